"""Search for the tree that a picture was drawn with: beam search with only the words of the released grammar.

Toon pictures, vector art and sampled trees are made of few exact parts. Their tree is found by trying every form of
shading side by side, then settling it leaf by leaf with its edges hard, down to the rounding of the picture.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator

from unshade.beam import Seen, is_released, lineages
from unshade.changes import paints_as_shades, removals, swaps
from unshade.fit.least_squares import COARSE_SOFTNESS, FINE_SOFTNESS, fit_pixels, sharpen
from unshade.fit.model import Model, soften
from unshade.fit.plan import NO_LIMITS, Limits, softness_of
from unshade.growth import FLOOR, Candidate, Effort, Growth, Samples
from unshade.moves import Proposer
from unshade.nodes import Leaf, Node, count_values, walk

PLAIN = ("plain_lights", "plain_masks", "plain_shades", "plain_spots", "plain_rims")
"""The families of the released grammar without its environments: all lights grey, edges drawn."""
PLAIN_LIMITS: Limits = {"softness": (0.0, 0.15), "highlight.sharpness": (20.0, 150.0), "exponent": (0.7, 1.5), "radius": (0.0, 0.8)}
"""Its ranges, a little wider, so that a fit does not turn a spot into something else."""

DRAWN = 1.0e-5
"""A plain tree with a mean squared error under this one is the answer: the picture was drawn with such a tree."""

ROUNDING = 3.0e-6
"""A tree under this error is the picture but for the rounding to 8 bits."""

LARGEST_DRAWN = 56
"""Values of the largest tree of the released grammar, and one detour more."""

SETTLED = 5.0e-4
"""Only a plain tree under this error is worth settling leaf by leaf."""

UNLIKE = 2.5e-4
"""A picture that was not drawn shows itself while the plain trees' error is over this one."""

SHOWING = 16
"""Values from which on a photograph shows itself."""

LAGGING = 1.3
"""Hardly any drawn picture is twice in turn explained this many times worse by plain words than by all words in trees as large."""

LEAST_DESCENT = 0.05
"""Fall of log(error) a value, over two leaves, of plain trees on the way to a drawn picture; photographs give less."""

MOST_DETOURS = 3
"""Leaves that are taken from a plain tree whose error stays where it was: its edges will not fall into place either."""

PHOTOGRAPHIC = 1.0e-3
"""A plain tree over this error is given up: the picture was not drawn with one."""


