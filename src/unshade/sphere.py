"""The unit sphere seen orthographically, and the axes: +x right, +y up, +z to the viewer, row 0 at the top."""

from __future__ import annotations

import torch

from unshade.types import Mask, Normals

SCORED_RADIUS = 0.97
"""Share of the sphere's radius inside which pictures are compared; the last pixels are antialiased."""

VIEW = (0.0, 0.0, 1.0)


def sphere_grid(size: int, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """x and y of every pixel centre of a ``size`` x ``size`` picture, (2, size, size) in (-1, 1)."""
    steps = (torch.arange(size, device=device, dtype=dtype) + 0.5) * (2.0 / size) - 1.0
    y, x = torch.meshgrid(-steps, steps, indexing="ij")
    return torch.stack([x, y])


def normals_from_xy(xy: torch.Tensor) -> Normals:
    """Lift (*, 2, H, W) positions to unit normals; a position outside the disc gets the normal of the silhouette."""
    radius = xy.square().sum(-3, keepdim=True).sqrt()
    xy = xy / radius.clamp(min=1.0)
    z = (1.0 - xy.square().sum(-3, keepdim=True)).clamp(min=0.0).sqrt()
    return torch.cat([xy, z], dim=-3)


def sphere_normals(size: int, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Normals:
    """Normals of the sphere inscribed in a square picture.

    Args:
        size: width and height in pixels.
    Returns:
        (3, size, size) unit vectors, continued past the silhouette.
    """
    return normals_from_xy(sphere_grid(size, device, dtype))


def disc_mask(size: int, radius: float = 1.0, device: torch.device | str = "cpu") -> Mask:
    """(1, size, size) bool, true where a pixel's centre is inside ``radius`` times the inscribed disc."""
    return sphere_grid(size, device).square().sum(0, keepdim=True) <= radius * radius


def reflect(normals: Normals) -> Normals:
    """Mirror direction of the viewer, ``r = 2 (n.v) n - v`` with v = +z."""
    view = normals.new_tensor(VIEW).view(3, 1, 1)
    return 2.0 * normals[..., 2:3, :, :] * normals - view
