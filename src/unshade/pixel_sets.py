"""The pixels that a search works on, with dictionaries that pictures of one size share."""

from __future__ import annotations

from functools import lru_cache

import torch

from unshade.atoms import Dictionary
from unshade.fit.least_squares import COARSE_SIZE
from unshade.fit.pixels import Pixels
from unshade.growth import Samples
from unshade.pictures import SphereImage

POINTS = 2500
"""Points of the full picture on which trees grow once they are good."""


@lru_cache(maxsize=4)
def _dictionary(normals: bytes) -> Dictionary:
    """The dictionary of (3, N) float32 normals; all pictures of one size and mask share it."""
    return Dictionary(torch.frombuffer(bytearray(normals), dtype=torch.float32).view(3, -1))


def _dictionary_of(pixels: Pixels) -> Dictionary:
    return _dictionary(pixels.normals.contiguous().numpy().tobytes())


def samples_of(sphere: SphereImage, fine: int, seed: int) -> Samples:
    """What a search works on: coarse averages, points of the full picture, and ``fine`` more points where it changes most."""
    coarse = Pixels.of(sphere.image, sphere.valid, COARSE_SIZE)
    points = Pixels.points(sphere.image, sphere.valid, POINTS, seed)
    important = Pixels.important(sphere.image, sphere.valid, fine, seed)
    return Samples(coarse, points, important, _dictionary_of(coarse), _dictionary_of(points))
