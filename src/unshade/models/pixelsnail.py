"""PixelSNAIL: a distribution over a map of codes, drawn code by code in reading order under a condition.

After Chen et al. 2018, "PixelSNAIL: An Improved Autoregressive Generative Model": blocks of gated causal convolutions, each block
followed by causal attention over everything before. `forward` runs over a whole map, for training. For sampling, every layer says in
``begun`` what `sampling` needs to know and keep of it, so that a new code costs one step, not a pass over the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.models import sampling
from unshade.models.config import PriorConfig
from unshade.threads import at_once

AT_ONCE = 128
"""Maps that a CPU draws as one batch: 1.5 MB are kept of each in the small configuration, and more at once are not faster there."""

OF_A_THREAD = 4
"""Fewest maps that are worth a thread of their own."""


def _norm(x: Tensor, gain: Tensor) -> Tensor:
    """Root mean square ``gain`` across the channels, dimension 1 of (B, C, H, W), at each position alone: so it is causal."""
    return sampling.unit(x) * _scaled(gain).view(-1, 1, 1)


def _scaled(gain: Tensor) -> Tensor:
    """What a vector of length 1 is multiplied with to have the root mean square ``gain``."""
    return gain * len(gain) ** 0.5


class CausalConvolution(nn.Module):
    """A convolution of the row above and the row itself up to the position, or short of it (``strict``)."""

    kept: Tensor

    def __init__(self, inputs: int, outputs: int, strict: bool = False) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, (2, 3 if strict else 2))
        self.right = 1 if strict else 0
        kept = torch.ones(2, 2 + self.right)
        if strict:
            kept[1, 1:] = 0.0
        self.register_buffer("kept", kept, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, outputs, H, W)."""
        weight = self.convolution.weight * self.kept if self.right else self.convolution.weight
        return F.conv2d(F.pad(x, (1, self.right, 1, 0)), weight, self.convolution.bias)

    def begun(self, count: int, width: int) -> sampling.Convolution:
        """Before the first of so many maps is drawn."""
        weight = (self.convolution.weight * self.kept).permute(2, 3, 1, 0).flatten(0, 1)
        zeros = weight.new_zeros(count, weight.shape[1])
        rows = [[zeros] * (width + 1 + self.right) for _ in range(2)]
        # Four places are seen; what is not kept is what comes last.
        return sampling.Convolution(rows, self.right, weight[:4].flatten(0, 1))


class GatedLayer(nn.Module):
    """``x + a * sigmoid(b)``, where a and b come from causal convolutions of x, from the condition, and from ``aside`` if there is one."""

    def __init__(self, channels: int, condition: int, dropout: float, aside: bool = False) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.ones(channels))
        self.first = CausalConvolution(channels, channels)
        self.aside = nn.Linear(channels, channels, bias=False) if aside else None
        self.second = CausalConvolution(channels, 2 * channels)
        self.told = nn.Conv2d(condition, 2 * channels, 1)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, condition: Tensor, aside: Tensor | None = None) -> Tensor:
        """x, aside (B, C, H, W), condition (B, D, H, W) to (B, C, H, W)."""
        inner = self.first(F.elu(_norm(x, self.gain)))
        if self.aside is not None and aside is not None:
            inner = inner + F.conv2d(aside, self.aside.weight[:, :, None, None])
        value, gate = (self.second(self.dropout(F.elu(inner))) + self.told(condition)).chunk(2, 1)
        return x + value * torch.sigmoid(gate)

    def begun(self, condition: Tensor, size: int) -> sampling.Layer:
        """Before the first map is drawn: the whole condition (L, N, D) is known, and read at once."""
        first, second = (convolution.begun(condition.shape[1], size) for convolution in (self.first, self.second))
        if self.aside is not None:
            first = first._replace(weights=torch.cat([first.weights, self.aside.weight.T]))
        told = _each(self.told, condition) + _bias(self.second.convolution)
        return sampling.Layer(_scaled(self.gain), first, _bias(self.first.convolution), second, list(told))


