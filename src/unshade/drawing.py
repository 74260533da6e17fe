"""Pictures of a tree: one a node, and the drawn tree as SVG with a thumbnail at every node.

The SVG needs no font, no script and no other file, and follows a dark or a light screen. A light with its own albedo is
drawn as one tinted sphere with the two it is made of below it, as a person sees it.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from PIL import Image as PillowImage

from unshade.blend import BLENDS
from unshade.labels import SIGNS, escape, folds, key_values, label, shown_color
from unshade.nodes import Leaf, Node, Operator, Role, Tree, steps, walk
from unshade.parameters import Layout
from unshade.render import shade_leaf, srgb_encode
from unshade.sphere import sphere_normals
from unshade.types import Image, Normals

DRAWN_NODES = 600
"""A tree with more nodes is drawn without pictures, which would make the file too heavy to open."""

THUMB = 64.0
SMALL = 22.0
COLUMN = 100.0
ROW = 156.0
MARGIN = 16.0
LINE = 14.0

STYLE = """
.shade-tree{font-family:system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif;font-size:11px}
.shade-tree .paper{fill:#ffffff}.shade-tree .ring{fill:none;stroke:#000000;stroke-opacity:.14}
.shade-tree .edge{fill:none;stroke:#b9b9b4;stroke-width:1.5}.shade-tree .to-mask{stroke-dasharray:3 3}
.shade-tree .pill{fill:#ecebe7}.shade-tree .sign{fill:#1c1c1e;font-weight:600}
.shade-tree .name{fill:#1c1c1e;font-weight:600}.shade-tree .value{fill:#5f5f64}
.shade-tree .white{fill:#ffffff;stroke:#5f5f64}.shade-tree .black{fill:#1c1c1e;stroke:#5f5f64}
@media (prefers-color-scheme:dark){
.shade-tree .paper{fill:#161719}.shade-tree .ring{stroke:#ffffff;stroke-opacity:.22}.shade-tree .edge{stroke:#55565c}
.shade-tree .pill{fill:#2b2c30}.shade-tree .sign,.shade-tree .name{fill:#f0f0f2}.shade-tree .value{fill:#a6a6ae}
}
""".strip()


def shaded_nodes(tree: Tree, normals: Normals) -> Iterator[tuple[str, Image]]:
    """Every node's own subtree rendered, children before parents, each node evaluated once.

    Args:
        normals: (3, H, W) unit vectors.
    Yields:
        address and (1 or 3, H, W) display-encoded picture in [0, 1]; masks are shown as they are.
    """
    layout = Layout.of(tree.root)
    parameters = layout.pack(tree.root).to(normals)
    slots = reversed(layout.slots)
    waiting: list[Image] = []
    for address, node in reversed(list(walk(tree.root))):
        if isinstance(node, Leaf):
            value = shade_leaf(node, normals, parameters, next(slots))
        else:
            value = BLENDS[node.kind].apply(*(waiting.pop() for _ in steps(node)))
        waiting.append(value)
        encoded = tree.blend_space == "linear" and not (isinstance(node, Leaf) and node.role is Role.MASK)
        yield address, srgb_encode(value) if encoded else value


def layers(tree: Tree, size: int) -> dict[str, Image]:
    """One picture a node, its own subtree rendered on the sphere, masks in grey.

    Args:
        size: width and height in pixels.
    Returns:
        address -> (3, size, size) display-encoded in [0, 1], in the order of `nodes.walk`. Grey pictures are views of one channel.
    """
    pictures = {address: picture.expand(3, size, size) for address, picture in shaded_nodes(tree, sphere_normals(size))}
    return dict(reversed(pictures.items()))


def data_uri(picture: Image, encoding: str = "png", quality: int = 90) -> str:
    """A (1, 3 or 4, H, W) picture in [0, 1] as an 8-bit ``data:`` address.

    Args:
        encoding: ``png``, ``webp`` (lossless) or ``webp-lossy`` with a ``quality``.
    """
    pixels = (picture.detach().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    image = PillowImage.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels)
    buffer = io.BytesIO()
    if encoding == "png":
        image.save(buffer, "PNG")
    else:
        image.save(buffer, "WEBP", lossless=encoding == "webp", quality=quality if encoding == "webp-lossy" else 20, method=1)
    name = "png" if encoding == "png" else "webp"
    return f"data:image/{name};base64,{base64.b64encode(buffer.getvalue()).decode()}"


@dataclass
class _Box:
    """A node's place in the drawing: ``x`` is its middle, ``y`` its top."""

    address: str
    node: Node
    below: list[_Box] = field(default_factory=list)
    mask: str = ""
    pair: tuple[str, str] | None = None
    """Addresses of the albedo and the light of a tint that is drawn as one."""
    width: float = COLUMN
    x: float = 0.0
    y: float = 0.0


def _plan(root: Node, fold: bool) -> _Box:
    """Which nodes get a place of their own, and how much room each subtree needs."""
    waiting: list[_Box] = []
    for address, node in reversed(list(walk(root))):
        box = _Box(address, node)
        if isinstance(node, Operator):
            below = [waiting.pop() for _ in steps(node)]
            pair = folds(node) if fold else None
            if pair:
                first, second = (child.address for child in below)
                box.pair = (first, second) if below[0].node == pair[0] else (second, first)
            else:
                box.mask = below.pop().address if node.mask is not None else ""
                box.below = below
                own = COLUMN + 2.0 * (THUMB + 4.0) if box.mask else COLUMN
                box.width = max(own, sum(child.width for child in below))
        waiting.append(box)
    return waiting[0]


def _lines(box: _Box) -> int:
    """Lines of text under a node: its name and its key values."""
    if box.pair and isinstance(box.node, Operator):
        return 2 + max(len(key_values(leaf, lines=2)) for leaf in box.node.children if isinstance(leaf, Leaf))
    return 1 + len(key_values(box.node)) if isinstance(box.node, Leaf) else 2


def _place(root: _Box) -> tuple[float, float]:
    """Set every box's x and y; the size of the whole."""
    depth, queue = 0.0, [(root, MARGIN, MARGIN)]
    order: list[_Box] = []
    while queue:
        box, left, top = queue.pop()
        order.append(box)
        box.x, box.y = left + box.width / 2, top
        depth = max(depth, top + THUMB + LINE * (_lines(box) + 0.6) + (SMALL if box.pair else 0.0))
        left += (box.width - sum(child.width for child in box.below)) / 2
        for child in box.below:
            queue.append((child, left, top + ROW))
            left += child.width
    for box in reversed(order):
        if box.below:
            box.x = (box.below[0].x + box.below[-1].x) / 2
    return root.width + 2 * MARGIN, depth + MARGIN


def tree_svg(
    tree: Tree,
    *,
    title: str = "Shade tree",
    thumbnail: int = 128,
    encoding: str = "png",
    quality: int = 90,
    prefix: str = "node",
    standalone: bool = True,
    fold: bool = True,
) -> str:
    """The drawn tree: operators above what they join, a picture of every node, names and key values under the leaves.

    Args:
        title: what a screen reader says first.
        thumbnail: pixels of each embedded picture, which is drawn at 64.
        encoding: see `data_uri`. Lossless PNG opens in every vector program; browsers also take WebP.
        prefix: starts every ``id``, so that several drawings can stand in one page. The picture of the k-th node of
            `nodes.walk` is ``{prefix}-{k}``, a symbol with a view box of 1 x 1.
        standalone: draw a background and carry `STYLE`; without, the drawing is to stand in a page that does.
        fold: draw a light with its own albedo as one tinted sphere.
    """
    places = {address: f"{prefix}-{index}" for index, (address, _) in enumerate(walk(tree.root))}
    root = _plan(tree.root, fold)
    width, height = _place(root)
    area = f'width="{width:.0f}" height="{height:.0f}"'
    # A page can make it smaller only by how much it knows its own width.
    known = "" if standalone else f' style="--width:{width:.0f}px"'
    about = f'viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(title)}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="shade-tree" {area}{known} {about}>',
        f"<style>{STYLE}</style><defs>" if standalone else "<defs>",
        f'<clipPath id="{prefix}-disc" clipPathUnits="userSpaceOnUse"><circle cx="0.5" cy="0.5" r="0.5"/></clipPath>',
        *_symbols(tree, places, prefix, thumbnail, encoding, quality),
        "</defs>",
    ]
    if standalone:
        parts.append(f'<rect class="paper" {area} rx="10" fill="#ffffff"/>')
    boxes = list(_boxes(root))
    parts += [_edges(box) for box in boxes if box.below]
    parts += [_drawn(box, tree, places) for box in boxes]
    return "\n".join([*parts, "</svg>", ""])


def _symbols(tree: Tree, places: dict[str, str], prefix: str, size: int, encoding: str, quality: int) -> Iterator[str]:
    """One symbol a node, a disc of diameter 1: a flat colour for an albedo, an embedded picture for the rest."""
    pictured = len(places) <= DRAWN_NODES
    nodes = dict(walk(tree.root))
    pictures = shaded_nodes(tree, sphere_normals(size)) if pictured else ((address, None) for address in nodes)
    for address, picture in pictures:
        node = nodes[address]
        if isinstance(node, Leaf) and node.kind == "albedo":
            shape = f'<circle cx=".5" cy=".5" r=".5" fill="{shown_color(node["color"], tree.blend_space)}"/>'
        elif picture is None:
            shape = '<circle cx=".5" cy=".5" r=".5" fill="#8a8a8a"/>'
        else:
            shape = f'<image width="1" height="1" clip-path="url(#{prefix}-disc)" href="{data_uri(picture, encoding, quality)}"/>'
        yield f'<symbol id="{places[address]}" viewBox="0 0 1 1">{shape}</symbol>'


def _boxes(root: _Box) -> Iterator[_Box]:
    stack = [root]
    while stack:
        box = stack.pop()
        yield box
        stack.extend(reversed(box.below))


def _edges(box: _Box) -> str:
    """Curves from an operator's sign to what it joins; a mix marks its white and its black side."""
    start = box.y + THUMB + 28.0
    parts = []
    for index, child in enumerate(box.below):
        end = child.y - 4.0
        middle = (start + end) / 2
        path = f"M{box.x:.1f} {start:.1f}C{box.x:.1f} {middle:.1f} {child.x:.1f} {middle:.1f} {child.x:.1f} {end:.1f}"
        parts.append(f'<path class="edge" d="{path}" fill="none" stroke="#b9b9b4"/>')
        if box.mask:
            side, color, words = (("white", "#ffffff", "1"), ("black", "#1c1c1e", "0"))[index]
            parts.append(
                f'<circle class="{side}" cx="{child.x:.1f}" cy="{end - 7:.1f}" r="4" fill="{color}" stroke="#5f5f64">'
                f"<title>shown where the mask is {words}</title></circle>"
            )
    return "".join(parts)


def _disc(place: str, x: float, y: float, size: float) -> str:
    """A node's picture as a disc whose middle is at x and top at y."""
    middle = f'cx="{x:.1f}" cy="{y + size / 2:.1f}" r="{size / 2 - 0.5:g}"'
    return (
        f'<use href="#{place}" x="{x - size / 2:.1f}" y="{y:.1f}" width="{size:g}" height="{size:g}"/>'
        f'<circle class="ring" {middle} fill="none" stroke="#000000" stroke-opacity=".14"/>'
    )


def _text(kind: str, x: float, y: float, words: str) -> str:
    short = words if len(words) <= 17 else words[:16].rstrip() + "…"
    fill = "#5f5f64" if kind == "value" else "#1c1c1e"
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="middle" fill="{fill}">{escape(short)}</text>'


def _drawn(box: _Box, tree: Tree, places: dict[str, str]) -> str:
    """A node with its sign, its mask or its words."""
    node, x = box.node, box.x
    name = f"{box.address} “{node.name}”" if node.name else box.address
    parts = [
        f'<g class="node" data-address="{escape(box.address)}"><title>{escape(name)}</title>',
        _disc(places[box.address], x, box.y, THUMB),
    ]
    base = box.y + THUMB
    if box.below:
        words = f"{node.name} · {SIGNS[node.kind]}" if node.name else SIGNS[node.kind]
        half = 11.0 if words == "×" else min(len(words), 17) * 3.1 + 9.0
        parts.append(
            f'<rect class="pill" x="{x - half:.1f}" y="{base + 7:.1f}" width="{2 * half:.1f}" height="20" rx="10" fill="#ecebe7"/>'
        )
        parts.append(_text("sign", x, base + 21, words))
    if box.mask and isinstance(node, Operator) and node.mask is not None:
        side = x + THUMB / 2 + 12.0 + SMALL
        parts.append(f'<path class="edge to-mask" d="M{x + THUMB / 2:.1f} {box.y + 32:.1f}H{side - SMALL:.1f}" stroke="#b9b9b4"/>')
        lines = [node.mask.name or "mask", *key_values(node.mask, lines=2)]
        about = f"{box.mask}: {node.mask.kind}, {', '.join(key_values(node.mask))}"
        parts.append(f'<g class="node" data-address="{escape(box.mask)}"><title>{escape(about)}</title>')
        parts.append(_disc(places[box.mask], side, box.y + 32 - SMALL, 2 * SMALL))
        parts += [_text("name" if k == 0 else "value", side, box.y + 32 + SMALL + LINE * (k + 1), line) for k, line in enumerate(lines)]
        parts.append("</g>")
    if not box.below:
        parts.append(_leaf_words(box, tree, places, base))
    return "".join([*parts, "</g>"])


def _leaf_words(box: _Box, tree: Tree, places: dict[str, str], base: float) -> str:
    """Name and key values under a leaf; for a tint also the two spheres it multiplies."""
    parts = []
    shown = box.node
    lines: list[str] = []
    if box.pair:
        pair = folds(box.node)
        assert pair is not None
        shown = pair[1]
        parts.append(
            _disc(places[box.pair[0]], box.x - SMALL * 0.85, base + 6, SMALL)
            + _disc(places[box.pair[1]], box.x + SMALL * 0.85, base + 6, SMALL)
        )
        parts.append(_text("sign", box.x, base + 21, "×"))
        base += SMALL + 6
        lines = [shown_color(pair[0]["color"], tree.blend_space)]
    parts.append(_text("name", box.x, base + LINE + 2, label(box.node)))
    if isinstance(shown, Leaf):
        lines = (key_values(shown, tree.blend_space, 2) if box.pair else key_values(shown, tree.blend_space)) + lines
    return "".join(parts + [_text("value", box.x, base + LINE * (k + 2) + 2, line) for k, line in enumerate(lines)])
