"""Shade trees as sequences of tokens, for networks that write a tree word by word.

A tree is written in prefix order: the kind of a node, its numbers, then its operands; the mask of a mix comes last. Every
operator has two operands. A number is one of `BINS` steps of its range, a direction two numbers of an equal-area map of the
sphere. A `Cursor` knows after every token what may come next, so what is decoded is always a tree.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from unshade.blend import BLENDS
from unshade.errors import TreeError
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, Role, Tree

BINS = 256

LONGEST = 160
"""Most tokens of a tree. Those of the synthetic data need about 100."""

LIGHTS = 4
"""Of an environment; where it has fewer, the rest is black."""

START = 0
"""Before the first token, and after the last."""


@dataclass(frozen=True)
class Span:
    """The range of one scalar; a constant has low and high alike and no token."""

    low: float
    high: float
    logarithmic: bool = False

    @property
    def written(self) -> bool:
        """Whether it takes a token."""
        return self.low < self.high

    def share(self, value: float) -> float:
        """Where a value is, 0 to 1."""
        value = min(max(value, self.low), self.high)
        if self.logarithmic:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def value(self, share: float) -> float:
        """The inverse of `share`."""
        if self.logarithmic:
            return self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share


UNIT = Span(0.0, 1.0)
SIGNED = Span(-1.0, 1.0)

# Those of the synthetic data (`unshade.base_nodes`), a little wider where it draws to the edge.
SPANS: dict[str, dict[str, Span]] = {
    "albedo": {},
    "diffuse": {"ambient": UNIT},
    "toon_diffuse": {"ambient": UNIT, "threshold": Span(-0.5, 0.6), "softness": Span(0.0, 0.2)},
    "highlight": {"sharpness": Span(0.4, 500.0, True), "amplitude": Span(0.2, 1.6)},
    "toon_highlight": {"radius": Span(0.02, 1.3), "brightness": UNIT, "softness": Span(0.0, 0.0)},
    "rim": {"exponent": Span(0.5, 6.0, True)},
    "environment": {"sharpness": Span(0.2, 300.0, True)},
    "threshold": {"threshold": Span(-0.3, 0.7), "softness": Span(0.0, 2.1)},
    "stripe": {"center": Span(-0.8, 0.8), "width": Span(0.1, 0.6), "softness": Span(0.0, 0.0)},
}

WORDS: tuple[str, ...] = (*BLENDS, *SPANS)
"""Kinds in the order of their tokens, which follow `START`; the numbers follow them."""

FIRST_NUMBER = 1 + len(WORDS)
VOCABULARY = FIRST_NUMBER + BINS


def _numbers(kind: str) -> list[tuple[str, Span]]:
    """The numbers that follow a leaf's kind, each with what it is."""
    found: list[tuple[str, Span]] = []
    for _ in range(LIGHTS if KINDS[kind].repeats else 1):
        for parameter in KINDS[kind].parameters:
            if parameter.type == "direction":
                found += [(f"{parameter.name}.{axis}", SIGNED) for axis in "uv"]
            elif parameter.type == "color":
                found += [(f"{parameter.name}.{channel}", UNIT) for channel in "rgb"]
            elif SPANS[kind][parameter.name].written:
                found.append((parameter.name, SPANS[kind][parameter.name]))
    return found


NUMBERS: dict[str, list[tuple[str, Span]]] = {kind: _numbers(kind) for kind in SPANS}

SLOTS: tuple[str, ...] = (
    "node",
    "mask",
    *dict.fromkeys(f"{kind}.{name}" for kind, numbers in NUMBERS.items() for name, _ in numbers),
)
"""What a token can stand for; networks are told which is next."""

_MASKS = tuple(kind for kind in SPANS if KINDS[kind].role is Role.MASK)
_CHEAPEST = {
    "node": min(1 + len(NUMBERS[kind]) for kind in SPANS if kind not in _MASKS),
    "mask": min(1 + len(NUMBERS[kind]) for kind in _MASKS),
}
"""Tokens that a node or a mask takes at least."""


def _follows(word: str) -> list[str]:
    """The slots that a kind opens, in order."""
    if word in BLENDS:
        return ["node", "node", "mask"] if word == "mix" else ["node", "node"]
    return [f"{word}.{name}" for name, _ in NUMBERS[word]]


def _allowed() -> torch.Tensor:
    table = torch.zeros(len(SLOTS), VOCABULARY, dtype=torch.bool)
    table[2:, FIRST_NUMBER:] = True
    for word in WORDS:
        table[int(word in _MASKS), token_of(word)] = True
    return table


def token_of(word: str) -> int:
    """The token of a kind."""
    return 1 + WORDS.index(word)


ALLOWED = _allowed()
"""(slots, vocabulary) bool: which tokens can stand in a slot."""


def _cost(slot: str) -> int:
    return _CHEAPEST.get(slot, 1)


class Cursor:
    """Where in a tree a sequence of tokens is."""

    def __init__(self) -> None:
        self._open = ["node"]
        self.tokens: list[int] = []

    @property
    def done(self) -> bool:
        """Whether the tree is whole."""
        return not self._open

    @property
    def slot(self) -> int:
        """What comes next, index of `SLOTS`; 0 where the tree is whole."""
        return SLOTS.index(self._open[-1]) if self._open else 0

    def allowed(self) -> torch.Tensor:
        """(vocabulary,) bool: the tokens that can come next so that the tree can still end within `LONGEST`."""
        fits = ALLOWED[self.slot].clone()
        room = LONGEST - len(self.tokens) - sum(map(_cost, self._open[:-1]))
        for word in WORDS:
            if fits[token_of(word)] and 1 + sum(map(_cost, _follows(word))) > room:
                fits[token_of(word)] = False
        return fits

    def push(self, token: int) -> None:
        """Go on by one token. Raises TreeError where it cannot stand here."""
        if self.done or not 0 <= token < VOCABULARY or not ALLOWED[self.slot, token]:
            where = SLOTS[self.slot] if not self.done else "nothing, the tree is whole"
            raise TreeError(f"token {len(self.tokens)}: expected {where}, got {token}")
        self._open.pop()
        self.tokens.append(token)
        if token < FIRST_NUMBER:
            self._open += reversed(_follows(WORDS[token - 1]))


