"""Second-order fitting of a given structure: Levenberg-Marquardt on the pixels of one picture.

Every operator is affine in each of its inputs, and every pixel stands alone. So the derivative of the picture by a
leaf's parameter is the product of two pictures: how much the output follows that leaf (its *gain*, one pass down the
tree) and the leaf's own derivative. A Jacobian costs about as much as a few renders, and the normal equations are small
and dense. Directions move on the sphere (two tangent coordinates), logarithmic parameters by factors, and numbers at
their bounds are held there while the gradient pushes outwards.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import torch
import torch.nn.functional as F

from unshade.blend import BLENDS
from unshade.fit.derivatives import ANALYTIC, forward_mode
from unshade.fit.fitted import Fitted
from unshade.fit.pixels import Pixels
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster
from unshade.parameters import Layout
from unshade.shading import facing
from unshade.types import Image, Mask


COARSE_SIZE = 40
"""Pictures are averaged down to this many pixels a side where edges do not matter yet."""

COARSE_SOFTNESS = 0.04
FINE_SOFTNESS = 0.012
"""Narrowest edges while fitting, about 1.5 pixels of a picture of 256: a narrower one has no slope that a pixel could see."""


class Model:
    """A structure at given pixels: values, gains and Jacobian."""

    def __init__(self, root: Node, pixels: Pixels, locked: Collection[str] = (), softest: float = 0.0) -> None:
        self.root, self.pixels = root, pixels
        self.layout = Layout.of(root)
        self.normals = pixels.normals[:, None, :]
        self.grazing = (1.0 - pixels.normals[2]).clamp(1e-6, 1.0)
        self.leaves: list[Leaf] = []
        self.addresses: list[str] = []
        self._collect(root, root.kind)
        self._columns(frozenset(locked))
        soft = torch.tensor([self.layout.names[k].endswith(".softness") for k in self.number.tolist()], dtype=torch.bool)
        self.low = torch.where(soft, self.low.clamp(min=softest), self.low)

    def _collect(self, node: Node, address: str) -> None:
        if isinstance(node, Leaf):
            self.leaves.append(node)
            self.addresses.append(address)
            return
        for index, child in enumerate(node.children):
            self._collect(child, f"{address}.{index}.{child.kind}")
        if node.mask is not None:
            self._collect(node.mask, f"{address}.mask")

    def _columns(self, locked: frozenset[str]) -> None:
        """Give every free number a column: two a direction, one for any other."""
        layout = self.layout
        self.columns: list[list[tuple[int, int]]] = []  # per leaf: (number, tangent 0/1 or -1)
        for leaf, address, slots in zip(self.leaves, self.addresses, layout.slots, strict=True):
            own: list[tuple[int, int]] = []
            held = any(address == where or address.startswith(where + ".") for where in locked)
            for parameter, slot in zip(KINDS[leaf.kind].parameters, slots, strict=True):
                if held or f"{address}.{parameter.name}" in locked:
                    continue
                if parameter.type == "direction":
                    own += [(start, tangent) for start in range(slot.start, slot.stop, 3) for tangent in (0, 1)]
                else:
                    own += [(number, -1) for number in range(slot.start, slot.stop) if layout.free[number]]
            self.columns.append(own)
        flat = [column for own in self.columns for column in own]
        self.free = len(flat)
        self.first = [0]
        for own in self.columns:
            self.first.append(self.first[-1] + len(own))
        number = torch.tensor([n for n, _ in flat], dtype=torch.long)
        tangent = torch.tensor([t for _, t in flat], dtype=torch.long)
        self.number, self.plain = number, tangent < 0
        self.log = layout.logarithmic[number] & self.plain if self.free else self.plain
        self.directions = number[tangent == 0]
        self.low = torch.where(self.plain, layout.lower[number], -torch.inf) if self.free else layout.lower[:0]
        self.high = torch.where(self.plain, layout.upper[number], torch.inf) if self.free else layout.upper[:0]
        groups: dict[str, list[int]] = {}
        for k, leaf in enumerate(self.leaves):
            groups.setdefault(leaf.kind if not KINDS[leaf.kind].repeats and KINDS[leaf.kind].parameters[0].type != "raster" else f"{leaf.kind}#{k}", []).append(k)
        self.groups = list(groups.values())
        self.index = [
            [torch.tensor([range(*self.layout.slots[k][p].indices(layout.size)) for k in group], dtype=torch.long) for p in range(len(KINDS[self.leaves[group[0]].kind].parameters))]
            for group in self.groups
        ]

    def _arguments(self, group: list[int], index: list[torch.Tensor], numbers: torch.Tensor) -> list[torch.Tensor]:
        """One (K, n) tensor a parameter; (1, lobes, n) for a kind that repeats; a raster as (1, C, h, w)."""
        kind = KINDS[self.leaves[group[0]].kind]
        arguments = []
        for p, parameter in enumerate(kind.parameters):
            stored = self.leaves[group[0]].values[p]
            if isinstance(stored, Raster):
                arguments.append(stored.tensor(numbers.device, numbers.dtype)[None])
            else:
                taken = numbers[index[p]]
                arguments.append(taken.unflatten(-1, (-1, parameter.size)) if kind.repeats else taken)
        return arguments

    def evaluate(self, vector: torch.Tensor) -> list[torch.Tensor]:
        """Every leaf's picture, (1 or 3, N) or (3, 1) for an albedo, in leaf order."""
        numbers = vector.to(self.normals.dtype)
        values: list[torch.Tensor] = [numbers] * len(self.leaves)
        for group, index in zip(self.groups, self.index, strict=True):
            kind = self.leaves[group[0]].kind
            if kind == "albedo":
                for k, color in zip(group, numbers[index[0]], strict=True):
                    values[k] = color[:, None]
                continue
            found = KINDS[kind].formula(self.normals, *self._arguments(group, index, numbers))[..., 0, :]
            for k, value in zip(group, found, strict=True):
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

    def jacobian(self, vector: torch.Tensor, values: list[torch.Tensor]) -> torch.Tensor:
        """d picture / d free coordinates, (F, 3, N)."""
        count = self.pixels.count
        gain = {address: g for address, _, _, g in self.nodes(values)}
        jacobian = torch.zeros(self.free, 3, count, dtype=self.normals.dtype)
        numbers = vector.to(self.normals.dtype)
        basis = self.tangents(vector).to(self.normals.dtype)
        for group, index in zip(self.groups, self.index, strict=True):
            name = self.leaves[group[0]].kind
            wanted = [k for k in group if self.columns[k]]
            if not wanted:
                continue
            if name == "albedo":
                for k in wanted:
                    g = torch.as_tensor(gain[self.addresses[k]], dtype=numbers.dtype).expand(3, count)
                    for column, (number, _) in enumerate(self.columns[k], self.first[k]):
                        channel = number - int(self.layout.slots[k][0].start)
                        jacobian[column, channel] = g[channel]
            elif name in ANALYTIC:
                self._analytic(name, group, index, numbers, values, basis, gain, jacobian)
            else:
                self._automatic(name, group, index, numbers, basis, gain, jacobian)
        return jacobian

    def tangents(self, vector: torch.Tensor) -> torch.Tensor:
        """Two unit vectors across the direction that starts at each number of the vector, (P, 2, 3); zero elsewhere."""
        basis = torch.zeros(vector.shape[0], 2, 3, dtype=vector.dtype)
        if len(self.directions):
            direction = torch.stack([vector[self.directions + k] for k in range(3)], dim=-1)
            direction = F.normalize(direction, dim=-1)
            helper = torch.where(direction[:, 2:].abs() < 0.9, direction.new_tensor([[0.0, 0.0, 1.0]]), direction.new_tensor([[1.0, 0.0, 0.0]]))
            first = F.normalize(torch.linalg.cross(helper, direction), dim=-1)
            basis[self.directions] = torch.stack([first, torch.linalg.cross(direction, first)], dim=1)
        return basis

    def _analytic(self, name, group, index, numbers, values, basis, gain, jacobian) -> None:  # type: ignore[no-untyped-def]
        arguments = self._arguments(group, index, numbers)
        toward = facing(self.normals, arguments[0])[:, 0, 0, :]
        value = torch.stack([values[k][0] for k in group])
        slope, *partials = ANALYTIC[name](value, toward, self.grazing, *arguments[1:])
        across = torch.einsum("ktd,dn->ktn", basis[index[0][:, 0]], self.pixels.normals)
        own = {-1: None, 0: across[:, 0] * slope, 1: across[:, 1] * slope}
        for row, k in enumerate(group):
            g = gain[self.addresses[k]]
            start = int(self.layout.slots[k][0].start)
            for column, (number, tangent) in enumerate(self.columns[k], self.first[k]):
                derivative = own[tangent][row] if tangent >= 0 else partials[number - start - 3][row]
                torch.mul(derivative.expand(3, -1), g, out=jacobian[column])

    def _automatic(self, name, group, index, numbers, basis, gain, jacobian) -> None:  # type: ignore[no-untyped-def]
        kind = KINDS[name]
        for row, k in enumerate(group):
            arguments = [a[row : row + 1] for a in self._arguments(group, index, numbers)]
            tangents = [a.new_zeros(len(self.columns[k]), *a.shape) for a in arguments]
            for d, (number, tangent) in enumerate(self.columns[k]):
                p = next(p for p, slot in enumerate(self.layout.slots[k]) if slot.start <= number < slot.stop)
                flat = tangents[p][d].view(-1)
                offset = number - self.layout.slots[k][p].start
                if tangent >= 0:
                    flat[offset : offset + 3] = basis[number, tangent]
                else:
                    flat[offset] = 1.0
            found = forward_mode(kind.name, self.normals, arguments, tangents)[:, 0]
            first = self.first[k]
            jacobian[first : first + len(found)] = found * gain[self.addresses[k]]

    def move(self, vector: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """The vector after a step in the free coordinates, inside its bounds."""
        moved = vector.clone()
        plain, log = self.plain & ~self.log, self.log
        moved[self.number[plain]] += step[plain]
        moved[self.number[log]] *= step[log].clamp(-1.5, 1.5).exp()
        kept = self.number[self.plain]
        moved[kept] = moved[kept].clamp(self.low[self.plain], self.high[self.plain])
        if len(self.directions):
            offset = (step[~self.plain].view(-1, 2, 1) * self.tangents(vector)[self.directions]).sum(1)
            for k in range(3):
                moved[self.directions + k] += offset[:, k]
            length = sum(moved[self.directions + k].square() for k in range(3)).sqrt()  # type: ignore[union-attr]
            for k in range(3):
                moved[self.directions + k] /= length
        return moved

    def scale(self, vector: torch.Tensor) -> torch.Tensor:
        """d number / d coordinate where it is not 1: the number itself for logarithmic ones, (F,)."""
        return torch.where(self.log, vector[self.number], torch.ones_like(vector[self.number]))


def minimise(model: Model, vector: torch.Tensor, steps: int, tolerance: float = 1e-4, damping: float = 1e-2) -> tuple[torch.Tensor, float, list[float]]:
    """Levenberg-Marquardt with Marquardt's scaling and bounds.

    Args:
        vector: (P,) float64 start. steps: most evaluations. tolerance: smallest relative decrease worth another step.
    Returns:
        The vector, its mean squared error, and the error after each accepted step.
    """
    root_weight = model.pixels.weight.sqrt()
    target = model.pixels.target

    def residual(values: list[torch.Tensor]) -> torch.Tensor:
        return (model.compose(values) - target) * root_weight

    values = model.evaluate(vector)
    error_image = residual(values)
    error = float(error_image.double().square().sum()) / 3.0
    history = [error]
    if model.free == 0:
        return vector, error, history
    fresh, slow = True, 0
    for _ in range(steps):
        if fresh:
            jacobian = model.jacobian(vector, values).mul_(root_weight)
            flat = jacobian.view(model.free, -1)
            scale = model.scale(vector)
            hessian = (flat @ flat.T).double() * scale[:, None] * scale
            gradient = (flat @ error_image.reshape(-1)).double() * scale
            numbers = vector[model.number]
            held = ((numbers <= model.low) & (gradient > 0)) | ((numbers >= model.high) & (gradient < 0))
            diagonal = hessian.diagonal().clamp(min=1e-9)
            dead = held | (hessian.diagonal() < 1e-14)
            hessian[dead] = 0.0
            hessian[:, dead] = 0.0
            gradient = torch.where(dead, torch.zeros_like(gradient), gradient)
        damped = hessian + torch.diag(diagonal * damping + 1e-10)
        factor, info = torch.linalg.cholesky_ex(damped)
        if int(info) != 0:
            damping = max(damping * 10.0, 1e-6)
            fresh = False
            continue
        step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
        candidate = model.move(vector, step)
        candidate_values = model.evaluate(candidate)
        candidate_image = residual(candidate_values)
        candidate_error = float(candidate_image.double().square().sum()) / 3.0
        fresh = candidate_error < error
        if fresh:
            decrease = (error - candidate_error) / max(error, 1e-30)
            vector, values, error_image, error = candidate, candidate_values, candidate_image, candidate_error
            history.append(error)
            damping = max(damping * 0.2, 1e-8)
            slow = slow + 1 if decrease < tolerance else 0
            if slow >= 2 or error < 1e-12:
                break
        else:
            damping *= 6.0
            if damping > 1e7:
                break
    return vector, error, history


def fit_pixels(pixels: Pixels, root: Node, *, locked: Collection[str] = (), steps: int = 30, tolerance: float = 1e-4, softest: float = 0.0) -> Fitted:
    """Fit the parameters of a structure at given pixels, from the tree's own numbers."""
    with torch.no_grad():
        model = Model(root, pixels, locked, softest)
        start = model.layout.pack(root)
        start[model.number] = torch.where(model.plain, start[model.number].clamp(model.low, model.high), start[model.number])
        vector, error, history = minimise(model, start, steps, tolerance)
        return Fitted(model.layout.unpack(root, vector), error, tuple(history))


def fit_least_squares(
    target: Image, mask: Mask, root: Node, *, seed: int = 0, locked: Collection[str] = (), steps: int = 60, count: int = 8000
) -> Fitted:
    """Fit the parameters of a tree to a picture: first on coarse averages, then on points of the full picture.

    Args:
        target: (3, H, H) in [0, 1]. mask: (1, H, H) bool, pixels that count. root: the structure and the start.
        seed: of the choice of points. locked: addresses that keep their numbers. steps: most steps on each set.
    Returns:
        The tree and its mean squared error on the points.
    """
    if target.shape[-1] > COARSE_SIZE:
        root = fit_pixels(Pixels.of(target, mask, COARSE_SIZE), root, locked=locked, steps=steps, softest=COARSE_SOFTNESS).root
    return fit_pixels(Pixels.important(target, mask, count, seed), root, locked=locked, steps=steps)
