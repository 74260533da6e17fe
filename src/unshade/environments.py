"""Real environments for synthetic spheres: CC0 HDRIs, shrunk, in the package; `hdri/sources.json` says where from.

A base node needs what a glossy coat shows of an environment: display-encoded, blurred by its roughness, at an exposure that
leaves something of the paint below. So each environment comes in a few versions, each a lat-long picture in [0, 1].
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file

from unshade.nodes import Raster
from unshade.render import srgb_encode
from unshade.threads import threads
from unshade.types import Image

FOLDER = Path(__file__).parent / "hdri"
SOURCES = FOLDER / "sources.json"
STORED = FOLDER / "environments.safetensors"

EXPOSURES = (0.02, 0.045, 0.1, 0.2)
"""What the mean of an environment becomes, scene-linear: from a coat of varnish to dull metal."""

SHARPNESSES = (None, 60.0, 12.0)
"""Of the spherical Gaussian that an environment is blurred by; None leaves it as it is."""

BLURRED_HEIGHT = 32


@lru_cache(maxsize=2)
def names(split: str) -> tuple[str, ...]:
    """The environments of a half, train or test."""
    listed = json.loads(SOURCES.read_text(encoding="utf-8"))["environments"]
    return tuple(entry["name"] for entry in listed if entry["half"] == split)


@lru_cache(maxsize=2)
def versions(split: str) -> tuple[tuple[str, float, float | None], ...]:
    """(name, exposure, sharpness of the blur) of every version of a half's environments, in the order of `panoramas`."""
    return tuple((name, exposure, sharpness) for name in names(split) for sharpness in SHARPNESSES for exposure in EXPOSURES)


@lru_cache(maxsize=2)
def panoramas(split: str) -> Image:
    """The versions of a half, (V, 3, 64, 128) display-encoded in [0, 1] and rounded to 16 bits."""
    stored = load_file(STORED)
    light = torch.stack([stored[name].float() for name in names(split)])
    return (versions_of(light, EXPOSURES, SHARPNESSES) * 65535.0).round() / 65535.0


def versions_of(light: Image, exposures: Sequence[float], sharpnesses: Sequence[float | None]) -> Image:
    """Environments (K, 3, h, w) of mean 1 at every blur and exposure, (V, 3, h, w) display-encoded, in the order of `versions`."""
    shown = torch.stack([light if sharpness is None else blurred(light, sharpness) for sharpness in sharpnesses], dim=1)
    exposed = shown[:, :, None] * torch.tensor(exposures).view(-1, 1, 1, 1)
    return srgb_encode(exposed.clamp(0.0, 1.0)).flatten(0, 2)


def raster(split: str, version: int) -> Raster:
    """One of the `panoramas` as a tree holds it."""
    return Raster.from_array(panoramas(split)[version].double())


def blurred(light: Image, sharpness: float) -> Image:
    """Environments (K, 3, h, w) seen in a rough coat: averaged with weights ``exp(-sharpness * |a - b|^2)`` of directions a and b.

    On one thread: trees of one seed hold the same bits however many cores there are.
    """
    height, width = light.shape[-2:]
    with threads(1):
        small = F.avg_pool2d(light, height // BLURRED_HEIGHT)
        toward, areas = directions(BLURRED_HEIGHT)
        weights = torch.exp(-2.0 * sharpness * (1.0 - toward @ toward.T)) * areas
        spread = (small.flatten(2) @ (weights / weights.sum(1, keepdim=True)).T).view_as(small)
        # Wrapped round before it is enlarged, so that no seam shows.
        wrapped = torch.cat([spread[..., -2:], spread, spread[..., :2]], dim=-1)
        scale = height // BLURRED_HEIGHT
        large = F.interpolate(wrapped, scale_factor=scale, mode="bilinear", align_corners=False)
        return large[..., 2 * scale : 2 * scale + width]


def directions(height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions of a lat-long picture's pixels, (N, 3), and the share of the sphere that each covers, (N,)."""
    latitude = (0.5 - (torch.arange(height) + 0.5) / height) * math.pi
    longitude = ((torch.arange(2 * height) + 0.5) / (2 * height) * 2.0 - 1.0) * math.pi
    up, around = torch.meshgrid(latitude, longitude, indexing="ij")
    toward = torch.stack([up.cos() * around.sin(), up.sin(), up.cos() * around.cos()], dim=-1)
    return toward.flatten(0, 1), up.cos().flatten() / up.cos().sum()
