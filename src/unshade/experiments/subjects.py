"""The pictures of the experiments: test trees of both styles, real spheres, drawings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import cast

from unshade.bench import datasets
from unshade.bench.datasets import Case, Subject
from unshade.experiments.drawings import DRAWINGS, drawing
from unshade.experiments.pieces import pieces
from unshade.nodes import Tree
from unshade.pictures import SIZE, Disc, SphereImage
from unshade.render import render
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.synthesis import Style, trees
from unshade.types import Image

STYLES = ("realistic", "toon")
"""Trees of the test half of the synthetic data: no leaf of theirs occurs in training."""

POOLS = ("pool-realistic", "pool-toon")
"""Those of them whose components can be told apart, for analogies."""

TEST_SEED = 90_001
"""Apart from the seed of the unseen nodes that training reports on."""

PRIVATE = ("wild",)
"""Sets whose pictures must not be passed on."""


def find_cases(dataset: str, data: Path, limit: int) -> list[Case]:
    """The cases of a set, ``limit`` at most, spread evenly; none where the set is absent."""
    if dataset in (*STYLES, *POOLS):
        return [Case(dataset, f"{number:04d}", None, number) for number in range(limit)]
    if dataset == "drawings":
        return [Case(dataset, name) for name in list(DRAWINGS)[:limit]]
    return datasets.find_cases(dataset, data, limit)


def load(case: Case, seed: int) -> Subject:
    """One case with its pictures. Raises PictureError."""
    if case.dataset in STYLES:
        return known(next(trees(cast(Style, case.dataset), "test", seed=TEST_SEED + seed, start=case.number)))
    if case.dataset in POOLS:
        return known(pool(case.dataset, case.number + 1, seed)[case.number])
    if case.dataset == "drawings":
        return Subject(_sphere(drawing(case.name)), disc_mask(SIZE, SCORED_RADIUS))
    return datasets.load(case, seed)


@lru_cache(maxsize=4)
def _released(dataset: str, seed: int) -> tuple[list[Tree], Iterator[Tree]]:
    """Those found so far, and where the next ones come from."""
    style = cast(Style, dataset.removeprefix("pool-"))
    return [], (tree for tree in trees(style, "test", seed=TEST_SEED + 1 + seed) if pieces(tree) is not None)


def pool(dataset: str, count: int, seed: int) -> list[Tree]:
    """The first test trees of a style whose components can be told apart."""
    found, stream = _released(dataset, seed)
    found.extend(islice(stream, max(0, count - len(found))))
    return found[:count]


def shown(tree: Tree) -> Image:
    """The picture of a tree in 8 bits, (3, 256, 256)."""
    return (render(tree, sphere_normals(SIZE)) * 255.0).round() / 255.0


def known(tree: Tree) -> Subject:
    """A picture whose tree is known."""
    return Subject(_sphere(shown(tree)), disc_mask(SIZE, SCORED_RADIUS), tree)


def _sphere(image: Image) -> SphereImage:
    half = SIZE / 2
    return SphereImage(image, disc_mask(SIZE), Disc(half, half, half, 1.0))
