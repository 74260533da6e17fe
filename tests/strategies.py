"""Hypothesis strategies that draw trees: every kind of leaf, every operator, names, lobes, rasters."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from unshade.nodes import KINDS, Family, Kind, Leaf, Member, Node, Operator, Parameter, Raster, Role, Tree

BUILT_IN = tuple(KINDS)
PAINTS = tuple(name for name in BUILT_IN if KINDS[name].role is not Role.MASK)
MASKS = tuple(name for name in BUILT_IN if KINDS[name].role is Role.MASK)


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Any number of a range, its ends and round numbers more often."""
    round_numbers = [number for number in (low, high, 0.0, 0.25, 0.5, 1.0) if low <= number <= high]
    return st.one_of(st.sampled_from(round_numbers), st.floats(low, high, allow_nan=False))


directions = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: math.hypot(*v) > 1e-3)
    | st.sampled_from([(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])
)  # fmt: skip


@st.composite
def rasters(draw: st.DrawFn, channels: int = 3) -> Raster:
    """A small picture of any 16-bit numbers."""
    height, width = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    seed = draw(st.integers(0, 2**32 - 1))
    pixels = np.random.default_rng(seed).integers(0, 65536, (channels, height, width), dtype=np.uint16)
    return Raster(channels, height, width, pixels.astype(">u2").tobytes())


def values(parameter: Parameter) -> st.SearchStrategy[object]:
    """A parameter's value for one lobe."""
    if parameter.type == "raster":
        return rasters(parameter.channels)
    if parameter.type == "direction":
        return directions
    return st.tuples(*[numbers(parameter.low, parameter.high)] * parameter.size)


names = st.none() | st.text(min_size=1, max_size=8)


@st.composite
def leaves(draw: st.DrawFn, kinds: tuple[str, ...] = PAINTS, named: bool = True) -> Leaf:
    """A leaf of one of these kinds."""
    kind: Kind = KINDS[draw(st.sampled_from(kinds))]
    lobes = draw(st.integers(1, 3)) if kind.repeats else 1
    drawn = []
    for parameter in kind.parameters:
        entries = [draw(values(parameter)) for _ in range(1 if parameter.type == "raster" else lobes)]
        drawn.append(entries[0] if len(entries) == 1 else [number for entry in entries for number in entry])  # type: ignore[attr-defined]
    return Leaf(kind.name, tuple(drawn), draw(names) if named else None)


def nodes(
    kinds: tuple[str, ...] = PAINTS, masks: tuple[str, ...] = MASKS, named: bool = True, max_leaves: int = 8
) -> st.SearchStrategy[Node]:
    """A node and all below it, of these kinds."""
    name = names if named else st.none()

    def operators(below: st.SearchStrategy[Node]) -> st.SearchStrategy[Node]:
        several = st.lists(below, min_size=2, max_size=4).map(tuple)
        joined = st.builds(Operator, st.sampled_from(["multiply", "screen"]), several, st.none(), name)
        return joined | st.builds(Operator, st.just("mix"), st.tuples(below, below), leaves(masks, named), name)

    return st.recursive(leaves(kinds, named), operators, max_leaves=max_leaves)


def trees(**options: object) -> st.SearchStrategy[Tree]:
    """A tree; the options are those of `nodes`."""
    exposures = st.just(1.0) | st.floats(1e-6, 1e6)
    return st.builds(Tree, nodes(**options), st.sampled_from(["srgb", "linear"]), exposures)  # type: ignore[arg-type]


@st.composite
def families(draw: st.DrawFn) -> Family:
    """A few trees with their figures, one of them chosen."""
    members = st.builds(Member, trees(max_leaves=3), st.floats(-50.0, 120.0) | st.just(math.inf))
    drawn = draw(st.lists(members, min_size=1, max_size=3))
    return Family(tuple(drawn), draw(st.integers(0, len(drawn) - 1)), tuple(draw(st.lists(members, max_size=2))))
