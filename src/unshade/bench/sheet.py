"""The worst ten of each set and method on one sheet: input, render, difference. It says what a method lacks.

Sheets show the pictures themselves, so they go to a folder that the repository ignores.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from PIL import Image as PILImage
from PIL import ImageDraw

from unshade import serde
from unshade.bench.datasets import find_cases, load
from unshade.bench.journal import Row
from unshade.bench.options import Options, default_data
from unshade.files import save_whole
from unshade.render import render
from unshade.sphere import sphere_normals
from unshade.types import Image

WORST = 10
AMPLIFIED = 4.0
CELL, CAPTION = 192, 30


def worst(options: Options, rows: Sequence[Row], folder: Path) -> list[Path]:
    """Draw a sheet for each set and method, the worst first."""
    folder.mkdir(parents=True, exist_ok=True)
    data = options.data or default_data()
    written = []
    for dataset, method in dict.fromkeys((row["dataset"], row["method"]) for row in rows):
        chosen = sorted((row for row in rows if (row["dataset"], row["method"]) == (dataset, method)), key=lambda row: row["psnr"])[:WORST]
        cases = {case.name: case for case in find_cases(dataset, data, options.limit)}
        sheet = PILImage.new("RGB", (2 * 3 * CELL, -(-len(chosen) // 2) * (CELL + CAPTION)), "#202020")
        pen = ImageDraw.Draw(sheet)
        for index, row in enumerate(chosen):
            subject = load(cases[row["name"]], row["seed"])
            picture = subject.sphere.image
            found = render(serde.loads(row["tree"]), sphere_normals(picture.shape[-1]))
            difference = ((found - picture) * AMPLIFIED + 0.5) * subject.scored + 0.5 * ~subject.scored
            left, top = (index % 2) * 3 * CELL, (index // 2) * (CELL + CAPTION)
            for column, image in enumerate((picture, found, difference)):
                sheet.paste(_thumbnail(image), (left + column * CELL, top))
            caption = f"{row['name']}  {row['psnr']:.1f} dB  {row['values']} values, {row['leaves']} leaves"
            pen.text((left + 4, top + CELL + 4), caption, fill="#e0e0e0")
        path = folder / f"{dataset}.{method}.png".replace(":", "-")
        save_whole(path, partial(sheet.save, format="PNG"))
        written.append(path)
    return written


def _thumbnail(image: Image) -> PILImage.Image:
    array = (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    return PILImage.fromarray(array).resize((CELL, CELL), PILImage.Resampling.BOX)
