"""The transformer baseline: a GPT over the places of a picture and the tokens of its tree.

After Guerrero et al. 2022, "MatFormer: A Generative Model for Procedural Materials".
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.models.config import Config
from unshade.models.image_encoder import ImageEncoder
from unshade.models.token_model import TokenModel
from unshade.models.tokens import LONGEST, VOCABULARY
from unshade.types import Image

PLACES = 16
"""Of the picture, before the first token."""

Memory = list[tuple[Tensor, Tensor]]
"""Keys and values of every block, (B, heads, L, width / heads)."""


class Block(nn.Module):
    """Attention to what came before, then a layer on each place; GPT-2's order."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention, self.norm_layer = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention, self.join = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.layer = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor, past: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """(B, L, width) after ``past``, which may only be given for L = 1, and the past after it."""
        query, key, value = self.attention(self.norm_attention(x)).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        if past is not None:
            key, value = torch.cat([past[0], key], 2), torch.cat([past[1], value], 2)
        found = F.scaled_dot_product_attention(query, key, value, is_causal=past is None)
        x = x + self.join(found.transpose(1, 2).flatten(2))
        return x + self.layer(self.norm_layer(x)), (key, value)


class TransformerBaseline(TokenModel):
    """The picture's places come first, as words that need not be foretold."""

    def __init__(self, config: Config) -> None:
        sizes = config.baselines
        width = sizes.gpt_width
        super().__init__(width)
        self.encoder = ImageEncoder(config.size, sizes.encoder_channels, width)
        self.positions = nn.Parameter(torch.randn(PLACES + LONGEST, width) * 0.02)
        self.blocks = nn.ModuleList(Block(width, sizes.gpt_heads) for _ in range(sizes.gpt_layers))
        self.norm = nn.LayerNorm(width)
        self.decide = nn.Linear(width, VOCABULARY)

    def _picture(self, images: Image) -> Tensor:
        return self.encoder(images).flatten(2).transpose(1, 2) + self.positions[:PLACES]

    def logits(self, images: Image, before: Tensor, slots: Tensor) -> Tensor:
        """See `TokenModel`."""
        words = self.embedded(before, slots) + self.positions[PLACES : PLACES + before.shape[1]]
        x = torch.cat([self._picture(images), words], 1)
        for block in self.blocks:
            x, _ = block(x)
        return self.decide(self.norm(x[:, PLACES:]))

    def begin(self, images: Image) -> Memory:
        """See `TokenModel`."""
        x, memory = self._picture(images), []
        for block in self.blocks:
            x, past = block(x)
            memory.append(past)
        return memory

    def step(self, before: Tensor, slot: Tensor, state: Memory) -> tuple[Tensor, Memory]:
        """See `TokenModel`."""
        x = self.embedded(before[:, None], slot[:, None]) + self.positions[state[0][0].shape[2]]
        memory = []
        for block, past in zip(self.blocks, state, strict=True):
            x, now = block(x, past)
            memory.append(now)
        return self.decide(self.norm(x[:, 0])), memory
