"""The pixels that a search works on."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from unshade.atoms import dictionary_of
from unshade.fit.least_squares import COARSE_SIZE
from unshade.fit.pixels import Pixels
from unshade.growth import Samples
from unshade.pictures import SphereImage
from unshade.types import Image, Mask

POINTS = 2500
"""Points of the full picture on which trees grow once they are good."""

CLEAN = 1.2
"""Most grain of a clean picture. Rounding to 8 bits makes 1.0; most MatCaps have 1.5 and more, and so have JPEGs that are not flat."""


def samples_of(sphere: SphereImage, fine: int, seed: int) -> Samples:
    """What a search works on: coarse averages, points of the full picture, and ``fine`` more points where it changes most."""
    coarse = Pixels.of(sphere.image, sphere.valid, COARSE_SIZE)
    points = Pixels.points(sphere.image, sphere.valid, POINTS, seed)
    important = Pixels.important(sphere.image, sphere.valid, fine, seed)
    is_clean = grain(sphere.image, sphere.valid) < CLEAN
    return Samples(coarse, points, important, dictionary_of(coarse), dictionary_of(points), is_clean)


def grain(image: Image, valid: Mask) -> float:
    """How rough a picture is away from its edges, in units of the noise that rounding to 8 bits makes.

    The fourth difference along rows and columns leaves nothing of a smooth shading; its 90th percentile is that of the
    noise, as long as fewer than one pixel in ten lies on an edge.
    """
    kernel = image.new_tensor([1.0, -4.0, 6.0, -4.0, 1.0])
    kernel = kernel / kernel.norm()
    inner = F.max_pool2d((~valid).to(image.dtype)[None], 5, stride=1, padding=2)[0] == 0.0
    if not bool(inner.any()):
        return 0.0
    across = F.conv2d(image[:, None], kernel.view(1, 1, 1, 5), padding=(0, 2))[:, 0]
    down = F.conv2d(image[:, None], kernel.view(1, 1, 5, 1), padding=(2, 0))[:, 0]
    rough = torch.cat([side[inner.expand_as(side)].abs() for side in (across, down)])
    ninetieth = rough.kthvalue(max(1, round(0.9 * rough.numel()))).values
    return float(ninetieth) / (1.645 * 12.0**-0.5 / 255.0)
