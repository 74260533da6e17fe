"""Measures every case with every method, on all cores, and keeps each row as soon as it is there."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from unshade import crew, serde
from unshade.bench import report
from unshade.bench.datasets import Case, find_cases, load
from unshade.bench.journal import Journal, Row, key_of
from unshade.bench.measures import measure
from unshade.bench.methods import method_of
from unshade.bench.options import Options, default_data
from unshade.errors import UnshadeError


@dataclass
class Measured:
    """What a run came to."""

    rows: list[Row] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    """Data set or method -> why it was left out."""
    failed: list[str] = field(default_factory=list)
    interrupted: bool = False


@dataclass(frozen=True)
class Task:
    """One case for one method."""

    case: Case
    method: str
    seed: int
    perceptual: bool

    @property
    def key(self) -> tuple[Any, ...]:
        """As in the journal."""
        return key_of(
            {"dataset": self.case.dataset, "name": self.case.name, "method": self.method, "seed": self.seed, "perceptual": self.perceptual}
        )


def run(options: Options, console: Console | None = None) -> Measured:
    """Measure what is asked and write results, table, curve and sheets under ``options.out``.

    An interrupt ends the measuring; what is done is kept, and reported as far as it goes.

    Raises:
        UnshadeError: an unknown method, no data set at all, or an output that cannot be written.
    """
    console = console or Console(stderr=True)
    for method in options.methods:
        method_of(method)
    data = options.data or default_data()
    measured, tasks = Measured(), []
    for dataset in options.datasets:
        cases = find_cases(dataset, data, options.limit)
        if not cases:
            measured.skipped[dataset] = f"no folder {data / dataset}"
        tasks += [Task(case, method, options.seed, options.perceptual) for method in options.methods for case in cases]
    if not tasks:
        raise UnshadeError(
            f"no data set found: {', '.join(f'{name} ({why})' for name, why in measured.skipped.items()) or 'none was asked for'}"
        )
    journal = Journal(options.out / "out" / "journal.jsonl")
    waiting = [task for task in tasks if options.fresh or task.key not in journal.rows]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task("measuring", total=len(tasks), completed=len(tasks) - len(waiting))
        try:
            for task, row in crew.run(waiting, options.workers or crew.cores(), measure_task, _lost):
                if "error" in row:
                    measured.failed.append(f"{task.method} on {task.case.dataset}/{task.case.name}: {row['error']}")
                else:
                    journal.add(row)
                progress.update(bar, advance=1, description=f"{task.method} {task.case.dataset}/{task.case.name}")
        except KeyboardInterrupt:
            measured.interrupted = True
    measured.rows = [journal.rows[task.key] for task in tasks if task.key in journal.rows]
    report.write(options, measured.rows, measured.skipped, measured.failed, console)
    return measured


def measure_task(task: Task) -> Row:
    """One row, or a row with only ``error``. A failure of one picture does not end the run."""
    # Processor seconds are then the cost of one core, and sums come in one order on any machine.
    torch.set_num_threads(1)
    try:
        subject = load(task.case, task.seed)
        wall, processor = time.perf_counter(), time.process_time()
        outcome = method_of(task.method)(subject.sphere, subject.scored, task.seed)
        seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - processor
        figures = measure(subject, outcome.tree, task.perceptual)
    except (UnshadeError, ArithmeticError, ImportError, RuntimeError, ValueError) as error:
        return {"error": f"{type(error).__name__}: {error}"}
    return {
        "dataset": task.case.dataset,
        "name": task.case.name,
        "method": task.method,
        "seed": task.seed,
        "perceptual": task.perceptual,
        **figures,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "curve": [list(point) for point in outcome.curve],
        "tree": serde.dumps(outcome.tree),
    }


def _lost(task: Task, code: int | None) -> Row:
    return {"error": f"its process ended with exit code {code}"}
