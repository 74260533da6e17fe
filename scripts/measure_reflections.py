"""Measure what holding a reflected environment as a picture is worth, and draw docs/reflections.png.

    python scripts/measure_reflections.py [--trees 20] [--seed 2] [--first 0]

The first unseen trees of a seed that reflect an environment are rendered to 8 bits and decomposed twice, with lights and with a picture.
Compared with the known tree are the picture, what is beneath the environment, what the environment is where it can be seen, and the
picture once everything is turned by 60 degrees. Writes benchmarks/results/reflections.json and docs/reflections.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from PIL import Image, ImageDraw, ImageFont

from unshade.bench.report import machine, versions
from unshade.components import Component
from unshade.decompose import decompose
from unshade.edit import transfer
from unshade.experiments.pieces import pieces
from unshade.experiments.subjects import known
from unshade.grammar import same_structure
from unshade.metrics import psnr
from unshade.models import weights
from unshade.nodes import Leaf, Tree, leaf, walk
from unshade.pictures import SIZE
from unshade.relight import relight
from unshade.render import render
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.synthesis import trees

ROOT = Path(__file__).resolve().parent.parent
RESULTS, PAGE, FIGURE = (ROOT / path for path in ("benchmarks/results/reflections.json", "docs/reflections.md", "docs/reflections.png"))
NORMALS, SCORED = sphere_normals(SIZE), disc_mask(SIZE, SCORED_RADIUS)
NOTHING = Tree(leaf("albedo", color=(0.0, 0.0, 0.0)))
DEGREES = 60.0
SHOWN, CELL, GAP, WORDS = 5, 150, 8, 40
"""Trees of the figure, and its sizes in pixels."""

FIGURES = {
    "picture": "the picture",
    "beneath": "beneath the environment",
    "environment": "the environment, where it shows",
    "turned": f"all lights turned by {DEGREES:.0f} degrees",
}


def reflecting(seed: int, first: int, count: int) -> Iterator[tuple[int, Tree]]:
    """Unseen trees of the released grammar that reflect an environment, with their numbers."""
    numbered = enumerate(trees("realistic", "test", seed=seed))
    chosen = ((number, tree) for number, tree in numbered if (pieces(tree) or {}).get(Component.ENVIRONMENT))
    return islice(chosen, first, first + count)


def without(tree: Tree) -> Tree:
    """What is beneath the environment; of a tree without one, the lights that stand for it are left out."""
    return transfer(NOTHING, tree, Component.ENVIRONMENT, stand_ins=not environments(tree))


def environments(tree: Tree) -> list[Leaf]:
    """The environments that a tree holds."""
    return [node for _, node in walk(tree.root) if isinstance(node, Leaf) and node.kind in ("environment", "environment_map")]


def compared(found: Tree, true: Tree) -> dict[str, Any]:
    """How near a recovered tree is."""
    beneath = without(true)
    figures = {
        "picture": psnr(render(found, NORMALS), render(true, NORMALS), SCORED),
        "beneath": psnr(render(without(found), NORMALS), render(beneath, NORMALS), SCORED),
        "turned": psnr(render(relight(found, DEGREES), NORMALS), render(relight(true, DEGREES), NORMALS), SCORED),
        "structure": same_structure(without(found), beneath),
        "values": without(found).values,
    }
    if environments(found):
        shows = SCORED & (render(beneath, NORMALS).amax(0, keepdim=True) < 0.9)
        balls = [render(Tree(environments(tree)[0]), NORMALS) for tree in (found, true)]
        figures["environment"] = psnr(*balls, shows)
    return figures


def measured(seed: int, first: int, count: int) -> tuple[list[dict[str, Any]], list[tuple[Tree, Tree, Tree]]]:
    """A row a tree and way, and the trees: true, with lights, with a picture."""
    rows, kept = [], []
    for number, true in reflecting(seed, first, count):
        sphere, found = known(true).sphere, []
        for how in ("lights", "picture"):
            began = time.process_time()
            tree = decompose(sphere, reflections=how).result().tree  # type: ignore[arg-type]
            seconds = time.process_time() - began
            found.append(tree)
            rows.append({"tree": number, "reflections": how, **compared(tree, true), "cpu_seconds": round(seconds, 2)})
            print({key: round(value, 1) if isinstance(value, float) else value for key, value in rows[-1].items()}, flush=True)
        kept.append((true, found[0], found[1]))
    return rows, kept


def draw(kept: list[tuple[Tree, Tree, Tree]]) -> None:
    """A row a tree: the picture, what is beneath, what is reflected, and all turned, both ways and in truth."""
    titles = (
        "the picture",
        "lights: what is\nbeneath",
        "picture: what is\nbeneath",
        "what is beneath\nin truth",
        "the environment\nas found",
        "the environment\nin truth",
        "lights: turned",
        "picture: turned",
        "turned in truth",
    )
    sheet = Image.new("RGB", (len(titles) * (CELL + GAP) + GAP, WORDS + len(kept) * (CELL + GAP) + GAP), (31, 31, 31))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for column, title in enumerate(titles):
        pen.multiline_text((GAP + column * (CELL + GAP) + CELL / 2, 6), title, fill=(225, 225, 225), font=font, anchor="ma", align="center")
    normals = sphere_normals(CELL)
    for row, (true, lights, picture) in enumerate(kept):
        balls = [true, without(lights), without(picture), without(true)]
        balls += [Tree(found[0]) if (found := environments(tree)) else NOTHING for tree in (picture, true)]
        balls += [relight(tree, DEGREES) for tree in (lights, picture, true)]
        for column, tree in enumerate(balls):
            image = torch.where(disc_mask(CELL), render(tree, normals), 31.0 / 255.0)
            pixels = (image * 255.0).round().byte().permute(1, 2, 0).numpy()
            sheet.paste(Image.fromarray(pixels), (GAP + column * (CELL + GAP), WORDS + row * (CELL + GAP)))
    sheet.save(FIGURE, optimize=True)


def table(rows: list[dict[str, Any]]) -> str:
    """Mean, median and worst tenth of each figure, for both ways."""
    lines = ["| PSNR in dB: mean / median / worst tenth | lights | picture |", "|---|---|---|"]
    ways = {how: [row for row in rows if row["reflections"] == how] for how in ("lights", "picture")}
    for key, title in FIGURES.items():
        cells = []
        for own in ways.values():
            numbers = sorted(row[key] for row in own if key in row)
            worst = numbers[len(numbers) // 10] if numbers else 0.0
            text = f"{statistics.mean(numbers):.1f} / {statistics.median(numbers):.1f} / {worst:.1f}" if numbers else ""
            cells.append(text + (f" of {len(numbers)}" if numbers and len(numbers) < len(own) else ""))
        lines.append(f"| {title} | {' | '.join(cells)} |")
    right = [f"{sum(row['structure'] for row in own)} of {len(own)}" for own in ways.values()]
    lines.append(f"| the structure beneath is the true one | {' | '.join(right)} |")
    for key, title, digits in (("values", "values beneath, median", 0), ("cpu_seconds", "seconds of one core, median", 1)):
        lines.append(f"| {title} | {' | '.join(f'{statistics.median(row[key] for row in own):.{digits}f}' for own in ways.values())} |")
    return "\n".join(lines)


def page(document: dict[str, Any]) -> str:
    """docs/reflections.md."""
    rows = document["rows"]
    return f"""# Reflections

