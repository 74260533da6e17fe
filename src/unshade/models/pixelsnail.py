"""PixelSNAIL: a distribution over a map of codes, drawn code by code in reading order under a condition.

After Chen et al. 2018, "PixelSNAIL: An Improved Autoregressive Generative Model": blocks of gated causal convolutions, each block
followed by causal attention over everything before. Every layer does two things: `forward` over a whole map, for training, and
`step` at one position over what it kept of the positions before, for sampling. So a new code costs one step, not a pass over the map.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.models.config import PriorConfig

AT_ONCE = 128
"""Maps that a CPU draws as one batch: 1.5 MB are kept of each in the small configuration, and more at once are not faster there."""

Cache = dict[Any, Tensor]
"""What layers keep between the steps of one sampling run, by layer."""


EPSILON = 1e-6
"""Of the root mean square that features are divided by."""


def _norm(x: Tensor, gain: Tensor) -> Tensor:
    """Root mean square 1 across the channels, dimension 1 of (B, C, H, W), at each position alone: so it is causal."""
    return x * torch.rsqrt(x.square().mean(1, keepdim=True) + EPSILON) * gain.view(-1, 1, 1)


def _norm_at(x: Tensor, gain: Tensor) -> Tensor:
    """`_norm` at one position, (N, C)."""
    return F.rms_norm(x, gain.shape, gain, EPSILON)


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

    def begin(self, cache: Cache, count: int, width: int) -> None:
        """Keep two rows, which take turns, with zeros around them: what a position sees of both lies in one piece, so nothing is copied.

        Which of the two is the row above changes with every row, so the weights are kept in both orders.
        """
        weight = (self.convolution.weight * self.kept).permute(2, 3, 1, 0)
        across, inputs = weight.shape[1:3]
        cache[self] = weight.new_zeros(count, width + 1 + self.right, 2, inputs)
        orders = (weight.flip(0), weight)
        cache[self, "weights"] = torch.stack([order.transpose(0, 1).reshape(2 * across * inputs, -1) for order in orders])

    def put(self, cache: Cache, row: int, column: int, x: Tensor) -> None:
        """Remember the input (N, C) at a position."""
        cache[self][:, column + 1, row % 2] = x

    def take(self, cache: Cache, row: int, column: int, told: Tensor | None = None) -> Tensor:
        """The output (N, outputs) at a position, from what was put there and before; ``told``, if given, stands in the bias' place."""
        patch = cache[self][:, column : column + 2 + self.right].flatten(1)
        return torch.addmm(self.convolution.bias if told is None else told, patch, cache[self, "weights"][row % 2])  # type: ignore[arg-type]

    def step(self, cache: Cache, row: int, column: int, x: Tensor, told: Tensor | None = None) -> Tensor:
        """Put, then take."""
        self.put(cache, row, column, x)
        return self.take(cache, row, column, told)


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

    def begin(self, cache: Cache, condition: Tensor) -> None:
        """Read the whole condition (H, W, N, D) at once: it is known before the first step."""
        for convolution in (self.first, self.second):
            convolution.begin(cache, condition.shape[2], condition.shape[1])
        cache[self] = _each(self.told, condition, self.second.convolution.bias)

    def step(self, cache: Cache, row: int, column: int, x: Tensor, aside: Tensor | None = None) -> Tensor:
        """`forward` at one position: x, aside (N, C)."""
        inner = self.first.step(cache, row, column, F.elu(_norm_at(x, self.gain)))
        if self.aside is not None and aside is not None:
            inner = torch.addmm(inner, aside, self.aside.weight.T)
        return x + F.glu(self.second.step(cache, row, column, F.elu(inner), cache[self][row, column]), 1)


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

    def begin(self, cache: Cache, count: int, length: int) -> None:
        """Room for all keys and values, the empty one first."""
        width = self.offer.out_features // 2 // self.heads
        cache[self] = self.offer.weight.new_zeros(2, count, self.heads, length + 1, width)

    def step(self, cache: Cache, position: int, x: Tensor, places: Tensor) -> Tensor:
        """The look at one position: x (N, C), places (2,) to (N, C)."""
        x = torch.cat([_norm_at(x, self.gain), places.expand(len(x), 2)], 1)
        cache[self, "asked"] = x
        query = self.ask(x).unflatten(1, (self.heads, 1, -1))
        keys, values = cache[self][:, :, :, : position + 1]
        # One query a head: two products are faster than the fused attention, which is made for many.
        return (torch.softmax(query @ keys.transpose(2, 3) * keys.shape[3] ** -0.5, 3) @ values).flatten(1)

    def remember(self, cache: Cache, position: int, seen: Tensor) -> None:
        """Offer a position to later ones, now that its code is drawn: entries ``seen`` (N, E)."""
        asked = cache[self, "asked"]
        offered = self.offer(torch.cat([asked[:, :-2], seen, asked[:, -2:]], 1))
        cache[self][:, :, :, position + 1] = offered.unflatten(1, (2, self.heads, -1)).transpose(0, 1)


