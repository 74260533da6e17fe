"""The methods that networks propose trees for: the paper's (`Learned`), and the search that starts from several proposals (`Hybrid`).

`Learned` is the paper's pipeline: the first stage (`inference`), a second stage for the nodes left over, the parametric fit
of every leaf, the optimisation of the whole tree. Deviations from the paper, beyond those of `inference`:

- the fits are second order on pixels, not BasinCMA on pixels and VGG features; ``second_stage="depth"`` is the paper's own;
- an environment is a few lights, not a raster, and a mask a circle or a band, so that the tree is parametric and small;
- products and screens are flattened, an albedo stands once in each, and a tree over the largest size loses its least useful leaves.

What the second stage does is counted and reported (`Stages`), so that nobody takes its work for the networks'.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import torch

from unshade import search_depth
from unshade.atoms import dictionary_of
from unshade.changes import removals, swaps
from unshade.decoded import SIZE
from unshade.fit.basin_cma import fit_basin_cma
from unshade.fit.gradient import fit_gradient
from unshade.fit.least_squares import FINE_SOFTNESS, error_of, fit_pixels
from unshade.fit.model import soften
from unshade.fit.pixels import Pixels
from unshade.growth import FLOOR, Candidate, Effort, Growth, Samples
from unshade.inference import Inference, Networks, Part, Pool, Round, infer, node_image
from unshade.nodes import Node, count_values
from unshade.proposals import Fits
from unshade.search import Search
from unshade.search_drawn import DRAWN, SETTLED, settled
from unshade.sphere import disc_mask
from unshade.types import Image, Mask

NODE_EFFORT = Effort(24, price=0.02, beam=0, trials=3, rounds=0, sweeps=0, polish_steps=10)
"""Of the second stage by size on one node: its picture is decoded from codes, so small gains are noise."""

NODE_THRESHOLD = 0.03
"""The paper's phi, root mean square, of the second stage by depth on one node: what a decoded picture is wrong by."""

NODE_BUDGET = search_depth.Budget(ranked=60, fitted=4, extended=4)

WHOLE_STEPS = 40
"""Most second-order steps of the whole tree on each set of pixels."""

SURVIVORS = 2
"""Proposals that the hybrid finishes beside the search's own tree."""

OFFERED = 4
"""Changes of a proposal that are looked at closely."""

SecondStage = Literal["size", "depth", "none"]


@dataclass(frozen=True)
class Settings:
    """Of the learned methods; the parts that an ablation turns off are here."""

    inference: Inference = field(default_factory=Inference)
    second_stage: SecondStage = "size"
    """How nodes that were left over are decomposed: our search by size, the paper's search by depth (a minute or more a node),
    or not at all: each becomes one colour."""
    overall: bool = True
    """Optimise the whole tree at the end."""
    objective: Literal["l2", "paper"] = "l2"
    """Of the search by depth."""
    device: str = "cpu"
    """Where the networks are; fits are on the CPU. Another device draws other samples from the same seed."""


PROPOSED = Settings(Inference(samples=12, trees=4))
"""Of the hybrid: several trees side by side, which the search finishes."""


