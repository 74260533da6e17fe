"""One visible loop that trains every model: resumable to the step, on a CPU, a GPU or, under torchrun, on several.

A run is a folder: DIR/TASK/state.safetensors (where it is), log.jsonl and tensorboard/ (its curves), pictures/ (how it looks), and
DIR/weights/TASK.safetensors (what it is for). Everything random in a step comes from the seed and the step's number.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from unshade import checkpoint, processes
from unshade.baseline_tasks import CNNTask, LSTMTask, TransformerTask
from unshade.checkpoint import Identity, Position
from unshade.errors import OutputError, UnshadeError, did_you_mean
from unshade.models import weights
from unshade.models.config import Config, TrainingConfig
from unshade.picture_output import write_picture
from unshade.reflection_task import ReflectionTask
from unshade.synthesis_shards import read_manifest, shard_batches
from unshade.tasks import HeadsTask, PriorTask, Task, VQVAETask
from unshade.training_log import Log

if TYPE_CHECKING:
    from unshade.synthesis import Style

_TASKS: tuple[type[Task[Any]], ...] = (VQVAETask, PriorTask, HeadsTask, ReflectionTask, CNNTask, LSTMTask, TransformerTask)

TASKS: dict[str, type[Task[Any]]] = {task.name: task for task in _TASKS}
"""Everything that can be trained, each after those whose weights it needs."""

SAVE_EVERY_SECONDS = 60.0
EVALUATION_BATCH = 16
EVALUATED, EVALUATED_LAST = 4, 32
"""Batches of unseen nodes of each style, on the way and at the end."""


class TrainingError(UnshadeError):
    """A run that cannot begin or go on."""


@dataclass(frozen=True)
class Run:
    """One training run."""

    task: str
    config: Config
    folder: Path
    seed: int = 0
    style: Style = "both"
    precision: str = "auto"
    """float32, bfloat16, or auto: bfloat16 on a GPU that has it."""
    workers: int = 0
    """Processes that make data."""
    shards: Path | None = None
    """A written data set to learn from, instead of drawing from the grammar."""
    report_every: int = 50
    evaluate_every: int = 500

    @property
    def training(self) -> TrainingConfig:
        """Of this task. Raises TrainingError."""
        if self.task not in TASKS or self.task not in self.config.training:
            raise TrainingError(f"unknown task {self.task!r}{did_you_mean(self.task, TASKS)}")
        return self.config.training[self.task]

    @property
    def weights(self) -> Path:
        """Where trained weights go, and where those of earlier tasks are."""
        return self.folder / "weights"

    @property
    def state(self) -> Path:
        """The file that a run goes on from."""
        return self.folder / self.task / "state.safetensors"


@dataclass(frozen=True)
class Progress:
    """Where a run is. ``test`` holds the figures of unseen nodes where they were taken at this step."""

    task: str
    step: int
    steps: int
    loss: float = math.nan
    figures: dict[str, float] = field(default_factory=dict)
    test: dict[str, float] = field(default_factory=dict)
    seconds_left: float = math.nan
    notes: tuple[str, ...] = ()


def train(run: Run, place: processes.Place | None = None) -> Iterator[Progress]:
    """Train one model from where its run is to the end of its steps.

    Ctrl-C or SIGTERM lets the step end, saves, and raises KeyboardInterrupt; a second one stops at once. After a kill, a later call
    repeats what came after the last save, with the same losses.

    Args:
        run: what to train.
        place: where, if several runs share one; under torchrun they must.
    Raises:
        TrainingError, CheckpointError, DatasetError, DeviceError, MissingWeightsError, OutputError.
    """
    training = run.training
    with contextlib.nullcontext(place) if place else processes.place() as place:
        shards = shards_of(run)
        precision = processes.precision(run.precision, place.device)
        run = replace(run, precision=str(precision).removeprefix("torch."))
        task = TASKS[run.task](run.config, run.weights, place.device)
        with processes.seeded(run.seed, 0):
            model = task.build().to(place.device)
        optimizer = torch.optim.AdamW(model.parameters(), lr=training.learning_rate, betas=(0.9, 0.99), weight_decay=training.weight_decay)
        identity = Identity(run.task, run.config, run.style, run.seed, run.precision, place.processes, shards)
        position, changes = Position(), list[str]()
        if run.state.is_file():
            position, changes = checkpoint.resume(run.state, model, optimizer, identity)
        log = Log(run.folder / run.task, position.step, writes=place.leads)
        notes = (*log.notes, *task.notes(), *_where(run, position, changes))
        yield Progress(run.task, position.step, training.steps, notes=notes if place.leads else ())

        first, began, earlier = position.step, time.monotonic(), position.seconds
        saved = began
        for batch in _batches(run, task, position.step, place):
            mixed = torch.autocast(place.device.type, torch.bfloat16, precision == torch.bfloat16)
            with processes.seeded(run.seed, position.step + 1, place.rank), mixed:
                outcome = task.outcome(model.train(), batch)
            optimizer.zero_grad()
            outcome.loss.backward()
            place.average_gradients(model)
            loss, length = float(outcome.loss.detach()), float(nn.utils.clip_grad_norm_(model.parameters(), training.clip))
            if place.anyone(not (math.isfinite(loss) and math.isfinite(length))):
                raise TrainingError(_diverged(run, position, loss, length))
            optimizer.param_groups[0]["lr"] = learning_rate(training, position.step)
            optimizer.step()

            position.step += 1
            position.seconds = earlier + time.monotonic() - began
            position.loss_sum += loss
            position.loss_count += 1
            evaluates = position.step % run.evaluate_every == 0 or position.step == training.steps
            if evaluates or position.step % run.report_every == 0:
                loss, figures = position.loss_sum / position.loss_count, {key: float(value) for key, value in outcome.figures.items()}
                position.loss_sum, position.loss_count = 0.0, 0
                log.add(position.step, {"loss": loss, **figures}, "train")
                test = _look(run, task, model, position, log) if evaluates and place.leads else {}
                left = (time.monotonic() - began) / (position.step - first) * (training.steps - position.step)
                yield Progress(run.task, position.step, training.steps, loss, figures, test, left)
            stops = place.anyone(place.asked())
            if place.leads and (evaluates or stops or time.monotonic() - saved > SAVE_EVERY_SECONDS):
                checkpoint.save(run.state, model, optimizer, position, identity)
                saved = time.monotonic()
            if stops:
                log.close()
                raise KeyboardInterrupt
        log.close()


def learning_rate(training: TrainingConfig, step: int) -> float:
    """Up over the warm-up, level, and down to 0 over the last share of the steps."""
    up = (step + 1) / max(training.warmup, 1)
    down = (training.steps - step) / max(training.decay * training.steps, 1.0)
    return training.learning_rate * min(1.0, up, down)


def _where(run: Run, position: Position, changes: list[str]) -> list[str]:
    """What a person should know of a run that was begun before."""
    if not position.step:
        return []
    if position.step >= run.training.steps:
        others = [change for change in changes if not change.startswith("steps")]
        unused = f"; nothing was trained with {', '.join(others)}" if others else ""
        return [f"done before, {position.step} of {run.training.steps} steps{unused}; more --steps go on, another folder begins anew"]
    return [f"going on from step {position.step}{', now with ' * bool(changes)}{', '.join(changes)}"]


def _diverged(run: Run, position: Position, loss: float, length: float) -> str:
    """What to say where the next step would lead nowhere."""
    saved = f"the last good state is in {run.state}" if run.state.is_file() else "no state was saved yet"
    return f"{run.task}: the loss is {loss:.4g}, its gradient {length:.4g} long, at step {position.step + 1}; {saved}; try a lower --rate"


def _batches(run: Run, task: Task[Any], step: int, place: processes.Place) -> Iterator[Any]:
    """The batches from a step to the last; another process draws from another seed."""
    seed, batch = run.seed + 7_919 * place.rank, run.training.batch
    stream: Iterator[Any]
    if run.shards:
        stream = shard_batches(run.shards, batch=batch, seed=seed, start=step, device=place.device)
    else:
        stream = task.stream(run.style, "train", batch=batch, seed=seed, start=step, workers=run.workers)
    for _ in range(step, run.training.steps):
        yield next(stream)


def shards_of(run: Run) -> str:
    """What the run's shards are, ``none`` where it has none. Raises TrainingError, DatasetError for those that it cannot learn from."""
    if run.shards is None:
        return "none"
    if not TASKS[run.task].reads_shards:
        able = ", ".join(task.name for task in _TASKS if task.reads_shards)
        raise TrainingError(f"{run.task} learns from whole trees and draws them itself; shards hold nodes, for {able}")
    manifest = read_manifest(run.shards)
    for name, wanted in (("size", run.config.size), ("split", "train"), ("style", run.style), ("complete", True)):
        if manifest.get(name) != wanted:
            raise TrainingError(f"{run.shards}: expected shards with {name} {wanted}, got {name} {manifest.get(name)}")
    seals = hashlib.sha256(" ".join(entry["sha256"] for entry in manifest["shards"]).encode()).hexdigest()
    return f"{manifest['trees']} trees of seed {manifest['seed']} ({seals[:8]})"


