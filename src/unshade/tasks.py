"""What each model learns: its loss, its figures on unseen nodes, and the pictures that show how far it is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.blend import mix
from unshade.errors import UnshadeError
from unshade.models import weights
from unshade.models.config import Config
from unshade.models.heads import Heads
from unshade.models.prior import Priors
from unshade.models.vqvae import VQVAE, Codes, codebook_use
from unshade.sphere import SCORED_RADIUS, disc_mask
from unshade.types import Image, Mask

if TYPE_CHECKING:
    from unshade.synthesis import Batch, Style

RECONSTRUCTION = 20.0
"""Weight of the mean squared error beside the commitment: about one over the variance of node images."""

SHOWN = 8
"""Examples on a sheet of pictures."""


Data = TypeVar("Data")
"""A batch of what a task learns from: `synthesis.Batch` of most."""


@dataclass(frozen=True)
class Outcome:
    """What a step is about: the loss to descend, and figures to watch."""

    loss: Tensor
    figures: dict[str, Tensor]


class Task(ABC, Generic[Data]):
    """One training task. Add another by a subclass and a line in `train.TASKS`.

    ``config`` gives the sizes, ``folder`` holds the weights of models that were trained before, ``device`` is where it all happens.
    """

    name: str
    data = "unshade.synthesis"
    """Where its examples are from, for the card of its weights."""
    reads_shards = False
    """Whether it learns from a `synthesis.Batch`, which shards hold as well."""

    def __init__(self, config: Config, folder: Path, device: torch.device) -> None:
        self.config, self.folder, self.device = config, folder, device

    @abstractmethod
    def build(self) -> nn.Module:
        """The model with fresh weights, from torch's seed."""

    def stream(self, style: Style, split: str, *, batch: int, seed: int, start: int = 0, workers: int = 0) -> Iterator[Data]:
        """Endless batches from batch ``start``; batch k depends on (style, split, batch, seed, k) alone."""
        from unshade.synthesis import batches

        options: dict[str, Any] = {"size": self.config.size, "batch": batch, "seed": seed, "start": start, "workers": workers}
        return cast("Iterator[Data]", batches(style, split, **options, device=self.device))

    @abstractmethod
    def outcome(self, model: nn.Module, batch: Data) -> Outcome:
        """The loss of a batch; may draw from torch's seed."""

    @abstractmethod
    def evaluate(self, model: nn.Module, batches: Sequence[Data]) -> dict[str, float]:
        """Figures on unseen nodes; the model is in evaluation mode and gradients are off."""

    @abstractmethod
    def pictures(self, model: nn.Module, batch: Data) -> Image:
        """One sheet (3, H, W) that a person can judge by, in the same conditions."""

    def notes(self) -> list[str]:
        """What a person should know before it starts."""
        return []


def psnr(a: Image, b: Image, where: Mask | None = None) -> Tensor:
    """`metrics.psnr` of each pair of (B, 3, S, S) images, (B,), at most 100 dB; of some pixels (B, 1, S, S) bool alone where given."""
    disc = disc_mask(a.shape[-1], SCORED_RADIUS, a.device)
    inside = disc[None] if where is None else disc & where
    error = ((a.float() - b.float()) * inside).square().sum((1, 2, 3)) / (3.0 * inside.sum((1, 2, 3)).clamp(min=1))
    return -10.0 * torch.log10(error + 1e-10)


def sheet(rows: Sequence[Image]) -> Image:
    """Rows of (N, C, S, S) images below each other, (3, H, W)."""
    return torch.cat([torch.cat(list(row.expand(-1, 3, -1, -1).clamp(0.0, 1.0)), 2) for row in rows], 1)


def _images(batch: Batch) -> Image:
    return torch.cat([batch.parent, batch.left, batch.right])


class VQVAETask(Task):
    """Encode and decode every node image of a batch, parents and children."""

    name = "vqvae"
    reads_shards = True

    def build(self) -> nn.Module:
        """See `Task`."""
        return VQVAE(self.config)

    def outcome(self, model: nn.Module, batch: Batch) -> Outcome:
        """Mean squared error inside the disc, and the encoder's commitment to its codes."""
        vqvae, images = cast(VQVAE, model), _images(batch)
        made = vqvae(images)
        error = (images - made.images).square().mean() / vqvae.disc.mean()
        loss = RECONSTRUCTION * error + vqvae.commitment * made.commitment
        return Outcome(loss, {"psnr": psnr(made.images.detach().clamp(0.0, 1.0), images).mean(), "commitment": made.commitment.detach()})

    def evaluate(self, model: nn.Module, batches: Sequence[Batch]) -> dict[str, float]:
        """PSNR over parents and over all nodes, its worst tenth, and the use of both codebooks."""
        vqvae = cast(VQVAE, model)
        found: dict[str, list[Tensor]] = {"all": [], "parent": [], "top": [], "bottom": []}
        for batch in batches:
            images = _images(batch)
            codes = vqvae.encode(images)
            decibels = psnr(vqvae.decode(codes), images)
            found["all"].append(decibels)
            found["parent"].append(decibels[: len(batch.parent)])
            found["top"].append(codes.top.flatten())
            found["bottom"].append(codes.bottom.flatten())
        everything = {key: torch.cat(parts) for key, parts in found.items()}
        figures = {
            "psnr": float(everything["all"].mean()),
            "psnr_worst_tenth": float(everything["all"].quantile(0.1)),
            "psnr_parents": float(everything["parent"].mean()),
        }
        for level in ("top", "bottom"):
            use = codebook_use(everything[level], self.config.vqvae.codes)
            figures |= {f"{level}_codes_used": use.used, f"{level}_perplexity": use.perplexity}
        return figures

    def pictures(self, model: nn.Module, batch: Batch) -> Image:
        """Parents and children, each above its reconstruction."""
        vqvae, rows = cast(VQVAE, model), []
        for images in (batch.parent, batch.left, batch.right):
            rows += [images[:SHOWN], vqvae.decode(vqvae.encode(images[:SHOWN]))]
        return sheet(rows)


