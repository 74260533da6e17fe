"""Jobs on several processes: one at a time each, a process that dies costs its own job only, an interrupt ends them all."""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from multiprocessing import resource_tracker
from typing import Any, Generic, Literal, TypeVar

Job = TypeVar("Job")
Answer = TypeVar("Answer")

_STARTING = threading.Lock()


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(
    jobs: Sequence[Job],
    workers: int,
    work: Callable[[Job], Answer],
    lost: Callable[[Job, int | None], Answer],
    abandoned: Callable[[Job], None] = lambda _: None,
    start: Literal["spawn", "fork"] = "spawn",
) -> Generator[tuple[Job, Answer]]:
    """Do the jobs on ``workers`` processes and yield each with its answer as it is done, in any order.

    Processes are spawned, hence ``work``, the jobs and the answers must be picklable; those that are forked know all that this one
    does, and ``work`` may be anything. One worker, or one job, is done in this process. Closing the generator, or an interrupt, ends
    the workers.

    Args:
        jobs: what to do.
        workers: most processes at once.
        work: does one job; it should not raise.
        lost: the answer for a job whose process died, from its exit code.
        abandoned: cleans up after a job that was cut short, where it leaves something behind.
        start: how a process begins; see `side_by_side` for what a fork asks.
    """
    if workers == 1 or len(jobs) <= 1:
        for job in jobs:
            yield job, work(job)
        return
    waiting = list(reversed(jobs))
    crew: list[_Worker[Job, Answer]] = []
    try:
        while waiting or crew:
            while waiting and len(crew) < workers:
                crew.append(_Worker(work, waiting.pop(), start))
            # With a time limit, since Windows cannot be interrupted in an endless wait.
            ready = multiprocessing.connection.wait([worker.pipe for worker in crew], timeout=0.5)
            for worker in [worker for worker in crew if worker.pipe in ready]:
                job = worker.job
                try:
                    answer = worker.take()
                except _Lost as loss:
                    answer = lost(job, loss.code)
                    abandoned(job)
                if worker.alive and waiting:
                    worker.give(waiting.pop())
                else:
                    crew.remove(worker)
                    worker.end()
                yield job, answer
    finally:
        for worker in crew:
            worker.end(at_once=True)
            abandoned(worker.job)


def side_by_side(jobs: Sequence[Callable[[], Answer]], workers: int) -> Generator[Answer]:
    """The answers of all jobs in their order, each as soon as it and those before it are there.

    Each job works on a copy of this process, which costs hundredths of a second and knows all that this one knows; what it changes there
    is lost, except for its answer, which must be picklable. A job that fails in a copy is done again here, so its error is raised here.
    Copies are made on Linux only; elsewhere, in a worker of a crew, and where there is one worker, jobs are done here, one after the other.

    A copy has none of the other threads: a job must not wait for them, hence compute with one thread of PyTorch, and neither print nor
    touch a GPU.
    """
    if sys.platform != "linux" or multiprocessing.current_process().daemon or workers < 2 or len(jobs) < 2:
        for job in jobs:
            yield job()
        return

    def work(place: int) -> bytes | None:
        try:
            # Pickled here, since a pipe would have PyTorch move tensors by files in shared memory.
            return pickle.dumps(jobs[place]())
        except Exception:  # noqa: BLE001 - whatever it is, it comes again where it can be raised
            if os.environ.get("UNSHADE_DEBUG"):
                traceback.print_exc()
            return None

    told: dict[int, bytes | None] = {}
    with contextlib.closing(run(range(len(jobs)), workers, work, lambda *_: None, start="fork")) as answers:
        for place, job in enumerate(jobs):
            while place not in told:
                try:
                    told.update([next(answers)])
                except OSError:  # no more processes, or no memory for them
                    told = dict.fromkeys(range(len(jobs))) | told
            yield _unpickled(told.pop(place), job)


def _unpickled(told: bytes | None, job: Callable[[], Answer]) -> Answer:
    """What a copy answered, or the job done here."""
    with contextlib.suppress(Exception):
        if told is not None:
            answer: Answer = pickle.loads(told)
            return answer
    return job()


class _Lost(Exception):  # noqa: N818 - a message from `take` to `run`, not an error to report
    def __init__(self, code: int | None) -> None:
        self.code = code


class _Worker(Generic[Job, Answer]):
    """One process and the job that it works on."""

    def __init__(self, work: Callable[[Job], Answer], job: Job, start: Literal["spawn", "fork"]) -> None:
        self.forked = start == "fork"
        process = multiprocessing.get_context("fork").Process if self.forked else multiprocessing.get_context("spawn").Process
        # One at a time, or a copy that another thread makes would hold both ends of this pipe.
        with _STARTING:
            self.pipe, other = multiprocessing.Pipe()
            # A copy holds both ends of its own pipe: it closes the one that is not its, or it would outlive this process.
            self.process = process(target=_serve, args=(other, work, self.pipe if self.forked else None), daemon=True)
            self.alive = True
            with _uninterrupted(self.forked), warnings.catch_warnings():
                # From Python 3.12 on: "This process is multi-threaded, use of fork() may lead to deadlocks in the child".
                warnings.simplefilter("ignore", DeprecationWarning)
                self.process.start()
            other.close()
        self.give(job)

    def give(self, job: Job) -> None:
        """Start on a job."""
        self.job = job
        # A process that died in the meantime is noticed by `take`.
        with contextlib.suppress(OSError):
            self.pipe.send(job)

    def take(self) -> Answer:
        """The answer to the job. Raises _Lost where the process died over it."""
        try:
            answer: Answer = self.pipe.recv()
        except (EOFError, OSError):
            self.alive = False
            self.process.join()
            raise _Lost(self.process.exitcode) from None
        return answer

    def end(self, at_once: bool = False) -> None:
        """Let the process go, after its job or now."""
        if self.forked:
            # It has nothing to put in order, and might wait for a lock that another thread held when it was copied.
            self.process.kill()
        elif at_once:
            self.process.terminate()
        self.pipe.close()
        self.process.join()


def _serve(
    pipe: multiprocessing.connection.Connection[Any, Any],
    work: Callable[[Any], Any],
    parents: multiprocessing.connection.Connection[Any, Any] | None = None,
) -> None:
    """A worker's life: jobs in, answers out, until the pipe closes. Ctrl-C is for the parent to handle."""
    if parents is not None:
        parents.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The command takes this as an interrupt too, which a copy would print.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(work(pipe.recv()))


@contextlib.contextmanager
def _uninterrupted(forked: bool = False) -> Iterator[None]:
    """Processes started in here know no Ctrl-C from their first moment on, before they can say so themselves.

    Here it waits: one that comes in the meantime interrupts at the end, when the new process has all that it needs.
    """
    if threading.current_thread() is not threading.main_thread() or sys.platform == "win32":
        yield
        return
    if not forked:
        # This process's helper lets signals through when it starts, so it starts first.
        resource_tracker.ensure_running()
    came: list[int] = []
    # Children inherit what is blocked. A thread that does not block it, such as a progress bar's, may still be sent it.
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)
