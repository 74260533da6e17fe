"""The search that starts from several trees of the networks."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Literal

from unshade.changes import removals, swaps
from unshade.fit.least_squares import FINE_SOFTNESS, fit_pixels
from unshade.fit.model import soften
from unshade.growth import FLOOR, Candidate, Effort, Samples
from unshade.inference import Networks, Pool
from unshade.learned import SURVIVORS, Proposing, Settings, Stages
from unshade.nodes import count_values
from unshade.pruning import within
from unshade.search import Search
from unshade.search_drawn import DRAWN, SETTLED, settled
from unshade.types import Image, Mask

OFFERED = 4
"""Changes of a proposal that are looked at closely."""


class Hybrid(Search):
    """Networks propose several trees, parameters included; the search finishes them, and one of its own, side by side.

    A proposal that becomes a drawn picture to its rounding is the answer at once.
    """

    def __init__(
        self, image: Image, valid: Mask, samples: Samples, effort: Effort, networks: Networks, settings: Settings, seed: int
    ) -> None:
        super().__init__(samples, effort)
        self.workers = settings.threads
        self.stages = Stages("hybrid")
        self.proposing = Proposing(image, valid, networks, settings, seed, self.stages)

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
        settling = self.side_by_side([partial(self._settled, proposed) for proposed, _ in survivors], self.workers)
        grown: list[Candidate] = []
        for current, (_, pool) in zip(self.stages.timed("proposals", settling), survivors, strict=True):
            if current.error < DRAWN:
                self._decided("networks", pool)
                yield "propose", current
                return
            grown.append(current)
        results = []
        for stage, found_ in super().run():
            yield stage, found_
            results = [found_]
        for current in self.side_by_side([partial(self._finished, current) for current in grown], self.workers):
            results.append(current)
            yield "grow", min(results, key=self.judged)
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

    def _finished(self, current: Candidate) -> Candidate:
        """A proposal grown on, with leaves of other kinds and in other places, its edges hard."""
        *_, current = [current, *self.grow(current, self.samples.points, self.samples.points_dictionary, FLOOR, self.families)]
        for _ in range(self.effort.sweeps):
            current = self._sweep(current, self.samples.points)
        return self.sharpen(current)

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
