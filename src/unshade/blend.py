"""How two or more shadings join: one table, one definition each (Geng et al. 2023, section 3.1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from operator import mul

from torch import Tensor


def multiply(*layers: Tensor) -> Tensor:
    """Product of the layers (Geng et al. 2023, equation 1)."""
    return math.prod(layers[1:], start=layers[0])


def screen(*layers: Tensor) -> Tensor:
    """``1 - (1 - a)(1 - b)...`` (Geng et al. 2023, equation 2)."""
    return 1.0 - math.prod([1.0 - layer for layer in layers[1:]], start=1.0 - layers[0])


def mix(left: Tensor, right: Tensor, mask: Tensor) -> Tensor:
    """``mask * left + (1 - mask) * right`` (Geng et al. 2023, equation 3)."""
    return right + mask * (left - right)


def _products_of_others(factors: Sequence[Tensor]) -> list[Tensor | float]:
    """For each factor the product of all the others, without dividing."""
    if len(factors) == 1:
        return [1.0]
    before = list(accumulate(factors[:-1], mul))
    after = list(accumulate(factors[:0:-1], mul))[::-1]
    return [after[0], *map(mul, before[:-1], after[1:]), before[-1]]


def multiply_gains(*layers: Tensor) -> list[Tensor | float]:
    """d multiply / d layer, one a layer."""
    return _products_of_others(layers)


def screen_gains(*layers: Tensor) -> list[Tensor | float]:
    """d screen / d layer, one a layer."""
    return _products_of_others([1.0 - layer for layer in layers])


def mix_gains(left: Tensor, right: Tensor, mask: Tensor) -> list[Tensor | float]:
    """d mix / d (left, right, mask)."""
    return [mask, 1.0 - mask, left - right]


@dataclass(frozen=True)
class Blend:
    """An operator of the grammar.

    Every operator is affine in each of its inputs, so the gain of an input is also its exact derivative and does not
    depend on it. The fit and the search rest on that.
    """

    name: str
    apply: Callable[..., Tensor]
    gains: Callable[..., list[Tensor | float]]
    identity: float | None
    """The constant layer that changes nothing, where there is one."""
    summary: str


BLENDS = {
    blend.name: blend
    for blend in (
        Blend("multiply", multiply, multiply_gains, 1.0, "darkens: white changes nothing"),
        Blend("screen", screen, screen_gains, 0.0, "lightens: black changes nothing"),
        Blend("mix", mix, mix_gains, None, "left where the mask is 1, right where it is 0"),
    )
}
