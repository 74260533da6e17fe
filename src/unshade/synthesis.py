"""Synthetic training data: trees drawn from the grammar, and every operator of theirs as an example.

A tree is drawn as `sampler` draws it: its structure first, each equally likely, then its numbers until every leaf shows. A
share of the trees is drawn wider than the released grammar: realistic ones with the broad and coloured lights of real
pictures, toon ones as people draw, with warm-cool ramps, hard lights and outlines. Trees have numbers: tree n depends only
on (style, split, seed, n), so data can be made anywhere and in any order.
"""

from __future__ import annotations

import atexit
import dataclasses
import hashlib
import os
import random
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from typing import Any, Literal, Protocol, Self, TypeAlias, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

from unshade.base_nodes import SPLITS
from unshade.blend import BLENDS
from unshade.errors import TreeError, did_you_mean
from unshade.forest import CODES, Forest, Outline, Plant, grow, pictures_of
from unshade.nodes import Tree
from unshade.sampler import Structure, structures
from unshade.sphere import disc_mask, sphere_normals
from unshade.types import Image, Mask

OPERATORS = ("multiply", "screen", "mix")
"""Classes of an example's operator."""

TYPES = ("operator", "albedo", "diffuse", "toon_diffuse", "highlight", "toon_highlight", "rim", "environment")
"""Classes of a child; an ``operator`` is to be decomposed further."""

Style: TypeAlias = Literal["realistic", "toon", "both"]
STYLES = ("realistic", "toon", "both")

GROVE = 32
"""Trees that are drawn together; tree n is in grove n // GROVE."""

WIDE_SHARE = {"realistic": 0.3, "toon": 0.5}
"""Of the trees, those drawn wider than the released grammar."""

MIXED_BATCHES = 16
"""Batches that are shuffled together, so that the nodes of one tree do not all fall into one batch; fewer where they are large."""

MIXED_NUMBERS = 1 << 24
"""Pixels times examples that are shuffled together, at most."""

EXAMPLES_OF_A_TREE = 4
"""Operators of a tree, fewer than on the average, so that a grove or more has them for certain."""


class _Movable(Protocol):
    def to(self, device: torch.device | str) -> Self: ...


Made = TypeVar("Made", bound=_Movable)


@dataclass(frozen=True)
class Batch:
    """Examples: operators of trees with their operands. Images are display-encoded in [0, 1] and 0 outside the disc."""

    parent: Image
    """(B, 3, S, S)."""
    left: Image
    right: Image
    operator: torch.Tensor
    """(B,) int64, index of `OPERATORS`."""
    mask: Mask
    """(B, 1, S, S), 0 where the operator is not a mix."""
    left_type: torch.Tensor
    """(B,) int64, index of `TYPES`."""
    right_type: torch.Tensor

    def to(self, device: torch.device | str) -> Batch:
        """The same on another device."""
        return Batch(*[getattr(self, field.name).to(device, non_blocking=True) for field in dataclasses.fields(self)])

    def __getitem__(self, rows: slice | torch.Tensor) -> Batch:
        """Some of the examples."""
        return Batch(*[getattr(self, field.name)[rows] for field in dataclasses.fields(self)])

    def __len__(self) -> int:
        """Examples."""
        return len(self.operator)


