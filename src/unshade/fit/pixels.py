"""The pixels of a picture that a fit looks at: averages, or points of the full picture."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from unshade import sphere
from unshade.types import Image, Mask


@dataclass(frozen=True)
class Pixels:
    """``normals`` (3, N), ``target`` (3, N) in [0, 1] and ``weight`` (N,), which sums to 1."""

    normals: torch.Tensor
    target: torch.Tensor
    weight: torch.Tensor

    @property
    def count(self) -> int:
        """N."""
        return self.normals.shape[1]

    @staticmethod
    def of(image: Image, valid: Mask | None = None, size: int | None = None, radius: float = sphere.SCORED_RADIUS) -> Pixels:
        """Pixels of a (3, H, H) picture inside ``radius`` and ``valid`` (1, H, H), averaged down to ``size`` x ``size``.

        A cell counts by the share of it that is inside, and its normal is the mean of the normals inside.
        """
        full = image.shape[-1]
        share = _inside(image, valid, radius).to(image.dtype)
        normals = sphere.sphere_normals(full, image.device, image.dtype)
        if size is not None and size < full:
            stack = F.adaptive_avg_pool2d(torch.cat([image * share, normals * share, share])[None], size)[0]
            share = stack[6:]
            image, normals = stack[:3] / share.clamp(min=1e-6), F.normalize(stack[3:6], dim=0)
        keep = share[0] > min(0.2, 0.5 * float(share.max()))
        weight = share[0][keep]
        return Pixels(normals[:, keep].contiguous(), image[:, keep].contiguous(), weight / weight.sum())

    @staticmethod
    def points(image: Image, valid: Mask | None, count: int, seed: int, radius: float = sphere.SCORED_RADIUS) -> Pixels:
        """``count`` pixels of the full picture, drawn evenly; the same places for every picture of a size and mask."""
        places = _inside(image, valid, radius)[0].nonzero()
        order = torch.randperm(len(places), generator=torch.Generator().manual_seed(seed))[:count].sort().values
        return _at(image, places[order], torch.ones(len(order), dtype=image.dtype))

    @staticmethod
    def important(image: Image, valid: Mask | None, count: int, seed: int, radius: float = sphere.SCORED_RADIUS) -> Pixels:
        """About ``count`` pixels of the full picture, most of them where it changes, weighted so that means are unbiased.

        Drawn edges need every pixel along them to be found to a fraction of a pixel.
        """
        inside = _inside(image, valid, radius)[0]
        across = (image[:, :, 1:] - image[:, :, :-1]).abs().sum(0)
        down = (image[:, 1:] - image[:, :-1]).abs().sum(0)
        change = F.pad(across, (1, 0)) + F.pad(across, (0, 1)) + F.pad(down, (0, 0, 1, 0)) + F.pad(down, (0, 0, 0, 1))
        importance = change[inside]
        importance = 0.4 / len(importance) + 0.6 * importance / importance.sum().clamp(min=1e-9)
        chance = torch.zeros_like(importance)
        for _ in range(8):
            certain = chance >= 1.0
            rest = torch.where(certain, torch.zeros_like(importance), importance)
            share = max(count - int(certain.sum()), 0) * rest / rest.sum().clamp(min=1e-12)
            chance = torch.where(certain, torch.ones_like(chance), share).clamp(max=1.0)
        kept = torch.rand(len(chance), generator=torch.Generator().manual_seed(seed), dtype=torch.float64) < chance
        return _at(image, inside.nonzero()[kept], 1.0 / chance[kept])


def _inside(image: Image, valid: Mask | None, radius: float) -> Mask:
    inside = sphere.disc_mask(image.shape[-1], radius, image.device)
    return inside if valid is None else inside & valid


def _at(image: Image, places: torch.Tensor, weight: torch.Tensor) -> Pixels:
    rows, columns = places.T
    normals = sphere.sphere_normals(image.shape[-1], image.device, image.dtype)
    return Pixels(normals[:, rows, columns].contiguous(), image[:, rows, columns].contiguous(), weight / weight.sum())
