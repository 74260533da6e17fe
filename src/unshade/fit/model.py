"""A structure at the pixels of one picture: values, gains and the Jacobian.

Every operator is affine in each of its inputs, and every pixel stands alone. So the derivative of the picture by a
leaf's parameter is the product of two pictures: how much the output follows that leaf (its *gain*, one pass down the
tree) and the leaf's own derivative. A Jacobian costs about as much as a few renders. Directions move on the sphere (two
tangent coordinates), logarithmic parameters by factors.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import torch
import torch.nn.functional as F

from unshade.blend import BLENDS
from unshade.fit.derivatives import ANALYTIC, environment, forward_mode
from unshade.fit.pixels import Pixels
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, replace, walk
from unshade.parameters import Layout
from unshade.shading import facing
from unshade.sphere import reflect

Limits: TypeAlias = dict[str, tuple[float, float]]
NO_LIMITS: Limits = {}

EDGE = ("direction", "threshold", "center", "width", "radius", "softness")
"""Parameters that place an edge. A hard edge has no slope, so a fit leaves its place alone; `soften` it to move it."""


def softness_of(leaf: Leaf) -> float:
    """Width of the edge of a mask or a toon leaf; infinite for a leaf without one."""
    return leaf["softness"][0] if any(parameter.name == "softness" for parameter in KINDS[leaf.kind].parameters) else math.inf


def is_hard(leaf: Leaf) -> bool:
    """True for a mask or a toon leaf whose edge is a step."""
    return softness_of(leaf) == 0.0


def is_locked(address: str, parameter: str, locked: Collection[str]) -> bool:
    """True where a leaf, a subtree above it or this parameter of it is to keep its numbers."""
    return any(address == where or address.startswith(f"{where}.") or where == f"{address}.{parameter}" for where in locked)


def soften(root: Node, softness: float, locked: Collection[str] = ()) -> Node:
    """The tree with every hard edge made this wide, locked ones aside."""
    for address, node in walk(root):
        if isinstance(node, Leaf) and is_hard(node) and not is_locked(address, "softness", locked):
            root = replace(root, address, node.set(softness=softness))
    return root


@dataclass(frozen=True)
class _Group:
    """Leaves of one kind with the same free numbers, evaluated and differentiated as one batch."""

    kind: str
    leaves: tuple[int, ...]
    index: tuple[torch.Tensor, ...]
    """One (K, n) index into the flat vector a parameter."""
    pattern: tuple[tuple[int, int, int], ...]
    """(parameter, offset in it, tangent 0 or 1, or -1 for a plain number) of each free column of a leaf."""
    first: int
    """First row in the Jacobian; K * len(pattern) rows follow, leaf by leaf."""


class Model:
    """A structure at given pixels: values, gains and Jacobian.

    Args:
        root: the structure. pixels: where. locked: addresses of leaves, subtrees or ``address.parameter`` that are kept.
        softest: least softness of an edge. limits: narrower ranges by ``parameter`` or ``kind.parameter``.
    """

    def __init__(self, root: Node, pixels: Pixels, locked: Collection[str] = (), softest: float = 0.0, limits: Limits = NO_LIMITS) -> None:
        self.root, self.pixels = root, pixels
        self.layout = Layout.of(root)
        self.normals = pixels.normals[:, None, :]
        self._last_tangents: tuple[torch.Tensor, torch.Tensor] | None = None
        self.grazing = (1.0 - pixels.normals[2]).clamp(1e-6, 1.0)
        self.leaves: list[Leaf] = []
        self.addresses: list[str] = []
        self._collect(root, root.kind)
        self.groups = self._grouped(frozenset(locked))
        self._columns(limits | {"softness": (softest, limits.get("softness", (0.0, math.inf))[1])})

    def _collect(self, node: Node, address: str) -> None:
        if isinstance(node, Leaf):
            self.leaves.append(node)
            self.addresses.append(address)
            return
        for index, child in enumerate(node.children):
            self._collect(child, f"{address}.{index}.{child.kind}")
        if node.mask is not None:
            self._collect(node.mask, f"{address}.mask")

    def _pattern(self, k: int, locked: frozenset[str]) -> tuple[tuple[int, int, int], ...]:
        """The free columns of one leaf: two a direction, one for any other number that is not held."""
        address, leaf = self.addresses[k], self.leaves[k]
        hard = is_hard(leaf)
        own: list[tuple[int, int, int]] = []
        for p, (parameter, slot) in enumerate(zip(KINDS[leaf.kind].parameters, self.layout.slots[k], strict=True)):
            if is_locked(address, parameter.name, locked) or (hard and parameter.name in EDGE):
                continue
            if parameter.type == "direction":
                own += [(p, offset, tangent) for offset in range(0, slot.stop - slot.start, 3) for tangent in (0, 1)]
            else:
                own += [(p, offset, -1) for offset in range(slot.stop - slot.start) if self.layout.free[slot.start + offset]]
        return tuple(own)

    def _grouped(self, locked: frozenset[str]) -> list[_Group]:
        batches: dict[tuple, list[int]] = {}
        for k, leaf in enumerate(self.leaves):
            kind = KINDS[leaf.kind]
            alone = kind.repeats or any(parameter.type == "raster" for parameter in kind.parameters)
            batches.setdefault((leaf.kind, self._pattern(k, locked), k if alone else -1), []).append(k)
        groups, first = [], 0
        for (kind_name, pattern, _), members in batches.items():
            index = tuple(
                torch.tensor([list(range(slot.start, slot.stop)) for slot in (self.layout.slots[k][p] for k in members)], dtype=torch.long)
                for p in range(len(KINDS[kind_name].parameters))
            )
            groups.append(_Group(kind_name, tuple(members), index, pattern, first))
            first += len(members) * len(pattern)
        self.free = first
        return groups

    def _columns(self, limits: Limits) -> None:
        """What each row of the Jacobian moves, and its bounds."""
        layout = self.layout
        flat = [
            (layout.slots[k][p].start + offset, tangent)
            for group in self.groups
            for k in group.leaves
            for p, offset, tangent in group.pattern
        ]
        self.number = torch.tensor([number for number, _ in flat], dtype=torch.long)
        self.plain = torch.tensor([tangent < 0 for _, tangent in flat], dtype=torch.bool)
        self.log = layout.logarithmic[self.number] & self.plain
        self.plain_rows, self.log_rows = _rows(self.plain), _rows(self.log)
        self.linear_rows = _rows(self.plain & ~self.log)
        self.directions = self.number[torch.tensor([tangent == 0 for _, tangent in flat], dtype=torch.bool)]
        self.spread = self.directions[:, None] + torch.arange(3)
        self.tangential = _rows(~self.plain)
        names = [(g.kind, KINDS[g.kind].parameters[p].name) for g in self.groups for _ in g.leaves for p, _, _ in g.pattern]
        ranges = [limits.get(f"{kind}.{name}", limits.get(name, (-math.inf, math.inf))) for kind, name in names]
        low, high = torch.tensor(ranges, dtype=torch.float64).reshape(-1, 2).unbind(1)
        self.low = torch.where(self.plain, layout.lower[self.number].maximum(low), -torch.inf)
        self.high = torch.where(self.plain, layout.upper[self.number].minimum(high), torch.inf)

    def _arguments(self, group: _Group, numbers: torch.Tensor) -> list[torch.Tensor]:
        """One (K, n) tensor a parameter; (1, lobes, n) for a kind that repeats; a raster as (1, C, h, w)."""
        kind = KINDS[group.kind]
        arguments = []
        for parameter, stored, index in zip(kind.parameters, self.leaves[group.leaves[0]].values, group.index, strict=True):
            if isinstance(stored, Raster):
                arguments.append(stored.tensor(numbers.device, numbers.dtype)[None])
            else:
                arguments.append(numbers[index].unflatten(-1, (-1, parameter.size)) if kind.repeats else numbers[index])
        return arguments

    def evaluate(self, vector: torch.Tensor) -> list[torch.Tensor]:
        """Every leaf's picture, (1 or 3, N) or (3, 1) for an albedo, in leaf order."""
        numbers = vector.to(self.normals.dtype)
        values: list[torch.Tensor] = [numbers] * len(self.leaves)
        for group in self.groups:
            if group.kind == "albedo":
                found = numbers[group.index[0]][..., None]
            else:
                found = KINDS[group.kind].formula(self.normals, *self._arguments(group, numbers))[..., 0, :]
            for k, value in zip(group.leaves, found.unbind(0), strict=True):
                values[k] = value
        return values

    def compose(self, values: list[torch.Tensor]) -> torch.Tensor:
        """The picture from the leaves' pictures, (3 or 1, N)."""
        found = iter(values)

        def value(node: Node) -> torch.Tensor:
            if isinstance(node, Leaf):
                return next(found)
            layers = [value(child) for child in node.children]
            if node.mask is not None:
                layers.append(next(found))
            return BLENDS[node.kind].apply(*layers)

        return value(self.root)

    def nodes(self, values: list[torch.Tensor]) -> Iterator[tuple[str, Node, torch.Tensor, torch.Tensor | float]]:
        """(address, node, value, gain) of every node, masks included; the gain is d output / d node."""
        found = iter(values)
        shaded: dict[str, torch.Tensor] = {}

        def value(node: Node, address: str) -> torch.Tensor:
            if isinstance(node, Leaf):
                shaded[address] = next(found)
                return shaded[address]
            layers = [value(child, f"{address}.{k}.{child.kind}") for k, child in enumerate(node.children)]
            if node.mask is not None:
                layers.append(value(node.mask, f"{address}.mask"))
            shaded[address] = BLENDS[node.kind].apply(*layers)
            return shaded[address]

        value(self.root, self.root.kind)
        stack: list[tuple[str, Node, torch.Tensor | float]] = [(self.root.kind, self.root, 1.0)]
        while stack:
            address, node, gain = stack.pop()
            yield address, node, shaded[address], gain
            if isinstance(node, Operator):
                below = [(f"{address}.{k}.{child.kind}", child) for k, child in enumerate(node.children)]
                if node.mask is not None:
                    below.append((f"{address}.mask", node.mask))
                gains = BLENDS[node.kind].gains(*(shaded[where] for where, _ in below))
                stack.extend((where, child, gain * own) for (where, child), own in zip(below, gains, strict=True))

    def jacobian(self, vector: torch.Tensor, values: list[torch.Tensor], weight: torch.Tensor | float = 1.0) -> torch.Tensor:
        """d picture / d free coordinates times the ``weight`` of each pixel, (F, 3, N)."""
        count = self.pixels.count
        gains = {address: gain for address, node, _, gain in self.nodes(values) if isinstance(node, Leaf)}
        jacobian = torch.empty(self.free, 3, count, dtype=self.normals.dtype)
        numbers = vector.to(self.normals.dtype)
        basis = self.tangents(vector).to(self.normals.dtype)
        for group in self.groups:
            if not group.pattern:
                continue
            rows, width = len(group.leaves), len(group.pattern)
            block = jacobian[group.first : group.first + rows * width].view(rows, width, 3, count)
            gain = (
                torch.stack([torch.as_tensor(gains[self.addresses[k]], dtype=numbers.dtype).expand(3, count) for k in group.leaves])
                * weight
            )
            if group.kind == "albedo":
                block.zero_()
                for column, (_, channel, _) in enumerate(group.pattern):
                    block[:, column, channel] = gain[:, channel]
            elif group.kind in ANALYTIC:
                torch.mul(self._analytic(group, numbers, values, basis)[:, :, None], gain[:, None], out=block)
            elif group.kind == "environment":
                torch.mul(self._environment(group, numbers, values, basis), gain, out=block[0])
            else:
                torch.mul(self._automatic(group, numbers, basis), gain[:, None], out=block)
        return jacobian

    def tangents(self, vector: torch.Tensor) -> torch.Tensor:
        """Two unit vectors across the direction that starts at each number of the vector, (P, 2, 3); zero elsewhere.

        A fit asks twice for each vector, for its Jacobian and for the step from it.
        """
        if self._last_tangents is None or self._last_tangents[0] is not vector:
            self._last_tangents = vector, self._tangents(vector)
        return self._last_tangents[1]

    def _tangents(self, vector: torch.Tensor) -> torch.Tensor:
        basis = torch.zeros(vector.shape[0], 2, 3, dtype=vector.dtype)
        if len(self.directions):
            direction = F.normalize(vector[self.spread], dim=-1)
            helper = torch.where(
                direction[:, 2:].abs() < 0.9, direction.new_tensor([[0.0, 0.0, 1.0]]), direction.new_tensor([[1.0, 0.0, 0.0]])
            )
            first = F.normalize(torch.linalg.cross(helper, direction), dim=-1)
            basis[self.directions] = torch.stack([first, torch.linalg.cross(direction, first)], dim=1)
        return basis

    def _analytic(self, group: _Group, numbers: torch.Tensor, values: list[torch.Tensor], basis: torch.Tensor) -> torch.Tensor:
        """Derivatives of grey leaves by their own free columns, (K, columns, N)."""
        arguments = self._arguments(group, numbers)
        toward = facing(self.normals, arguments[0])[:, 0, 0, :]
        value = torch.stack([values[k][0] for k in group.leaves])
        slope, *partials = ANALYTIC[group.kind](value, toward, self.grazing, *arguments[1:])
        across = torch.matmul(basis[group.index[0][:, 0]], self.pixels.normals) * slope[:, None]
        columns = [across[:, tangent] if tangent >= 0 else partials[p - 1] for p, _, tangent in group.pattern]
        return torch.stack([column.expand_as(toward) for column in columns], dim=1)

    def _environment(self, group: _Group, numbers: torch.Tensor, values: list[torch.Tensor], basis: torch.Tensor) -> torch.Tensor:
        """Derivatives of an environment by its own free columns, (columns, 3, N)."""
        direction, sharpness, color = (argument[0] for argument in self._arguments(group, numbers))
        value = values[group.leaves[0]]
        mirrored = reflect(self.normals)[:, 0]
        turned, sharpened, lobe = environment(mirrored, value, direction, sharpness, color, basis[group.index[0][0, ::3]])
        columns = torch.zeros(len(group.pattern), 3, mirrored.shape[1], dtype=mirrored.dtype)
        for column, (p, offset, tangent) in enumerate(group.pattern):
            if tangent >= 0:
                columns[column] = turned[offset // 3, tangent]
            elif p == 1:
                columns[column] = sharpened[offset]
            else:
                columns[column, offset % 3] = lobe[offset // 3] * (value[offset % 3] < 1.0)
        return columns

    def _automatic(self, group: _Group, numbers: torch.Tensor, basis: torch.Tensor) -> torch.Tensor:
        """Derivatives of any leaves by their own free columns, (K, columns, 1 or 3, N)."""
        arguments = self._arguments(group, numbers)
        tangents = [argument.new_zeros(len(group.pattern), *argument.shape) for argument in arguments]
        for d, (p, offset, tangent) in enumerate(group.pattern):
            flat = tangents[p][d].view(len(group.leaves), -1)
            if tangent >= 0:
                flat[:, offset : offset + 3] = basis[group.index[p][:, offset], tangent]
            else:
                flat[:, offset] = 1.0
        if any(isinstance(stored, Raster) for stored in self.leaves[group.leaves[0]].values):
            return self._differences(group.kind, arguments, tangents).transpose(0, 1)
        return forward_mode(group.kind, self.normals, arguments, tangents).transpose(0, 1)

    def _differences(self, kind: str, arguments: list[torch.Tensor], tangents: list[torch.Tensor]) -> torch.Tensor:
        """Central differences, for look-ups in pictures, which PyTorch does not differentiate forwards; (D, K, C, N)."""
        step = 1e-6 if self.normals.dtype is torch.float64 else 1e-3
        sides = []
        for side in (step, -step):
            shaded = [
                KINDS[kind].formula(self.normals, *(a + side * t[d] for a, t in zip(arguments, tangents, strict=True)))
                for d in range(len(tangents[0]))
            ]
            sides.append(torch.stack(shaded)[..., 0, :])
        return (sides[0] - sides[1]) / (2.0 * step)

    def move(self, vector: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """The vector after a step in the free coordinates, inside its bounds."""
        moved = vector.clone()
        moved[self.number[self.linear_rows]] += step[self.linear_rows]
        moved[self.number[self.log_rows]] *= step[self.log_rows].clamp(-1.5, 1.5).exp()
        kept = self.number[self.plain_rows]
        moved[kept] = moved[kept].clamp(self.low[self.plain_rows], self.high[self.plain_rows])
        if len(self.directions):
            offset = (step[self.tangential].view(-1, 2, 1) * self.tangents(vector)[self.directions]).sum(1)
            moved[self.spread] = F.normalize(vector[self.spread] + offset, dim=-1)
        return moved

    def scale(self, vector: torch.Tensor) -> torch.Tensor:
        """d number / d coordinate where it is not 1: the number itself for logarithmic ones, (F,)."""
        return torch.where(self.log, vector[self.number], torch.ones_like(vector[self.number]))

    def start(self) -> torch.Tensor:
        """The tree's own numbers as a vector (P,), inside their bounds."""
        vector = self.layout.pack(self.root)
        vector[self.number] = torch.where(self.plain, vector[self.number].clamp(self.low, self.high), vector[self.number])
        return vector

    def held(self, vector: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        """The coordinates at a bound that a gradient (F,) pushes outwards, (F,) bool."""
        numbers = vector[self.number]
        return ((numbers <= self.low) & (gradient > 0)) | ((numbers >= self.high) & (gradient < 0))


def _rows(chosen: torch.Tensor) -> torch.Tensor:
    """The numbers of the true entries of (F,) bool."""
    return chosen.nonzero()[:, 0]
