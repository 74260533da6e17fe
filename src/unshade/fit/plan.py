"""What a second-order fit has to know of a structure besides its numbers: how its pictures are joined, and what may move.

Trees that differ in their numbers alone share one plan, as long as the same of their edges are hard. A search looks at most structures
more than once.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import torch

from unshade.nodes import KINDS, Leaf, Node, Operator, walk
from unshade.parameters import Layout, Outline, layout_of, outline_of

Limits: TypeAlias = dict[str, tuple[float, float]]
NO_LIMITS: Limits = {}

EDGE = ("direction", "threshold", "center", "width", "radius", "softness")
"""Parameters that place an edge. A hard edge has no slope, so a fit leaves its place alone; `model.soften` it to move it."""


def softness_of(leaf: Leaf) -> float:
    """Width of the edge of a mask or a toon leaf; infinite for a leaf without one."""
    return leaf["softness"][0] if any(parameter.name == "softness" for parameter in KINDS[leaf.kind].parameters) else math.inf


def is_hard(leaf: Leaf) -> bool:
    """True for a mask or a toon leaf whose edge is a step."""
    return softness_of(leaf) == 0.0


def is_locked(address: str, parameter: str, locked: Collection[str]) -> bool:
    """True where a leaf, a subtree above it or this parameter of it is to keep its numbers."""
    return any(address == where or address.startswith(f"{where}.") or where == f"{address}.{parameter}" for where in locked)


@dataclass(frozen=True)
class Join:
    """An operator. Places are those of `nodes.walk`."""

    place: int
    kind: str
    below: tuple[int, ...]
    """Its children, and its mask after them."""


@dataclass(frozen=True)
class Group:
    """Leaves of one kind with the same free numbers, evaluated and differentiated as one batch."""

    kind: str
    leaves: tuple[int, ...]
    index: tuple[torch.Tensor, ...]
    """One (K, n) index into the flat vector a parameter."""
    pattern: tuple[tuple[int, int, int], ...]
    """(parameter, offset in it, tangent 0 or 1, or -1 for a plain number) of each free column of a leaf."""
    first: int
    """First row in the Jacobian; K * len(pattern) rows follow, leaf by leaf."""


@dataclass(frozen=True)
class Plan:
    """A structure, the numbers of it that are free, and their bounds. F rows of the Jacobian, P numbers in the flat vector."""

    layout: Layout
    addresses: tuple[str, ...]
    """One a node."""
    leaf_places: tuple[int, ...]
    """The nodes that are leaves."""
    joins: tuple[Join, ...]
    """The others, parents first."""
    groups: tuple[Group, ...]
    free: int
    """F."""
    order: torch.Tensor
    """The vector's numbers group by group, parameter by parameter, as `widths` and `shapes` tell them apart."""
    widths: tuple[int, ...]
    shapes: tuple[tuple[int, ...], ...]
    number: torch.Tensor
    """(F,) the number of the vector that a row moves."""
    plain: torch.Tensor
    """(F,) bool: not a tangent of a direction."""
    log: torch.Tensor
    """(F,) bool: moves by factors."""
    low: torch.Tensor
    high: torch.Tensor
    """(F,) bounds of the numbers; infinite for tangents."""
    plain_rows: torch.Tensor
    tangential: torch.Tensor
    """The rows of each sort."""
    directions: torch.Tensor
    """The first number of each free direction."""
    spread: torch.Tensor
    """(D, 3) its numbers."""

    @staticmethod
    def of(root: Node, locked: Collection[str], limits: Limits) -> Plan:
        """The plan of a tree; see `Model` for the arguments."""
        hard = tuple(is_hard(node) for _, node in walk(root) if isinstance(node, Leaf))
        return _plan(outline_of(root), _shape(root), hard, frozenset(locked), tuple(sorted(limits.items())))


Shape: TypeAlias = tuple[tuple[str, str, int], ...]


def _shape(root: Node) -> Shape:
    """(address, kind, nodes right below) of every node."""
    return tuple(
        (address, node.kind, len(node.children) + (node.mask is not None) if isinstance(node, Operator) else 0)
        for address, node in walk(root)
    )


def _joins(shape: Shape) -> tuple[Join, ...]:
    """The operators: one that has not all of its children takes the next node."""
    below: list[list[int]] = [[] for _ in shape]
    open_: list[int] = []
    for place, (_, _, count) in enumerate(shape):
        if open_:
            below[open_[-1]].append(place)
            if len(below[open_[-1]]) == shape[open_[-1]][2]:
                open_.pop()
        if count:
            open_.append(place)
    return tuple(Join(place, kind, tuple(below[place])) for place, (_, kind, count) in enumerate(shape) if count)


