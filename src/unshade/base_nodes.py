"""Random base nodes, many at once, of the training half or the test half.

The space of base nodes is cut into cells and each cell belongs to one half, so that no test leaf occurs in training:
colours and directions by a fine grid, the directions of masks by a grid of their own, environments by name. `half_of` tells
the half of any leaf. The ranges are those of the released sampler, and wider ones for real pictures and for drawings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch

from unshade.environments import raster, versions
from unshade.nodes import KINDS, Leaf, Raster, Role
from unshade.sampler import cut_radius

SPLITS = ("train", "test")
COLOR_CELLS = 16
"""Cells along each channel."""

DIRECTION_CELLS = 16
"""Cells from -1 to 1 along each axis: about 7 degrees."""

WIDTH = 6
"""Numbers that the largest base node needs."""


@dataclass(frozen=True)
class Range:
    """What a number of a base node is drawn from, evenly or, where ``logarithmic``, evenly on a logarithmic scale."""

    low: float
    high: float
    logarithmic: bool = False

    def draw(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """(count,) float64."""
        share = torch.rand(count, generator=generator, dtype=torch.float64)
        if self.logarithmic:
            return self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share


@dataclass(frozen=True)
class Base:
    """A word of the data's grammar: a kind of leaf, and where its numbers come from."""

    kind: str
    scalars: tuple[Range, ...] = ()
    """One for each scalar of the kind, in its order."""
    lowest: float = 0.0
    """Directions have a z over this; 0 is the side that the viewer sees."""
    hue: Range | None = None
    """Of a colour in degrees, with ``saturation`` and ``brightness``; None is evenly over the cube."""
    saturation: Range = Range(0.0, 1.0)
    brightness: Range = Range(0.0, 1.0)
    toward: bool = False
    """Its direction is nearly that of the tree's first form."""


ZERO = Range(0.0, 0.0)
ONE = Range(1.0, 1.0)
_CUT = (ZERO, Range(0.2, 0.7), ZERO)
# fmt: off
BASES: dict[str, Base] = {
    # As released.
    "albedo": Base("albedo"),
    "diffuse": Base("diffuse", (Range(0.2, 0.5),)),
    "highlight": Base("highlight", (Range(30.0, 100.0), Range(1.0, 1.5))),
    "rim": Base("rim", (ONE,)),
    "toon_diffuse": Base("toon_diffuse", (Range(0.2, 0.7), Range(-0.2, 0.2), Range(0.1, 0.1))),
    "toon_highlight": Base("toon_highlight", _CUT),
    "threshold": Base("threshold", (Range(-0.2, 0.6), ZERO)),
    "stripe": Base("stripe", (Range(-0.2, 0.7), Range(0.15, 0.5), ZERO)),
    "environment": Base("environment_map"),
    # Wider, for real pictures.
    "wide_diffuse": Base("diffuse", (Range(0.0, 0.6),), lowest=-0.4),
    "wide_highlight": Base("highlight", (Range(8.0, 400.0, True), Range(0.3, 1.5))),
    "broad_highlight": Base("highlight", (Range(0.5, 20.0, True), ONE), lowest=-0.4),
    "wide_rim": Base("rim", (Range(0.6, 5.0, True),), lowest=-0.5),
    # For drawings.
    "hard_diffuse": Base("toon_diffuse", (Range(0.2, 0.8), Range(-0.4, 0.5), ZERO), lowest=-0.2),
    "hard_highlight": Base("toon_highlight", (Range(0.06, 0.5), Range(0.4, 1.0), ZERO)),
    "warm": Base("albedo", hue=Range(-20.0, 60.0), saturation=Range(0.2, 0.9), brightness=Range(0.6, 1.0)),
    "cool": Base("albedo", hue=Range(180.0, 290.0), saturation=Range(0.2, 0.9), brightness=Range(0.2, 0.7)),
    "ramp": Base("threshold", (Range(-0.1, 0.4), Range(0.6, 2.0)), toward=True),
    "ink": Base("albedo", hue=Range(0.0, 360.0), brightness=Range(0.0, 0.25)),
    "outline": Base("threshold", (Range(0.15, 0.4), ZERO), lowest=0.96),
}
# fmt: on


def draw(word: str, count: int, split: str, generator: torch.Generator, toward: torch.Tensor | None = None) -> torch.Tensor:
    """Base nodes of one half.

    Args:
        word: of `BASES`.
        toward: (count, 3) directions of the trees' forms, for a word that follows them.
    Returns:
        (count, WIDTH) float64: the numbers of the kind in its order, then zeros. An environment is its version in
        `environments.versions` and its rotation.
    """
    base = BASES[word]
    role = KINDS[base.kind].role
    if base.kind == "albedo":
        columns = [_within(lambda n: _colors(base, n, generator), count, split, role)]
    elif base.kind == "environment_map":
        version = torch.randint(len(versions(split)), (count, 1), generator=generator).double()
        turn = torch.zeros(count, 3, dtype=torch.float64)
        turn[:, 1] = Range(-math.pi, math.pi).draw(count, generator)
        columns = [version, turn]
    elif base.toward:
        assert toward is not None
        columns = [_near(toward, split, role, generator)]
    else:
        columns = [_within(lambda n: _directions(n, base.lowest, generator), count, split, role)]
    scalars = [numbers.draw(count, generator) for numbers in base.scalars]
    if word == "toon_highlight":
        scalars[0] = _released_radii(count, generator)
    columns += [scalar[:, None] for scalar in scalars]
    drawn = torch.cat(columns, dim=1)
    return torch.nn.functional.pad(drawn, (0, WIDTH - drawn.shape[1]))


