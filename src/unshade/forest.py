"""Many trees of different structures as one table of nodes, shaded level by level: all leaves of a kind at once, then all
operators whose operands are known. Every operator has two operands here, as in the released grammar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from unshade.base_nodes import BASES, WIDTH, base_leaf, draw
from unshade.blend import BLENDS
from unshade.environments import panoramas as real_panoramas
from unshade.nodes import KINDS, Leaf, Node, Operator, Role, Tree
from unshade.sampler import VISIBLE, Structure
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.types import Image, Normals

CODES: tuple[str, ...] = (*BLENDS, *(kind for kind in KINDS))
"""What a node's kind is in a table."""

CHECKED_SIZE = 64
"""As in `sampler`; a rough look at every fourth pixel first drops most of those that fail."""


@dataclass(frozen=True, eq=False)
class Outline:
    """A structure as columns, one entry a node, operands before their operator, the root last; -1 where there is none."""

    words: tuple[str, ...]
    """Of `base_nodes.BASES`, or an operator's name."""
    links: np.ndarray
    """(3, N) int64: left, right, mask."""
    kinds: np.ndarray
    """(N,) int64, index of `CODES`."""
    heights: np.ndarray
    """(N,) int64, 0 at the leaves."""

    @staticmethod
    @lru_cache(maxsize=4096)
    def of(structure: Structure) -> Outline:
        """The columns of a structure."""
        words: list[str] = []
        links: list[tuple[int, int, int]] = []
        heights: list[int] = []

        def add(part: Structure) -> int:
            below = [] if isinstance(part, str) else [add(operand) for operand in part[1:]]
            words.append(part if isinstance(part, str) else str(part[0]))
            links.append((below[0], below[1], below[2] if len(below) > 2 else -1) if below else (-1, -1, -1))
            heights.append(1 + max(heights[row] for row in below) if below else 0)
            return len(words) - 1

        add(structure)
        kinds = [CODES.index(word if word in BLENDS else BASES[word].kind) for word in words]
        return Outline(tuple(words), np.array(links).T, np.array(kinds), np.array(heights))


@dataclass(frozen=True, eq=False)
class Plant:
    """A tree of one half with its numbers, (N, WIDTH) float64 a node; see `base_nodes.draw`."""

    outline: Outline
    split: str
    numbers: torch.Tensor

    def tree(self) -> Tree:
        """As the rest of the package knows it; every operator has two children."""

        def node(row: int) -> Node:
            kind, (left, right, mask) = CODES[self.outline.kinds[row]], self.outline.links[:, row]
            if left < 0:
                return base_leaf(kind, self.numbers[row], self.split)
            masked = node(mask) if mask >= 0 else None
            assert masked is None or isinstance(masked, Leaf)
            return Operator(kind, (node(left), node(right)), masked)

        return Tree(node(len(self.numbers) - 1))


def seeds(outlines: Sequence[Outline], split: str, generator: torch.Generator) -> list[Plant]:
    """Trees of these structures with random numbers; whether their leaves show is another matter, see `all_show`."""
    words = np.array([word for outline in outlines for word in outline.words])
    owners = np.repeat(np.arange(len(outlines)), [len(outline.words) for outline in outlines])
    numbers = torch.zeros(len(words), WIDTH, dtype=torch.float64)
    toward = torch.zeros(len(outlines), 3, dtype=torch.float64)
    # Those that follow another come last.
    for word in sorted(BASES, key=lambda word: BASES[word].toward):
        rows = (words == word).nonzero()[0]
        if len(rows):
            owner = torch.from_numpy(owners[rows])
            numbers[rows] = draw(word, len(rows), split, generator, toward[owner])
            if KINDS[BASES[word].kind].role is Role.DIFFUSE:
                toward[owner] = numbers[rows, :3]
    ends = np.cumsum([len(outline.words) for outline in outlines])[:-1].tolist()
    parts = torch.tensor_split(numbers, ends)
    return [Plant(outline, split, part.clone()) for outline, part in zip(outlines, parts, strict=True)]


