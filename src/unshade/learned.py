"""The methods that networks propose trees for: the paper's (`Learned`), and the search that starts from several proposals (`Hybrid`).

`Learned` is the paper's pipeline: the first stage (`inference`), a second stage for the nodes left over (`second_stage`), the parametric
fit of every leaf, the optimisation of the whole tree. Deviations from the paper, beyond those of `inference`:

- the fits are second order on pixels, not BasinCMA on pixels and VGG features; ``second_stage="depth"`` is the paper's own;
- nodes that were left over are looked at twice, the second time in their place (``in_place``);
- an environment is a few lights, not a raster, and a mask a circle or a band, so that the tree is parametric and small;
- products and screens are flattened, an albedo stands once in each, and a tree over the largest size loses its least useful leaves.

What the second stage does is counted and reported (`Stages`), so that nobody takes its work for the networks'.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import torch

from unshade.changes import removals, swaps
from unshade.fit.least_squares import FINE_SOFTNESS, error_of, fit_pixels
from unshade.fit.model import soften
from unshade.growth import FLOOR, Candidate, Effort, Growth, Samples
from unshade.inference import Cause, Inference, Networks, Pool, Round, infer
from unshade.node_image import node_image
from unshade.nodes import Node, count_values
from unshade.proposals import Fits
from unshade.pruning import least_useful, within
from unshade.search import Search
from unshade.search_drawn import DRAWN, SETTLED, settled
from unshade.second_stage import SecondStage, SecondStageByDepth
from unshade.threads import threads
from unshade.types import Image, Mask

PLACED_STEPS = 6
"""Second-order steps of the whole tree before two trees are compared."""

WHOLE_STEPS = 40
"""Most second-order steps of the whole tree on each set of pixels."""

SURVIVORS = 2
"""Trees of pools that are finished, by the hybrid beside the search's own. A third of `Learned` took a third more time for 0.25 dB."""

SECOND_NODES = 6
"""Different nodes that the second stage decomposes before a third pool adds to them. Without the third the trees of four development
pictures that leave more over were as good or better (in the mean by 1.2 dB), in 0.7 to 1.0 of the time."""

OFFERED = 4
"""Changes of a proposal that are looked at closely."""

SecondStageName = Literal["size", "depth", "none"]


@dataclass(frozen=True)
class Settings:
    """Of the learned methods; the parts that an ablation turns off are here."""

    inference: Inference = field(default_factory=Inference)
    second_stage: SecondStageName = "size"
    """How nodes that were left over are decomposed: our search by size, the paper's search by depth (a minute or more a node),
    or not at all: each becomes one colour."""
    in_place: bool = True
    """Look at nodes that were left over a second time, in their place in the tree (`second_stage`); the paper does not."""
    overall: bool = True
    """Optimise the whole tree at the end."""
    objective: Literal["l2", "paper"] = "l2"
    """Of the search by depth."""
    device: str = "cpu"
    """Where the networks are; fits are on the CPU. Another device draws other samples from the same seed."""
    threads: int = 0
    """Of the networks, on a CPU; 0 for as many as PyTorch uses when the work begins."""


