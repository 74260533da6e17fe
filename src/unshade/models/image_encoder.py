"""What the baselines see a picture with: convolutions that halve it to 4 x 4 places."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.sphere import sphere_grid
from unshade.types import Image

GROUPS = 4


def convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """3 x 3, normalised, with its bend."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1), nn.GroupNorm(GROUPS, outputs), nn.SiLU())


class ImageEncoder(nn.Module):
    """(B, 3, S, S) in [0, 1] to features (B, outputs, 4, 4)."""

    places: Tensor

    def __init__(self, size: int, channels: int, outputs: int, widest: int = 8) -> None:
        super().__init__()
        self.register_buffer("places", sphere_grid(size), persistent=False)
        layers: list[nn.Module] = [convolution(5, channels)]
        inputs = channels
        while size > 4:
            width = min(2 * inputs, widest * channels)
            layers += [convolution(inputs, width, 2), convolution(width, width)]
            inputs, size = width, size // 2
        self.layers = nn.Sequential(*layers)
        self.join = nn.Conv2d(inputs + 48, outputs, 1)

    def forward(self, images: Image) -> Tensor:
        """See the class."""
        places = self.places.expand(len(images), -1, -1, -1)
        seen = self.layers(torch.cat([2.0 * images - 1.0, places], 1))
        # The colours as they are, at 16 x 16: normalised layers know them only beside each other.
        colors = F.pixel_unshuffle(F.adaptive_avg_pool2d(images, 16), 4)
        return self.join(torch.cat([seen, 2.0 * colors - 1.0], 1))
