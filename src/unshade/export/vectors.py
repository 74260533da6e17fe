"""Parametric leaves as vector art: flat fills, linear gradients, and radial gradients with a focus. No pixels.

Three ways to draw a profile, each measured against it on a grid before one is taken:

- *strips*: at one z a leaf is a linear gradient, so the disc is covered by a few, each faded into the next by a mask that
  depends on z alone. Exact wherever the profile is straight, for a light from anywhere.
- *bands*: where the lines of equal brightness are closed (around the spot of a light that faces the viewer) they are
  ellipses whose centres move. Two of them define a cone, and a radial gradient whose focus is the cone's apex draws all
  that lie between: a chain of such gradients, painted one over the other.
- *steps*: a hard edge is one path along its line; a narrow one is a few, each in one brightness.

All in the frame of a leaf (`profiles`): the unit disc, u along the light, v across it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from unshade.export.profiles import Numbers, Profile

Stops: TypeAlias = "tuple[tuple[float, float], ...]"
"""Offset in [0, 1] and brightness."""


@dataclass(frozen=True)
class Flat:
    """One brightness."""

    value: float


@dataclass(frozen=True)
class Linear:
    """A gradient along u: offset 0 at ``start``, 1 at ``end``, the ends continued."""

    start: float
    end: float
    stops: Stops


@dataclass(frozen=True)
class Radial:
    """A gradient from a focus on the u axis to an ellipse around ``center``, the outer end continued."""

    center: float
    radius: float
    aspect: float
    """Height over width of the ellipse."""
    focus: float
    stops: Stops


Paint: TypeAlias = Flat | Linear | Radial


@dataclass(frozen=True)
class Ellipse:
    """An ellipse around a point of the u axis."""

    center: float
    rx: float
    ry: float


@dataclass(frozen=True)
class Beyond:
    """All of the disc on the light's side of a line of equal brightness that ends at the silhouette.

    The line is the part of ``Ellipse`` from ``(tangent, +-sqrt(1 - tangent^2))`` that faces away from the light.
    """

    ellipse: Ellipse
    tangent: float


@dataclass(frozen=True)
class Ramp:
    """A mask that is 0 at heights z of ``clear`` and over, and 1 at ``full`` and below."""

    clear: float
    full: float


@dataclass(frozen=True)
class Fill:
    """One painted shape; without one, all of the disc."""

    paint: Paint
    shape: Ellipse | Beyond | None = None
    ramp: Ramp | None = None
    multiply: bool = False
    """Multiplied with what is below, not painted over it."""


Drawing: TypeAlias = "tuple[Fill, ...]"

TOLERANCE = 0.0012
"""Root mean square error that a leaf's drawing may have over the disc (58 dB), where one is found."""

KNOTS = 32
"""The heights at which strips stand are multiples of 1/KNOTS, so that leaves share their masks."""

STEEPEST_CONE = 0.97
"""How far from the centre, in radii, the focus of a gradient may lie. Renderers move one beyond the ellipse back into it."""

BYTES = {"strip": 150, "stop": 34, "band": 190, "step": 80}
"""What each part takes in an SVG, about; the smaller drawing is taken."""


@lru_cache(maxsize=4)
def _grid(center: float = 0.0, half: float = 1.0) -> tuple[Numbers, Numbers, Numbers]:
    """u, v and z of places spread over a square's upper half, inside the disc; the lower half is its mirror image."""
    places = (np.arange(96) + 0.5) / 48 - 1.0
    u, v = np.meshgrid(center + half * places, half * places[48:])
    inside = u * u + v * v < 1.0
    u, v = u[inside], v[inside]
    return u, v, np.sqrt(1.0 - u * u - v * v)


def simulate(drawing: Iterable[Fill], u: Numbers, v: Numbers) -> Numbers:
    """The brightness that a drawing has at places of the disc, without antialiasing."""
    z = np.sqrt(np.clip(1.0 - u * u - v * v, 0.0, None))
    found = np.zeros_like(u)
    for fill in drawing:
        painted = _painted(fill.paint, u, v)
        if fill.multiply:
            painted = painted * found
        share = np.ones_like(u) if fill.shape is None else _inside(fill.shape, u, v).astype(np.float64)
        if fill.ramp is not None:
            share = share * np.clip((fill.ramp.clear - z) / (fill.ramp.clear - fill.ramp.full), 0.0, 1.0)
        found = found + share * (painted - found)
    return found


