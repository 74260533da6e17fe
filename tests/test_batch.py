"""Many pictures in one call: names of folders, what is done already, workers, and folders that appear whole."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from unshade import batch, crew
from unshade.batch import Job, Log, Settings, assign_folders, find_pictures, folder_name
from unshade.errors import OutputError, PictureError
from unshade.staging import check_folder, staged, staging_folder

RECORD = {"input": "", "tree": "", "psnr": 40.0, "ssim": 0.99, "st_lpips": None, "values": 6, "leaves": 2, "seconds": 1.0, "seed": 0}


def finished(tmp_path: Path, picture: Path, name: str, settings: Settings | None = None) -> Job:
    """A picture that is done, in its folder and in the log."""
    job = Job(picture, tmp_path / "out" / name, settings or Settings())
    job.folder.mkdir(parents=True)  # type: ignore[union-attr]
    (job.folder / "tree.json").write_text("{}")  # type: ignore[operator]
    Log(tmp_path / "out").add(job, RECORD | {"input": str(picture)})
    return job


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "ball.png"
    path.write_bytes(b"picture")
    return path


@pytest.mark.parametrize(
    ("given", "made"),
    [("ball.png", "ball"), ("a.b.png", "a.b"), ("con.png", "con_"), ("aux.x.png", "aux.x_"), ("a?b:c.png", "a_b_c"), ("end. .png", "end")]
    + [(".png", "png"), ("results.jsonl.png", "results.jsonl_"), ("x" * 200 + ".png", "x" * 100)],
)
def test_folder_names_work_on_every_system(given: str, made: str) -> None:
    assert folder_name(Path(given)) == made


def test_pictures_with_one_stem_get_folders_of_their_own(tmp_path: Path) -> None:
    pictures = [Path("a/ball.png"), Path("b/ball.jpg"), Path("b/BALL.png"), Path("b/ball-2.png"), Path("c/cube.png")]
    names = assign_folders(pictures, Log(tmp_path))
    assert names == ["ball", "ball-2", "BALL-3", "ball-2-2", "cube"]


def test_a_later_call_does_not_take_the_folder_of_another_picture(tmp_path: Path, picture: Path) -> None:
    finished(tmp_path, picture, "ball")
    other = tmp_path / "elsewhere" / "ball.png"
    assert assign_folders([other, picture], Log(tmp_path / "out")) == ["ball-2", "ball"]


def test_find_pictures_takes_files_as_named_and_folders_by_suffix(tmp_path: Path) -> None:
    for name in ("b.png", "a.JPG", "notes.txt", ".hidden.png"):
        (tmp_path / name).write_bytes(b"")
    named = tmp_path / "notes.txt"
    again = tmp_path / "x" / ".." / "b.png"
    assert find_pictures([named, tmp_path, tmp_path / "b.png", again]) == [named, tmp_path / "a.JPG", tmp_path / "b.png"]


def test_a_folder_without_pictures_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(PictureError, match=r"expected a folder with pictures .* found none"):
        find_pictures([tmp_path])


def test_finished_needs_the_same_settings_picture_and_a_tree(tmp_path: Path, picture: Path) -> None:
    job = finished(tmp_path, picture, "ball")
    assert Log(tmp_path / "out").finished(job) == RECORD | {"input": str(picture), "tree": str(job.folder / "tree.json")}  # type: ignore[operator]
    assert Log(tmp_path / "out").finished(Job(picture, job.folder, Settings(seed=1))) is None
    picture.write_bytes(b"another picture")
    assert Log(tmp_path / "out").finished(job) is None
    picture.write_bytes(b"picture")
    assert Log(tmp_path / "out").finished(job) is not None
    (job.folder / "tree.json").unlink()  # type: ignore[operator]
    assert Log(tmp_path / "out").finished(job) is None


def test_what_is_in_the_mask_counts_among_the_settings(tmp_path: Path, picture: Path) -> None:
    mask = tmp_path / "mask.png"
    mask.write_bytes(b"mask")
    job = finished(tmp_path, picture, "ball", Settings(mask=str(mask)))
    assert Log(tmp_path / "out").finished(job) is not None
    mask.write_bytes(b"other")
    assert Log(tmp_path / "out").finished(job) is None


def test_the_log_survives_a_line_that_was_cut_off(tmp_path: Path, picture: Path) -> None:
    first = finished(tmp_path, picture, "ball")
    log = tmp_path / "out" / "results.jsonl"
    log.write_bytes(log.read_bytes() + b'{"folder": "cut')
    other = tmp_path / "other.png"
    other.write_bytes(b"other")
    second = finished(tmp_path, other, "other")
    assert Log(tmp_path / "out").finished(first) is not None
    assert Log(tmp_path / "out").finished(second) is not None
    assert len(log.read_text().splitlines()) == 3


def test_failures_are_not_logged(tmp_path: Path, picture: Path) -> None:
    job = Job(picture, tmp_path / "ball", Settings())
    Log(tmp_path).add(job, batch.failure(picture, "no sphere", 3))
    assert not (tmp_path / "results.jsonl").exists()


def test_a_failure_is_one_line_that_names_the_picture() -> None:
    assert batch.failure(Path("a.png"), "no\n  sphere", 3) == {"input": "a.png", "error": "a.png: no sphere", "exit_code": 3}
    assert batch.failure(Path("a.png"), "a.png: no sphere", 3)["error"] == "a.png: no sphere"


def test_records_come_in_the_order_of_their_pictures() -> None:
    jobs = [Job(Path(name), None, Settings()) for name in "abcd"]
    seen: list[str] = []
    printed = batch.InOrder(jobs, lambda record: seen.append(record["input"]))
    for name in "cab":
        printed.add(jobs["abcd".index(name)], {"input": name})
    assert seen == ["a", "b", "c"]
    printed = batch.InOrder(jobs, lambda record: seen.append(record["input"]))
    seen.clear()
    printed.add(jobs[3], {"input": "d"})
    printed.add(jobs[1], {"input": "b"})
    printed.flush()
    assert seen == ["b", "d"]


def lost(job: object, code: int | None) -> str:
    return f"{job} lost with {code}"


def test_workers_do_every_job_once() -> None:
    numbers = list(range(20))
    answers = dict(crew.run(numbers, 2, functools.partial(pow, 2), lost, lambda job: None))
    assert answers == {number: 2**number for number in numbers}


def test_a_process_that_dies_costs_only_its_own_job() -> None:
    abandoned: list[object] = []
    jobs = ["import os; os._exit(7)", "1", "2", "3"]
    found = dict(crew.run(jobs, 2, exec, lost, abandoned.append))
    assert found == {jobs[0]: f"{jobs[0]} lost with 7", "1": None, "2": None, "3": None}
    assert abandoned == [jobs[0]]


@pytest.mark.skipif(os.name == "nt", reason="Windows blocks no signals")
@pytest.mark.parametrize("threads", [0, 1], ids=["alone", "beside a thread that may be sent the signal"])
def test_an_interrupt_waits_until_a_process_has_started(threads: int) -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    over = threading.Event()
    for _ in range(threads):
        threading.Thread(target=over.wait, daemon=True).start()
    asked = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"
    told = []
    try:
        with pytest.raises(KeyboardInterrupt), crew._uninterrupted():
            os.kill(os.getpid(), signal.SIGINT)
            told.append(subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout.strip())
        assert told == ["True"], "the work went on, and the process that it started knows no interrupt"
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    finally:
        over.set()
        signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_workers_leave_interrupts_to_the_parent() -> None:
    jobs = [f"import os, signal; os.kill(os.getpid(), signal.SIGINT); {k}" for k in range(3)]
    assert dict(crew.run(jobs, 2, exec, lost, lambda job: None)) == dict.fromkeys(jobs)


def test_closing_ends_the_workers_and_cleans_up() -> None:
    abandoned: list[float] = []
    begin = time.monotonic()
    answers = crew.run([0.0, 60.0, 60.0, 60.0], 2, time.sleep, lost, abandoned.append)
    assert next(answers) == (0.0, None)
    answers.close()
    assert time.monotonic() - begin < 20
    assert abandoned
    assert set(abandoned) == {60.0}


def test_a_staged_folder_appears_whole(tmp_path: Path) -> None:
    with staged(tmp_path / "out" / "ball") as staging:
        (staging / "tree.json").write_text("new")
        assert not (tmp_path / "out" / "ball").exists()
    assert (tmp_path / "out" / "ball" / "tree.json").read_text() == "new"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["ball"]


def test_a_failure_while_staging_leaves_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "ball"
    folder.mkdir()
    (folder / "tree.json").write_text("old")
    with pytest.raises(KeyboardInterrupt), staged(folder) as staging:
        (staging / "tree.json").write_text("new")
        raise KeyboardInterrupt
    assert (folder / "tree.json").read_text() == "old"
    assert not staging_folder(folder).exists()


def test_a_failure_while_staging_leaves_no_new_folder(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"), staged(tmp_path / "out" / "ball"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_staging_again_replaces_what_was_made_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "ball"
    (folder / "layers").mkdir(parents=True)
    for name in ("tree.json", "render.png", "layers/old.png", "notes.txt"):
        (folder / name).write_text("old")
    with staged(folder) as staging:
        (staging / "tree.json").write_text("new")
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "tree.json"]
    assert (folder / "tree.json").read_text() == "new"


def test_check_folder_refuses_a_file_on_the_way(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(OutputError, match="is a file"):
            check_folder(folder)
    check_folder(tmp_path / "new" / "out")
    assert not (tmp_path / "new").exists()


def test_settings_are_told_apart_by_their_fingerprint(picture: Path) -> None:
    plain = Settings().fingerprint(picture)
    assert plain == json.loads(json.dumps(plain))
    learned = Settings(method="learned").fingerprint(picture)
    assert Settings(method="learned", device="cuda").fingerprint(picture) != learned != plain
    for other in (
        Settings(seed=1),
        Settings(preset="best"),
        Settings(max_values=9),
        Settings(disc=(1.0, 2.0, 3.0)),
        Settings(search="depth"),
    ):
        assert other.fingerprint(picture) != plain


def test_cores_is_a_positive_number() -> None:
    assert 1 <= crew.cores() <= (os.cpu_count() or 1)


def test_jobs_side_by_side_answer_in_order_and_change_nothing_here() -> None:
    told: list[int] = []

    def job(number: int) -> tuple[int, int, torch.Tensor]:
        told.append(number)
        time.sleep(0.2 if number == 0 else 0.0)
        return number, os.getpid(), torch.full((2,), float(number))

    jobs = [functools.partial(job, number) for number in range(5)]
    found = list(crew.side_by_side(jobs, 2))
    assert [number for number, _, _ in found] == [0, 1, 2, 3, 4]
    assert all(torch.equal(tensor, torch.full((2,), float(number))) for number, _, tensor in found)
    copies = {process for _, process, _ in found}
    if sys.platform == "linux":
        assert len(copies) == 2 and os.getpid() not in copies and not told
    assert {process for _, process, _ in crew.side_by_side(jobs, 1)} == {os.getpid()} and told[-5:] == [0, 1, 2, 3, 4]


@pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")
def test_what_fails_in_a_copy_is_done_again_here() -> None:
    here = os.getpid()

    def dies() -> str:
        if os.getpid() != here:
            os._exit(9)
        return "here"

    def raises() -> str:
        raise ArithmeticError(f"in {os.getpid()}")

    assert list(crew.side_by_side([dies, lambda: "there", dies], 2)) == ["here", "there", "here"]
    answers = crew.side_by_side([lambda: "first", raises], 2)
    assert next(answers) == "first"
    with pytest.raises(ArithmeticError, match=str(here)):
        next(answers)


def test_a_worker_of_a_crew_makes_no_copies() -> None:
    asked = "[*__import__('unshade.crew').crew.side_by_side([__import__('os').getpid] * 3, 2), __import__('os').getpid(), {}]"
    answers = crew.run([asked.format(number) for number in range(2)], 2, eval, lost, lambda job: None)
    assert all(len(set(processes)) == 1 and processes[0] != os.getpid() for _, (*processes, _) in answers)


@pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")
def test_where_no_process_can_be_made_jobs_are_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses() -> int:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refuses)
    assert list(crew.side_by_side([os.getpid] * 3, 2)) == [os.getpid()] * 3


@pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")
def test_what_cannot_be_told_by_a_copy_is_done_again_here() -> None:
    answers = list(crew.side_by_side([lambda: (os.getpid(), threading.Lock()), os.getpid], 2))
    assert answers[0][0] == os.getpid() != answers[1]  # type: ignore[index]


UNTIL_KILLED = """
import os, signal, sys, time
from unshade import crew
def lasts():
    print(os.getpid(), flush=True)
    time.sleep({seconds})
    return os.getpid()
