"""tree <-> flat vectors of its numbers, with bounds.

The vector holds every number of every leaf in walk order, rasters excepted: directions as 3 numbers, colours 3,
scalars 1. Nothing is rescaled, so packing and unpacking change no bit; `Layout.lower` and `upper` give the ranges,
and `Layout.logarithmic` says which numbers an optimiser should see on a logarithmic scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeAlias

import torch

from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, carried_amplitude
from unshade.types import Params


@dataclass(frozen=True)
class Layout:
    """Where the numbers of a structure stand in its flat vector."""

    slots: tuple[tuple[slice, ...], ...]
    """One entry a leaf in walk order (masks after the children of their mix), one slice a parameter."""
    names: tuple[str, ...]
    """One a number, ``address.parameter[.index]``."""
    types: tuple[str, ...]
    """One a number: direction, color, scalar or rotation."""
    lower: torch.Tensor
    upper: torch.Tensor
    logarithmic: torch.Tensor
    free: torch.Tensor
    """(P,) bool, false for an amplitude that the tint beside it carries."""

    @cached_property
    def is_direction(self) -> torch.Tensor:
        """(P,) bool, true for the numbers of directions."""
        return torch.tensor([kind == "direction" for kind in self.types], dtype=torch.bool)

    @property
    def size(self) -> int:
        """Numbers in the vector."""
        return len(self.names)

    @staticmethod
    def of(root: Node) -> Layout:
        """The layout of a structure. Trees that differ only in their numbers share one."""
        return layout_of(outline_of(root))

    def pack(self, root: Node) -> Params:
        """The numbers of a tree of this structure, (P,) float64."""
        return torch.tensor(
            [number for leaf in _leaves(root) for value in leaf.values if not isinstance(value, Raster) for number in value],
            dtype=torch.float64,
        )

    def unpack(self, root: Node, vector: Params) -> Node:
        """The tree with the numbers of a (P,) vector, brought into range."""
        vector = vector.detach().to("cpu", torch.float64)
        vector = torch.where(self.is_direction, vector, vector.clamp(self.lower, self.upper))
        numbers = vector.tolist()
        found = iter(self.slots)

        def rebuild(node: Node) -> Node:
            if isinstance(node, Leaf):
                slots = zip(node.values, next(found), strict=True)
                return Leaf(node.kind, tuple(old if isinstance(old, Raster) else tuple(numbers[slot]) for old, slot in slots), node.name)
            children = tuple(rebuild(child) for child in node.children)
            mask = rebuild(node.mask) if node.mask is not None else None
            return Operator(node.kind, children, mask, node.name)  # type: ignore[arg-type]

        return rebuild(root)


def _leaves(root: Node) -> list[Leaf]:
    if isinstance(root, Leaf):
        return [root]
    below = [leaf for child in root.children for leaf in _leaves(child)]
    return below + ([root.mask] if root.mask is not None else [])


Outline: TypeAlias = tuple[tuple[str, str, int, bool], ...]


def outline_of(root: Node, address: str = "") -> Outline:
    """(address, kind, lobes, amplitude is free) of every leaf in order: all that a layout depends on."""
    address = address or root.kind
    if isinstance(root, Leaf):
        return ((address, root.kind, root.lobes, True),)
    carried = carried_amplitude(root)
    found = [entry for index, child in enumerate(root.children) for entry in outline_of(child, f"{address}.{index}.{child.kind}")]
    if carried is not None:
        found = [(where, kind, lobes, kind != carried.kind) for where, kind, lobes, _ in found]
    if root.mask is not None:
        found.append((f"{address}.mask", root.mask.kind, root.mask.lobes, True))
    return tuple(found)


@lru_cache(maxsize=512)
def layout_of(outline: Outline) -> Layout:
    """The layout of all trees of an outline."""
    slots: list[tuple[slice, ...]] = []
    names: list[str] = []
    types: list[str] = []
    lower: list[float] = []
    upper: list[float] = []
    logarithmic: list[bool] = []
    free: list[bool] = []
    for address, kind_name, lobes, amplitude_is_free in outline:
        kind = KINDS[kind_name]
        own = []
        for parameter in kind.parameters:
            count = parameter.size * lobes
            own.append(slice(len(names), len(names) + count))
            names += [f"{address}.{parameter.name}" + (f".{k}" if count > 1 else "") for k in range(count)]
            types += [parameter.type] * count
            lower += [parameter.low] * count
            upper += [parameter.high] * count
            logarithmic += [parameter.logarithmic] * count
            free += [amplitude_is_free or parameter.name != kind.amplitude] * count
        slots.append(tuple(own))
    with torch.inference_mode(False):  # layouts are shared, also with fits by gradient
        return Layout(
            tuple(slots),
            tuple(names),
            tuple(types),
            torch.tensor(lower, dtype=torch.float64),
            torch.tensor(upper, dtype=torch.float64),
            torch.tensor(logarithmic, dtype=torch.bool),
            torch.tensor(free, dtype=torch.bool),
        )
