"""Seeded random trees after the authors' released grammar and ranges, every leaf of which shows.

The grammar gives 24 trees: four kinds of paint, with one to three highlights, drawn realistic (`diffuse`, `highlight`)
or toon (a product of two `toon_diffuse`, `toon_highlight`); 96 with a rim and an environment optional. What neither the
paper nor its release says is ours: where the masks lie, and environments made of a few spherical-Gaussian lights.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from functools import lru_cache
from typing import TypeAlias

import torch

from unshade.blend import BLENDS
from unshade.canonical import structure_key
from unshade.errors import TreeError, did_you_mean
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, Tree, Value, leaf
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals

Structure: TypeAlias = "str | tuple[Structure, ...]"
"""A leaf kind, or an operator's name and its operands."""

RELEASED: dict[str, tuple[str | tuple[str, ...], ...]] = {
    "S": ("N", ("screen", "environment", "N")),
    "N": ("M", ("screen", "M", "rim")),
    "M": (("screen", "L", "H"),),
    "L": (("multiply", "B", "D"),),
    "D": ("diffuse", ("multiply", "toon_diffuse", "toon_diffuse")),
    "B": (
        "albedo",
        ("mix", "albedo", "albedo", "threshold"),
        ("mix", "albedo", "albedo", "stripe"),
        ("mix", "B1", "albedo", "stripe"),
    ),
    "B1": (("mix", "albedo", "albedo", "stripe"),),
    "H": ("highlight", ("screen", "highlight", "highlight"), ("screen", "H1", "highlight")),
    "H1": (("screen", "highlight", "highlight"),),
}
"""The released grammar. A toon tree has toon highlights where this says ``highlight``."""

STYLES = ("realistic", "toon")
VISIBLE = 2.0 / 255.0
"""A leaf shows if taking it away changes the picture by this much, root mean square inside the scored disc."""
CHECKED_SIZE = 64
ATTEMPTS = 2000


def all_canonical_structures(style: str | None = None, environment: bool | None = False, rim: bool | None = False) -> list[str]:
    """The `structure_key` of every tree of the released grammar: 24, or 96 with ``environment=None, rim=None``.

    Args:
        style: realistic, toon, or None for both.
        environment, rim: with (True), without (False), or both (None). An environment is counted with one lobe.
    """
    styles = STYLES if style is None else (_known_style(style),)
    return [structure_key(_default(structure)) for name in styles for structure in structures(name, environment, rim)]


def sample(
    generator: torch.Generator,
    style: str = "realistic",
    environment: bool | Raster | None = False,
    rim: bool | None = None,
    lobes: int | None = None,
) -> Tree:
    """A random tree in which every leaf shows.

    The structure is drawn first, each equally likely, then its numbers, again and again until every leaf shows.

    Args:
        generator: source of all randomness; the same state gives the same tree.
        style: realistic or toon.
        environment: with an environment leaf of a few lights (True), with this lat-long picture (a `Raster`), without
            (False), or either (None, one tree in two).
        rim: with, without, or either (None, one tree in two).
        lobes: lights in an environment; None draws 2 to 4.
    Raises:
        TreeError: an unknown style, or a given picture under which no tree shows all of its leaves.
    """
    panorama = environment if isinstance(environment, Raster) else None
    with_environment = _either(generator, True if isinstance(environment, Raster) else environment)
    choices = structures(_known_style(style), with_environment, _either(generator, rim))
    structure = choices[_integer(generator, len(choices))]
    count = lobes if lobes is not None else 2 + _integer(generator, 3)
    for _ in range(ATTEMPTS):
        root = _drawn(structure, _Numbers(generator, count, panorama))
        if every_leaf_shows(root):
            return Tree(root)
    raise TreeError(f"no tree in which every leaf shows after {ATTEMPTS} attempts; is the environment black?")


def _known_style(style: str) -> str:
    if style not in STYLES:
        raise TreeError(f"unknown style {style!r}{did_you_mean(style, STYLES)}")
    return style


def _derivations(symbol: str) -> Iterator[Structure]:
    """All that a symbol of the grammar can become."""
    if symbol not in RELEASED:
        yield symbol
        return
    for product in RELEASED[symbol]:
        if isinstance(product, str):
            yield from _derivations(product)
        else:
            for operands in itertools.product(*[list(_derivations(operand)) for operand in product[1:]]):
                yield (product[0], *operands)


def _kinds(structure: Structure) -> Iterator[str]:
    """The leaf kinds of a structure."""
    if isinstance(structure, str):
        yield structure
    else:
        for operand in structure[1:]:
            yield from _kinds(operand)


