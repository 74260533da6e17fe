"""One thing to measure, what it came to as a row, and the crew and journal behind many of them."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from unshade import crew, serde
from unshade.bench.datasets import Case
from unshade.bench.journal import Journal, key_of
from unshade.bench.measures import compare_trees, decibels, measure
from unshade.errors import UnshadeError
from unshade.experiments import methods, subjects
from unshade.experiments.damage import CLEAN, damaged
from unshade.experiments.pieces import pieces
from unshade.experiments.understanding import Question, understood
from unshade.render import render
from unshade.sphere import sphere_normals

Row = dict[str, Any]

KEY = ("kind", "dataset", "name", "method", "damage", "seed", "weights", "perceptual")
"""What a row is found again by: what was asked, with which settings and weights; not the code that answered, which stands in the row."""


@dataclass(frozen=True)
class Job:
    """One picture, or one analogy, for one method."""

    kind: Literal["tree", "time", "analogy"]
    case: Case
    method: str
    seed: int
    folder: Path | None
    """Of the weights."""
    digest: str
    """Of the method's settings and weights."""
    perceptual: bool = False
    damage: str = CLEAN
    question: Question | None = None

    @property
    def about(self) -> Row:
        """The fields of `KEY`."""
        return {
            "kind": self.kind,
            "dataset": self.case.dataset,
            "name": self.case.name,
            "method": self.method,
            "damage": self.damage,
            "seed": self.seed,
            "weights": self.digest,
            "perceptual": self.perceptual,
        }


class Measure(Protocol):
    """Does jobs, or finds them done, and gives their rows in order; those that failed are left out."""

    def __call__(self, jobs: Sequence[Job]) -> list[Row]:
        """See the class."""


def row_of(job: Job) -> Row:
    """What a job comes to; a row with ``error`` where it failed, so that one picture does not end the run."""
    torch.set_num_threads(1)
    try:
        return job.about | {"commit": commit()} | {"tree": _tree, "time": _time, "analogy": _analogy}[job.kind](job)
    except (UnshadeError, ArithmeticError, ImportError, RuntimeError, ValueError) as error:
        return job.about | {"error": f"{type(error).__name__}: {error}"}


@lru_cache(maxsize=1)
def commit() -> str:
    """Of the code that measures, ``-dirty`` where it was changed since; empty outside a clone."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def _tree(job: Job) -> Row:
    subject = subjects.load(job.case, job.seed)
    sphere = damaged(subject.sphere, job.damage, job.seed + job.case.number)
    wall, processor = time.perf_counter(), time.process_time()
    found = methods.answer(job.method, sphere, job.seed, job.folder)
    seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - processor
    row = measure(subject, found.tree, job.perceptual)
    row |= {"seconds": seconds, "cpu_seconds": cpu_seconds, "curve": [list(point) for point in found.curve]}
    if subject.truth is not None:
        row["released"] = pieces(subject.truth) is not None
    if found.stages:
        row["stages"] = found.stages
    return row | {"tree": serde.dumps(found.tree)}


def _time(job: Job) -> Row:
    """The best tree so far over the seconds of one core; looking at it does not count."""
    subject = subjects.load(job.case, job.seed)
    normals, image = sphere_normals(subject.sphere.size), subject.sphere.image
    work = methods.work(job.method, subject.sphere, job.seed, job.folder)
    used, best, told, curve = 0.0, float("-inf"), None, []
    while True:
        begin = time.process_time()
        step = next(work, None)
        used += time.process_time() - begin
        if step is None:
            break
        # The method's own figure decides which tree it would give if it were stopped now.
        if step.psnr > best or step.stage == "done":
            best = step.psnr
            if step.tree != told:
                told = step.tree
                curve.append([round(used, 4), round(decibels(image, render(told, normals), subject.scored), 3), told.values])
    assert told is not None
    row = {"anytime": curve, "cpu_seconds": used, "psnr": curve[-1][1], "values": told.values}
    if subject.truth is not None:
        row["structure_right"] = compare_trees(told, subject.truth, subject.scored)["structure_right"]
    return row | {"tree": serde.dumps(told)}


def _analogy(job: Job) -> Row:
    assert job.question is not None
    return understood(job.question, job.seed, job.perceptual)


@dataclass
class Work:
    """The measuring of one run: a crew, a journal, and what failed."""

    journal: Path
    workers: int
    resume: bool
    console: Console
    failed: list[str] = field(default_factory=list)
    _fresh: set[tuple[Any, ...]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._kept = Journal(self.journal, KEY)

    def measure(self, jobs: Sequence[Job]) -> list[Row]:
        """See `Measure`."""
        unique = {key_of(job.about, KEY): job for job in jobs}
        known = self._kept.rows if self.resume else self._fresh
        waiting = [job for key, job in unique.items() if key not in known]
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        bad: set[tuple[Any, ...]] = set()
        with Progress(*columns, console=self.console, disable=not self.console.is_terminal) as progress:
            bar = progress.add_task("measuring", total=len(unique), completed=len(unique) - len(waiting))
            for job, row in crew.run(waiting, self.workers, row_of, _lost):
                what = f"{job.method} on {job.case.dataset}/{job.case.name}"
                if "error" in row:
                    self.failed.append(f"{what}: {row['error']}")
                    bad.add(key_of(row, KEY))
                else:
                    self._kept.add(row)
                    self._fresh.add(key_of(row, KEY))
                progress.update(bar, advance=1, description=what)
        keys = [key_of(job.about, KEY) for job in jobs]
        return [self._kept.rows[key] for key in keys if key not in bad]


def _lost(job: Job, code: int | None) -> Row:
    return job.about | {"error": f"its process ended with exit code {code}"}