def base_leaf(kind: str, numbers: torch.Tensor, split: str) -> Leaf:
    """The leaf of a row that `draw` made."""
    if kind == "environment_map":
        return Leaf(kind, (raster(split, int(numbers[0])), tuple(numbers[1:4].tolist())))
    values, first = [], 0
    for parameter in KINDS[kind].parameters:
        values.append(tuple(numbers[first : first + parameter.size].tolist()))
        first += parameter.size
    return Leaf(kind, tuple(values))


def half_of(leaf: Leaf) -> str | None:
    """The half that a leaf belongs to, train or test; None for an environment that is in neither."""
    if leaf.kind == "environment_map":
        return _halves_of_environments().get(leaf["pixels"].data)
    first = leaf.values[0]
    assert not isinstance(first, Raster)
    return SPLITS[int(_is_test(torch.tensor([first], dtype=torch.float64), leaf.role))]


@lru_cache(maxsize=1)
def _halves_of_environments() -> dict[bytes, str]:
    return {raster(split, version).data: split for split in SPLITS for version in range(len(versions(split)))}


def _is_test(points: torch.Tensor, role: Role) -> torch.Tensor:
    """Which (N, 3) colours or directions are in the test half: a hash of their cell."""
    if role is Role.PAINT:
        salt, cells = 1, (points * COLOR_CELLS).floor().clamp(0, COLOR_CELLS - 1)
    else:
        salt, cells = 2 + (role is Role.MASK), ((points + 1.0) * (DIRECTION_CELLS / 2)).floor().clamp(0, DIRECTION_CELLS - 1)
    mixed = torch.full((len(points),), salt, dtype=torch.int64)
    for column in cells.long().unbind(1):
        mixed = ((mixed + column + 1) * 0x9E3779B1) & 0xFFFFFFFF
        mixed = mixed ^ (mixed >> 15)
    return (mixed >> 7) & 1 == 1


def _within(make: Callable[[int], torch.Tensor], count: int, split: str, role: Role) -> torch.Tensor:
    """``make(n)`` gives (n, 3); again for those that are in the other half."""
    points = make(count)
    while len(wrong := (_is_test(points, role) != (split == "test")).nonzero()[:, 0]):
        points[wrong] = make(len(wrong))
    return points


def _near(toward: torch.Tensor, split: str, role: Role, generator: torch.Generator) -> torch.Tensor:
    """Directions of this half that are near to others."""
    found = toward.clone()
    spread = 0.05
    while len(wrong := (_is_test(found, role) != (split == "test")).nonzero()[:, 0]):
        noise = torch.randn(len(wrong), 3, generator=generator, dtype=torch.float64)
        found[wrong] = torch.nn.functional.normalize(toward[wrong] + spread * noise, dim=1)
        spread *= 1.2
    return found


def _directions(count: int, lowest: float, generator: torch.Generator) -> torch.Tensor:
    """Evenly over the sphere where z > ``lowest``, (count, 3)."""
    z = Range(lowest, 1.0).draw(count, generator)
    angle = Range(0.0, math.tau).draw(count, generator)
    radius = (1.0 - z * z).clamp(min=0.0).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)


def _colors(base: Base, count: int, generator: torch.Generator) -> torch.Tensor:
    """(count, 3) in [0, 1]."""
    if base.hue is None:
        return torch.rand(count, 3, generator=generator, dtype=torch.float64)
    hue, saturation, value = (part.draw(count, generator)[:, None] for part in (base.hue, base.saturation, base.brightness))
    sector = (torch.tensor([[5.0, 3.0, 1.0]], dtype=torch.float64) + hue / 60.0) % 6.0
    return value * (1.0 - saturation * torch.minimum(sector, 4.0 - sector).clamp(0.0, 1.0))


def _released_radii(count: int, generator: torch.Generator) -> torch.Tensor:
    """Of a highlight that is cut at a threshold, as released."""
    parts = (Range(0.5, 0.8), Range(30.0, 90.0), Range(0.1, 0.5))
    amplitudes, sharpnesses, thresholds = (part.draw(count, generator).tolist() for part in parts)
    return torch.tensor([cut_radius(*cut) for cut in zip(amplitudes, sharpnesses, thresholds, strict=True)], dtype=torch.float64)