def _trained_vqvae(task: Task) -> VQVAE:
    """The encoder and decoder that another task stands on."""
    loaded = weights.load("vqvae", task.folder, task.device)
    if not weights.same_codes(loaded.config, task.config):
        raise UnshadeError(
            f"{weights.file_of('vqvae', task.folder)}: the VQ-VAE is of configuration {loaded.config.name!r} and does not fit "
            f"{task.config.name!r}; train it first with: unshade train vqvae --config {task.config.name}"
        )
    return cast(VQVAE, loaded.model)


class PriorTask(Task):
    """Foretell the codes of the first child from those of the parent, and of the second from both."""

    name = "prior"
    reads_shards = True

    def __init__(self, config: Config, folder: Path, device: torch.device) -> None:
        super().__init__(config, folder, device)
        self.vqvae = _trained_vqvae(self)

    def build(self) -> nn.Module:
        """See `Task`."""
        return Priors(self.config)

    def _codes(self, batch: Batch) -> tuple[Codes, Codes, Codes]:
        with torch.no_grad():
            codes = self.vqvae.encode(_images(batch))
        parts = [part.chunk(3) for part in (codes.top, codes.bottom, codes.top_features, codes.bottom_features)]
        parent, left, right = (Codes(*(part[k] for part in parts)) for k in range(3))
        return parent, left, right

    def _entropies(self, model: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Nats a code of each of the four maps."""
        priors = cast(Priors, model)
        parent, left, right = self._codes(batch)
        first, second = priors.first(self.vqvae, [parent], left), priors.second(self.vqvae, [parent, left], right)
        return {"first_top": first.top, "first_bottom": first.bottom, "second_top": second.top, "second_bottom": second.bottom}

    def outcome(self, model: nn.Module, batch: Batch) -> Outcome:
        """The sum of the four mean entropies."""
        entropies = self._entropies(model, batch)
        return Outcome(torch.stack(list(entropies.values())).sum(), {key: value.detach() for key, value in entropies.items()})

    def evaluate(self, model: nn.Module, batches: Sequence[Batch]) -> dict[str, float]:
        """The four entropies, in nats a code."""
        found = [self._entropies(model, batch) for batch in batches]
        return {key: float(torch.stack([one[key] for one in found]).mean()) for key in found[0]}

    def pictures(self, model: nn.Module, batch: Batch) -> Image:
        """Parents, their true children, and below them children drawn twice."""
        priors, samples = cast(Priors, model), 2
        generator = torch.Generator(self.device).manual_seed(0)
        left, right = priors.sample_children(self.vqvae, self.vqvae.encode(batch.parent[:SHOWN]), samples, generator)
        drawn = [self.vqvae.decode(child).unflatten(0, (-1, samples)) for child in (left, right)]
        return sheet(
            [batch.parent[:SHOWN], batch.left[:SHOWN], batch.right[:SHOWN], *(child[:, k] for k in range(samples) for child in drawn)]
        )


class HeadsTask(Task):
    """Read operators, masks and types, from true images and from such as the decoder makes."""

    name = "heads"
    reads_shards = True

    def __init__(self, config: Config, folder: Path, device: torch.device) -> None:
        super().__init__(config, folder, device)
        self.vqvae = _trained_vqvae(self) if weights.file_of("vqvae", folder).is_file() else None

    def notes(self) -> list[str]:
        """See `Task`."""
        return [] if self.vqvae else [f"no VQ-VAE in {self.folder} yet: the heads learn from true images only, not from decoded ones"]

    def build(self) -> nn.Module:
        """See `Task`."""
        return Heads(self.config)

    def _decoded(self, images: Image) -> Image:
        """What the decoder makes of images."""
        assert self.vqvae is not None
        with torch.no_grad():
            return self.vqvae.decode(self.vqvae.encode(images))

    def _mixed(self, batch: Batch) -> list[Image]:
        """Parent, left and right, half of the children and a quarter of the parents decoded."""
        images = [batch.parent, batch.left, batch.right]
        if self.vqvae is None:
            return images
        shares = (0.25, 0.5, 0.5)
        chosen = [torch.rand(len(image), device=image.device) < share for image, share in zip(images, shares, strict=True)]
        decoded = self._decoded(torch.cat([image[which] for image, which in zip(images, chosen, strict=True)]))
        parts = decoded.split([int(which.sum()) for which in chosen])
        return [image.index_put((which,), part.to(image)) for image, which, part in zip(images, chosen, parts, strict=True)]

    def outcome(self, model: nn.Module, batch: Batch) -> Outcome:
        """Cross entropy of each head; the mask's only over mixes."""
        heads = cast(Heads, model)
        parent, left, right = self._mixed(batch)
        operator = F.cross_entropy(heads.operator(parent, left, right).float(), batch.operator)
        type_ = F.cross_entropy(heads.types(torch.cat([parent, left, right])).float(), _types(batch))
        mixed = batch.operator == MIX
        mask = parent.new_zeros(())
        if bool(mixed.any()):
            logits = heads.mask(parent[mixed], left[mixed], right[mixed]).float()
            disc = disc_mask(parent.shape[-1], device=parent.device).float().expand_as(logits)
            mask = F.binary_cross_entropy_with_logits(logits, batch.mask[mixed], weight=disc, reduction="sum") / disc.sum()
        loss = operator + type_ + mask
        return Outcome(loss, {"operator_loss": operator.detach(), "type_loss": type_.detach(), "mask_loss": mask.detach()})

    def evaluate(self, model: nn.Module, batches: Sequence[Batch]) -> dict[str, float]:
        """Share of right operators and types, and the mean IoU of masks: of true nodes, and with decoded children."""
        figures = _judged(cast(Heads, model), [(batch, batch.left, batch.right) for batch in batches])
        if self.vqvae is not None:
            decoded = [(batch, self._decoded(batch.left), self._decoded(batch.right)) for batch in batches]
            figures |= {f"{key}_decoded": value for key, value in _judged(cast(Heads, model), decoded).items()}
        return figures

    def pictures(self, model: nn.Module, batch: Batch) -> Image:
        """Parents, children, the parent's mask where it is a mix, and the mask that g sees for every example."""
        mask = cast(Heads, model).mask(batch.parent[:SHOWN], batch.left[:SHOWN], batch.right[:SHOWN]).float().sigmoid()
        disc = disc_mask(mask.shape[-1], device=mask.device)
        return sheet([batch.parent[:SHOWN], batch.left[:SHOWN], batch.right[:SHOWN], batch.mask[:SHOWN], (mask > 0.5) * disc])


MIX = 2
"""Number of `mix` among the operators of `synthesis`."""


def _types(batch: Batch) -> Tensor:
    """Types of parents, which are operators, and of children."""
    return torch.cat([torch.zeros_like(batch.left_type), batch.left_type, batch.right_type])


def _judged(heads: Heads, cases: Sequence[tuple[Batch, Image, Image]]) -> dict[str, float]:
    """How often the heads are right about parents and these children; ``type_balanced`` counts every type alike, however rare."""
    operators, types, truths, overlaps, errors = [], [], [], [], []
    for batch, left, right in cases:
        operators.append(heads.operator(batch.parent, left, right).argmax(1) == batch.operator)
        types.append(heads.types(torch.cat([left, right])).argmax(1))
        truths.append(torch.cat([batch.left_type, batch.right_type]))
        mixed = batch.operator == MIX
        if bool(mixed.any()):
            parent, left, right, truth = batch.parent[mixed], left[mixed], right[mixed], batch.mask[mixed] > 0.5
            found = heads.mask(parent, left, right) > 0.0
            overlaps.append(overlap(found, truth))
            errors.append(psnr(mix(left, right, found.float()), parent))
    truth, right_type = torch.cat(truths), torch.cat(types) == torch.cat(truths)
    recalls = [right_type[truth == kind].float().mean() for kind in truth.unique()]
    figures = {
        "operator": float(torch.cat(operators).float().mean()),
        "type": float(right_type.float().mean()),
        "type_balanced": float(torch.stack(recalls).mean()),
    }
    if overlaps:
        figures |= {"mask_iou": float(torch.cat(overlaps).mean()), "mix_psnr": float(torch.cat(errors).mean())}
    return figures


def overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union inside the disc of masks (B, 1, S, S) bool, (B,); 1 where both are empty."""
    disc = disc_mask(a.shape[-1], device=a.device)
    union = ((a | b) & disc).sum((1, 2, 3))
    return torch.where(union > 0, (a & b & disc).sum((1, 2, 3)) / union.clamp(min=1), torch.ones_like(union, dtype=torch.float32))
