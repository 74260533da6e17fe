"""Trees that are too large lose what is least useful.

The picture is affine in every node, so how far it is off once a leaf is gone is told by one look at the whole tree: the
error before any fit. Only the leaves whose loss hurts least are looked at closely.
"""

from __future__ import annotations

import torch

from unshade.blend import BLENDS
from unshade.changes import removable
from unshade.fit.least_squares import FINE_SOFTNESS, fit_pixels
from unshade.fit.model import Model
from unshade.fit.pixels import Pixels
from unshade.nodes import Node, count_values, find, replace, steps

REMOVED = 5
"""Leaves whose loss is looked at closely: those with the least error before any fit."""


def least_useful(root: Node, pixels: Pixels, fit_steps: int = 3) -> Node | None:
    """The tree without the leaf whose loss hurts least after so many steps of a fit; None where only one is left."""
    options = [replace(root, where, kept) for _, where, kept in sorted(losses(root, pixels), key=lambda loss: loss[0])[:REMOVED]]
    if not options or not fit_steps:
        return options[0] if options else None
    close = [fit_pixels(pixels, smaller, steps=fit_steps, softest=FINE_SOFTNESS) for smaller in options]
    return min(close, key=lambda option: option.error).root


def within(root: Node, pixels: Pixels, most: int) -> Node | None:
    """The tree without its least useful leaves until it stores at most so many values; None where that cannot be."""
    found: Node | None = root
    while found is not None and (over := count_values(found) - most) > 0:
        # A tree that is far too large is full of leaves that nothing rests on.
        found = least_useful(found, pixels, 3 if over < 12 else 0)
    return found


def losses(root: Node, pixels: Pixels) -> list[tuple[float, str, Node | None]]:
    """For everything that `changes.removable` lists, the mean squared error of the tree without it, all else as it is."""
    model = Model(root, pixels)
    values = model.evaluate(model.layout.pack(root))
    residual = model.compose(values) - pixels.target
    nodes = {address: (value, gain) for address, _, value, gain in model.nodes(values)}
    found = []
    for where, kept in removable(root):
        value, gain = nodes[where]
        off = residual + gain * (_instead(root, where, kept, nodes, pixels) - value)
        found.append((float((off.square() * pixels.weight).double().sum()) / 3.0, where, kept))
    return found


def _instead(
    root: Node, where: str, kept: Node | None, nodes: dict[str, tuple[torch.Tensor, torch.Tensor | float]], pixels: Pixels
) -> torch.Tensor | float:
    """The picture of what stands at an address once something is lost."""
    if kept is None:
        identity = BLENDS[where.rsplit(".", 2)[0].rpartition(".")[2]].identity
        assert identity is not None
        return identity
    for step, child in steps(find(root, where)):
        if child is kept:
            return nodes[f"{where}.{step}.{child.kind}"][0]
    model = Model(kept, pixels)
    return model.compose(model.evaluate(model.layout.pack(kept)))
