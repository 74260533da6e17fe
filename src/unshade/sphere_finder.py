"""Where the sphere is in a picture: from alpha, as a circle on a plain background, or as a full-frame MatCap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PILImage

Array: TypeAlias = NDArray[np.float64]

WORKING_SIDE = 192
"""The longer side of the copy in which the circle is first looked for."""

ANGLES = 360
"""Rays along which a circle's edge is measured."""

MIN_COVERAGE = 0.45
"""Share of the circle that must show as an edge."""

MIN_RADIUS = 5.0
"""Smallest sphere that is looked for, in pixels."""

ONE_COLOR = 0.5 / 255.0
"""A picture that varies less than this, root mean square, is all one colour: wherever its sphere is, it looks the same."""

SNAP = 0.015
"""A circle this close to the inscribed disc of a square picture, as a share of its radius, is that disc."""

SNAP_OUTSIDE = 0.05
"""The same for a circle that leaves the frame: then it was measured on the few arcs that the corners show."""


@dataclass(frozen=True)
class Disc:
    """The sphere's silhouette in pixels of the picture: ``cx`` to the right and ``cy`` down from the top left corner.

    ``score`` in [0, 1] says how sure the place is; 1 for one that was given.
    """

    cx: float
    cy: float
    r: float
    score: float = 1.0


def inscribed_disc(width: int, height: int, score: float = 1.0) -> Disc:
    """The largest disc of the frame."""
    return Disc(width / 2, height / 2, min(width, height) / 2, score)


def disc_of_alpha(alpha: Array) -> Disc | None:
    """The disc of a silhouette, None where its outline is no circle.

    Args:
        alpha: (H, W) in [0, 1].
    """
    solid = alpha > 0.5
    if solid.sum() < 50:
        return None
    points = _outline(_largest_component(solid))
    start = _ransac_circle(points)
    if start is None:
        return None
    padded = np.pad(alpha, 8)[..., None].astype(np.float64)
    circle = _refine(padded, (start[0] + 8, start[1] + 8, start[2]), reach=max(3.0, 0.04 * start[2]))
    if circle is None:
        return None
    cx, cy, r, coverage, spread = circle
    if coverage < 0.6 or spread > max(0.35, 0.01 * r):
        return None
    frame = inscribed_disc(alpha.shape[1], alpha.shape[0], coverage)
    disc = Disc(cx - 8, cy - 8, r, coverage)
    # Measured to a few hundredths of a pixel; a picture cut to its sphere is then taken as it is, without resampling.
    return frame if max(abs(disc.cx - frame.cx), abs(disc.cy - frame.cy), abs(disc.r - frame.r)) < 0.1 else disc


def find_disc(rgb: Array) -> Disc | None:
    """The sphere in an opaque picture; None where there is none to be found.

    Args:
        rgb: (H, W, 3) display-encoded.
    """
    height, width = rgb.shape[:2]
    square = abs(width - height) <= 1
    circle = find_circle(rgb)
    if circle is not None:
        frame = inscribed_disc(width, height)
        apart = max(abs(circle.r - frame.r), np.hypot(circle.cx - frame.cx, circle.cy - frame.cy)) / frame.r
        if square and apart < (SNAP_OUTSIDE if _leaves(circle, width, height) else SNAP):
            return Disc(frame.cx, frame.cy, frame.r, circle.score)
        return circle
    if square:
        score = smoothness(rgb)
        if score > 0.0:
            return inscribed_disc(width, height, score)
    if float(rgb.reshape(-1, 3).std(axis=0).max()) < ONE_COLOR:
        return inscribed_disc(width, height, 0.0)
    return None


def _leaves(circle: Disc, width: int, height: int) -> bool:
    return min(circle.cx, circle.cy, width - circle.cx, height - circle.cy) < circle.r - 0.5


def smoothness(rgb: Array) -> float:
    """How much a square picture looks like shading: 0 for noise, text or a pattern, up to 1.

    It is the share of the variance that 12 x 12 cosines explain, counted from a half. Real MatCaps, mirrors and stone
    included, reach 0.75 and more, noise and text stay under 0.3. A picture that hardly varies is smooth.
    """
    small = _resized(rgb, 64, 64)
    steps = (np.arange(64) + 0.5) / 64
    basis = np.array([np.cos(np.pi * k * steps) for k in range(12)])
    basis /= np.linalg.norm(basis, axis=1, keepdims=True)
    project = basis.T @ basis
    rest = small - np.stack([project @ small[..., c] @ project for c in range(3)], axis=-1)
    error, variance = float(np.square(rest).mean()), float(np.square(small - small.mean((0, 1))).mean())
    if error < 0.012**2:
        return 1.0
    return max(0.0, 1.0 - 2.0 * error / variance)


