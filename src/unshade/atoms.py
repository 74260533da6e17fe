"""A dictionary of leaves at many directions and sizes, rendered once, from which the search reads its starts.

All operators are affine in a new leaf's colour or strength, so the best colour of every entry at every place in a tree
is a closed form, and one matrix product finds it for the whole dictionary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch

from unshade.fit.pixels import Pixels
from unshade.nodes import KINDS, Leaf, leaf


def directions(count: int, lowest: float) -> torch.Tensor:
    """``count`` directions spread evenly (Fibonacci) over the sphere where z > ``lowest``, (count, 3)."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1.0 - (1.0 - lowest) * k / count
    radius = (1.0 - z * z).sqrt()
    angle = k * (math.pi * (3.0 - math.sqrt(5.0)))
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)


@dataclass(frozen=True)
class Atoms:
    """Leaves of one family and their pictures."""

    leaves: tuple[Leaf, ...]
    pictures: torch.Tensor
    """(M, N) grey."""
    squares: torch.Tensor
    """(M, N)"""
    scalable: torch.Tensor
    """(M,) bool, true where the leaf has an amplitude of its own."""

    def project(self, basis: torch.Tensor, residual: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """For every leaf, ``basis`` (*, 3, N) times its picture against the residual and against itself, (*, 3, M) each.

        One product for the bases of several places reads the pictures once.

        Their ratio is the colour of the leaf that lowers the squared error most, where it is added as ``basis * color * picture``.
        """
        return (weight * basis * residual) @ self.pictures.T, (weight * basis.square()) @ self.squares.T


def _render(leaves: list[Leaf], normals: torch.Tensor) -> Atoms:
    """Render grey leaves at (3, N) normals, kind by kind as one batch."""
    pictures = torch.empty(len(leaves), normals.shape[1], dtype=normals.dtype)
    kinds: dict[str, list[int]] = {}
    for k, entry in enumerate(leaves):
        kinds.setdefault(entry.kind, []).append(k)
    for name, index in kinds.items():
        kind = KINDS[name]
        arguments = [torch.tensor([leaves[k].values[p] for k in index], dtype=normals.dtype) for p in range(len(kind.parameters))]
        if kind.repeats:
            arguments = [argument[:, None, :] for argument in arguments]
        pictures[index] = kind.formula(normals[:, None, :], *arguments)[:, 0, 0, :]
    scalable = torch.tensor([KINDS[entry.kind].amplitude is not None for entry in leaves])
    return Atoms(tuple(leaves), pictures, pictures.square(), scalable)


def lights() -> list[Leaf]:
    """Highlights from broad to as small as a few pixels."""
    found = []
    for sharpness, count, lowest in (
        (0.3, 24, -0.6),
        (0.8, 40, -0.5),
        (2.0, 70, -0.4),
        (5.0, 110, -0.3),
        (12.0, 170, -0.2),
        (35.0, 260, -0.1),
        (110.0, 420, 0.0),
    ):
        found += [leaf("highlight", direction=d, sharpness=sharpness) for d in directions(count, lowest).tolist()]
    return found


def spots() -> list[Leaf]:
    """Drawn highlights with an edge."""
    return [
        leaf("toon_highlight", direction=d, radius=radius, softness=0.4 * radius)
        for radius, count in ((0.12, 300), (0.22, 160), (0.4, 80), (0.7, 50))
        for d in directions(count, 0.0).tolist()
    ]


def environments() -> list[Leaf]:
    """Lights seen in the mirror direction, white."""
    found = []
    for sharpness, count in ((0.5, 24), (2.0, 60), (8.0, 160), (30.0, 300)):
        found += [leaf("environment", direction=d, sharpness=sharpness, color=(1.0, 1.0, 1.0)) for d in directions(count, -0.98).tolist()]
    return found


def masks() -> list[Leaf]:
    """One side of a circle, hard and soft, and bands."""
    found = []
    for softness, count, edges in ((0.06, 60, 7), (0.3, 50, 7), (0.9, 40, 5), (1.8, 24, 5)):
        for d in directions(count, -0.99).tolist():
            for k in range(edges):
                found.append(leaf("threshold", direction=d, threshold=-0.9 + 1.8 * (k + 0.5) / edges, softness=softness))
    for width, count in ((0.15, 30), (0.4, 30), (0.8, 20)):
        for d in directions(count, 0.0).tolist():
            for center in (-0.6, -0.3, 0.0, 0.3, 0.6):
                found.append(leaf("stripe", direction=d, center=center, width=width, softness=0.08))
    return found


def shades() -> list[Leaf]:
    """Lambert and two-tone shading with no ambient, by which a tree is multiplied."""
    found = [leaf("diffuse", direction=d, ambient=0.0) for d in directions(90, -0.9).tolist()]
    for softness, count in ((0.08, 60), (0.5, 40), (1.4, 30)):
        for d in directions(count, -0.9).tolist():
            for k in range(5):
                found.append(leaf("toon_diffuse", direction=d, ambient=0.0, threshold=-0.8 + 0.35 * k - 0.5 * softness, softness=softness))
    return found


def plain_lights() -> list[Leaf]:
    """Highlights as the released grammar draws them."""
    found = []
    for sharpness, count, lowest in ((20.0, 200, -0.1), (50.0, 320, 0.0), (100.0, 420, 0.0)):
        found += [leaf("highlight", direction=d, sharpness=sharpness) for d in directions(count, lowest).tolist()]
    return found


def plain_masks() -> list[Leaf]:
    """Drawn masks: hard circles and bands."""
    found = []
    for d in directions(80, -0.99).tolist():
        found += [leaf("threshold", direction=d, threshold=-0.9 + 1.8 * (k + 0.5) / 9, softness=0.05) for k in range(9)]
    for d in directions(70, 0.0).tolist():
        for width in (0.15, 0.3, 0.5):
            found += [leaf("stripe", direction=d, center=-0.8 + 0.2 * k, width=width, softness=0.05) for k in range(9)]
    return found


def plain_shades() -> list[Leaf]:
    """Lambert shading and two-tone shading with the released softness."""
    found = [leaf("diffuse", direction=d, ambient=0.0) for d in directions(90, -0.5).tolist()]
    for d in directions(90, -0.5).tolist():
        found += [leaf("toon_diffuse", direction=d, ambient=0.0, threshold=-0.3 + 0.1 * k, softness=0.1) for k in range(7)]
    return found


def rims() -> list[Leaf]:
    """Light at the silhouette, wide and narrow."""
    found = []
    for exponent in (0.7, 1.5, 3.0, 7.0):
        for k in range(16):
            angle = 2.0 * math.pi * k / 16
            for z in (0.0, 0.6):
                found.append(leaf("rim", direction=(math.cos(angle), math.sin(angle), z), exponent=exponent))
    return found


def plain_rims() -> list[Leaf]:
    """The rims of the released grammar."""
    return [leaf("rim", direction=d, exponent=1.0) for d in directions(90, -0.2).tolist()]


FAMILIES = {
    "rims": rims,
    "plain_rims": plain_rims,
    "plain_lights": plain_lights,
    "plain_spots": spots,
    "plain_masks": plain_masks,
    "plain_shades": plain_shades,
    "plain_environments": environments,
    "lights": lights,
    "spots": spots,
    "environments": environments,
    "masks": masks,
    "shades": shades,
}


@lru_cache(maxsize=len(FAMILIES))
def _leaves(family: str) -> list[Leaf]:
    return FAMILIES[family]()


class Dictionary:
    """Every family rendered at the pixels of one picture."""

    def __init__(self, normals: torch.Tensor) -> None:
        self.normals = normals
        self._families: dict[str, Atoms] = {}

    def __getitem__(self, family: str) -> Atoms:
        if family not in self._families:
            self._families[family] = _render(_leaves(family), self.normals)
        return self._families[family]


def dictionary_of(pixels: Pixels) -> Dictionary:
    """The dictionary at the pixels of a picture; all pictures of one size and mask share it."""
    return _dictionary(pixels.normals.contiguous().numpy().tobytes())


@lru_cache(maxsize=4)
def _dictionary(normals: bytes) -> Dictionary:
    """Of (3, N) float32 normals."""
    return Dictionary(torch.frombuffer(bytearray(normals), dtype=torch.float32).view(3, -1))
