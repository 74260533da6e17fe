"""Draws docs/editing.png: what the verbs of docs/editing.md do to the trees of two example pictures."""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont

from unshade.assignment import read_color
from unshade.decompose import decompose
from unshade.edit import harden, move_light, remove, soften, transfer
from unshade.nodes import Tree, leaf
from unshade.pictures import read_sphere
from unshade.recolor import recolor
from unshade.relight import relight
from unshade.selection import select
from unshade.surroundings import Surroundings, under
from unshade.turntable import directions, frame
from unshade.vary import vary

ROOT = Path(__file__).resolve().parent.parent
SIZE, GAP, WORDS, COLUMNS = 180, 10, 26, 5


def sky() -> Surroundings:
    """Blue above, brown below, a window on the left and a low sun on the right."""
    along = directions(64)
    above = (along[1:2] > 0).float()
    light = above * torch.tensor([0.35, 0.55, 0.95])[:, None, None] + (1.0 - above) * torch.tensor([0.3, 0.2, 0.12])[:, None, None]
    sun = torch.nn.functional.normalize(torch.tensor([0.7, 0.35, 0.6]), dim=0)
    light = light + 30.0 * torch.exp(250.0 * (torch.einsum("c,chw->hw", sun, along) - 1.0)) * torch.tensor([1.0, 0.8, 0.5])[:, None, None]
    longitude, latitude = torch.atan2(along[0], along[2]), along[1].asin()
    window = ((longitude + 1.2).abs() < 0.4) & ((latitude - 0.4).abs() < 0.35)
    return Surroundings(torch.where(window, torch.tensor([4.0, 4.4, 5.0])[:, None, None], light))


def tree_of(name: str) -> Tree:
    return decompose(read_sphere(ROOT / "examples" / f"{name}.png")).result().tree


def main() -> None:
    red, green = tree_of("red_lacquer"), tree_of("green_metal")
    surroundings = sky()
    panorama = Tree(leaf("environment_map", pixels=surroundings.raster))
    highlights = [address for address in select(red.root, "highlight") if red.find(address).role.value == "highlight"]  # type: ignore[union-attr]
    shown: list[tuple[str, Tree, Tree | None]] = [
        ("the tree of a picture", red, None),
        ('recolor "#2f7fd0"', recolor(red, read_color("#2f7fd0")), None),
        ("relight --turn 60,0", relight(red, 60.0), relight(red, 60.0)),
        ("relight --environment", under(red, surroundings), panorama),
        ("… --turn 120,0", relight(under(red, surroundings), 120.0), relight(panorama, 120.0)),
        ("another tree", green, None),
        ("transfer albedo", transfer(green, red, "albedo"), None),
        ("transfer diffuse", transfer(green, red, "diffuse"), None),
        ("edit --remove highlights", remove(red, *highlights), None),
        ("soften --by 2.5", soften(red, 2.5), None),
        ("harden --by 2.5", harden(red, 2.5), None),
        ("edit --move-light 0,-60", move_light(red, 0.0, -60.0), None),
        *((f"vary, number {number}", tree, None) for number, tree in enumerate(vary(red, 3, seed=4, strength=0.7))),
    ]
    rows = -(-len(shown) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * (SIZE + GAP) + GAP, rows * (SIZE + WORDS + GAP) + GAP), (31, 31, 31))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for number, (words, tree, lights) in enumerate(shown):
        row, column = divmod(number, COLUMNS)
        x, y = GAP + column * (SIZE + GAP), GAP + row * (SIZE + WORDS + GAP)
        pixels = (frame(tree, SIZE, lights).clamp(0.0, 1.0) * 255.0).round().byte().permute(1, 2, 0).numpy()
        sheet.paste(Image.fromarray(pixels), (x, y))
        draw.text((x + SIZE / 2, y + SIZE + 5), words, fill=(225, 225, 225), font=font, anchor="ma")
    sheet.save(ROOT / "docs" / "editing.png", optimize=True)


if __name__ == "__main__":
    main()