@dataclass
class Stages:
    """What each stage did and took. All but the seconds depend on the picture, the settings and the seed alone."""

    method: str
    """That was used."""
    why: str = ""
    """Where it is not the one that was asked for."""
    second_stage: SecondStageName | None = None
    """Of the learned method."""
    tree_of: Literal["networks", "search"] | None = None
    """Of the hybrid: whose tree became the result, one that networks proposed or the search's own."""
    rounds: int = 0
    nodes: int = 0
    """Of the chosen tree that were to be decomposed."""
    second_stage_nodes: int = 0
    """Of them, those that were left over, whatever the cause. All of them are one, the picture itself, where the networks found nothing."""
    left_over: dict[Cause, int] = field(default_factory=lambda: dict.fromkeys(get_args(Cause), 0))
    """The same by why."""
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
        causes = [pool.parts[place].cause for place in pool.left_over]
        self.left_over = {cause: causes.count(cause) for cause in self.left_over}
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
            with self.stages.clock("first stage"), threads(self.settings.threads or torch.get_num_threads()):
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
        self.settings = settings
        self.stages = Stages("learned", second_stage=settings.second_stage)
        self.proposing = _Proposing(image, valid, networks, settings, seed, self.stages)
        fits = self.proposing.fits
        self.second = (
            SecondStageByDepth(self, fits, image, valid, settings.objective, seed)
            if settings.second_stage == "depth"
            else SecondStage(self, fits)
        )

    def run(self) -> Iterator[tuple[str, Candidate]]:
        """(stage, candidate) as they come."""
        best = self._rough(self.start())
        yield "start", best
        for found in self.proposing.rounds():
            best = min(best, self._rough(self.proposing.tree(found.pools[0])), key=lambda candidate: candidate.error)
            yield "propose", best
        looked: list[tuple[Candidate, Pool, dict[int, Node]]] = []
        pools = self.proposing.pools if self.settings.second_stage == "none" else taken_up(self.proposing.pools)
        for pool in pools:
            second: dict[int, Node] = {}
            for rough in self._second_stage(pool, second):
                best = min(best, rough, key=lambda candidate: candidate.error)
                yield "second stage", best
            looked.append((self._placed(pool, second), pool, second))
        finished = []
        for placed, pool, second in sorted(looked, key=lambda entry: self.judged(entry[0]))[:SURVIVORS]:
            for better in self._in_place(placed, pool, second):
                best = min(best, better, key=lambda candidate: candidate.error)
                yield "second stage", best
            root = self.proposing.tree(pool, second)
            with self.stages.clock("whole tree"):
                finished.append((self._finished(root), pool))
        chosen, pool = min(finished, key=lambda entry: self.judged(entry[0]))
        self.stages.chosen(pool)
        self.stages.second_stage_fits = self.second.count
        yield "whole tree", chosen
        with self.stages.clock("family"):
            self._smaller(chosen)

    def _second_stage(self, pool: Pool, second: dict[int, Node]) -> Iterator[Candidate]:
        """Decompose what was left over, into ``second``; the tree after each node."""
        for place in pool.left_over if self.settings.second_stage != "none" else ():
            with self.stages.clock("second stage"):
                second[place] = self.second.decompose(pool, place, second)
            yield self._rough(self.proposing.tree(pool, second))

    def _in_place(self, placed: Candidate, pool: Pool, second: dict[int, Node]) -> Iterator[Candidate]:
        """Decompose it once more where it stands; the tree after each node that is better so."""
        # A pool whose root is left over has no other parts, and the root is in its place already.
        if not self.settings.in_place or not any(second):
            return
        for place in pool.left_over:
            with self.stages.clock("second stage"):
                found = self.second.in_place(pool, place, second)
            if found is None:
                continue
            other = self._placed(pool, second | {place: found})
            if self.judged(other) < self.judged(placed):
                placed, second[place] = other, found
                yield self._rough(self.proposing.tree(pool, second))

    def _placed(self, pool: Pool, second: dict[int, Node]) -> Candidate:
        """The tree of a pool after a short fit, or as it is where the whole tree is not optimised."""
        root = self.proposing.tree(pool, second)
        if not self.settings.overall:
            return self._rough(root)
        with self.stages.clock("second stage"):
            return self.fit(root, self.samples.coarse, PLACED_STEPS)

    def _rough(self, root: Node) -> Candidate:
        """A tree as it is."""
        candidate = Candidate(root, error_of(self.samples.coarse, root))
        self.rough.add(candidate)
        return candidate

    def _finished(self, root: Node) -> Candidate:
        """The optimisation of the whole tree, after it has lost what is over the largest size."""
        if self.settings.overall and count_values(root) > self.effort.max_values:
            # Which leaves are of use shows once the tree is the picture's.
            root = self.fit(root, self.samples.coarse, PLACED_STEPS).root
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


def taken_up(pools: Sequence[Pool]) -> list[Pool]:
    """The pools whose nodes the second stage decomposes: two, and more while no more than `SECOND_NODES` different ones are left over."""
    found: list[Pool] = []
    nodes: set[Image] = set()
    for pool in pools:
        # Pools share their parts; a tensor is equal to itself alone.
        nodes.update(pool.parts[place].image for place in pool.left_over)
        if len(found) >= 2 and len(nodes) > SECOND_NODES:
            break
        found.append(pool)
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
        survivors = sorted(trees, key=lambda entry: self.judged(entry[0]))[:SURVIVORS]
        finished: list[Candidate] = []
        for proposed, pool in survivors:
            with self.stages.clock("proposals"):
                finished.append(self._settled(proposed))
            if finished[-1].error < DRAWN:
                self._decided("networks", pool)
                yield "propose", finished[-1]
                return
        results = []
        for stage, found_ in super().run():
            yield stage, found_
            results = [found_]
        for current in finished:
            for current in self.grow(current, self.samples.points, self.samples.points_dictionary, FLOOR, self.families):
                yield "grow", min([current, *results], key=self.judged)
            for _ in range(self.effort.sweeps):
                current = self._sweep(current, self.samples.points)
            results.append(self.sharpen(current))
        best = min(results, key=self.judged)
        place = next(place for place, result in enumerate(results) if result is best)
        self._decided("networks" if place else "search", survivors[max(place - 1, 0)][1])
        yield "polish", best

    def _decided(self, whose: Literal["networks", "search"], pool: Pool) -> None:
        """Note whose tree is the result, and count the nodes of the proposal that it is, or of the best one."""
        self.stages.chosen(pool)
        # What grows from a proposal of one colour is the search's.
        self.stages.tree_of = whose if self.stages.second_stage_nodes < self.stages.nodes else "search"

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
