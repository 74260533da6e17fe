"""Draws docs/readme.png: an example picture, what its tree renders to, and the tree with a thumbnail at every node."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from unshade.decompose import decompose
from unshade.metrics import psnr
from unshade.nodes import Leaf, Node, Role, Tree, count_values, steps, tint
from unshade.parameters import Layout
from unshade.pictures import read_sphere
from unshade.render import evaluate, render
from unshade.sphere import disc_mask, sphere_normals

ROOT = Path(__file__).resolve().parent.parent
EXAMPLE = ROOT / "examples" / "red_lacquer.png"
THUMBNAIL = 76
SPHERE = 230
MARGIN = 28
PAPER, INK, LINE = (250, 250, 248), (40, 40, 44), (170, 170, 176)
OVERSAMPLING = 3


@dataclass
class Box:
    """A node of the drawing: what it shows, where, and what hangs below it."""

    node: Node
    label: str
    below: list[Box]
    x: float = 0.0
    y: float = 0.0


def picture(image: torch.Tensor, size: int) -> Image.Image:
    """(3, S, S) in [0, 1] as an RGBA picture of ``size`` pixels with an antialiased silhouette."""
    coverage = disc_mask(size * OVERSAMPLING).float()
    image = torch.nn.functional.interpolate(image[None].float(), size=size * OVERSAMPLING, mode="bilinear", antialias=True)[0]
    stacked = torch.cat([image.clamp(0.0, 1.0), coverage]).mul(255.0).round().byte().permute(1, 2, 0).numpy()
    return Image.fromarray(np.ascontiguousarray(stacked), "RGBA").resize((size, size), Image.Resampling.BOX)


def label_of(node: Node) -> str:
    """A tinted leaf is one thing to a person: a light or a form with a colour."""
    pair = tint(node)
    return (pair[1].kind if pair else node.kind).replace("_", " ")


def arrange(node: Node, left: float, depth: int) -> tuple[Box, float]:
    """A box for the node and everything below it, leaves side by side from ``left``; also where the next leaf goes."""
    if isinstance(node, Leaf) or tint(node):
        return Box(node, label_of(node), [], left + THUMBNAIL / 2, depth), left + THUMBNAIL + 12
    below = []
    for _, child in steps(node):
        box, left = arrange(child, left, depth + 1)
        below.append(box)
    return Box(node, label_of(node), below, (below[0].x + below[-1].x) / 2, depth), left


def every(box: Box) -> list[Box]:
    return [box, *(inner for child in box.below for inner in every(child))]


def shown(node: Node) -> torch.Tensor:
    """(3, 2T, 2T) what a node alone looks like; a mask is grey."""
    normals = sphere_normals(THUMBNAIL * 2)
    if isinstance(node, Leaf) and node.role is Role.MASK:
        layout = Layout.of(node)
        return evaluate(node, normals, layout.pack(node).to(normals), layout).expand(3, -1, -1)
    return render(node, normals)


def draw(image: torch.Tensor, tree: Tree, error: float) -> Image.Image:
    """The whole picture."""
    root, right = arrange(tree.root, 2 * MARGIN + SPHERE, 0)
    boxes = every(root)
    levels = 1 + int(max(box.y for box in boxes))
    rows = max(2 * SPHERE + 110, levels * (THUMBNAIL + 56) + 2 * MARGIN)
    canvas = Image.new("RGB", (int(right) + MARGIN, int(rows)), PAPER)
    pen = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(13)

    spread = (rows - 2 * MARGIN - THUMBNAIL - 20) / max(levels - 1, 1)
    for box in boxes:
        box.x, box.y = round(box.x), round(MARGIN + THUMBNAIL / 2 + box.y * spread)
    for box in boxes:
        if box.below:
            middle = (box.y + box.below[0].y) // 2
            pen.line([(box.x, box.y), (box.x, middle)], LINE, 2)
            pen.line([(box.below[0].x, middle), (box.below[-1].x, middle)], LINE, 2)
        for child in box.below:
            pen.line([(child.x, middle), (child.x, child.y)], LINE, 2)
    for box in boxes:
        thumbnail = picture(shown(box.node), THUMBNAIL)
        corner = (int(box.x - THUMBNAIL / 2), int(box.y - THUMBNAIL / 2))
        pen.rectangle([corner[0] - 2, corner[1] + THUMBNAIL, corner[0] + THUMBNAIL + 2, corner[1] + THUMBNAIL + 18], PAPER)
        canvas.paste(thumbnail, corner, thumbnail)
        pen.ellipse([*corner, corner[0] + THUMBNAIL - 1, corner[1] + THUMBNAIL - 1], outline=LINE)
        pen.text((box.x, box.y + THUMBNAIL / 2 + 9), box.label, INK, font, anchor="mm")

    top = (rows - 2 * SPHERE - 90) / 2
    rendered = render(tree, sphere_normals(2 * SPHERE))
    for caption, source in (("input", image), (f"its tree, rendered: {error:.1f} dB, {count_values(tree.root)} values", rendered)):
        sphere = picture(source, SPHERE)
        canvas.paste(sphere, (MARGIN, int(top)), sphere)
        pen.text((MARGIN + SPHERE / 2, top + SPHERE + 18), caption, INK, font, anchor="mm")
        top += SPHERE + 50
    return canvas


def main() -> None:
    """Decompose the example and draw it."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("picture", nargs="?", type=Path, default=EXAMPLE)
    options.add_argument("--output", type=Path, default=ROOT / "docs" / "readme.png")
    options.add_argument("--preset", default="draft", help="draft makes a tree small enough to read in a picture")
    chosen = options.parse_args()
    torch.set_num_threads(1)
    sphere = read_sphere(chosen.picture)
    result = decompose(sphere, preset=chosen.preset).result()
    error = psnr(sphere.image, render(result.tree, sphere_normals(sphere.image.shape[-1])), sphere.valid)
    draw(sphere.image, result.tree, error).save(chosen.output, optimize=True)
    print(f"{chosen.output.name}: {error:.2f} dB, {count_values(result.tree.root)} values")


if __name__ == "__main__":
    main()