class CausalAttention(nn.Module):
    """Every position looks at the codes and features of all positions before it, and at nothing where there is none.

    Keys and values are moved on by one place, with zeros in the first, so that attention up to a position is attention before it.
    """

    def __init__(self, channels: int, inputs: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.gain = nn.Parameter(torch.ones(channels))
        self.ask = nn.Linear(channels + 2, channels)
        self.offer = nn.Linear(channels + inputs + 2, 2 * channels)

    def _split(self, x: Tensor) -> Tensor:
        """(N, L, C) to (N, heads, L, C / heads)."""
        return x.unflatten(2, (self.heads, -1)).transpose(1, 2)

    def forward(self, x: Tensor, seen: Tensor, places: Tensor) -> Tensor:
        """x (B, C, H, W), the entries of the codes ``seen`` (B, E, H, W) and ``places`` (1, 2, H, W) to (B, C, H, W)."""
        height, width = x.shape[-2:]
        x = _norm(x, self.gain)
        places = places.expand(len(x), -1, -1, -1)
        queries = self.ask(torch.cat([x, places], 1).flatten(2).transpose(1, 2))
        offered = self.offer(torch.cat([x, seen, places], 1).flatten(2).transpose(1, 2))
        keys, values = F.pad(offered, (0, 0, 1, 0))[:, :-1].chunk(2, 2)
        out = F.scaled_dot_product_attention(self._split(queries), self._split(keys), self._split(values), is_causal=True)
        return out.transpose(1, 2).flatten(2).transpose(1, 2).unflatten(2, (height, width))

    def begun(self, count: int, places: Tensor) -> sampling.Attention:
        """Before the first code is drawn, with the empty key and value; places (L, 2)."""
        channels, width = len(self.gain), len(self.gain) // self.heads
        ask, ask_bias = (part * width**-0.5 for part in (self.ask.weight.T, self.ask.bias))
        # Keys and values of a head side by side.
        offer, offer_bias = (
            part.unflatten(-1, (2, self.heads, width)).transpose(-3, -2).flatten(-3) for part in (self.offer.weight.T, self.offer.bias)
        )
        looks, length = count * self.heads, len(places) + 1
        return sampling.Attention(
            _scaled(self.gain),
            ask[:channels],
            list(ask_bias + places @ ask[channels:]),
            offer[:-2],
            list(offer_bias + places @ offer[-2:]),
            ask.new_zeros(looks, width, length),
            ask.new_zeros(looks, length, width),
        )


class Block(nn.Module):
    """Gated layers, attention, and a gated layer that joins the two."""

    def __init__(self, inputs: int, config: PriorConfig) -> None:
        super().__init__()
        sizes = (config.channels, config.condition_channels, config.dropout)
        self.layers = nn.ModuleList(GatedLayer(*sizes) for _ in range(config.layers))
        self.attention = CausalAttention(config.channels, inputs, config.heads)
        self.join = GatedLayer(*sizes, aside=True)

    def begun(self, condition: Tensor, size: int, places: Tensor) -> sampling.Block:
        """Before the first code is drawn: condition (L, N, D), places (L, 2)."""
        layers = [layer.begun(condition, size) for layer in self.layers]  # type: ignore[operator]
        return sampling.Block(layers, self.attention.begun(condition.shape[1], places), self.join.begun(condition, size))


class PixelSNAIL(nn.Module):
    """Logits of every code of a (size x size) map given the codes before it, in reading order, and a condition.

    The codes' entries in their codebook, (K, E), are given with every call: alike codes are alike inputs. They are alike outputs too:
    a part of the logits is that of a Gaussian over the entries, of which the network gives the natural parameters.
    """

    places: Tensor

    def __init__(self, size: int, codes: int, entry_channels: int, config: PriorConfig) -> None:
        super().__init__()
        self.size = size
        self.enter = CausalConvolution(entry_channels, config.channels, strict=True)
        self.told = nn.Conv2d(config.condition_channels, config.channels, 1)
        self.blocks = nn.ModuleList(Block(entry_channels, config) for _ in range(config.blocks))
        self.gain = nn.Parameter(torch.ones(config.channels))
        self.leave = nn.Linear(config.channels, codes)
        self.aim = nn.Linear(config.channels, entry_channels + 1)
        steps = torch.linspace(-1.0, 1.0, size)
        self.register_buffer("places", torch.stack(torch.meshgrid(steps, steps, indexing="ij"))[None], persistent=False)

    def forward(self, numbers: Tensor, entries: Tensor, condition: Tensor) -> Tensor:
        """numbers (B, H, W), entries (K, E), condition (B, D, H, W) to logits (B, K, H, W)."""
        seen = F.embedding(numbers, entries).permute(0, 3, 1, 2)
        x = self.enter(seen) + self.told(condition)
        for block in self.blocks:
            assert isinstance(block, Block)
            for layer in block.layers:
                x = layer(x, condition)
            x = block.join(x, condition, block.attention(x, seen, self.places))
        x = F.elu(_norm(x, self.gain)).permute(0, 2, 3, 1)
        return (self.leave(x) + self.aim(x) @ _table(entries)).permute(0, 3, 1, 2)

    @torch.no_grad()
    def sample(self, entries: Tensor, condition: Tensor, generator: torch.Generator, temperature: float = 1.0) -> Tensor:
        """Draw a map of codes for each condition, all as one batch; on a CPU `AT_ONCE` at a time.

        Args:
            entries: (K, E) of the codebook.
            condition: (N, D, H, W).
            generator: source of all randomness, on the same device.
            temperature: 1 draws from the distribution, less makes likely codes likelier, 0 takes the likeliest.
        Returns:
            (N, H, W) int64.
        """
        condition = condition.to(self.gain.dtype)
        parts = _parts(condition, _chances(condition, self.size**2, generator))
        draw = sampling.compiled() if condition.device.type == "cpu" else sampling.draw

        def drawn(part: Tensor, chances: Tensor) -> Tensor:
            # Both belong to a thread.
            with torch.inference_mode(), torch.autocast(part.device.type, enabled=False):
                return draw(self.begun(part, entries), entries, chances, temperature).unflatten(1, (self.size, self.size))

        return torch.cat(at_once([partial(drawn, *part) for part in parts], condition.device))

    def begun(self, condition: Tensor, entries: Tensor) -> sampling.State:
        """Before the first code is drawn."""
        condition = condition.flatten(2).permute(2, 0, 1).contiguous()
        table, places = _table(entries), self.places[0].flatten(1).T.contiguous()
        return sampling.State(
            self.enter.begun(condition.shape[1], self.size),
            list(_each(self.told, condition) + _bias(self.enter.convolution)),
            [block.begun(condition, self.size, places) for block in self.blocks],  # type: ignore[operator]
            _scaled(self.gain),
            self.leave.weight.T + self.aim.weight.T @ table,
            self.leave.bias + self.aim.bias @ table,
        )

    @torch.no_grad()
    def sample_uncached(self, entries: Tensor, condition: Tensor, generator: torch.Generator, temperature: float = 1.0) -> Tensor:
        """`sample` by a pass over the whole map for every code: slow, and what the fast one is tested against."""
        found = []
        for part, chances in zip(_batches(condition), _chances(condition, self.size**2, generator), strict=True):
            drawn = part.new_zeros(len(part), self.size, self.size, dtype=torch.int64)
            for position in range(self.size * self.size):
                row, column = divmod(position, self.size)
                logits = self(drawn, entries, part)[:, :, row, column]
                drawn[:, row, column] = sampling.pick(logits, chances[position], temperature)
            found.append(drawn)
        return torch.cat(found)


def _each(convolution: nn.Conv2d, x: Tensor) -> Tensor:
    """A convolution of 1 x 1 where the channels come last, (..., D) to (..., outputs)."""
    return F.linear(x, convolution.weight[:, :, 0, 0], convolution.bias)


def _bias(convolution: nn.Conv2d) -> Tensor:
    assert convolution.bias is not None
    return convolution.bias


def _table(entries: Tensor) -> Tensor:
    """(E + 1, K): what the natural parameters of a Gaussian are multiplied with for its logarithm at every entry."""
    return torch.cat([entries, -0.5 * entries.square().mean(1, keepdim=True)], 1).T


def _batches(condition: Tensor) -> tuple[Tensor, ...]:
    return condition.split(AT_ONCE if condition.device.type == "cpu" else max(len(condition), 1))


def _chances(condition: Tensor, length: int, generator: torch.Generator) -> list[Tensor]:
    """For each batch, (length, N, 1) uniform numbers: all randomness, which does not depend on how many threads share the work."""
    return [
        torch.stack([torch.rand(len(part), 1, generator=generator, device=part.device) for _ in range(length)])
        for part in _batches(condition)
    ]


def _parts(condition: Tensor, chances: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
    """The batches with their chances, on a CPU as many of them as there are threads at least."""
    found = []
    for part, numbers in zip(_batches(condition), chances, strict=True):
        shares = min(torch.get_num_threads(), len(part) // OF_A_THREAD) if condition.device.type == "cpu" else 1
        found += list(zip(part.tensor_split(max(shares, 1)), numbers.tensor_split(max(shares, 1), 1), strict=True))
    return found