def _painted(paint: Paint, u: Numbers, v: Numbers) -> Numbers:
    if isinstance(paint, Flat):
        return np.full_like(u, paint.value)
    offsets, values = np.array(paint.stops).T
    if isinstance(paint, Linear):
        return np.interp((u - paint.start) / (paint.end - paint.start), offsets, values)
    x, y, shift = u - paint.focus, v / paint.aspect, paint.center - paint.focus
    # The circle through (x, y) of the family around focus + t (center - focus) with radius t * radius.
    room = paint.radius**2 - shift**2
    t = (np.sqrt(np.maximum((x * shift) ** 2 + room * (x * x + y * y), 0.0)) - x * shift) / room
    return np.interp(t, offsets, values)


def _inside(shape: Ellipse | Beyond, u: Numbers, v: Numbers) -> np.ndarray:
    ellipse = shape if isinstance(shape, Ellipse) else shape.ellipse
    within: np.ndarray = ((u - ellipse.center) / ellipse.rx) ** 2 + (v / ellipse.ry) ** 2 <= 1.0
    return within if isinstance(shape, Ellipse) else within | (u >= shape.tangent)


def simplified(
    function: Callable[[Numbers], Numbers], low: float, high: float, tolerance: float, samples: int = 513
) -> list[tuple[float, float]]:
    """The fewest points, about, whose straight lines stay within a tolerance of a function (Douglas and Peucker)."""
    x = np.linspace(low, high, samples)
    y = np.asarray(function(x), dtype=np.float64)
    keep, spans = {0, samples - 1}, [(0, samples - 1)]
    while spans:
        first, last = spans.pop()
        between = np.arange(first + 1, last)
        if not len(between):
            continue
        error = np.abs(y[between] - np.interp(x[between], [x[first], x[last]], [y[first], y[last]]))
        worst = int(error.argmax())
        if error[worst] > tolerance:
            middle = int(between[worst])
            keep.add(middle)
            spans += [(first, middle), (middle, last)]
    return [(float(x[k]), float(y[k])) for k in sorted(keep)]


def _stops(points: list[tuple[float, float]]) -> Stops:
    low, high = points[0][0], points[-1][0]
    return tuple(((x - low) / (high - low), value) for x, value in points)


# Strips


