"""What is left of a picture for one child, once the other is known.

Decoded children are blurred, and a child of a child more so. But every operator is affine in each operand, ``gain * child + offset``:
where the gain is not small, the picture and one child say exactly what the other has to be. So a child that is to be decomposed
further keeps the edges of the picture, at whatever level it stands, and what one child is wrong by reaches the other, which can mend it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from unshade.blend import BLENDS
from unshade.sphere import disc_mask
from unshade.types import Image, Mask

RIDGE = 0.01
"""Square of the gain at which the decoded child and what is left for it weigh alike."""

COLORED = ("albedo", "environment")
"""Types of leaves that have a colour; all others are grey."""


def cleaned(kind: str, image: Image) -> Image:
    """A decoded leaf (3, S, S) without what no leaf of its type has: an albedo is one colour, a shading is grey."""
    disc = disc_mask(image.shape[-1], device=image.device)
    if kind == "albedo":
        return (image * disc).sum((1, 2), keepdim=True) / disc.sum() * disc
    return image if kind in COLORED else image.mean(0, keepdim=True).expand(3, -1, -1)


def gains(operator: str, children: Sequence[Image], mask: Mask | None) -> tuple[Image, Image]:
    """How much of each of two children shows in their parent, (3, S, S) each."""
    operands = [*children, *([mask] if mask is not None else [])]
    left, right = BLENDS[operator].gains(*operands)[:2]
    return tuple(torch.as_tensor(gain).expand_as(children[0]) for gain in (left, right))  # type: ignore[return-value]


def remainder(parent: Image, operator: str, children: Sequence[Image], mask: Mask | None, side: int) -> Image:
    """What one child has to be for the operator to give the parent, as far as it shows; elsewhere the child as it is.

    Args:
        parent: (3, S, S). children: (3, S, S) each, as they were decoded. mask: (1, S, S), of a mix. side: 0 or 1.
    Returns:
        (3, S, S) in [0, 1], the least squares solution with the decoded child as its prior.
    """
    gain = gains(operator, children, mask)[side]
    operands = [torch.zeros_like(parent) if k == side else child for k, child in enumerate(children)]
    offset = BLENDS[operator].apply(*operands, *([mask] if mask is not None else []))
    found = (gain * (parent - offset) + RIDGE * children[side]) / (gain.square() + RIDGE)
    return found.clamp(0.0, 1.0) * disc_mask(parent.shape[-1], device=parent.device)


def completed(parent: Image, operator: str, children: Sequence[Image], mask: Mask | None, kinds: Sequence[str]) -> list[Image]:
    """Both children of a node, those that are to be decomposed further as the remainder of the other.

    Under multiply and screen only one of two can be that: the one with more to show, whose sharp edges a decoder loses most of.
    """
    found = [cleaned(kind, child) for kind, child in zip(kinds, children, strict=True)]
    sides = [side for side, kind in enumerate(kinds) if kind == "operator"]
    if len(sides) == 2 and operator != "mix":
        shares = gains(operator, found, mask)
        sides = [max(sides, key=lambda side: float(contrast(found[side], shares[side])))]
    # Under a mix each of them has pixels of its own, so what is decoded of one does not matter to the other.
    wanted = {side: remainder(parent, operator, found, mask, side) for side in sides}
    return [wanted.get(side, child) for side, child in enumerate(found)]


def contrast(image: Image, gain: Image) -> torch.Tensor:
    """Root mean square of what would be lost in the picture if a part (3, S, S) were one colour; gain: how much of it shows there."""
    disc = disc_mask(image.shape[-1], device=image.device)
    weight = gain.square() * disc
    mean = (weight * image).sum((1, 2), keepdim=True) / weight.sum((1, 2), keepdim=True).clamp(min=1e-9)
    return ((weight * (image - mean).square()).sum() / (3.0 * disc.sum())).sqrt()
