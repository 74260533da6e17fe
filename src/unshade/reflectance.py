"""Colours seen at normals -> a picture of the sphere, with what was seen and a clean fill of what was not.

A picture M of the sphere is looked up at ``n.xy`` (`shading.image`), which is linear in M. So the picture that explains colours
I_i at normals n_i is a least-squares problem on its grid,

    sum_i w_i |I_i - (B M)_i|^2  +  smooth |grad (M - T)|^2  +  hold |M - T|^2,

with B the bilinear look-up and T a trend of few numbers, spherical harmonics to the second order: what diffuse light can do
(Ramamoorthi and Hanrahan 2001). Where nothing was seen the second and third terms alone decide: M goes over into the trend
without an edge. B^T W B couples a texel to its eight neighbours only, so a step of the solver costs the grid, not the photo.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.floating]

SMOOTH = 0.02
"""Weight of the fill against one pixel of the photo in a texel."""

HOLD = 1e-4
COARSEST = 32
STEPS = 60
"""Steps of the solver on each grid; the next coarser one gives the start."""

CELLS = 64
"""Coverage is counted in this many cells a side."""


def harmonics(normals: Array) -> Array:
    """Real spherical harmonics to the second order at (N, 3) normals, (N, 9), up to constant factors."""
    x, y, z = normals.T
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3.0 * z * z - 1.0], axis=-1)


def grid_normals(size: int) -> Array:
    """(size, size, 3) normals of the picture's texels, those of the silhouette past it, as `sphere.sphere_normals` has them."""
    steps = (np.arange(size) + 0.5) * (2.0 / size) - 1.0
    x, y = np.meshgrid(steps, -steps)
    radius = np.maximum(np.hypot(x, y), 1.0)
    x, y = x / radius, y / radius
    return np.stack([x, y, np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))], axis=-1)


def trend(normals: Array, colors: Array, weights: Array) -> Array:
    """(9, C) harmonics that explain (N, C) colours best, the absolute error counted (ten rounds of reweighting).

    A small ridge keeps what was not seen near what was.
    """
    basis = harmonics(normals)
    ridge = np.diag([0.0, *[1e-3] * 3, *[1e-2] * 5]) * max(float(weights.sum()), 1e-12)
    count: Array = np.array(weights)
    found: Array = np.zeros((9, colors.shape[1]))
    for _ in range(10):
        found = np.linalg.solve(basis.T @ (basis * count[:, None]) + ridge + 1e-9 * np.eye(9), basis.T @ (colors * count[:, None]))
        error = np.abs(colors - basis @ found).sum(-1)
        count = weights / np.maximum(error, 0.02) * 0.02
    return found


@dataclass(frozen=True)
class Corners:
    """Bilinear look-ups of (N,) places in a picture: the four texels of each, and their shares."""

    index: NDArray[np.int64]
    share: Array

    @staticmethod
    def of(normals: Array, size: int) -> Corners:
        """Of (N, 3) normals in a picture of ``size`` texels a side; (4, N) each, in the order 00, 01, 10, 11 of (row, column)."""
        column = np.clip((normals[:, 0] + 1.0) * (size / 2.0) - 0.5, 0.0, size - 1.0)
        row = np.clip((1.0 - normals[:, 1]) * (size / 2.0) - 0.5, 0.0, size - 1.0)
        left = np.minimum(column.astype(np.int64), size - 2)
        top = np.minimum(row.astype(np.int64), size - 2)
        right, low = column - left, row - top
        first = top * size + left
        index = np.stack([first, first + 1, first + size, first + size + 1])
        share = np.stack([(1 - low) * (1 - right), (1 - low) * right, low * (1 - right), low * right])
        return Corners(index, share)

    def look_up(self, picture: Array) -> Array:
        """(N, C) from a picture (S, S, C)."""
        flat = picture.reshape(-1, picture.shape[-1])
        found: Array = sum(self.share[k][:, None] * flat[self.index[k]] for k in range(4))
        return found

    def gather(self, numbers: Array, size: int) -> Array:
        """The transpose: (N, C) numbers summed into (S, S, C)."""
        planes = [summed(self.index.ravel(), (self.share * numbers[:, c]).ravel(), size * size) for c in range(numbers.shape[1])]
        return np.stack(planes, axis=-1).reshape(size, size, -1)


def summed(places: NDArray[np.int64], numbers: Array, count: int) -> Array:
    """(count,) sums of the (N,) numbers that share a place."""
    return np.asarray(np.bincount(places, numbers, count), dtype=np.float64)


