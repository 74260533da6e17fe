"""Priors of the children's codes: the first child given its parent, the second given the parent and the first.

Each is two PixelSNAILs, over the top codes and then over the bottom codes. What is given enters as the entries of its codes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.models.config import Config
from unshade.models.pixelsnail import PixelSNAIL
from unshade.models.vqvae import VQVAE, Codes, Residual


def repeat(codes: Codes, count: int) -> Codes:
    """Each item of (B, ...) codes ``count`` times in a row, (B * count, ...)."""
    return Codes(*(part.repeat_interleave(count, 0) for part in (codes.top, codes.bottom, codes.top_features, codes.bottom_features)))


def _reader(inputs: int, channels: int, blocks: int) -> nn.Sequential:
    """Features of what is given, not causal: all of it is known."""
    layers: list[nn.Module] = [nn.Conv2d(inputs, channels, 3, padding=1)]
    return nn.Sequential(*layers, *(Residual(channels, channels) for _ in range(blocks)), nn.ReLU())


@dataclass(frozen=True)
class Tables:
    """The entries (K, E) of both codebooks, standardised."""

    top: Tensor
    bottom: Tensor

    @classmethod
    def of(cls, vqvae: VQVAE) -> Tables:
        """Those of a VQ-VAE."""
        return cls(vqvae.top_codebook.standard(), vqvae.bottom_codebook.standard())


def _entries(numbers: Tensor, table: Tensor) -> Tensor:
    """Entries (B, E, h, w) of numbers (B, h, w)."""
    return F.embedding(numbers, table).permute(0, 3, 1, 2)


@dataclass(frozen=True)
class Entropy:
    """Mean of ``-log p`` of the true codes, in nats a code."""

    top: Tensor
    bottom: Tensor


class ChildPrior(nn.Module):
    """The distribution of one child's codes given the codes of one node (the parent) or two (and the first child)."""

    def __init__(self, config: Config, given: int) -> None:
        super().__init__()
        sizes, codes, entry = config.prior, config.vqvae.codes, config.vqvae.code_channels
        self.ratio = config.bottom // config.top
        width = sizes.condition_channels
        self.read_coarse = _reader(given * entry * (1 + self.ratio**2), width, sizes.condition_blocks)
        self.read_fine = _reader(given * entry + width + entry, width, sizes.condition_blocks)
        self.top = PixelSNAIL(config.top, codes, entry, sizes)
        self.bottom = PixelSNAIL(config.bottom, codes, entry, sizes)

    def _coarse(self, given: Sequence[Codes], tables: Tables) -> Tensor:
        """The condition of the top codes, (B, D, h, w)."""
        tops = [_entries(codes.top, tables.top) for codes in given]
        bottoms = [F.pixel_unshuffle(_entries(codes.bottom, tables.bottom), self.ratio) for codes in given]
        return self.read_coarse(torch.cat([*tops, *bottoms], 1))

    def _fine(self, given: Sequence[Codes], coarse: Tensor, top: Tensor, tables: Tables) -> Tensor:
        """The condition of the bottom codes, (B, D, H, W): also the child's own top codes (B, h, w)."""
        raised = F.interpolate(torch.cat([coarse, _entries(top, tables.top)], 1), scale_factor=float(self.ratio), mode="nearest")
        return self.read_fine(torch.cat([*(_entries(codes.bottom, tables.bottom) for codes in given), raised], 1))

    def forward(self, vqvae: VQVAE, given: Sequence[Codes], child: Codes) -> Entropy:
        """How badly the codes of ``child`` are foretold."""
        tables = Tables.of(vqvae)
        coarse = self._coarse(given, tables)
        top = self.top(child.top, tables.top, coarse)
        bottom = self.bottom(child.bottom, tables.bottom, self._fine(given, coarse, child.top, tables))
        return Entropy(F.cross_entropy(top.float(), child.top), F.cross_entropy(bottom.float(), child.bottom))

    @torch.no_grad()
    def sample(
        self, vqvae: VQVAE, given: Sequence[Codes], samples: int, generator: torch.Generator, temperature: float = 1.0, cached: bool = True
    ) -> Codes:
        """Draw children, as one batch.

        Args:
            vqvae: whose codes these are.
            given: codes of the parent, and of the first child where this is the prior of the second; (B, ...) each.
            samples: children of each of the B.
            generator, temperature: as in `PixelSNAIL.sample`.
            cached: False draws the same codes by the slow way.
        Returns:
            (B * samples, ...), the children of one parent in a row.
        """
        tables = Tables.of(vqvae)
        coarse = self._coarse(given, tables).repeat_interleave(samples, 0)
        draw_top, draw_bottom = (p.sample if cached else p.sample_uncached for p in (self.top, self.bottom))
        top = draw_top(tables.top, coarse, generator, temperature)
        fine = self._fine([repeat(codes, samples) for codes in given], coarse, top, tables)
        return vqvae.codes(top, draw_bottom(tables.bottom, fine, generator, temperature))


class Priors(nn.Module):
    """The priors of both children."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.first = ChildPrior(config, given=1)
        self.second = ChildPrior(config, given=2)

    @torch.no_grad()
    def sample_children(
        self, vqvae: VQVAE, parent: Codes, samples: int, generator: torch.Generator, temperature: float = 1.0, cached: bool = True
    ) -> tuple[Codes, Codes]:
        """Draw ``samples`` pairs of children for each of B parents: two times (B * samples, ...), those of one parent in a row."""
        left = self.first.sample(vqvae, [parent], samples, generator, temperature, cached)
        right = self.second.sample(vqvae, [repeat(parent, samples), left], 1, generator, temperature, cached)
        return left, right