def strips(profile: Profile, top: float = 1.0, tolerance: float = TOLERANCE) -> Drawing:
    """A profile as faded linear gradients; from q = ``top`` on it only has to continue."""
    u, _, z = _grid()
    q = profile.at(u, z)
    counted = q < top
    low, high = float(q.min()), float(min(q.max(), top))
    if not counted.any() or high - low < 1e-6:
        return (Fill(Flat(float(profile.shade(np.array([top]))[0]))),)
    points = simplified(profile.shade, *_varying(profile, low, high), tolerance)
    truth = profile.shade(np.minimum(q, high))
    knots = {0, KNOTS}
    while True:
        drawing = _strips(profile, points, sorted(knots))
        error = np.where(counted, np.abs(simulate(drawing, *_grid()[:2]) - truth), 0.0)
        if math.sqrt(float((error**2).mean())) <= tolerance or len(knots) > KNOTS:
            return drawing
        ordered = np.array(sorted(knots))
        place = np.clip(np.searchsorted(ordered, z * KNOTS) - 1, 0, len(ordered) - 2)
        squares = np.bincount(place, error**2, len(ordered) - 1) * (np.diff(ordered) > 1)
        worst = int(squares.argmax())
        if squares[worst] == 0.0:
            return drawing
        knots.add(int(ordered[worst] + ordered[worst + 1]) // 2)


def _varying(profile: Profile, low: float, high: float) -> tuple[float, float]:
    """The part of a range outside of which the brightness stays the same. Some renderers know 256 places on a gradient."""
    q = np.linspace(low, high, 1001)
    shaded = profile.shade(q)
    first = int(np.argmax(np.abs(shaded - shaded[0]) > 5e-4))
    last = len(q) - 1 - int(np.argmax(np.abs(shaded - shaded[-1])[::-1] > 5e-4))
    return (float(q[max(first - 1, 0)]), float(q[min(last + 1, len(q) - 1)])) if last > 0 and first <= last else (low, high)


def _strips(profile: Profile, points: list[tuple[float, float]], knots: list[int]) -> Drawing:
    """From the middle of the disc (z = 1) out."""
    low, high = points[0][0], points[-1][0]
    stops, fills = _stops(points), []
    for k, knot in reversed(list(enumerate(knots))):
        ramp = None if k == len(knots) - 1 else Ramp(knots[k + 1] / KNOTS, knot / KNOTS)
        a, b = (float(number) for number in profile.line(knot / KNOTS))
        if a * 2.0 < 0.004 * (high - low):
            fills.append(Fill(Flat(float(profile.shade(np.clip([b], low, high))[0])), ramp=ramp))
        else:
            fills.append(Fill(Linear((low - b) / a, (high - b) / a, stops), ramp=ramp))
    return tuple(fills)


# Bands


def contour(profile: Profile, q: float) -> Ellipse:
    """The closed line of this q: exact for n.l, for a mirrored profile the ellipse of the same width and height."""
    q = min(max(q, -1.0), 1.0)
    if not profile.mirrored:
        radius = math.sqrt(1.0 - q * q)
        return Ellipse(q * profile.rho, radius * profile.lz, radius)
    opening, tilt = math.acos(q), math.atan2(profile.rho, profile.lz)
    near, far = math.sin((tilt - opening) / 2), math.sin((tilt + opening) / 2)
    turn = np.linspace(0.0, math.pi, 181)
    across = math.sin(opening) * np.sin(turn)
    along = math.cos(opening) * math.cos(tilt) - math.sin(opening) * np.cos(turn) * math.sin(tilt)
    # The normal halfway between the viewer and a mirrored direction of height ``along``.
    height = float((across / np.sqrt(np.maximum(2.0 + 2.0 * along, 1e-12))).max())
    return Ellipse((near + far) / 2, (far - near) / 2, height)


def bands(profile: Profile, low: float, count: int, tolerance: float = TOLERANCE) -> Drawing | None:
    """The brightness inside the line q = ``low`` as a chain of gradients; None where the lines are no cone's."""
    opening = math.acos(min(max(low, -1.0), 1.0))
    ellipses = [contour(profile, math.cos(opening * (1.0 - k / count))) for k in range(count + 1)]
    fills = []
    for outer, inner in pairwise(ellipses):
        share = inner.rx / outer.rx
        focus = (inner.center - share * outer.center) / (1.0 - share)
        if abs(focus - outer.center) > STEEPEST_CONE * outer.rx:
            return None

        def along(t: Numbers, outer: Ellipse = outer, focus: float = focus) -> Numbers:
            """The mean over the two ends and the two sides of the ellipse of offset t."""
            middle, ends = focus + t * (outer.center - focus), np.zeros_like(t)
            for u, v in ((middle - t * outer.rx, 0.0), (middle + t * outer.rx, 0.0), (middle, t * outer.ry), (middle, t * outer.ry)):
                ends += profile.shade(profile.at(u, np.sqrt(np.clip(1.0 - u * u - v * v, 0.0, 1.0)))) / 4
            return ends

        points = simplified(along, share, 1.0, tolerance, 129)
        fills.append(Fill(Radial(outer.center, outer.rx, outer.ry / outer.rx, focus, tuple(points)), outer))
    return tuple(fills)


# Steps


def steps(profile: Profile, count: int) -> Drawing:
    """A profile of n.l in flat brightnesses, at most ``count`` from end to end, each within its line."""
    q = np.linspace(-1.0, 1.0, 8001)
    shaded = profile.shade(q)
    low, height = float(shaded.min()), float(np.ptp(shaded))
    level = np.round((shaded - low) * (count / height)).astype(int) if height > 0 else np.zeros(len(q), dtype=int)
    levels = low + np.arange(count + 1) * (height / count)
    fills = [Fill(Flat(float(levels[level[q <= -profile.rho][-1]] if profile.rho < 1 else levels[level[0]])))]
    for k in np.flatnonzero(np.diff(level)):
        edge = float(q[k] + q[k + 1]) / 2
        if edge <= -profile.rho:
            continue
        ellipse = contour(profile, edge)
        shape = ellipse if edge >= profile.rho else Beyond(ellipse, edge / profile.rho)
        fills.append(Fill(Flat(float(levels[level[k + 1]])), shape))
    return tuple(fills)


# The choice


def size(drawing: Drawing) -> int:
    """About how many bytes a drawing takes; stops that several strips share count once."""
    shared = {fill.paint.stops for fill in drawing if isinstance(fill.paint, Linear)}
    total = BYTES["stop"] * sum(len(stops) for stops in shared)
    for fill in drawing:
        if isinstance(fill.paint, Radial):
            total += BYTES["band"] + BYTES["stop"] * len(fill.paint.stops)
        else:
            total += BYTES["step" if fill.shape is not None else "strip"]
    return total


def error(profile: Profile, drawing: Drawing, center: float = 0.0, half: float = 1.0) -> float:
    """Root mean square over the disc, or over a square of it around ``(center, 0)``."""
    u, v, z = _grid(center, half)
    return math.sqrt(float(((simulate(drawing, u, v) - profile.shade(profile.at(u, z))) ** 2).mean()))


def _spot(profile: Profile) -> tuple[float, float]:
    """Middle and half width of the square around the spot of a light, where its picture is not dark."""
    q = np.linspace(-1.0, 1.0, 4001)
    lit = profile.shade(q) > 0.02 * profile.shade(np.ones(1))
    ellipse = contour(profile, float(q[lit].min()) if lit.any() else -1.0)
    return round(ellipse.center, 3), min(max(round(1.1 * ellipse.ry, 3), 0.01), 1.0)


def drawn(profile: Profile, tolerance: float = TOLERANCE) -> Drawing:
    """The smallest drawing of a profile within the tolerance, or the nearest to it.

    A small spot is a small part of the disc, so that it is measured for itself too, with four times the tolerance.
    """
    spot = _spot(profile)
    near: tuple[float, Drawing] = (math.inf, ())
    good: tuple[float, Drawing] = (math.inf, ())
    for series in _series(profile, tolerance):
        for drawing, price in series:
            cost = price * size(drawing)
            if cost >= good[0]:
                break
            worst = error(profile, drawing) / tolerance
            if not profile.edged and spot[1] < 0.6:
                worst = max(worst, error(profile, drawing, *spot) / (4.0 * tolerance))
            if worst <= 1.3:
                good = (cost, drawing)
                break
            near = min(near, (worst, drawing), key=lambda found: found[0])
    return good[1] or near[1]


def _series(profile: Profile, tolerance: float) -> Iterator[Iterator[tuple[Drawing, float]]]:
    """Ways to draw a profile, each from coarse to fine, with a price on the size: steps can be seen, gradients cannot."""
    if profile.edged and profile.spread < 2e-3:
        yield iter([(steps(profile, 1), 1.0)])
        return
    yield iter([(strips(profile, tolerance=tolerance), 1.0)])
    if profile.edged and profile.spread < 0.4:
        yield ((steps(profile, count), 1.6) for count in (16, 32, 48))
    floor = -profile.lz if profile.mirrored else profile.rho
    for share in (0.0, 0.04, 0.15, 0.4, 0.8, 0.95, 0.99):
        low = floor + 1e-3 + share * (1.0 - floor)
        if low < 1.0 - 1e-6:
            yield _chained(profile, low, tolerance)


def _chained(profile: Profile, low: float, tolerance: float) -> Iterator[tuple[Drawing, float]]:
    """Strips outside of the line q = ``low``, ever more bands inside."""
    below: Drawing = ()
    for count in (1, 2, 3, 4, 6, 9, 12):
        inside = bands(profile, low, count, tolerance)
        if inside is not None:
            below = below or strips(profile, low, tolerance)
            yield below + inside, 1.0
