"""Give a tree another colour: its paint as a whole moves to the new colour, the differences inside it are kept.

Differences are kept in OKLab (Ottosson 2020): lightness by its difference, colourfulness by its ratio, hues by their angle,
so that shades stay shades of the new colour.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

from unshade.components import Body, Component, Lit, Over, Part, Sides, leaves_below, take_apart
from unshade.errors import TreeError
from unshade.nodes import KINDS, Leaf, Node, Raster, Role, Tree, find
from unshade.relight import rebuild
from unshade.render import render, srgb_decode, srgb_encode
from unshade.selection import select
from unshade.sphere import disc_mask, sphere_normals

SIZE = 32
"""Pixels of the picture that a paint's mean is taken of."""

GREY = 0.02
"""A colour with less OKLab chroma than this has no hue to turn from."""

MOST = 3.0
"""Most that a difference in chroma grows."""

ALIKE = (0.9, 0.98)
"""Cosines between a broad light's colour and the paint's: below the first it is a light of its own, over the second it is lit paint."""

_TO_LMS = np.array(
    [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566], [0.0883024619, 0.2817188376, 0.6299787005]]
)
_TO_LAB = np.array(
    [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099], [0.0259040371, 0.7827717662, -0.8086757660]]
)


def _lab(srgb: np.ndarray) -> np.ndarray:
    linear = srgb_decode(torch.from_numpy(srgb)).numpy()
    return np.cbrt(linear @ _TO_LMS.T) @ _TO_LAB.T


def _srgb(lab: np.ndarray) -> np.ndarray:
    linear = (lab @ np.linalg.inv(_TO_LAB).T) ** 3 @ np.linalg.inv(_TO_LMS).T
    return srgb_encode(torch.from_numpy(linear.clip(0.0, 1.0))).numpy().clip(0.0, 1.0)


def moved_colors(colors: np.ndarray, before: Sequence[float], after: Sequence[float]) -> np.ndarray:
    """Display-encoded colours (..., 3) moved as ``before`` moves to ``after``."""
    lab, old, new = _lab(colors), _lab(np.asarray(before, dtype=float)), _lab(np.asarray(after, dtype=float))
    difference = lab - old
    hues = difference[..., 1] + 1j * difference[..., 2]
    chroma, wanted = complex(old[1], old[2]), complex(new[1], new[2])
    if abs(chroma) > GREY:
        ratio = wanted / chroma
        hues = hues * (ratio if abs(ratio) <= MOST else ratio / abs(ratio) * MOST)
    moved = _srgb(np.stack([new[0] + difference[..., 0], new[1] + hues.real, new[2] + hues.imag], axis=-1))
    return np.where((np.abs(difference).sum(-1, keepdims=True) < 1e-12), np.asarray(after, dtype=float), moved)


def mean_color(node: Node) -> tuple[float, ...]:
    """The mean of a node's picture over the sphere, in the numbers of its tree."""
    picture = render(node, sphere_normals(SIZE, dtype=torch.float64))[:, disc_mask(SIZE)[0]]
    return tuple(picture.mean(-1).tolist())


def recast(light: Node, before: Sequence[float], after: Sequence[float]) -> Node:
    """A broad light with its colours for another paint below it.

    One of the colour of the paint is lit paint and takes the new colour on; one of another colour is a light of its own
    and stays; between them it does so in part.
    """
    changed: dict[str, Leaf] = {}
    for address, leaf in leaves_below(Part(light.kind, light)):
        if leaf.kind == "albedo":
            old = np.asarray(leaf["color"])
            cosine = float(old @ np.asarray(before)) / max(float(np.linalg.norm(old) * np.linalg.norm(before)), 1e-9)
            share = min(max((cosine - ALIKE[0]) / (ALIKE[1] - ALIKE[0]), 0.0), 1.0)
            scaled = old * np.asarray(after) / np.maximum(before, 1e-3)
            changed[address] = leaf.set(color=((1.0 - share) * old + share * scaled).clip(0.0, 1.0))
    return rebuild(light, changed)


