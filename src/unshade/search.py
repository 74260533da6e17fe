"""Search over structures by size: grow a tree leaf by leaf where it pays most, then prune, swap and polish.

One picture, three sets of its pixels: coarse averages, on which trees grow fast and textures do not mislead; points of the
full picture, on which edges are exact; and more points, on which the result is polished. Work is counted in steps, never
in seconds, so that a result depends on nothing but the picture, the preset and the seed.

A tree is judged by ``log(error + floor) + price * values``: every stored value has to lower the error by a share, and an
error below what 8-bit pictures can show is not worth lowering.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field

import torch

from unshade.atoms import Dictionary
from unshade.fit.fitted import Fitted
from unshade.fit.least_squares import COARSE_SOFTNESS, FINE_SOFTNESS, fit_pixels, sharpen
from unshade.fit.model import NO_LIMITS, Limits, Model, soften
from unshade.fit.pixels import Pixels
from unshade.moves import Move, Proposer, removals, swaps
from unshade.nodes import Leaf, Node, count_values, leaf

PLAIN = ("plain_lights", "plain_masks", "plain_shades", "plain_spots", "plain_rims")
"""The families of the released grammar: all lights grey, edges drawn."""
PLAIN_LIMITS: Limits = {"softness": (0.0, 0.15), "sharpness": (20.0, 150.0), "exponent": (0.7, 1.5), "radius": (0.0, 0.8)}
"""Its ranges, a little wider, so that a fit does not turn a spot into something else."""

DRAWN = 1.0e-5
"""A plain tree with a mean squared error under this one is the answer: the picture was drawn with such a tree."""

LARGEST_DRAWN = 56
"""Values of the largest tree of the released grammar, and one detour more."""

SETTLED = 5.0e-4
"""Only a plain tree under this error is worth settling leaf by leaf."""

PHOTOGRAPHIC = 1.0e-3
"""A plain tree over this error is given up: the picture was not drawn with one."""

FLOOR = 5.0e-6
"""Mean squared error that is not worth lowering: rounding to 8 bits alone makes 1.3e-6."""


@dataclass(frozen=True)
class Effort:
    """How much work a search does, in steps."""

    max_values: int
    price: float = 0.006
    """Least decrease of log(error) that a stored value must bring."""
    beam: int = 5
    beam_moves: int = 6
    trials: int = 4
    """Moves that are tried by a short fit at each growth."""
    trial_steps: int = 5
    growth_steps: int = 12
    rounds: int = 0
    """Times that the least useful leaf is taken out and the tree grown again."""
    sweeps: int = 1
    """Times that all leaves are offered other kinds."""
    sweep_steps: int = 2
    """Most changes a sweep makes."""
    settle_steps: int = 14
    """Most changes that a plain tree is offered one by one."""
    polish_steps: int = 25


@dataclass(frozen=True)
class Candidate:
    """A tree on the way, with its mean squared error on the polishing points (or the set it was grown on)."""

    root: Node
    error: float

    @property
    def values(self) -> int:
        """Stored values."""
        return count_values(self.root)


@dataclass
class Front:
    """The best tree of each size so far."""

    best: dict[int, Candidate] = field(default_factory=dict)

    def add(self, candidate: Candidate) -> None:
        """Keep it if no tree of its size is better."""
        held = self.best.get(candidate.values)
        if held is None or candidate.error < held.error:
            self.best[candidate.values] = candidate

    def members(self) -> list[Candidate]:
        """Smallest first, each better than all that are smaller."""
        chosen: list[Candidate] = []
        for values in sorted(self.best):
            if not chosen or self.best[values].error < 0.98 * chosen[-1].error:
                chosen.append(self.best[values])
        return chosen


@dataclass(frozen=True)
class Samples:
    """The pixel sets of one picture with their dictionaries."""

    coarse: Pixels
    points: Pixels
    fine: Pixels
    coarse_dictionary: Dictionary
    points_dictionary: Dictionary


class Search:
    """One search. `run` yields better and better candidates; `front` holds the curve."""

    def __init__(
        self,
        samples: Samples,
        effort: Effort,
        families: tuple[str, ...] = ("lights", "rims", "masks", "shades", "spots", "environments"),
        skip: int = 0,
    ) -> None:
        self.samples, self.effort, self.families, self.skip = samples, effort, families, skip
        self.front = Front()
        """Trees that were fitted to points of the full picture."""
        self.rough = Front()
        """Trees that were fitted to the coarse averages only."""

    def family(self, most: int) -> list[Candidate]:
        """The curve of error over values: at most ``most`` trees of all sizes that the search came by, polished."""
        known = {candidate.values: candidate for candidate in (*self.rough.members(), *self.front.members())}
        sizes = sorted(known)
        if len(sizes) > most:
            sizes = sorted({sizes[round(k * (len(sizes) - 1) / (most - 1))] for k in range(most)})
        with torch.no_grad():
            return [self._fit(known[values].root, self.samples.points, self.effort.growth_steps) for values in sizes]

    def judge(self, error: float, values: int) -> float:
        """Lower is better."""
        return math.log(error + FLOOR) + self.effort.price * values

    def run(self) -> Iterator[tuple[str, Candidate]]:
        """(stage, candidate) as they come; the last one is the result."""
        with torch.no_grad():
            current = Candidate(self._start(), math.inf)
            for current in self._grow(current, self.samples.coarse, self.samples.coarse_dictionary, stop=1e-4):
                yield "grow", current
            plain: Candidate | None = None
            if self.effort.beam and not self.skip:
                plain = yield from self._plain(self.rough.members())
                if plain is not None and plain.error < DRAWN:
                    yield "polish", plain
                    return
            current = self._fit(current.root, self.samples.points, self.effort.growth_steps)
            for current in self._grow(current, self.samples.points, self.samples.points_dictionary, stop=FLOOR):
                yield "grow", current
            for _ in range(self.effort.sweeps):
                current = self._sweep(current, self.samples.points)
                yield "swap", current
            for number in range(self.effort.rounds):
                better = self._exchange(current, number)
                if self.judge(better.error, better.values) < self.judge(current.error, current.values):
                    current = better
                    yield "exchange", current
            current = self._sharpen(current)
            if plain and self.judge(plain.error, plain.values) < self.judge(current.error, current.values):
                current = plain
            yield "polish", current

    def _plain(self, curve: list[Candidate]) -> Generator[tuple[str, Candidate], None, Candidate | None]:
        """Beam search with only the words of the released grammar, which a drawn or sampled picture may be made of.

        ``curve`` is what all words reach. A photograph shows itself by the plain words falling behind; then None.
        """
        effort, pixels = self.effort, self.samples.coarse
        proposer = Proposer(self.samples.coarse_dictionary, pixels.target, pixels.weight)
        states = self._forms(proposer)
        best, stale = min(states, key=self._drawn), 0
        while stale < 2:
            options: list[Candidate] = []
            for state in states:
                model = Model(state.root, pixels)
                moves = proposer.propose(model, model.layout.pack(state.root), PLAIN, effort.beam_moves)
                options += [
                    self._coarse(move.root, 4) for move in moves if move.cost <= min(effort.max_values, LARGEST_DRAWN) - state.values
                ]
            states = [self._coarse(option.root, 8) for option in distinct(sorted(options, key=self._drawn), effort.beam, each=2)]
            if not states:
                break
            leader = min(states, key=self._drawn)
            best, stale = (leader, 0) if self._drawn(leader) < self._drawn(best) else (best, stale + 1)
            yield "plain", best
            rivals = [candidate.error for candidate in curve if candidate.values <= leader.values]
            behind = min(leader.error, best.error) / min(rivals, default=math.inf)
            if best.error > 2.5e-4 and behind > (3.0 if leader.values < 26 else 1.2) and leader.values >= 16:
                return None
        sharp = self._sharpen(best, PLAIN_LIMITS)
        if sharp.error > PHOTOGRAPHIC:
            return sharp
        points, dictionary = self.samples.points, self.samples.points_dictionary
        for grown in self._grow(
            self._fit(sharp.root, points, effort.growth_steps, limits=PLAIN_LIMITS), points, dictionary, FLOOR, PLAIN, PLAIN_LIMITS
        ):
            sharp = grown
            yield "plain", sharp
            if sharp.values >= LARGEST_DRAWN:
                break
        sharp = self._sharpen(sharp, PLAIN_LIMITS)
        for step in range(effort.settle_steps):
            if sharp.error > (SETTLED if step < 5 else 0.15 * SETTLED):
                break
            better = self._settle(sharp)
            if better is None:
                break
            sharp = better
            yield "settle", sharp
        return sharp

    def _settle(self, current: Candidate) -> Candidate | None:
        """A plain tree with one leaf less, of another kind or in another place, if that is better once its edges are hard."""
        points = self.samples.points
        base = soften(current.root, FINE_SOFTNESS)
        better = self._sharpest(current, [base, *removals(base), *swaps(base)])
        if better is not None or current.error < FLOOR:
            return better
        proposer = Proposer(self.samples.points_dictionary, points.target, points.weight)
        moved = []
        for smaller in [base, *removals(base)]:
            fitted = fit_pixels(points, smaller, steps=3, softest=FINE_SOFTNESS, limits=PLAIN_LIMITS).root
            model = Model(fitted, points)
            moved += [move.root for move in proposer.propose(model, model.layout.pack(fitted), PLAIN, 2)]
        return self._sharpest(current, moved)

    def _sharpest(self, current: Candidate, roots: list[Node]) -> Candidate | None:
        """The best of some trees by a short soft fit, then a sharp one of the most promising; None if none is better."""
        points = self.samples.points
        start = fit_pixels(points, soften(current.root, FINE_SOFTNESS), steps=4, softest=FINE_SOFTNESS, limits=PLAIN_LIMITS).error
        options = []
        for root in roots:
            if count_values(root) <= self.effort.max_values:
                quick = fit_pixels(points, root, steps=4, softest=FINE_SOFTNESS, limits=PLAIN_LIMITS)
                options.append(Candidate(quick.root, quick.error))
        options.sort(key=settled)
        smaller = [option for option in options if option.values < current.values and option.error < 1.5 * start + 1e-5]
        options = smaller[:6] + [option for option in options if option not in smaller][:6]
        best, bar = None, settled(current) - 2e-3
        for option in options:
            fitted = sharpen(self.samples.fine, option.root, steps=12, limits=PLAIN_LIMITS)
            found = Candidate(fitted.root, fitted.error)
            if settled(found) < bar:
                best, bar = found, settled(found)
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
        """Where plain trees start: one colour, alone and under one or two shadings or rims."""
        flat = self._coarse(self._start(), 2)
        found = layer = [flat]
        for _ in range(2):
            options: list[Candidate] = []
            for state in layer:
                model = Model(state.root, self.samples.coarse)
                moves = proposer.propose(model, model.layout.pack(state.root), ("plain_shades", "plain_rims"), 6)
                options += [self._coarse(move.root, 8) for move in moves]
            layer = distinct(sorted(options, key=lambda option: option.error), 6, each=3)
            found = found + layer
        return distinct(sorted(found, key=self._drawn), 8)

    def _sharpen(self, current: Candidate, limits: Limits = NO_LIMITS) -> Candidate:
        """Fit on the fine points, edges about a pixel wide, then hard where that is better."""
        fitted = sharpen(self.samples.fine, current.root, steps=self.effort.polish_steps, limits=limits)
        return Candidate(fitted.root, fitted.error)

    def _start(self) -> Node:
        pixels = self.samples.coarse
        mean = (pixels.target * pixels.weight).sum(1).clamp(0.0, 1.0)
        return leaf("albedo", color=mean.tolist())

    def _fit(self, root: Node, pixels: Pixels, steps: int, tolerance: float = 1e-3, limits: Limits = NO_LIMITS) -> Candidate:
        fitted: Fitted = fit_pixels(
            pixels,
            root,
            steps=steps,
            tolerance=tolerance,
            softest=FINE_SOFTNESS if pixels is not self.samples.coarse else COARSE_SOFTNESS,
            limits=limits,
        )
        candidate = Candidate(fitted.root, fitted.error)
        (self.rough if pixels is self.samples.coarse else self.front).add(candidate)
        return candidate

    def _grow(
        self,
        current: Candidate,
        pixels: Pixels,
        dictionary: Dictionary,
        stop: float,
        families: tuple[str, ...] | None = None,
        limits: Limits = NO_LIMITS,
    ) -> Iterator[Candidate]:
        """Add the leaf that pays most, again and again."""
        proposer = Proposer(dictionary, pixels.target, pixels.weight)
        effort = self.effort
        while True:
            model = Model(current.root, pixels)
            moves = proposer.propose(model, model.layout.pack(current.root), families or self.families, 24)
            room = effort.max_values - count_values(current.root)
            moves = [move for move in moves if move.cost <= room and move.relative > 0.0]
            if proposer.error <= stop or not moves:
                return
            if self.skip:
                moves = moves[self.skip :] or moves
                self.skip = 0
            grown = self._try(moves, pixels, proposer.error, limits)
            if grown is None:
                return
            current = grown
            yield current

    def _try(self, moves: list[Move], pixels: Pixels, error: float, limits: Limits) -> Candidate | None:
        """Short fits of the most promising moves; a full one of the best, if it pays."""
        for first in range(0, len(moves), self.effort.trials):
            best = (0.0, moves[0].root)
            for move in moves[first : first + self.effort.trials]:
                fitted = fit_pixels(pixels, move.root, steps=self.effort.trial_steps, softest=FINE_SOFTNESS, limits=limits)
                pays = math.log((error + FLOOR) / (fitted.error + FLOOR)) / max(move.cost, 1)
                best = max(best, (pays, fitted.root), key=lambda option: option[0])
            if best[0] >= self.effort.price:
                return self._fit(best[1], pixels, self.effort.growth_steps, limits=limits)
        return None

    def _sweep(self, current: Candidate, pixels: Pixels) -> Candidate:
        """Offer every leaf another kind, or none at all, until nothing pays."""
        current = self._fit(current.root, pixels, self.effort.growth_steps)
        for _ in range(self.effort.sweep_steps):
            score = self.judge(current.error, current.values)
            options = []
            for root in removals(current.root) + swaps(current.root):
                if count_values(root) <= min(current.values + 2, self.effort.max_values):
                    quick = fit_pixels(pixels, root, steps=4, softest=FINE_SOFTNESS)
                    options.append(Candidate(quick.root, quick.error))
            options.sort(key=lambda option: self.judge(option.error, option.values))
            tried = [self._fit(option.root, pixels, self.effort.growth_steps) for option in options[:3]]
            best = min(tried, key=lambda option: self.judge(option.error, option.values), default=current)
            if self.judge(best.error, best.values) > score - 1e-4:
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
        smaller = self._fit(options[min(number, len(options) - 1)][1], pixels, self.effort.growth_steps)
        *_, regrown = [smaller, *self._grow(smaller, pixels, self.samples.points_dictionary, FLOOR)]
        return regrown


def settled(candidate: Candidate) -> float:
    """How a nearly right drawn tree is judged: a leaf that shows lowers this by 1 or more, one that mends a few pixels does not."""
    return math.log(candidate.error + 3.0e-5) + 0.03 * candidate.values


def distinct(candidates: list[Candidate], most: int, each: int = 1) -> list[Candidate]:
    """The first candidates, at most ``each`` of one structure."""
    seen: dict[str, int] = {}
    chosen = []
    for candidate in candidates:
        key = outline(candidate.root)
        seen[key] = seen.get(key, 0) + 1
        if seen[key] <= each:
            chosen.append(candidate)
    return chosen[:most]


def outline(root: Node) -> str:
    """The structure of a tree as text, numbers left out."""
    if isinstance(root, Leaf):
        return root.kind
    below = ",".join(outline(child) for child in root.children)
    return f"{root.kind}({below}{'|' + root.mask.kind if root.mask else ''})"
