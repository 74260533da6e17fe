"""The state of a training run on disk: everything that its next step depends on, in one file that is always whole.

A safetensors file: the model's and the optimiser's tensors, and the rest as JSON in the header. Randomness needs no state: that of a step
depends on the seed and the step's number alone.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from unshade.errors import UnshadeError
from unshade.files import write_whole
from unshade.models.config import BASELINES, Config, ConfigError

FREE = ("steps", "learning_rate", "warmup", "decay", "weight_decay", "clip")
"""What of a training may change on the way."""


class CheckpointError(UnshadeError):
    """A training state that is damaged, or belongs to another run."""


@dataclass
class Position:
    """How far a run is: ``step`` steps done in ``seconds``; the losses since the last report add up to ``loss_sum`` over ``loss_count``."""

    step: int = 0
    seconds: float = 0.0
    loss_sum: float = 0.0
    loss_count: int = 0


@dataclass(frozen=True)
class Identity:
    """What must be the same for a run to go on."""

    task: str
    config: Config
    style: str
    seed: int
    precision: str
    processes: int
    shards: str = "none"
    """Which written examples it learns from, if not from the grammar."""

    def header(self) -> dict[str, str]:
        """As strings, for a file."""
        return {
            "task": self.task,
            "config": self.config.to_json(),
            "style": self.style,
            "seed": str(self.seed),
            "precision": self.precision,
            "processes": str(self.processes),
            "shards": self.shards,
        }


def save(path: Path, model: nn.Module, optimizer: torch.optim.Optimizer, position: Position, identity: Identity) -> None:
    """Write the state, whole or not at all. Raises OutputError."""
    tensors = {f"model.{key}": value for key, value in model.state_dict().items()}
    for number, values in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{number}.{key}": value for key, value in values.items()}
    header = identity.header() | {"position": json.dumps(vars(position))}
    write_whole(path, safetensors.torch.save({key: value.detach().cpu().contiguous() for key, value in tensors.items()}, header))


def resume(path: Path, model: nn.Module, optimizer: torch.optim.Optimizer, identity: Identity) -> tuple[Position, list[str]]:
    """Put the state of a file into a model and its optimiser.

    The steps and rates of training may have been changed since; sizes, batch, style, seed, precision and processes may not.

    Returns:
        Where the run is, and what of its training was changed since, as ``learning_rate 0.001 instead of 0.003``.
    Raises:
        CheckpointError: the file is damaged, or of another run.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header: dict[str, str] = file.metadata() or {}
        tensors = safetensors.torch.load_file(path)
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{path}: the training state is damaged ({error}); delete it to begin again") from None
    changes = _check(path, header, identity)
    try:
        model.load_state_dict({key.removeprefix("model."): value for key, value in tensors.items() if key.startswith("model.")})
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith("optimizer."):
                _, number, name = key.split(".", 2)
                state.setdefault(int(number), {})[name] = value
        optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
        return Position(**json.loads(header["position"])), changes
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(f"{path}: the training state does not fit this version ({reason}); delete it to begin again") from None


def _check(path: Path, header: dict[str, str], identity: Identity) -> list[str]:
    """What may have been changed and was. Raises CheckpointError for what may not."""
    wanted, header = identity.header(), {"shards": "none", **header}
    wrong = [f"{key} {header.get(key)}, not {wanted[key]}" for key in wanted if key != "config" and header.get(key) != wanted[key]]
    try:
        was = _settings(Config.from_json(header.get("config", "")), identity.task)
    except ConfigError as error:
        raise CheckpointError(f"{path}: the training state is damaged ({error}); delete it to begin again") from None
    now, changes = _settings(identity.config, identity.task), []
    for name in (name for name in was | now if was.get(name) != now.get(name)):
        if name in FREE:
            changes.append(f"{name} {now[name]} instead of {was[name]}")
        else:
            wrong.append(f"{name} {was.get(name)}, not {now.get(name)}")
    if wrong:
        raise CheckpointError(f"{path}: this run was begun with {'; '.join(wrong)}; go on as it began, or choose another folder")
    return changes


def _settings(config: Config, task: str) -> dict[str, Any]:
    """What of a configuration a task depends on: ``size``, ``batch``, ``vqvae.codes`` and so on. Raises ConfigError."""
    if task not in config.training:
        raise ConfigError(f"no training of {task}")
    parts = ("baselines",) if task in BASELINES else ("reflection",) if task == "reflection" else ("vqvae", "prior", "heads")
    sizes = {f"{part}.{name}": value for part in parts for name, value in vars(getattr(config, part)).items()}
    return {"size": config.size, **sizes, **vars(config.training[task])}
