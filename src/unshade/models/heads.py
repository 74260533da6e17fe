"""The small networks that read node images: f the operator, g its mask, h what a node is (the paper's f, g and h).

Both closed-form operators and both differences from the parent enter as images of their own: whether ``multiply(left, right)`` looks
like the parent is then something to see, not to learn.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.blend import multiply, screen
from unshade.models.config import Config
from unshade.sphere import disc_mask, sphere_grid
from unshade.types import Image

OPERATORS = 3
TYPES = 8
"""Classes, in the order of `unshade.synthesis`."""


def _step(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """A convolution and what makes it train well."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1), nn.GroupNorm(4, outputs), nn.ReLU())


def _classifier(inputs: int, channels: int, size: int, classes: int) -> nn.Sequential:
    """Halve down to 4 x 4, then average and decide."""
    layers: list[nn.Module] = []
    while size > 4:
        layers.append(_step(inputs, channels, 2))
        layers.append(_step(channels, channels))
        inputs, channels, size = channels, min(channels * 2, 128), size // 2
    return nn.Sequential(*layers, _Pool(), nn.Linear(2 * inputs, 128), nn.ReLU(), nn.Linear(128, classes))


class _Pool(nn.Module):
    """Mean and maximum over the picture, (B, C, H, W) to (B, 2 C)."""

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        return torch.cat([x.mean((2, 3)), x.amax((2, 3))], 1)


class OperatorNet(nn.Module):
    """f: which operator makes the parent of its children."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.layers = _classifier(15, config.heads.channels, config.size, OPERATORS)

    def forward(self, parent: Image, left: Image, right: Image) -> Tensor:
        """Images (B, 3, S, S) to logits (B, 3)."""
        return self.layers(torch.cat([parent, left, right, parent - multiply(left, right), parent - screen(left, right)], 1))


class MaskNet(nn.Module):
    """g: the mask by which a mix made the parent of its children; 1 where it shows the left one."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        width = config.heads.channels
        self.fine = _step(17, width)
        self.middle = nn.Sequential(_step(width, 2 * width, 2), _step(2 * width, 2 * width))
        self.coarse = nn.Sequential(_step(2 * width, 2 * width, 2), _step(2 * width, 2 * width), _step(2 * width, 2 * width))
        self.join_middle = _step(4 * width, width)
        self.join_fine = _step(2 * width, width)
        self.decide = nn.Conv2d(width, 1, 1)

    def forward(self, parent: Image, left: Image, right: Image) -> Tensor:
        """Images (B, 3, S, S) to logits (B, 1, S, S)."""
        to_left, to_right = (parent - left).abs(), (parent - right).abs()
        nearer = torch.cat([d.sum(1, keepdim=True) for d in (to_left, to_right)], 1)
        # Relative to their sum, so that children which are nearly alike can be told apart too.
        nearer = nearer / (nearer.sum(1, keepdim=True) + 0.02)
        fine = self.fine(torch.cat([parent, left, right, to_left, to_right, nearer], 1))
        middle = self.middle(fine)
        middle = self.join_middle(torch.cat([middle, F.interpolate(self.coarse(middle), scale_factor=2.0)], 1))
        return self.decide(self.join_fine(torch.cat([fine, F.interpolate(middle, scale_factor=2.0)], 1)))


class TypeNet(nn.Module):
    """h: which leaf a node is, or an operator to decompose further."""

    disc: Tensor
    places: Tensor

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.register_buffer("disc", disc_mask(config.size).float(), persistent=False)
        self.register_buffer("places", sphere_grid(config.size), persistent=False)
        self.layers = _classifier(8, config.heads.channels, config.size, TYPES)

    def forward(self, node: Image) -> Tensor:
        """(B, 3, S, S) to logits (B, 8)."""
        mean = node.sum((2, 3), keepdim=True) / self.disc.sum()
        # How a node differs from one flat colour tells an albedo from a faint shading.
        flat = (10.0 * (node - mean) * self.disc).clamp(-1.0, 1.0)
        places = self.places.expand(len(node), -1, -1, -1)
        return self.layers(torch.cat([node, flat, places], 1))


class Heads(nn.Module):
    """The three together, as they are trained and stored."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.operator = OperatorNet(config)
        self.mask = MaskNet(config)
        self.types = TypeNet(config)