def find_circle(rgb: Array) -> Disc | None:
    """A sphere in front of a plain, graded or noisy background, anywhere in the frame.

    A smooth background is fitted to the border and to what agrees with it; the outline of what differs gives circles
    by consensus of three points; the best is then measured along rays at full resolution. Where no background fits
    (a floor and a wall), the strongest edges of a frame that is not square give the points.

    Args:
        rgb: (H, W, 3) display-encoded.
    """
    height, width = rgb.shape[:2]
    scale = min(1.0, WORKING_SIDE / max(height, width))
    small = _resized(rgb, max(8, round(width * scale)), max(8, round(height * scale)))
    smooth = _smoothed(small)
    sx, sy = small.shape[1] / width, small.shape[0] / height

    def measured(points: Array) -> Disc | None:
        start = _ransac_circle(points)
        return None if start is None else _measured(rgb, (start[0] / sx, start[1] / sy, start[2] / (0.5 * (sx + sy))), 1.0 / min(sx, sy))

    background, noise = _background(smooth)
    distance = np.linalg.norm(smooth - background, axis=-1)
    best: Disc | None = None
    for threshold in (max(4.0 * noise, 0.02), max(8.0 * noise, 0.05), max(12.0 * noise, 0.12)):
        foreground = distance > threshold
        if not 0.005 < foreground.mean() < 0.98:
            continue
        found = measured(_outline(_largest_component(foreground)))
        if found is None or not (_stands_alone(foreground, found, sx, sy) or _plain_outside(small, smooth, found, sx, sy)):
            continue
        if best is None or found.score > best.score + 0.02:
            best = found
    if best is None and abs(width - height) > 1:
        strength, edges = _edges(smooth)
        found = measured(edges)
        if found is not None and found.score > 0.8 and _few_edges_outside(strength, found, sx, sy):
            best = found
    return best


def _measured(rgb: Array, circle: tuple[float, float, float], pixel: float) -> Disc | None:
    """The circle at full resolution, None where too little of it shows as an edge."""
    reach = max(3.0, 2.5 * pixel, 0.05 * circle[2])
    refined: tuple[float, float, float, float, float] | None = None
    for step in range(4):
        refined = _refine(rgb, circle, reach)
        if refined is None:
            return None
        circle = refined[:3]
        reach = max(2.5, 1.5 * pixel if step == 0 else 0.0, 0.02 * circle[2])
    assert refined is not None
    cx, cy, r, coverage, spread = refined
    height, width = rgb.shape[:2]
    if coverage < MIN_COVERAGE or spread > max(0.6, 0.012 * r) or r < MIN_RADIUS or r > 0.75 * max(width, height):
        return None
    return Disc(float(cx), float(cy), float(r), float(coverage))


def _radius(shape: tuple[int, ...], disc: Disc, sx: float, sy: float) -> Array:
    """(h, w) of every pixel of the working copy, the distance from the disc's centre in its radii."""
    rows, columns = np.indices(shape[:2])
    return np.hypot((columns + 0.5) / sx - disc.cx, (rows + 0.5) / sy - disc.cy) / disc.r


def _stands_alone(foreground: NDArray[np.bool_], disc: Disc, sx: float, sy: float) -> bool:
    """True where the background really is background: little of the foreground lies outside the disc (a shadow may,
    beside a circle that shows all around), and most of the disc is foreground."""
    radius = _radius(foreground.shape, disc, sx, sy)
    inside, outside = radius < 0.97, radius > 1.06
    allowed = 0.5 if disc.score > 0.85 else 0.1
    return bool((foreground & outside).sum() < allowed * (radius < 1.0).sum() and foreground[inside].mean() > 0.4)


