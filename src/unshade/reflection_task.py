"""What the network of reflections learns: the environment in a picture, and the picture without it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from unshade.models.reflection import ReflectionNet
from unshade.reflection_data import ReflectionBatch, ReflectionBatches
from unshade.sphere import disc_mask
from unshade.tasks import SHOWN, Outcome, Task, psnr, sheet
from unshade.types import Image, Mask

if TYPE_CHECKING:
    from unshade.synthesis import Style

SMOOTHED = 1e-5
"""Added to squared errors under a root: errors far over its own root, 0.32 % of the range, count as absolute ones, those far under it as
squares."""


class ReflectionTask(Task[ReflectionBatch]):
    """Take pictures of whole trees apart into environment and plain picture."""

    name = "reflection"
    data = "unshade.reflection_data"

    def build(self) -> nn.Module:
        """See `Task`."""
        return ReflectionNet(self.config)

    def stream(self, style: Style, split: str, *, batch: int, seed: int, start: int = 0, workers: int = 0) -> Iterator[ReflectionBatch]:
        """See `Task`."""
        return ReflectionBatches(style, split, self.config.size, batch, seed).stream(start=start, workers=workers, device=self.device)

    def outcome(self, model: nn.Module, batch: ReflectionBatch) -> Outcome:
        """Absolute errors of both pictures, where there is anything to tell them by."""
        environment, plain = cast(ReflectionNet, model)(batch.pictures)
        shows, shines_through = _where(batch, 0.01), _under(1.0 - batch.environments, 0.02)
        found = _error(environment, batch.environments, shows) + _error(plain, batch.plain, shines_through)
        figures = {"plain_psnr": psnr(plain.detach(), batch.plain).mean()}
        return Outcome(found, figures)

    def evaluate(self, model: nn.Module, batches: Sequence[ReflectionBatch]) -> dict[str, float]:
        """PSNR of environments, of plain pictures under one, and of pictures that reflect nothing."""
        found: dict[str, list[Tensor]] = {"environment_psnr": [], "plain_psnr": [], "untouched_psnr": []}
        for batch in batches:
            environment, plain = cast(ReflectionNet, model)(batch.pictures)
            reflects = batch.environments.amax((1, 2, 3)) > 0.0
            decibels = psnr(plain, batch.plain)
            found["environment_psnr"].append(psnr(environment, batch.environments, _where(batch, 0.05))[reflects])
            found["plain_psnr"].append(decibels[reflects])
            found["untouched_psnr"].append(decibels[~reflects])
        joined = {key: torch.cat(parts) for key, parts in found.items()}
        return {key: float(values.mean()) for key, values in joined.items() if len(values)}

    def pictures(self, model: nn.Module, batch: ReflectionBatch) -> Image:
        """Pictures; the plain pictures in them and those found; the environments and those found."""
        shown = ReflectionBatch(batch.pictures[:SHOWN], batch.environments[:SHOWN])
        environment, plain = cast(ReflectionNet, model)(shown.pictures)
        return sheet([shown.pictures, shown.plain, plain, shown.environments, environment])


def _where(batch: ReflectionBatch, least: float) -> Mask:
    """Pixels whose environment shows: the plain picture leaves at least so much of every channel to it."""
    return _under(1.0 - batch.plain, least)


def _under(room: Image, least: float) -> Mask:
    return (room.amin(1, keepdim=True) > least) & disc_mask(room.shape[-1], device=room.device)


def _error(found: Image, true: Image, where: Mask) -> Tensor:
    """Mean over the disc of absolute errors at some of its pixels, smooth at 0."""
    errors = ((found - true).square() + SMOOTHED).sqrt() * where
    return errors.sum() / (3.0 * len(found) * disc_mask(found.shape[-1]).sum())