def _styled(structure: Structure) -> Structure:
    """A structure with toon highlights."""
    if isinstance(structure, str):
        return "toon_highlight" if structure == "highlight" else structure
    return tuple(_styled(part) for part in structure)


@lru_cache(maxsize=32)
def structures(style: str, environment: bool | None, rim: bool | None) -> tuple[Structure, ...]:
    """The structures of a style of the released grammar; with, without, or either (None) of an environment and a rim."""
    found = []
    for structure in _derivations("S"):
        kinds = set(_kinds(structure))
        fits = environment in (None, "environment" in kinds) and rim in (None, "rim" in kinds)
        if fits and ("toon_diffuse" in kinds) == (style == "toon"):
            found.append(_styled(structure) if style == "toon" else structure)
    return tuple(found)


def _built(kind: str, parts: list[Node]) -> Node:
    """An operator, a child of the same kind taken apart into its own."""
    if kind == "mix":
        assert isinstance(parts[2], Leaf)
        return Operator("mix", (parts[0], parts[1]), parts[2])
    children: list[Node] = []
    for part in parts:
        children += part.children if isinstance(part, Operator) and part.kind == kind else (part,)
    return Operator(kind, tuple(children))


def _default(structure: Structure) -> Node:
    """A tree of this structure with paints that no canonical form folds together."""
    colors = itertools.count(1)

    def made(part: Structure) -> Node:
        if isinstance(part, str):
            return leaf(part, color=(0.5, 0.1 * next(colors), 0.5)) if part == "albedo" else leaf(part)
        return _built(str(part[0]), [made(operand) for operand in part[1:]])

    return made(structure)


def _drawn(structure: Structure, numbers: _Numbers) -> Node:
    if isinstance(structure, str):
        return numbers.leaf(structure)
    return _built(str(structure[0]), [_drawn(operand, numbers) for operand in structure[1:]])


def _either(generator: torch.Generator, choice: bool | None) -> bool:
    return bool(_integer(generator, 2)) if choice is None else choice


def _integer(generator: torch.Generator, below: int) -> int:
    return int(torch.randint(below, (1,), generator=generator, device=generator.device))


@dataclasses.dataclass(frozen=True)
class _Numbers:
    """Draws the parameters of each kind of leaf from the released ranges."""

    generator: torch.Generator
    lobes: int
    panorama: Raster | None

    def uniform(self, low: float, high: float) -> float:
        share = torch.rand(1, generator=self.generator, device=self.generator.device, dtype=torch.float64)
        return low + (high - low) * float(share)

    def color(self, high: float = 1.0) -> tuple[float, ...]:
        return tuple(self.uniform(0.0, high) for _ in range(3))

    def direction(self, lowest: float = 0.0) -> tuple[float, float, float]:
        """Evenly over the sphere where z > ``lowest``; 0 is the hemisphere that the viewer sees."""
        z, angle = self.uniform(lowest, 1.0), self.uniform(0.0, math.tau)
        radius = math.sqrt(max(1.0 - z * z, 0.0))
        return radius * math.cos(angle), radius * math.sin(angle), z

    def leaf(self, kind: str) -> Leaf:
        """A random leaf of a kind that `RELEASED` knows."""
        if kind == "albedo":
            return leaf(kind, color=self.color())
        if kind == "environment":
            return self.environment()
        direction, uniform = self.direction(), self.uniform
        if kind == "diffuse":
            return leaf(kind, direction=direction, ambient=uniform(0.2, 0.5))
        if kind == "highlight":
            return leaf(kind, direction=direction, sharpness=uniform(30.0, 100.0), amplitude=uniform(1.0, 1.5))
        if kind == "toon_diffuse":
            return leaf(kind, direction=direction, ambient=uniform(0.2, 0.7), threshold=uniform(-0.2, 0.2), softness=0.1)
        if kind == "toon_highlight":
            radius = cut_radius(uniform(0.5, 0.8), uniform(30.0, 90.0), uniform(0.1, 0.5))
            return leaf(kind, direction=direction, radius=radius, brightness=uniform(0.2, 0.7), softness=0.0)
        if kind == "rim":
            return leaf(kind, direction=direction, exponent=1.0)
        if kind == "threshold":
            return leaf(kind, direction=direction, threshold=uniform(-0.2, 0.6), softness=0.0)
        assert kind == "stripe", kind
        return leaf(kind, direction=direction, center=uniform(-0.2, 0.7), width=uniform(0.15, 0.5), softness=0.0)

    def environment(self) -> Leaf:
        """The caller's picture, turned about the vertical, or a few lights anywhere in the mirrored world."""
        if self.panorama is not None:
            return leaf("environment_map", pixels=self.panorama, rotation=(0.0, self.uniform(-math.pi, math.pi), 0.0))
        lights = [(self.direction(-0.9), math.exp(self.uniform(math.log(2.0), math.log(30.0))), self.color(0.7)) for _ in range(self.lobes)]
        directions, sharpnesses, colors = zip(*lights, strict=True)
        return leaf("environment", direction=directions, sharpness=sharpnesses, color=colors)


