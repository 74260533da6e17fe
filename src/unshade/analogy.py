"""The visual shading editing analogy (Geng et al. 2023, section 4.2): A is to AB as P is to the answer.

AB is A with one component of B. Each component of B is put into A in turn, and what comes nearest to AB is what was done;
then P gets that component of Q. Only A, B, P and Q are taken apart: AB is looked at, never decomposed, so that its own
decomposition cannot mislead.

Where no component explains AB well, the pictures are asked (`ratio`): a photograph that is reflected is more than a tree can hold.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import torch

from unshade.components import Component
from unshade.decompose import decompose
from unshade.edit import component, transfer
from unshade.errors import PictureError, TreeError
from unshade.metrics import psnr
from unshade.nodes import Tree
from unshade.pictures import SIZE, SphereImage, read_sphere, sphere_from_array
from unshade.ratio import moved, thinned
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals
from unshade.types import Image, Mask

Source: TypeAlias = "Tree | SphereImage | torch.Tensor | str | Path"

Reflections: TypeAlias = Literal["lights", "picture"]
"""How a reflected environment is held, see `decompose`."""

VISIBLE = 50.0
"""dB between two pictures from which they count as the same."""

SURE = 3.0
"""dB by which an explanation must be nearer than the next to be sure of it."""

CLEAR = 24.0
"""dB from which on an explanation by trees needs no other."""


@dataclass(frozen=True)
class Seen:
    """One of the five as a picture, and as a tree where one is needed."""

    image: Image
    valid: Mask
    tree: Tree


@dataclass(frozen=True)
class Explanation:
    """What makes AB of A and B."""

    scores: dict[Component, float]
    """dB between AB and A with each component of B, best first; only components whose move changes A."""
    seen: Component | None = None
    """What the pictures tell, where no component explains AB well."""
    still: float = -math.inf
    """dB between AB and A as it is."""

    @property
    def component(self) -> Component | None:
        """What was moved; None where no component of B changes A."""
        return self.seen or next(iter(self.scores), None)

    def apply(self, q: Tree, p: Tree) -> Tree:
        """P with that component of Q. Raises TreeError for trees of different blend spaces."""
        if self.component is None:
            return p
        held = any(component(tree, Component.ENVIRONMENT) is not None for tree in (q, p))
        return transfer(q, p, self.component, stand_ins=self.seen is Component.ENVIRONMENT and not held)


@dataclass(frozen=True)
class Analogy:
    """What was understood, and the answer."""

    tree: Tree
    """P with the component of Q."""
    component: Component
    explanation: Explanation
    trees: dict[str, Tree]
    """The trees of A, B, P and Q."""
    reflections: Reflections | None = None
    """How what pictures reflect was held; None where none was decomposed."""

    @property
    def scores(self) -> dict[Component, float]:
        """Of the explanation."""
        return self.explanation.scores

    @property
    def margin(self) -> float:
        """dB by which the best explanation is nearer than the next; infinite where there is no other."""
        best = list(self.scores.values())
        return best[0] - best[1] if len(best) > 1 else math.inf

    @property
    def doubt(self) -> str:
        """Why something else may have been moved; empty where that is unlikely."""
        if self.explanation.seen is not None:
            return "told from the pictures, the trees do not explain it"
        if next(iter(self.scores.values())) <= self.explanation.still:
            return f"AB is nearer to A as it is, {self.explanation.still:.1f} dB"
        return f"the next explanation is {self.margin:.1f} dB away" if self.margin < SURE else ""

    @property
    def sure(self) -> bool:
        """Is the margin large enough, and do the trees hold what was moved?"""
        return not self.doubt

    def report(self) -> dict[str, Any]:
        """What was understood, for JSON."""
        return {
            "component": self.component.value,
            "sure": self.sure,
            "doubt": self.doubt,
            "seen_in_pictures": self.explanation.seen is not None,
            "margin_db": None if math.isinf(self.margin) else round(self.margin, 2),
            "scores_db": {which.value: round(min(score, 200.0), 2) for which, score in self.scores.items()},
            "understood": f"AB is A with the {self.component.value} of B; the answer is P with the {self.component.value} of Q",
            "reflections": self.reflections,
            "values": {name: tree.values for name, tree in {**self.trees, "answer": self.tree}.items()},
        }


def analogy(
    a: Source,
    b: Source,
    ab: Source,
    p: Source,
    q: Source,
    *,
    preset: str = "balanced",
    seed: int = 0,
    told: Callable[[str], None] | None = None,
) -> Analogy:
    """Find what makes AB of A and B, and do it with P and Q.

    Args:
        a, b, ab, p, q: trees or pictures. Pictures other than AB are decomposed first, with ``preset`` and ``seed``, and where the
            network for it is there, with what they reflect as a picture, which can be moved whole; else as lights, and
            `Analogy.reflections` says so.
        told: called with the name of each picture before it is decomposed.
    Raises:
        PictureError: a picture cannot be used. TreeError: AB is A, no component of B changes A, or the blend spaces differ.
        WeightsError: the weights of that network are damaged.
    """
    # All are read before the first is decomposed, so that a bad one is told at once.
    read = {name: _read(source) for name, source in {"A": a, "B": b, "AB": ab, "P": p, "Q": q}.items()}
    goal, valid = _picture(read.pop("AB"))
    before, counts = _picture(read["A"])
    if (still := psnr(goal, before, counts & valid)) >= VISIBLE:
        near = "is identical to A" if math.isinf(still) else f"looks like A, {still:.1f} dB apart"
        raise TreeError(f"nothing was moved: AB {near}, so nothing can be understood from it")
    held = _held() if any(not isinstance(source, Tree) for source in read.values()) else None
    seen = {}
    for name, source in read.items():
        if told is not None and not isinstance(source, Tree):
            told(name)
        seen[name] = _seen(source, preset, seed, held or "lights")
    found = explain(seen["A"], seen["B"], goal, valid)
    if found.component is None:
        raise TreeError("no component of B changes A, so nothing can be understood from AB")
    answer = found.apply(seen["Q"].tree, seen["P"].tree)
    return Analogy(answer, found.component, found, {name: one.tree for name, one in seen.items()}, held)


def explain(a: Seen, b: Seen, ab: Image, valid: Mask) -> Explanation:
    """Put each component of B into A in turn and look how near that comes to AB, at every other pixel.

    What the tree of A leaves of its picture unexplained is not held against any of them: changes are compared, not pictures.
    """
    normals = thinned(sphere_normals(SIZE))
    before = render(a.tree, normals)
    wanted, counts = thinned(ab - a.image), thinned(a.valid & valid)
    found = {}
    for which in Component:
        change = render(transfer(b.tree, a.tree, which), normals) - before
        if psnr(change, torch.zeros_like(change)) < VISIBLE:
            found[which] = psnr(change, wanted, counts)
    best = dict(sorted(found.items(), key=lambda entry: -entry[1]))
    is_clear = any(score > CLEAR for score in best.values())
    seen = None if is_clear else moved(a.image, b.image, ab, a.valid & b.valid & valid)
    return Explanation(best, seen, psnr(wanted, torch.zeros_like(wanted), counts))


def _read(source: Source) -> Tree | SphereImage:
    if isinstance(source, Tree | SphereImage):
        sphere = source
    else:
        sphere = read_sphere(source) if isinstance(source, str | Path) else sphere_from_array(source)
    if isinstance(sphere, SphereImage) and sphere.size != SIZE:
        raise PictureError(f"analogy: expected spheres of {SIZE} pixels, got {sphere.size}")
    return sphere


def _picture(source: Tree | SphereImage) -> tuple[Image, Mask]:
    if isinstance(source, Tree):
        return render(source, sphere_normals(SIZE)), disc_mask(SIZE)
    return source.image, source.valid


def _held() -> Reflections:
    """As a picture where the network for it is there."""
    from unshade.models import weights

    return "picture" if weights.file_of("reflection").is_file() else "lights"


def _seen(source: Tree | SphereImage, preset: str, seed: int, held: Reflections) -> Seen:
    tree = source if isinstance(source, Tree) else decompose(source, preset=preset, seed=seed, reflections=held).result().tree
    return Seen(*_picture(source), tree)
