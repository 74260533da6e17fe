"""What is for a GPU too, on one that is pretended: no tensor on the other side, and the numbers of the CPU."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from lit_spheres import PAINTED, picture
from pretended_gpu import GPU, DevicesError, pretended_gpu
from unshade import train
from unshade.decompose import Result, decompose
from unshade.inference import Inference, Networks, infer
from unshade.learned import Settings
from unshade.models.config import TrainingConfig, find
from unshade.node_image import node_image
from unshade.processes import Place
from unshade.sphere import disc_mask
from unshade.train import Run

DRAWN = Inference(samples=2, stop=10.0, depth=2, hidden=0.0)
"""Networks that know nothing are taken at their word."""


def test_the_pretended_gpu_refuses_what_a_gpu_would() -> None:
    here = torch.ones(3)
    with pretended_gpu():
        there = here.to("cuda")
        assert there.device == GPU and there.is_cuda and here.device.type == "cpu"
        for wrong in (lambda: here + there, lambda: torch.cat([there, here]), lambda: here[there > 0.0], lambda: there.numpy()):
            with pytest.raises(DevicesError):
                wrong()
        assert (there + torch.tensor(1.0)).device == GPU and there[here > 0.0].device == GPU, "as PyTorch has it"
        layer = torch.nn.Linear(3, 2).to(GPU)
        assert layer.weight.device == layer(there).device == GPU
        layer(there).sum().backward()
        assert layer.weight.grad is not None and layer.weight.grad.device == GPU
        there += there.cpu().to(there.device)
        assert there.tolist() == [2.0] * 3 and there.cpu().numpy().tolist() == [2.0] * 3


@pytest.fixture(scope="module", autouse=True)
def _few_evaluated() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("EVALUATED", "EVALUATED_LAST"):
            patch.setattr(train, name, 1)
        patch.setattr(train, "EVALUATION_BATCH", 2)
        yield


def trained(folder: Path, place: Place) -> dict[str, list[dict[str, float]]]:
    """Losses and figures of every model after two steps."""
    tiny = find("tiny")
    short = dataclasses.replace(tiny, training={task: TrainingConfig(2, 4, 3e-3, warmup=3) for task in tiny.training})
    runs = {task: Run(task, short, folder, precision="float32", report_every=1, evaluate_every=2) for task in train.TASKS}
    return {task: [{"loss": done.loss, **done.test} for done in train.train(run, place) if done.figures] for task, run in runs.items()}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of networks that were trained on it, all of them, which took the same steps on the CPU."""
    gpu, cpu = (tmp_path_factory.mktemp(name) for name in ("gpu", "cpu"))
    with pretended_gpu() as device:
        there = trained(gpu, Place(0, 1, device, lambda: False))
    here = trained(cpu, Place(0, 1, torch.device("cpu"), lambda: False))
    assert there == here
    return gpu / "weights"


@pytest.mark.slow
def test_networks_that_learn_on_a_gpu_draw_there(weights: Path) -> None:
    image = node_image(picture(PAINTED), disc_mask(96), 16)
    *_, here = infer(image, Networks.load(weights), DRAWN, 5)
    with pretended_gpu():
        networks = Networks.load(weights, "cuda:0")
        *_, there = infer(image, networks, DRAWN, 5)
        assert networks.device == GPU and all(part.image.device == GPU for part in there.pools[0].parts)
    assert there.drawn == here.drawn > 1
    for one, other in zip(here.pools, there.pools, strict=True):
        assert [(part.kind, part.state, part.operator) for part in one.parts] == [(p.kind, p.state, p.operator) for p in other.parts]
        for part, same in zip(one.parts, other.parts, strict=True):
            torch.testing.assert_close(part.image, same.image, atol=1e-4, rtol=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["learned", "hybrid"])
def test_only_networks_are_on_the_gpu(
    method: str, weights: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fits are on the CPU, those in copies of the process among them, which a GPU would refuse."""
    monkeypatch.setenv("UNSHADE_DEBUG", "1")  # a copy tells why it failed; its job would be done here
    settings = Settings(inference=DRAWN, device="cuda:0", threads=2)
    with pretended_gpu():
        work = decompose(picture(PAINTED), preset="draft", method=method, weights=weights, settings=settings)
        found: Result = work.result()
    assert found.stages is not None and found.stages["method"] == method and found.stages["drawn_nodes"] > 1
    assert "DevicesError" not in capfd.readouterr().err
