"""The CNN baseline: one step of the tree as one picture-to-picture network, applied again to its own children.

After Niu et al. 2022, "RIM-Net: Recursive Implicit Fields for Unsupervised Learning of Hierarchical Shape Structures". It does what
the priors, f, g and h do together, but once and for all: it has one answer where several trees are possible.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.models.config import Config
from unshade.models.heads import OPERATORS, TYPES
from unshade.models.image_encoder import convolution
from unshade.sphere import disc_mask, sphere_grid
from unshade.types import Image

LEVELS = 4
"""Sizes that the picture is seen at, each half the one before."""


@dataclass(frozen=True)
class Split:
    """A node taken apart: children (B, 3, S, S), not clamped, 0 outside the disc, and logits of the rest."""

    left: Image
    right: Image
    mask: Tensor
    """(B, 1, S, S)."""
    operator: Tensor
    """(B, 3)."""
    left_type: Tensor
    """(B, 8)."""
    right_type: Tensor


class CNNBaseline(nn.Module):
    """An encoder, a decoder of both children and the mask that also sees each level of the encoder, and classes from the middle."""

    disc: Tensor
    places: Tensor

    def __init__(self, config: Config) -> None:
        super().__init__()
        first = config.baselines.cnn_channels
        widths = [min(first << k, 8 * first) for k in range(LEVELS)]
        self.register_buffer("disc", disc_mask(config.size).float(), persistent=False)
        self.register_buffer("places", sphere_grid(config.size), persistent=False)
        self.enter = convolution(5, first)
        self.down = nn.ModuleList(nn.Sequential(convolution(a, b, 2), convolution(b, b)) for a, b in pairwise(widths))
        self.middle = nn.Sequential(convolution(widths[-1], widths[-1]), convolution(widths[-1], widths[-1]))
        self.up = nn.ModuleList(nn.Sequential(convolution(a + b, a), convolution(a, a)) for a, b in pairwise(widths))
        self.show = nn.Conv2d(first, 7, 1)
        self.classes = nn.Sequential(nn.Linear(2 * widths[-1], 128), nn.SiLU(), nn.Linear(128, OPERATORS + 2 * TYPES))

    def forward(self, parent: Image) -> Split:
        """Take nodes (B, 3, S, S) in [0, 1] apart."""
        levels = [self.enter(torch.cat([2.0 * parent - 1.0, self.places.expand(len(parent), -1, -1, -1)], 1))]
        for layer in self.down:
            levels.append(layer(levels[-1]))
        x = levels[-1] + self.middle(levels[-1])
        classes = self.classes(torch.cat([x.mean((2, 3)), x.amax((2, 3))], 1))
        for layer, level in zip(reversed(self.up), reversed(levels[:-1]), strict=True):
            x = layer(torch.cat([level, F.interpolate(x, scale_factor=2.0)], 1))
        # Left and right begin as the parent: what changes is what is learned.
        left, right, mask = self.show(x).split([3, 3, 1], 1)
        operator, left_type, right_type = classes.split([OPERATORS, TYPES, TYPES], 1)
        return Split((parent + left) * self.disc, (parent + right) * self.disc, mask, operator, left_type, right_type)
