"""Drawn edges: an edge of a mask is a circle on the sphere, where a plane ``n.d = t`` cuts it.

A reflected photograph hides which paints a ball has, but not where they end: hardly a photograph jumps from one pixel to the next.
Places of such jumps lie on circles, which random sampling finds to a few hundredths of a pixel (RANSAC; Fischler and Bolles 1981).
Where a picture was scaled or its edges are smoothed, a jump takes up to three steps; such are looked for as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from unshade.nodes import Leaf, leaf
from unshade.sphere import SCORED_RADIUS, disc_mask
from unshade.types import Image, Mask

JUMP = 0.02
"""Least jump of log(1 - picture) between two pixels."""

ALONE = 2.5
"""Times that a jump is larger than the steps on either side of it."""

ROUNDED = 1.2 / 255.0
"""What two rounded pixels may differ by."""

TRIES = 4000
"""Triples of places that are tried for a circle."""

ON = 1.0
"""Pixels from a circle within which a place is on it."""

PLACES = 25
"""Least places of a circle."""

SHARE = 0.12
"""Least share of the visible circle near which there are any: paints may look alike along the rest."""

STRAY = 0.45
"""Most root mean square distance of a circle's places, in pixels: rounding to pixels makes 0.3."""

PARALLEL = 0.95
"""Cosine from which two circles may be a stripe."""

STRIPE_STRAY = 0.7
"""`STRAY` of two circles in parallel planes."""

MOST = 5
"""Circles of a picture."""

WIDEST = 3
"""Steps between pixels that a jump may take."""

UNLIT = 0.15
"""What must be missing to white where a jump takes several steps: a highlight falls as fast from white, and its edge is a circle too."""

DENSE = 0.75
"""Least share of the rows and columns crossed by a circle, where it has places, that have one: clutter is sparser."""

SCORED = 1000
"""Most places that tried circles are judged by."""

FAILED = 10
"""Circles that may turn out to be none before the search for more is given up."""

EDGE = 3
"""Pixels at the border of a picture without places: what is next to them is not known."""

CHANCE = 3.0
"""Times as many places as would lie on a circle by chance, if they were everywhere, as in grain."""


@dataclass(frozen=True, eq=False)
class Circle:
    """A plane with the places (P, 3) that lie on it."""

    normal: torch.Tensor
    offset: float
    places: torch.Tensor


def edge_masks(image: Image, valid: Mask, seed: int = 0) -> list[Leaf]:
    """The hard masks whose edges a picture shows, those with the longest edges first: two parallel edges are a stripe.

    Args:
        image: (3, H, H) in [0, 1], without grain. valid: (1, H, H), pixels that count.
    """
    return masks_of(edge_circles(image, valid, seed), image.shape[-1])


def masks_of(circles: Sequence[Circle], size: int) -> list[Leaf]:
    """The masks that end at circles of a picture of ``size``."""
    found: list[tuple[int, Leaf]] = []
    waiting = list(circles)
    while waiting:
        first = waiting.pop(0)
        stripe = next((pair for second in waiting if (pair := _stripe(first, second, size))), None)
        if stripe is None:
            found.append((len(first.places), leaf("threshold", direction=first.normal.tolist(), threshold=first.offset, softness=0.0)))
        else:
            waiting.remove(stripe[0])
            found.append((len(first.places) + len(stripe[0].places), stripe[1]))
    return [mask for _, mask in sorted(found, key=lambda entry: -entry[0])]


def edges_left(circles: Sequence[Circle], before: Image, after: Image) -> float:
    """How much of the jumps of a picture along its circles another picture still shows: 0 for nothing, 1 for all, the median place."""
    if not circles:
        return 0.0
    size = before.shape[-1]
    x, y, _ = torch.cat([circle.places for circle in circles]).T
    row, column = (((1.0 - y) * 0.5 * size - 0.5).round().long(), ((x + 1.0) * 0.5 * size - 0.5).round().long())
    jumps = []
    for image in (before, after):
        log = (1.0 - image.double()).clamp(min=0.5 / 255.0).log()
        around = F.max_pool2d(log, 3, stride=1, padding=1) + F.max_pool2d(-log, 3, stride=1, padding=1)
        jumps.append(around.amax(0)[row, column])
    return float((jumps[1] / jumps[0].clamp(min=1e-9)).median())


