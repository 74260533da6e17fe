"""What every search over structures stands on: candidates, the curve of the best of each size, and growth by one leaf.

One picture, three sets of its pixels: coarse averages, on which trees grow fast and textures do not mislead; points of the
full picture, on which edges are exact; and more points, on which the result is polished. Work is counted in steps, never
in seconds, so that a result depends on nothing but the picture, the preset and the seed.

A tree is judged by ``log(error + floor) + price * values``: every stored value has to lower the error by a share, and an
error below what 8-bit pictures can show is not worth lowering.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TypeVar

from unshade import crew
from unshade.atoms import Dictionary
from unshade.fit.least_squares import COARSE_SOFTNESS, FINE_SOFTNESS, fit_pixels, sharpen
from unshade.fit.model import Model
from unshade.fit.pixels import Pixels
from unshade.fit.plan import NO_LIMITS, Limits
from unshade.moves import Move, Proposer
from unshade.nodes import Leaf, Node, count_values, leaf
from unshade.threads import threads

Answer = TypeVar("Answer")

FLOOR = 5.0e-6
"""Mean squared error that is not worth lowering: rounding to 8 bits alone makes 1.3e-6."""


@dataclass(frozen=True)
class Effort:
    """How much work a search does, in steps."""

    max_values: int
    price: float = 0.006
    """Least decrease of log(error) that a stored value must bring."""
    beam: int = 1
    """Plain trees of every form that are kept while they grow; 0 leaves the plain search out."""
    beam_moves: int = 4
    """Ways in which each of them may grow on."""
    trials: int = 4
    """Moves that are tried by a short fit at each growth."""
    trial_steps: int = 4
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
    late: bool = False
    """Also grow rims and environments, which pay only in large trees."""


@dataclass(frozen=True)
class Candidate:
    """A tree on the way, with its mean squared error on the polishing points (or the set it was grown on)."""

    root: Node
    error: float

    @cached_property
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

    def update(self, other: Front) -> None:
        """Add all of another front."""
        for candidate in other.best.values():
            self.add(candidate)

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
    is_clean: bool = False
    """Is the picture as smooth as rounding to 8 bits leaves a rendering? Then it may be a tree's, to the last digit."""


class Growth:
    """Trees for one picture, growing leaf by leaf; `front` and `rough` hold the curve."""

    def __init__(self, samples: Samples, effort: Effort) -> None:
        self.samples, self.effort = samples, effort
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
        return [self.fit(known[values].root, self.samples.points, self.effort.growth_steps) for values in sizes]

    def judge(self, error: float, values: int) -> float:
        """Lower is better."""
        return math.log(error + FLOOR) + self.effort.price * values

    def judged(self, candidate: Candidate) -> float:
        """`judge` of a candidate."""
        return self.judge(candidate.error, candidate.values)

    def start(self) -> Node:
        """The mean colour."""
        pixels = self.samples.coarse
        mean = (pixels.target * pixels.weight).sum(1).clamp(0.0, 1.0)
        return leaf("albedo", color=mean.tolist())

    def fit(self, root: Node, pixels: Pixels, steps: int, tolerance: float = 1e-3, limits: Limits = NO_LIMITS) -> Candidate:
        """Fit the numbers of a tree and note it on the curve."""
        fitted = fit_pixels(
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

    def sharpen(self, current: Candidate, limits: Limits = NO_LIMITS) -> Candidate:
        """Fit on the fine points, edges about a pixel wide, then hard where that is better."""
        fitted = sharpen(self.samples.fine, current.root, steps=self.effort.polish_steps, limits=limits)
        return Candidate(fitted.root, fitted.error)

    def side_by_side(self, jobs: Sequence[Callable[[], Answer]], workers: int) -> Iterator[Answer]:
        """The answers of pieces of this growth, in order (`crew.side_by_side`); what they note on the curve is noted here."""

        def noted(job: Callable[[], Answer]) -> tuple[Answer, Front, Front]:
            with threads(1):
                return job(), self.front, self.rough

        with closing(crew.side_by_side([partial(noted, job) for job in jobs], workers)) as answers:
            for answer, front, rough in answers:
                self.front.update(front)
                self.rough.update(rough)
                yield answer

    def grow(
        self,
        current: Candidate,
        pixels: Pixels,
        dictionary: Dictionary,
        stop: float,
        families: tuple[str, ...],
        limits: Limits = NO_LIMITS,
    ) -> Iterator[Candidate]:
        """Add the leaf that pays most, again and again."""
        proposer = Proposer(dictionary, pixels.target, pixels.weight)
        effort = self.effort
        while True:
            model = Model(current.root, pixels)
            moves = proposer.propose(model, model.layout.pack(current.root), families, 24)
            room = effort.max_values - count_values(current.root)
            moves = [move for move in moves if move.cost <= room and move.relative > 0.0]
            if proposer.error <= stop or not moves:
                return
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
                return self.fit(best[1], pixels, self.effort.growth_steps, limits=limits)
        return None


def outline(root: Node) -> str:
    """The structure of a tree as text, numbers left out."""
    if isinstance(root, Leaf):
        return root.kind
    below = ",".join(outline(child) for child in root.children)
    return f"{root.kind}({below}{'|' + root.mask.kind if root.mask else ''})"