class _System:
    """The normal equations on a grid, as planes: a texel with itself, and with its neighbours right, below, and on both diagonals."""

    def __init__(self, corners: Corners, weights: Array, size: int, smooth: float) -> None:
        index, share = corners.index, corners.share

        def plane(*pairs: tuple[int, int, int]) -> Array:
            """Products of the shares p and q, stored at the texel of r."""
            parts = [summed(index[r], weights * share[p] * share[q], size * size) for p, q, r in pairs]
            total: Array = np.sum(parts, axis=0)
            return total.reshape(size, size)[..., None]

        self.own = plane((0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 3, 3))
        self.right = plane((0, 1, 0), (2, 3, 2))[:, :-1]
        self.below = plane((0, 2, 0), (1, 3, 1))[:-1]
        self.falling = plane((0, 3, 0))[:-1, :-1]
        self.rising = plane((1, 2, 1))[:-1, 1:]
        neighbours = np.full((size, size, 1), 4.0)
        for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
            neighbours[edge] -= 1.0
        self.own += HOLD + smooth * neighbours
        self.smooth = smooth

    def __call__(self, picture: Array) -> Array:
        result = self.own * picture
        for plane, one, other in (
            (self.right - self.smooth, np.s_[:, :-1], np.s_[:, 1:]),
            (self.below - self.smooth, np.s_[:-1], np.s_[1:]),
            (self.falling, np.s_[:-1, :-1], np.s_[1:, 1:]),
            (self.rising, np.s_[:-1, 1:], np.s_[1:, :-1]),
        ):
            result[one] += plane * picture[other]
            result[other] += plane * picture[one]
        return result


def _prior(picture: Array, smooth: float) -> Array:
    """``hold - smooth * laplacian`` of a picture."""
    result = HOLD * picture
    across = smooth * (picture[:, 1:] - picture[:, :-1])
    down = smooth * (picture[1:] - picture[:-1])
    result[:, 1:] += across
    result[:, :-1] -= across
    result[1:] += down
    result[:-1] -= down
    return result


def _enlarged(picture: Array, size: int) -> Array:
    """Bilinear to another size, pixel edges aligned."""
    at = np.clip((np.arange(size) + 0.5) * (picture.shape[0] / size) - 0.5, 0.0, picture.shape[0] - 1.0)
    low = np.minimum(at.astype(np.int64), picture.shape[0] - 2)
    part = (at - low)[:, None, None]
    rows = picture[low] * (1 - part) + picture[low + 1] * part
    part = (at - low)[None, :, None]
    found: Array = rows[:, low] * (1 - part) + rows[:, low + 1] * part
    return found


def solve(normals: Array, colors: Array, weights: Array, size: int, smooth: float = SMOOTH) -> Array:
    """The picture of the sphere that explains colours seen at normals.

    Args:
        normals: (N, 3) unit vectors that face the viewer.
        colors: (N, C).
        weights: (N,), 1 for a pixel that counts in full.
        size: width and height.
        smooth: weight of smoothness against one pixel; more for noise and texture.
    Returns:
        (size, size, C) in [0, 1], filled past the silhouette and where nothing was seen.
    """
    base = trend(normals, colors, weights)
    low, high = colors.min(axis=0), colors.max(axis=0)
    sizes = [size]
    while sizes[0] > COARSEST:
        sizes.insert(0, -(-sizes[0] // 2))
    found: Array | None = None
    for side in sizes:
        guess = np.clip((harmonics(grid_normals(side).reshape(-1, 3)) @ base).reshape(side, side, -1), low, high)
        corners = Corners.of(normals, side)
        system = _System(corners, weights, side, smooth)
        right = corners.gather(colors * weights[:, None], side) + _prior(guess, smooth)
        found = _conjugate_gradients(system, right, guess if found is None else _enlarged(found, side))
    assert found is not None
    return found.clip(0.0, 1.0)


def _conjugate_gradients(system: _System, right: Array, start: Array) -> Array:
    """``system(x) = right``, each channel by itself, preconditioned by the diagonal."""
    x = start.copy()
    rest = right - system(x)
    scaled = rest / system.own
    along, power = scaled, (rest * scaled).sum((0, 1))
    goal = 1e-14 * np.maximum((right * right / system.own).sum((0, 1)), 1e-30)
    for _ in range(STEPS):
        if (power <= goal).all():
            break
        ahead = system(along)
        step = power / np.maximum((along * ahead).sum((0, 1)), 1e-300)
        x = x + step * along
        rest = rest - step * ahead
        scaled = rest / system.own
        before, power = power, (rest * scaled).sum((0, 1))
        along = scaled + (power / np.maximum(before, 1e-300)) * along
    return x


def coverage(normals: Array, weights: Array, size: int) -> Array:
    """(size, size) in [0, 1]: how well each direction was seen. Two pixels in a cell of 1/64 of the width, or around it, are enough."""
    cells = min(CELLS, size)
    count = Corners.of(normals, cells).gather(np.minimum(weights, 1.0)[:, None], cells)
    padded = np.pad(count[..., 0], 1, mode="edge")
    rows = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    seen = np.clip((0.25 * rows[:, :-2] + 0.5 * rows[:, 1:-1] + 0.25 * rows[:, 2:]) / 2.0, 0.0, 1.0)
    # Cells that the silhouette cuts are seen in part of their area.
    inside = np.hypot(*np.moveaxis(grid_normals(cells)[..., :2], -1, 0)) < 1.0
    share = _enlarged(np.where(inside, seen, np.where(seen > 0.15, 1.0, seen))[..., None], size)[..., 0]
    steps = (np.arange(size) + 0.5) * (2.0 / size) - 1.0
    return share * (np.hypot(*np.meshgrid(steps, steps)) <= 1.0)
