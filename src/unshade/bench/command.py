"""`unshade bench`: the command line of the benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from unshade.bench.options import DATASETS, METHODS, SAMPLED, Options
from unshade.bench.runner import run
from unshade.errors import UnshadeError


class BenchError(UnshadeError):
    """Some pictures could not be measured."""


@click.command("bench", context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--dataset",
    "datasets",
    multiple=True,
    metavar="NAME",
    help=f"A folder in --data, examples, or sampler:STYLE; repeatable; absent ones are skipped by name. [{', '.join(DATASETS)}]",
)
@click.option(
    "--method",
    "methods",
    multiple=True,
    metavar="NAME",
    help="adam:K, basin:K, second:K (K highlights), search:PRESET, depth:PRESET, learned:PRESET or hybrid:PRESET; may be repeated. "
    f"Default: {', '.join(METHODS)}.",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    help="Folder of the data sets. Default: data, ../shared/data or examples, the first that exists.",
)
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("benchmarks"),
    show_default=True,
    help="Where results, table, curve and sheets go.",
)
@click.option(
    "--limit", type=click.IntRange(min=1), help=f"Pictures of each data set, spread evenly. Default: all ({SAMPLED} of a sampler set)."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the methods and of the sampled trees.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes. Default: one a core.")
@click.option("--perceptual", is_flag=True, help="Measure st_lpips too (slow).")
@click.option("--fresh", is_flag=True, help="Measure again what an earlier run has measured; needed after a change of the code.")
def command(
    datasets: tuple[str, ...],
    methods: tuple[str, ...],
    data: Path | None,
    out: Path,
    limit: int | None,
    seed: int,
    workers: int | None,
    perceptual: bool,
    fresh: bool,
) -> None:
    """Measure data sets x methods; write JSON results, a table, a curve and sheets of the worst.

    It can be interrupted and goes on where it was.

    \b
    Examples:
      unshade bench
      unshade bench --dataset pbr --dataset sampler:toon --method search:draft --method second:4 --limit 20
    """
    main(Options(datasets or DATASETS, methods or METHODS, data, out, limit, seed, workers, perceptual, fresh))


def main(options: Options | Sequence[str]) -> None:
    """Run the benchmark, from options or from the words of a command line.

    Raises:
        UnshadeError: a bad option, no data set, an output that cannot be written; `BenchError` where pictures failed.
        KeyboardInterrupt: it was interrupted, after what is done has been written.
    """
    if not isinstance(options, Options):
        command.main(list(options), prog_name="unshade bench", standalone_mode=False)
        return
    measured = run(options)
    if measured.interrupted:
        raise KeyboardInterrupt
    if measured.failed:
        total = len(measured.failed) + len(measured.rows)
        raise BenchError(f"{len(measured.failed)} of {total} measurements failed; the first: {measured.failed[0]}")
