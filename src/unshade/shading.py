"""The catalogue of basic shading: one short pure function a leaf kind.

Each takes ``normals`` (*, 3, H, W) and its parameters (*, n) and returns (*, 1, H, W) for grey shading and masks or
(*, 3, H, W) for colour, in [0, 1]. Device and dtype follow the input; batches broadcast. Every function is a function
of one pixel's normal, so it works on a sphere, a normal map and a mesh alike.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from unshade.sphere import reflect
from unshade.types import Image, Mask, Normals, Params

SHARPEST_EDGE = 1e-4
"""A softness of 0 is a step this wide, so that its gradient stays finite."""


def _image(parameter: Params) -> torch.Tensor:
    """(*, n) -> (*, n, 1, 1)."""
    return parameter[..., None, None]


def facing(normals: Normals, direction: Params) -> torch.Tensor:
    """``n.l`` of unit normals and a direction that is normalised here, (*, 1, H, W) in [-1, 1]."""
    return (normals * _image(F.normalize(direction, dim=-1))).sum(-3, keepdim=True)


def smoothstep(low: torch.Tensor, width: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Hermite step from 0 at ``low`` to 1 at ``low + width``."""
    t = ((x - low) / width.clamp(min=SHARPEST_EDGE)).clamp(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def albedo(normals: Normals, color: Params) -> Image:
    """One colour everywhere. Source: Geng et al. 2023, table 1."""
    return _image(color).expand(*np.broadcast_shapes(color.shape[:-1], normals.shape[:-3]), 3, *normals.shape[-2:])


def diffuse(normals: Normals, direction: Params, ambient: Params) -> Image:
    """Lambert shading, ``ambient + (1 - ambient) * max(n.l, 0)``. Source: Geng et al. 2023, table 1."""
    ambient = _image(ambient)
    return ambient + (1.0 - ambient) * facing(normals, direction).clamp(min=0.0)


def highlight(normals: Normals, direction: Params, sharpness: Params, amplitude: Params) -> Image:
    """A spot of light, ``clamp(amplitude * exp(-sharpness * |n - l|^2), 0, 1)``; ``|n - l|^2 = 2 - 2 n.l``.

    Source: Geng et al. 2023, table 1 and its released renderer.
    """
    return spot(normals, direction, _image(sharpness), _image(amplitude)).clamp(0.0, 1.0)


def spot(normals: Normals, direction: Params, sharpness: torch.Tensor, amplitude: torch.Tensor) -> torch.Tensor:
    """The spherical Gaussian under `highlight` and `environment`, not clamped."""
    return amplitude * torch.exp(-2.0 * sharpness * (1.0 - facing(normals, direction)))


def rim(normals: Normals, direction: Params, exponent: Params) -> Image:
    """Light grazing the silhouette, ``(1 - n.v)^exponent * max(n.l, 0)``. Source: released grammar, exponent ours."""
    grazing = (1.0 - normals[..., 2:3, :, :]).clamp(1e-6, 1.0)
    return grazing ** _image(exponent) * facing(normals, direction).clamp(min=0.0)


def toon_diffuse(normals: Normals, direction: Params, ambient: Params, threshold: Params, softness: Params) -> Image:
    """Two-tone shading, ``ambient + (1 - ambient) * smoothstep(threshold, threshold + softness, n.l)``.

    Source: released grammar, where the softness is fixed at 0.1.
    """
    ambient = _image(ambient)
    return ambient + (1.0 - ambient) * smoothstep(_image(threshold), _image(softness), facing(normals, direction))


def toon_highlight(normals: Normals, direction: Params, radius: Params, brightness: Params, softness: Params) -> Image:
    """A spot with an edge: ``brightness`` within ``radius`` of the light, over an edge of width ``softness`` centred there.

    Radius and softness are angles in radians. The released grammar cuts a highlight at a threshold and scales it; only
    these numbers of it can be seen.
    """
    angle = facing(normals, direction).clamp(-1.0 + 1e-7, 1.0 - 1e-7).acos()
    softness = _image(softness)
    return _image(brightness) * (1.0 - smoothstep(_image(radius) - 0.5 * softness, softness, angle))


def environment(normals: Normals, direction: Params, sharpness: Params, color: Params) -> Image:
    """A reflected environment of K spherical-Gaussian lights, looked up along the mirror direction.

    ``min(sum_k color_k * exp(-sharpness_k * |r - l_k|^2), 1)``, with r the mirror direction (`sphere.reflect`).

    Args:
        direction, color: (*, K, 3). sharpness: (*, K, 1).
    """
    mirrored = reflect(normals)[..., None, :, :, :]
    lobes = spot(mirrored, direction, _image(sharpness), torch.ones_like(_image(sharpness)))
    return (_image(color) * lobes).sum(-4).clamp(max=1.0)


def rotate(directions: Normals, rotation: Params) -> Normals:
    """Turn (*, 3, H, W) directions by an axis-angle vector (*, 3) in radians (Rodrigues)."""
    angle = rotation.square().sum(-1, keepdim=True).clamp(min=1e-24).sqrt()
    directions, axis = torch.broadcast_tensors(directions, _image(rotation / angle))
    cosine, sine = _image(angle.cos()), _image(angle.sin())
    along = (axis * directions).sum(-3, keepdim=True)
    return directions * cosine + torch.linalg.cross(axis, directions, dim=-3) * sine + axis * along * (1.0 - cosine)


def environment_map(normals: Normals, pixels: torch.Tensor, rotation: Params) -> Image:
    """A reflected lat-long picture: +y up, +z at the centre, longitude wraps, bilinear.

    Args:
        pixels: (*, 3, h, w), rows from +y down to -y. rotation: (*, 3) axis-angle that turns the environment.
    """
    x, y, z = rotate(reflect(normals), -rotation).unbind(-3)
    longitude = torch.atan2(x, z) / torch.pi
    latitude = -torch.asin(y.clamp(-1.0, 1.0)) * (2.0 / torch.pi)
    wrapped = torch.cat([pixels[..., -1:], pixels, pixels[..., :1]], dim=-1)
    width = pixels.shape[-1]
    return _lookup(wrapped, longitude * (width / (width + 2)), latitude)


def image(normals: Normals, pixels: torch.Tensor) -> Image:
    """A picture of the sphere, indexed by ``n.xy`` and clamped at the silhouette. ``pixels``: (*, 3, h, w)."""
    return _lookup(pixels, normals[..., 0, :, :], -normals[..., 1, :, :])


def _lookup(pixels: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Bilinear samples of (*, C, h, w) at x, y (*, H, W) in [-1, 1], pixel edges at -1 and 1."""
    batch = np.broadcast_shapes(pixels.shape[:-3], x.shape[:-2])
    grid = torch.stack([x, y], dim=-1).expand(*batch, *x.shape[-2:], 2).reshape(-1, *x.shape[-2:], 2)
    source = pixels.expand(*batch, *pixels.shape[-3:]).reshape(-1, *pixels.shape[-3:])
    found = F.grid_sample(source.to(grid), grid, mode="bilinear", padding_mode="border", align_corners=False)
    return found.reshape(*batch, *found.shape[-3:])


def threshold(normals: Normals, direction: Params, threshold: Params, softness: Params) -> Mask:
    """Mask: 1 where ``n.l`` is over a threshold, with a soft edge centred on it. Source: released masks, softness ours."""
    softness = _image(softness)
    return smoothstep(_image(threshold) - 0.5 * softness, softness, facing(normals, direction))


def stripe(normals: Normals, direction: Params, center: Params, width: Params, softness: Params) -> Mask:
    """Mask: 1 in the band of ``width`` around ``n.l = center``. Source: released masks, softness ours."""
    softness = _image(softness)
    distance = (facing(normals, direction) - _image(center)).abs()
    return 1.0 - smoothstep(0.5 * _image(width) - 0.5 * softness, softness, distance)


def image_mask(normals: Normals, pixels: torch.Tensor) -> Mask:
    """Mask from a picture of the sphere, indexed by ``n.xy``. ``pixels``: (*, 1, h, w)."""
    return image(normals, pixels)