class DrawnSearch(Growth):
    """`run` yields better and better candidates and returns the best, or None where the picture was not drawn."""

    def __init__(self, samples: Samples, effort: Effort, families: tuple[str, ...] = PLAIN) -> None:
        super().__init__(samples, effort)
        self.families = families

    def run(self, curve: list[Candidate]) -> Generator[tuple[str, Candidate], None, Candidate | None]:
        """Beam search with only the words of the released grammar, which a drawn or sampled picture may be made of.

        ``curve`` is what all words reach. A photograph shows itself by the plain words falling behind; then None.
        """
        effort, pixels = self.effort, self.samples.coarse
        proposer = Proposer(self.samples.coarse_dictionary, pixels.target, pixels.weight)
        states = self._forms(proposer)
        best, stale = min(states, key=self._drawn), 0
        leaders: list[Candidate] = []
        while stale < 2:
            options = self._extended(states, proposer, self.families, effort.beam_moves, 4)
            states = [self._coarse(option.root, 8) for option in lineages(sorted(options, key=self._drawn), effort.beam)]
            if not states:
                break
            leader = min(states, key=self._drawn)
            best, stale = (leader, 0) if self._drawn(leader) < self._drawn(best) else (best, stale + 1)
            yield "plain", best
            leaders.append(leader)
            if leader.values >= SHOWING and self._is_photograph(leaders, best, curve):
                return None
        if best.error > UNLIKE:
            return None
        sharp = self.sharpen(best, PLAIN_LIMITS)
        if sharp.error > PHOTOGRAPHIC:
            return sharp
        for sharp in self._settling(sharp, thorough=False):
            yield "settle", sharp
        if sharp.error < DRAWN:
            return sharp
        points, dictionary = self.samples.points, self.samples.points_dictionary
        grown = self.fit(sharp.root, points, effort.growth_steps, limits=PLAIN_LIMITS)
        for grown in self.grow(grown, points, dictionary, FLOOR, self.families, PLAIN_LIMITS):
            yield "plain", grown
            if grown.values >= LARGEST_DRAWN:
                break
        if grown.values > sharp.values:
            sharp = self.sharpen(grown, PLAIN_LIMITS)
            for sharp in self._settling(sharp, thorough=True):
                yield "settle", sharp
        return sharp

    def _settling(self, sharp: Candidate, thorough: bool) -> Iterator[Candidate]:
        """Changes of one leaf, as long as they are better and not only make a tree that is not the picture's smaller."""
        detours = 0
        for step in range(self.effort.settle_steps):
            if sharp.error > (SETTLED if step < 5 else 0.15 * SETTLED):
                return
            better = self._settle(sharp, thorough)
            if better is None or better.error > max(DRAWN, 1.3 * sharp.error):
                return
            detours += better.error > max(DRAWN, 0.9 * sharp.error)
            sharp = better
            yield sharp
            if detours == MOST_DETOURS:
                return

    def _is_photograph(self, leaders: list[Candidate], best: Candidate, curve: list[Candidate]) -> bool:
        """Do the plain words fall behind all words, twice in turn or by far, or do they explain too little?"""

        def lag(leader: Candidate) -> float:
            return leader.error / min((rival.error for rival in curve if rival.values <= leader.values), default=math.inf)

        if len(leaders) > 1 and all(leader.values >= 12 and lag(leader) > LAGGING for leader in leaders[-2:]):
            return True
        if best.error <= UNLIKE:
            return False
        now = leaders[-1]
        return min(1.0, best.error / now.error) * lag(now) > (1.8 if now.values < 26 else 1.4) or _is_stuck(leaders)

    def prune(self, current: Candidate) -> Candidate:
        """Any tree that reproduces a drawn picture, without what is only there to mend a few pixels."""
        for _ in range(self.effort.settle_steps):
            base = soften(current.root, FINE_SOFTNESS)
            better = self._sharpest(current, [base, *removals(base), *swaps(base)], NO_LIMITS)
            if better is None or better.error > max(DRAWN, current.error):
                break
            current = better
        return current

    def _settle(self, current: Candidate, thorough: bool) -> Candidate | None:
        """A plain tree with one leaf less, of another kind or in another place, if that is better once its edges are hard."""
        points = self.samples.points
        base = soften(current.root, FINE_SOFTNESS)
        better = self._sharpest(current, [base, *removals(base), *swaps(base)])
        if better is not None or current.error < FLOOR or not thorough:
            return better
        proposer = Proposer(self.samples.points_dictionary, points.target, points.weight)
        smaller = []
        for root in [base, *removals(base)]:
            fitted = fit_pixels(points, root, steps=3, softest=FINE_SOFTNESS, limits=PLAIN_LIMITS)
            smaller.append(Candidate(fitted.root, fitted.error))
        moved = [root for candidate in sorted(smaller, key=settled)[:3] for root in swaps(candidate.root)]
        for candidate in smaller:
            model = Model(candidate.root, points)
            moved += [move.root for move in proposer.propose(model, model.layout.pack(candidate.root), self.families, 2)]
        return self._sharpest(current, moved)

    def _sharpest(self, current: Candidate, roots: list[Node], limits: Limits = PLAIN_LIMITS) -> Candidate | None:
        """The best of some trees by a short soft fit, then a sharp one of the most promising; None if none is better."""
        points = self.samples.points
        start = fit_pixels(points, soften(current.root, FINE_SOFTNESS), steps=4, softest=FINE_SOFTNESS, limits=limits).error
        options = []
        for root in roots:
            if count_values(root) <= self.effort.max_values:
                quick = fit_pixels(points, root, steps=4, softest=FINE_SOFTNESS, limits=limits)
                options.append(Candidate(quick.root, quick.error))
        options = sorted((option for option in options if option.error < 2.0 * start + 1e-5), key=settled)
        smaller = [option for option in options if option.values < current.values and option.error < 1.5 * start + 1e-5]
        options = smaller[:6] + [option for option in options if option not in smaller][:6]
        best, bar, worse = None, settled(current) - 2e-3, 0
        for option in options:
            fitted = sharpen(self.samples.fine, option.root, steps=12, limits=limits)
            found = Candidate(fitted.root, fitted.error)
            if settled(found) < bar:
                best, bar, worse = found, settled(found), 0
            elif best is not None and (worse := worse + 1) == 2:
                break
        return best

    def _drawn(self, candidate: Candidate) -> float:
        """How a plain tree is judged while it grows: a dearer price than `judge`'s keeps small trees in the beam."""
        return math.log(candidate.error + FLOOR) + 5.0 * self.effort.price * candidate.values

    def _coarse(self, root: Node, steps: int) -> Candidate:
        fitted = fit_pixels(self.samples.coarse, root, steps=steps, tolerance=1e-3, softest=COARSE_SOFTNESS, limits=PLAIN_LIMITS)
        candidate = Candidate(fitted.root, fitted.error)
        self.rough.add(candidate)
        return candidate

    def _forms(self, proposer: Proposer) -> list[Candidate]:
        """Where plain trees start: one colour, alone, under a shading or two, and with a rim."""
        found = layer = [self._coarse(self.start(), 2)]
        for _ in range(2):
            layer = self._extended(layer, proposer, ("plain_shades", "plain_rims"), 6, 8)
            layer = lineages(sorted(layer, key=lambda option: option.error), 3)
            found = found + layer
        return lineages(sorted(found, key=self._drawn), 2)

    def _extended(self, states: list[Candidate], proposer: Proposer, families: tuple[str, ...], most: int, steps: int) -> list[Candidate]:
        """Every state with one leaf more, by short fits; only forms that the released grammar has."""
        options, seen = [], Seen()
        for state in states:
            model = Model(state.root, self.samples.coarse)
            moves = proposer.propose(model, model.layout.pack(state.root), families, most)
            for root in [move.root for move in moves] + paints_as_shades(state.root):
                if count_values(root) <= min(self.effort.max_values, LARGEST_DRAWN) and is_released(root) and seen.is_new(root):
                    options.append(self._coarse(root, steps))
        return options


def looks_drawn(candidate: Candidate) -> bool:
    """Is a tree so near, or so near and with hard edges, that the picture was drawn?"""
    return candidate.error < (4.0 * DRAWN if has_edges(candidate.root) else DRAWN)


def has_edges(root: Node, softest: float = 0.0) -> bool:
    """Has any leaf an edge no softer than this?"""
    return any(isinstance(node, Leaf) and softness_of(node) <= softest for _, node in walk(root))


def settled(candidate: Candidate) -> float:
    """How a nearly right drawn tree is judged: a leaf that shows lowers this by 1 or more, one that mends a few pixels does not."""
    return math.log(max(candidate.error, 6.0e-6) + 3.0e-5) + 0.03 * candidate.values


def _is_stuck(leaders: list[Candidate]) -> bool:
    """Do the last two leaves explain too little? Every part of a drawn picture lowers its error by a good share."""
    if len(leaders) < 3:
        return False
    before, now = leaders[-3], leaders[-1]
    return math.log(before.error / max(now.error, FLOOR)) < LEAST_DESCENT * (now.values - before.values)
