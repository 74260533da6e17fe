"""A picture of the sphere as the networks know them."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from unshade.sphere import disc_mask
from unshade.types import Image, Mask


def node_image(image: Image, valid: Mask, size: int) -> Image:
    """A picture of the sphere as the networks know them.

    Args:
        image: (3, H, H) in [0, 1]. valid: (1, H, H), the pixels that count; the others are filled in from around them.
    Returns:
        (3, size, size), 0 outside the disc.
    """
    weight = (valid & disc_mask(image.shape[-1], device=image.device)).to(image)
    layers = torch.cat([image * weight, weight])[None]
    filled = (layers[0, :3].sum((1, 2)) / weight.sum().clamp(min=1.0)).view(1, 3, 1, 1)
    # From coarse to fine: what a finer average does not know, the coarser one does.
    for level in (side for side in (4, 8, 16, 32) if side < size and side <= image.shape[-1]):
        filled = _over(F.adaptive_avg_pool2d(layers, level), filled)
    # The networks were shown pictures that are sampled at pixel centres, their edges as sharp as can be.
    filled = _over(F.interpolate(layers, size, mode="bilinear"), filled)
    return filled[0].clamp(0.0, 1.0) * disc_mask(size, device=image.device)


def _over(layers: torch.Tensor, below: torch.Tensor) -> torch.Tensor:
    """Colours (1, 3, S, S) of weighted ones, (1, 4, S, S) with the weight last; where that is small, those below, of any size."""
    share = layers[:, 3:]
    trust = (4.0 * share).clamp(max=1.0)
    below = F.interpolate(below, layers.shape[-1], mode="bilinear")
    return trust * layers[:, :3] / share.clamp(min=1e-6) + (1.0 - trust) * below
