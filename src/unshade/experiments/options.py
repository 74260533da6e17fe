"""What to run, on what, and where the results go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PARTS = ("decomposition", "analogy", "ablation", "robustness", "anytime", "wild")

METHODS = ("cnn", "lstm", "transformer", "learned:alone", "learned", "search:draft", "search:balanced", "search:best", "hybrid:balanced")

ABLATION = ("learned:base", "learned:samples", "learned:second", "learned:overall", "learned")
"""What the paper leaves out, and puts back one after the other; the last is ours."""

SAMPLED = 60
"""Trees of each style where no limit is given."""


@dataclass(frozen=True)
class Options:
    """One run of the experiments. What is not there (data, weights) is skipped by name."""

    parts: Sequence[str] = PARTS
    methods: Sequence[str] = METHODS
    data: Path | None = None
    out: Path = Path(".")
    """Root of the project: figures go to ``docs``, JSON to ``benchmarks/results/experiments``."""
    limit: int | None = None
    """Pictures of each set, and analogies of each component."""
    weights: Path | None = None
    """Of the networks and baselines; None for those that ship."""
    training: Path | None = None
    """Folder of a training run, whose learning curves are kept."""
    seed: int = 0
    workers: int | None = None
    perceptual: bool = True
    resume: bool = True
    """Keep what the journal holds."""
    add: bool = False
    """Keep what the documents that are there say of methods that are not asked."""

    @property
    def results(self) -> Path:
        """JSON of each part."""
        return self.out / "benchmarks" / "results" / "experiments"

    @property
    def journal(self) -> Path:
        """Rows that are done, trees included; not in the repository."""
        return self.out / "benchmarks" / "out" / "experiments.jsonl"

    @property
    def page(self) -> Path:
        """The page, its figures in a folder beside it."""
        return self.out / "docs" / "experiments.md"

    @property
    def figures(self) -> Path:
        """The pictures of the page."""
        return self.out / "docs" / "experiments"

    @property
    def sheets(self) -> Path:
        """Pictures that cannot be passed on; not in the repository."""
        return self.out / "benchmarks" / "sheets"

    def count(self, usual: int) -> int:
        """How many, unless there is a limit."""
        return usual if self.limit is None else self.limit
