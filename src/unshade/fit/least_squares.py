"""Second-order fitting of a given structure: Levenberg-Marquardt on the pixels of one picture.

The normal equations are small and dense (20 to 200 numbers). Numbers at their bounds are held there while the gradient
pushes outwards. Edges have no slope where they are hard, so they are fitted about a pixel wide and made hard afterwards
where that is better.
"""

from __future__ import annotations

from collections.abc import Collection

import torch

from unshade.fit.fitted import Fitted
from unshade.fit.model import Model, soften
from unshade.fit.pixels import Pixels
from unshade.fit.plan import EDGE, NO_LIMITS, Limits, is_hard, is_locked, softness_of
from unshade.nodes import KINDS, Leaf, Node, replace, walk
from unshade.types import Image, Mask

COARSE_SIZE = 40
"""Pictures are averaged down to this many pixels a side where edges do not matter yet."""

COARSE_SOFTNESS = 0.04
FINE_SOFTNESS = 0.012
"""Narrowest edges while fitting, about 1.5 pixels of a picture of 256: a narrower one has no slope that a pixel could see."""


def minimise(
    model: Model, vector: torch.Tensor, steps: int, tolerance: float = 1e-4, damping: float = 1e-2
) -> tuple[torch.Tensor, float, list[float]]:
    """Levenberg-Marquardt with Marquardt's scaling and bounds.

    Args:
        vector: (P,) float64 start. steps: most evaluations. tolerance: smallest relative decrease worth another step.
    Returns:
        The vector, its mean squared error, and the error after each accepted step.
    """
    root_weight = model.pixels.weight.sqrt()
    target = model.pixels.target

    def residual(values: list[torch.Tensor]) -> torch.Tensor:
        return (model.compose(values) - target) * root_weight

    values = model.evaluate(vector)
    error_image = residual(values)
    error = float(error_image.double().square().sum()) / 3.0
    history = [error]
    if model.free == 0:
        return vector, error, history
    fresh, slow = True, 0
    for _ in range(steps):
        if fresh:
            jacobian = model.jacobian(vector, values, root_weight)
            flat = jacobian.view(model.free, -1)
            scale = model.scale(vector)
            hessian = (flat @ flat.T).double() * scale[:, None] * scale
            gradient = (flat @ error_image.reshape(-1)).double() * scale
            diagonal = hessian.diagonal().clamp(min=1e-9)
            dead = model.held(vector, gradient) | (hessian.diagonal() < 1e-14)
            alive = (~dead).double()
            hessian *= alive[:, None] * alive
            gradient *= alive
        damped = hessian + torch.diag(diagonal * damping + 1e-10)
        factor, info = torch.linalg.cholesky_ex(damped)
        if int(info) != 0:
            damping = max(damping * 10.0, 1e-6)
            fresh = False
            continue
        step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
        candidate = model.move(vector, step)
        candidate_values = model.evaluate(candidate)
        candidate_image = residual(candidate_values)
        candidate_error = float(candidate_image.double().square().sum()) / 3.0
        fresh = candidate_error < error
        if fresh:
            decrease = (error - candidate_error) / max(error, 1e-30)
            vector, values, error_image, error = candidate, candidate_values, candidate_image, candidate_error
            history.append(error)
            damping = max(damping * 0.2, 1e-8)
            slow = slow + 1 if decrease < tolerance else 0
            if slow >= 2 or error < 1e-12:
                break
        else:
            damping *= 6.0
            if damping > 1e7:
                break
    return vector, error, history


def fit_pixels(
    pixels: Pixels,
    root: Node,
    *,
    locked: Collection[str] = (),
    steps: int = 30,
    tolerance: float = 1e-4,
    softest: float = 0.0,
    limits: Limits = NO_LIMITS,
) -> Fitted:
    """Fit the parameters of a structure at given pixels, from the tree's own numbers."""
    with torch.no_grad():
        model = Model(root, pixels, locked, softest, limits)
        vector, error, history = minimise(model, model.start(), steps, tolerance)
        return Fitted(model.layout.unpack(root, vector), error, tuple(history))


