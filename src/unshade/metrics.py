"""How far apart two pictures, two colours and two trees are.

Pictures are scored inside the disc of `sphere.SCORED_RADIUS`, whatever lies outside.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from unshade.models import perceptual
from unshade.sphere import SCORED_RADIUS, disc_mask
from unshade.tree_distance import tree_distance
from unshade.types import Image, Mask

__all__ = ["ciede2000", "ciede2000_lab", "psnr", "psnr_full_frame", "scored_mask", "ssim", "st_lpips", "tree_distance"]

WINDOW_SIGMA = 1.5
WINDOW_RADIUS = 5
"""SSIM's Gaussian window, 11 x 11 as in its paper."""


def scored_mask(image: Image, mask: Mask | None = None) -> Mask:
    """(1, S, S) bool: the pixels of a square picture inside the scored disc and, if given, a (1, S, S) mask."""
    disc = disc_mask(image.shape[-1], SCORED_RADIUS, image.device)
    return disc if mask is None else disc & (mask.to(image.device) > 0.5)


def _checked(a: Image, b: Image, mask: Mask | None) -> tuple[Image, Image, Mask]:
    if a.ndim != 3 or a.shape[0] != 3 or a.shape[1] != a.shape[2] or a.shape != b.shape:
        raise ValueError(f"metrics: expected two square (3, S, S) pictures of one size, got {tuple(a.shape)} and {tuple(b.shape)}")
    if mask is not None and mask.shape != (1, *a.shape[1:]):
        raise ValueError(f"metrics: expected a mask (1, {a.shape[1]}, {a.shape[2]}), got {tuple(mask.shape)}")
    scored = scored_mask(a, mask)
    if not scored.any():
        raise ValueError("metrics: the mask leaves no pixel to compare")
    return a.detach().double(), b.detach().to(a.device).double(), scored


def psnr(a: Image, b: Image, mask: Mask | None = None) -> float:
    """Peak signal to noise ratio in dB from the mean squared error over the scored pixels; infinite for equal ones.

    Args:
        a, b: (3, S, S) in [0, 1].
        mask: (1, S, S) pixels that count among those of the scored disc.
    """
    a, b, scored = _checked(a, b, mask)
    return _decibels(float((a - b)[:, scored[0]].square().mean()))


def psnr_full_frame(a: Image, b: Image, mask: Mask | None = None) -> float:
    """`psnr` over the whole frame with black outside the scored pixels: flattered by them, never to be put beside `psnr`."""
    a, b, scored = _checked(a, b, mask)
    return _decibels(float(((a - b) * scored).square().mean()))


def _decibels(error: float) -> float:
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def ssim(a: Image, b: Image, mask: Mask | None = None) -> float:
    """Structural similarity of the pictures with black outside the scored pixels: 1 for equal ones.

    Args:
        a, b: (3, S, S) in [0, 1], S at least 11.
        mask: as in `psnr`.
    Source: Wang et al. 2004, equation 13, averaged over channels and over the pixels that the window fits around.
    """
    a, b, scored = _checked(a, b, mask)
    if a.shape[-1] <= 2 * WINDOW_RADIUS:
        raise ValueError(f"ssim: expected at least {2 * WINDOW_RADIUS + 1} pixels a side, got {a.shape[-1]}")
    a, b = a * scored, b * scored
    steps = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=a.dtype, device=a.device)
    taps = torch.exp(-0.5 * (steps / WINDOW_SIGMA).square())
    taps = taps / taps.sum()
    # The window as a banded matrix: float64 convolutions are four times slower.
    window = torch.stack([torch.diag(tap.expand(a.shape[-1] - k), k) for k, tap in enumerate(taps)]).sum(0)[: 1 - len(taps)]
    blurred = window @ torch.stack([a, b, a * a, b * b, a * b]) @ window.T
    mean_a, mean_b, square_a, square_b, product = blurred
    variance_a, variance_b, covariance = square_a - mean_a**2, square_b - mean_b**2, product - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    index = (2 * mean_a * mean_b + c1) * (2 * covariance + c2) / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))
    return float(index.mean())


