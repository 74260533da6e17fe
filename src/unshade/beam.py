"""What a beam search for drawn pictures keeps: only forms of the released grammar, a line for each, and no tree twice."""

from __future__ import annotations

import operator

from unshade.fit.plan import EDGE
from unshade.growth import Candidate
from unshade.moves import Anatomy, plain_numbers
from unshade.nodes import KINDS, Leaf, Node, find, walk

HOPELESS = 4.0
"""A form whose trees have this many times the error of the best is left behind."""

TWINS = 0.02
"""Two trees of one form and size whose errors differ by less than this share are taken for one."""

NEAR = 0.96
"""Cosine of the angle within which two leaves of a kind end in one place."""

BESIDE = 0.2
"""Way within which two edges end in one place."""

PLACES = frozenset(EDGE) - {"direction", "softness"}
"""Parameters that say where along its direction an edge is."""

RELEASED_FORMS = {(), ("diffuse",), ("toon_diffuse",), ("toon_diffuse", "toon_diffuse")}
"""Shadings of a base in the released grammar; one toon shading alone is on the way to two."""


MOST_MIXES = 3
"""Mixes in a plain tree: two in the released grammar, and one detour."""


def is_released(root: Node) -> bool:
    """Can a tree of the released grammar grow from this one?"""
    return form_of(root) in RELEASED_FORMS and sum(node.kind == "mix" for _, node in walk(root)) <= MOST_MIXES


def form_of(root: Node) -> tuple[str, ...]:
    """The kinds of a base's shadings."""
    return tuple(find(root, address).kind for address in Anatomy.of(root).forms)


def line_of(root: Node) -> tuple[str, ...]:
    """What tells the lines of a beam apart: the form, and whether there is a rim or an environment."""
    return (*form_of(root), *sorted({node.kind for _, node in walk(root)} & {"rim", "environment"}))


def lineages(candidates: list[Candidate], each: int) -> list[Candidate]:
    """The first candidates of every form, so that a wrong shading that fits well early cannot crowd out the right one.

    A form that is `HOPELESS` times worse than the best is left behind, and so is a tree as large and as good as one before
    it, which is nearly always the same tree.
    """
    bar = HOPELESS * min((candidate.error for candidate in candidates), default=0.0)
    lines: dict[tuple[str, ...], list[Candidate]] = {}
    chosen = []
    for candidate in candidates:
        line = lines.setdefault(line_of(candidate.root), [])
        if len(line) < each and candidate.error <= bar and not any(_are_twins(candidate, other) for other in line):
            line.append(candidate)
            chosen.append(candidate)
    return chosen


class Seen:
    """Trees that were offered; a tree that will end as one of them need not be fitted."""

    def __init__(self) -> None:
        self._gists: dict[tuple[str, ...], list[_Gist]] = {}

    def is_new(self, root: Node) -> bool:
        """Remember a tree; false where one like it was remembered before."""
        gist = _gist(root)
        alike = self._gists.setdefault(tuple(gist), [])
        if any(_resemble(gist, other) for other in alike):
            return False
        alike.append(gist)
        return True


_Gist = dict[str, list[tuple[tuple[float, ...], tuple[float, ...]]]]
"""Where the leaves of each kind at each depth point, and where their edges are; nothing, for one colour."""


def _gist(root: Node) -> _Gist:
    gist: _Gist = {}
    for address, node in walk(root):
        if isinstance(node, Leaf):
            held = list(zip(KINDS[node.kind].parameters, plain_numbers(node), strict=True))
            points = next((numbers for parameter, numbers in held if parameter.type == "direction"), ())
            edges = tuple(numbers[0] for parameter, numbers in held if parameter.name in PLACES)
            gist.setdefault(f"{node.kind} {address.count('.')}", []).append((points, edges))
    return dict(sorted(gist.items()))


def _resemble(a: _Gist, b: _Gist) -> bool:
    """Will two trees with leaves of the same kinds end as the same tree, since all their leaves lie nearly alike?"""
    for kind, leaves in a.items():
        left = list(b[kind])
        for leaf in leaves:
            match = next((k for k, other in enumerate(left) if _lie_alike(leaf, other)), None)
            if match is None:
                return False
            del left[match]
        if left:
            return False
    return True


def _lie_alike(a: tuple[tuple[float, ...], tuple[float, ...]], b: tuple[tuple[float, ...], tuple[float, ...]]) -> bool:
    if len(a[0]) != len(b[0]) or sum(map(operator.mul, a[0], b[0])) < NEAR * len(a[0]) / 3:
        return False
    return all(abs(x - y) < BESIDE for x, y in zip(a[1], b[1], strict=True))


def _are_twins(a: Candidate, b: Candidate) -> bool:
    return a.values == b.values and abs(a.error - b.error) <= TWINS * b.error
