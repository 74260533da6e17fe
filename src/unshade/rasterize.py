"""Triangles to pixels: which one is in front, and where in it. Small, exact, on the CPU.

Every triangle brings the pixels of its bounding box; those whose centre lies inside stay, and the nearest wins. All triangles are
worked on together, in portions of a fixed number of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.floating]
Indices: TypeAlias = NDArray[np.int64]

PORTION = 1 << 20
"""Pixels of bounding boxes that are tested at once."""


@dataclass(frozen=True)
class Fragments:
    """What is seen: for each of N covered ``pixel`` (row * width + column) its ``triangle`` and the shares (N, 3) of its corners."""

    pixel: Indices
    triangle: Indices
    shares: Array


def rasterize(corners: Array, width: int, height: int) -> Fragments:
    """The front triangle of every pixel.

    Args:
        corners: (F, 3, 3) x to the right and y down in pixels, and a depth that is linear across the picture and larger nearer
            (1 / distance in perspective). Triangles of either orientation count.
    """
    low = np.ceil(corners[..., :2].min(axis=1) - 0.5).astype(np.int64).clip(0, [width, height])
    high = (np.floor(corners[..., :2].max(axis=1) - 0.5).astype(np.int64) + 1).clip(0, [width, height])
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    twice_area = _cross(b - a, c - a)
    spans = np.maximum(high - low, 0)
    count = spans[:, 0] * spans[:, 1] * (np.abs(twice_area) > 1e-12)
    nearest = np.full(width * height, -np.inf)
    owner = np.full(width * height, -1, dtype=np.int64)
    order = np.flatnonzero(count)
    ends = np.cumsum(count[order])
    start = 0
    while start < len(order):
        stop = max(start + 1, int(np.searchsorted(ends, (ends[start - 1] if start else 0) + PORTION, side="right")))
        _draw(order[start:stop], count, low, spans, corners, twice_area, width, nearest, owner)
        start = stop
    pixel = np.flatnonzero(owner >= 0)
    triangle = owner[pixel]
    return Fragments(pixel, triangle, _shares(corners, twice_area, triangle, pixel % width + 0.5, pixel // width + 0.5))


def _draw(
    chosen: Indices, count: Indices, low: Indices, spans: Indices, corners: Array, area: Array, width: int, nearest: Array, owner: Indices
) -> None:
    """Put some triangles into the depth buffer; ties go to the first."""
    triangle = np.repeat(chosen, count[chosen])
    place = np.arange(len(triangle)) - np.repeat(np.cumsum(count[chosen]) - count[chosen], count[chosen])
    column = low[triangle, 0] + place % spans[triangle, 0]
    row = low[triangle, 1] + place // spans[triangle, 0]
    shares = _shares(corners, area, triangle, column + 0.5, row + 0.5)
    inside = (shares >= -1e-9).all(axis=-1)
    triangle, pixel = triangle[inside], (row * width + column)[inside]
    depth = (shares[inside] * corners[triangle][:, :, 2]).sum(-1)
    ranked = np.lexsort((triangle, -depth, pixel))
    first = ranked[np.unique(pixel[ranked], return_index=True)[1]]
    nearer = first[depth[first] > nearest[pixel[first]]]
    nearest[pixel[nearer]], owner[pixel[nearer]] = depth[nearer], triangle[nearer]


def _cross(u: Array, v: Array) -> Array:
    found: Array = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return found


def _shares(corners: Array, area: Array, triangle: Indices, x: Array, y: Array) -> Array:
    """(N, 3) barycentric coordinates of places in triangles."""
    own, at = corners[triangle][..., :2], np.stack([x, y], axis=-1)
    parts = [_cross(own[:, (k + 1) % 3] - at, own[:, (k + 2) % 3] - at) for k in range(3)]
    return np.stack(parts, axis=-1) / area[triangle][:, None]
