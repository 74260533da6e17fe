"""The LSTM baseline: a picture to a vector, the vector to a tree in tokens.

After Tian et al. 2019, "Learning to Infer and Execute 3D Shape Programs".
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from unshade.models.config import Config
from unshade.models.image_encoder import ImageEncoder
from unshade.models.token_model import TokenModel
from unshade.models.tokens import VOCABULARY
from unshade.types import Image

State = tuple[Tensor, tuple[Tensor, Tensor]]
"""The picture's vector, and the LSTM's state."""


class LSTMBaseline(TokenModel):
    """The vector begins the LSTM and is told to it again at every token."""

    def __init__(self, config: Config) -> None:
        sizes = config.baselines
        width = sizes.lstm_width
        super().__init__(width)
        self.encoder = ImageEncoder(config.size, sizes.encoder_channels, width // 4)
        self.vector = nn.Sequential(nn.Flatten(), nn.Linear(width // 4 * 16, width), nn.SiLU())
        self.first = nn.Linear(width, 2 * sizes.lstm_layers * width)
        self.lstm = nn.LSTM(2 * width, width, sizes.lstm_layers, batch_first=True)
        self.decide = nn.Linear(width, VOCABULARY)
        self.layers = sizes.lstm_layers

    def begin(self, images: Image) -> State:
        """See `TokenModel`."""
        vector = self.vector(self.encoder(images))
        first = self.first(vector).tanh().unflatten(1, (2, self.layers, -1)).permute(1, 2, 0, 3)
        return vector, (first[0].contiguous(), first[1].contiguous())

    def _run(self, embedded: Tensor, state: State) -> tuple[Tensor, State]:
        vector, memory = state
        told = vector[:, None].expand(-1, embedded.shape[1], -1)
        outputs, memory = self.lstm(torch.cat([embedded, told], 2), memory)
        return self.decide(outputs), (vector, memory)

    def logits(self, images: Image, before: Tensor, slots: Tensor) -> Tensor:
        """See `TokenModel`."""
        return self._run(self.embedded(before, slots), self.begin(images))[0]

    def step(self, before: Tensor, slot: Tensor, state: State) -> tuple[Tensor, State]:
        """See `TokenModel`."""
        logits, state = self._run(self.embedded(before[:, None], slot[:, None]), state)
        return logits[:, 0], state
