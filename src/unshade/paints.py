"""Take texture and cast shadow out of a photo whose normals are known, so that what is left is a function of the normal.

A photo is read as ``I = t * M(n)``: a picture of the sphere M, and a colour ratio t that is one of a few, 1 for the paint that
covers most. Another paint and a cast shadow are both such a ratio; what fits none, such as dirt or a reflection of something
near, does not count. Found in turn, like the means of a mixture:

1. M and the paint of every large patch together, from which patch shows what in which direction (`two_way`);
2. the ratios that many pixels share, in directions that the common paint is seen in too: a highlight, which depends on the
   direction, is never mistaken for paint;
3. the ratio of each pixel, judged together with its neighbours and its patch, since paint comes in patches (`patches`);
4. M again from the pixels of the common paint, those of the others helping where it is not seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from unshade.patches import patches
from unshade.reflectance import Array, Corners, solve, summed
from unshade.two_way import TwoWay, direction_cells, group_quantiles, take_apart

Labels: TypeAlias = NDArray[np.int64]

GRID = 48
"""Side of the picture of the sphere while paints are told apart."""

STARTS = 2
ROUNDS = 6
MOST = 6
"""Most paints and shadows that are looked for."""

SHARE = 0.015
"""Share of the pixels that a paint must have."""

STEP = 0.12
"""Width of a cell of the histogram of ratios, in their logarithm."""

PATCH = 40
"""Pixels of a patch that has one paint."""

NOISE = 0.012
"""Least deviation that is counted as noise, of [0, 1]."""

OTHER = 0.02
"""Weight of a pixel of another paint, brought to the common one, against a pixel of the common paint itself."""

LIT = 0.8
"""Quantile in each small range of directions that the picture of the sphere starts from: a cast shadow only darkens."""

DARK = 0.02
"""Added to both sides of a ratio, so that black over black is 1."""


@dataclass(frozen=True)
class Paint:
    """A ratio to the common paint that many pixels share: (3,) colour, and its share of the pixels."""

    ratio: tuple[float, float, float]
    share: float

    @property
    def shadow(self) -> bool:
        """Darker and nearly grey, as a cast shadow is; a grey paint looks the same."""
        return max(self.ratio) < 0.97 and max(self.ratio) - min(self.ratio) < 0.12 * max(self.ratio) + 0.04


@dataclass(frozen=True)
class Separation:
    """What `separate` found.

    ``labels`` are (H, W): -1 outside, 0 the common paint, k the paint ``paints[k - 1]``, `NONE` for what fits none.
    ``weights`` (H, W) and ``flat`` (H, W, 3), the colours as if all were the common paint, are what the picture of the
    sphere is solved from. ``noise`` is the deviation that stays, of [0, 1].
    """

    labels: Labels
    paints: tuple[Paint, ...]
    weights: Array
    flat: Array
    noise: float


NONE = MOST + 2


def _ratios(colors: Array, shaded: Array) -> Array:
    return np.log((colors + DARK) / (shaded + DARK))


def _near(ratios: Array, cells: NDArray[np.int64], counts: Array, key: int, side: int) -> tuple[Array, float]:
    """The middle of a cell of ratios, and the pixels in it and around it."""
    low = ratios.min(axis=0)
    middle = low + (np.array([key // side**2, key // side % side, key % side]) + 0.5) * STEP
    own = (np.abs(ratios - middle) < STEP).all(axis=-1)
    return np.median(ratios[own], axis=0), float(own.sum())


def _mode(ratios: Array) -> tuple[Array, float]:
    """The place in (N, 3) log ratios that most pixels are around, and how many are."""
    cells = ((ratios - ratios.min(axis=0)) / STEP).astype(np.int64)
    side = int(cells.max()) + 1
    keys, counts = np.unique(cells @ np.array([side * side, side, 1]), return_counts=True)
    tried = keys[np.argsort(-counts, kind="stable")[:12]]
    return max((_near(ratios, cells, counts.astype(np.float64), int(key), side) for key in tried), key=lambda found: found[1])


def _blurred(plane: Array, weight: Array) -> Array:
    """Mean over 5 x 5 pixels of those that count, (H, W)."""

    def boxed(values: Array) -> Array:
        padded = np.pad(values, 3)
        total = padded.cumsum(0).cumsum(1)
        found: Array = total[5:-1, 5:-1] - total[5:-1, :-6] - total[:-6, 5:-1] + total[:-6, :-6]
        return found

    return boxed(plane * weight) / np.maximum(boxed(weight), 1e-9)


class _Separator:
    def __init__(self, image: Array, normals: Array, valid: NDArray[np.bool_]) -> None:
        self.image, self.valid = image, valid
        self.colors, self.normals = image[valid], normals[valid]
        self.corners = Corners.of(self.normals, GRID)
        self.ratios: list[Array] = [np.zeros(3)]
        self.noise = self.deviation = 0.05
        self.labels = np.zeros(len(self.colors), dtype=np.int64)
        self._start()

    def _start(self) -> None:
        """Paints of the large patches and the picture of the sphere that goes with them, in turn with the patches themselves."""
        logarithms = np.log(self.colors + DARK)
        everywhere = np.zeros(self.image.shape)
        everywhere[self.valid] = logarithms
        flat, counted = self.colors, np.ones(len(self.colors), dtype=bool)
        for _ in range(STARTS):
            self.shaded = self.corners.look_up(self._levels(flat, counted))
            shaded = np.zeros(self.image.shape)
            shaded[self.valid] = np.log(self.shaded + DARK)
            self.patch = patches(everywhere, shaded, self.valid)[self.valid]
            self.area = np.bincount(self.patch)
            apart = self._common_first(take_apart(logarithms, self.normals, self.patch, PATCH))
            paint, known = np.zeros((len(self.area), 3)), np.zeros(len(self.area), dtype=bool)
            paint[apart.chosen], known[apart.chosen] = apart.paints, True
            flat, counted = np.exp(logarithms - paint[self.patch]) - DARK, known[self.patch]
            if counted.mean() < 0.2:
                counted[:] = True  # nothing but texture
        self.shaded = self.corners.look_up(self._levels(flat, counted))
        self._name(apart)

    def _common_first(self, apart: TwoWay) -> TwoWay:
        """The same with the paint that most of the area shares as 0."""
        if not len(apart.chosen):
            return apart
        area = self.area[apart.chosen]
        near: NDArray[np.bool_] = np.all(np.abs(apart.paints[:, None] - apart.paints[None]) < STEP, axis=-1)
        own = near[int((near @ area).argmax())]
        return TwoWay(apart.chosen, apart.paints - np.average(apart.paints[own], axis=0, weights=area[own]))

    def _name(self, apart: TwoWay) -> None:
        """Make ratios of the paints that patches share; ``fixed`` is the one that each pixel's patch has, -1 where it has none."""
        area = self.area[apart.chosen].astype(np.float64)
        label = np.full(len(area), -1)
        label[np.abs(apart.paints).max(axis=-1, initial=0.0) < STEP] = 0
        while (label < 0).any() and len(self.ratios) <= MOST:
            near = (np.abs(apart.paints[:, None] - apart.paints[None]) < 1.5 * STEP).all(axis=-1) & (label < 0)
            share = near @ area * (label < 0)
            best = int(share.argmax())
            if share[best] < SHARE * len(self.colors):
                break
            label[near[best]] = len(self.ratios)
            self.ratios.append(np.average(apart.paints[near[best]], axis=0, weights=area[near[best]]))
        found = np.full(len(self.area), -1)
        found[apart.chosen] = label
        self.fixed = found[self.patch]

    def _levels(self, flat: Array, counted: NDArray[np.bool_]) -> Array:
        """The picture of the sphere from a quantile in each cell of directions."""
        _, levels, place, count = group_quantiles(direction_cells(self.normals[counted]), flat[counted], LIT)
        where = np.stack([summed(place, self.normals[counted, c], len(count)) for c in range(3)], axis=-1)
        where /= np.linalg.norm(where, axis=-1, keepdims=True)
        return solve(where, levels.clip(0.0, 1.0), np.sqrt(count), GRID, 0.05)

    def find_paints(self) -> None:
        """Add ratios that many unexplained pixels share."""
        rest = self._costs().min(axis=0) > 9.0
        least = max(SHARE * len(self.colors), 30.0)
        while rest.sum() > least and len(self.ratios) <= MOST:
            ratios = _ratios(self.colors[rest], self.shaded[rest])
            middle, count = _mode(ratios)
            if count < least:
                return
            if min(np.abs(middle - known).max() for known in self.ratios) > STEP:
                self.ratios.append(middle)
            rest[np.flatnonzero(rest)[(np.abs(ratios - middle) < STEP).all(axis=-1)]] = False

    def _costs(self) -> Array:
        """(K, N) squared deviations of the pixels from each paint, in units of the noise."""
        return np.stack([np.square(self.colors - ((self.shaded + DARK) * np.exp(ratio) - DARK)).mean(axis=-1) for ratio in self.ratios]) / (
            self.noise**2
        )

    def assign(self) -> None:
        """Give every pixel the paint that explains it and its neighbours; what none explains gets `NONE`.

        A large patch of another paint keeps it: light that lies on top of the paint is why a ratio does not explain it all.
        """
        alone = np.minimum(self._costs(), 25.0)
        planes = np.zeros((len(alone), *self.valid.shape))
        planes[:, self.valid] = alone
        inside = self.valid.astype(np.float64)
        together = np.stack([_blurred(plane, inside)[self.valid] for plane in planes]) + 0.5 * alone
        labels = together.argmin(axis=0)
        labels[np.take_along_axis(alone, labels[None], 0)[0] >= 16.0] = NONE
        self.labels = np.where(self.fixed > 0, self.fixed, labels)

    def update(self) -> None:
        """The ratios, the noise and the picture of the sphere from the pixels that each paint has."""
        for k in range(1, len(self.ratios)):
            own = self.labels == k
            if own.sum() >= 10:
                self.ratios[k] = np.median(_ratios(self.colors[own], self.shaded[own]), axis=0)
        own = self.labels == 0
        if own.any():
            deviation = np.sqrt(np.square(self.colors[own] - self.shaded[own]).mean(axis=-1))
            self.deviation = 1.2 * float(np.median(deviation))
            self.noise = min(max(self.deviation, NOISE), 0.08)
        weights, flat = self.flattened()
        self.shaded = self.corners.look_up(solve(self.normals, flat, weights, GRID, 0.05))

    def flattened(self) -> tuple[Array, Array]:
        """Weights (N,) and colours (N, 3) as if all were the common paint."""
        table = np.exp(np.array([*self.ratios]))
        labels = np.where(self.labels == NONE, 0, self.labels)
        ratio = table[labels]
        flat = ((self.colors + DARK) / ratio - DARK).clip(0.0, 1.0)
        other = OTHER * np.minimum(ratio, 1.0).mean(axis=-1) ** 2
        weights = np.where(self.labels == 0, 1.0, np.where(self.labels == NONE, 1e-4, other))
        return weights, flat

    def drop_small(self) -> None:
        """Paints that in the end few pixels have."""
        least = SHARE * len(self.colors)
        kept = [0, *(k for k in range(1, len(self.ratios)) if (self.labels == k).sum() >= least)]
        number = np.full(NONE + 1, -1)
        number[kept] = np.arange(len(kept))
        self.ratios = [self.ratios[k] for k in kept]
        self.fixed = number[self.fixed]


def separate(image: Array, normals: Array, valid: NDArray[np.bool_]) -> Separation:
    """Tell the paints and shadows of a photo apart.

    Args:
        image: (H, W, 3) display-encoded.
        normals: (H, W, 3) unit vectors, to the viewer.
        valid: (H, W) the object.
    """
    work = _Separator(image, normals, valid)
    for round_ in range(ROUNDS):
        if round_ < ROUNDS - 2:
            work.find_paints()
        elif round_ == ROUNDS - 2:
            work.drop_small()
        work.assign()
        work.update()
    work.assign()
    weights, flat = work.flattened()
    planes = np.full(valid.shape, -1, dtype=np.int64)
    planes[valid] = work.labels
    all_weights, all_flat = np.zeros(valid.shape), np.zeros(image.shape)
    all_weights[valid], all_flat[valid] = weights, flat
    total = max(len(work.colors), 1)
    paints = tuple(
        Paint((float(r), float(g), float(b)), float((work.labels == k).sum() / total))
        for k, (r, g, b) in enumerate(np.exp(np.array(work.ratios))[1:], start=1)
        if (work.labels == k).sum() >= SHARE * total
    )
    return Separation(planes, paints, all_weights, all_flat, work.deviation)
