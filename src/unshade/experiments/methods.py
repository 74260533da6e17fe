"""The methods of the experiments by name.

- ``cnn``, ``lstm``, ``transformer``: the baselines; with ``+fit`` our fit of the whole tree goes over what they found.
- ``learned``: the paper's stages, and a second look of ours; ``learned:base``, ``learned:samples``, ``learned:second``,
  ``learned:overall`` and ``learned`` itself (``learned:full`` is the same) are its ablation; ``learned:alone`` has no second
  stage, ``learned:depth`` the paper's own, minutes a picture.
- ``search:PRESET``, ``hybrid:PRESET``: ours; with ``+reflections`` a reflected environment is held as a picture.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, cast

from unshade import baselines, learned, pruning, second_stage
from unshade.decompose import Decomposition, decompose, fit
from unshade.errors import MissingWeightsError, UnshadeError, did_you_mean
from unshade.inference import Inference
from unshade.learned import Settings
from unshade.models import weights
from unshade.nodes import Tree
from unshade.pictures import SphereImage
from unshade.presets import PRESETS

NETWORKS = ("learned", "hybrid")

VARIANTS: dict[str, Settings] = {
    "base": Settings(Inference(samples=1), second_stage="none", overall=False),
    "samples": Settings(second_stage="none", overall=False),
    "second": Settings(in_place=False, overall=False),
    "overall": Settings(in_place=False),
    "full": Settings(),
    "alone": Settings(second_stage="none"),
    "depth": Settings(second_stage="depth"),
}
"""Of ``learned``: one sample; several; the second stage; the optimisation of the whole tree, which makes all stages of the
paper; a second look at nodes in their place, which is ours and the default. ``alone`` is all but the second stage, so that no
search helps the networks; ``depth`` has the paper's second stage."""

FIT = "+fit"

REFLECTIONS = "+reflections"


@dataclass(frozen=True)
class Outcome:
    """What a method found; ``curve`` is (values, psnr) of its family, ``stages`` what networks did."""

    tree: Tree
    curve: tuple[tuple[int, float], ...] = ()
    stages: dict[str, Any] | None = None


@dataclass(frozen=True)
class Name:
    """A method's name, taken apart."""

    kind: str
    argument: str
    fitted: bool
    reflecting: bool


def name_of(method: str) -> Name:
    """Raises UnshadeError with the nearest known word."""
    kind, _, argument = method.removesuffix(FIT).removesuffix(REFLECTIONS).partition(":")
    fitted, reflecting = method.endswith(FIT), method.endswith(REFLECTIONS)
    known: dict[str, list[str]] = {
        **{name: [] for name in baselines.NAMES},
        "learned": [*VARIANTS],
        "search": [*PRESETS],
        "hybrid": [*PRESETS],
    }
    if kind not in known:
        raise UnshadeError(f"unknown method {method!r}{did_you_mean(kind, known)}")
    if argument and argument not in known[kind]:
        raise UnshadeError(f"method {method!r}: {kind} takes {', '.join(known[kind]) or 'nothing'} after a colon")
    if fitted and kind not in baselines.NAMES:
        raise UnshadeError(f"method {method!r}: only the baselines are not fitted already")
    if reflecting and kind in baselines.NAMES:
        raise UnshadeError(f"method {method!r}: the baselines hold no reflections")
    return Name(kind, argument, fitted, reflecting)


def missing(method: str, folder: Path | None) -> str | None:
    """Why a method cannot run, or None."""
    name = name_of(method)
    for model in _models(name):
        try:
            weights.read_card(weights.file_of(model, folder))
        except (MissingWeightsError, weights.WeightsError) as error:
            return str(error)
    return None


def _models(name: Name) -> tuple[str, ...]:
    own = tuple(weights.MODELS) if name.kind in NETWORKS else (name.kind,) if name.kind in baselines.NAMES else ()
    return (*own, *weights.SEARCH) if name.reflecting else own


def digest(method: str, folder: Path | None) -> str:
    """A short mark of a method's settings and weights: with others of either it is another method."""
    paths = [weights.file_of(model, folder) for model in _models(name_of(method))]
    return _digest(repr(_settings(method)), tuple((path, path.stat().st_mtime_ns) for path in paths))


def _settings(method: str) -> tuple[Any, ...]:
    """What a method's numbers are set to, where it has such."""
    name = name_of(method)
    preset = PRESETS[name.argument] if name.argument in PRESETS else PRESETS["balanced"] if name.kind in ("search", *NETWORKS) else None
    networks = {"learned": VARIANTS.get(name.argument or "full"), "hybrid": Settings()}.get(name.kind)
    finish = (learned.SURVIVORS, pruning.REMOVED)
    fixed = {
        "learned": (learned.PLACED_STEPS, learned.WHOLE_STEPS, learned.SECOND_NODES, *finish, second_stage.NODE_EFFORT),
        "hybrid": finish,
    }.get(name.kind, ())
    return preset, networks, fixed


@lru_cache(maxsize=16)
def _digest(settings: str, files: tuple[tuple[Path, int], ...]) -> str:
    total = hashlib.sha256(settings.encode())
    for path, _ in files:
        total.update(path.read_bytes())
    return total.hexdigest()[:12]


def work(method: str, sphere: SphereImage, seed: int, folder: Path | None) -> Decomposition:
    """The improving trees of a method that has such. Raises UnshadeError."""
    name = name_of(method)
    options: dict[str, Any] = {"preset": "balanced", "weights": folder, "reflections": "picture" if name.reflecting else "lights"}
    if name.kind == "learned":
        options["settings"] = VARIANTS[name.argument or "full"]
    elif name.argument:
        options["preset"] = name.argument
    return decompose(sphere, seed=seed, method=cast(Literal["search", "learned", "hybrid"], name.kind), **options)


def answer(method: str, sphere: SphereImage, seed: int, folder: Path | None) -> Outcome:
    """The tree of a method. Raises UnshadeError."""
    name = name_of(method)
    if name.kind in baselines.NAMES:
        tree = baselines.Baseline.load(name.kind, folder).tree(sphere)
        return Outcome(fit(sphere, tree, seed=seed).tree if name.fitted else tree)
    result = work(method, sphere, seed, folder).result()
    curve = tuple((member.values, member.psnr) for member in result.family.members)
    return Outcome(result.tree, curve, result.stages)


def cards(methods: Iterator[str], folder: Path | None) -> dict[str, dict[str, Any]]:
    """How the weights behind some methods were trained."""
    models = dict.fromkeys(model for method in methods for model in _models(name_of(method)))
    found = {model: weights.read_card(weights.file_of(model, folder)) for model in models}
    return {model: {key: card[key] for key in ("config", "steps", "of", "examples", "hours", "hardware")} for model, card in found.items()}


def described() -> dict[str, dict[str, Any]]:
    """The settings of the ablation, for its document."""
    return {name: dataclasses.asdict(settings) for name, settings in VARIANTS.items()}