signal.signal(signal.SIGTERM, signal.default_int_handler)
answers = crew.side_by_side([os.getpid, lasts, lasts], 2)
next(answers)
{then}
"""


@pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")
@pytest.mark.parametrize(
    ("seconds", "then"),
    [(60.0, "answers.close()"), (60.0, ""), (60.0, "os.killpg(0, signal.SIGTERM)"), (2.0, "os.kill(os.getpid(), signal.SIGKILL)")],
    ids=["closed", "left alone", "told to end, all of them", "killed"],
)
def test_copies_end_with_what_asked_for_them(seconds: float, then: str) -> None:
    # A copy that works when this process is killed ends its job first.
    wait = "time.sleep(0.5)\n"
    script = UNTIL_KILLED.format(seconds=seconds, then=wait + then)
    begin = time.monotonic()
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=50, start_new_session=True)
    copies = [int(line) for line in ran.stdout.split()]
    assert 1 <= len(copies) <= 2 and time.monotonic() - begin < 50
    # Only the process itself may say that it was interrupted.
    assert ran.stderr.count("Traceback") <= (1 if "SIGTERM" in then else 0) and "Process Fork" not in ran.stderr
    deadline = time.monotonic() + 30
    while any(_runs(copy) for copy in copies) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(_runs(copy) for copy in copies)


def _runs(process: int) -> bool:
    try:
        # A process that has ended, and whose parent has not asked yet, is a zombie.
        return (Path("/proc") / str(process) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
