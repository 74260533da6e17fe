"""The curve of error over size as an SVG whose points choose a tree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from unshade.labels import decibels

WIDTH, HEIGHT = 720.0, 390.0
LEFT, RIGHT, TOP, BOTTOM = 52.0, 24.0, 26.0, 62.0
PERFECT = 80.0
"""A render without an error has no finite PSNR; it is drawn here, in dB."""


@dataclass(frozen=True)
class Point:
    """A tree on the curve. ``open`` says that the page holds it and so that it can be chosen."""

    key: str
    values: int
    psnr: float
    open: bool
    chosen: bool
    other: bool
    """An alternative, which is not on the curve itself."""


def ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers between two bounds, about so many."""
    raw = (high - low) / max(about, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = max(next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw * 0.999), 1.0)
    return [step * index for index in range(math.ceil(low / step), math.floor(high / step) + 1)]


def chart(points: Sequence[Point]) -> str:
    """The chart as inline SVG: a group of radio buttons to a screen reader and the keyboard.

    Args:
        points: the family from small to large, and its alternatives.
    """
    heights = [min(point.psnr, PERFECT) for point in points]
    low, high = math.floor(min(heights) - 1.0), math.ceil(max(heights) + 1.0)
    widest = max(max(point.values for point in points) * 1.04, 8.0)

    def across(values: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * values / widest

    def up(psnr: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (min(psnr, PERFECT) - low) / (high - low)

    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="radiogroup" aria-label="Trees of the family by size and closeness">'
    ]
    for tick in ticks(low, high, 5):
        parts.append(f'<path class="grid" d="M{LEFT:g} {up(tick):.1f}H{WIDTH - RIGHT:g}"/>')
        parts.append(f'<text x="{LEFT - 10:g}" y="{up(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in ticks(0.0, widest, 8):
        parts.append(f'<text x="{across(tick):.1f}" y="{HEIGHT - BOTTOM + 24:g}" text-anchor="middle">{tick:g}</text>')
    parts.append(f'<text class="axis" x="{LEFT - 10:g}" y="12" text-anchor="end">dB</text>')
    parts.append(f'<text class="axis" x="{WIDTH - RIGHT:g}" y="{HEIGHT - 6:g}" text-anchor="end">values that the tree stores</text>')
    path = "L".join(f"{across(point.values):.1f} {up(point.psnr):.1f}" for point in points if not point.other)
    parts.append(f'<path class="curve" d="M{path}"/>')
    parts += [_mark(point, across(point.values), up(point.psnr)) for point in points]
    return "".join([*parts, "</svg>"])


def _mark(point: Point, x: float, y: float) -> str:
    words = f"{point.values} values, {decibels(point.psnr)}{', chosen' if point.chosen else ', an alternative' if point.other else ''}"
    if not point.open:
        return f'<circle class="shut" cx="{x:.1f}" cy="{y:.1f}" r="2.5"><title>{words}</title></circle>'
    place = f'cx="{x:.1f}" cy="{y:.1f}"'
    shape = f'<path class="dot" d="M{x:.1f} {y - 6:.1f}l6 6l-6 6l-6 -6z"/>' if point.other else f'<circle class="dot" {place} r="5"/>'
    state = f'aria-checked="{"true" if point.chosen else "false"}" tabindex="{0 if point.chosen else -1}"'
    return (
        f'<g class="point" role="radio" data-show="{point.key}" {state} aria-label="{words}"><title>{words}</title>'
        f'<circle class="reach" {place} r="14"/><circle class="halo" {place} r="10"/>{shape}</g>'
    )
