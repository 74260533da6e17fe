"""Sizes of the networks and of their training, as data that can be read at a glance and is stored in every checkpoint."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any

from unshade.errors import UnshadeError, did_you_mean


class ConfigError(UnshadeError):
    """A configuration that does not exist or cannot be read."""

    exit_code = 2


@dataclass(frozen=True)
class VQVAEConfig:
    """The encoder and decoder of node images."""

    channels: int
    hidden: int
    """Channels inside a residual block."""
    blocks: int
    """Residual blocks of each encoder and decoder."""
    codes: int
    """Entries of each codebook."""
    code_channels: int
    bottom_halvings: int
    """The bottom codes are the image halved this often."""
    top_halvings: int
    """The top codes are the bottom codes halved this often."""
    commitment: float = 0.25
    decay: float = 0.97
    """Of the moving averages that are the codebook."""


@dataclass(frozen=True)
class PriorConfig:
    """One PixelSNAIL and what turns its condition into features."""

    channels: int
    blocks: int
    """Each is some gated residual layers, one causal attention, and one layer that joins the two."""
    layers: int
    """Gated residual layers of a block."""
    heads: int
    condition_channels: int
    condition_blocks: int
    dropout: float = 0.0


@dataclass(frozen=True)
class HeadsConfig:
    """The operator, mask and type networks."""

    channels: int


@dataclass(frozen=True)
class ReflectionConfig:
    """The network that tells what a picture reflects, from half of the picture's size down; every level is half of the one before."""

    channels: tuple[int, ...] = (40, 80, 128, 160)
    """Of every level, multiples of 8."""
    blocks: tuple[int, ...] = (1, 1, 2, 2)
    """Residual blocks of every level, on the way down and on the way up."""


@dataclass(frozen=True)
class BaselinesConfig:
    """The baselines, each about as large as the learned method's networks together."""

    cnn_channels: int = 44
    encoder_channels: int = 24
    """Of what the LSTM and the transformer see a picture with."""
    lstm_width: int = 416
    lstm_layers: int = 2
    gpt_width: int = 256
    gpt_layers: int = 6
    gpt_heads: int = 8


BASELINES = ("cnn", "lstm", "transformer")
"""The tasks that train them."""


@dataclass(frozen=True)
class TrainingConfig:
    """How long and how fast one model trains."""

    steps: int
    batch: int
    """Examples of a step and a process."""
    learning_rate: float
    warmup: int = 200
    decay: float = 0.4
    """Share of the steps, at the end, over which the learning rate falls to 0."""
    weight_decay: float = 0.0
    clip: float = 1.0
    """Longest gradient."""


