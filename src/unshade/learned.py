"""The paper's method: networks propose a tree, searches and fits finish it.

The first stage (`inference`), a second stage for the nodes left over (`second_stage`), the parametric fit of every leaf, the
optimisation of the whole tree. Deviations from the paper, beyond those of `inference`:

- the fits are second order on pixels, not BasinCMA on pixels and VGG features; ``second_stage="depth"`` is the paper's own;
- nodes that were left over are looked at twice, the second time in their place (``in_place``);
- an environment is a few lights, not a raster, and a mask a circle or a band, so that the tree is parametric and small;
- products and screens are flattened, an albedo stands once in each, and a tree over the largest size loses its least useful leaves.

What the second stage does is counted and reported (`Stages`), so that nobody takes its work for the networks'.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, get_args

import torch

from unshade.fit.least_squares import error_of
from unshade.growth import Answer, Candidate, Effort, Growth, Samples
from unshade.inference import Cause, Inference, Networks, Pool, Round, infer
from unshade.node_image import node_image
from unshade.nodes import Node, count_values
from unshade.proposals import Fits
from unshade.pruning import least_useful, within
from unshade.second_stage import SecondStage, SecondStageByDepth
from unshade.threads import threads
from unshade.types import Image, Mask

PLACED_STEPS = 6
"""Second-order steps of the whole tree before two trees are compared."""

WHOLE_STEPS = 40
"""Most second-order steps of the whole tree on each set of pixels."""

SURVIVORS = 2
"""Trees of pools that are finished, by the hybrid beside the search's own. A third took a third more time for 0.25 dB."""

SECOND_NODES = 6
"""Different nodes that the second stage decomposes before a third pool adds to them. Without the third the trees of four development
pictures that leave more over were as good or better (in the mean by 1.2 dB), in 0.7 to 1.0 of the time."""

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
    """Of the networks, on a CPU, and copies of the process that decompose what they leave over and finish trees (`crew.side_by_side`);
    0 for as many as PyTorch uses when the work begins."""


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

    def timed(self, stage: str, work: Iterator[Answer]) -> Iterator[Answer]:
        """The same, with the time of each step added to a stage."""
        while True:
            with self.clock(stage):
                try:
                    found = next(work)
                except StopIteration:
                    return
            yield found

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        found = dataclasses.asdict(self) | {"second_stage_share": round(self.second_stage_share, 4)}
        return found | {"seconds": {stage: round(seconds, 3) for stage, seconds in self.seconds.items()}}


class Proposing:
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
        self.proposing = Proposing(image, valid, networks, settings, seed, self.stages)
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
        pools = self.proposing.pools if self.settings.second_stage == "none" else taken_up(self.proposing.pools)
        known: dict[Image, Node] = {}
        for image, root in self._decomposed(pools):
            known[image] = root
            yield "second stage", best
        looked = []
        for pool in pools:
            second = {place: known[image] for place in pool.left_over if (image := pool.parts[place].image) in known}
            best = min(best, self._rough(self.proposing.tree(pool, second)), key=lambda candidate: candidate.error)
            yield "second stage", best
            with self.stages.clock("second stage"):
                looked.append((self._placed(pool, second), pool, second))
        survivors = sorted(looked, key=lambda entry: self.judged(entry[0]))[:SURVIVORS]
        trees = []
        in_place = self._side_by_side("second stage", [partial(self._in_place, *entry) for entry in survivors])
        for (second, fits), (_, pool, _) in zip(in_place, survivors, strict=True):
            self.stages.second_stage_fits += fits
            trees.append(self.proposing.tree(pool, second))
            best = min(best, self._rough(trees[-1]), key=lambda candidate: candidate.error)
            yield "second stage", best
        finished = list(self._side_by_side("whole tree", [partial(self._finished, root) for root in trees]))
        place = min(range(len(finished)), key=lambda place: self.judged(finished[place]))
        chosen = finished[place]
        self.stages.chosen(survivors[place][1])
        yield "whole tree", chosen
        with self.stages.clock("family"):
            self._smaller(chosen)

    def _decomposed(self, pools: Sequence[Pool]) -> Iterator[tuple[Image, Node]]:
        """The nodes that pools leave over, each once, with their trees."""
        if self.settings.second_stage == "none":
            return
        parts = list({pool.parts[place].image: pool.parts[place] for pool in pools for place in pool.left_over}.values())
        found = self._side_by_side("second stage", [partial(self.second.decompose, part.cpu()) for part in parts])
        for part, (root, fits) in zip(parts, found, strict=True):
            self.stages.second_stage_fits += fits
            yield part.image, root

    def _side_by_side(self, stage: str, jobs: Sequence[Callable[[], Answer]]) -> Iterator[Answer]:
        return self.stages.timed(stage, self.side_by_side(jobs, self.settings.threads))

    def _in_place(self, placed: Candidate, pool: Pool, second: dict[int, Node]) -> tuple[dict[int, Node], int]:
        """What was left over, each decomposed once more where it stands, if the tree is better so; and the fits that it took."""
        fits = 0
        # A pool whose root is left over has no other parts, and the root is in its place already.
        for place in pool.left_over if self.settings.in_place and any(second) else ():
            found = self.second.in_place(pool, place, second)
            if found is None:
                continue
            fits += found.fits
            other = self._placed(pool, second | {place: found.root})
            if self.judged(other) < self.judged(placed):
                placed, second = other, second | {place: found.root}
        return second, fits

    def _placed(self, pool: Pool, second: dict[int, Node]) -> Candidate:
        """The tree of a pool after a short fit, or as it is where the whole tree is not optimised."""
        root = self.proposing.fits.tree(pool, second)
        return self.fit(root, self.samples.coarse, PLACED_STEPS) if self.settings.overall else self._rough(root)

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