def _look(run: Run, task: Task[Any], model: nn.Module, position: Position, log: Log) -> dict[str, float]:
    """Figures of unseen nodes, a sheet of pictures, and the weights as they are now."""
    count = EVALUATED_LAST if position.step == run.training.steps else EVALUATED
    figures: dict[str, float] = {}
    model.eval()
    with torch.no_grad():
        styles: tuple[Style, ...] = ("realistic", "toon") if run.style == "both" else (run.style,)
        for style in styles:
            stream = task.stream(style, "test", batch=EVALUATION_BATCH, seed=run.seed)
            found = [next(stream) for _ in range(count)]
            figures |= {f"{style}_{key}": value for key, value in task.evaluate(model, found).items()}
            drawn = task.pictures(model, found[0]).cpu()
            path = run.folder / run.task / "pictures" / f"{position.step:07d}-{style}.png"
            make_folder(path.parent)
            write_picture(path, drawn)
    log.add(position.step, figures, "test")
    make_folder(run.weights)
    weights.save(weights.file_of(run.task, run.weights), run.task, model, run.config, card(run, position, figures))
    return figures


def make_folder(path: Path) -> None:
    """Raises OutputError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be made: {error.strerror or error}") from None


def card(run: Run, position: Position, figures: dict[str, float]) -> dict[str, Any]:
    """What there is to know about trained weights: data, steps, time, hardware, figures."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
    return {
        "model": run.task,
        "config": run.config.name,
        "data": f"{TASKS[run.task].data}, style {run.style}, split train, "
        + (f"shards: {shards_of(run)}" if run.shards else f"seed {run.seed}"),
        "steps": position.step,
        "of": run.training.steps,
        "examples": position.step * run.training.batch * int(os.environ.get("WORLD_SIZE", "1")),
        "hours": round(position.seconds / 3600.0, 3),
        "hardware": gpu or f"{platform.machine()} CPU, {torch.get_num_threads()} thread(s)",
        "torch": torch.__version__,
        "precision": run.precision,
        "figures": {key: round(value, 4) for key, value in figures.items()},
    }


def leads() -> bool:
    """Whether this is the process that writes and speaks: the only one, or torchrun's first."""
    return os.environ.get("RANK", "0") == "0"
