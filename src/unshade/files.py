"""Writing a file whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path

from unshade.errors import OutputError


def write_whole(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file so that it holds either all of ``data`` or what it held before, also after a crash.

    The bytes go to a temporary file beside it, reach the disk, and take the name at once; an error leaves nothing behind.
    Raises OutputError.
    """
    target = Path(path)
    temporary = target.parent / f".unshade-{secrets.token_hex(6)}.tmp"
    try:
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
