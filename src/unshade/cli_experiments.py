"""The command `unshade experiments`."""

from __future__ import annotations

from pathlib import Path

import click

from unshade.arguments import SEED
from unshade.errors import UnshadeError
from unshade.staging import check_folder

PARTS = ("decomposition", "analogy", "ablation", "robustness", "anytime", "wild")
"""As in `unshade.experiments.options`, which comes with PyTorch."""


class ExperimentsError(UnshadeError):
    """Some measurements failed."""

    exit_code = 7


@click.command()
@click.argument("parts", nargs=-1, type=click.Choice(PARTS), metavar="[PART]...")
@click.option(
    "--method",
    "methods",
    multiple=True,
    metavar="NAME",
    help="One of those above; may be repeated. Default: the baselines, learned:alone, learned, search with each preset, hybrid.",
)
@click.option("--limit", type=click.IntRange(1), metavar="N", help="Pictures of each set, and analogies of each component.")
@click.option("--resume/--fresh", default=True, help="Keep what an earlier run has measured (the default), or measure again.")
@click.option("--add", is_flag=True, help="Keep what the JSON that is there says of methods that are not asked now.")
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="DIR",
    help="Folder of the real spheres, as for `bench`.",
)
@click.option(
    "--weights",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Of networks and baselines, instead of those that ship.",
)
@click.option(
    "--training",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="DIR",
    help="A training run, whose learning curves are kept.",
)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("."), show_default=True, metavar="DIR", help="Root of the project."
)
@click.option("--seed", type=SEED, default=0, show_default="0", metavar="N", help="Of the methods and of the test trees.")
@click.option("--workers", type=click.IntRange(1), metavar="N", help="Processes; all cores when not given.")
@click.option("--perceptual/--no-perceptual", default=True, help="Measure st_lpips too, about a second a picture (the default).")
def experiments(
    parts: tuple[str, ...],
    methods: tuple[str, ...],
    limit: int | None,
    resume: bool,
    add: bool,
    data: Path | None,
    weights: Path | None,
    training: Path | None,
    output: Path,
    seed: int,
    workers: int | None,
    perceptual: bool,
) -> None:
    """Run the paper's experiments and ours, all or some: from raw data to DIR/docs/experiments.md.

    decomposition compares all methods, analogy asks each for 300 edits a component by example, ablation takes the learned method apart,
    robustness spoils the pictures and looks at size, anytime looks at the trees on the way, wild shows what has no known tree. The
    JSON behind the page goes to DIR/benchmarks/results/experiments. Data and weights that are not there are skipped by name, and so
    is the ablation where learned is not among the methods. It can be interrupted and goes on where it was.

    \b
    Methods:
      cnn, lstm, transformer         the baselines; with +fit their trees are fitted
      learned                        the learned method with all that is ours
      learned:VARIANT                base, samples, second, overall, full (learned itself), alone or depth
      search:PRESET, hybrid:PRESET   draft, balanced or best; without a preset, balanced
      learned, search and hybrid     with +reflections hold a reflected environment as a picture

    \b
    Examples:
      unshade experiments
      unshade experiments decomposition anytime --limit 4
      unshade experiments analogy --method search:balanced --method lstm --weights run/weights
      unshade experiments ablation anytime --method learned --add
    """
    from unshade.experiments import Options, run
    from unshade.experiments.options import METHODS

    check_folder(output)
    given, parts, methods = parts, parts or PARTS, methods or METHODS
    if "learned" not in methods:
        if "ablation" in given:
            raise click.UsageError("ablation takes the method learned apart, which is not among those of --method; add --method learned")
        parts = tuple(part for part in parts if part != "ablation")
    ran = run(Options(parts, methods, data, output, limit, weights, training, seed, workers, perceptual, resume, add))
    if ran.failed:
        raise ExperimentsError(f"{len(ran.failed)} measurements failed; the first: {ran.failed[0]}")


VERBS = (experiments,)
