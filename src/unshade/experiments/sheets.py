"""Pictures of the experiments: inputs beside what each method made of them.

Pictures of sets that must not be passed on go to a folder that git ignores.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image as PILImage
from PIL import ImageDraw

from unshade import serde
from unshade.bench.datasets import Case
from unshade.bench.options import default_data
from unshade.experiments import subjects
from unshade.experiments.options import Options
from unshade.experiments.summaries import groups
from unshade.experiments.understanding import Question, truths
from unshade.pictures import SIZE
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals
from unshade.types import Image

Row = dict[str, Any]
Cell = tuple[Image, str]

CELL, CAPTION = 128, 28
GROUND, INK = "#1c1c1f", "#e4e4e4"
EACH = 2
"""Pictures of a set on a sheet that compares methods."""


def draw(path: Path, lines: Sequence[Sequence[Cell]]) -> Path | None:
    """A grid of spheres with captions; None where there is nothing."""
    if not lines:
        return None
    columns = max(map(len, lines))
    sheet = PILImage.new("RGB", (columns * CELL, len(lines) * (CELL + CAPTION)), GROUND)
    pen = ImageDraw.Draw(sheet)
    for k, line in enumerate(lines):
        for column, (image, caption) in enumerate(line):
            sheet.paste(_thumbnail(image), (column * CELL, k * (CELL + CAPTION)))
            pen.multiline_text((column * CELL + 4, k * (CELL + CAPTION) + CELL + 1), caption, fill=INK, spacing=0, font_size=11)
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)
    return path


def _thumbnail(image: Image) -> PILImage.Image:
    shown = image * disc_mask(image.shape[-1]) + (1.0 - disc_mask(image.shape[-1]).float()) * (0x1C / 255.0)
    array = (shown.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    return PILImage.fromarray(array).resize((CELL, CELL), PILImage.Resampling.BOX)


def _drawn(row: Row) -> Image:
    return render(serde.loads(row["tree"]), sphere_normals(SIZE))


def _cases(options: Options, rows: Sequence[Row]) -> dict[tuple[str, str], Case]:
    """The cases that rows are about."""
    data = options.data or default_data()
    found: dict[tuple[str, str], Case] = {}
    for (dataset,), own in groups(rows, "dataset").items():
        names = {row["name"] for row in own}
        found |= {
            (dataset, case.name): case for case in subjects.find_cases(dataset, data, 100_000 if not _counted(dataset) else _last(names))
        }
    return found


def _counted(dataset: str) -> bool:
    return dataset in (*subjects.STYLES, *subjects.POOLS)


def _last(names: set[str]) -> int:
    return max(int(name) for name in names) + 1


def compared(options: Options, rows: Sequence[Row], chosen: Sequence[str], each: int) -> list[list[Cell]]:
    """A line a picture of the chosen sets: the input, then every method's."""
    rows = [row for row in rows if row["dataset"] in chosen]
    cases, lines = _cases(options, rows), []
    for own in groups(rows, "dataset").values():
        for (dataset, name), found in list(groups(own, "dataset", "name").items())[:each]:
            line = [(subjects.load(cases[dataset, name], options.seed).sphere.image, f"{dataset}\n{name.rpartition('.')[0] or name}"[:44])]
            line += [(_drawn(row), f"{row['method']}\n{row['psnr']:.1f} dB, {row['values']} values") for row in found]
            lines.append(line)
    return lines


def decomposition(options: Options, rows: Sequence[Row]) -> Path | None:
    """Some pictures of each set with all methods, nothing fitted afterwards."""
    plain = [row for row in rows if "+" not in row["method"]]
    return draw(options.figures / "decomposition.png", compared(options, plain, (*subjects.STYLES, "pbr"), EACH))


def ablation(options: Options, rows: Sequence[Row]) -> Path | None:
    """Some pictures of each set with all variants."""
    return draw(options.figures / "ablation.png", compared(options, rows, (*subjects.STYLES, "pbr"), EACH))


def wild(options: Options, rows: Sequence[Row]) -> Path | None:
    """All that may be shown; the others apart."""
    kept = [row["dataset"] for row in rows if row["dataset"] in subjects.PRIVATE]
    draw(options.sheets / "experiments-wild.png", _side_by_side(compared(options, rows, kept, 100)))
    shown = [row["dataset"] for row in rows if row["dataset"] not in subjects.PRIVATE]
    return draw(options.figures / "wild.png", _side_by_side(compared(options, rows, shown, 100)))


def _side_by_side(lines: list[list[Cell]]) -> list[list[Cell]]:
    """Two pictures in a line, so that the sheet is not endless."""
    return [[cell for line in lines[k : k + 2] for cell in line] for k in range(0, len(lines), 2)]


def analogy(options: Options, rows: Sequence[Row]) -> Path | None:
    """The first analogy of each component: what is given, the true answer, and every method's."""
    asked = [row for row in rows if row["kind"] == "analogy" and "-000-" in row["name"]]
    lines = []
    for (component, _), own in groups(asked, "component", "name").items():
        numbers = own[0]["numbers"]
        dataset = next(row["pool"] for row in own)
        a, b, p, q, ab, answer = truths(Question(dataset, component, tuple(numbers)), options.seed)
        line = [(subjects.shown(tree), f"{component}\n{name}") for tree, name in zip((a, b, ab, p, q, answer), _GIVEN, strict=True)]
        line += [(_drawn(row), f"{row['method']}\n{row['understood']}, {row['psnr']:.1f} dB") for row in own]
        lines.append(line)
    return draw(options.figures / "analogy.png", lines)


_GIVEN = ("A", "B", "AB, seen", "P", "Q", "true answer")

SHEETS: dict[str, Callable[[Options, Sequence[Row]], Path | None]] = {
    "decomposition": decomposition,
    "analogy": analogy,
    "ablation": ablation,
    "wild": wild,
}
