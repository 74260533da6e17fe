"""The methods that are compared, each a function of one sphere and a seed.

``adam:K``, ``basin:K`` and ``second:K`` fit the numbers of one fixed structure,
``screen(multiply(albedo, diffuse), K tinted highlights, a tinted rim)``, from the same start; only the optimiser differs.
``search:PRESET``, ``learned:PRESET`` and ``hybrid:PRESET`` are the whole of `unshade.decompose` by that method, and
``depth:PRESET`` is its search by depth, the paper's second stage.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias, cast

import torch

from unshade.errors import UnshadeError, did_you_mean
from unshade.nodes import Node, Operator, Tree, leaf, multiply, screen
from unshade.pictures import SphereImage
from unshade.types import Image, Mask

Proposing: TypeAlias = Literal["search", "learned", "hybrid", "depth"]

TABLE = ("adam", "basin", "second", "depth", "search", "learned", "hybrid")

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))

RESTARTS = 3
"""Of Adam, as in the prototype's figures."""


@dataclass(frozen=True)
class Outcome:
    """What a method found. ``curve`` is (values, psnr) of its family, simplest first."""

    tree: Tree
    curve: tuple[tuple[int, float], ...] = ()


def method_of(name: str) -> Callable[[SphereImage, Mask, int], Outcome]:
    """The method of a name such as ``second:4`` or ``search:best``. Raises UnshadeError."""
    kind, _, argument = name.partition(":")
    if kind in ("search", "learned", "hybrid", "depth"):
        return partial(_decomposed, preset=argument or "balanced", method=cast(Proposing, kind))
    if kind not in TABLE:
        raise UnshadeError(f"unknown method {name!r}{did_you_mean(kind, TABLE)}")
    if argument and not (argument.isdigit() and 1 <= int(argument) <= 32):
        raise UnshadeError(f"method {name!r}: expected a number of highlights from 1 to 32 after the colon")
    highlights = int(argument or 4)

    def fixed(sphere: SphereImage, scored: Mask, seed: int) -> Outcome:
        root = fixed_structure(sphere.image, scored, highlights)
        return Outcome(Tree(_fit(kind, sphere.image, scored, root, seed), exposure=sphere.exposure))

    return fixed


def _fit(kind: str, image: Image, scored: Mask, root: Node, seed: int) -> Node:
    if kind == "adam":
        from unshade.fit.gradient import fit_gradient

        return fit_gradient(image, scored, root, seed=seed, restarts=RESTARTS).root
    if kind == "basin":
        from unshade.fit.basin_cma import fit_basin_cma

        return fit_basin_cma(image, scored, root, seed=seed, objective="l2").root
    from unshade.fit.least_squares import fit_least_squares

    return fit_least_squares(image, scored, root, seed=seed).root


def _decomposed(sphere: SphereImage, scored: Mask, seed: int, *, preset: str, method: Proposing) -> Outcome:
    from unshade.decompose import decompose

    if method in ("learned", "hybrid"):
        # `decompose` would search where the hybrid has no networks; a row must be what it says.
        from unshade.inference import Networks

        Networks.load()

    if method == "depth":
        result = decompose(sphere, preset=preset, seed=seed, search="depth").result()
    else:
        result = decompose(sphere, preset=preset, seed=seed, method=method).result()
    return Outcome(result.tree, tuple((member.values, member.psnr) for member in result.family.members))


def fixed_structure(image: Image, scored: Mask, highlights: int) -> Operator:
    """The structure that the fixed methods fit, 12 + 6 K values, with lights spread over the visible side.

    Colours start from the picture: the paint at its bright quarter, the lights at what is left.
    """
    counted = image[:, scored[0]]
    paint = torch.quantile(counted, 0.75, dim=1).clamp(0.05, 0.95).double().tolist()
    light = (torch.quantile(counted, 0.98, dim=1) * 0.4).clamp(0.05, 0.95).double().tolist()
    spots = []
    for index in range(highlights):
        radius = 0.9 * math.sqrt((index + 0.5) / highlights)
        angle = 0.5 * math.pi + index * GOLDEN_ANGLE
        direction = (radius * math.cos(angle), radius * math.sin(angle), math.sqrt(1.0 - radius * radius))
        spots.append(multiply(leaf("albedo", color=light), leaf("highlight", direction=direction, sharpness=12.0, amplitude=1.0)))
    body = multiply(leaf("albedo", color=paint), leaf("diffuse", direction=(0.3, 0.5, 0.8), ambient=0.3))
    grazing = multiply(leaf("albedo", color=light), leaf("rim", exponent=2.0))
    return screen(body, *spots, grazing)
