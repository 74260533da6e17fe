"""The curves of a training run: a line of JSON a report, and the same for TensorBoard where it is installed."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from unshade.errors import OutputError
from unshade.files import add_line, write_whole


class Log:
    """``folder/log.jsonl`` and ``folder/tensorboard``. What an earlier run wrote after ``step`` is taken back: it will come again."""

    def __init__(self, folder: Path, step: int, writes: bool = True) -> None:
        self.path = folder / "log.jsonl"
        self.notes: list[str] = []
        self._board: Any = None
        self._writes = writes
        if not writes:
            return
        try:
            folder.mkdir(parents=True, exist_ok=True)
            kept = [line for line in self._lines() if _step(line) <= step]
            write_whole(self.path, "".join(f"{line}\n" for line in kept).encode())
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror or error}") from None
        try:
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)
        except ImportError:
            self.notes.append("no TensorBoard logs: it is not installed (pip install 'unshade[train]'); log.jsonl has the same curves")

    def _lines(self) -> list[str]:
        return self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else []

    def add(self, step: int, figures: dict[str, float], split: str) -> None:
        """Figures of the training or test split at a step. Raises OutputError."""
        if not self._writes:
            return
        add_line(self.path, json.dumps({"step": step, "split": split, **figures}))
        if self._board is not None:
            for name, value in figures.items():
                self._board.add_scalar(f"{split}/{name}", value, step)

    def close(self) -> None:
        """Let TensorBoard write what it holds back."""
        if self._board is not None:
            self._board.close()


def _step(line: str) -> float:
    """The step of a line; a line that a kill cut short belongs to no step."""
    with contextlib.suppress(ValueError, TypeError, KeyError):
        return int(json.loads(line)["step"])
    return float("inf")
