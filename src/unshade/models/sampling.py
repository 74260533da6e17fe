"""Codes of a `PixelSNAIL` drawn one after the other: a new code costs one step over what is kept of those before, not a pass over the map.

A step is three hundred small operations, between which Python takes as long as the processor takes for them. So `draw` is written in the
part of Python that is TorchScript too, and on a CPU runs as that: no interpreter between the operations, and none to wait for in another
thread.
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
    """A causal convolution. It keeps two rows, which take turns, so that what a position sees of both lies in one piece."""

    rows: Tensor
    """(N, W + what is beyond both ends, 2, C)."""
    weights: Tensor
    """(2, places seen * C, outputs): which of the two is the row above changes with every row, so they are kept in both orders."""
    bias: Tensor


class Layer(NamedTuple):
    """A gated layer."""

    gain: Tensor
    first: Convolution
    aside: Tensor
    """(C, C), or (0, 0)."""
    second: Convolution
    told: Tensor
    """(L, N, 2 C), of the condition, with the bias of ``second``."""


class Attention(NamedTuple):
    """Looks at everything before."""

    gain: Tensor
    ask: Tensor
    ask_bias: Tensor
    offer: Tensor
    offer_bias: Tensor
    offered: Tensor
    """(2, N, heads, L + 1, C / heads): all keys and values, those of nothing first."""


class Block(NamedTuple):
    """Layers, attention, and a layer that joins the two."""

    layers: list[Layer]
    attention: Attention
    join: Layer


class State(NamedTuple):
    """A network that is being drawn from: its weights as a step wants them, and what is kept."""

    enter: Convolution
    told: Tensor
    """(L, N, C)."""
    blocks: list[Block]
    gain: Tensor
    leave: Tensor
    """(C, K)."""
    leave_bias: Tensor
    places: Tensor
    """(L, 2)."""


def unit(x: Tensor) -> Tensor:
    """Features (N, C, ...) divided by their length, or by a thousandth of the usual one where they have none."""
    return F.normalize(x, dim=1, eps=1e-3 * x.size(1) ** 0.5)


def _normal(x: Tensor, gain: Tensor) -> Tensor:
    return F.elu(unit(x) * gain)


def _convolved(layer: Convolution, row: int, column: int, x: Tensor, bias: Tensor) -> Tensor:
    """Put the features (N, C) of a position, and take what the layer makes of them and those before."""
    layer.rows[:, column + 1, row % 2] = x
    return torch.addmm(bias, layer.rows[:, column : column + 2].flatten(1), layer.weights[row % 2])


def _gated(layer: Layer, row: int, column: int, position: int, x: Tensor, aside: Tensor) -> Tensor:
    inner = _convolved(layer.first, row, column, _normal(x, layer.gain), layer.first.bias)
    if layer.aside.numel():
        inner = torch.addmm(inner, aside, layer.aside)
    return x + F.glu(_convolved(layer.second, row, column, F.elu(inner), layer.told[position]), 1)


def _asked(attention: Attention, x: Tensor, place: Tensor) -> Tensor:
    return torch.cat([unit(x) * attention.gain, place.expand(x.size(0), 2)], 1)


def _looked(attention: Attention, position: int, asked: Tensor) -> Tensor:
    """What attention finds (N, C) before a position."""
    heads, width = attention.offered.size(2), attention.offered.size(4)
    query = torch.addmm(attention.ask_bias, asked, attention.ask).view(-1, heads, 1, width)
    keys, values = attention.offered[0, :, :, : position + 1], attention.offered[1, :, :, : position + 1]
    # One query a head: two products are faster than the fused attention, which is made for many.
    return torch.matmul(torch.softmax(torch.matmul(query, keys.transpose(2, 3)) * width**-0.5, 3), values).flatten(1)


def _offered(attention: Attention, position: int, asked: Tensor, seen: Tensor) -> None:
    """Offer a position to later ones, now that its code is drawn."""
    heads, width = attention.offered.size(2), attention.offered.size(4)
    offered = torch.addmm(attention.offer_bias, torch.cat([asked[:, :-2], seen, asked[:, -2:]], 1), attention.offer)
    attention.offered[:, :, :, position + 1] = offered.view(-1, 2, heads, width).transpose(0, 1)


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
        rows = state.enter.rows
        x = torch.addmm(state.enter.bias, rows[:, column : column + 3].flatten(1), state.enter.weights[row % 2]) + state.told[position]
        asked: list[Tensor] = []
        for block in state.blocks:
            for layer in block.layers:
                x = _gated(layer, row, column, position, x, x)
            asked.append(_asked(block.attention, x, state.places[position]))
            x = _gated(block.join, row, column, position, x, _looked(block.attention, position, asked[-1]))
        number = pick(torch.addmm(state.leave_bias, _normal(x, state.gain), state.leave), chances[position], temperature)
        drawn[:, position] = number
        seen = F.embedding(number, entries)
        rows[:, column + 1, row % 2] = seen
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
