"""Pictures of the experiments: inputs beside what each method made of them.

Pictures of sets that must not be passed on go to a folder that git ignores.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image as PILImage
from PIL import ImageColor, ImageDraw

from unshade import serde
from unshade.bench.datasets import Case
from unshade.bench.options import default_data
from unshade.experiments import subjects
from unshade.experiments.options import Options
from unshade.experiments.summaries import groups
from unshade.experiments.understanding import Question, truths
from unshade.files import save_whole
from unshade.pictures import SIZE
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals
from unshade.types import Image

Row = dict[str, Any]
Cell = tuple[Image | None, str]
"""A sphere and what stands below it; None where there is no sphere."""

WIDTH = 1600
"""Of a whole sheet. GitHub shows it about 900 wide, so that letters of 20 are read as 11, however many columns there are."""

WIDEST = 220
"""Of a column, where there are few."""

PAD, GAP = 12, 44
"""Between columns, and between groups of them."""

TEXT, LINE = 20, 24
GROUND, INK, FAINT = "#56565b", "#f4f4f4", "#a4a4a8"
"""Neither black outlines nor white lights vanish on this grey."""

EACH = 2
"""Pictures of a set on a sheet that compares methods."""


@dataclass(frozen=True)
class Table:
    """Spheres in columns."""

    heads: Sequence[Sequence[str]]
    """Titles of the columns, in groups that stand apart."""
    lines: Sequence[Sequence[Cell]]


def draw(path: Path, *tables: Table) -> Path | None:
    """A file of what `sheet` makes; None where there is nothing."""
    filled = [table for table in tables if table.lines]
    if not filled:
        return None
    path.parent.mkdir(parents=True, exist_ok=True)
    save_whole(path, lambda file: sheet(*filled).save(file, "PNG", optimize=True))
    return path


def sheet(*tables: Table) -> PILImage.Image:
    """Tables one below the other, with columns of one width."""
    sizes = [(sum(map(len, table.heads)), PAD + GAP * (len(table.heads) - 1)) for table in tables]
    pitch = min(WIDEST, *((WIDTH - between) // columns for columns, between in sizes))
    width = max(columns * pitch + between for columns, between in sizes)
    parts = [_drawn_table(table, pitch, width) for table in tables]
    whole = PILImage.new("RGB", (width, PAD + sum(part.height for part in parts)), GROUND)
    top = PAD
    for part in parts:
        whole.paste(part, (0, top))
        top += part.height
    return whole


def _drawn_table(table: Table, pitch: int, width: int) -> PILImage.Image:
    size, titles = pitch - PAD, [title for group in table.heads for title in group]
    apart = [GAP * number for number, group in enumerate(table.heads) for _ in group]
    lefts = [PAD + column * pitch + gap for column, gap in enumerate(apart)]
    head = _lines(titles) * LINE
    tops = [head + PAD // 2]
    for line in table.lines:
        tall = _lines(caption for _, caption in line)
        tops.append(tops[-1] + size + tall * LINE + (2 * PAD if tall else PAD))
    made = PILImage.new("RGB", (width, tops[-1]), GROUND)
    pen = ImageDraw.Draw(made)
    for left, title in zip(lefts, titles, strict=True):
        _write(pen, left + size // 2, head - _lines([title]) * LINE, title)
    for top, line in zip(tops, table.lines, strict=False):
        for left, (image, caption) in zip(lefts, line, strict=False):
            if image is None:
                pen.text((left + size // 2, top + size // 2), "none", fill=FAINT, anchor="mm", font_size=TEXT)
            else:
                made.paste(_thumbnail(image, size), (left, top))
            _write(pen, left + size // 2, top + size + PAD // 4, caption)
    return made


def _lines(texts: Iterable[str]) -> int:
    """Of the tallest."""
    return max(len(text.splitlines()) for text in texts)


def _write(pen: ImageDraw.ImageDraw, middle: int, top: int, text: str) -> None:
    for number, line in enumerate(text.splitlines()):
        pen.text((middle, top + number * LINE), line, fill=INK, anchor="ma", font_size=TEXT)


def _thumbnail(image: Image, size: int) -> PILImage.Image:
    disc = disc_mask(image.shape[-1])
    ground = torch.tensor(ImageColor.getrgb(GROUND))[:, None, None] / 255.0
    shown = torch.where(disc, image.clamp(0.0, 1.0), ground)
    array = (shown * 255.0).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    return PILImage.fromarray(array).resize((size, size), PILImage.Resampling.HAMMING)


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


def _title(method: str) -> str:
    """The name of a method, broken where its parts meet."""
    return method.replace(":", ":\n").replace("+", "\n+")


def _name(dataset: str, name: str) -> str:
    """What stands below an input."""
    words = (name.rpartition(".")[0] or name).replace("_", " ")
    return f"{dataset}\n{textwrap.fill(words, 13, max_lines=2, placeholder='…')}"


def compared(options: Options, rows: Sequence[Row], chosen: Sequence[str], each: int) -> Table:
    """A line a picture of the chosen sets: the input, then every method's."""
    rows = [row for row in rows if row["dataset"] in chosen]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    cases, lines = _cases(options, rows), []
    for own in groups(rows, "dataset").values():
        for (dataset, name), found in list(groups(own, "dataset", "name").items())[:each]:
            given = subjects.load(cases[dataset, name], options.seed).sphere.image
            lines.append([(given, _name(dataset, name)), *_answers(found, methods, lambda row: f"{row['values']} values")])
    return Table([["input", *map(_title, methods)]], lines)


def _answers(rows: Sequence[Row], methods: Sequence[str], more: Callable[[Row], str]) -> list[Cell]:
    """What each method made of one picture."""
    cells: dict[str, Cell] = {row["method"]: (_drawn(row), f"{row['psnr']:.1f} dB\n{more(row)}") for row in rows}
    return [cells.get(method, (None, "")) for method in methods]


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


def _side_by_side(table: Table) -> Table:
    """Two pictures in a line, so that the sheet is not endless."""
    pairs = [table.lines[k : k + 2] for k in range(0, len(table.lines), 2)]
    return Table([*table.heads, *table.heads], [[cell for line in pair for cell in line] for pair in pairs])


def analogy(options: Options, rows: Sequence[Row]) -> Path | None:
    """The first analogy of each component: what is given, then the true answer and every method's."""
    asked = [row for row in rows if row["kind"] == "analogy" and "-000-" in row["name"]]
    methods = list(dict.fromkeys(row["method"] for row in asked))
    given, answers = [], []
    for (component, _), own in groups(asked, "component", "name").items():
        question = Question(own[0]["pool"], component, tuple(own[0]["numbers"]))
        a, b, p, q, ab, answer = (subjects.shown(tree) for tree in truths(question, options.seed))
        given.append([(a, component), (b, ""), (ab, ""), (p, ""), (q, "")])
        answers.append([(answer, component), *_answers(own, methods, lambda row: str(row["understood"] or "unclear"))])
    told = _side_by_side(Table([["A", "B", "AB, seen", "P", "Q"]], given))
    return draw(options.figures / "analogy.png", told, Table([["true\nanswer", *map(_title, methods)]], answers))


SHEETS: dict[str, Callable[[Options, Sequence[Row]], Path | None]] = {
    "decomposition": decomposition,
    "analogy": analogy,
    "ablation": ablation,
    "wild": wild,
}
