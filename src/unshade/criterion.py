"""The criterion that picks one of several samples of a node's children (Geng et al. 2023, section 3.3): L_select and its terms.

`inference` says where it is not the paper's, and why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from unshade.blend import BLENDS
from unshade.sphere import disc_mask
from unshade.synthesis import OPERATORS
from unshade.types import Image, Mask

SEEN = 0.02
"""Root mean square difference from which on two decoded pictures are visibly different. Leaves of our trees change a picture by
0.008 at least."""

LEAST = 1e-3
"""Smallest difference whose logarithm is taken."""


@dataclass(frozen=True)
class Terms:
    """The criterion of one sample."""

    recon: float
    drawn: float
    """L_recon of the children as they were drawn, not completed."""
    similar: float
    blank: float
    white: float
    select: float
    """The paper's four, weighted."""
    rank: float
    """What samples are ordered by: ``select``, and what is drawn."""


def criterion(
    parents: Image,
    shown: Image,
    drawn: tuple[Image, Image],
    through: tuple[Image, Image],
    children: tuple[Image, Image],
    operators: torch.Tensor,
    masks: Mask,
    weights: Sequence[float],
) -> list[Terms]:
    """L_select of B samples and its terms.

    Args:
        parents: (B, 3, S, S). drawn: both children as they were decoded. children: the same, or completed. through: these as they come
            out of codes.
        shown: what a child that is the parent again would look like: the parents, or as they come out of their codes.
        operators: (B,), index of `OPERATORS`. masks: (B, 1, S, S) in [0, 1]. weights: alpha, beta, gamma, and of what is drawn.
    """
    alpha, beta, gamma, delta = weights
    disc = disc_mask(parents.shape[-1], device=parents.device)

    def missed(pair: tuple[Image, Image]) -> torch.Tensor:
        rebuilt = torch.stack([BLENDS[name].apply(*pair, *([masks] if name == "mix" else [])) for name in OPERATORS])
        return _distance(parents, rebuilt[operators, torch.arange(len(operators), device=operators.device)], disc)

    recon = missed(through)
    at_first = recon if drawn is through else missed(drawn)
    mixed = operators == OPERATORS.index("mix")

    def near(other: Image, ignored: torch.Tensor | None = None) -> torch.Tensor:
        least = torch.minimum(*(_distance(child, other, disc) for child in children))
        found = -(least.clamp(LEAST, SEEN) / SEEN).log()
        return found if ignored is None else found.masked_fill(ignored, 0.0)

    similar = near(shown)
    blank, white = near(torch.zeros_like(parents), mixed), near(disc.to(parents).expand_as(parents), mixed)
    select = recon + alpha * similar + beta * blank + gamma * white
    columns = (column.tolist() for column in (recon, at_first, similar, blank, white, select, select + delta * at_first))
    return [Terms(*row) for row in zip(*columns, strict=True)]


def _distance(a: Image, b: Image, disc: Mask) -> torch.Tensor:
    """Root mean square difference inside the disc, (B,)."""
    return ((a - b).square().mean(1) * disc).sum((1, 2)).div(disc.sum()).sqrt()