def slots_of(tokens: Sequence[int]) -> list[int]:
    """The slot that each token of a whole tree stands in, indices of `SLOTS`. Raises TreeError."""
    cursor, found = Cursor(), []
    for token in tokens:
        found.append(cursor.slot)
        cursor.push(token)
    return found


def tokens_of(tree: Tree) -> list[int]:
    """A tree in tokens.

    Raises:
        TreeError: it holds a kind that has no tokens, such as a picture, or needs more than `LONGEST`.
    """
    tokens: list[int] = []
    _write(tree.root, tokens)
    if len(tokens) > LONGEST:
        raise TreeError(f"a tree of {len(tokens)} tokens; {LONGEST} at most can be written")
    return tokens


def _write(node: Node, tokens: list[int]) -> None:
    if node.kind not in WORDS:
        raise TreeError(f"{node.kind}: has no tokens; known: {', '.join(WORDS)}")
    tokens.append(token_of(node.kind))
    if isinstance(node, Leaf):
        tokens += [
            FIRST_NUMBER + min(int(span.share(value) * BINS), BINS - 1)
            for value, (_, span) in zip(_flat(node), NUMBERS[node.kind], strict=True)
        ]
        return
    first, *rest = node.children
    _write(first, tokens)
    _write(rest[0] if len(rest) == 1 else Operator(node.kind, tuple(rest)), tokens)
    if node.mask is not None:
        _write(node.mask, tokens)


def _flat(leaf: Leaf) -> list[float]:
    """The numbers of a leaf in the order of `NUMBERS`."""
    kind, found = KINDS[leaf.kind], list[float]()
    lights = LIGHTS if kind.repeats else 1
    for k in range(lights):
        for parameter, value in zip(kind.parameters, leaf.values, strict=True):
            assert not isinstance(value, Raster)
            own = value[k * parameter.size : (k + 1) * parameter.size]
            if not own:  # fewer lights than are written: a black one more
                own = (0.0, 0.0, 1.0) if parameter.type == "direction" else (0.0,) * parameter.size
            if parameter.type == "direction":
                found += _flattened(own)
            elif parameter.type == "color" or SPANS[leaf.kind][parameter.name].written:
                found += own
    return found


def _flattened(direction: Sequence[float]) -> tuple[float, float]:
    """Lambert's azimuthal equal-area map, centred on the viewer: a direction to a point of the unit disc."""
    x, y, z = direction
    across = math.hypot(x, y)
    if across < 1e-9:
        return (0.0, 0.0) if z > 0 else (1.0, 0.0)
    radius = math.sqrt(max(0.0, (1.0 - z) / 2.0))
    return x / across * radius, y / across * radius


def _raised(u: float, v: float) -> tuple[float, float, float]:
    """The inverse of `_flattened`; a point outside the disc is moved to its edge."""
    radius = math.hypot(u, v)
    if radius < 1e-9:
        return 0.0, 0.0, 1.0
    bounded = min(radius, 1.0)
    z = 1.0 - 2.0 * bounded * bounded
    across = math.sqrt(max(0.0, 1.0 - z * z))
    return u / radius * across, v / radius * across, z


def tree_of(tokens: Iterable[int]) -> Tree:
    """The tree of a whole sequence. Raises TreeError."""
    cursor = Cursor()
    for token in tokens:
        cursor.push(token)
    if not cursor.done:
        raise TreeError(f"the tree is not whole after {len(cursor.tokens)} tokens: expected {SLOTS[cursor.slot]}")
    return Tree(_read(iter(cursor.tokens)))


def _read(tokens: Iterable[int]) -> Node:
    stream = iter(tokens)
    word = WORDS[next(stream) - 1]
    if word in SPANS:
        return _leaf(word, [span.value((next(stream) - FIRST_NUMBER + 0.5) / BINS) for _, span in NUMBERS[word]])
    children = (_read(stream), _read(stream))
    mask = _read(stream) if word == "mix" else None
    assert mask is None or isinstance(mask, Leaf)
    return Operator(word, children, mask)


def _leaf(word: str, numbers: list[float]) -> Leaf:
    kind, stream = KINDS[word], iter(numbers)
    values: list[list[float]] = [[] for _ in kind.parameters]
    for _ in range(LIGHTS if kind.repeats else 1):
        for parameter, value in zip(kind.parameters, values, strict=True):
            if parameter.type == "direction":
                value += _raised(next(stream), next(stream))
            elif parameter.type == "color":
                value += [next(stream) for _ in range(3)]
            else:
                span = SPANS[word][parameter.name]
                value.append(next(stream) if span.written else span.low)
    return Leaf(word, tuple(tuple(value) for value in values)) if not kind.repeats else _without_black(word, values)


def _without_black(word: str, values: list[list[float]]) -> Leaf:
    """The lights that shine, the first one in any case."""
    kind = KINDS[word]
    place = kind.parameters.index(kind.parameter("color"))
    kept = [k for k in range(LIGHTS) if max(values[place][3 * k : 3 * k + 3]) > 1.0 / BINS] or [0]
    lit = [
        tuple(number for k in kept for number in value[k * parameter.size : (k + 1) * parameter.size])
        for parameter, value in zip(kind.parameters, values, strict=True)
    ]
    return Leaf(word, tuple(lit))