class Forest:
    """The nodes of many trees as one table on a device. Columns have N entries; ``tree`` says whose node it is.

    ``panoramas`` are the pictures that the versions of environments are of, for each half; None for the real ones.
    """

    def __init__(self, plants: Sequence[Plant], device: torch.device | str = "cpu", panoramas: Mapping[str, Image] | None = None) -> None:
        sizes = np.array([len(plant.numbers) for plant in plants])
        starts = np.cumsum(sizes) - sizes
        links = np.concatenate(
            [np.where(p.outline.links < 0, -1, p.outline.links + start) for p, start in zip(plants, starts, strict=True)], 1
        )
        self.kinds = np.concatenate([plant.outline.kinds for plant in plants])
        self.heights = np.concatenate([plant.outline.heights for plant in plants])
        self.links = links
        self.left, self.right, self.mask = (torch.from_numpy(link).to(device) for link in links)
        self.tree = np.repeat(np.arange(len(plants)), sizes)
        self.numbers = torch.cat([plant.numbers for plant in plants]).to(device, torch.float32)
        self.split = np.array([plant.split for plant in plants])
        self.device = device
        self.panoramas = panoramas

    def roots(self) -> np.ndarray:
        """Rows of the roots, a tree each."""
        return np.flatnonzero(np.diff(self.tree, append=-1))

    def operators(self) -> np.ndarray:
        """Rows of the operators, in order."""
        return (self.links[0] >= 0).nonzero()[0]

    def shade(self, normals: Normals) -> Image:
        """The value of every node, (N, 3, H, W) for normals (3, H, W)."""
        values = normals.new_empty(len(self.kinds), 3, *normals.shape[-2:])
        for code in np.unique(self.kinds[self.heights == 0]):
            rows = (self.kinds == code).nonzero()[0]
            where = self._rows(rows)
            if CODES[code] == "environment_map":
                for split in np.unique(self.split):
                    own = self._rows(rows[self.split[self.tree[rows]] == split])
                    values[own] = self._environments(own, str(split), normals)
            else:
                kind = KINDS[CODES[code]]
                sizes = [parameter.size for parameter in kind.parameters]
                values[where] = kind.formula(normals, *self.numbers[where, : sum(sizes)].split(sizes, dim=1)).expand(-1, 3, -1, -1)
        for code, rows in self._levels():
            where = self._rows(rows)
            values[where] = BLENDS[CODES[code]].apply(*self._operands(values, where, CODES[code]))
        return values

    def all_show(self, normals: Normals, least: float = VISIBLE) -> np.ndarray:
        """Which trees show all of their leaves; `sampler.every_leaf_shows` for many at once, at (3, 1, P) normals. (T,) bool."""
        values = self.shade(normals)
        gains = torch.ones_like(values)
        shows = torch.ones(len(values), dtype=torch.bool, device=self.device)
        is_leaf = self.left < 0
        for code, rows in reversed(list(self._levels())):
            where, name = self._rows(rows), CODES[code]
            layers = self._operands(values, where, name)
            links = [self.left[where], self.right[where]]
            for k, own in enumerate(BLENDS[name].gains(*layers)[:2]):
                gain = gains[where] * own
                gains[links[k]] = gain
                identity = BLENDS[name].identity
                change = gain * (layers[k] - (layers[1 - k] if identity is None else identity))
                seen = change.square().flatten(1).mean(1).sqrt() >= least
                shows[links[k]] = seen if identity is None else seen | ~is_leaf[links[k]]
        hidden = np.unique(self.tree[~shows.cpu().numpy()])
        return ~np.isin(np.arange(len(self.split)), hidden)

    def _rows(self, rows: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(rows).to(self.device)

    def _levels(self) -> list[tuple[int, np.ndarray]]:
        """(operator, rows) whose operands are known once those before are."""
        return [
            (code, rows)
            for height in range(1, int(self.heights.max()) + 1)
            for code in range(len(BLENDS))
            if len(rows := ((self.heights == height) & (self.kinds == code)).nonzero()[0])
        ]

    def _operands(self, values: Image, where: torch.Tensor, name: str) -> list[Image]:
        layers = [values[self.left[where]], values[self.right[where]]]
        return [*layers, values[self.mask[where]]] if name == "mix" else layers

    def _environments(self, where: torch.Tensor, split: str, normals: Normals) -> Image:
        pictures = (self.panoramas[split] if self.panoramas else real_panoramas(split)).to(self.device)
        versions, turns = self.numbers[where, 0].long(), self.numbers[where, 1:4]
        # A few at a time: each copies its picture.
        chunks = zip(versions.split(32), turns.split(32), strict=True)
        return torch.cat([KINDS["environment_map"].formula(normals, pictures[version], turn) for version, turn in chunks])


@lru_cache(maxsize=2)
def checked_normals(stride: int) -> Normals:
    """Where `Forest.all_show` looks, (3, 1, P): every ``stride``-th pixel inside the scored disc."""
    inside = disc_mask(CHECKED_SIZE, SCORED_RADIUS)[0]
    return sphere_normals(CHECKED_SIZE)[:, inside][:, None, ::stride].contiguous()


def pictures_of(values: Image, size: int) -> Image:
    """Values at the pixels inside the disc, (N, C, 1, P), as pictures (N, C, size, size), 0 outside."""
    pictures = values.new_zeros(*values.shape[:2], size, size)
    pictures[..., disc_mask(size)[0].to(values.device)] = values[:, :, 0]
    return pictures


def grow(
    outlines: Sequence[Outline], split: str, generator: torch.Generator, panoramas: Image | None = None, attempts: int = 5000
) -> list[Plant]:
    """One tree of each structure in which every leaf shows: drawn again and again until it does. ``panoramas`` as of a `Forest`."""
    shown = None if panoramas is None else {split: panoramas}
    grown: dict[int, Plant] = {}
    for _ in range(attempts):
        missing = [index for index in range(len(outlines)) if index not in grown]
        if not missing:
            break
        # As many tries at the few that are left as there were trees.
        tried = [index for index in missing for _ in range(max(1, len(outlines) // len(missing)))]
        plants = seeds([outlines[index] for index in tried], split, generator)
        for stride, least in ((5, 0.8 * VISIBLE), (1, VISIBLE)):
            good = Forest(plants, panoramas=shown).all_show(checked_normals(stride), least) if plants else np.array([], dtype=bool)
            plants, tried = [p for p, ok in zip(plants, good, strict=True) if ok], [t for t, ok in zip(tried, good, strict=True) if ok]
        for index, plant in zip(tried, plants, strict=True):
            grown.setdefault(index, plant)
    assert len(grown) == len(outlines), f"no tree in which every leaf shows after {attempts} attempts"
    return [grown[index] for index in range(len(outlines))]