@dataclass(frozen=True)
class Config:
    """Everything that a run needs to know apart from its seed and its device."""

    name: str
    size: int
    """Width and height of the node images."""
    vqvae: VQVAEConfig
    prior: PriorConfig
    heads: HeadsConfig
    training: dict[str, TrainingConfig] = field(default_factory=dict)
    """For each task of `unshade.train`."""
    baselines: BaselinesConfig = BaselinesConfig()
    reflection: ReflectionConfig = ReflectionConfig()

    @property
    def bottom(self) -> int:
        """Width and height of the bottom codes."""
        return self.size >> self.vqvae.bottom_halvings

    @property
    def top(self) -> int:
        """Width and height of the top codes."""
        return self.bottom >> self.vqvae.top_halvings

    def to_json(self) -> str:
        """One line that `from_json` reads."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Config:
        """Raises ConfigError for anything that `to_json` did not write."""
        try:
            data: dict[str, Any] = json.loads(text)
            return cls(
                name=str(data["name"]),
                size=int(data["size"]),
                vqvae=VQVAEConfig(**data["vqvae"]),
                prior=PriorConfig(**data["prior"]),
                heads=HeadsConfig(**data["heads"]),
                training={name: TrainingConfig(**value) for name, value in data["training"].items()},
                # Files from before there were these say nothing of them.
                baselines=BaselinesConfig(**data.get("baselines", {})),
                reflection=ReflectionConfig(**{name: tuple(value) for name, value in data.get("reflection", {}).items()}),
            )
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ConfigError(f"expected the JSON of a model configuration, got {text[:60]!r} ({error})") from None


def find(name: str) -> Config:
    """The configuration of this name. Raises ConfigError."""
    if name not in CONFIGS:
        raise ConfigError(f"unknown configuration {name!r}{did_you_mean(name, CONFIGS)}")
    return CONFIGS[name]


SMALL = Config(
    name="small",
    size=64,
    vqvae=VQVAEConfig(channels=96, hidden=48, blocks=2, codes=512, code_channels=16, bottom_halvings=2, top_halvings=1),
    prior=PriorConfig(channels=64, blocks=2, layers=3, heads=4, condition_channels=96, condition_blocks=3),
    heads=HeadsConfig(channels=32),
    training={
        "vqvae": TrainingConfig(steps=12_000, batch=12, learning_rate=1e-3),
        "prior": TrainingConfig(steps=8_000, batch=16, learning_rate=1e-3, weight_decay=0.01),
        "heads": TrainingConfig(steps=3_000, batch=32, learning_rate=1e-3, weight_decay=0.01),
        "reflection": TrainingConfig(steps=8_600, batch=32, learning_rate=1e-3, decay=0.8, weight_decay=0.01),
        "cnn": TrainingConfig(steps=8_000, batch=16, learning_rate=3e-4, weight_decay=0.01),
        "lstm": TrainingConfig(steps=8_000, batch=16, learning_rate=3e-3, weight_decay=0.01),
        "transformer": TrainingConfig(steps=8_000, batch=16, learning_rate=3e-3, weight_decay=0.01),
    },
)
"""Trains on two cores within hours; its weights ship with the package."""

PAPER = Config(
    name="paper",
    size=256,
    vqvae=VQVAEConfig(channels=128, hidden=32, blocks=2, codes=2048, code_channels=64, bottom_halvings=3, top_halvings=2),
    prior=PriorConfig(channels=256, blocks=4, layers=4, heads=8, condition_channels=256, condition_blocks=3, dropout=0.1),
    heads=HeadsConfig(channels=64),
    training={
        "vqvae": TrainingConfig(steps=200_000, batch=32, learning_rate=3e-4, warmup=1000),
        "prior": TrainingConfig(steps=200_000, batch=16, learning_rate=3e-4, warmup=1000, weight_decay=0.01),
        "heads": TrainingConfig(steps=50_000, batch=32, learning_rate=5e-4, warmup=500, weight_decay=0.01),
        "reflection": TrainingConfig(steps=200_000, batch=32, learning_rate=5e-4, warmup=1000, decay=0.8, weight_decay=0.01),
        "cnn": TrainingConfig(steps=200_000, batch=32, learning_rate=5e-4, warmup=1000, weight_decay=0.01),
        "lstm": TrainingConfig(steps=200_000, batch=32, learning_rate=5e-4, warmup=1000, weight_decay=0.01),
        "transformer": TrainingConfig(steps=200_000, batch=32, learning_rate=3e-4, warmup=1000, weight_decay=0.01),
    },
    baselines=BaselinesConfig(184, 48, 1472, 3, 768, 13, 12),
    reflection=ReflectionConfig((64, 96, 160, 224, 288, 320), (1, 1, 2, 2, 2, 2)),
)
"""The paper's sizes: 256 x 256 images, 2,048 entries, 8 x 8 top and 32 x 32 bottom codes, PixelSNAIL of 256 channels. For a GPU."""

TINY = Config(
    name="tiny",
    size=16,
    vqvae=VQVAEConfig(channels=16, hidden=8, blocks=1, codes=16, code_channels=8, bottom_halvings=2, top_halvings=1),
    prior=PriorConfig(channels=16, blocks=1, layers=1, heads=2, condition_channels=16, condition_blocks=1, dropout=0.1),
    heads=HeadsConfig(channels=8),
    training={
        "vqvae": TrainingConfig(steps=30, batch=4, learning_rate=3e-3, warmup=5),
        "prior": TrainingConfig(steps=30, batch=4, learning_rate=3e-3, warmup=5),
        "heads": TrainingConfig(steps=30, batch=4, learning_rate=3e-3, warmup=5),
        "reflection": TrainingConfig(steps=30, batch=4, learning_rate=3e-3, warmup=5),
        **{name: TrainingConfig(steps=30, batch=4, learning_rate=3e-3, warmup=5) for name in BASELINES},
    },
    baselines=BaselinesConfig(cnn_channels=8, encoder_channels=8, lstm_width=48, lstm_layers=1, gpt_width=48, gpt_layers=2, gpt_heads=4),
    reflection=ReflectionConfig((16, 24), (1, 1)),
)
"""Seconds on any machine and of no use: for tests."""

CONFIGS = {config.name: config for config in (SMALL, PAPER, TINY)}
