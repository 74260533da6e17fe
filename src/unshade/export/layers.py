"""A tree as the layers of a picture editor: every leaf a picture of the whole square, groups for its operators.

The layers reach past the silhouette, and the root is masked by the sphere, so that a blend at the edge has something below
it. Editors blend encoded values; the leaves of a tree that works on linear light are encoded one by one.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from unshade.export.scene import Item, Mode, Picture
from unshade.nodes import KINDS, Leaf, Node, Role, Tree
from unshade.parameters import Layout
from unshade.render import evaluate, srgb_encode
from unshade.sphere import sphere_grid, sphere_normals
from unshade.types import Image, Mask


def layered(tree: Tree, size: int) -> Item:
    """The root's item; pictures are (3, size, size) display-encoded, masks grey."""
    normals = sphere_normals(size)

    def picture(leaf: Leaf) -> Image:
        layout = Layout.of(leaf)
        shown = evaluate(leaf, normals, layout.pack(leaf).to(normals), layout).expand(3, size, size)
        return srgb_encode(shown) if tree.blend_space == "linear" and KINDS[leaf.kind].role is not Role.MASK else shown

    def item(node: Node, address: str) -> Item:
        label = node.name or node.kind
        if isinstance(node, Leaf):
            return Item(Picture(picture(node)), address, label)
        items = [item(child, f"{address}.{k}.{child.kind}") for k, child in enumerate(node.children)]
        if node.mask is not None:
            mask = Item(Picture(picture(node.mask)), f"{address}.mask", node.mask.name or node.mask.kind)
            items = [items[1], replace(items[0], mask=mask)]
        else:
            mode: Mode = "multiply" if node.kind == "multiply" else "screen"
            items[1:] = [replace(above, mode=mode) for above in items[1:]]
        return Item(tuple(items), address, label)

    return item(tree.root, tree.root.kind)


def disc(size: int) -> Mask:
    """(1, size, size) opacity of the sphere in [0, 1], its edge one pixel wide."""
    radius = sphere_grid(size).square().sum(0, keepdim=True).sqrt()
    return ((1.0 - radius) * (size / 2.0) + 0.5).clamp(0.0, 1.0)


def blended(item: Item) -> Image:
    """What a picture editor shows for an item: its layers joined from the bottom up."""
    if isinstance(item.content, Picture):
        return item.content.pixels
    assert isinstance(item.content, tuple)
    below = blended(item.content[0])
    for above in item.content[1:]:
        over = blended(above)
        if above.mode == "multiply":
            over = below * over
        elif above.mode == "screen":
            over = 1.0 - (1.0 - below) * (1.0 - over)
        share = torch.ones(()) if above.mask is None else blended(above.mask)
        below = below + share * (over - below)
    return below
