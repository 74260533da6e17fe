"""One visual analogy for one method: is the component understood, and how near is the answer?"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from unshade import metrics, serde
from unshade.analogy import Seen, explain
from unshade.bench.measures import decibels
from unshade.components import Component
from unshade.errors import TreeError
from unshade.experiments.pieces import pieces, swapped
from unshade.experiments.subjects import pool, shown
from unshade.nodes import Tree
from unshade.pictures import SIZE
from unshade.render import render
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.types import Image


@dataclass(frozen=True)
class Question:
    """Known trees by their numbers in a pool, the component that moves, and what a method made of each tree's picture."""

    dataset: str
    component: str
    numbers: tuple[int, int, int, int]
    """A, B, P and Q."""
    found: tuple[str, ...] = ()
    """Trees as JSON, in the same order."""


def truths(question: Question, seed: int) -> tuple[Tree, ...]:
    """A, B, P, Q, then AB and the answer."""
    trees = pool(question.dataset, max(question.numbers) + 1, seed)
    a, b, p, q = (trees[number] for number in question.numbers)
    which = Component(question.component)
    return a, b, p, q, swapped(a, b, which), swapped(p, q, which)


@lru_cache(maxsize=160)
def _pool_picture(dataset: str, number: int, seed: int) -> Image:
    return shown(pool(dataset, number + 1, seed)[number])


def understood(question: Question, seed: int, perceptual: bool) -> dict[str, Any]:
    """The row of an analogy. A method whose trees cannot be edited so gives P back unchanged."""
    a, b, p, q, ab, answer = truths(question, seed)
    found_a, found_b, found_p, found_q = (serde.loads(tree) for tree in question.found)
    disc, scored = disc_mask(SIZE), disc_mask(SIZE, SCORED_RADIUS)
    row: dict[str, Any] = {
        "component": question.component,
        "understood": None,
        "by_trees": None,
        "pool": question.dataset,
        "numbers": list(question.numbers),
    }
    row["with_environment"] = any((pieces(tree) or {}).get(Component.ENVIRONMENT) for tree in (a, b, p, q))
    done, pictures = found_p, [_pool_picture(question.dataset, number, seed) for number in question.numbers[:2]]
    try:
        found = explain(Seen(pictures[0], disc, found_a), Seen(pictures[1], disc, found_b), shown(ab), disc)
        if found.component is not None:
            row |= {"understood": found.component.value, "by_trees": next((which.value for which in found.scores), None)}
            done = found.apply(found_q, found_p)
    except TreeError as error:
        row["fault"] = str(error)
    picture, given = render(done, sphere_normals(SIZE)), shown(answer)
    with torch.no_grad():
        lpips = metrics.st_lpips(picture, given, mask=scored) if perceptual else None
    return row | {
        "right": row["understood"] == question.component,
        "psnr": decibels(picture, given, scored),
        "ssim": metrics.ssim(picture, given, scored),
        "st_lpips": lpips,
        "tree": serde.dumps(done),
    }
