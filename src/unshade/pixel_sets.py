"""The pixels that a search works on."""

from __future__ import annotations

from unshade.atoms import dictionary_of
from unshade.fit.least_squares import COARSE_SIZE
from unshade.fit.pixels import Pixels
from unshade.growth import Samples
from unshade.pictures import SphereImage

POINTS = 2500
"""Points of the full picture on which trees grow once they are good."""


def samples_of(sphere: SphereImage, fine: int, seed: int) -> Samples:
    """What a search works on: coarse averages, points of the full picture, and ``fine`` more points where it changes most."""
    coarse = Pixels.of(sphere.image, sphere.valid, COARSE_SIZE)
    points = Pixels.points(sphere.image, sphere.valid, POINTS, seed)
    important = Pixels.important(sphere.image, sphere.valid, fine, seed)
    return Samples(coarse, points, important, dictionary_of(coarse), dictionary_of(points))