A ball that reflects a room holds a whole photograph. `unshade decompose` explains it with a few lights, since every value has
to pay; the tree is small, but the lights are not the room, and form and highlights bend to make up for it. With

    unshade decompose chrome.png -o out --reflections picture

(`decompose(..., reflections="picture")`) the environment becomes what it is, a lat-long picture of 128 x 64 pixels on top of a
small tree of what is beneath. It can be turned with the lights, taken off, and put on another ball. The tree of lights stays in
the family, one size smaller. `unshade analogy` decomposes so by itself.

How it is done: where a picture has edges, paints end; they are circles on the ball, found to a fraction of a pixel
([circles.py](../src/unshade/circles.py); all of them and no other in 83 of 100 unseen trees). A small network guesses the picture
beneath ([model card](model-card.md)). A tree with those paints and the guess's lights is then fitted to how the picture *bends*:
in `log(1 - I) - log(1 - N)`, the logarithm of what the environment leaves, nothing of the tree N may be seen any more
([separation.py](../src/unshade/separation.py)). What is left over is the environment
([reflections.py](../src/unshade/reflections.py)).

It is made for renderings and MatCaps in the words of the released grammar: one form, two masks at most, white highlights.
Pictures with much grain (all of less than about 64 pixels seem to have it), those that a small tree holds at 48 dB, those in
which the network sees no reflection, and drawings, whose edges would stay in what is left over, stay with lights. One paint alone
does not tell how much of its brightness is reflected, so there the guess decides.

## Measured

`python scripts/measure_reflections.py --trees {document["trees"]} --seed {document["seed"]}`: {document["trees"]} unseen trees
of the released grammar (colours, directions, masks and environments occur in no training), `balanced`, against the known tree;
every row is in [benchmarks/results/reflections.json](../benchmarks/results/reflections.json). Seeds 90001 and 90002 were looked
at while this was built.

{table(rows)}

The picture loses in values: 24,576 of the raster come on top of those in the table. What a turn shows that could not be seen
before, behind the ball and under highlights, is filled in smoothly.

![Pictures, what is beneath them, what they reflect, and all turned](reflections.png)
"""


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--trees", type=int, default=20)
    options.add_argument("--seed", type=int, default=2)
    options.add_argument("--first", type=int, default=0)
    given = options.parse_args()
    torch.set_num_threads(1)
    rows, kept = measured(given.seed, given.first, given.trees)
    card = weights.read_card(weights.file_of("reflection"))
    about = {"trees": given.trees, "seed": given.seed, "first": given.first, "machine": machine(), "versions": versions()}
    document = {**about, "weights": {key: card[key] for key in ("config", "steps", "hours") if key in card}, "rows": rows}
    text = json.dumps({key: value for key, value in document.items() if key != "rows"})[:-1]
    RESULTS.write_text(text + ', "rows": [\n' + ",\n".join(map(json.dumps, rows)) + "\n]}\n", encoding="utf-8")
    PAGE.write_text(page(document), encoding="utf-8")
    draw(kept[:SHOWN])


if __name__ == "__main__":
    main()