@dataclass
class Stages:
    """What each stage did and took. All but the seconds depend on the picture, the settings and the seed alone."""

    method: str
    """That was used."""
    why: str = ""
    """Where it is not the one that was asked for."""
    rounds: int = 0
    nodes: int = 0
    """Of the chosen tree that were to be decomposed."""
    second_stage_nodes: int = 0
    """Of them, those that the networks could not decompose."""
    drawn_nodes: int = 0
    """That children were drawn for, over all trees."""
    samples: int = 0
    """Pairs of children that were drawn."""
    leaf_fits: int = 0
    second_stage_fits: int = 0
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def second_stage_share(self) -> float:
        """Share of the nodes that reach the second stage."""
        return self.second_stage_nodes / max(self.nodes, 1)

    def chosen(self, pool: Pool) -> None:
        """Count the nodes of the pool that became the tree."""
        self.second_stage_nodes = len(pool.left_over)
        self.nodes = self.second_stage_nodes + sum(part.state == "split" for part in pool.parts)

    @contextmanager
    def clock(self, stage: str) -> Iterator[None]:
        """Add the time inside to a stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begin

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        found = dataclasses.asdict(self) | {"second_stage_share": round(self.second_stage_share, 4)}
        return found | {"seconds": {stage: round(seconds, 3) for stage, seconds in self.seconds.items()}}


class _Proposing:
    """The first stage for one picture, and the trees of its pools."""

    def __init__(self, image: Image, valid: Mask, networks: Networks, settings: Settings, seed: int, stages: Stages) -> None:
        self.picture = node_image(image, valid, networks.config.size)
        self.networks, self.settings, self.seed, self.stages = networks, settings, seed, stages
        self.fits = Fits()
        self.pools: tuple[Pool, ...] = ()

    def rounds(self) -> Iterator[Round]:
        """Each level as it is drawn; `pools` holds the result."""
        work = infer(self.picture, self.networks, self.settings.inference, self.seed)
        while True:
            with self.stages.clock("first stage"):
                found = next(work, None)
            if found is None:
                return
            self.pools = found.pools
            self.stages.rounds += 1
            self.stages.drawn_nodes = found.drawn
            self.stages.samples = found.drawn * self.settings.inference.samples
            yield found

    def tree(self, pool: Pool, second: dict[int, Node] | None = None) -> Node:
        """The tree of a pool as it is."""
        with self.stages.clock("leaves"):
            root = self.fits.tree(pool, second)
            self.stages.leaf_fits = self.fits.count
        return root


class Learned(Growth):
    """The paper's method. `run` yields the tree on the way, the last one is the result; `stages` says what was done."""

    def __init__(
        self, image: Image, valid: Mask, samples: Samples, effort: Effort, networks: Networks, settings: Settings, seed: int
    ) -> None:
        super().__init__(samples, effort)
        self.image, self.valid, self.settings, self.seed = image, valid, settings, seed
        self.stages = Stages("learned")
        self.proposing = _Proposing(image, valid, networks, settings, seed, self.stages)

    def run(self) -> Iterator[tuple[str, Candidate]]:
        """(stage, candidate) as they come."""
        best = self._rough(self.start())
        yield "start", best
        for found in self.proposing.rounds():
            best = min(best, self._rough(self.proposing.tree(found.pools[0])), key=lambda candidate: candidate.error)
            yield "propose", best
        finished = []
        for pool in self.proposing.pools:
            second: dict[int, Node] = {}
            for place in pool.left_over if self.settings.second_stage != "none" else []:
                with self.stages.clock("second stage"):
                    second[place] = self._second_stage(pool.parts[place], place == 0, self._room(pool))
                best = min(best, self._rough(self.proposing.tree(pool, second)), key=lambda candidate: candidate.error)
                yield "second stage", best
            root = self.proposing.tree(pool, second)
            with self.stages.clock("whole tree"):
                finished.append((self._finished(root), pool))
        chosen, pool = min(finished, key=lambda entry: self.judge(entry[0].error, entry[0].values))
        self.stages.chosen(pool)
        yield "whole tree", chosen
        with self.stages.clock("family"):
            self._smaller(chosen)

    def _rough(self, root: Node) -> Candidate:
        """A tree as it is."""
        candidate = Candidate(root, error_of(self.samples.coarse, root))
        self.rough.add(candidate)
        return candidate

    def _finished(self, root: Node) -> Candidate:
        """The optimisation of the whole tree, after it has lost what is over the largest size."""
        root = within(root, self.samples.coarse, self.effort.max_values) or self.start()
        if not self.settings.overall:
            candidate = Candidate(root, error_of(self.samples.points, root))
            self.front.add(candidate)
            return candidate
        found = self.fit(root, self.samples.coarse, WHOLE_STEPS)
        found = self.fit(found.root, self.samples.points, WHOLE_STEPS)
        return self.sharpen(found)

    def _smaller(self, chosen: Candidate) -> None:
        """The curve below the result: the leaf whose loss hurts least goes first."""
        current: Candidate | None = chosen
        while current is not None:
            root = least_useful(current.root, self.samples.points)
            current = self.fit(root, self.samples.points, self.effort.growth_steps) if root is not None else None

    def _room(self, pool: Pool) -> int:
        """Values for each node that was left over, so that the tree stays within its size; 3 at least, one colour."""
        share = (self.effort.max_values - count_values(self.proposing.tree(pool))) // max(len(pool.left_over), 1)
        return max(3 + share, 3)

    def _second_stage(self, part: Part, is_root: bool, room: int) -> Node:
        """Decompose a node that was left over: the picture itself where it is the root, else what was decoded."""
        if self.settings.second_stage == "depth":
            image, valid = (self.image, self.valid) if is_root else (part.image.cpu(), disc_mask(part.image.shape[-1]))
            return self._by_depth(image, valid, room, is_root)
        # Of the picture itself: grown, but not looked at as a drawing, which would be the search in the place of the networks.
        samples, effort = self.samples, dataclasses.replace(self.effort, beam=0, rounds=0)
        if not is_root:
            pixels = Pixels.of(part.image.cpu(), None, SIZE)
            samples = Samples(pixels, pixels, pixels, dictionary_of(pixels), dictionary_of(pixels))
            effort = dataclasses.replace(NODE_EFFORT, max_values=min(room, NODE_EFFORT.max_values))
        steps = [found for _, found in Search(samples, effort).run()]
        self.stages.second_stage_fits += len(steps)
        return steps[-1].root

    def _by_depth(self, image: Image, valid: Mask, room: int, is_root: bool) -> Node:
        """The paper's second stage: structures in order of depth, BasinCMA."""
        found, fits = self.start(), 0
        with torch.inference_mode(False):
            for progress in search_depth.search(
                image.clone(),
                valid.clone(),
                partial(fit_basin_cma, objective=self.settings.objective, meta_steps=6, gradient_steps=10, final_steps=150),
                0.01 if is_root else NODE_THRESHOLD,
                seed=self.seed,
                rank=partial(fit_gradient, size=20, steps=50, restarts=3),
                budget=NODE_BUDGET,
                max_values=room,
            ):
                found = progress.root
                fits = progress.done
        self.stages.second_stage_fits += fits
        return found


