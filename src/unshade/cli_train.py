"""The command `unshade train`."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from unshade.arguments import SEED
from unshade.staging import check_folder

if TYPE_CHECKING:
    from unshade.models.config import Config
    from unshade.terminal import Messages
    from unshade.train import Progress

MODELS = ("vqvae", "prior", "heads", "reflection")
"""What `all` trains, in this order; the names are those of `unshade.train.TASKS`."""


BASELINES = ("cnn", "lstm", "transformer")

INTERRUPTED = 130
"""The exit code of `unshade.cli` for it."""


class Rate(click.FloatRange):
    """A finite number over 0."""

    def __init__(self) -> None:
        super().__init__(0.0, min_open=True)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """As click has it, but neither nan nor inf."""
        rate = float(click.FLOAT.convert(value, param, ctx))
        if not 0.0 < rate < math.inf:
            self.fail(f"expected a finite learning rate over 0, such as 0.001, got {value}", param, ctx)
        return rate


@click.command()
@click.argument("model", type=click.Choice([*MODELS, "baseline", "all"]))
@click.argument("baseline", type=click.Choice(BASELINES), required=False)
@click.option(
    "--config", default="small", show_default=True, metavar="NAME", help="small (hours on two cores), paper (a GPU), or tiny (a test)."
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("out/train"),
    show_default=True,
    metavar="DIR",
    help="Folder of the run: states, curves, pictures, and the weights in DIR/weights.",
)
@click.option("--steps", type=click.IntRange(1), metavar="N", help="Steps in all instead of the configuration's.")
@click.option("--batch", type=click.IntRange(1), metavar="N", help="Examples of a step and process instead of the configuration's.")
@click.option("--rate", type=Rate(), metavar="R", help="Learning rate instead of the configuration's.")
@click.option(
    "--style", type=click.Choice(["both", "realistic", "toon"]), default="both", show_default=True, help="Which trees to learn from."
)
@click.option("--seed", type=SEED, default=0, show_default="0", metavar="N", help="The same seed gives the same training.")
@click.option(
    "--precision",
    type=click.Choice(["auto", "float32", "bfloat16"]),
    default="auto",
    show_default=True,
    help="Of large products; auto is bfloat16 on a GPU that has it. Some CPUs are twice as fast with bfloat16.",
)
@click.option(
    "--workers", type=click.IntRange(0), default=0, show_default=True, metavar="N", help="Processes that make data beside the training."
)
@click.option(
    "--shards",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Learn from a folder of `unshade dataset make`, not from examples drawn on the way; of vqvae, prior, heads and the cnn.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a report, one a line, on standard output.")
@click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors.")
def train(
    model: str,
    baseline: str | None,
    config: str,
    output: Path,
    steps: int | None,
    batch: int | None,
    rate: float | None,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Train the networks, or a baseline.

    vqvae is the encoder and decoder of node images, prior draws children, heads are the operator, mask and type networks; prior needs a
    trained vqvae. reflection takes a picture apart into what it reflects and the picture without it. `all` trains each in turn,
    evaluates it on unseen nodes, and writes weights and a model card to DIR/weights. A call goes on where the last one stopped: after
    Ctrl-C at that step, after a kill at the last save, a minute before at most.

    `baseline` trains what the experiments compare with: the cnn, the lstm or the transformer, or each in turn where none is named.

    Several GPUs: torchrun --nproc-per-node 8 -m unshade train vqvae --config paper

    \b
    Examples:
      unshade train all --config small -o run
      unshade train vqvae --config paper --batch 64 -o paper
      unshade train vqvae --shards data -o run
      unshade train reflection --precision bfloat16 --workers 1 -o run
      unshade train baseline lstm -o run
    """
    from unshade import processes
    from unshade import train as loop
    from unshade.models.config import find
    from unshade.terminal import Messages

    if baseline and model != "baseline":
        raise click.UsageError(f"{baseline} is a baseline: unshade train baseline {baseline}")
    check_folder(output)
    found, messages = find(config), Messages(quiet or not loop.leads())
    names = {"all": MODELS, "baseline": (baseline,) if baseline else BASELINES}
    runs = [loop.Run(task, _changed(found, task, steps, batch, rate), output, **options) for task in names.get(model, (model,))]
    for run in runs:
        loop.shards_of(run)  # what cannot be read is said before hours of training
    try:
        with processes.place() as place:
            for run in runs:
                for progress in loop.train(run, place):
                    _tell(progress, messages, as_json and place.leads)
    except KeyboardInterrupt:
        if loop.leads():
            raise
        raise click.exceptions.Exit(INTERRUPTED) from None  # the first process says it for all
    if model == "all" and loop.leads():
        from unshade.model_card import write_card

        messages.say(f"weights and model card: {write_card(output / 'weights')}")


def _changed(config: Config, task: str, steps: int | None, batch: int | None, rate: float | None) -> Config:
    """The configuration with what the command line says."""
    training = config.training[task]
    given: dict[str, Any] = {"steps": steps, "batch": batch, "learning_rate": rate}
    training = dataclasses.replace(training, **{name: value for name, value in given.items() if value})
    return dataclasses.replace(config, training={**config.training, task: training})


def _tell(progress: Progress, messages: Messages, as_json: bool) -> None:
    """A report as a line for a person, or as JSON."""
    for note in progress.notes:
        messages.say(f"{progress.task}: {note}", "dim")
    if not progress.figures:
        return
    if as_json:
        click.echo(json.dumps({key: value for key, value in dataclasses.asdict(progress).items() if key != "notes"}))
    figures = "  ".join(f"{key} {value:.4g}" for key, value in progress.figures.items())
    messages.say(
        f"{progress.task} {progress.step}/{progress.steps}  loss {progress.loss:.4f}  {figures}  {_duration(progress.seconds_left)} left"
    )
    if progress.test:
        messages.say("  unseen: " + "  ".join(f"{key} {value:.4g}" for key, value in progress.test.items()), "bold")


def _duration(seconds: float) -> str:
    """``1 h 05 min``, ``12 min`` or ``40 s``."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{minutes} min" if minutes else f"{rest} s"


VERBS = (train,)
