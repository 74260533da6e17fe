"""The second pass of the search for drawn pictures: the words of the released grammar with its environments.

An environment of broad lights explains a little of everything, so that a beam which has its word from the start loses
toon trees. It comes second, only for pictures as clean as renderings, and gives up as soon as the trees with one do not
lead: a tree with the right environment is hardly ever behind the best of all words, one of a photograph soon is.
"""

from __future__ import annotations

import dataclasses
import math

from unshade.growth import Candidate, Effort, Samples
from unshade.search_drawn import LAGGING, PLAIN, PLAIN_LIMITS, ROUNDING, DrawnSearch, has_edges

REFLECTING = (*PLAIN, "plain_environments")
"""All families of the released grammar."""

NEARLY = 8.0e-5
"""A tree without edges under this error may lack an environment only."""

LEVEL = 1.05
"""Where there are no edges to place, trees with the right environment are hardly ever this many times worse than others as large."""

LEADING = 40
"""Values by which the edges of a drawn picture are in place; from here on trees with the right environment leave all others behind."""

WIDTH = 2
"""Trees of every form that are kept, at least, where there are edges: an environment is seen late, after all that is on top of it."""

MOVES = 5
"""Ways in which each may grow on, at least."""


class ReflectingSearch(DrawnSearch):
    """`run` as in the first pass. ``is_edged``: has the picture edges?"""

    def __init__(self, samples: Samples, effort: Effort, is_edged: bool) -> None:
        if is_edged:
            effort = dataclasses.replace(effort, beam=max(WIDTH, effort.beam), beam_moves=max(MOVES, effort.beam_moves))
        super().__init__(samples, effort, REFLECTING)
        self.is_edged = is_edged

    def _is_photograph(self, leaders: list[Candidate], best: Candidate, curve: list[Candidate]) -> bool:
        lag = best.error / min((rival.error for rival in curve if rival.values <= best.values), default=math.inf)
        if self.is_edged and leaders[-1].values < LEADING:
            return False
        return lag > (LAGGING if self.is_edged else LEVEL) - 0.05 * max(0, best.values - LEADING)


def is_edged(*candidates: Candidate | None) -> bool:
    """Has any of some trees an edge as narrow as those of the released grammar?"""
    narrow = PLAIN_LIMITS["softness"][1]
    return any(candidate is not None and has_edges(candidate.root, narrow) for candidate in candidates)


def may_reflect(candidate: Candidate, plain: Candidate | None) -> bool:
    """Is a tree of a clean picture so near, or has it or the best plain tree edges, that an environment may be all it lacks?"""
    return candidate.error > ROUNDING and (candidate.error < NEARLY or is_edged(candidate, plain))