class Block(nn.Module):
    """Gated layers, attention, and a gated layer that joins the two."""

    def __init__(self, inputs: int, config: PriorConfig) -> None:
        super().__init__()
        sizes = (config.channels, config.condition_channels, config.dropout)
        self.layers = nn.ModuleList(GatedLayer(*sizes) for _ in range(config.layers))
        self.attention = CausalAttention(config.channels, inputs, config.heads)
        self.join = GatedLayer(*sizes, aside=True)


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
        return torch.cat([self._sample(entries, part, generator, temperature) for part in _batches(condition)])

    def _sample(self, entries: Tensor, condition: Tensor, generator: torch.Generator, temperature: float) -> Tensor:
        count, size = len(condition), self.size
        cache: Cache = {}
        self.enter.begin(cache, count, size)
        condition = condition.permute(2, 3, 0, 1).contiguous()
        told = _each(self.told, condition)
        for block in self.blocks:
            assert isinstance(block, Block)
            for layer in [*block.layers, block.join]:
                layer.begin(cache, condition)
            block.attention.begin(cache, count, size * size)
        drawn, table = condition.new_zeros(count, size, size, dtype=torch.int64), _table(entries)
        for position in range(size * size):
            row, column = divmod(position, size)
            x = self._step(cache, row, column, told[row, column])
            number = _draw(self.leave(x) + self.aim(x) @ table, generator, temperature)
            drawn[:, row, column] = number
            seen = F.embedding(number, entries)
            self.enter.put(cache, row, column, seen)
            for block in self.blocks:
                block.attention.remember(cache, position, seen)  # type: ignore[operator,union-attr]
        return drawn

    def _step(self, cache: Cache, row: int, column: int, told: Tensor) -> Tensor:
        """The last features (N, C) of one position, from the cached ones of those before."""
        x = self.enter.take(cache, row, column) + told
        places = self.places[0, :, row, column]
        for block in self.blocks:
            assert isinstance(block, Block)
            for layer in block.layers:
                x = layer.step(cache, row, column, x)  # type: ignore[operator]
            looked = block.attention.step(cache, row * self.size + column, x, places)
            x = block.join.step(cache, row, column, x, looked)
        return F.elu(_norm_at(x, self.gain))

    @torch.no_grad()
    def sample_uncached(self, entries: Tensor, condition: Tensor, generator: torch.Generator, temperature: float = 1.0) -> Tensor:
        """`sample` by a pass over the whole map for every code: slow, and what the fast one is tested against."""
        found = []
        for part in _batches(condition):
            drawn = part.new_zeros(len(part), self.size, self.size, dtype=torch.int64)
            for position in range(self.size * self.size):
                row, column = divmod(position, self.size)
                logits = self(drawn, entries, part)[:, :, row, column]
                drawn[:, row, column] = _draw(logits, generator, temperature)
            found.append(drawn)
        return torch.cat(found)


def _each(convolution: nn.Conv2d, x: Tensor, more: Tensor | None = None) -> Tensor:
    """A convolution of 1 x 1 where the channels come last, (..., D) to (..., outputs), with ``more`` added to its bias."""
    bias = convolution.bias if more is None or convolution.bias is None else convolution.bias + more
    return F.linear(x, convolution.weight[:, :, 0, 0], bias)


def _batches(condition: Tensor) -> tuple[Tensor, ...]:
    return condition.split(AT_ONCE if condition.device.type == "cpu" else max(len(condition), 1))


def _table(entries: Tensor) -> Tensor:
    """(E + 1, K): what the natural parameters of a Gaussian are multiplied with for its logarithm at every entry."""
    return torch.cat([entries, -0.5 * entries.square().mean(1, keepdim=True)], 1).T


def _draw(logits: Tensor, generator: torch.Generator, temperature: float) -> Tensor:
    """One number for each row of logits (N, K)."""
    if temperature == 0.0:
        return logits.argmax(1)
    # One uniform number a row and the sum of what is before it: a fifth of all the time goes where each code draws one of its own.
    total = torch.softmax(logits.float() / temperature, 1).cumsum(1)
    at = torch.rand(len(logits), 1, generator=generator, device=logits.device) * total[:, -1:]
    return torch.searchsorted(total, at, right=True)[:, 0].clamp(max=logits.shape[1] - 1)
