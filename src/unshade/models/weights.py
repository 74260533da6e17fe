"""Weights in files: safetensors with the configuration and a card in the header. Nothing is unpickled.

Parameters are stored in half precision, codebooks as they are. The files that ship lie in ``unshade/weights``, those of the baselines in
``benchmarks/weights`` of the repository.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import nn

from unshade.errors import MissingWeightsError, UnshadeError, did_you_mean
from unshade.files import write_whole
from unshade.models.cnn_baseline import CNNBaseline
from unshade.models.config import Config, ConfigError
from unshade.models.heads import Heads
from unshade.models.lstm_baseline import LSTMBaseline
from unshade.models.prior import Priors
from unshade.models.reflection import ReflectionNet
from unshade.models.transformer_baseline import TransformerBaseline
from unshade.models.vqvae import VQVAE

FOLDER = Path(__file__).resolve().parent.parent / "weights"
"""Of the weights that ship with the package."""

BASELINE_FOLDER = FOLDER.parents[2] / "benchmarks" / "weights"
"""Of the baselines, in a checkout of the repository: twice the size of the package's, and nothing but the experiments reads them."""

MODELS: dict[str, Callable[[Config], nn.Module]] = {"vqvae": VQVAE, "prior": Priors, "heads": Heads}
"""What the learned method needs; the name of a file is that of its training task."""

SEARCH: dict[str, Callable[[Config], nn.Module]] = {"reflection": ReflectionNet}
"""What the search asks about pictures that reflect."""

BASELINES: dict[str, Callable[[Config], nn.Module]] = {"cnn": CNNBaseline, "lstm": LSTMBaseline, "transformer": TransformerBaseline}
"""What it is compared with."""

WITHOUT = {
    **dict.fromkeys(MODELS, "`unshade decompose --method search` needs none"),
    **dict.fromkeys(SEARCH, "`unshade decompose --reflections lights` needs none"),
}
"""What can be had without some weights, for whoever looks for them in vain."""

_ALL = {**MODELS, **SEARCH, **BASELINES}


class WeightsError(UnshadeError):
    """A weight file that is damaged, or holds something else than expected."""

    exit_code = 6


@dataclass(frozen=True)
class Loaded:
    """A model in evaluation mode, how it is made, and what its card says."""

    model: nn.Module
    config: Config
    card: dict[str, Any]


def file_of(name: str, folder: str | os.PathLike[str] | None = None) -> Path:
    """Where the weights of a model lie, whether they do or not."""
    if name not in _ALL:
        raise WeightsError(f"unknown model {name!r}{did_you_mean(name, _ALL)}")
    return Path(folder or (BASELINE_FOLDER if name in BASELINES else FOLDER)) / f"{name}.safetensors"


def available(folder: str | os.PathLike[str] | None = None) -> bool:
    """Whether all that the learned method needs is there."""
    return all(file_of(name, folder).is_file() for name in MODELS)


def save(path: Path, name: str, model: nn.Module, config: Config, card: dict[str, Any]) -> None:
    """Write a model's weights, whole or not at all. Raises OutputError."""
    halved = {key for key, _ in model.named_parameters()}
    tensors = {key: (value.half() if key in halved else value).cpu().contiguous() for key, value in model.state_dict().items()}
    header = {"model": name, "config": config.to_json(), "card": json.dumps(card)}
    write_whole(path, safetensors.torch.save(tensors, header))


def read_card(path: Path) -> dict[str, Any]:
    """The card of a weight file: data, steps, time, hardware, figures. Raises MissingWeightsError, WeightsError."""
    return json.loads(_header(path)["card"])


def _training(name: str) -> str:
    """The command that makes the weights of a model."""
    return f"unshade train {'baseline ' * (name in BASELINES)}{name}" if name in {*BASELINES, *SEARCH} else "unshade train all"


def _header(path: Path) -> dict[str, str]:
    if not path.is_file():
        raise MissingWeightsError(f"{path}: no such weights; train them with: {_training(path.stem)}", WITHOUT.get(path.stem, ""))
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise WeightsError(f"{path}: the weight file is damaged ({error})") from None
    if not {"model", "config", "card"} <= set(header):
        raise WeightsError(
            f"{path}: expected weights that `unshade train` wrote, got a header with {', '.join(sorted(header)) or 'nothing'}"
        )
    return header


def load(name: str, folder: str | os.PathLike[str] | None = None, device: torch.device | str = "cpu") -> Loaded:
    """A trained model in float32.

    Args:
        name: vqvae, prior, heads, reflection, cnn, lstm or transformer.
        folder: of the weight files; None for those of the project.
    Raises:
        MissingWeightsError: there is no such file. WeightsError: it is damaged or of another model.
    """
    path = file_of(name, folder)
    header = _header(path)
    if header["model"] != name:
        raise WeightsError(f"{path}: expected the weights of {name}, got those of {header['model']}")
    try:
        config, card = Config.from_json(header["config"]), json.loads(header["card"])
        model = _ALL[name](config)
        tensors = safetensors.torch.load_file(path)
    except (safetensors.SafetensorError, OSError, ValueError, ConfigError) as error:
        raise WeightsError(f"{path}: the weight file is damaged ({error})") from None
    expected = model.state_dict()
    wrong = [
        key
        for key in sorted({*expected, *tensors})
        if key not in expected or key not in tensors or expected[key].shape != tensors[key].shape
    ]
    if wrong:
        raise WeightsError(f"{path}: {len(wrong)} tensors do not fit the network of this version, the first is {wrong[0]}; train again")
    model.load_state_dict(tensors)
    return Loaded(model.float().eval().requires_grad_(False).to(device), config, card)


def same_codes(a: Config, b: Config) -> bool:
    """Whether two models speak of the same codes of the same images."""
    return (a.size, dataclasses.astuple(a.vqvae)) == (b.size, dataclasses.astuple(b.vqvae))
