"""A structure at the pixels of one picture: values, gains and the Jacobian.

Every operator is affine in each of its inputs, and every pixel stands alone. So the derivative of the picture by a
leaf's parameter is the product of two pictures: how much the output follows that leaf (its *gain*, one pass down the
tree) and the leaf's own derivative. A Jacobian costs about as much as a few renders. Directions move on the sphere (two
tangent coordinates), logarithmic parameters by factors.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator

import torch
import torch.nn.functional as F

from unshade.blend import BLENDS
from unshade.fit.derivatives import ANALYTIC, environment, forward_mode
from unshade.fit.pixels import Pixels
from unshade.fit.plan import NO_LIMITS, Group, Limits, Plan, is_hard, is_locked
from unshade.nodes import KINDS, Leaf, Node, Raster, replace, walk
from unshade.shading import facing
from unshade.sphere import reflect


def soften(root: Node, softness: float, locked: Collection[str] = ()) -> Node:
    """The tree with every hard edge made this wide, locked ones aside."""
    for address, node in walk(root):
        if isinstance(node, Leaf) and is_hard(node) and not is_locked(address, "softness", locked):
            root = replace(root, address, node.set(softness=softness))
    return root


class Model:
    """A structure at given pixels: values, gains and Jacobian.

    What was computed last is kept: a vector or a list of values that was given once is not to be changed, and nothing is differentiated
    by PyTorch.

    Args:
        root: the structure. pixels: where. locked: addresses of leaves, subtrees or ``address.parameter`` that are kept.
        softest: least softness of an edge. limits: narrower ranges by ``parameter`` or ``kind.parameter``.
    """

    def __init__(self, root: Node, pixels: Pixels, locked: Collection[str] = (), softest: float = 0.0, limits: Limits = NO_LIMITS) -> None:
        self.root, self.pixels = root, pixels
        edges = {"softness": (softest, limits.get("softness", (0.0, math.inf))[1])}
        self.plan = Plan.of(root, locked, limits | edges)
        self.layout, self.free, self.number = self.plan.layout, self.plan.free, self.plan.number
        self.normals = pixels.normals[:, None, :]
        self.grazing = (1.0 - pixels.normals[2]).clamp(1e-6, 1.0)
        self.every_node = [node for _, node in walk(root)]
        self.leaves = [node for node in self.every_node if isinstance(node, Leaf)]
        self._last_arguments: tuple[torch.Tensor, list[list[torch.Tensor]]] | None = None
        self._last_pictures: tuple[list[torch.Tensor], list[torch.Tensor]] | None = None
        self._last_tangents: tuple[torch.Tensor, torch.Tensor] | None = None

    def _arguments(self, vector: torch.Tensor) -> list[list[torch.Tensor]]:
        """One list a group of one (K, n) tensor a parameter; (1, lobes, n) for a kind that repeats; a raster as (1, C, h, w).

        A fit asks twice for each vector, for the pictures and for their derivatives.
        """
        if self._last_arguments is None or self._last_arguments[0] is not vector:
            plan = self.plan
            parts = vector.to(self.normals.dtype).index_select(0, plan.order).split(plan.widths)
            found = iter([part.view(shape) for part, shape in zip(parts, plan.shapes, strict=True)])
            arguments = [
                [
                    stored.tensor(vector.device, self.normals.dtype)[None] if isinstance(stored, Raster) else next(found)
                    for stored in self.leaves[group.leaves[0]].values
                ]
                for group in plan.groups
            ]
            self._last_arguments = vector, arguments
        return self._last_arguments[1]

    def evaluate(self, vector: torch.Tensor) -> list[torch.Tensor]:
        """Every leaf's picture, (1 or 3, N) or (3, 1) for an albedo, in leaf order."""
        values: list[torch.Tensor] = [vector] * len(self.leaves)
        for group, arguments in zip(self.plan.groups, self._arguments(vector), strict=True):
            if group.kind == "albedo":
                found = arguments[0][..., None]
            else:
                found = KINDS[group.kind].formula(self.normals, *arguments)[..., 0, :]
            # A kind without parameters has one picture, however many leaves are of it.
            for k, value in zip(group.leaves, found.expand(len(group.leaves), *found.shape[-2:]).unbind(0), strict=True):
                values[k] = value
        return values

    def compose(self, values: list[torch.Tensor]) -> torch.Tensor:
        """The picture from the leaves' pictures, (3 or 1, N)."""
        return self._pictures(values)[0]

    def _pictures(self, values: list[torch.Tensor]) -> list[torch.Tensor]:
        """Every node's picture, in the order of `nodes.walk`.

        A fit asks twice for the same values, for the picture and for the gains.
        """
        if self._last_pictures is None or self._last_pictures[0] is not values:
            pictures: list[torch.Tensor] = [values[0]] * len(self.every_node)
            for place, value in zip(self.plan.leaf_places, values, strict=True):
                pictures[place] = value
            for join in reversed(self.plan.joins):
                pictures[join.place] = BLENDS[join.kind].apply(*(pictures[below] for below in join.below))
            self._last_pictures = values, pictures
        return self._last_pictures[1]

    def _gains(self, pictures: list[torch.Tensor]) -> list[torch.Tensor | float]:
        """d output / d node of every node, in the same order."""
        gains: list[torch.Tensor | float] = [1.0] * len(pictures)
        for join in self.plan.joins:
            own = BLENDS[join.kind].gains(*(pictures[below] for below in join.below))
            for below, gain in zip(join.below, own, strict=True):
                gains[below] = gains[join.place] * gain if join.place else gain
        return gains

    def nodes(self, values: list[torch.Tensor]) -> Iterator[tuple[str, Node, torch.Tensor, torch.Tensor | float]]:
        """(address, node, value, gain) of every node, masks included; the gain is d output / d node."""
        pictures = self._pictures(values)
        yield from zip(self.plan.addresses, self.every_node, pictures, self._gains(pictures), strict=True)

    def jacobian(self, vector: torch.Tensor, values: list[torch.Tensor], weight: torch.Tensor | float = 1.0) -> torch.Tensor:
        """d picture / d free coordinates times the ``weight`` of each pixel, (F, 3, N)."""
        count, dtype = self.pixels.count, self.normals.dtype
        gains = self._gains(self._pictures(values))
        jacobian = torch.empty(self.free, 3, count, dtype=dtype)
        basis = self.tangents(vector).to(dtype)
        for group, arguments in zip(self.plan.groups, self._arguments(vector), strict=True):
            if not group.pattern:
                continue
            rows, width = len(group.leaves), len(group.pattern)
            block = jacobian[group.first : group.first + rows * width].view(rows, width, 3, count)
            own = [torch.as_tensor(gains[self.plan.leaf_places[k]] * weight, dtype=dtype).expand(3, count) for k in group.leaves]
            gain = torch.stack(own) if rows > 1 else own[0][None]
            if group.kind == "albedo":
                block.zero_()
                for column, (_, channel, _) in enumerate(group.pattern):
                    block[:, column, channel] = gain[:, channel]
            elif group.kind in ANALYTIC:
                torch.mul(self._analytic(group, arguments, values, basis)[:, :, None], gain[:, None], out=block)
            elif group.kind == "environment":
                torch.mul(self._environment(group, arguments, values, basis), gain, out=block[0])
            else:
                torch.mul(self._automatic(group, arguments, basis), gain[:, None], out=block)
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
        if len(self.plan.directions):
            direction = F.normalize(vector[self.plan.spread], dim=-1)
            helper = torch.where(
                direction[:, 2:].abs() < 0.9, direction.new_tensor([[0.0, 0.0, 1.0]]), direction.new_tensor([[1.0, 0.0, 0.0]])
            )
            first = F.normalize(torch.linalg.cross(helper, direction), dim=-1)
            basis[self.plan.directions] = torch.stack([first, torch.linalg.cross(direction, first)], dim=1)
        return basis

    def _analytic(self, group: Group, arguments: list[torch.Tensor], values: list[torch.Tensor], basis: torch.Tensor) -> torch.Tensor:
        """Derivatives of grey leaves by their own free columns, (K, columns, N)."""
        toward = facing(self.normals, arguments[0])[:, 0, 0, :]
        value = torch.stack([values[k][0] for k in group.leaves])
        slope, *partials = ANALYTIC[group.kind](value, toward, self.grazing, *arguments[1:])
        across = torch.matmul(basis[group.index[0][:, 0]], self.pixels.normals) * slope[:, None]
        columns = [across[:, tangent] if tangent >= 0 else partials[p - 1] for p, _, tangent in group.pattern]
        return torch.stack([column.expand_as(toward) for column in columns], dim=1)

    def _environment(self, group: Group, arguments: list[torch.Tensor], values: list[torch.Tensor], basis: torch.Tensor) -> torch.Tensor:
        """Derivatives of an environment by its own free columns, (columns, 3, N)."""
        direction, sharpness, color = (argument[0] for argument in arguments)
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

    def _automatic(self, group: Group, arguments: list[torch.Tensor], basis: torch.Tensor) -> torch.Tensor:
        """Derivatives of any leaves by their own free columns, (K, columns, 1 or 3, N)."""
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
        plan, moved = self.plan, vector.clone()
        own = vector[self.number]
        own = torch.where(plan.log, own * step.clamp(-1.5, 1.5).exp(), own + step)
        kept = plan.plain_rows
        moved[self.number[kept]] = own.clamp(plan.low, plan.high)[kept]
        if len(plan.directions):
            offset = (step[plan.tangential].view(-1, 2, 1) * self.tangents(vector)[plan.directions]).sum(1)
            moved[plan.spread] = F.normalize(vector[plan.spread] + offset, dim=-1)
        return moved

    def scale(self, vector: torch.Tensor) -> torch.Tensor:
        """d number / d coordinate where it is not 1: the number itself for logarithmic ones, (F,)."""
        return vector[self.number].where(self.plan.log, 1.0)

    def start(self) -> torch.Tensor:
        """The tree's own numbers as a vector (P,), inside their bounds."""
        vector = self.layout.pack(self.root)
        vector[self.number] = torch.where(self.plan.plain, vector[self.number].clamp(self.plan.low, self.plan.high), vector[self.number])
        return vector

    def held(self, vector: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        """The coordinates at a bound that a gradient (F,) pushes outwards, (F,) bool."""
        numbers = vector[self.number]
        return ((numbers <= self.plan.low) & (gradient > 0)) | ((numbers >= self.plan.high) & (gradient < 0))