def edge_circles(image: Image, valid: Mask, seed: int = 0) -> list[Circle]:
    """The circles of `edge_masks`, at most `MOST`, in the order they were found."""
    sharp, smooth = (
        _circles(edge_places(image, valid, widest), image.shape[-1], torch.Generator().manual_seed(seed)) for widest in (1, WIDEST)
    )
    return smooth if len(smooth) > len(sharp) else sharp


def _circles(places: torch.Tensor, size: int, generator: torch.Generator) -> list[Circle]:
    """Circles that places (P, 3) of a picture of ``size`` lie on, one after the other."""
    found: list[Circle] = []
    failed = 0
    while len(found) < MOST and failed < FAILED and len(places) >= PLACES:
        circle = _likeliest(places, size, generator)
        if circle is None:
            break
        away = _distance(places, circle.normal[None], torch.tensor([circle.offset]), size)[:, 0]
        share, length = _seen(circle, size)
        by_chance = len(places) / (0.25 * math.pi * size * size) * 2.4 * ON * length
        stray = float(away[away < 1.2 * ON].square().mean().sqrt())
        dense = len(circle.places) > DENSE * share * length
        if stray < STRAY and share > SHARE and dense and len(circle.places) > CHANCE * by_chance:
            found.append(circle)
        else:
            failed += 1
        places = places[away >= 2.0 * ON]
    return found


def edge_places(image: Image, valid: Mask, widest: int = 1) -> torch.Tensor:
    """Unit normals (P, 3) where log(1 - image) jumps in any channel, within ``widest`` steps, and does not on either side.

    A jump of one step is half-way between two pixels; that of several is where their mean step is, which is exact for an edge whose
    pixels are averages.
    """
    size = image.shape[-1]
    dark = (1.0 - image.double()).clamp(min=0.5 / 255.0)
    inside = (valid & disc_mask(size, SCORED_RADIUS, image.device))[0].clone()
    inside[:EDGE], inside[-EDGE:], inside[:, :EDGE], inside[:, -EDGE:] = False, False, False, False
    unlit = inside & (dark.amin(0) > UNLIT)
    found = []
    for axis in (1, 0):
        step = _next(dark.log(), 1, axis) - dark.log()
        told = torch.zeros_like(inside)
        for width in range(1, widest + 1):
            steps = torch.stack([_next(step, k, axis) for k in range(width)])
            jump = steps.sum(0)
            around = torch.stack([_next(step, k, axis).abs() for k in (-2, -1, width, width + 1)]).amax(0)
            noise = ROUNDED * (1.0 / dark + 1.0 / _next(dark, width, axis))
            onward = (steps * jump.sign() >= 0.0).all(0)
            jumps = (jump.abs() > ALONE * around + noise) & (jump.abs() > JUMP) & onward
            known = torch.stack([_next(inside if width == 1 else unlit, k, axis) for k in range(-2, width + 3)]).all(0)
            # A wide window over a jump that is told already says nothing new.
            fresh = jumps.any(0) & known & ~torch.stack([_next(told, k, axis) for k in range(1 - width, width)]).any(0)
            told |= fresh
            row, column = fresh.nonzero().T
            middle = _middle(dark, jump, width, axis)[row, column]
            x = 2.0 * (column + 0.5 + (middle if axis == 1 else 0.0)) / size - 1.0
            y = 1.0 - 2.0 * (row + 0.5 + (middle if axis == 0 else 0.0)) / size
            found.append(torch.stack([x, y, (1.0 - x * x - y * y).clamp(min=0.0).sqrt()], 1))
    return torch.cat(found)


def _middle(dark: Image, jump: Image, width: int, axis: int) -> torch.Tensor:
    """Where a jump of so many steps is, in pixels from the first (H, H), in the channel where it is largest."""
    channel = jump.abs().argmax(0, keepdim=True)
    values = torch.stack([_next(dark, k, axis).gather(0, channel)[0] for k in range(width + 1)])
    whole = values[-1] - values[0]
    return sum((k + 0.5) * (values[k + 1] - values[k]) for k in range(width)) / torch.where(whole == 0.0, 1.0, whole)


def _next(values: torch.Tensor, step: int, axis: int) -> torch.Tensor:
    """The values so many rows (axis 0) or columns (axis 1) further on; what comes in from the other side is at the border."""
    return values.roll(-step, axis - 2)


