"""Files on a disk that is full or after a kill: what was there before stays, and one line says what is wrong."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from unshade.bench.journal import Journal
from unshade.errors import OutputError
from unshade.files import add_line, save_whole
from unshade.training_log import Log

FIELDS = ("name",)


@contextlib.contextmanager
def room(size: int) -> Iterator[None]:
    """No file may grow over so many bytes, as on a disk that is full."""
    if sys.platform == "win32":
        pytest.skip("needs a limit of files' sizes")
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_line_stands_alone_after_one_that_was_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    add_line(path, "one")
    add_line(path, "two")
    assert path.read_bytes() == b"one\ntwo\n"
    path.write_bytes(b"one\ntw")
    add_line(path, "three")
    assert path.read_bytes() == b"one\ntw\nthree\n"


def test_a_journal_survives_a_full_disk(tmp_path: Path) -> None:
    path = tmp_path / "out" / "journal"
    rows = [{"name": name, "text": "-" * 1000} for name in "abc"]
    journal = Journal(path, FIELDS)
    journal.add(rows[0])
    with room(1500):
        with pytest.raises(OutputError, match=f"cannot write {path}: File too large"):
            journal.add(rows[1])
        assert list(Journal(path, FIELDS).rows.values()) == rows[:1], "opening it writes nothing"
    again = Journal(path, FIELDS)
    again.add(rows[2])
    assert list(Journal(path, FIELDS).rows.values()) == [rows[0], rows[2]]


def test_the_curves_of_a_training_survive_a_full_disk(tmp_path: Path) -> None:
    log = Log(tmp_path, 0)
    for step in range(40):
        log.add(step, {"loss": 1.0}, "train")
    log.close()
    before = (tmp_path / "log.jsonl").read_text()
    with room(500), pytest.raises(OutputError, match=r"cannot write .*log\.jsonl: File too large"):
        Log(tmp_path, 39)
    assert (tmp_path / "log.jsonl").read_text() == before


def test_a_picture_is_whole_or_the_one_before(tmp_path: Path) -> None:
    path, picture = tmp_path / "a.png", Image.effect_noise((64, 64), 50.0)
    save_whole(path, lambda file: picture.save(file, "PNG"))
    before = path.read_bytes()
    with room(1000), pytest.raises(OutputError, match="File too large"):
        save_whole(path, lambda file: picture.rotate(90).save(file, "PNG"))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
