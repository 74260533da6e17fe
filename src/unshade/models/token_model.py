"""A network that writes a tree token by token, given a picture: what the LSTM and the transformer baseline share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unshade.models.tokens import ALLOWED, BINS, FIRST_NUMBER, LONGEST, SLOTS, START, VOCABULARY, Cursor
from unshade.types import Image

NEAR = 2.0
"""Bins over which a wrong number falls to 1/e of the right one's share in the loss: nearly right is nearly as good."""


def targets() -> Tensor:
    """(vocabulary, vocabulary): what to foretell for each token; for a number also its neighbours."""
    table = torch.eye(VOCABULARY)
    bins = torch.arange(BINS)
    near = torch.exp(-(bins[:, None] - bins).abs() / NEAR)
    near[(bins[:, None] - bins).abs() > 8] = 0.0
    table[FIRST_NUMBER:, FIRST_NUMBER:] = near / near.sum(1, keepdim=True)
    return table


class TokenModel(nn.Module, ABC):
    """Subclasses say how a picture and the tokens before lead to the logits of the next."""

    allowed: Tensor
    targets: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("allowed", ALLOWED.clone(), persistent=False)
        self.register_buffer("targets", targets(), persistent=False)
        self.before = nn.Embedding(VOCABULARY, width)
        """Of the token before."""
        self.slot = nn.Embedding(len(SLOTS), width)
        """Of what comes next."""

    def embedded(self, before: Tensor, slots: Tensor) -> Tensor:
        """(B, L) each, to (B, L, width)."""
        return self.before(before) + self.slot(slots)

    @abstractmethod
    def logits(self, images: Image, before: Tensor, slots: Tensor) -> Tensor:
        """(B, L, vocabulary) from images (B, 3, S, S), the tokens before (B, L) and the slots to fill (B, L)."""

    @abstractmethod
    def begin(self, images: Image) -> Any:
        """What `step` needs to know before the first token."""

    @abstractmethod
    def step(self, before: Tensor, slot: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Logits (B, vocabulary) of the next token and the state after it; ``before`` and ``slot`` are (B,)."""

    def forward(self, images: Image, tokens: Tensor, slots: Tensor) -> tuple[Tensor, Tensor]:
        """The loss, and which tokens were foretold.

        Args:
            images: (B, 3, S, S). tokens, slots: (B, L); after its end a tree is filled with `START`.
        Returns:
            Mean nats a token against the softened targets, and (B, L) bool.
        """
        before = F.pad(tokens[:, :-1], (1, 0), value=START)
        logits = self.logits(images, before, slots).float().masked_fill(~self.allowed[slots], -1e9)
        counts = tokens != START
        losses = -(self.targets[tokens] * F.log_softmax(logits, 2)).sum(2)
        return (losses * counts).sum() / counts.sum(), (logits.argmax(2) == tokens) & counts

    @torch.no_grad()
    def write(self, images: Image) -> list[list[int]]:
        """The most likely token after the most likely token, among those that can still become a tree."""
        cursors = [Cursor() for _ in images]
        before = torch.full((len(images),), START, device=images.device)
        state = self.begin(images)
        for _ in range(LONGEST):
            if all(cursor.done for cursor in cursors):
                break
            slots = torch.tensor([cursor.slot for cursor in cursors], device=images.device)
            logits, state = self.step(before, slots, state)
            fits = torch.stack([cursor.allowed() for cursor in cursors]).to(images.device)
            before = logits.float().masked_fill(~fits, -torch.inf).argmax(1)
            for cursor, token in zip(cursors, before.tolist(), strict=True):
                if not cursor.done:
                    cursor.push(token)
        return [cursor.tokens for cursor in cursors]
