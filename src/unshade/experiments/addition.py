"""A run of some methods put into the documents of an earlier run, so that the others need not be measured again."""

from __future__ import annotations

from typing import Any

from unshade.errors import UnshadeError
from unshade.experiments.jobs import Row
from unshade.experiments.parts import Document

WHICH = ("dataset", "name", "component", "damage", "method")
"""What an entry is of; those that it has tell it from all others of its list."""


def check(old: Document, new: Document, name: str) -> None:
    """Raises UnshadeError where an earlier document, of the file ``name``, is of another format, part, seed or limit."""
    for field in ("format", "part", "seed", "limit"):
        if new[field] != old.get(field):
            raise UnshadeError(f"{name} was measured with {field} {old.get(field)!r}, not {new[field]!r}; leave out --add to measure anew")


def added(new: Document, old: Document) -> tuple[Document, list[str]]:
    """The new document with what the old one says of other methods, and those methods. A note says which are whose."""
    lists = [field for field, value in new.items() if isinstance(value, list) and field not in ("failed", "notes")]
    fresh = {entry["method"] for field in lists for entry in new[field]}
    kept = sorted({entry["method"] for field in lists for entry in old.get(field, [])} - fresh)
    if not kept:
        return new, kept
    note = f"Measured last: {', '.join(f'`{method}`' for method in sorted(fresh))}; the other methods are of an earlier run."
    notes = [*(note for note in old.get("notes", []) if not note.startswith("Measured last: ")), note]
    found: Document = {}
    for field, value in new.items():
        found[field] = _joined(value, old.get(field, []), fresh) if field in lists else value
        if field == "failed":
            found["notes"] = notes
    found["weights"] = old.get("weights", {}) | new["weights"]
    found["skipped"] = {what: why for what, why in (old.get("skipped", {}) | new["skipped"]).items() if what not in fresh}
    # A failure begins with its method (`jobs.Work.measure`).
    found["failed"] = [*(what for what in old.get("failed", []) if what.partition(" on ")[0] not in fresh), *new["failed"]]
    return found, kept


def _joined(new: list[Row], old: list[Row], fresh: set[str]) -> list[Row]:
    """In the order of the old list; what that has not comes last."""
    again = {_which(entry): entry for entry in new}
    kept = [again.pop(_which(entry), None) if entry["method"] in fresh else entry for entry in old]
    return [*(entry for entry in kept if entry is not None), *again.values()]


def _which(entry: Row) -> tuple[Any, ...]:
    return tuple(entry.get(field) for field in WHICH)
