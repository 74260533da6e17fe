"""What the paper minimises: the distance of two pictures, in pixels and in VGG features (Geng et al. 2023, section 3.4).

``||R(p) - I||_2 + ||F_VGG(R(p)) - F_VGG(I)||_2``. The paper states neither the layers nor a scale. Here both terms are
root mean squares, so that they do not depend on the resolution; each feature layer is divided by its own root mean
square on the target, and the layers are averaged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import torch
import torch.nn.functional as F

from unshade.sphere import sphere_normals
from unshade.types import Image, Mask

ObjectiveName: TypeAlias = Literal["l2", "paper"]
"""``l2`` is the pixel term alone; ``paper`` adds the VGG features and needs their weights."""

Features: TypeAlias = Callable[[Image], "list[torch.Tensor]"]

FIT_SIZE = 64
"""Pictures are compared at this size; VGG features at 256 cost sixteen times as much."""

FEATURE_WEIGHT = 0.2
"""Makes the two terms about equal near the end of a fit: on real pictures 0.01 in pixels went with 0.05 in features."""

_FLOOR = 1e-12
"""Keeps the gradient of a root finite at a perfect fit."""


def shrink(image: Image, mask: Mask, size: int) -> tuple[Image, Mask]:
    """Average the masked pixels of a square picture down to ``size`` (or leave a smaller one as it is).

    Args:
        image: (3, H, W). mask: (1, H, W) bool, the pixels that count.
    Returns:
        (3, h, w) and (1, h, w) bool: true where at least half of a pixel's area counts.
    """
    if image.shape[-1] <= size and image.shape[-2] <= size:
        return image, mask.bool()
    weight = mask.to(image)[None]
    covered = F.adaptive_avg_pool2d(weight, size)[0]
    averaged = F.adaptive_avg_pool2d(image[None] * weight, size)[0] / covered.clamp(min=1e-6)
    return averaged, covered >= 0.5


class Objective:
    """The distance of rendered variants from one picture.

    ``normals`` are what to render: (3, h, w). For ``l2`` they are only the pixels that count, in one row.
    """

    def __init__(
        self, target: Image, mask: Mask, name: ObjectiveName = "l2", *, size: int = FIT_SIZE, features: Features | None = None
    ) -> None:
        """
        Args:
            target: (3, H, W) square picture of the sphere. mask: (1, H, W), the pixels that count.
            features: the backbone, for tests; the VGG of `unshade.models.perceptual` where left out.
        Raises:
            ValueError: unknown name, a picture that is not square, or a mask without a pixel.
            MissingExtraError: ``paper`` without the weights.
        """
        if name not in ("l2", "paper"):
            raise ValueError(f"objective: expected 'l2' or 'paper', got {name!r}")
        if target.ndim != 3 or target.shape[0] != 3 or target.shape[1] != target.shape[2] or mask.shape != (1, *target.shape[1:]):
            raise ValueError(
                f"objective: expected a square (3, S, S) picture and a (1, S, S) mask, got {tuple(target.shape)} and {tuple(mask.shape)}"
            )
        target, mask = shrink(target, mask, size)
        if not mask.any():
            raise ValueError("objective: the mask leaves no pixel to compare")
        self.name = name
        normals = sphere_normals(target.shape[-1], target.device, target.dtype)
        if name == "l2":
            keep = mask[0]
            self.normals, self._target = normals[:, keep][:, None], target[:, keep][:, None]
            return
        if features is None:
            from unshade.models.perceptual import vgg_features

            features = vgg_features
        self.normals, self._mask, self._features = normals, mask.to(target), features
        self._target = target * self._mask
        self._share = self._mask.mean()
        with torch.no_grad():
            self._wanted = [layer.detach() for layer in features(self._target[None])]
        self._scales = [layer.square().mean().clamp(min=_FLOOR).sqrt() for layer in self._wanted]

    def __call__(self, images: Image) -> torch.Tensor:
        """(B, 3, h, w) rendered at ``normals`` -> (B,) errors, 0 at a perfect fit."""
        if self.name == "l2":
            return _root_mean_square(images - self._target)
        images = images * self._mask
        pixels = _root_mean_square(images - self._target) / self._share.sqrt()
        layers = [
            _root_mean_square(found - wanted) / scale
            for found, wanted, scale in zip(self._features(images), self._wanted, self._scales, strict=True)
        ]
        return pixels + FEATURE_WEIGHT * torch.stack(layers).mean(0)


def _root_mean_square(difference: torch.Tensor) -> torch.Tensor:
    """(B, ...) -> (B,)."""
    return (difference.flatten(1).square().mean(1) + _FLOOR).sqrt()
