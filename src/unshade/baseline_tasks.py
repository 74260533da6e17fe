"""What each baseline learns: the CNN one step of a tree, the LSTM and the transformer whole trees in tokens."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.baseline_data import TreeBatch, TreeBatches
from unshade.models.cnn_baseline import CNNBaseline, Split
from unshade.models.lstm_baseline import LSTMBaseline
from unshade.models.token_model import TokenModel
from unshade.models.tokens import FIRST_NUMBER, tree_of
from unshade.models.transformer_baseline import TransformerBaseline
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals
from unshade.tasks import MIX, RECONSTRUCTION, SHOWN, Outcome, Task, overlap, psnr, sheet
from unshade.types import Image

if TYPE_CHECKING:
    from unshade.synthesis import Batch, Style


class CNNTask(Task["Batch"]):
    """Children, operator, mask and types of a node, at once."""

    name = "cnn"
    reads_shards = True

    def build(self) -> nn.Module:
        """See `Task`."""
        return CNNBaseline(self.config)

    def outcome(self, model: nn.Module, batch: Batch) -> Outcome:
        """Squared error of the children inside the disc, and cross entropy of the rest; the mask's only over mixes."""
        found: Split = cast(CNNBaseline, model)(batch.parent)
        disc = disc_mask(batch.parent.shape[-1], device=batch.parent.device).float()
        error = ((found.left - batch.left).square() + (found.right - batch.right).square()).mean() / (2.0 * disc.mean())
        operator = F.cross_entropy(found.operator.float(), batch.operator)
        types = F.cross_entropy(torch.cat([found.left_type, found.right_type]).float(), torch.cat([batch.left_type, batch.right_type]))
        mixed = batch.operator == MIX
        mask = error.new_zeros(())
        if bool(mixed.any()):
            weight = disc.expand_as(batch.mask[mixed])
            mask = F.binary_cross_entropy_with_logits(found.mask[mixed].float(), batch.mask[mixed], weight=weight, reduction="sum")
            mask = mask / weight.sum()
        children = torch.cat([found.left, found.right]).detach().clamp(0.0, 1.0)
        figures = {"child_psnr": psnr(children, torch.cat([batch.left, batch.right])).mean(), "operator_loss": operator.detach()}
        return Outcome(RECONSTRUCTION * error + operator + types + mask, figures)

    def evaluate(self, model: nn.Module, batches: Sequence[Batch]) -> dict[str, float]:
        """PSNR of the children, shares of right operators and types, IoU of the masks."""
        decibels, operators, types, overlaps = [], [], [], []
        for batch in batches:
            found: Split = cast(CNNBaseline, model)(batch.parent)
            decibels.append(psnr(torch.cat([found.left, found.right]).clamp(0.0, 1.0), torch.cat([batch.left, batch.right])))
            operators.append(found.operator.argmax(1) == batch.operator)
            types += [found.left_type.argmax(1) == batch.left_type, found.right_type.argmax(1) == batch.right_type]
            mixed = batch.operator == MIX
            overlaps.append(overlap(found.mask[mixed] > 0.0, batch.mask[mixed] > 0.5))
        figures = {"child_psnr": decibels, "operator": operators, "type": types, "mask_iou": overlaps}
        joined = {key: torch.cat(values).float() for key, values in figures.items()}
        return {key: float(values.mean()) for key, values in joined.items() if len(values)}

    def pictures(self, model: nn.Module, batch: Batch) -> Image:
        """Parents, and their children each above what was foretold; the mask last."""
        found: Split = cast(CNNBaseline, model)(batch.parent[:SHOWN])
        mask = found.mask.float().sigmoid() * disc_mask(batch.parent.shape[-1], device=batch.parent.device)
        children = [batch.left[:SHOWN], found.left.float(), batch.right[:SHOWN], found.right.float()]
        return sheet([batch.parent[:SHOWN], *children, batch.mask[:SHOWN], mask])


class TokenTask(Task[TreeBatch]):
    """The tokens of a tree from its picture."""

    def stream(self, style: Style, split: str, *, batch: int, seed: int, start: int = 0, workers: int = 0) -> Iterator[TreeBatch]:
        """See `Task`."""
        return TreeBatches(style, split, self.config.size, batch, seed).stream(start=start, workers=workers, device=self.device)

    def outcome(self, model: nn.Module, batch: TreeBatch) -> Outcome:
        """Mean cross entropy of a token; kinds and numbers count alike."""
        loss, right = cast(TokenModel, model)(batch.images, batch.tokens, batch.slots)
        return Outcome(loss, {"kinds_right": _right_kinds(right, batch.tokens)})

    def evaluate(self, model: nn.Module, batches: Sequence[TreeBatch]) -> dict[str, float]:
        """Of trees written from pictures alone: how near they look, and whether all of their kinds are right."""
        writer = cast(TokenModel, model)
        found: dict[str, list[Tensor]] = {"nats": [], "kinds_right": [], "structure": [], "tree_psnr": []}
        for batch in batches:
            loss, right = writer(batch.images, batch.tokens, batch.slots)
            found["nats"].append(loss[None])
            found["kinds_right"].append(_right_kinds(right, batch.tokens)[None])
            written = writer.write(batch.images)
            found["structure"].append(torch.tensor([_kinds(a) == _kinds(b) for a, b in zip(written, batch.tokens.tolist(), strict=True)]))
            found["tree_psnr"].append(psnr(drawn(written, batch.images), batch.images))
        return {key: float(torch.cat([part.float().cpu() for part in parts]).mean()) for key, parts in found.items()}

    def pictures(self, model: nn.Module, batch: TreeBatch) -> Image:
        """Pictures above the trees that were written of them."""
        images = batch.images[:SHOWN]
        return sheet([images, drawn(cast(TokenModel, model).write(images), images)])


class LSTMTask(TokenTask):
    """By an LSTM."""

    name = "lstm"

    def build(self) -> nn.Module:
        """See `Task`."""
        return LSTMBaseline(self.config)


class TransformerTask(TokenTask):
    """By a transformer."""

    name = "transformer"

    def build(self) -> nn.Module:
        """See `Task`."""
        return TransformerBaseline(self.config)


def drawn(written: Sequence[Sequence[int]], like: Image) -> Image:
    """The trees of some sequences, as large as the images."""
    normals, disc = sphere_normals(like.shape[-1]), disc_mask(like.shape[-1])
    return torch.stack([render(tree_of(tokens), normals) * disc for tokens in written]).to(like)


def _kinds(tokens: Sequence[int]) -> list[int]:
    return [token for token in tokens if 0 < token < FIRST_NUMBER]


def _right_kinds(right: Tensor, tokens: Tensor) -> Tensor:
    """Share of the tokens that are kinds which were foretold."""
    kinds = (tokens > 0) & (tokens < FIRST_NUMBER)
    return right[kinds].float().mean()
