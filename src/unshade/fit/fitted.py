"""What every fitter returns."""

from __future__ import annotations

from dataclasses import dataclass

from unshade.nodes import Node


@dataclass(frozen=True, slots=True)
class Fitted:
    """A tree with fitted parameters.

    ``error`` is the fitter's own objective at the end (for least squares the mean squared error over the pixels that
    count), ``history`` the objective after each step.
    """

    root: Node
    error: float
    history: tuple[float, ...] = ()