def st_lpips(a: Image, b: Image, net: perceptual.Net = "vgg", mask: Mask | None = None) -> float:
    """Shift-tolerant LPIPS of the pictures with black outside the scored pixels: 0 for equal ones.

    Not the LPIPS of other papers; see `models.perceptual`. At 256 x 256 VGG takes about a second.

    Args:
        a, b: (3, S, S) in [0, 1], S at least 32.
        net: ``vgg`` or ``alex``.
        mask: as in `psnr`.
    Raises:
        MissingExtraError: the weight files are not installed.
    """
    a, b, scored = _checked(a, b, mask)
    with torch.no_grad():
        found = perceptual.distance((a * scored)[None].float(), (b * scored)[None].float(), net)
    return float(found)


def ciede2000(a: Sequence[float], b: Sequence[float]) -> float:
    """Colour difference of two sRGB colours, display-encoded in [0, 1]; about 1 is just visible.

    Source: CIE 142-2001, under D65.
    """
    return ciede2000_lab(_lab(a), _lab(b))


def _lab(color: Sequence[float]) -> tuple[float, float, float]:
    """sRGB to CIELAB under D65 (IEC 61966-2-1, CIE 15)."""
    r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in color)
    x = (0.4123908 * r + 0.3575843 * g + 0.1804808 * b) / 0.9504559
    y = 0.2126390 * r + 0.7151687 * g + 0.0721923 * b
    z = (0.0193308 * r + 0.1191948 * g + 0.9505322 * b) / 1.0890578
    fx, fy, fz = (math.cbrt(t) if t > (6 / 29) ** 3 else t * (29 / 6) ** 2 / 3 + 4 / 29 for t in (x, y, z))
    return 116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)


def ciede2000_lab(a: Sequence[float], b: Sequence[float]) -> float:
    """Colour difference of two CIELAB colours.

    Source: Sharma, Wu and Dalal 2005, equations 2 to 22.
    """
    (l1, a1, b1), (l2, a2, b2) = a, b
    chroma = 0.5 * (math.hypot(a1, b1) + math.hypot(a2, b2))
    g = 0.5 * (1 - math.sqrt(chroma**7 / (chroma**7 + 25.0**7)))
    a1, a2 = a1 * (1 + g), a2 * (1 + g)
    c1, c2 = math.hypot(a1, b1), math.hypot(a2, b2)
    h1, h2 = math.degrees(math.atan2(b1, a1)) % 360, math.degrees(math.atan2(b2, a2)) % 360
    turn, total = h2 - h1, h1 + h2
    if c1 * c2 == 0.0:
        turn, hue = 0.0, total
    elif abs(turn) <= 180:
        hue = total / 2
    else:
        turn += 360 if turn < 0 else -360
        hue = (total + 360) / 2 if total < 360 else (total - 360) / 2
    dl, dc, dh = l2 - l1, c2 - c1, 2 * math.sqrt(c1 * c2) * math.sin(math.radians(turn) / 2)
    lightness, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    t = 1 - 0.17 * _cos(hue - 30) + 0.24 * _cos(2 * hue) + 0.32 * _cos(3 * hue + 6) - 0.20 * _cos(4 * hue - 63)
    sl = 1 + 0.015 * (lightness - 50) ** 2 / math.sqrt(20 + (lightness - 50) ** 2)
    sc, sh = 1 + 0.045 * chroma, 1 + 0.015 * chroma * t
    rotation = -math.sin(math.radians(60 * math.exp(-(((hue - 275) / 25) ** 2)))) * 2 * math.sqrt(chroma**7 / (chroma**7 + 25.0**7))
    return math.sqrt((dl / sl) ** 2 + (dc / sc) ** 2 + (dh / sh) ** 2 + rotation * (dc / sc) * (dh / sh))


def _cos(degrees: float) -> float:
    return math.cos(math.radians(degrees))
