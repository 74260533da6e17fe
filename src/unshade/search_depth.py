"""The paper's second stage: structures in order of depth, each fitted, until the error is small (Geng et al. 2023, section 3.4).

A structure is a nested tuple, ``("screen", ("multiply", ("albedo",), ("diffuse",)), ("highlight",))``. Depth counts as
in the paper's binary grammar: a leaf is 1 deep, a pair one deeper than its deeper side. What can show the same pictures
is looked at once:

- multiply and screen are flattened and their children sorted, and so are the sides of a mix;
- two albedos under one multiply or one screen are one albedo;
- a mix of two products leaves a common factor outside, ``multiply(x, mix(a, b))``, where it is stored once;
- a picture with colour needs a tree with an albedo.

There are 6 structures of depth 1, some dozens of depth 2 and thousands of depth 3, hence `Budget`: the most promising
structures of a depth come first, and the next depth grows from them. Without a budget this is the paper's full search.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from unshade.fit.fitted import Fitted
from unshade.nodes import KINDS, Node, Operator, leaf
from unshade.types import Image, Mask

Structure: TypeAlias = tuple
"""``(kind,)`` of a leaf, ``(operator, child, child, ...)`` else."""

LEAVES = ("albedo", "diffuse", "highlight", "rim", "toon_diffuse", "toon_highlight")
"""The leaves of the released grammar; its environment is a raster, which these fitters do not fit."""

MASK = "threshold"

MAX_STRUCTURES = 1_000_000
"""Most structures of one depth that are written down."""

GREY = 2.0 / 255.0
"""A picture whose channels differ by less everywhere has no colour."""


class Fitter(Protocol):
    """`fit_gradient`, `fit_basin_cma` or another, with the rest of its arguments bound."""

    def __call__(self, target: Image, mask: Mask, root: Node, *, seed: int) -> Fitted:
        """The structure of ``root`` fitted to the picture, starting at its numbers."""
        ...


@dataclass(frozen=True)
class Budget:
    """How many structures of a depth are looked at; None is all of them, as in the paper."""

    ranked: int | None = None
    """That the cheap fitter ranks: the small ones, and those grown from the best of the last depth."""
    fitted: int | None = None
    """That the fitter itself is called on."""
    extended: int | None = None
    """That the next depth is grown from. Depths 1 and 2 are grown from in full."""


PRACTICAL = Budget(ranked=400, fitted=12, extended=6)
"""Minutes rather than days at depth 4."""


@dataclass(frozen=True)
class Progress:
    """A tree that is better than all before it."""

    root: Node
    error: float
    stage: str
    """``depth 1``, ``depth 2`` ... or ``whole tree``."""
    done: int
    """Calls of a fitter so far."""
    total: int
    """Calls of a fitter up to the end of the present depth, at most."""


def canonical(structure: Structure) -> Structure:
    """Flatten and sort one level whose children are canonical; two albedos become one."""
    kind, *children = structure
    if not children:
        return structure
    if kind != "mix":
        children = [below for child in children for below in (child[1:] if child[0] == kind else (child,))]
        paint = [child for child in children if child == ("albedo",)]
        children = [child for child in children if child != ("albedo",)] + paint[:1]
        if len(children) == 1:
            return children[0]
    return (kind, *sorted(children, key=_order))


def _order(structure: Structure) -> tuple[int, str]:
    return size(structure), repr(structure)


def size(structure: Structure) -> int:
    """Counted values of the structure, as `nodes.count_values` of `as_tree`."""
    kind, *children = structure
    if not children:
        return sum(parameter.values for parameter in KINDS[kind].parameters)
    own = size((MASK,)) if kind == "mix" else -int(kind == "multiply" and _is_tinted_light(children))
    return own + sum(size(child) for child in children)


def _is_tinted_light(children: Sequence[Structure]) -> bool:
    others = [child for child in children if child != ("albedo",)]
    return len(children) == 2 and len(others) == 1 and len(others[0]) == 1 and KINDS[others[0][0]].amplitude is not None


def kinds_in(structure: Structure) -> set[str]:
    """Leaf kinds of a structure."""
    return {structure[0]} if len(structure) == 1 else set().union(*(kinds_in(child) for child in structure[1:]))


def distinct(structure: Structure) -> bool:
    """False for a mix of two products with a common factor, which is smaller with the factor outside."""
    if structure[0] != "mix":
        return True
    left, right = ({child for child in side[1:] if child != ("albedo",)} if side[0] == "multiply" else {side} for side in structure[1:])
    return not left & right or structure[1] == structure[2]


def grow(deepest: Sequence[Structure], below: Sequence[Structure]) -> Iterator[Structure]:
    """Canonical structures one deeper than ``deepest``: each operator over two, one at least from there; may repeat."""
    for index, left in enumerate(deepest):
        for right in [*below, *deepest[index:]]:
            for operator in ("multiply", "screen", "mix"):
                structure = canonical((operator, left, right))
                if distinct(structure):
                    yield structure


class Levels:
    """The structures of depth 1, of depth 2, ... each once over all depths."""

    def __init__(self, leaves: Sequence[str] = LEAVES) -> None:
        self._seen: set[Structure] = set()
        self._below: list[Structure] = []
        self._deepest: list[Structure] = []
        self._leaves = [(kind,) for kind in leaves]

    def next(self) -> list[Structure]:
        """The next depth, small ones that grow from the first of `extend` first (place by size and place of the parent, added).

        Raises ValueError where there are more than `MAX_STRUCTURES`.
        """
        count = 3 * len(self._deepest) * (len(self._below) + len(self._deepest))
        if count > MAX_STRUCTURES:
            raise ValueError(f"about {count:.0e} structures in the next depth: give Budget.extended (or a smaller max_depth)")
        if not self._deepest:
            found = self._new(self._leaves)
        else:
            families = [
                self._new(grow([parent], [*self._below, *self._deepest[place + 1 :]])) for place, parent in enumerate(self._deepest)
            ]
            placed = [
                (place + position, place, structure) for place, family in enumerate(families) for position, structure in enumerate(family)
            ]
            found = [structure for _, _, structure in sorted(placed, key=lambda entry: entry[:2])]
        self._below, self._deepest = [*self._below, *self._deepest], found
        return found

    def _new(self, made: Sequence[Structure] | Iterator[Structure]) -> list[Structure]:
        new = sorted({structure for structure in made if structure not in self._seen}, key=_order)
        self._seen.update(new)
        return new

    def extend(self, chosen: Sequence[Structure]) -> None:
        """Let the next depth grow from these alone, in this order."""
        self._deepest = list(chosen)


def as_tree(structure: Structure) -> Node:
    """The structure with every parameter at its default, masks a little soft."""
    kind, *children = structure
    if not children:
        return leaf(kind)
    return Operator(kind, tuple(as_tree(child) for child in children), leaf(MASK, softness=0.1) if kind == "mix" else None)


def search(
    target: Image,
    mask: Mask,
    fitter: Fitter,
    threshold: float,
    max_depth: int = 3,
    *,
    seed: int = 0,
    rank: Fitter | None = None,
    whole_tree: Fitter | None = None,
    budget: Budget = PRACTICAL,
    max_values: int | None = None,
    leaves: Sequence[str] = LEAVES,
) -> Iterator[Progress]:
    """Look for the shallowest structure that fits, and yield every tree that is better than those before it.

    Args:
        target: (3, S, S) in [0, 1]. mask: (1, S, S), the pixels that count.
        fitter: fits the numbers of a structure; the search ends where its error is under ``threshold`` (the paper's phi).
        rank: a cheap fitter that says which structures of a depth come first and where they start; without it they
            come as they grow and start at their defaults.
        whole_tree: the last optimisation, from the best tree's numbers; its error must be comparable with the fitter's.
        max_values: leave larger structures out.
    """
    levels = Levels(leaves)
    counted = target[:, mask.bool()[0]]
    colored = bool((counted.amax(0) - counted.amin(0) > GREY).any())
    best: Progress | None = None
    done = total = 0
    for depth in range(1, max_depth + 1):
        level = levels.next()
        candidates = [
            structure for structure in level if _fits_picture(structure, colored) and (max_values is None or size(structure) <= max_values)
        ]
        candidates = candidates[: budget.ranked]
        starts = {structure: as_tree(structure) for structure in candidates}
        promise: dict[Structure, float] = dict.fromkeys(candidates, 0.0)
        total += len(candidates[: budget.fitted]) + (len(candidates) if rank else 0)
        if rank is not None:
            for structure in candidates:
                quick = rank(target, mask, starts[structure], seed=seed)
                starts[structure], promise[structure] = quick.root, quick.error
                done += 1
            candidates.sort(key=lambda structure: promise[structure])
        for structure in candidates[: budget.fitted]:
            fitted = fitter(target, mask, starts[structure], seed=seed)
            promise[structure] = min(promise[structure], fitted.error) if rank is None else promise[structure]
            done += 1
            if best is None or fitted.error < best.error:
                best = Progress(fitted.root, fitted.error, f"depth {depth}", done, total)
                yield best
                if best.error < threshold:
                    break
        if best is not None and best.error < threshold:
            break
        rest = [structure for structure in level if structure not in promise]
        levels.extend([*candidates, *rest] if depth < 3 else candidates[: budget.extended])
    if best is not None and whole_tree is not None:
        finished = whole_tree(target, mask, best.root, seed=seed)
        if finished.error < best.error:
            yield Progress(finished.root, finished.error, "whole tree", done + 1, done + 1)


def _fits_picture(structure: Structure, colored: bool) -> bool:
    """A picture with colour needs an albedo, but a single leaf is always tried."""
    return len(structure) == 1 or not colored or "albedo" in kinds_in(structure)
