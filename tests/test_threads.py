"""Threads of PyTorch: how many compute, and jobs side by side whose answers do not depend on how many there are."""

from __future__ import annotations

import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import pytest
import torch

from unshade.inference import Inference, Networks, infer
from unshade.models import weights
from unshade.threads import at_once, threads

CPU = torch.device("cpu")
EXAMPLE = Path(__file__).parents[1] / "examples" / "red_lacquer.png"


@pytest.mark.parametrize("count", [1, 2, 3])
def test_jobs_run_side_by_side_each_with_one_thread_and_the_derivatives_of_the_caller(count: int) -> None:
    together = threading.Barrier(count, timeout=30.0)

    def job(number: int) -> tuple[int, int, bool]:
        together.wait()
        # To ask is what sets it in a new thread, so that a thread begins with one is not seen here.
        return number, torch.get_num_threads(), torch.is_grad_enabled()

    for derivatives in (True, False):
        with threads(count), torch.set_grad_enabled(derivatives):
            assert at_once([partial(job, number) for number in range(2 * count)], CPU) == [(k, 1, derivatives) for k in range(2 * count)]
            assert torch.get_num_threads() == count


def test_a_job_that_fails_is_told_and_threads_are_as_before() -> None:
    with threads(2):
        with pytest.raises(ZeroDivisionError):
            at_once([lambda: 1, lambda: 1 // 0], CPU)
        assert torch.get_num_threads() == 2


@pytest.mark.skipif(not weights.available(), reason="no weights ship with this checkout")
def test_networks_find_the_same_pools_on_any_number_of_threads() -> None:
    """To the last bit, with the networks that ship: small ones are too small for PyTorch to share."""
    image = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(1))
    found = []
    for count in (1, 2, 3):
        with threads(count):
            *_, last = infer(image, Networks.load(), Inference(samples=12, draws=1, stop=10.0), seed=5)
        found.append([(part.kind, part.operator, part.image, part.codes.bottom, part.mask) for pool in last.pools for part in pool.parts])
    assert len(found[0]) > 3
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            assert one[:2] == same[:2]
            assert all(a is b is None or torch.equal(a, b) for a, b in zip(one[2:], same[2:], strict=True))


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="PyTorch has no TorchScript for this Python")
@pytest.mark.parametrize(("method", "scripted"), [("search", False), ("learned", True), ("hybrid", True)])
def test_a_command_forgoes_torchscript_only_where_no_network_is_asked(method: str, scripted: bool, tmp_path: Path) -> None:
    code = "import sys, torch; print(torch.jit._state._enabled.enabled); sys.exit(0)"
    code = f"from unshade import batch, cli; batch._read = lambda job: exec({code!r}); cli.main()"
    words = ["decompose", str(EXAMPLE), "--method", method, "-o", str(tmp_path)]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == str(scripted)
