"""Rows to the figures that tables show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from unshade.bench.measures import quantile
from unshade.bench.report import summary

Row = dict[str, Any]

PRIVATE = ("kind", "tree", "weights", "perceptual", "seed", "curve", "damage")
"""What does not stand in each row of the results: a tree renders to a copy of its picture."""


def public(rows: Sequence[Row]) -> list[Row]:
    """Rows as they are published."""
    return [{key: rounded(value) for key, value in row.items() if key not in PRIVATE and value is not None} for row in rows]


def rounded(value: Any) -> Any:
    """Numbers to four places, however deep they stand."""
    if isinstance(value, float):
        return round(value, 4)
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    return [rounded(entry) for entry in value] if isinstance(value, list | tuple) else value


def groups(rows: Sequence[Row], *fields: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by some of their fields, in order of first appearance."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[field] for field in fields), []).append(row)
    return found


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """`bench.report.summary`, and what the stages of networks did."""
    found = summary(rows)
    staged = [row["stages"] for row in rows if row.get("stages")]
    if staged:
        names = dict.fromkeys(name for stages in staged for name in stages["seconds"])
        causes = dict.fromkeys(cause for stages in staged for cause in stages["left_over"])
        found["stages"] = {
            "second_stage_share": rounded(sum(s["second_stage_nodes"] for s in staged) / max(1, sum(s["nodes"] for s in staged))),
            # Nothing was decomposed by the networks: what was found is the second stage's alone.
            "root_left_over": rounded(sum(s["nodes"] == s["second_stage_nodes"] for s in staged) / len(staged)),
            "left_over": {cause: sum(s["left_over"].get(cause, 0) for s in staged) for cause in causes},
            "seconds": {name: rounded(quantile([s["seconds"].get(name, 0.0) for s in staged], 0.5)) for name in names},
        }
    return found


def spread(numbers: Sequence[float]) -> dict[str, Any]:
    """Mean, median and the worst tenth."""
    return {
        "count": len(numbers),
        "mean": rounded(sum(numbers) / len(numbers)),
        "median": rounded(quantile(numbers, 0.5)),
        "p10": rounded(quantile(numbers, 0.1)),
    }


def best_within(curve: Sequence[Sequence[float]], limit: float) -> float | None:
    """The best second entry of points whose first is within a limit."""
    return max((point[1] for point in curve if point[0] <= limit), default=None)
