"""VQ-VAE-2 of node images: an encoder to two maps of codes, top and bottom, and a decoder back (the paper's E and D).

After Razavi et al. 2019, "Generating Diverse High-Fidelity Images with VQ-VAE-2": the top codes see the whole picture
coarsely, the bottom codes see it finely and what the top codes say. Codebooks are moving averages (van den Oord et al. 2017, appendix A.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.distributed
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.models.config import Config, VQVAEConfig
from unshade.sphere import disc_mask
from unshade.types import Image

DEAD = 0.03
"""A code that is drawn less often than this share of the average is dead and starts again where an input is."""


@dataclass(frozen=True)
class Codes:
    """What an image is encoded to.

    ``top`` (B, h, w) and ``bottom`` (B, H, W) are int64 numbers of codes; ``top_features`` (B, D, h, w) and ``bottom_features``
    (B, D, H, W) are their entries in the codebooks.
    """

    top: Tensor
    bottom: Tensor
    top_features: Tensor
    bottom_features: Tensor


@dataclass(frozen=True)
class Reconstruction:
    """``images`` (B, 3, S, S), not clamped, 0 outside the disc; ``commitment``, how far the encoder is from its codes; ``codes``."""

    images: Image
    commitment: Tensor
    codes: Codes


class Codebook(nn.Module):
    """The nearest of K entries for every feature; the entries follow the features as moving averages.

    All codes are dead at first, so the first batch fills the codebook.
    """

    entries: Tensor
    uses: Tensor
    sums: Tensor

    def __init__(self, codes: int, channels: int, decay: float) -> None:
        super().__init__()
        self.decay = decay
        self.register_buffer("entries", torch.zeros(codes, channels))
        self.register_buffer("uses", torch.zeros(codes))
        """Moving average of how many features of a batch each entry is drawn by."""
        self.register_buffer("sums", torch.zeros(codes, channels))

    def lookup(self, numbers: Tensor) -> Tensor:
        """Entries (B, D, h, w) of numbers (B, h, w)."""
        return F.embedding(numbers, self.entries).permute(0, 3, 1, 2)

    def standard(self) -> Tensor:
        """The entries (K, D) with mean 0 and deviation 1 in every channel, as other networks like to read them."""
        deviation, mean = torch.std_mean(self.entries, 0)
        return (self.entries - mean) / (deviation + 1e-6)

    def nearest(self, flat: Tensor) -> Tensor:
        """Numbers (N,) of the entries nearest to features (N, D)."""
        return (self.entries.square().sum(1) - 2.0 * flat @ self.entries.T).argmin(1)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features (B, D, h, w) to entries that pass gradients straight through, numbers (B, h, w), and the commitment loss."""
        with torch.autocast(features.device.type, enabled=False):
            features = features.float()
            flat = features.detach().permute(0, 2, 3, 1).reshape(-1, features.shape[1])
            if self.training:
                self._revive(flat)
            numbers = self.nearest(flat)
            shape = (features.shape[0], *features.shape[2:])
            entries = self.lookup(numbers.view(shape))
            if self.training:
                self._follow(flat, numbers)
            commitment = (features - entries).square().sum(1).mean()
            return features + (entries - features).detach(), numbers.view(shape), commitment

    @torch.no_grad()
    def _follow(self, flat: Tensor, numbers: Tensor) -> None:
        """Move every entry towards the mean of the features that drew it."""
        uses = torch.bincount(numbers, minlength=len(self.uses)).to(flat)
        sums = torch.zeros_like(self.sums).index_add_(0, numbers, flat)
        for total in (uses, sums):
            _add_processes(total)
        self.uses.lerp_(uses, 1.0 - self.decay)
        self.sums.lerp_(sums, 1.0 - self.decay)
        self.entries.copy_(self.sums / self.uses.clamp(min=1e-6)[:, None])

    @torch.no_grad()
    def _revive(self, flat: Tensor) -> None:
        """Put dead entries where features of this batch are."""
        total = float(self.uses.sum())
        dead = self.uses <= DEAD * total / len(self.uses)
        if not bool(dead.any()):
            return
        chosen = flat[torch.randint(len(flat), (int(dead.sum()),), device=flat.device)].contiguous()
        if torch.distributed.is_initialized():
            torch.distributed.broadcast(chosen, 0)
        # A fresh entry counts as drawn an average share of the time, so that it has time to prove itself.
        share = (total or float(len(flat))) / len(self.uses)
        self.uses[dead] = share
        self.sums[dead] = chosen * share
        self.entries[dead] = chosen


def _add_processes(total: Tensor) -> None:
    if torch.distributed.is_initialized():
        torch.distributed.all_reduce(total)


class Residual(nn.Module):
    """``x + conv1(relu(conv3(relu(x))))``."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.spread = nn.Conv2d(channels, hidden, 3, padding=1)
        self.join = nn.Conv2d(hidden, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same."""
        return x + self.join(F.relu(self.spread(F.relu(x))))


