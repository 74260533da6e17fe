"""A GPU where there is none: tensors that say they are on one, are computed on the CPU, and refuse what a GPU would refuse.

An operation on tensors of both devices raises, and so does NumPy on what is on the GPU, or a forked process that touches it. So code
for a GPU is tested for what goes wrong most, a tensor on the other side, and has to give the CPU's numbers. It shows nothing of speed,
of the rounding of other kernels, or of a GPU's own random numbers.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

GPU = torch.device("cuda", 0)

CROSSING = {"copy_", "to", "cpu", "__set__", "_has_compatible_shallow_copy_type"}
"""What may have tensors of both devices."""

INDEXING = {"__getitem__", "__setitem__"}
"""What may have an index on the CPU."""


class DevicesError(RuntimeError):
    """What PyTorch would raise on a machine with a GPU."""


class _Generator(torch.Generator):
    """Draws on the CPU what it is asked for on the GPU."""

    def __new__(cls, device: Any = "cpu") -> _Generator:
        return super().__new__(cls, "cpu")


class _Mode(TorchFunctionMode):
    """Follows every tensor: those on the GPU carry a mark, ``far``."""

    def __init__(self) -> None:
        super().__init__()
        self.process = os.getpid()

    def __torch_function__(self, function: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        tensors = list(_tensors((*args, *kwargs.values())))
        name, owner = getattr(function, "__name__", ""), getattr(getattr(function, "__self__", None), "__name__", "")
        if name == "_parse_to" or not (any(map(_far, tensors)) or any(map(_is_gpu, (*args, *kwargs.values())))):
            return function(*args, **kwargs)
        if os.getpid() != self.process:
            raise DevicesError(f"{name}: cannot use a GPU in a forked process")
        if name == "__get__" and owner in ("device", "is_cuda"):
            return GPU if owner == "device" else True
        if name in ("numpy", "__array__"):
            raise DevicesError(f"{name}: a tensor on the GPU; use Tensor.cpu() first")
        alike = tensors[:1] + [value for value in tensors[1:] if _far(value)] if name in INDEXING else tensors
        if name not in CROSSING and any(value.dim() and not _far(value) for value in alike):
            sides = [f"{tuple(value.shape)} on the {'GPU' if _far(value) else 'CPU'}" for value in tensors]
            raise DevicesError(f"{name}: expected all tensors on one device, got {', '.join(sides)}")
        there = _goes_there(name, owner, args, kwargs, tensors)
        near = [["cpu" if _is_gpu(value) else value for value in values] for values in (args, kwargs.values())]
        found = function(*near[0], **dict(zip(kwargs, near[1], strict=True)))
        if owner == "data" and name == "__set__":
            args[0].far = there
        return _placed(found, there, tensors)


def _goes_there(name: str, owner: str, args: tuple[Any, ...], kwargs: dict[str, Any], tensors: list[Tensor]) -> bool:
    """Whether the result of an operation is on the GPU."""
    devices = [value for value in (*args[1:], kwargs.get("device")) if isinstance(value, (str, torch.device))]
    if name == "cpu":
        return False
    if devices and (name == "to" or kwargs.get("device") is not None):
        return _is_gpu(devices[-1])
    if name == "to" or owner == "data":
        return _far(tensors[-1])
    return _far(args[0]) if name in CROSSING else True


def _tensors(values: Any) -> Iterator[Tensor]:
    """All of them, in lists of lists too."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (tuple, list)):
            yield from _tensors(value)


def _far(value: Tensor) -> bool:
    return getattr(value, "far", False)


def _is_gpu(value: Any) -> bool:
    return isinstance(value, (str, torch.device)) and str(value).startswith("cuda")


def _placed(found: Any, there: bool, given: list[Tensor]) -> Any:
    """The results of an operation with their marks; what it was given keeps its own."""
    if isinstance(found, Tensor):
        if _far(found) != there:
            found = found.view_as(found) if any(found is value for value in given) else found
            found.far = there  # type: ignore[attr-defined]
        return found
    if type(found) in (tuple, list):
        return type(found)(_placed(part, there, given) for part in found)
    if isinstance(found, tuple):  # with names, such as of `max`
        for part in found:
            _placed(part, there, given)
    return found


@contextmanager
def pretended_gpu() -> Iterator[torch.device]:
    """Inside, PyTorch in this thread knows the device, ``cuda``."""
    no_cudnn = patch.object(torch.backends.cudnn, "is_acceptable", return_value=False)
    with patch.object(torch, "Generator", _Generator), no_cudnn, _Mode():
        yield GPU