def trees(style: Style, split: str, *, seed: int, start: int = 0) -> Iterator[Tree]:
    """Endless trees, the first of them tree ``start``; every operator has two children, in the order of the released grammar.

    Args:
        style: realistic, toon, or both, one tree in two of each.
        split: the half of the base nodes, train or test.
    Raises:
        TreeError: an unknown style or split.
    """
    _check(style, split)
    for grove in count(start // GROVE):
        first = start % GROVE if grove == start // GROVE else 0
        for plant in plants(style, split, seed, grove)[first:]:
            yield plant.tree()


def batches(
    style: Style,
    split: str,
    *,
    size: int,
    batch: int,
    seed: int,
    start: int = 0,
    workers: int = 0,
    device: torch.device | str = "cpu",
) -> Iterator[Batch]:
    """Endless shuffled examples, the first of them batch ``start``.

    Batch k depends only on (style, split, size, batch, seed, k): neither on where the stream began nor on the workers.

    Args:
        size: width and height of the images.
        batch: examples in a batch.
        workers: processes that prepare batches ahead, on the CPU; 0 prepares them here, on ``device``.
    Raises:
        TreeError: an unknown style or split.
    """
    mixed = max(1, min(MIXED_BATCHES, MIXED_NUMBERS // (batch * size * size)))
    blocks = _Blocks(style, split, size, mixed * batch, seed, torch.device("cpu" if workers else device))
    first, skipped = divmod(start, mixed)
    for block in blocks.stream(start=first, workers=workers, device=device):
        for k in range(skipped, mixed):
            yield block[slice(k * batch, (k + 1) * batch)]
        skipped = 0


def examples(grown: Sequence[Plant], size: int, device: torch.device | str = "cpu") -> tuple[Batch, torch.Tensor]:
    """Every operator of some trees, and which of the trees each is from, (B,) int64."""
    forest = Forest(grown, device)
    rows = forest.operators()
    return render_examples(forest, torch.from_numpy(rows), size), torch.from_numpy(forest.tree[rows])


def render_examples(forest: Forest, rows: torch.Tensor, size: int) -> Batch:
    """The examples of some operators of a forest."""
    inside = disc_mask(size)[0].to(forest.device)
    values = forest.shade(sphere_normals(size, forest.device)[:, inside][:, None])
    rows = rows.to(forest.device)
    left, right, mask = forest.left[rows], forest.right[rows], forest.mask[rows]
    kinds = torch.from_numpy(forest.kinds).to(forest.device)
    codes = type_codes().to(forest.device)

    masks = values[mask.clamp(min=0), :1] * (mask >= 0)[:, None, None, None]
    images = [pictures_of(shaded, size) for shaded in (values[rows], values[left], values[right], masks)]
    # The operators are first in the table, in the order of `OPERATORS`.
    parent, first, second, masked = images
    return Batch(parent, first, second, kinds[rows], masked, codes[kinds[left]], codes[kinds[right]])


@lru_cache(maxsize=1)
def type_codes() -> torch.Tensor:
    """The index of `TYPES` for each of `forest.CODES`; masks have none and count as operators."""
    names = ["environment" if kind == "environment_map" else kind for kind in CODES]
    return torch.tensor([TYPES.index(name) if name in TYPES else 0 for name in names])


@lru_cache(maxsize=64)
def plants(style: Style, split: str, seed: int, grove: int) -> tuple[Plant, ...]:
    """The trees of a grove."""
    key = seed_of(f"{style} {split} {seed} {grove}")
    choices = random.Random(key)
    outlines = [Outline.of(random_structure(style, choices)) for _ in range(GROVE)]
    return tuple(grow(outlines, split, torch.Generator().manual_seed(key)))


def seed_of(words: str) -> int:
    """A seed of 56 bits for what some words name."""
    return int.from_bytes(hashlib.blake2b(words.encode(), digest_size=7).digest(), "big")


def random_structure(style: Style, choices: random.Random) -> Structure:
    """A random structure in words of `base_nodes.BASES`."""
    own = choices.choice(("realistic", "toon")) if style == "both" else style
    environment = own == "realistic" and choices.random() < 0.5
    structure = choices.choice(structures(own, environment, choices.random() < 0.5))
    if choices.random() >= WIDE_SHARE[own]:
        return structure
    if own == "realistic":
        return with_real_lights(structure, choices)
    drawn = _drawn(structure, choices)
    return ("mix", drawn, "ink", "outline") if choices.random() < 0.35 else drawn


def with_real_lights(structure: Structure, choices: random.Random) -> Structure:
    """With the lights of real pictures: broad ones and coloured ones."""
    if not isinstance(structure, str):
        return (structure[0], *[with_real_lights(operand, choices) for operand in structure[1:]])
    if structure == "highlight":
        light = choices.choice(("broad_highlight", "wide_highlight"))
        return ("multiply", "albedo", light) if light == "broad_highlight" or choices.random() < 0.5 else light
    if structure == "rim":
        return ("multiply", "albedo", "wide_rim") if choices.random() < 0.5 else "wide_rim"
    return "wide_diffuse" if structure == "diffuse" else structure


def _drawn(structure: Structure, choices: random.Random) -> Structure:
    """As people draw: a plain paint becomes a warm-cool ramp, form and lights get hard edges, lights a colour."""
    if isinstance(structure, str):
        if structure == "toon_highlight":
            return ("multiply", "albedo", "hard_highlight") if choices.random() < 0.4 else "hard_highlight"
        return "hard_diffuse" if structure == "toon_diffuse" and choices.random() < 0.6 else structure
    if structure[0] == "multiply" and structure[1] == "albedo" and choices.random() < 0.7:
        return ("multiply", ("mix", "warm", "cool", "ramp"), *[_drawn(operand, choices) for operand in structure[2:]])
    return (structure[0], *[_drawn(operand, choices) for operand in structure[1:]])


@dataclass(frozen=True)
class Batches(Dataset[Made], ABC):
    """Endless batches of what is drawn from the grammar. Batch k depends on these fields and on k alone, neither on where a stream
    began nor on the workers.

    Raises:
        TreeError: an unknown style or split.
    """

    style: Style
    split: str
    """The half of the base nodes, train or test."""
    size: int
    """Width and height of the pictures."""
    batch: int
    """Items in a batch."""
    seed: int

    def __post_init__(self) -> None:
        _check(self.style, self.split)

    @abstractmethod
    def __getitem__(self, number: int) -> Made:
        """Batch ``number``."""

    def stream(self, *, start: int = 0, workers: int = 0, device: torch.device | str = "cpu") -> Iterator[Made]:
        """The batches from ``start`` on, on a device. ``workers`` processes prepare them ahead; 0 prepares them here."""
        made = _ahead(self, start, workers) if workers else map(self.__getitem__, count(start))
        return (batch.to(device) for batch in made)


@dataclass(frozen=True)
class _Blocks(Batches[Batch]):
    """Examples that are shuffled together."""

    device: torch.device
    """Where they are made."""

    def __getitem__(self, number: int) -> Batch:
        groves = -(-self.batch // (GROVE * EXAMPLES_OF_A_TREE))
        grown = [plant for grove in range(groves) for plant in plants(self.style, self.split, self.seed, number * groves + grove)]
        generator = torch.Generator().manual_seed((self.seed * 1_000_003 + number) % (1 << 62))
        forest = Forest(grown, self.device)
        rows = torch.from_numpy(forest.operators())
        assert len(rows) >= self.batch, f"{len(rows)} examples where {self.batch} are needed"
        return render_examples(forest, rows[torch.randperm(len(rows), generator=generator)[: self.batch]], self.size)


def _ahead(batches: Dataset[Any], first: int, workers: int) -> DataLoader[Any]:
    """Batches ``first``, ``first`` + 1, ... of an endless set, prepared in other processes."""
    # Spawned: a fork of a process with threads or a GPU may hang.
    return DataLoader(
        batches,
        batch_size=None,
        sampler=_Counted(first),
        num_workers=workers,
        prefetch_factor=2,
        collate_fn=_as_it_is,
        multiprocessing_context="spawn",
        worker_init_fn=_ends_at_once,
    )


def _ends_at_once(worker: int) -> None:
    """Let this worker leave without taking its interpreter apart, which aborts it where a thread still packs a batch.

    What fails in a worker is not told by its exit, but raised where its batch is asked for.
    """
    atexit.register(os._exit, 0)


@dataclass(frozen=True)
class _Counted:
    """A `DataLoader` sampler that never ends."""

    first: int

    def __iter__(self) -> Iterator[int]:
        return count(self.first)


def _as_it_is(block: Any) -> Any:
    return block


def _check(style: str, split: str) -> None:
    """Raises TreeError for an unknown style or split."""
    if style not in STYLES:
        raise TreeError(f"unknown style {style!r}{did_you_mean(style, STYLES)}")
    if split not in SPLITS:
        raise TreeError(f"unknown split {split!r}{did_you_mean(split, SPLITS)}")


assert tuple(BLENDS) == OPERATORS and CODES[: len(OPERATORS)] == OPERATORS
