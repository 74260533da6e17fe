"""What a first-order or black-box optimiser sees of a tree: its free numbers, evenly scaled.

A scalar or a colour runs over [0, 1] of its range, logarithmically where its parameter says so; a direction stays 3
numbers of length 1. Locked numbers and amplitudes that a tint carries do not appear.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F

from unshade.errors import AddressError
from unshade.nodes import KINDS, Leaf, Node, Role, find_address, walk
from unshade.parameters import Layout
from unshade.sphere import VIEW
from unshade.types import Params


def locked_numbers(root: Node, layout: Layout, locked: Collection[str]) -> torch.Tensor:
    """(P,) bool: the numbers at or below the locked addresses.

    An entry is anything `nodes.find` takes, or that and a parameter's name: ``screen.0.multiply.1.diffuse.ambient``.
    Raises AddressError.
    """
    prefixes = [_prefix(root, where) for where in locked]
    return torch.tensor(
        [any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes) for name in layout.names], dtype=torch.bool
    )


def _prefix(root: Node, where: str) -> str:
    try:
        return find_address(root, where)
    except AddressError:
        address, _, parameter = where.rpartition(".")
        node = dict(walk(root)).get(address) if address else None
        if not isinstance(node, Leaf):
            raise
        KINDS[node.kind].parameter(parameter)
        return where


@dataclass(frozen=True)
class Coordinates:
    """The free numbers of one structure as (*, D) points."""

    root: Node
    layout: Layout
    free: torch.Tensor
    """(P,) bool."""
    own: Params
    """(P,) float64, the numbers of ``root``."""

    @staticmethod
    def of(root: Node, locked: Collection[str] = ()) -> Coordinates:
        """Raises AddressError where a locked address fits no node."""
        layout = Layout.of(root)
        return Coordinates(root, layout, layout.free & ~locked_numbers(root, layout, locked), layout.pack(root))

    @cached_property
    def size(self) -> int:
        """D."""
        return int(self.free.sum())

    @cached_property
    def directions(self) -> torch.Tensor:
        """(D,) bool, the coordinates that come in threes of length 1."""
        return torch.tensor([name == "direction" for name in self.layout.types], dtype=torch.bool)[self.free]

    @cached_property
    def _scale(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Low end and width of each free number's range, (D,) each, logarithms where the third is true."""
        lower, upper = self.layout.lower[self.free], self.layout.upper[self.free]
        logarithmic = self.layout.logarithmic[self.free] & (lower > 0)
        low, high = (
            torch.where(logarithmic, lower.clamp(min=1e-30).log(), lower),
            torch.where(logarithmic, upper.clamp(min=1e-30).log(), upper),
        )
        straight = self.directions
        return low.masked_fill(straight, 0.0), (high - low).masked_fill(straight, 1.0), logarithmic

    def encode(self, numbers: Params) -> torch.Tensor:
        """(*, P) numbers of the layout -> (*, D) points."""
        low, width, logarithmic = (part.to(numbers.device) for part in self._scale)
        numbers = numbers[..., self.free.to(numbers.device)]
        scaled = torch.where(logarithmic, numbers.clamp(min=1e-30).log(), numbers)
        return (scaled - low.to(numbers)) / width.to(numbers)

    def decode(self, points: torch.Tensor) -> Params:
        """(*, D) points -> (*, P) numbers of the layout, the rest as in ``root``; differentiable."""
        low, width, logarithmic = (part.to(points.device) for part in self._scale)
        scaled = low.to(points) + points * width.to(points)
        scaled = torch.where(logarithmic, torch.where(logarithmic, scaled, 0.0).exp(), scaled)
        where = self.free.to(points.device).nonzero()[:, 0]
        return self.own.to(points).expand(*points.shape[:-1], -1).index_copy(-1, where, scaled)

    def constrain(self, points: torch.Tensor) -> torch.Tensor:
        """Bring (*, D) points into range: the nearest in [0, 1], directions to length 1."""
        straight = self.directions.to(points.device)
        inside = points.clamp(0.0, 1.0)
        if straight.any():
            inside[..., straight] = F.normalize(points[..., straight].unflatten(-1, (-1, 3)), dim=-1).flatten(-2)
        return inside

    def tree(self, point: torch.Tensor) -> Node:
        """The structure with the numbers of one (D,) point. Locked numbers keep every bit."""
        numbers = self.own.clone()
        numbers[self.free] = self.decode(point.detach().to("cpu", torch.float64))[self.free]
        return self.layout.unpack(self.root, numbers)

    def random(self, generator: torch.Generator, count: int) -> torch.Tensor:
        """(count, D) float64 starts: lights on the visible side, the rest around each parameter's default.

        The nodes' ranges are too wide to draw from: most of a sharpness between 0.05 and 5000 is invisible.
        """
        numbers = torch.cat([self.own.new_zeros(count, 0)] + [_random_leaf(leaf, generator, count) for leaf in self._leaves()], dim=-1)
        return self.constrain(self.encode(numbers))

    def _leaves(self) -> list[Leaf]:
        """The leaves in the order of the layout."""
        nodes = dict(walk(self.root))
        found: list[str] = []
        for name in self.layout.names:
            address = next(part for part in _parents(name) if part in nodes)
            if not found or found[-1] != address:
                found.append(address)
        return [leaf for leaf in (nodes[address] for address in found) if isinstance(leaf, Leaf)]


def _parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[:end]) for end in range(len(parts) - 1, 0, -1)]


def _random_leaf(leaf: Leaf, generator: torch.Generator, count: int) -> torch.Tensor:
    kind = KINDS[leaf.kind]
    drawn = []
    for parameter in kind.parameters:
        for _ in range(leaf.lobes if parameter.size else 0):
            uniform = torch.rand(count, parameter.size, generator=generator, dtype=torch.float64)
            if parameter.type == "direction":
                drawn.append(_random_direction(uniform, kind.role))
            elif parameter.type == "color":
                drawn.append(uniform)
            else:
                middle = torch.tensor(parameter.default or (0.5 * (parameter.low + parameter.high),), dtype=torch.float64)
                if parameter.logarithmic:
                    value = middle / 30.0 * 150.0**uniform
                else:
                    # Away from both ends of its range, where an edge is hard or a spot is gone and no gradient leads back.
                    reach = 0.25 * min(parameter.high - parameter.low, 2.0)
                    low, high = (middle - reach).clamp(min=parameter.low), (middle + reach).clamp(max=parameter.high)
                    value = low + (high - low) * (0.1 + 0.8 * uniform)
                drawn.append(value.clamp(parameter.low, parameter.high))
    return torch.cat(drawn, dim=-1) if drawn else torch.zeros(count, 0, dtype=torch.float64)


def _random_direction(uniform: torch.Tensor, role: Role) -> torch.Tensor:
    """(count, 3) uniform numbers -> the normal of a random place on the disc, mirrored for a reflection."""
    radius, angle = 0.98 * uniform[:, :1].sqrt(), 2.0 * torch.pi * uniform[:, 1:2]
    normal = torch.cat([radius * angle.cos(), radius * angle.sin(), (1.0 - radius.square()).sqrt()], dim=-1)
    return 2.0 * normal[:, 2:] * normal - normal.new_tensor(VIEW) if role is Role.ENVIRONMENT else normal
