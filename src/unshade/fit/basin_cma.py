"""BasinCMA, the paper's optimiser: CMA-ES over starts, each judged by the bottom of its basin.

A population of starts is drawn, a few gradient steps are taken from each, and the evolution strategy is told the
starts with the errors at the *ends*. Sources: Wampler and Popovic 2009; Huh et al. 2020; step counts of the code
that Geng et al. released.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
import torch

from unshade.fit.coordinates import Coordinates
from unshade.fit.fitted import Fitted
from unshade.fit.gradient import LEARNING_RATE, descend, fit_gradient
from unshade.fit.objective import FIT_SIZE, Objective, ObjectiveName
from unshade.nodes import Node
from unshade.types import Image, Mask

if TYPE_CHECKING:
    from cmaes import CMA

SPREAD = 0.25
"""First standard deviation of the starts, in units of a parameter's range."""

DIRECTION_REACH = 1.5
"""Starts of a direction's three numbers stay within this before they are normalised."""


def fit_basin_cma(
    target: Image,
    mask: Mask,
    root: Node,
    *,
    seed: int,
    locked: Collection[str] = frozenset(),
    objective: ObjectiveName = "paper",
    size: int = FIT_SIZE,
    meta_steps: int = 30,
    gradient_steps: int = 30,
    final_steps: int = 300,
    population: int | None = None,
    finalists: int = 4,
    learning_rate: float = LEARNING_RATE,
) -> Fitted:
    """Fit the numbers of a structure by BasinCMA around the tree as it is.

    Args:
        target: (3, S, S) in [0, 1]. mask: (1, S, S), the pixels that count.
        locked: addresses, names or ``address.parameter`` whose numbers stay as they are.
        meta_steps: generations of CMA-ES. gradient_steps: Adam steps from each start.
        final_steps: Adam steps from the ``finalists`` best ends, and from the tree as it is.
        population: starts a generation; ``4 + 3 ln D`` where left out.
    Raises:
        AddressError: a locked address fits nothing. MissingExtraError: no weights for the objective ``paper``.
    """
    if min(meta_steps, gradient_steps, final_steps) < 0 or finalists < 1 or (population is not None and population < 2):
        raise ValueError("fit_basin_cma: needs step counts >= 0, finalists >= 1 and a population >= 2")
    compared = Objective(target, mask, objective, size=size)
    coordinates = Coordinates.of(root, locked)
    if not coordinates.size:
        return fit_gradient(target, mask, root, seed=seed, locked=locked, objective=objective, size=size, steps=0, restarts=1)
    own = coordinates.encode(coordinates.own)
    kept, kept_errors = own[None].to(target), torch.full((1,), torch.inf, device=target.device, dtype=target.dtype)
    strategy = _strategy(own.numpy(), coordinates.directions.numpy(), seed, population)
    history: list[float] = []
    for _ in range(meta_steps):
        starts = np.stack([strategy.ask() for _ in range(strategy.population_size)])
        ends, errors, best = descend(compared, coordinates, torch.from_numpy(starts).to(target), gradient_steps, learning_rate)
        strategy.tell(list(zip(starts, errors.double().tolist(), strict=True)))
        history += best
        everything, all_errors = torch.cat([kept, ends]), torch.cat([kept_errors, errors])
        order = all_errors.argsort(stable=True)[:finalists]
        kept, kept_errors = everything[order], all_errors[order]
    if meta_steps:
        kept = torch.cat([kept, own[None].to(target)])
    points, errors, best = descend(compared, coordinates, kept, final_steps, learning_rate)
    winner = int(errors.argmin())
    falling = np.minimum.accumulate(np.array(history + best))
    return Fitted(coordinates.tree(points[winner]), float(errors[winner]), tuple(falling.tolist()))


def _strategy(mean: np.ndarray, directions: np.ndarray, seed: int, population: int | None) -> CMA:
    from cmaes import CMA  # here, because it loads all of scipy.stats where scipy is installed

    reach = np.where(directions, DIRECTION_REACH, 1.0)
    bounds = np.stack([np.where(directions, -reach, 0.0), reach], axis=1)
    # One draw, then clipped: with tens of coordinates nearly every draw leaves the box somewhere, and drawing again costs time for nothing.
    return CMA(
        mean=np.clip(mean, bounds[:, 0], bounds[:, 1]),
        sigma=SPREAD,
        bounds=bounds,
        n_max_resampling=1,
        seed=seed % 2**32,
        population_size=population,
    )
