"""Colour = light of a direction x paint of a patch: a table with two kinds of rows, taken apart by least absolute errors.

In logarithms the table is additive, ``y[direction, patch] = light[direction] + paint[patch]``. Patches are seen from many directions and
directions in many patches, so both come out, up to a factor that goes to the paints: most of the area shall have paint 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from unshade.reflectance import Array

BINS = 24
"""Cells a side in which directions are counted as one."""

MOST = 300
"""Patches that are taken apart; the smaller ones wait."""

ROUNDS = 25
TIGHT = 0.01
"""Errors below this count as their square, so that the weights stay finite."""

PRIOR = 0.02
"""Weight of a patch's area for paint 0 against its area in the table."""


@dataclass(frozen=True)
class TwoWay:
    """``paints`` (P, 3) in logarithms, of the patches ``chosen`` (P,)."""

    chosen: NDArray[np.int64]
    paints: Array


def direction_cells(normals: Array) -> NDArray[np.int64]:
    """(N,) the cell of each (N, 3) normal."""
    cell = np.clip(((normals[:, :2] + 1.0) * (BINS / 2.0)).astype(np.int64), 0, BINS - 1)
    found: NDArray[np.int64] = cell[:, 1] * BINS + cell[:, 0]
    return found


def group_quantiles(
    groups: NDArray[np.int64], values: Array, quantile: float = 0.5
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], NDArray[np.int64]]:
    """The groups (G,) that occur, a quantile of (N, C) values in each (G, C), each value's group (N,), and counts (G,)."""
    found, place, count = np.unique(groups, return_inverse=True, return_counts=True)
    ends = np.cumsum(count)
    middle = ends - count + (count * quantile).astype(np.int64)
    found_values = np.stack([values[np.lexsort((values[:, c], place)), c][middle] for c in range(values.shape[1])], axis=-1)
    return found, found_values, place, count


def take_apart(logarithms: Array, normals: Array, patch: NDArray[np.int64], least: int) -> TwoWay:
    """The paints of the larger patches.

    Args:
        logarithms: (N, 3) of the colours. normals: (N, 3). patch: (N,) from 0 up.
        least: pixels that a patch must have.
    """
    area = np.bincount(patch)
    chosen = np.argsort(-area, kind="stable")[:MOST]
    chosen = chosen[area[chosen] >= least]
    number = np.full(len(area), -1)
    number[chosen] = np.arange(len(chosen))
    own = number[patch] >= 0
    if len(chosen) == 0:
        return TwoWay(chosen, np.zeros((0, logarithms.shape[1])))
    lights, light = np.unique(direction_cells(normals[own]), return_inverse=True)
    cells, table, _, count = group_quantiles(light * len(chosen) + number[patch[own]], logarithms[own])
    row, column = cells // len(chosen), cells % len(chosen)
    weight = np.minimum(count, 50.0)
    total = len(lights)
    paints = np.zeros((len(chosen), table.shape[1]))
    prior = PRIOR * np.bincount(column, weight, len(chosen))
    for c in range(table.shape[1]):
        error, away = np.ones(len(cells)), np.ones(len(chosen))
        for _ in range(ROUNDS):
            w, p = weight / np.maximum(error, TIGHT), prior / np.maximum(away, TIGHT)
            # Eliminate the lights: each is the weighted mean of what its patches leave.
            joint = np.zeros((total, len(chosen)))
            joint[row, column] = w
            per_light = np.maximum(joint.sum(1), 1e-12)
            matrix = np.diag(joint.sum(0) + p) - joint.T @ (joint / per_light[:, None])
            seen = np.bincount(row, w * table[:, c], total)
            right = np.bincount(column, w * table[:, c], len(chosen)) - joint.T @ (seen / per_light)
            paints[:, c] = np.linalg.solve(matrix + 1e-9 * np.eye(len(chosen)), right)
            level = (seen - joint @ paints[:, c]) / per_light
            error = np.abs(table[:, c] - level[row] - paints[column, c])
            away = np.abs(paints[:, c])
    return TwoWay(chosen, paints)
