"""Real environments for synthetic spheres: CC0 HDRIs, shrunk, in the package; `hdri/sources.json` says where from.

A base node needs what a glossy coat shows of an environment: display-encoded, blurred by its roughness, at an exposure that
leaves something of the paint below. So each environment comes in a few versions, each a lat-long picture in [0, 1].
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import torch
from safetensors.torch import load_file

from unshade.nodes import Raster
from unshade.render import srgb_encode
from unshade.types import Image

FOLDER = Path(__file__).parent / "hdri"
SOURCES = FOLDER / "sources.json"
STORED = FOLDER / "environments.safetensors"

TEST = frozenset({"apartment", "dawn", "forest", "studio", "sunset", "warehouse"})
"""Environments of the test half; indoors and outdoors, day and evening are in both halves."""

EXPOSURES = (0.02, 0.045, 0.1, 0.2)
"""What the mean of an environment becomes, scene-linear: from a coat of varnish to dull metal."""

SHARPNESSES = (None, 60.0, 12.0)
"""Of the spherical Gaussian that an environment is blurred by; None leaves it as it is."""

BLURRED_HEIGHT = 32


def names(split: str) -> tuple[str, ...]:
    """The environments of a half, train or test."""
    return tuple(name for name in sorted(load_file(STORED)) if (name in TEST) == (split == "test"))


def versions(split: str) -> tuple[tuple[str, float, float | None], ...]:
    """(name, exposure, sharpness of the blur) of every version of a half's environments, in the order of `panoramas`."""
    return tuple((name, exposure, sharpness) for name in names(split) for sharpness in SHARPNESSES for exposure in EXPOSURES)


@lru_cache(maxsize=2)
def panoramas(split: str) -> Image:
    """The versions of a half, (V, 3, 64, 128) display-encoded in [0, 1] and rounded to 16 bits."""
    stored = load_file(STORED)
    pictures = []
    for name in names(split):
        light = stored[name].float()
        for sharpness in SHARPNESSES:
            shown = light if sharpness is None else blurred(light, sharpness)
            pictures += [srgb_encode((exposure * shown).clamp(0.0, 1.0)) for exposure in EXPOSURES]
    return (torch.stack(pictures) * 65535.0).round() / 65535.0


def raster(split: str, version: int) -> Raster:
    """One of the `panoramas` as a tree holds it."""
    return Raster.from_array(panoramas(split)[version].double())


def blurred(light: Image, sharpness: float) -> Image:
    """An environment seen in a rough coat: averaged with the weights ``exp(-sharpness * |a - b|^2)`` of directions a and b."""
    height, width = light.shape[-2:]
    small = torch.nn.functional.avg_pool2d(light[None], height // BLURRED_HEIGHT)[0]
    directions, areas = _directions(BLURRED_HEIGHT)
    weights = torch.exp(-2.0 * sharpness * (1.0 - directions @ directions.T)) * areas
    spread = small.flatten(1) @ (weights / weights.sum(1, keepdim=True)).T
    # Wrapped round before it is enlarged, so that no seam shows.
    wrapped = torch.cat([spread.view_as(small)] * 3, dim=-1)[None]
    large = torch.nn.functional.interpolate(wrapped, size=(height, 3 * width), mode="bilinear", align_corners=False)[0]
    return large[..., width : 2 * width]


def _directions(height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions of a lat-long picture's pixels, (N, 3), and the share of the sphere that each covers, (N,)."""
    latitude = (0.5 - (torch.arange(height) + 0.5) / height) * math.pi
    longitude = ((torch.arange(2 * height) + 0.5) / (2 * height) * 2.0 - 1.0) * math.pi
    up, around = torch.meshgrid(latitude, longitude, indexing="ij")
    directions = torch.stack([up.cos() * around.sin(), up.sin(), up.cos() * around.cos()], dim=-1)
    return directions.flatten(0, 1), up.cos().flatten() / up.cos().sum()
