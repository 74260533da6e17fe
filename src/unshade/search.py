"""Search over structures by size: grow a tree leaf by leaf where it pays most, then prune, swap and polish."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator

from unshade.changes import removals, swaps
from unshade.fit.least_squares import FINE_SOFTNESS, fit_pixels
from unshade.fit.pixels import Pixels
from unshade.growth import FLOOR, Candidate, Effort, Growth, Samples
from unshade.nodes import count_values
from unshade.search_drawn import DRAWN, DrawnSearch, looks_drawn
from unshade.search_reflecting import ReflectingSearch, is_edged, may_reflect

ALL = ("lights", "masks", "shades", "spots", "rims", "environments")
"""Every family of leaves."""

LATE = frozenset({"rims", "environments"})
"""Families that come only where `Effort.late` asks for them, and once a tree is good: early they take over form, which belongs
to the diffuse part."""


class Search(Growth):
    """One search. `run` yields better and better candidates; the last one is the result.

    ``left_out`` are families of leaves to do without, which leads to another explanation of the picture.
    """

    def __init__(self, samples: Samples, effort: Effort, left_out: frozenset[str] = frozenset()) -> None:
        super().__init__(samples, effort)
        without = left_out if effort.late else left_out | LATE
        self.complete = not left_out
        self.families = tuple(family for family in ALL if family not in without)
        self.early = tuple(family for family in self.families if family not in LATE)

    def run(self) -> Iterator[tuple[str, Candidate]]:
        """(stage, candidate) as they come; the last one is the result."""
        current = Candidate(self.start(), math.inf)
        for current in self.grow(current, self.samples.coarse, self.samples.coarse_dictionary, 1e-4, self.early):
            yield "grow", current
        current = yield from (self._drawn_or_grown if self.effort.beam and self.complete else self._grown)(current)
        yield "polish", current

    def _drawn_or_grown(self, current: Candidate) -> Generator[tuple[str, Candidate], None, Candidate]:
        """The tree that the picture was drawn with, or the one grown on in all words, whichever is better."""
        drawn = DrawnSearch(self.samples, self.effort)
        plain = yield from drawn.run(self.rough.members())
        self.front.update(drawn.front)
        self.rough.update(drawn.rough)
        current = plain if plain is not None and plain.error < DRAWN else (yield from self._grown(current))
        if self.samples.is_clean and may_reflect(current, plain):
            current = yield from self._with_environment(current, plain)
        if current is not plain and looks_drawn(current):
            current = drawn.prune(current)
        if plain is not None and self.judged(plain) < self.judged(current):
            current = plain
        return current

    def _grown(self, current: Candidate) -> Generator[tuple[str, Candidate], None, Candidate]:
        """The tree grown on in all words and points of the full picture, with leaves of other kinds and in other places, sharp."""
        current = self.fit(current.root, self.samples.points, self.effort.growth_steps)
        for current in self.grow(current, self.samples.points, self.samples.points_dictionary, FLOOR, self.families):
            yield "grow", current
        for _ in range(self.effort.sweeps):
            current = self._sweep(current, self.samples.points)
            yield "swap", current
        for number in range(self.effort.rounds):
            better = self._exchange(current, number)
            if self.judged(better) < self.judged(current):
                current = better
                yield "exchange", current
        return self.sharpen(current)

    def _with_environment(self, current: Candidate, plain: Candidate | None) -> Generator[tuple[str, Candidate], None, Candidate]:
        """The tree of the released grammar with an environment, if that is better."""
        drawn = ReflectingSearch(self.samples, self.effort, is_edged(current, plain))
        found = yield from drawn.run(self.rough.members())
        if found is None or self.judged(found) >= self.judged(current):
            return current
        self.front.update(drawn.front)
        self.rough.update(drawn.rough)
        return found

    def _sweep(self, current: Candidate, pixels: Pixels) -> Candidate:
        """Offer every leaf another kind, or none at all, until nothing pays."""
        current = self.fit(current.root, pixels, self.effort.growth_steps)
        for _ in range(self.effort.sweep_steps):
            score = self.judged(current)
            options = []
            for root in removals(current.root) + swaps(current.root):
                if count_values(root) <= min(current.values + 2, self.effort.max_values):
                    quick = fit_pixels(pixels, root, steps=2, softest=FINE_SOFTNESS)
                    options.append(Candidate(quick.root, quick.error))
            options.sort(key=self.judged)
            tried = [self.fit(option.root, pixels, self.effort.growth_steps) for option in options[:3]]
            best = min(tried, key=self.judged, default=current)
            if self.judged(best) > score - 1e-4:
                return current
            current = best
        return current

    def _exchange(self, current: Candidate, number: int) -> Candidate:
        """Take out the leaf whose loss hurts least (the next one each time) and grow again."""
        pixels = self.samples.points
        options = []
        for root in removals(current.root):
            quick = fit_pixels(pixels, root, steps=3, softest=FINE_SOFTNESS)
            options.append((self.judge(quick.error, count_values(root)), quick.root))
        options.sort(key=lambda option: option[0])
        if not options:
            return current
        smaller = self.fit(options[min(number, len(options) - 1)][1], pixels, self.effort.growth_steps)
        *_, regrown = [smaller, *self.grow(smaller, pixels, self.samples.points_dictionary, FLOOR, self.families)]
        return regrown
