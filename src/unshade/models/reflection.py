"""What a picture reflects: a small U-Net that takes a picture apart into an environment and the picture without it.

The picture is ``screen(plain, environment)``, so at every pixel and channel the environment is at most the picture. The network says which
share of the picture it is; what is left follows exactly.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.models.config import Config
from unshade.sphere import sphere_grid
from unshade.types import Image

GROUPS = 8
"""Of the normalisations; channels are multiples of it."""

DARKEST = 1.0 / 255.0
"""Under an environment brighter than 1 minus this nothing can be seen of the plain picture."""


class ReflectionNet(nn.Module):
    """A picture to what it reflects and what is left without."""

    places: Tensor

    def __init__(self, config: Config) -> None:
        super().__init__()
        widths, blocks = config.reflection.channels, config.reflection.blocks
        finer, coarser, last = widths[:-1], widths[1:], widths[-1]
        self.register_buffer("places", sphere_grid(config.size), persistent=False)
        # Picture and places, each 2 x 2 pixels as one.
        self.stem = nn.Conv2d(4 * 5, widths[0], 3, 1, 1)
        self.encoder = nn.ModuleList(_blocks(*level) for level in zip(widths, blocks, strict=True))
        self.halve = nn.ModuleList(nn.Conv2d(fine, coarse, 3, 2, 1) for fine, coarse in zip(finer, coarser, strict=True))
        self.everywhere = nn.Linear(last, last)
        self.widen = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in zip(finer, coarser, strict=True))
        self.decoder = nn.ModuleList(_blocks(*level) for level in zip(finer, blocks[:-1], strict=True))
        self.share = nn.Sequential(nn.GroupNorm(GROUPS, widths[0]), nn.SiLU(), nn.Conv2d(widths[0], 4 * 3, 3, 1, 1))

    def forward(self, pictures: Image) -> tuple[Image, Image]:
        """Take pictures apart.

        Args:
            pictures: (B, 3, S, S) in [0, 1].
        Returns:
            Environments in [0, picture] and plain pictures in [0, 1], (B, 3, S, S) each. ``screen`` of the two is the picture, to within
            `DARKEST` where an environment is so bright that nothing beneath it can be seen.
        """
        places = self.places.expand(len(pictures), -1, -1, -1)
        # Twice as fast on CPUs in this order of memory.
        x = F.pixel_unshuffle(torch.cat([2.0 * pictures - 1.0, places], 1), 2).contiguous(memory_format=torch.channels_last)
        x = self.stem(x)
        skipped: list[Tensor] = []
        for level, encode in enumerate(self.encoder):
            x = encode(x)
            if level < len(self.halve):
                skipped.append(x)
                x = self.halve[level](x)
        x = x + self.everywhere(x.mean((2, 3)))[..., None, None]
        for level in reversed(range(len(self.decoder))):
            x = F.interpolate(self.widen[level](x), scale_factor=2.0) + skipped[level]
            x = self.decoder[level](x)
        environment = torch.sigmoid(F.pixel_shuffle(self.share(x), 2).float()) * pictures
        return environment, without(pictures, environment)


def without(pictures: Image, environment: Image) -> Image:
    """The picture under an environment that was screened on it: ``(I - E) / (1 - E)``."""
    return (pictures - environment) / (1.0 - environment).clamp(min=DARKEST)


class _Residual(nn.Module):
    """Two convolutions beside a path that leaves everything as it is, and at first nothing but that path."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.normalize = nn.GroupNorm(GROUPS, channels)
        self.first, self.second = (nn.Conv2d(channels, channels, 3, 1, 1) for _ in range(2))
        for parameter in self.second.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        return x + self.second(F.silu(self.first(F.silu(self.normalize(x)))))


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*[_Residual(channels) for _ in range(count)])
