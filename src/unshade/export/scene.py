"""A tree as a picture editor sees it: named groups with blend modes and masks, and what is painted in each.

Shared by the vector targets, which only write it down. Blend modes work on encoded values there; the leaves of a tree that
works on linear light are encoded one by one, which is right for each alone and near for a multiply (`targets.linear` tells).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np
import torch

from unshade.blend import screen
from unshade.export.profiles import Numbers, Profile, lobes, profile
from unshade.export.vectors import Drawing, Fill, Radial, drawn, simplified
from unshade.nodes import KINDS, Leaf, Node, Role, Tree
from unshade.parameters import Layout
from unshade.render import evaluate, render, srgb_encode
from unshade.sphere import sphere_normals
from unshade.types import Image

Mode: TypeAlias = Literal["normal", "multiply", "screen", "color-dodge"]
Color: TypeAlias = "tuple[float, float, float]"

WHITE: Color = (1.0, 1.0, 1.0)

PICTURE_SIZE = 512
"""Width and height at which a raster leaf is embedded."""

SAME_SUM = 0.002
"""Root mean square up to which the lobes of an environment are screened; those that overlap more are added."""


@dataclass(frozen=True)
class Art:
    """A drawing in the frame of a leaf, turned by ``angle`` (radians, counterclockwise); its brightness times ``tint``."""

    angle: float
    drawing: Drawing
    tint: Color = WHITE


@dataclass(frozen=True)
class Plain:
    """One colour over all of the disc."""

    color: Color


@dataclass(frozen=True)
class Picture:
    """A raster leaf as pixels: (3, S, S) display-encoded, on the square around the disc."""

    pixels: Image


@dataclass(frozen=True)
class Item:
    """A node of the tree, or a lobe of a leaf, blended with the items below it in the same group.

    A group is isolated: what is in it blends with nothing outside.
    """

    content: tuple[Item, ...] | Art | Plain | Picture
    address: str = ""
    label: str = ""
    mode: Mode = "normal"
    opacity: float = 1.0
    mask: Item | None = None
    """Its brightness is the share of this item."""


def scene(tree: Tree) -> Item:
    """The items of a tree, the root outermost."""
    linear = tree.blend_space == "linear"

    def item(node: Node, address: str) -> Item:
        label = node.name or node.kind
        if isinstance(node, Leaf):
            return replace(_leaf(Leaf(node.kind, node.values), linear), address=address, label=label)
        items = [item(child, f"{address}.{k}.{child.kind}") for k, child in enumerate(node.children)]
        if node.mask is not None:
            items = [items[1], replace(items[0], mask=item(node.mask, f"{address}.mask"))]
        else:
            mode: Mode = "multiply" if node.kind == "multiply" else "screen"
            items[1:] = [replace(above, mode=mode) for above in items[1:]]
        return Item(tuple(items), address, label)

    return item(tree.root, tree.root.kind)


@lru_cache(maxsize=512)
def _leaf(leaf: Leaf, linear: bool) -> Item:
    """A leaf or a mask without its name. Kept, since finding a drawing takes a few tenths of a second."""
    linear = linear and KINDS[leaf.kind].role is not Role.MASK
    if leaf.kind == "albedo":
        return Item(Plain(_color(leaf["color"], linear)))
    if leaf.kind == "environment":
        return _environment(leaf, linear)
    if leaf.kind in PROFILED:
        found = _encoded(profile(leaf), linear)
        drawing = drawn(found)
        if leaf.kind == "rim":
            drawing += (Fill(_grazing(leaf["exponent"][0], linear), multiply=True),)
        return Item(Art(found.angle, drawing))
    layout = Layout.of(leaf)
    shown = evaluate(leaf, sphere_normals(PICTURE_SIZE), layout.pack(leaf).float(), layout).expand(3, -1, -1)
    return Item(Picture(srgb_encode(shown) if linear else shown))


def _color(color: tuple[float, ...], linear: bool) -> Color:
    if linear:
        color = tuple(srgb_encode(torch.tensor(color, dtype=torch.float64)).tolist())
    return (color[0], color[1], color[2])


def _encoded(found: Profile, linear: bool) -> Profile:
    shade = found.shade
    return replace(found, shade=lambda q: srgb_encode(torch.from_numpy(np.asarray(shade(q)))).numpy()) if linear else found


def _grazing(exponent: float, linear: bool) -> Radial:
    """A rim's factor ``(1 - z)^exponent``."""

    def factor(radius: Numbers) -> Numbers:
        grazing = np.clip(1.0 - np.sqrt(np.clip(1.0 - radius * radius, 0.0, 1.0)), 1e-6, 1.0) ** exponent
        return srgb_encode(torch.from_numpy(grazing)).numpy() if linear else grazing

    return Radial(0.0, 1.0, 1.0, 0.0, tuple(simplified(factor, 0.0, 1.0, 0.003)))


def _environment(leaf: Leaf, linear: bool) -> Item:
    """The sum of the lobes. Screened where that is nearly their sum, else their mean (each over the last at 1/k opacity) times
    their number, which a dodge with a constant is: ``below / (1 - constant)``, clamped at 1."""
    arts = [Art(lobe.angle, drawn(_encoded(lobe, linear)), _color(color, linear)) for lobe, color in lobes(leaf)]
    if len(arts) == 1:
        return Item(arts[0])
    if _overlap(leaf) <= SAME_SUM:
        return Item(tuple(Item(art, label=f"lobe {k + 1}", mode="screen" if k else "normal") for k, art in enumerate(arts)))
    items = [Item(art, label=f"lobe {k + 1}", opacity=1.0 / (k + 1)) for k, art in enumerate(arts)]
    share = 1.0 - 1.0 / len(arts)
    return Item((*items, Item(Plain((share, share, share)), label=f"times {len(arts)}", mode="color-dodge")))


PROFILED = {"diffuse", "highlight", "rim", "toon_diffuse", "toon_highlight", "threshold", "stripe"}
"""The kinds that `profiles.profile` knows."""


def _single(leaf: Leaf, lobe: int) -> Leaf:
    """An environment of one lobe of this one."""
    sizes = [parameter.size for parameter in KINDS[leaf.kind].parameters]
    return Leaf(
        leaf.kind, tuple(value[lobe * n : (lobe + 1) * n] for value, n in zip(leaf.values, sizes, strict=True) if isinstance(value, tuple))
    )


def _overlap(leaf: Leaf) -> float:
    """How far the screen of an environment's lobes is from their clamped sum, root mean square over the disc."""
    normals = sphere_normals(64, dtype=torch.float64)
    screened = screen(*(render(_single(leaf, k), normals) for k in range(leaf.lobes)))
    return float((screened - render(leaf, normals)).square().mean().sqrt())