def cut_radius(amplitude: float, sharpness: float, threshold: float) -> float:
    """The angle at which ``amplitude * exp(-sharpness * |n - l|^2)`` falls to ``threshold``; 0 where it never reaches it."""
    squared = math.log(amplitude / threshold) / sharpness
    return math.acos(min(max(1.0 - 0.5 * squared, -1.0), 1.0))


@lru_cache(maxsize=1)
def _scored_normals() -> torch.Tensor:
    """The normals inside the scored disc of a small picture, (3, 1, N) float64."""
    inside = disc_mask(CHECKED_SIZE, SCORED_RADIUS)[0]
    return sphere_normals(CHECKED_SIZE, dtype=torch.float64)[:, inside][:, None, :]


def every_leaf_shows(root: Node, least: float = VISIBLE) -> bool:
    """Does taking away any one leaf change the picture by ``least``, root mean square inside the scored disc?

    A leaf under a multiply or a screen is taken away by its identity, white or black. Under a mix the other side takes
    its place, which also tells whether the mask shows. Each lobe of an environment has to show by itself.

    Every operator is affine in each operand, so the change is the gain of the leaf times its own change, exactly: one
    pass up for the values and one down for the gains serve all leaves.
    """
    normals = _scored_normals()
    values: dict[tuple[int, ...], torch.Tensor] = {}

    def up(node: Node, path: tuple[int, ...]) -> torch.Tensor:
        if isinstance(node, Leaf):
            values[path] = _shaded(node, normals)
        else:
            layers = [up(part, (*path, k)) for k, part in enumerate(_operands(node))]
            values[path] = BLENDS[node.kind].apply(*layers)
        return values[path]

    def shows(change: torch.Tensor) -> bool:
        return float(change.expand(3, *change.shape[-2:]).square().mean().sqrt()) >= least

    def down(node: Node, path: tuple[int, ...], gain: torch.Tensor | float) -> bool:
        if isinstance(node, Leaf):
            return True
        operands = _operands(node)
        layers = [values[(*path, k)] for k in range(len(operands))]
        gains = BLENDS[node.kind].gains(*layers)
        identity = BLENDS[node.kind].identity
        for k, operand in enumerate(node.children):
            below = gain * gains[k]
            without: list[torch.Tensor] = []
            if identity is None:
                without.append(layers[1 - k])
            elif isinstance(operand, Leaf):
                without.append(torch.full_like(layers[k], identity))
            if isinstance(operand, Leaf) and operand.lobes > 1:
                without += [_shaded(_without_lobe(operand, lobe), normals) for lobe in range(operand.lobes)]
            if not all(shows(below * (layers[k] - other)) for other in without) or not down(operand, (*path, k), below):
                return False
        return True

    up(root, ())
    return down(root, (), 1.0)


def _operands(node: Operator) -> tuple[Node, ...]:
    return node.children if node.mask is None else (*node.children, node.mask)


def _shaded(node: Leaf, normals: torch.Tensor) -> torch.Tensor:
    kind = KINDS[node.kind]
    arguments = []
    for parameter, value in zip(kind.parameters, node.values, strict=True):
        if isinstance(value, Raster):
            arguments.append(value.tensor(dtype=normals.dtype))
        else:
            numbers = torch.tensor(value, dtype=normals.dtype)
            arguments.append(numbers.view(-1, parameter.size) if kind.repeats else numbers)
    return kind.formula(normals, *arguments)


def _without_lobe(node: Leaf, lobe: int) -> Leaf:
    kept: list[Value] = []
    for parameter, value in zip(KINDS[node.kind].parameters, node.values, strict=True):
        first, last = lobe * parameter.size, (lobe + 1) * parameter.size
        kept.append(value if isinstance(value, Raster) else value[:first] + value[last:])
    return Leaf(node.kind, tuple(kept))