def _widths(inner: int, halvings: int) -> list[int]:
    """Channels before each halving but the first and after the last: narrower while the picture is large."""
    return [max(inner >> (halvings - k), 8) for k in range(1, halvings + 1)]


def _encoder(inputs: int, config: VQVAEConfig, halvings: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in _widths(config.channels, halvings):
        layers += [nn.Conv2d(inputs, width, 4, stride=2, padding=1), nn.ReLU()]
        inputs = width
    layers.append(nn.Conv2d(inputs, config.channels, 3, padding=1))
    layers += [Residual(config.channels, config.hidden) for _ in range(config.blocks)]
    return nn.Sequential(*layers, nn.ReLU())


def _decoder(inputs: int, config: VQVAEConfig, halvings: int, outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = [nn.Conv2d(inputs, config.channels, 3, padding=1)]
    layers += [Residual(config.channels, config.hidden) for _ in range(config.blocks)]
    before = config.channels
    for width in [*_widths(config.channels, halvings)[-2::-1], outputs]:
        layers += [nn.ReLU(), nn.ConvTranspose2d(before, width, 4, stride=2, padding=1)]
        before = width
    return nn.Sequential(*layers)


class VQVAE(nn.Module):
    """Node images to codes and back. Images are (B, 3, S, S) in [0, 1] with the S of its configuration."""

    disc: Tensor

    def __init__(self, config: Config) -> None:
        super().__init__()
        sizes = config.vqvae
        self.size = config.size
        self.commitment = sizes.commitment
        self.encode_bottom = _encoder(3, sizes, sizes.bottom_halvings)
        self.encode_top = _encoder(sizes.channels, sizes, sizes.top_halvings)
        self.to_top = nn.Conv2d(sizes.channels, sizes.code_channels, 1)
        self.top_codebook = Codebook(sizes.codes, sizes.code_channels, sizes.decay)
        self.decode_top = _decoder(sizes.code_channels, sizes, sizes.top_halvings, sizes.code_channels)
        self.to_bottom = nn.Conv2d(sizes.channels + sizes.code_channels, sizes.code_channels, 1)
        self.bottom_codebook = Codebook(sizes.codes, sizes.code_channels, sizes.decay)
        self.decode_both = _decoder(sizes.code_channels * 2, sizes, sizes.bottom_halvings, 3)
        self.register_buffer("disc", disc_mask(config.size).float(), persistent=False)

    def _encode(self, images: Image) -> tuple[Codes, Tensor]:
        if images.ndim != 4 or images.shape[1:] != (3, self.size, self.size):
            raise ValueError(f"VQVAE: expected (B, 3, {self.size}, {self.size}) images, got {tuple(images.shape)}")
        fine = self.encode_bottom(2.0 * images - 1.0)
        top_features, top, top_commitment = self.top_codebook(self.to_top(self.encode_top(fine)))
        told = self.decode_top(top_features)
        bottom_features, bottom, bottom_commitment = self.bottom_codebook(self.to_bottom(torch.cat([fine, told], 1)))
        return Codes(top, bottom, top_features, bottom_features), top_commitment + bottom_commitment

    def _decode(self, codes: Codes) -> Image:
        coarse = F.interpolate(codes.top_features, size=codes.bottom_features.shape[-2:], mode="nearest")
        images = self.decode_both(torch.cat([coarse, codes.bottom_features], 1))
        return (0.5 + 0.5 * images.float()) * self.disc

    def encode(self, images: Image) -> Codes:
        """The codes of images (B, 3, S, S). Raises ValueError for another shape."""
        return self._encode(images)[0]

    def codes(self, top: Tensor, bottom: Tensor) -> Codes:
        """Codes from their numbers (B, h, w) and (B, H, W), such as a prior draws."""
        return Codes(top, bottom, self.top_codebook.lookup(top), self.bottom_codebook.lookup(bottom))

    def decode(self, codes: Codes) -> Image:
        """Images (B, 3, S, S) in [0, 1] of codes, 0 outside the disc."""
        return self._decode(codes).clamp(0.0, 1.0)

    def forward(self, images: Image) -> Reconstruction:
        """Encode and decode; in training mode the codebooks follow."""
        codes, commitment = self._encode(images)
        return Reconstruction(self._decode(codes), commitment, codes)


@dataclass(frozen=True)
class CodebookUse:
    """How much of a codebook some codes use: entries drawn at all, and the perplexity (the codebook's size if all are drawn alike)."""

    used: int
    perplexity: float


def codebook_use(numbers: Tensor, codes: int) -> CodebookUse:
    """Of numbers of any shape, for a codebook of ``codes`` entries."""
    shares = torch.bincount(numbers.flatten(), minlength=codes).double()
    shares = shares[shares > 0] / shares.sum()
    return CodebookUse(len(shares), float(torch.exp(-(shares * shares.log()).sum())))