def _likeliest(places: torch.Tensor, size: int, generator: torch.Generator) -> Circle | None:
    """The circle through three places that most others lie on, settled by them; None where they are too few."""
    a, b, c = places[torch.randint(len(places), (TRIES, 3), generator=generator)].unbind(1)
    normals = torch.linalg.cross(b - a, c - a)
    lengths = normals.norm(dim=1)
    usable = lengths > 1e-3
    if not bool(usable.any()):
        return None
    normals = normals[usable] / lengths[usable, None]
    offsets = (normals * a[usable]).sum(1)
    judges = places[torch.randperm(len(places), generator=generator)[:SCORED]] if len(places) > SCORED else places
    best = int((_distance(judges, normals, offsets, size) < ON).sum(0).argmax())
    normal, offset = normals[best], float(offsets[best])
    for _ in range(6):
        near = places[_distance(places, normal[None], torch.tensor([offset]), size)[:, 0] < ON]
        if len(near) < PLACES:
            return None
        normal, (offset,) = _planes([near])
    return Circle(normal, offset, places[_distance(places, normal[None], torch.tensor([offset]), size)[:, 0] < 1.2 * ON])


def _planes(groups: list[torch.Tensor]) -> tuple[torch.Tensor, list[float]]:
    """The common normal of parallel planes through groups of places, and the offset of each."""
    scatter, means = torch.zeros(3, 3, dtype=torch.float64), []
    for places in groups:
        weight = places[:, 2:].clamp(min=0.1)  # a pixel at the silhouette says little of where it is
        mean = (places * weight).sum(0) / weight.sum()
        apart = (places - mean) * weight
        scatter += apart.T @ (places - mean)
        means.append(mean)
    normal = torch.linalg.eigh(0.5 * (scatter + scatter.T))[1][:, 0]
    return normal, [float(mean @ normal) for mean in means]


def _distance(places: torch.Tensor, normals: torch.Tensor, offsets: torch.Tensor, size: int) -> torch.Tensor:
    """From places (P, 3) to circles (K, 3), (K,) in pixels of the picture, (P, K)."""
    away = places @ normals.T - offsets
    down = normals[:, 2] / places[:, 2:].clamp(min=0.05)
    slope = torch.hypot(normals[:, 0] - down * places[:, :1], normals[:, 1] - down * places[:, 1:2])
    return away.abs() / slope.clamp(min=0.05) * (0.5 * size)


def _seen(circle: Circle, size: int) -> tuple[float, float]:
    """Share of what is visible of a circle that has places of it within three pixels, and how many rows and columns that crosses."""
    angle = torch.linspace(0.0, 2.0 * math.pi, 513, dtype=torch.float64)[:-1, None]
    helper = torch.eye(3, dtype=torch.float64)[int(circle.normal.abs().argmin())]
    across = F.normalize(torch.linalg.cross(circle.normal, helper), dim=0)
    ring = angle.cos() * across + angle.sin() * torch.linalg.cross(circle.normal, across)
    radius = math.sqrt(max(1.0 - circle.offset**2, 0.0))
    points = circle.offset * circle.normal + radius * ring
    seen = (points[:, 2] > 0.02) & (points[:, :2].norm(dim=1) < SCORED_RADIUS)
    if not bool(seen.any()):
        return 0.0, 0.0
    near = torch.cdist(points[seen], circle.places).amin(1) < 6.0 / size
    crossed = (points.roll(-1, 0) - points)[seen, :2].abs().sum()
    return float(near.double().mean()), float(crossed) * 0.5 * size


def _stripe(first: Circle, second: Circle, size: int) -> tuple[Circle, Leaf] | None:
    """The second circle and the stripe between the two, if they are parallel."""
    if abs(float(first.normal @ second.normal)) < PARALLEL:
        return None
    groups = [first.places, second.places]
    normal, offsets = _planes(groups)
    for places, offset in zip(groups, offsets, strict=True):
        if float(_distance(places, normal[None], torch.tensor([offset]), size).square().mean().sqrt()) > STRIPE_STRAY:
            return None
    low, high = sorted(offsets)
    return second, leaf("stripe", direction=normal.tolist(), center=0.5 * (low + high), width=high - low, softness=0.0)
