"""What differs between two trees, node by node."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from unshade.nodes import KINDS, Leaf, Node, Raster, Value, steps

MAX_PAIRS = 10_000
"""Most pairs of children that are compared to find the most alike."""


@dataclass(frozen=True)
class Change:
    """One difference: ``removed`` (only in the first tree), ``added`` (only in the second) or ``changed``."""

    what: str
    address: str
    """In the first tree; in the second for what is added."""
    parameter: str = ""
    """Of a change inside a leaf."""
    before: str = ""
    after: str = ""


def changes(first: Node, second: Node) -> list[Change]:
    """The differences between two trees, in the order of their nodes.

    The children of an operator are paired by how alike they are, not by their place, because the order of multiply and
    screen means nothing; only mix keeps its left and right.
    """
    return list(_changes(first, second, first.kind, second.kind))


def _changes(first: Node, second: Node, here: str, there: str) -> Iterator[Change]:
    if first.kind != second.kind:
        yield Change("removed", here, before=outline(first))
        yield Change("added", there, after=outline(second))
        return
    if first.name != second.name:
        yield Change("changed", here, "name", first.name or "", second.name or "")
    if isinstance(first, Leaf) and isinstance(second, Leaf):
        for parameter, before, after in zip(KINDS[first.kind].parameters, first.values, second.values, strict=True):
            if before != after:
                yield Change("changed", here, parameter.name, shown(before), shown(after))
        return
    ours, theirs = dict(steps(first)), dict(steps(second))
    pairs = {step: step for step in ours} if first.kind == "mix" else _pair(ours, theirs)
    for step, node in ours.items():
        if step in pairs:
            other = theirs[pairs[step]]
            yield from _changes(node, other, _below(here, step, node), _below(there, pairs[step], other))
        else:
            yield Change("removed", _below(here, step, node), before=outline(node))
    for step, other in theirs.items():
        if step not in pairs.values():
            yield Change("added", _below(there, step, other), after=outline(other))


def _below(address: str, step: str, node: Node) -> str:
    return f"{address}.mask" if step == "mask" else f"{address}.{step}.{node.kind}"


def _pair(ours: dict[str, Node], theirs: dict[str, Node]) -> dict[str, str]:
    """Steps of one node to steps of the other, the most alike first, only nodes of one kind; in order where there are very many."""
    if len(ours) * len(theirs) > MAX_PAIRS:
        return {step: step for step, node in ours.items() if step in theirs and theirs[step].kind == node.kind}
    costs = sorted(
        (_unlikeness(node, other), step, their) for step, node in ours.items() for their, other in theirs.items() if node.kind == other.kind
    )
    pairs: dict[str, str] = {}
    for _, step, their in costs:
        if step not in pairs and their not in pairs.values():
            pairs[step] = their
    return pairs


def _unlikeness(first: Node, second: Node) -> float:
    """0 for equal nodes, about 1 a parameter or a leaf that has nothing in common."""
    if first == second:
        return 0.0
    if first.kind != second.kind:
        return 1.0 + abs(_size(first) - _size(second))
    if isinstance(first, Leaf) and isinstance(second, Leaf):
        return sum(map(_distance, first.values, second.values))
    ours, theirs = dict(steps(first)), dict(steps(second))
    pairs = _pair(ours, theirs)
    left = [node for step, node in ours.items() if step not in pairs]
    left += [node for step, node in theirs.items() if step not in pairs.values()]
    return sum(_unlikeness(ours[step], theirs[their]) for step, their in pairs.items()) + 3.0 * sum(map(_size, left))


def _size(node: Node) -> int:
    return 1 + sum(_size(child) for _, child in steps(node))


def _distance(first: Value, second: Value) -> float:
    if isinstance(first, Raster) or isinstance(second, Raster) or len(first) != len(second):
        return float(first != second)
    return math.tanh(math.dist(first, second))


def shown(value: Value) -> str:
    """A value in short: numbers to four digits, a raster by its size."""
    if isinstance(value, Raster):
        return f"{value.width} x {value.height} pixels"
    return " ".join(f"{number:.4g}" for number in value)


def outline(node: Node) -> str:
    """The structure of a subtree without its values: ``multiply(albedo, diffuse)``."""
    below = ", ".join(outline(child) for _, child in steps(node))
    return f"{node.kind}({below})" if below else node.kind