class Hybrid(Search):
    """Networks propose several trees, parameters included; the search finishes them, and one of its own, side by side.

    A proposal that becomes a drawn picture to its rounding is the answer at once.
    """

    def __init__(
        self, image: Image, valid: Mask, samples: Samples, effort: Effort, networks: Networks, settings: Settings, seed: int
    ) -> None:
        super().__init__(samples, effort)
        self.stages = Stages("hybrid")
        self.proposing = _Proposing(image, valid, networks, settings, seed, self.stages)

    def run(self) -> Iterator[tuple[str, Candidate]]:
        """(stage, candidate) as they come; the last one is the result."""
        best = self.fit(self.start(), self.samples.coarse, 1)
        yield "start", best
        trees: list[tuple[Candidate, Pool]] = []
        for found in self.proposing.rounds():
            # What is still open is one colour in the tree of a round: the fit of a whole level costs little beside drawing it.
            trees = [(self._proposed(pool), pool) for pool in found.pools]
            best = min([best, *(candidate for candidate, _ in trees)], key=lambda candidate: candidate.error)
            yield "propose", best
        survivors = sorted(trees, key=lambda entry: self.judge(entry[0].error, entry[0].values))[:SURVIVORS]
        self.stages.chosen(survivors[0][1])
        finished: list[Candidate] = []
        for proposed, pool in survivors:
            with self.stages.clock("proposals"):
                finished.append(self._settled(proposed))
            if finished[-1].error < DRAWN:
                self.stages.chosen(pool)
                yield "propose", finished[-1]
                return
        results = []
        for stage, found_ in super().run():
            yield stage, found_
            results = [found_]
        for current in finished:
            for current in self.grow(current, self.samples.points, self.samples.points_dictionary, FLOOR, self.families):
                yield "grow", min([current, *results], key=self._judged)
            for _ in range(self.effort.sweeps):
                current = self._sweep(current, self.samples.points)
            results.append(self.sharpen(current))
        yield "polish", min(results, key=self._judged)

    def _judged(self, candidate: Candidate) -> float:
        return self.judge(candidate.error, candidate.values)

    def _proposed(self, pool: Pool) -> Candidate:
        """The tree of a pool, fitted to the coarse averages."""
        root = self.proposing.tree(pool)
        with self.stages.clock("proposals"):
            return self.fit(within(root, self.samples.coarse, self.effort.max_values) or self.start(), self.samples.coarse, 20)

    def _settled(self, proposed: Candidate) -> Candidate:
        """A proposal on all points; one that is nearly right with leaves taken out or exchanged, as long as that is better."""
        current = self.sharpen(self.fit(proposed.root, self.samples.points, self.effort.growth_steps))
        for _ in range(self.effort.settle_steps):
            if current.error < FLOOR or current.error > SETTLED:
                break
            better = self._offered(current)
            if better is None:
                break
            current = better
        self.front.add(current)
        return current

    def _offered(self, current: Candidate) -> Candidate | None:
        """The best tree with one leaf less or of another kind, its edges hard; None if none is better."""
        base = soften(current.root, FINE_SOFTNESS)
        quick = []
        for root in [base, *removals(base), *swaps(base)]:
            if count_values(root) <= self.effort.max_values:
                fitted = fit_pixels(self.samples.points, root, steps=4, softest=FINE_SOFTNESS)
                quick.append(Candidate(fitted.root, fitted.error))
        sharp = [self.sharpen(option) for option in sorted(quick, key=settled)[:OFFERED]]
        best = min(sharp, key=settled)
        return best if settled(best) < settled(current) - 2e-3 else None


class Unproposed(Search):
    """The search in the place of the hybrid, where there are no networks."""

    def __init__(self, samples: Samples, effort: Effort, why: str) -> None:
        super().__init__(samples, effort)
        self.stages = Stages("search", why)


def least_useful(root: Node, pixels: Pixels, steps: int = 3) -> Node | None:
    """The tree without the leaf whose loss hurts least after so many steps of a fit; None where only one is left."""
    options = [fit_pixels(pixels, smaller, steps=steps, softest=FINE_SOFTNESS) for smaller in removals(root)]
    return min(options, key=lambda option: option.error).root if options else None


def within(root: Node, pixels: Pixels, most: int) -> Node | None:
    """The tree without its least useful leaves until it stores at most so many values; None where that cannot be."""
    found: Node | None = root
    while found is not None and (over := count_values(found) - most) > 0:
        # A tree that is far too large is full of leaves that nothing rests on.
        found = least_useful(found, pixels, steps=3 if over < 12 else 0)
    return found
