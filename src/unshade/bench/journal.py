"""Rows that are done, one JSON object a line, so that a benchmark can be stopped and go on.

A row is found again by what was asked (set, picture, method, seed, measures), not by the code that answered: after a
change of the code, ask for a fresh run. The journal holds trees, so it stays out of the repository as the sheets do.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from unshade.errors import OutputError
from unshade.files import add_line

Row = dict[str, Any]

KEY = ("dataset", "name", "method", "seed", "perceptual")


def key_of(row: Row, fields: Sequence[str] = KEY) -> tuple[Any, ...]:
    """What was asked."""
    return tuple(row[field] for field in fields)


class Journal:
    """The file of rows; the last row of a key counts."""

    def __init__(self, path: Path, fields: Sequence[str] = KEY) -> None:
        self.path, self.fields = path, fields
        self.rows: dict[tuple[Any, ...], Row] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            # Ended by a power cut or a full disk, the last line may be half a row.
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from error
        for line in text.splitlines():
            row = _parse(line, fields)
            if row is not None:
                self.rows[key_of(row, fields)] = row

    def add(self, row: Row) -> None:
        """Keep a row, at once. Raises OutputError."""
        add_line(self.path, json.dumps(row))
        self.rows[key_of(row, self.fields)] = row


def _parse(line: str, fields: Sequence[str]) -> Row | None:
    try:
        row = json.loads(line)
    except json.JSONDecodeError:
        return None
    return row if isinstance(row, dict) and all(field in row for field in fields) else None
