"""Variations of a tree to choose from: the same parts, other light, other colours, other widths."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator

import numpy as np
import torch

from unshade.components import Component, uses
from unshade.edit import component
from unshade.errors import TreeError, did_you_mean
from unshade.nodes import KINDS, Leaf, Role, Tree, find
from unshade.recolor import mean_color, recolor
from unshade.relight import rebuild, turn, turn_of
from unshade.render import srgb_encode
from unshade.types import Image

ASPECTS = ("light", "color", "shape")
"""What can vary: where the light comes from, the paint's colour, and the widths, edges and strengths of the shading."""

FARTHEST, WIDEST = 60.0, math.log(4.0)
"""Degrees that the light moves at most at strength 1, and the logarithm of the factor by which numbers change."""


def vary(tree: Tree, count: int, seed: int = 0, strength: float = 0.5, only: Collection[str] = ASPECTS) -> Iterator[Tree]:
    """Variations of a tree; number n of a seed does not depend on how many are drawn.

    Args:
        strength: from 0, no change, to 1, large ones.
        only: of `ASPECTS`, what varies.
    Raises:
        TreeError: an unknown aspect, or a strength out of [0, 1].
    """
    for word in only:
        if word not in ASPECTS:
            raise TreeError(f"unknown aspect {word!r}{did_you_mean(word, ASPECTS)}")
    if not 0.0 <= strength <= 1.0:
        raise TreeError(f"vary: the strength must be in [0, 1], got {strength}")
    for number in range(count):
        chance = np.random.default_rng([seed, number])
        varied = tree
        # Drawn always, so that what an aspect becomes does not depend on which others vary.
        light, color, shape = (np.random.default_rng(chance.integers(2**63)) for _ in ASPECTS)
        if "shape" in only:
            varied = _reshaped(varied, shape, strength)
        if "color" in only:
            varied = _recolored(varied, color, strength)
        if "light" in only:
            angle, reach = light.uniform(0.0, math.tau), FARTHEST * strength * math.sqrt(light.uniform(0.05, 1.0))
            varied = turn(varied, turn_of(reach * math.cos(angle), reach * math.sin(angle)))
        yield varied


def _recolored(tree: Tree, chance: np.random.Generator, strength: float) -> Tree:
    """The paint's mean with another hue, colourfulness and lightness."""
    paint = component(tree, Component.ALBEDO)
    hue, chroma, light = chance.uniform(-1.0, 1.0, 3)
    known = uses(tree.root)
    painted = [leaf for a, leaf in tree.walk() if a in known and known[a].component is Component.ALBEDO and not known[a].over]
    painted = [leaf for leaf in painted if KINDS[leaf.kind].role is Role.PAINT]
    if paint is None or not painted:
        return tree
    mean = np.asarray(mean_color(paint))
    encoded = srgb_encode(torch.from_numpy(mean)).numpy() if tree.blend_space == "linear" else mean
    # Turn the hue by mixing channels about the grey axis; a grey gets a colour of its own.
    grey = encoded.mean()
    angle = math.pi * strength * hue
    offset = encoded - grey
    if np.abs(offset).max() < 0.05:
        offset = 0.25 * strength * np.array([math.cos(angle * 2), math.cos(angle * 2 - 2.094), math.cos(angle * 2 + 2.094)])
    axis = np.full(3, 1.0 / math.sqrt(3.0))
    turned = offset * math.cos(angle) + np.cross(axis, offset) * math.sin(angle)
    wanted = grey * math.exp(0.4 * strength * light) + turned * math.exp(0.7 * strength * chroma)
    return recolor(tree, tuple(np.clip(wanted, 0.0, 1.0).tolist()))


def _reshaped(tree: Tree, chance: np.random.Generator, strength: float) -> Tree:
    """Every number of lights and form times a random factor; directions, colours and paint as they are."""
    changed: dict[str, Leaf] = {}
    for address, use in uses(tree.root).items():
        leaf = find(tree.root, address)
        assert isinstance(leaf, Leaf)
        if use.component is Component.ALBEDO or use.tint or leaf.role is Role.MASK:
            continue
        for parameter in KINDS[leaf.kind].parameters:
            if parameter.type == "scalar" and parameter.name != "threshold":
                old = np.asarray(leaf[parameter.name])
                reach = WIDEST if parameter.logarithmic else 0.5 * WIDEST
                new = old * np.exp(strength * reach * chance.uniform(-1.0, 1.0, old.shape))
                leaf = leaf.set(**{parameter.name: new.clip(parameter.low, parameter.high)})
        changed[address] = leaf
    return dataclasses.replace(tree, root=rebuild(tree.root, changed))


def contact_sheet(pictures: list[Image], gap: int = 8, background: float = 0.12) -> Image:
    """Pictures of one size side by side, row after row, (3, H, W); the order is that of reading."""
    columns = math.ceil(math.sqrt(len(pictures)))
    rows = math.ceil(len(pictures) / columns)
    side = pictures[0].shape[-1]
    sheet = torch.full((3, rows * (side + gap) + gap, columns * (side + gap) + gap), background)
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        top, left = gap + row * (side + gap), gap + column * (side + gap)
        sheet[:, top : top + side, left : left + side] = picture
    return sheet