def sharpen(pixels: Pixels, root: Node, *, locked: Collection[str] = (), steps: int = 30, limits: Limits = NO_LIMITS) -> Fitted:
    """Fit with edges about a pixel wide, then make hard every edge that is better hard."""
    fitted = fit_pixels(pixels, soften(root, FINE_SOFTNESS, locked), locked=locked, steps=steps, softest=FINE_SOFTNESS, limits=limits)
    root, error = fitted.root, fitted.error
    for address, node in walk(fitted.root):
        if isinstance(node, Leaf) and softness_of(node) < 2.0 * FINE_SOFTNESS and not is_locked(address, "softness", locked):
            hard = replace(root, address, node.set(softness=0.0))
            hard_error = error_of(pixels, hard)
            if hard_error < error:
                root, error = hard, hard_error
    if root is not fitted.root:
        root = place_edges(pixels, root, locked)
        again = fit_pixels(pixels, root, locked=locked, steps=steps // 2, limits=limits)
        root, error = again.root, again.error
    return Fitted(root, error, fitted.history)


def place_edges(pixels: Pixels, root: Node, locked: Collection[str] = (), rounds: int = 6, tries: int = 64) -> Node:
    """Move hard edges by fractions of a pixel where that is better, by seeded random search, one edge at a time.

    The error of a hard edge is a staircase that no gradient descends; but the picture is affine in the leaf, so a whole
    batch of tries costs one small render each.
    """
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for address, node in walk(root):
            if not isinstance(node, Leaf) or not is_hard(node):
                continue
            model = Model(root, pixels)
            values = model.evaluate(model.layout.pack(root))
            value, gain = next((value, gain) for where, _, value, gain in model.nodes(values) if where == address)
            rest = model.compose(values) - gain * value - pixels.target
            kind = KINDS[node.kind]
            held = [torch.tensor(number, dtype=torch.float64) for number in node.values]
            best = float(((rest + gain * value).square() * pixels.weight).sum())
            for number in range(rounds):
                size = 0.004 * 0.5**number
                tried = [
                    stored + size * torch.randn(tries, len(stored), generator=generator, dtype=torch.float64)
                    if parameter.name in EDGE and parameter.name != "softness" and not is_locked(address, parameter.name, locked)
                    else stored.expand(tries, -1)
                    for parameter, stored in zip(kind.parameters, held, strict=True)
                ]
                shaded = kind.formula(model.normals, *(argument.to(pixels.normals.dtype) for argument in tried))[:, 0]
                errors = ((rest + gain * shaded).square() * pixels.weight).sum((-1, -2))
                k = int(errors.argmin())
                if float(errors[k]) < best:
                    best, held = float(errors[k]), [argument[k] for argument in tried]
            bounded = [
                number if parameter.type == "direction" else number.clamp(parameter.low, parameter.high)
                for parameter, number in zip(kind.parameters, held, strict=True)
            ]
            root = replace(root, address, Leaf(node.kind, tuple(tuple(number.tolist()) for number in bounded), node.name))
    return root


def error_of(pixels: Pixels, root: Node) -> float:
    """Mean squared error of a tree at given pixels."""
    with torch.no_grad():
        model = Model(root, pixels)
        values = model.evaluate(model.layout.pack(root))
        return float(((model.compose(values) - pixels.target).square() * pixels.weight).double().sum()) / 3.0


def fit_least_squares(
    target: Image, mask: Mask, root: Node, *, seed: int = 0, locked: Collection[str] = (), steps: int = 60, count: int = 8000
) -> Fitted:
    """Fit the parameters of a tree to a picture: first on coarse averages, then on points of the full picture.

    Args:
        target: (3, H, H) in [0, 1]. mask: (1, H, H) bool, pixels that count. root: the structure and the start.
        seed: of the choice of points. locked: addresses that keep their numbers. steps: most steps on each set.
    Returns:
        The tree and its mean squared error on the points.
    """
    if target.shape[-1] > COARSE_SIZE:
        root = soften(root, COARSE_SOFTNESS, locked)
        root = fit_pixels(Pixels.of(target, mask, COARSE_SIZE), root, locked=locked, steps=steps, softest=COARSE_SOFTNESS).root
    return sharpen(Pixels.important(target, mask, count, seed), root, locked=locked, steps=steps)
