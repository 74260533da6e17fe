"""Writing a file whole or not at all, or line by line."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from unshade.errors import OutputError


def check_place(path: Path) -> None:
    """Fail before the work is done rather than after it: a file that is in the way or write-protected, a folder that is not there.

    A file that takes another's name at once would replace a protected one too, so that is looked at here. Raises OSError.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a directory")
    if path.exists() and not (os.access(path, os.W_OK) and path.stat().st_mode & 0o222):
        raise PermissionError(errno.EACCES, "it is write-protected")
    if not path.parent.exists():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))


def check_kept(path: Path, *read: str | Path | None) -> None:
    """Raises OutputError where ``path`` is one of the files that were read: it would be lost."""
    for source in read:
        if source is not None and path.exists() and Path(source).exists() and path.samefile(source):
            raise OutputError(f"{path}: this is a file that is read; give -o another name, so that it is kept")


def write_whole(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file so that it holds either all of ``data`` or what it held before, also after a crash.

    The bytes go to a temporary file beside it, reach the disk, and take the name at once; an error leaves nothing behind.
    Raises OutputError.
    """
    target = Path(path)
    temporary = target.parent / f".unshade-{secrets.token_hex(6)}.tmp"
    try:
        check_place(target)
        try:
            with open(temporary, "xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from error


def save_whole(path: str | os.PathLike[str], save: Callable[[BinaryIO], object]) -> None:
    """`write_whole` of what ``save`` puts into a file. Raises OutputError."""
    held = io.BytesIO()
    save(held)
    write_whole(path, held.getvalue())


def add_line(path: str | os.PathLike[str], line: str) -> None:
    """Add a line to a file, which is made where there is none; a last line that a kill or a full disk cut short stays one of its own.

    Raises OutputError.
    """
    try:
        with open(path, "a+b") as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
            begins = b"" if file.read(1) in (b"", b"\n") else b"\n"
            file.write(begins + line.encode() + b"\n")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error
