"""The second stage of the learned method: the nodes that the networks leave over.

A node is decomposed twice. First its picture as the first stage left it, 64 pixels wide and a little wrong, so that every node has some
tree. Then, beyond the paper, what it has to show *in its place*: the operators above it are undone with the siblings as they are by
then, which says at the pixels of the real picture what is missing there. The better of both stays.

The first needs nothing but the node, so nodes may be decomposed side by side.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from functools import partial
from typing import Literal, NamedTuple

import torch

from unshade import search_depth
from unshade.atoms import dictionary_of
from unshade.blend import BLENDS
from unshade.decoded import SIZE
from unshade.fit.basin_cma import fit_basin_cma
from unshade.fit.gradient import fit_gradient
from unshade.fit.pixels import Pixels
from unshade.growth import Effort, Growth, Samples
from unshade.inference import Part, Pool
from unshade.nodes import Node
from unshade.proposals import Fits
from unshade.render import render
from unshade.search import Search
from unshade.sphere import disc_mask
from unshade.types import Image, Mask

NODE_EFFORT = Effort(32, price=0.01, beam=0, trials=3, rounds=0, sweeps=0, polish_steps=10)
"""By size on one node: it has what its siblings lack, so the smallest gains are noise."""

ALBEDO = 3
"""Values of one colour."""

NODE_THRESHOLD = 0.03
"""The paper's phi, root mean square, by depth on one node: what a decoded picture is wrong by."""

NODE_BUDGET = search_depth.Budget(ranked=60, fitted=4, extended=4)

HIDDEN = 0.05
"""A node whose gain is less shows too little of itself to be more than one colour."""

ALL = 0.5
"""A node whose gain is at least this may have all values of `NODE_EFFORT`."""

UNSEEN = 1.0e-3
"""So much less than the best seen pixel, and a pixel does not count."""


class Found(NamedTuple):
    """The tree of a node."""

    root: Node
    fits: int
    """Of whole structures, that it took."""


class SecondStage:
    """By size: our search, a tenth of a second to a few seconds a node.

    Args:
        main: whose picture and effort these are. fits: the leaves of the pools.
    """

    def __init__(self, main: Growth, fits: Fits) -> None:
        self.main, self.fits = main, fits

    def decompose(self, part: Part) -> Found:
        """The tree of a part that was left over, on the CPU: of the picture itself where it is the root, else of its own."""
        if not part.depth:
            # Grown, but not looked at as a drawing, which would be the search in the place of the networks.
            return _searched(self.main.samples, dataclasses.replace(self.main.effort, beam=0, rounds=0))
        return _of_node(Pixels.of(part.image, None, SIZE), _room(gain_of(part)))

    def in_place(self, pool: Pool, place: int, second: Mapping[int, Node]) -> Found | None:
        """Another tree of a part below the root, of what it has to show in its place; None where that can hardly be seen."""
        pixels, gain = wanted(pool, place, second, self.fits, self.main.samples.coarse)
        return _of_node(pixels, _room(gain)) if gain >= HIDDEN else None


def _of_node(pixels: Pixels, room: int) -> Found:
    dictionary = dictionary_of(pixels)
    return _searched(Samples(pixels, pixels, pixels, dictionary, dictionary), dataclasses.replace(NODE_EFFORT, max_values=room))


def _searched(samples: Samples, effort: Effort) -> Found:
    steps = [found for _, found in Search(samples, effort).run()]
    return Found(steps[-1].root, len(steps))


def gain_of(part: Part) -> float:
    """How much of a part shows in the picture, root mean square inside the disc: 0 is invisible, 1 is all of it."""
    if part.gain is None:
        return 1.0
    disc = disc_mask(part.gain.shape[-1])
    return math.sqrt(float(part.gain.square().mean(0, keepdim=True)[disc].mean()))


def _room(gain: float) -> int:
    """Values that a node may have: one that shows little of itself is one colour, or a small tree."""
    return max(round(NODE_EFFORT.max_values * min(gain / ALL, 1.0)), ALBEDO) if gain >= HIDDEN else ALBEDO


class SecondStageByDepth(SecondStage):
    """The paper's: structures in order of depth, BasinCMA, a minute or more a node; never in its place.

    Args:
        image, valid, seed: of the picture. objective: of BasinCMA.
    """

    def __init__(self, main: Growth, fits: Fits, image: Image, valid: Mask, objective: Literal["l2", "paper"], seed: int) -> None:
        super().__init__(main, fits)
        self.image, self.valid, self.objective, self.seed = image, valid, objective, seed

    def decompose(self, part: Part) -> Found:
        """See the class."""
        image, valid = (part.image, disc_mask(part.image.shape[-1])) if part.depth else (self.image, self.valid)
        found = Found(self.main.start(), 0)
        with torch.inference_mode(False):
            for progress in search_depth.search(
                image.clone(),
                valid.clone(),
                partial(fit_basin_cma, objective=self.objective, meta_steps=6, gradient_steps=10, final_steps=150),
                NODE_THRESHOLD if part.depth else 0.01,
                seed=self.seed,
                rank=partial(fit_gradient, size=20, steps=50, restarts=3),
                budget=NODE_BUDGET,
                max_values=(NODE_EFFORT if part.depth else self.main.effort).max_values,
            ):
                found = Found(progress.root, progress.done)
        return found

    def in_place(self, pool: Pool, place: int, second: Mapping[int, Node]) -> Found | None:
        """None: the paper looks at decoded pictures only."""
        return None


def wanted(pool: Pool, place: int, second: Mapping[int, Node], fits: Fits, pixels: Pixels) -> tuple[Pixels, float]:
    """What a part would have to show for the tree to be the picture, the rest of the tree being as it is.

    Every operator is affine in each operand, ``gain * operand + offset``, so it can be undone from the root down. A pixel counts by
    the mean square of its gains over the channels.

    Args:
        pixels: of the picture.
    Returns:
        The same places with another target and weight, those that hardly show the part left out; and the part's gain, root mean
        square: 0 is invisible, 1 is all of it.
    """
    at = pixels.normals[:, None]
    target, seen = pixels.target[:, None], torch.ones_like(pixels.target[:, None])
    for above, below in pool.way(place):
        part = pool.parts[above]
        assert part.operator is not None and part.children is not None
        side, blend = part.children.index(below), BLENDS[part.operator]
        operands = [torch.zeros_like(target) if child == below else render(fits.tree(pool, second, child), at) for child in part.children]
        if part.mask is not None:
            operands.append(render(fits.mask(pool, above), at))
        gain = torch.as_tensor(blend.gains(*operands)[side])
        target = ((target - blend.apply(*operands)) / gain.clamp(min=1e-3)).clamp(0.0, 1.0)
        seen = seen * gain
    power = seen.square().mean((0, 1))
    weight = pixels.weight * power + 1e-12
    kept = weight > UNSEEN * weight.max()
    found = Pixels(pixels.normals[:, kept].contiguous(), target[:, 0, kept].contiguous(), weight[kept] / weight[kept].sum())
    return found, math.sqrt(float(weight.sum()))
