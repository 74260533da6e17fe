"""How many threads PyTorch computes with. Sums depend on how many share them; one gives the same bits everywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Answer = TypeVar("Answer")


@contextmanager
def threads(count: int) -> Iterator[None]:
    """So many inside, as before outside."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def at_once(jobs: Sequence[Callable[[], Answer]], device: torch.device) -> list[Answer]:
    """The answers of all jobs, on a CPU each computed by one thread, as many side by side as PyTorch may use.

    So an answer has the same bits however many threads there are. An interrupt waits for the jobs that have begun.
    """
    if device.type != "cpu":
        return [job() for job in jobs]
    count, derivatives = min(torch.get_num_threads(), len(jobs)), torch.is_grad_enabled()

    def answer(job: Callable[[], Answer]) -> Answer:
        # Whether derivatives are kept belongs to a thread.
        with torch.set_grad_enabled(derivatives):
            return job()

    with threads(1):
        if count < 2:
            return [job() for job in jobs]
        # A new thread begins with all cores, until its first operation asks how many it may use; not every one does.
        with ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(answer, jobs))
