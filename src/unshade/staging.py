"""A folder of results appears whole or not at all: written aside, then moved into place."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from unshade.errors import OutputError

TREE_FILE = "tree.json"
"""Moved last, so a folder that holds it is complete."""

MADE = (TREE_FILE, "render.png", "difference.png", "layers", "family", "alternatives", "tree.svg", "report.html")
"""Everything that a result's folder may hold; nothing else in it is touched."""


def staging_folder(folder: Path) -> Path:
    """Where the files of ``folder`` wait until all are written."""
    return folder.parent / f".{folder.name}.partial"


def discard(folder: Path) -> None:
    """Remove what an interrupted run left unfinished."""
    shutil.rmtree(staging_folder(folder), ignore_errors=True)


@contextlib.contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """A folder to write into that becomes ``folder`` at the end, or nothing at all where that fails."""
    staging = staging_folder(folder)
    made_parent = not folder.parent.exists()
    try:
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir(parents=True)
        yield staging
        _publish(staging, folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    finally:
        discard(folder)
        if made_parent and not folder.exists():
            with contextlib.suppress(OSError):
                folder.parent.rmdir()


def _publish(staging: Path, folder: Path) -> None:
    if not folder.exists():
        os.replace(staging, folder)
        return
    for name in MADE:
        old = folder / name
        if old.is_dir():
            shutil.rmtree(old)
        else:
            old.unlink(missing_ok=True)
    for new in sorted(staging.iterdir(), key=lambda path: path.name == TREE_FILE):
        os.replace(new, folder / new.name)


def check_own(folder: Path, marker: str, names: Iterable[str]) -> None:
    """Fail where results would take the place of someone else's files: any of ``names`` or `MADE`, in a folder without ``marker``,
    the file that every folder of such results holds. Raises OutputError."""
    check_folder(folder)
    if not (folder / marker).exists():
        for name in (*names, *MADE):
            if (folder / name).exists():
                raise OutputError(f"{folder}: expected a new folder or one with {marker}, since {name} in this one would be lost")


def check_folder(folder: Path) -> None:
    """Fail before the work is done rather than after it. Raises OutputError."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise OutputError(f"{folder}: expected a folder to write into, but {existing} is a file")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(f"{folder}: cannot be written: no permission for {existing}")