def _plain_outside(small: Array, smooth: Array, disc: Disc, sx: float, sy: float) -> bool:
    """True where all that lies outside a well visible circle is one smooth surface, of fifth degree at most."""
    outside = _radius(small.shape, disc, sx, sy) > 1.06
    if disc.score < 0.75 or outside.mean() < 0.25:
        return False
    y, x = np.meshgrid(np.linspace(-1, 1, small.shape[0]), np.linspace(-1, 1, small.shape[1]), indexing="ij")
    design, colors = _powers(x[outside], y[outside], 5), smooth[outside]
    weights, *_ = np.linalg.lstsq(design, colors, rcond=None)
    rest = np.linalg.norm(colors - design @ weights, axis=-1)
    noise = float(np.median(np.linalg.norm((small - smooth)[outside], axis=-1)))
    return float(np.percentile(rest, 90)) < max(0.06, 2.0 * noise)


def _edges(smooth: Array) -> tuple[Array, Array]:
    """The strength of the gradient, (h, w), and the (N, 2) places of its sharpest crests."""
    dx = np.zeros(smooth.shape[:2])
    dy = np.zeros(smooth.shape[:2])
    dx[:, 1:-1] = np.linalg.norm(smooth[:, 2:] - smooth[:, :-2], axis=-1)
    dy[1:-1] = np.linalg.norm(smooth[2:] - smooth[:-2], axis=-1)
    strength = np.hypot(dx, dy)
    limit = max(0.03, 0.25 * float(np.percentile(strength, 99)))
    inner = strength[1:-1, 1:-1]
    across = (inner >= strength[1:-1, :-2]) & (inner >= strength[1:-1, 2:]) & (dx >= dy)[1:-1, 1:-1]
    down = (inner >= strength[:-2, 1:-1]) & (inner >= strength[2:, 1:-1]) & (dx < dy)[1:-1, 1:-1]
    crest = np.zeros(strength.shape, dtype=bool)
    crest[1:-1, 1:-1] = (inner > limit) & (across | down)
    rows, columns = np.nonzero(crest)
    points = np.stack([columns + 0.5, rows + 0.5], axis=1)
    return np.where(crest, strength, 0.0), points[:: max(1, len(points) // 1500)]


def _few_edges_outside(strength: Array, disc: Disc, sx: float, sy: float) -> bool:
    """True where the edges outside a circle, as strong as its own, add up to less than twice its length."""
    radius = _radius(strength.shape, disc, sx, sy)
    own = strength[(np.abs(radius - 1.0) < 0.06) & (strength > 0)]
    return bool(own.size) and int((strength[radius > 1.06] > 0.5 * np.median(own)).sum()) < own.size


def _powers(x: Array, y: Array, degree: int) -> Array:
    """(..., terms) the products of powers of two coordinates, lower degrees first."""
    return np.stack([x**i * y ** (total - i) for total in range(degree + 1) for i in range(total + 1)], axis=-1)


def _resized(rgb: Array, width: int, height: int) -> Array:
    """Area-averaged copy."""
    if (rgb.shape[1], rgb.shape[0]) == (width, height):
        return rgb.astype(np.float64)
    planes = [
        np.asarray(PILImage.fromarray(rgb[..., c].astype(np.float32)).resize((width, height), PILImage.Resampling.BOX))
        for c in range(rgb.shape[2])
    ]
    return np.stack(planes, axis=-1).astype(np.float64)


def _smoothed(rgb: Array) -> Array:
    """Binomial 3 x 3."""
    padded = np.pad(rgb, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    return 0.25 * rows[:, :-2] + 0.5 * rows[:, 1:-1] + 0.25 * rows[:, 2:]


def _background(rgb: Array) -> tuple[Array, float]:
    """A cubic surface a channel through the border and what agrees with it, and the robust spread about it."""
    height, width = rgb.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    edge = max(1, round(0.02 * min(height, width)))
    powers = _powers(x, y, 3)
    border = np.ones((height, width), dtype=bool)
    border[edge:-edge, edge:-edge] = False
    member, noise = border, 0.0
    surface = rgb
    for step in range(8):
        # The border alone does not say how a surface bends inside; higher terms join once the background is known.
        terms = powers[..., : 3 if step < 3 else 6 if step < 6 else 10]
        design = terms[member]
        weights = np.linalg.solve(design.T @ design + 1e-9 * np.eye(terms.shape[-1]), design.T @ rgb[member])
        surface = terms @ weights
        distance = np.linalg.norm(rgb - surface, axis=-1)
        noise = float(1.4826 * np.median(distance[member]))
        limit = max(3.0 * noise, 0.01)
        member = (distance < limit) & (border if step < 3 else np.ones_like(border))
        if member.sum() < 20:
            member = border
    return surface, noise


def _largest_component(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest 4-connected set of true pixels, by union of runs."""
    parent: list[int] = []
    runs: list[tuple[int, int, int]] = []

    def root(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    above: list[int] = []
    for row in range(mask.shape[0]):
        changes = np.flatnonzero(np.diff(np.concatenate([[0], mask[row].astype(np.int8), [0]])))
        here = []
        for start, stop in zip(changes[0::2].tolist(), changes[1::2].tolist(), strict=True):
            label = len(runs)
            runs.append((row, start, stop))
            parent.append(label)
            here.append(label)
            for other in above:
                if runs[other][1] < stop and runs[other][2] > start:
                    parent[root(other)] = root(label)
        above = here
    sizes: dict[int, int] = {}
    for label, (_, start, stop) in enumerate(runs):
        sizes[root(label)] = sizes.get(root(label), 0) + stop - start
    largest = np.zeros_like(mask)
    if sizes:
        winner = max(sizes, key=lambda k: sizes[k])
        for label, (row, start, stop) in enumerate(runs):
            if root(label) == winner:
                largest[row, start:stop] = True
    return largest


def _outline(mask: NDArray[np.bool_]) -> Array:
    """(N, 2) x, y of the first and last true pixels of every row and column, as borders between pixels."""
    points = []
    for transposed, array in ((False, mask), (True, mask.T)):
        lines = np.flatnonzero(array.any(axis=1))
        first = array[lines].argmax(axis=1).astype(np.float64)
        last = array.shape[1] - array[lines, ::-1].argmax(axis=1).astype(np.float64)
        for along, inner in ((first, first > 0), (last, last < array.shape[1])):
            pair = (lines[inner] + 0.5, along[inner]) if transposed else (along[inner], lines[inner] + 0.5)
            points.append(np.stack(pair, axis=1))
    return np.concatenate(points)


def _ransac_circle(points: Array) -> tuple[float, float, float] | None:
    """The circle that most of its own circumference supports, by consensus of three points (fixed seed)."""
    if len(points) < 12:
        return None
    generator = np.random.default_rng(0)
    picked = points[generator.integers(0, len(points), (600, 3))]
    a, b, c = picked[:, 0], picked[:, 1], picked[:, 2]
    ab, ac = b - a, c - a
    cross = 2.0 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    usable = np.abs(cross) > 1e-6 * (1.0 + np.abs(ab).sum(1) * np.abs(ac).sum(1)) + 1.0
    ab, ac, cross, a = ab[usable], ac[usable], cross[usable], a[usable]
    if not len(cross):
        return None
    ab2, ac2 = np.square(ab).sum(1), np.square(ac).sum(1)
    ux = (ac[:, 1] * ab2 - ab[:, 1] * ac2) / cross
    uy = (ab[:, 0] * ac2 - ac[:, 0] * ab2) / cross
    centers, radii = a + np.stack([ux, uy], axis=1), np.hypot(ux, uy)
    extent = points.max(0) - points.min(0)
    usable = (radii > 3.0) & (radii < 1.5 * extent.max())
    centers, radii = centers[usable], radii[usable]
    if not len(radii):
        return None
    offset = points[None] - centers[:, None]
    near = np.abs(np.linalg.norm(offset, axis=-1) - radii[:, None]) < np.maximum(1.0, 0.015 * radii)[:, None]
    bins = np.floor((np.arctan2(offset[..., 1], offset[..., 0]) / (2 * np.pi) + 0.5) * 72).astype(int) % 72
    covered = np.zeros((len(radii), 72), dtype=bool)
    which = np.nonzero(near)
    covered[which[0], bins[which]] = True
    # Coverage decides; the share of all points that lie on the circle breaks ties between arcs of one outline.
    support = covered.mean(1) + 0.5 * near.mean(1)
    best = int(support.argmax())
    if covered[best].mean() < 0.3:
        return None
    chosen = points[near[best]]
    cx, cy, r = _algebraic_circle(chosen, np.ones(len(chosen)))
    return cx, cy, r


def _algebraic_circle(points: Array, weights: Array) -> tuple[float, float, float]:
    """Weighted least-squares circle (Kasa 1976), exact for points on one."""
    middle = points.mean(0)
    shifted = points - middle
    root = np.sqrt(weights)
    design = np.stack([2 * shifted[:, 0], 2 * shifted[:, 1], np.ones(len(points))], axis=1) * root[:, None]
    (x, y, k), *_ = np.linalg.lstsq(design, np.square(shifted).sum(1) * root, rcond=None)
    return float(x + middle[0]), float(y + middle[1]), float(np.sqrt(max(k + x * x + y * y, 1e-12)))


def _refine(picture: Array, circle: tuple[float, float, float], reach: float) -> tuple[float, float, float, float, float] | None:
    """Measure the edge along rays across a circle and fit again.

    Args:
        picture: (H, W, C).
        circle: centre and radius to start from.
        reach: pixels inside and outside of it in which the edge is looked for.
    Returns:
        centre, radius, the share of rays that show an edge there, and the robust spread of the edges about the circle
        in pixels; None where too few do.
    """
    cx, cy, r = circle
    height, width = picture.shape[:2]
    angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
    step = 0.25 if reach < 12 else reach / 48
    offsets = np.arange(-reach - 1.0, reach + 1.0 + step / 2, step)
    radii = r + offsets
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    x = cx + directions[:, :1] * radii
    y = cy + directions[:, 1:] * radii
    visible = ((x > 0.5) & (x < width - 0.5) & (y > 0.5) & (y < height - 0.5)).all(axis=1) & (radii[0] > 0)
    if visible.sum() < 0.25 * ANGLES:
        return None
    profile = _bilinear(picture, x[visible], y[visible])
    # Neighbouring rays averaged: an edge goes on along the circle, noise does not.
    lag = max(1, round(1.0 / step))
    slope = profile[:, lag:] - profile[:, :-lag]
    slope = (np.roll(slope, 1, axis=0) + slope + np.roll(slope, -1, axis=0)) / 3.0
    strength = np.linalg.norm(slope, axis=-1)
    at = offsets[lag:] - 0.5 * step * lag
    # The outermost edge that is not weak beside the strongest: a rim light or a drawn outline has a second one inside.
    before, after = np.pad(strength, ((0, 0), (1, 1)))[:, :-2], np.pad(strength, ((0, 0), (1, 1)))[:, 2:]
    outside = strength[:, at > 0.6 * reach]
    rough = max(0.012, 3.0 * float(np.median(outside)))
    crest = (strength >= before) & (strength >= after) & (strength > np.maximum(0.3 * strength.max(axis=1, keepdims=True), rough))
    peak = np.where(crest.any(axis=1), len(at) - 1 - crest[:, ::-1].argmax(axis=1), strength.argmax(axis=1))
    height_of = strength[np.arange(len(peak)), peak]
    window = np.abs(at[None] - at[peak][:, None]) <= 1.0
    weight = np.square(strength) * window
    edge = (weight * at).sum(1) / np.maximum(weight.sum(1), 1e-12)
    contrast = height_of > rough
    interior = (peak > 0) & (peak < len(at) - 1)
    good = contrast & interior
    if good.sum() < 0.2 * ANGLES:
        return None
    points = np.stack([cx, cy], axis=0) + directions[visible] * (r + edge)[:, None]
    weights = good.astype(np.float64)
    residual = edge
    for _ in range(12):
        cx, cy, r = _algebraic_circle(points[good], weights[good])
        residual = np.hypot(points[:, 0] - cx, points[:, 1] - cy) - r
        spread = 1.4826 * float(np.median(np.abs(residual[good])))
        cut = max(3.0 * spread, 0.3)
        weights = np.square(np.clip(1.0 - np.square(residual / cut), 0.0, 1.0))
    agree = good & (np.abs(residual) < max(0.75, 0.02 * r))
    if agree.sum() < 0.2 * ANGLES:
        return None
    return cx, cy, r, float(agree.sum()) / ANGLES, 1.4826 * float(np.median(np.abs(residual[good])))


def _bilinear(picture: Array, x: Array, y: Array) -> Array:
    """(..., C) at pixel positions, pixel centres at half-integers."""
    height, width = picture.shape[:2]
    x, y = np.clip(x - 0.5, 0, width - 1.001), np.clip(y - 0.5, 0, height - 1.001)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = (x - left)[..., None], (y - top)[..., None]
    upper = picture[top, left] * (1 - u) + picture[top, left + 1] * u
    lower = picture[top + 1, left] * (1 - u) + picture[top + 1, left + 1] * u
    return upper * (1 - v) + lower * v
