"""Normals from an outline alone: the shape is blown up like a balloon. A guess, exact for a disc, plausible for round things.

The height h solves ``laplacian(h) = -4`` inside and is 0 on the outline; the surface is ``z = sqrt(h)``, which stands upright at
the outline and makes a hemisphere of a disc. Its normal is ``(-h_x / 2, -h_y / 2, sqrt(h))``, normalised.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from unshade.errors import PictureError
from unshade.reflectance import Array
from unshade.types import Normals

LARGEST = 384
"""Longer side on which the height is solved; the normals of a larger mask are enlarged."""

STEPS = 400
TOLERANCE = 1e-6


def inflate(mask: Array | torch.Tensor, path: str | Path = "mask") -> Normals:
    """Normals of a balloon with the outline of a mask.

    Args:
        mask: (H, W) in [0, 1], or (1, H, W); several separate parts are blown up each by itself.
        path: what an error calls it.
    Returns:
        (3, H, W) float64 unit vectors, +x right, +y up, +z to the viewer; (0, 0, 1) outside.
    Raises:
        PictureError: nothing is inside.
    """
    solid = np.asarray(mask, dtype=np.float64)
    solid = solid[0] if solid.ndim == 3 else solid
    if (solid > 0.5).sum() < 16:
        raise PictureError(f"{path}: expected a shape of at least 16 pixels, got {int((solid > 0.5).sum())}")
    factor = max(1, -(-max(solid.shape) // LARGEST))
    small = _shrunk(np.pad(solid, factor), factor)
    height = _height(small > 0.5)
    down, right = np.gradient(height)
    field = np.stack([-0.5 * right, 0.5 * down, np.sqrt(np.maximum(height, 0.0))], axis=-1)
    # Outside, the direction at the outline goes on, so that its own pixels get it.
    field = _spread(field, small > 0.5, 3)
    if factor > 1:
        field = _enlarged(field, (small.shape[0] * factor, small.shape[1] * factor))
    height_, width = solid.shape
    normals = field[factor : factor + height_, factor : factor + width].copy()
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(length > 1e-9, normals / np.maximum(length, 1e-9), np.array([0.0, 0.0, 1.0]))
    normals[solid <= 0.0] = (0.0, 0.0, 1.0)
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(normals, -1, 0)))


def _height(inside: NDArray[np.bool_]) -> Array:
    """Conjugate gradients from a coarser solution; pixels outside are held at 0."""
    start: Array = np.zeros(inside.shape)
    if min(inside.shape) > 32:
        rows, columns = (-(-side // 2) * 2 for side in inside.shape)
        padded = np.pad(inside, ((0, rows - inside.shape[0]), (0, columns - inside.shape[1])))
        coarse = padded.reshape(rows // 2, 2, columns // 2, 2).sum((1, 3)) >= 2
        start = 4.0 * _enlarged(_height(coarse)[..., None], (rows, columns))[: inside.shape[0], : inside.shape[1], 0]
    x: Array = np.where(inside, start, 0.0)

    def negative_laplacian(plane: Array) -> Array:
        padded = np.pad(plane, 1)
        around = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
        return np.where(inside, 4.0 * plane - around, 0.0)

    rest = np.where(inside, 4.0, 0.0) - negative_laplacian(x)
    along, power = rest, float((rest * rest).sum())
    goal = TOLERANCE**2 * 16.0 * float(inside.sum())
    for _ in range(STEPS):
        if power <= goal:
            break
        ahead = negative_laplacian(along)
        step = power / float((along * ahead).sum())
        x, rest = x + step * along, rest - step * ahead
        before, power = power, float((rest * rest).sum())
        along = rest + (power / before) * along
    return x


def _shrunk(plane: Array, factor: int) -> Array:
    if factor == 1:
        return plane
    rows, columns = (-(-side // factor) * factor for side in plane.shape)
    padded = np.pad(plane, ((0, rows - plane.shape[0]), (0, columns - plane.shape[1])))
    found: Array = padded.reshape(rows // factor, factor, columns // factor, factor).mean((1, 3))
    return found


def _enlarged(field: Array, size: tuple[int, int]) -> Array:
    """Bilinear, pixel edges aligned, (H, W, C)."""
    for axis, side in enumerate(size):
        count = field.shape[axis]
        at = np.clip((np.arange(side) + 0.5) * (count / side) - 0.5, 0.0, count - 1.0)
        low = np.minimum(at.astype(np.int64), max(count - 2, 0))
        share = (at - low).reshape([-1 if k == axis else 1 for k in range(3)])
        field = np.take(field, low, axis) * (1.0 - share) + np.take(field, np.minimum(low + 1, count - 1), axis) * share
    return field


def _spread(field: Array, known: NDArray[np.bool_], times: int) -> Array:
    """Carry a field outward pixel by pixel."""
    for _ in range(times):
        total, count = np.zeros_like(field), np.zeros(known.shape)
        weighted, solid = np.pad(np.where(known[..., None], field, 0.0), ((1, 1), (1, 1), (0, 0))), np.pad(known, 1).astype(np.float64)
        rows, columns = known.shape
        for row in range(3):
            for column in range(3):
                total += weighted[row : row + rows, column : column + columns]
                count += solid[row : row + rows, column : column + columns]
        fresh = ~known & (count > 0)
        field = np.where(fresh[..., None], total / np.maximum(count, 1.0)[..., None], field)
        known = known | fresh
    return field