def recolor(tree: Tree, color: Sequence[float], where: str | None = None) -> Tree:
    """The tree in another colour.

    Args:
        color: display-encoded, three numbers in [0, 1].
        where: the paint to move, as a whole; else the paint of the base, and broad lights of its colour with it. Paint over
            the whole (drawn edges) and the colours of other lights stay.
    Raises:
        TreeError: there is no paint to recolour. AddressError.
    """
    if where is not None:
        changed: dict[str, Leaf] = {}
        for address in select(tree.root, where):
            changed |= _recolored(tree, [Part(address, find(tree.root, address))], color)
        if not changed:
            raise TreeError(f"{where} holds no colour")
        return dataclasses.replace(tree, root=rebuild(tree.root, changed))
    bodies = list(_bodies(take_apart(tree.root)))
    paints = [body.base.paint for body in bodies if not isinstance(body.base, Sides)]
    parts = [part for paint in paints for part in paint]
    changed = _recolored(tree, parts, color)
    if not changed:
        raise TreeError("this tree has no paint to recolour; its lights have colours of their own, which an address can name")
    before, after = _mean(parts), _mean([Part(part.address, rebuild_part(part, changed)) for part in parts])
    for body in bodies:
        for light in body.lights:
            if light.component is Component.DIFFUSE:
                new = recast(light.part.node, before, after)
                pairs = zip(leaves_below(light.part), leaves_below(Part(light.part.address, new)), strict=True)
                changed |= {address: leaf for (address, old), (_, leaf) in pairs if leaf != old}
    return dataclasses.replace(tree, root=rebuild(tree.root, changed))


def rebuild_part(part: Part, leaves: dict[str, Leaf]) -> Node:
    """A part's node with other leaves at addresses of its tree."""
    own = {part.node.kind + address[len(part.address) :]: leaf for address, leaf in leaves.items() if address.startswith(part.address)}
    return rebuild(part.node, own)


def _bodies(lit: Lit) -> list[Body]:
    if isinstance(lit, Body):
        return [lit, *(_bodies(lit.base) if isinstance(lit.base, Sides) else [])]
    return [body for side in ((lit.under,) if isinstance(lit, Over) else (lit.left, lit.right)) for body in _bodies(side)]


def _mean(parts: Sequence[Part]) -> tuple[float, ...]:
    means = np.array([mean_color(part.node) for part in parts])
    return tuple(means.mean(0).tolist())


def _recolored(tree: Tree, parts: Sequence[Part], color: Sequence[float]) -> dict[str, Leaf]:
    """The paint leaves of some parts, moved together so that their mean becomes a colour."""
    leaves = [(address, leaf) for part in parts for address, leaf in leaves_below(part) if KINDS[leaf.kind].role is Role.PAINT]
    leaves = list(dict(leaves).items())
    if not leaves:
        return {}
    linear = tree.blend_space == "linear"
    before = np.asarray(
        _mean(parts) if all(_only_paint(part.node) for part in parts) else np.mean([mean_color(leaf) for _, leaf in leaves], 0)
    )
    if linear:
        before = srgb_encode(torch.from_numpy(before)).numpy()
    if not all(math.isfinite(channel) and 0.0 <= channel <= 1.0 for channel in color) or len(color) != 3:
        raise TreeError(f"recolor: expected three numbers in [0, 1], got {tuple(color)}")
    changed = {}
    for address, leaf in leaves:
        parameter = KINDS[leaf.kind].parameters[0].name
        old = leaf[parameter]
        numbers = np.moveaxis(old.array(), 0, -1) if isinstance(old, Raster) else np.asarray(old)
        encoded = srgb_encode(torch.from_numpy(np.array(numbers))).numpy() if linear else numbers
        moved = moved_colors(encoded, before.tolist(), color)
        moved = srgb_decode(torch.from_numpy(moved)).numpy() if linear else moved
        changed[address] = leaf.set(**{parameter: Raster.from_array(np.moveaxis(moved, -1, 0)) if isinstance(old, Raster) else moved})
    return changed


def _only_paint(node: Node) -> bool:
    return all(KINDS[leaf.kind].role in (Role.PAINT, Role.MASK) for _, leaf in leaves_below(Part(node.kind, node)))
