"""First order: Adam in bounded coordinates, all restarts in one batch.

The baseline of the benchmark, the inner loop of BasinCMA, and the paper's last step (the whole tree at once).
"""

from __future__ import annotations

import math
from collections.abc import Collection

import torch

from unshade.fit.coordinates import Coordinates
from unshade.fit.fitted import Fitted
from unshade.fit.objective import FIT_SIZE, Objective, ObjectiveName
from unshade.nodes import Node
from unshade.render import render
from unshade.types import Image, Mask

LEARNING_RATE = 0.03
"""In units of a parameter's range; falls to a fiftieth along a cosine."""


def descend(
    objective: Objective, coordinates: Coordinates, starts: torch.Tensor, steps: int, learning_rate: float = LEARNING_RATE
) -> tuple[torch.Tensor, torch.Tensor, list[float]]:
    """Adam from every start at once; the rows do not influence one another.

    Args:
        starts: (B, D) points.
    Returns:
        the best point of each row (B, D), its error (B,), and the best error of all after each step.
    """
    points = coordinates.constrain(starts.detach()).requires_grad_()
    adam = torch.optim.Adam([points], lr=learning_rate)
    best, errors = points.detach().clone(), torch.full(points.shape[:1], torch.inf, device=points.device, dtype=points.dtype)
    history: list[float] = []
    for step in range(steps + 1):
        with torch.set_grad_enabled(step < steps):
            losses = objective(render(coordinates.root, objective.normals, coordinates.decode(points)))
        better = losses.detach() < errors
        best = torch.where(better[:, None], points.detach(), best)
        errors = torch.where(better, losses.detach(), errors)
        history.append(float(errors.min()))
        if step == steps:
            break
        adam.param_groups[0]["lr"] = learning_rate * (0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * step / steps)))
        (points.grad,) = torch.autograd.grad(losses.sum(), points)
        adam.step()
        with torch.no_grad():
            points.copy_(coordinates.constrain(points))
    return best, errors, history


def starts_of(coordinates: Coordinates, target: Image, count: int, generator: torch.Generator) -> torch.Tensor:
    """(count, D) on the target's device: the tree's own numbers first, then random ones."""
    own = coordinates.encode(coordinates.own)[None]
    return torch.cat([own, coordinates.random(generator, count - 1)]).to(target)


def fit_gradient(
    target: Image,
    mask: Mask,
    root: Node,
    *,
    seed: int,
    locked: Collection[str] = frozenset(),
    objective: ObjectiveName = "l2",
    size: int = FIT_SIZE,
    steps: int = 300,
    restarts: int = 8,
    learning_rate: float = LEARNING_RATE,
) -> Fitted:
    """Fit the numbers of a structure by Adam from several starts, of which the first is the tree as it is.

    Args:
        target: (3, S, S) in [0, 1]. mask: (1, S, S), the pixels that count.
        locked: addresses, names or ``address.parameter`` whose numbers stay as they are.
        size: the picture is compared at this size.
    Raises:
        AddressError: a locked address fits nothing. MissingExtraError: no weights for the objective ``paper``.
    """
    if steps < 0 or restarts < 1:
        raise ValueError(f"fit_gradient: needs steps >= 0 and restarts >= 1, got {steps} and {restarts}")
    compared = Objective(target, mask, objective, size=size)
    coordinates = Coordinates.of(root, locked)
    generator = torch.Generator().manual_seed(seed)
    if not coordinates.size:
        steps, restarts = 0, 1
    points, errors, history = descend(compared, coordinates, starts_of(coordinates, target, restarts, generator), steps, learning_rate)
    winner = int(errors.argmin())
    return Fitted(coordinates.tree(points[winner]), float(errors[winner]), tuple(history))
