"""What a parametric leaf is to a vector drawing: a profile ``g(q)`` of one number that the sphere's symmetry leaves.

In the frame of a leaf, ``u`` runs along the light's direction as it is seen, ``v`` across it, and ``z = sqrt(1 - u^2 - v^2)``. Diffuse
and toon shading, highlights and masks are functions of ``q = n.l = rho u + lz z``; a lobe of an environment of
``q = r.l = 2 z (rho u + lz z) - lz``. At one z both are ``q = a u + b``, so that each is a linear gradient there.
The formulas themselves stand in `unshade.shading`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from unshade.nodes import KINDS, Leaf

Numbers = NDArray[np.float64]


EDGED = {"toon_diffuse", "toon_highlight", "threshold", "stripe"}


@dataclass(frozen=True)
class Profile:
    """A leaf, or one lobe of it, in its own frame."""

    angle: float
    """Of the u axis from +x, counterclockwise, in radians."""
    rho: float
    """How far the light is from the view axis: the sine of its angle."""
    lz: float
    """0 at least; a light from behind is its antipode with the profile turned."""
    mirrored: bool
    """True where q is that of the mirror direction."""
    shade: Callable[[Numbers], Numbers]
    """q in [-1, 1] to brightness in [0, 1]."""
    edged: bool = False
    """True for the kinds that have an edge, which may be drawn as a line."""

    def line(self, z: Numbers | float) -> tuple[Numbers, Numbers]:
        """a and b of ``q = a u + b`` at a height z."""
        z = np.asarray(z, dtype=np.float64)
        if self.mirrored:
            return 2.0 * z * self.rho, 2.0 * self.lz * z * z - self.lz
        return np.full_like(z, self.rho), self.lz * z

    def at(self, u: Numbers, z: Numbers) -> Numbers:
        """q at places of the disc."""
        a, b = self.line(z)
        return np.clip(a * u + b, -1.0, 1.0)

    @property
    def spread(self) -> float:
        """The share of [-1, 1] over which the brightness goes from end to end at its steepest: 0 for a hard edge."""
        q = np.linspace(-1.0, 1.0, 4001)
        slope = float(np.abs(np.diff(self.shade(q))).max()) / 5e-4
        height = float(np.ptp(self.shade(q)))
        return height / slope if slope > 0 else 2.0


def _along(leaf: Leaf, **values: object) -> Callable[[Numbers], Numbers]:
    """The brightness of a leaf as a function of n.l: its own formula on normals in the plane of the light."""
    turned = leaf.set(direction=(0.0, 0.0, 1.0), **values)
    parameters = [torch.tensor(value, dtype=torch.float64) for value in turned.values]
    formula = KINDS[leaf.kind].formula

    def shade(q: Numbers) -> Numbers:
        cosine = torch.from_numpy(np.clip(np.asarray(q, dtype=np.float64), -1.0, 1.0)).reshape(1, -1)
        normals = torch.stack([(1.0 - cosine.square()).clamp(min=0.0).sqrt(), torch.zeros_like(cosine), cosine])
        return formula(normals, *parameters)[0, 0].numpy().reshape(np.shape(q))

    return shade


def _turned(shade: Callable[[Numbers], Numbers]) -> Callable[[Numbers], Numbers]:
    return lambda q: shade(-q)


def _oriented(direction: tuple[float, ...], mirrored: bool, shade: Callable[[Numbers], Numbers], edged: bool = False) -> Profile:
    x, y, z = direction
    if z < 0.0 and not mirrored:
        x, y, z, shade = -x, -y, -z, _turned(shade)
    rho = math.hypot(x, y)
    return Profile(math.atan2(y, x) if rho > 1e-9 else 0.0, rho, z, mirrored, shade, edged)


def profile(leaf: Leaf) -> Profile:
    """The profile of a grey leaf or mask that depends on one direction; a rim's without its factor ``(1 - z)^exponent``."""
    direction = leaf["direction"]
    if leaf.kind == "rim":
        return _oriented(direction, False, lambda q: np.maximum(q, 0.0))
    return _oriented(direction, False, _along(leaf), edged=leaf.kind in EDGED)


def lobes(leaf: Leaf) -> list[tuple[Profile, tuple[float, float, float]]]:
    """The lobes of an environment, each a grey profile with its colour."""
    found = []
    for k in range(leaf.lobes):
        direction, color = leaf["direction"][3 * k : 3 * k + 3], leaf["color"][3 * k : 3 * k + 3]
        sharpness = leaf["sharpness"][k]
        found.append((_oriented(direction, True, _gaussian(sharpness)), (color[0], color[1], color[2])))
    return found


def _gaussian(sharpness: float) -> Callable[[Numbers], Numbers]:
    spot = Leaf("highlight", ((0.0, 0.0, 1.0), (sharpness,), (1.0,)))
    return _along(spot)
