"""An edit distance between shade trees.

Both trees are brought to their canonical form. A node that only one tree has costs 1, with all below it; an operator may
be put around a node or taken away; two leaves of one kind cost what their numbers differ by, at most 1. The children of
multiply and screen are paired at least cost, as their order means nothing (Zhang 1996, "A constrained edit distance
between unordered labeled trees").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from unshade.canonical import canonical
from unshade.nodes import KINDS, Leaf, Node, Operator, Parameter, Raster, Tree, Value, steps

EXACT_PAIRS = 40
"""Most children of one node that are paired exactly; more are paired nearest first."""


def tree_distance(a: Tree | Node, b: Tree | Node) -> float:
    """How many nodes apart two trees are: 0 exactly when their canonical forms and blend spaces are equal; symmetric.

    Raises TreeError where a canonical form is too large.
    """
    spaces = {tree.blend_space for tree in (a, b) if isinstance(tree, Tree)}
    first, second = (canonical(tree.root if isinstance(tree, Tree) else tree) for tree in (a, b))
    if repr(second) < repr(first):
        first, second = second, first
    return _Distances().between(first, second) + (len(spaces) - 1 if len(spaces) > 1 else 0)


class _Distances:
    """Distances between the subtrees of two trees, each found once."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], float] = {}
        self._sizes: dict[int, int] = {}

    def size(self, node: Node) -> int:
        """Nodes from here down."""
        if id(node) not in self._sizes:
            self._sizes[id(node)] = 1 + sum(self.size(child) for _, child in steps(node))
        return self._sizes[id(node)]

    def between(self, a: Node, b: Node) -> float:
        key = (id(a), id(b))
        if key not in self._known:
            self._known[key] = 0.0 if a == b else self._measured(a, b)
        return self._known[key]

    def _measured(self, a: Node, b: Node) -> float:
        if isinstance(a, Leaf) and isinstance(b, Leaf):
            return leaf_distance(a, b) if a.kind == b.kind else 2.0
        options = [float(self.size(a) + self.size(b))]
        if isinstance(a, Operator) and isinstance(b, Operator) and a.kind == b.kind:
            if a.mask is not None and b.mask is not None:
                pairs = [*zip(a.children, b.children, strict=True), (a.mask, b.mask)]
                options.append(sum(self.between(x, y) for x, y in pairs))
            else:
                options.append(self._paired(a.children, b.children))
        if isinstance(a, Operator):
            options += [self.size(a) - self.size(child) + self.between(child, b) for child in a.children]
        if isinstance(b, Operator):
            options += [self.size(b) - self.size(child) + self.between(a, child) for child in b.children]
        return min(options)

    def _paired(self, a: Sequence[Node], b: Sequence[Node]) -> float:
        """The cheapest way to pair children, to remove those left of ``a`` and to add those left of ``b``."""
        costs = np.array([[self.between(x, y) for y in b] for x in a])
        remove = np.array([float(self.size(x)) for x in a])
        add = np.array([float(self.size(y)) for y in b])
        return cheapest_pairing(costs, remove, add)


def cheapest_pairing(costs: np.ndarray, remove: np.ndarray, add: np.ndarray) -> float:
    """The least sum of (n, m) ``costs`` of pairs with the (n,) and (m,) costs of what is left unpaired."""
    n, m = costs.shape
    if max(n, m) > EXACT_PAIRS:
        total, rows, columns = float(remove.sum() + add.sum()), set(range(n)), set(range(m))
        gains = costs - remove[:, None] - add[None, :]
        for flat in np.argsort(gains, axis=None, kind="stable"):
            i, j = divmod(int(flat), m)
            if gains[i, j] < 0 and i in rows and j in columns:
                total += float(gains[i, j])
                rows.remove(i)
                columns.remove(j)
        return total
    square = np.zeros((n + m, n + m))
    square[:n, :m] = costs
    square[:n, m:] = remove[:, None]
    square[n:, :m] = add[None, :]
    chosen = assignment(square)
    return float(square[np.arange(n + m), chosen].sum())


def assignment(costs: np.ndarray) -> np.ndarray:
    """For each row of a square matrix its column in the cheapest one-to-one assignment.

    Source: the Hungarian method with potentials, one shortest augmenting path a row (Jonker and Volgenant 1987).
    """
    n = len(costs)
    row_price, column_price = np.zeros(n + 1), np.zeros(n + 1)
    owner = np.full(n + 1, n)
    for row in range(n):
        owner[n] = row
        column, shortest, came_from = n, np.full(n, np.inf), np.full(n, n)
        visited = np.zeros(n + 1, dtype=bool)
        while owner[column] != n or column == n:
            visited[column] = True
            reduced = costs[owner[column]] - row_price[owner[column]] - column_price[:n]
            free = ~visited[:n]
            better = free & (reduced < shortest)
            shortest[better], came_from[better] = reduced[better], column
            step = shortest[free].min()
            following = int(np.flatnonzero(free)[shortest[free].argmin()])
            row_price[owner[visited]] += step
            column_price[visited] -= step
            shortest[free] -= step
            column = following
        while column != n:
            before = int(came_from[column])
            owner[column] = owner[before]
            column = before
    chosen = np.empty(n, dtype=int)
    chosen[owner[:n]] = np.arange(n)
    return chosen


def leaf_distance(a: Leaf, b: Leaf) -> float:
    """Between two leaves of one kind: the mean over the parameters of their difference as a share of its range."""
    kind = KINDS[a.kind]
    if not kind.repeats:
        return _mean([_apart(p, x, y) for p, x, y in zip(kind.parameters, a.values, b.values, strict=True)])
    first, second = _lobes(a), _lobes(b)
    costs = np.array([[_mean([_apart(p, x, y) for p, x, y in zip(kind.parameters, u, v, strict=True)]) for v in second] for u in first])
    return min(1.0, cheapest_pairing(costs, np.ones(len(first)), np.ones(len(second))) / max(len(first), len(second)))


def _mean(numbers: Sequence[float]) -> float:
    return sum(numbers) / len(numbers) if numbers else 0.0


def _lobes(leaf: Leaf) -> list[tuple[Value, ...]]:
    sizes = [parameter.size for parameter in KINDS[leaf.kind].parameters]
    return [tuple(value[k * n : (k + 1) * n] for value, n in zip(leaf.values, sizes, strict=True)) for k in range(leaf.lobes)]  # type: ignore[index]


@lru_cache(maxsize=256)
def _picture(raster: Raster) -> np.ndarray:
    return raster.array()


def _apart(parameter: Parameter, a: Value, b: Value) -> float:
    """Two values of one parameter, from 0 (only for equal ones) to 1."""
    if a == b:
        return 0.0
    if isinstance(a, Raster) or isinstance(b, Raster):
        same_size = isinstance(a, Raster) and isinstance(b, Raster) and (a.height, a.width) == (b.height, b.width)
        return float(np.abs(_picture(a) - _picture(b)).mean()) if same_size else 1.0
    if parameter.type == "direction":
        # Half the chord's length is exact for near directions, where the arc cosine is not.
        return 2.0 / math.pi * math.asin(min(1.0, 0.5 * math.dist(a, b)))
    if parameter.logarithmic:
        return abs(math.log(a[0] / b[0])) / math.log(parameter.high / parameter.low)
    share = [abs(x - y) / (parameter.high - parameter.low) for x, y in zip(a, b, strict=True)]
    return min(1.0, _mean(share))
