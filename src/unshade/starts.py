"""Starts for a structure whose numbers nobody chose: its form first, then one light after the other where the picture shows it."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import torch

from unshade.atoms import Dictionary, dictionary_of
from unshade.fit.least_squares import COARSE_SIZE, COARSE_SOFTNESS, fit_pixels
from unshade.fit.model import Model, soften
from unshade.fit.pixels import Pixels
from unshade.fit.plan import is_locked
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, find, replace, tint, walk
from unshade.types import Image, Mask

FAMILIES = {"highlight": "lights", "toon_highlight": "spots", "rim": "rims"}
"""Where the dictionary keeps the lights of a kind."""

BLACK = Leaf("albedo", ((0.0, 0.0, 0.0),))

STEPS, LAST_STEPS = 8, 30
RANDOM = 6
"""Random forms beside the tree's own."""


def read_off(target: Image, mask: Mask, root: Node, *, seed: int = 0, locked: Collection[str] = ()) -> Node:
    """The tree with the numbers from which a fit comes out best: its own, or some that are read off the picture.

    Two equal leaves under one operator never part by themselves, and a light that starts far from any in the picture goes
    out. So all lights are put out, the form is fitted from several random starts, and each light is lit where it helps most.

    Args:
        target: (3, H, H) in [0, 1]. mask: (1, H, H) bool, pixels that count. locked: addresses that keep their numbers.
    """
    pixels = Pixels.of(target, mask, COARSE_SIZE)
    dictionary = dictionary_of(pixels)
    generator = torch.Generator().manual_seed(seed)
    root = soften(root, COARSE_SOFTNESS, locked)
    places = _dark_places(root, locked)

    def fitted(start: Node, steps: int, held: Collection[str] = ()) -> tuple[float, Node]:
        found = fit_pixels(pixels, start, locked=[*locked, *held], steps=steps, softest=COARSE_SOFTNESS)
        return found.error, found.root

    dark = root
    for place in places:
        dark = replace(dark, place, BLACK)
    results = [fitted(root, LAST_STEPS)]
    for number in range(1 + RANDOM):
        form = dark if number == 0 else _drawn(dark, generator, locked)
        _, found = fitted(form, STEPS, [f"{place}.albedo" for place in places])
        for index, place in enumerate(places):
            found = _lit(pixels, dictionary, found, place, find(root, place))
            _, found = fitted(found, STEPS, [f"{later}.albedo" for later in places[index + 1 :]])
        results.append(fitted(found, LAST_STEPS))
    return min(results, key=lambda result: result[0])[1]


def _dark_places(root: Node, locked: Collection[str]) -> list[str]:
    """Where the lights are, each with its own paint, and none that holds a locked number. Without the kind at its end such an
    address stays when the node there becomes another."""
    found = []
    for where, node in walk(root):
        if isinstance(node, Leaf) and node.kind in FAMILIES and "." in where:
            above = where.rsplit(".", 2)[0]
            whole = above if tint(find(root, above)) else where
            if not any(f"{one}.".startswith(f"{other}.") for held in locked for one, other in ((held, whole), (whole, held))):
                found.append(whole.rpartition(".")[0])
    return [place for place in found if place]


def _lit(pixels: Pixels, dictionary: Dictionary, root: Node, place: str, light: Node) -> Node:
    """The tree with the best entry of the dictionary at a place that is dark: the picture is affine in it."""
    model = Model(root, pixels)
    values = model.evaluate(model.layout.pack(root))
    gain = next(gain for address, _, _, gain in model.nodes(values) if address.rpartition(".")[0] == place)
    gain = torch.as_tensor(gain).expand(3, pixels.count)
    wanted = pixels.target - model.compose(values)
    pair = tint(light)
    leaf = pair[1] if pair else light
    assert isinstance(leaf, Leaf)
    atoms = dictionary[FAMILIES[leaf.kind]]
    up, down = atoms.project(gain, wanted, pixels.weight)
    if pair is None:
        up, down = up.sum(0, keepdim=True), down.sum(0, keepdim=True)
    amplitude = KINDS[leaf.kind].amplitude
    scale = (up / down.clamp(min=1e-12)).clamp(0.0, 1.0) if pair or amplitude else torch.ones_like(up)
    best = int((2.0 * scale * up - scale.square() * down).sum(0).argmax())
    entry = atoms.leaves[best]
    if pair is None:
        entry = entry.set(**{amplitude: max(float(scale[0, best]), 0.02)}) if amplitude else entry
        return replace(root, place, dataclasses.replace(entry, name=leaf.name))
    assert isinstance(light, Operator)
    paint = pair[0].set(color=scale[:, best].tolist())
    children = tuple(paint if child is pair[0] else dataclasses.replace(entry, name=leaf.name) for child in light.children)
    return replace(root, place, dataclasses.replace(light, children=children))


def _drawn(root: Node, generator: torch.Generator, locked: Collection[str]) -> Node:
    """The tree with its directions and colours drawn anew, all else as it is."""
    for address, node in walk(root):
        if not isinstance(node, Leaf):
            continue
        changed: dict[str, object] = {}
        for parameter, value in zip(KINDS[node.kind].parameters, node.values, strict=True):
            if isinstance(value, Raster) or is_locked(address, parameter.name, locked):
                continue
            drawn = torch.randn(len(value) // 3, 3, generator=generator, dtype=torch.float64) if parameter.size == 3 else None
            if drawn is not None and parameter.type == "direction":
                drawn[:, 2] = drawn[:, 2].abs()
                changed[parameter.name] = drawn.flatten().tolist()
            elif drawn is not None and parameter.type == "color" and any(value):
                changed[parameter.name] = torch.sigmoid(drawn).flatten().tolist()
        root = replace(root, address, node.set(**changed))
    return root
