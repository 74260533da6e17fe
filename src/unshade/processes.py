"""Where a training run takes place: the device, several processes under torchrun, the seed of a step, and a polite end on Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType

import torch
import torch.distributed
from torch import Tensor, nn

from unshade.errors import UnshadeError


class DeviceError(UnshadeError):
    """A device or precision that is not there."""


@dataclass(frozen=True)
class Place:
    """This process among all, its device, and whether a person asked it to stop."""

    rank: int
    processes: int
    device: torch.device
    asked: Callable[[], bool]

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    def average_gradients(self, model: nn.Module) -> None:
        """Data parallelism: every process then takes the same step. All gradients go in one message."""
        if self.processes == 1:
            return
        gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in model.parameters() if p.requires_grad]
        message = torch.cat([gradient.flatten() for gradient in gradients])
        torch.distributed.all_reduce(message)
        message /= self.processes
        offset = 0
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter.grad = message[offset : offset + parameter.numel()].view_as(parameter)
                offset += parameter.numel()

    def anyone(self, here: bool) -> bool:
        """Whether it is so in any process; all must ask at the same step."""
        if self.processes == 1:
            return here
        answer: Tensor = torch.tensor(float(here), device=self.device)
        torch.distributed.all_reduce(answer, torch.distributed.ReduceOp.MAX)
        return bool(answer > 0)


@contextlib.contextmanager
def place() -> Iterator[Place]:
    """The GPU where there is one, else the CPU; joined to the others where torchrun set WORLD_SIZE.

    Once for all that a command trains: torchrun's processes can meet only once.
    """
    gpu = torch.cuda.is_available()
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    if processes == 1:
        with stop_flag() as asked:
            yield Place(0, 1, torch.device("cuda" if gpu else "cpu"), asked)
        return
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if gpu else torch.device("cpu")
    if gpu:
        torch.cuda.set_device(device)
    torch.distributed.init_process_group("nccl" if gpu else "gloo")
    try:
        with stop_flag(patient=True) as asked:
            yield Place(torch.distributed.get_rank(), processes, device, asked)
            torch.distributed.barrier()  # none may leave while another still talks to it
    finally:
        torch.distributed.destroy_process_group()


def precision(wanted: str, device: torch.device) -> torch.dtype:
    """The type of the large products: ``auto`` is bfloat16 on a GPU that has it. Raises DeviceError."""
    if wanted not in ("auto", "float32", "bfloat16"):
        raise DeviceError(f"unknown precision {wanted!r}; known: auto, float32, bfloat16")
    able = device.type == "cpu" or torch.cuda.is_bf16_supported(including_emulation=False)
    if wanted == "bfloat16" and not able:
        raise DeviceError(f"this GPU ({torch.cuda.get_device_name(device)}) has no bfloat16; use --precision float32")
    mixed = wanted == "bfloat16" or (wanted == "auto" and device.type == "cuda" and able)
    return torch.bfloat16 if mixed else torch.float32


@contextlib.contextmanager
def seeded(seed: int, step: int, rank: int = 0) -> Iterator[None]:
    """Inside, torch draws what belongs to this step and process alone; outside, nothing has happened."""
    with torch.random.fork_rng(devices=range(torch.cuda.device_count()) if torch.cuda.is_available() else []):
        torch.manual_seed(((seed * 1_000_003 + step) * 4_099 + rank) % (1 << 63))
        yield


@contextlib.contextmanager
def stop_flag(patient: bool = False) -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM only raise a flag, so that a step is never cut in two; the second Ctrl-C ends it at once.

    ``patient``: the first one counts and later ones do not, not even behind the block. For torchrun, which sends on what the terminal
    has sent already, and kills who takes longer than half a minute.
    """
    raised = threading.Event()

    def ask(number: int, frame: FrameType | None) -> None:
        if raised.is_set() and not patient:
            raise KeyboardInterrupt
        raised.set()

    if threading.current_thread() is not threading.main_thread():
        yield raised.is_set
        return
    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield raised.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if patient and raised.is_set() else handler)
