"""What to measure, on what, and where the results go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

DATASETS = ("wild", "pbr", "layered", "examples", "sampler:realistic", "sampler:toon")

METHODS = ("adam:4", "basin:4", "second:2", "second:4", "second:8", "search:draft", "search:balanced", "search:best")

SAMPLED = 60
"""Trees of a sampler set where no limit is given."""


def default_data() -> Path:
    """The first that exists: ``data`` here, ``shared/data`` one folder up, the example pictures."""
    candidates = (Path("data"), Path("..", "shared", "data"), Path("examples"))
    return next((path for path in candidates if path.is_dir()), candidates[0])


@dataclass(frozen=True)
class Options:
    """One run of the benchmark. Absent data sets are skipped by name."""

    datasets: Sequence[str] = DATASETS
    """Folders of pictures inside ``data``, ``examples``, and ``sampler:STYLE``."""
    methods: Sequence[str] = METHODS
    """``adam:K``, ``basin:K`` and ``second:K`` fit one structure with K highlights; ``search:PRESET``, ``depth:PRESET``,
    ``learned:PRESET`` and ``hybrid:PRESET`` are the whole of `unshade.decompose`."""
    data: Path | None = None
    out: Path = Path("benchmarks")
    limit: int | None = None
    """Pictures of each data set, spread evenly over its names; None is all (`SAMPLED` of a sampler set)."""
    seed: int = 0
    workers: int | None = None
    """Processes; None is one a core, 1 works in this one."""
    perceptual: bool = False
    """Measure st_lpips too."""
    fresh: bool = False
    """Measure again what the journal holds."""
