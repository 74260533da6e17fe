"""Codes of a `PixelSNAIL` drawn one after the other: a new code costs one step over what is kept of those before, not a pass over the map.

A step is a hundred and sixty small operations, between which Python takes as long as the processor takes for them. So `draw` is written
in the part of Python that is TorchScript too, and on a CPU runs as that: no interpreter between the operations, and none to wait for in
another thread.
"""

import sys
import warnings
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor

NO_SCRIPT = (3, 14)
"""From this Python on, PyTorch does not support TorchScript."""


class Convolution(NamedTuple):
    """A causal convolution. It keeps two rows, which take turns."""

    rows: list[list[Tensor]]
    """Features (N, C) at each place of both, zeros beyond their ends."""
    ahead: int
    """Places of the row above that are seen to the right."""
    weights: Tensor
    """(places seen * C, outputs)."""


class Layer(NamedTuple):
    """A gated layer."""

    gain: Tensor
    first: Convolution
    bias: Tensor
    """Of ``first``, whose weights end with those of what comes from aside, if anything does."""
    second: Convolution
    told: list[Tensor]
    """(N, 2 C) at each position, of the condition, with the bias of ``second``."""


class Attention(NamedTuple):
    """Looks at everything before."""

    gain: Tensor
    ask: Tensor
    ask_bias: list[Tensor]
    """(C) at each position: where it is belongs to the question."""
    offer: Tensor
    offer_bias: list[Tensor]
    keys: Tensor
    """(N * heads, C / heads, L + 1), the first one of nothing."""
    values: Tensor
    """(N * heads, L + 1, C / heads)"""


class Block(NamedTuple):
    """Layers, attention, and a layer that joins the two."""

    layers: list[Layer]
    attention: Attention
    join: Layer


class State(NamedTuple):
    """A network that is being drawn from: its weights as a step wants them, and what is kept."""

    enter: Convolution
    told: list[Tensor]
    """(N, C) at each position, of the condition, with the bias of ``enter``."""
    blocks: list[Block]
    gain: Tensor
    leave: Tensor
    """(C, K)."""
    leave_bias: Tensor


def unit(x: Tensor) -> Tensor:
    """Features (N, C, ...) divided by their length, or by a thousandth of the usual one where they have none."""
    return x / torch.linalg.vector_norm(x, 2.0, [1], True).clamp_min(1e-3 * x.size(1) ** 0.5)


def _normal(x: Tensor, gain: Tensor) -> Tensor:
    return F.elu(unit(x) * gain)


def _seen(layer: Convolution, row: int, column: int) -> list[Tensor]:
    """What a position sees of those before."""
    above, here = layer.rows[(row + 1) % 2], layer.rows[row % 2]
    return above[column : column + 2 + layer.ahead] + [here[column]]


def _gated(layer: Layer, row: int, column: int, position: int, x: Tensor, aside: list[Tensor]) -> Tensor:
    inner = _normal(x, layer.gain)
    layer.first.rows[row % 2][column + 1] = inner
    inner = F.elu(torch.addmm(layer.bias, torch.cat(_seen(layer.first, row, column) + [inner] + aside, 1), layer.first.weights))
    layer.second.rows[row % 2][column + 1] = inner
    both = torch.addmm(layer.told[position], torch.cat(_seen(layer.second, row, column) + [inner], 1), layer.second.weights)
    return x + F.glu(both, 1)


def _looked(attention: Attention, position: int, asked: Tensor) -> Tensor:
    """What attention finds (N, C) before a position."""
    query = torch.addmm(attention.ask_bias[position], asked, attention.ask).view(attention.keys.size(0), 1, -1)
    # One query a head: two products are faster than the fused attention, which is made for many.
    shares = torch.softmax(torch.bmm(query, attention.keys.narrow(2, 0, position + 1)), 2)
    return torch.bmm(shares, attention.values.narrow(1, 0, position + 1)).view(asked.size(0), -1)


def _offered(attention: Attention, position: int, asked: Tensor, seen: Tensor) -> None:
    """Offer a position to later ones, now that its code is drawn."""
    offered = torch.addmm(attention.offer_bias[position], torch.cat([asked, seen], 1), attention.offer)
    offered = offered.view(attention.keys.size(0), 2, -1)
    attention.keys.select(2, position + 1).copy_(offered.select(1, 0))
    attention.values.select(1, position + 1).copy_(offered.select(1, 1))


def pick(logits: Tensor, chance: Tensor, temperature: float) -> Tensor:
    """One number for each row of logits (N, K).

    Args:
        chance: (N, 1), uniform in [0, 1).
        temperature: 1 draws from the distribution, less makes likely numbers likelier, 0 takes the likeliest.
    """
    if temperature == 0.0:
        return logits.argmax(1)
    # One uniform number a row and the sum of what is before it: a fifth of all the time goes where each code draws one of its own.
    total = torch.softmax(logits.float() / temperature, 1).cumsum(1)
    return torch.searchsorted(total, chance * total[:, -1:], right=True)[:, 0].clamp(max=logits.size(1) - 1)


def draw(state: State, entries: Tensor, chances: Tensor, temperature: float) -> Tensor:
    """Draw a map of codes for each of N conditions.

    Args:
        entries: (K, E) of the codebook.
        chances: (L, N, 1), uniform in [0, 1), for each position in reading order.
        temperature: as of `pick`.
    Returns:
        (N, L) int64.
    """
    length, count = chances.size(0), chances.size(1)
    size = int(length**0.5)
    drawn = torch.zeros([count, length], dtype=torch.int64, device=entries.device)
    for position in range(length):
        row, column = position // size, position % size
        x = torch.addmm(state.told[position], torch.cat(_seen(state.enter, row, column), 1), state.enter.weights)
        asked: list[Tensor] = []
        for block in state.blocks:
            for layer in block.layers:
                x = _gated(layer, row, column, position, x, [])
            asked.append(unit(x) * block.attention.gain)
            x = _gated(block.join, row, column, position, x, [_looked(block.attention, position, asked[-1])])
        number = pick(torch.addmm(state.leave_bias, _normal(x, state.gain), state.leave), chances[position], temperature)
        drawn[:, position] = number
        seen = F.embedding(number, entries)
        state.enter.rows[row % 2][column + 1] = seen
        for k, block in enumerate(state.blocks):
            _offered(block.attention, position, asked[k], seen)
    return drawn


@lru_cache(maxsize=1)
def compiled() -> Callable[[State, Tensor, Tensor, float], Tensor]:
    """`draw` as TorchScript, or as it is where PyTorch does not offer that any more: the same codes, in twice the time or more."""
    with warnings.catch_warnings():
        # What PyTorch offers in its place, torch.compile, wants a C++ compiler on the user's machine.
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            script = torch.jit.script(draw) if sys.version_info < NO_SCRIPT else draw
        except (RuntimeError, AttributeError, OSError):  # a later PyTorch without it, or no source to read
            script = draw
    return cast(Callable[[State, Tensor, Tensor, float], Tensor], script)