@lru_cache(maxsize=256)
def _plan(
    outline: Outline,
    shape: Shape,
    hard: tuple[bool, ...],
    locked: frozenset[str],
    limits: tuple[tuple[str, tuple[float, float]], ...],
) -> Plan:
    with torch.inference_mode(False):  # plans are shared, also with fits by gradient
        layout = layout_of(outline)
        groups, free = _grouped(outline, layout, hard, locked)
        order, widths, shapes = _order(groups)
        flat = [
            (layout.slots[k][p].start + offset, tangent) for group in groups for k in group.leaves for p, offset, tangent in group.pattern
        ]
        number = torch.tensor([number for number, _ in flat], dtype=torch.long)
        plain = torch.tensor([tangent < 0 for _, tangent in flat], dtype=torch.bool)
        log = layout.logarithmic[number] & plain
        low, high = _bounds(groups, dict(limits))
        directions = number[torch.tensor([tangent == 0 for _, tangent in flat], dtype=torch.bool)]
        return Plan(
            layout=layout,
            joins=_joins(shape),
            addresses=tuple(address for address, _, _ in shape),
            leaf_places=tuple(place for place, (_, _, count) in enumerate(shape) if not count),
            groups=groups,
            free=free,
            order=order,
            widths=widths,
            shapes=shapes,
            number=number,
            plain=plain,
            log=log,
            low=torch.where(plain, layout.lower[number].maximum(low), -torch.inf),
            high=torch.where(plain, layout.upper[number].minimum(high), torch.inf),
            plain_rows=_rows(plain),
            tangential=_rows(~plain),
            directions=directions,
            spread=directions[:, None] + torch.arange(3),
        )


def _grouped(outline: Outline, layout: Layout, hard: tuple[bool, ...], locked: frozenset[str]) -> tuple[tuple[Group, ...], int]:
    """The leaves that are one batch each, and the number of all free columns."""
    batches: dict[tuple, list[int]] = {}
    for k, (address, name, _, _) in enumerate(outline):
        kind = KINDS[name]
        alone = kind.repeats or any(parameter.type == "raster" for parameter in kind.parameters)
        batches.setdefault((name, _pattern(k, address, name, layout, hard[k], locked), k if alone else -1), []).append(k)
    groups, first = [], 0
    for (name, pattern, _), members in batches.items():
        index = tuple(
            torch.tensor([list(range(slot.start, slot.stop)) for slot in (layout.slots[k][p] for k in members)], dtype=torch.long)
            for p in range(len(KINDS[name].parameters))
        )
        groups.append(Group(name, tuple(members), index, pattern, first))
        first += len(members) * len(pattern)
    return tuple(groups), first


def _pattern(k: int, address: str, name: str, layout: Layout, hard: bool, locked: frozenset[str]) -> tuple[tuple[int, int, int], ...]:
    """The free columns of one leaf: two a direction, one for any other number that is not held."""
    own: list[tuple[int, int, int]] = []
    for p, (parameter, slot) in enumerate(zip(KINDS[name].parameters, layout.slots[k], strict=True)):
        if is_locked(address, parameter.name, locked) or (hard and parameter.name in EDGE):
            continue
        if parameter.type == "direction":
            own += [(p, offset, tangent) for offset in range(0, slot.stop - slot.start, 3) for tangent in (0, 1)]
        else:
            own += [(p, offset, -1) for offset in range(slot.stop - slot.start) if layout.free[slot.start + offset]]
    return tuple(own)


def _order(groups: tuple[Group, ...]) -> tuple[torch.Tensor, tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """See `Plan.order`: (K, n) numbers of a parameter, (1, lobes, n) of a kind that repeats; a raster has none."""
    every = [
        (KINDS[group.kind].repeats, parameter.size, index)
        for group in groups
        for parameter, index in zip(KINDS[group.kind].parameters, group.index, strict=True)
        if parameter.type != "raster"
    ]
    numbers = [number for _, _, index in every for number in index.flatten().tolist()]
    shapes = tuple((1, index.numel() // size, size) if repeats else tuple(index.shape) for repeats, size, index in every)
    return torch.tensor(numbers, dtype=torch.long), tuple(index.numel() for _, _, index in every), shapes


def _bounds(groups: tuple[Group, ...], limits: Limits) -> tuple[torch.Tensor, torch.Tensor]:
    """The narrower ranges of all rows, (F,) each."""
    names = [(g.kind, KINDS[g.kind].parameters[p].name) for g in groups for _ in g.leaves for p, _, _ in g.pattern]
    ranges = [limits.get(f"{kind}.{name}", limits.get(name, (-math.inf, math.inf))) for kind, name in names]
    low, high = torch.tensor(ranges, dtype=torch.float64).reshape(-1, 2).unbind(1)
    return low, high


def _rows(chosen: torch.Tensor) -> torch.Tensor:
    """The numbers of the true entries of (F,) bool."""
    return chosen.nonzero()[:, 0]
