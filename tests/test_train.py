"""The training loop: losses fall, a run that was stopped or killed ends as one that was not, and mistakes get one line."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from click.testing import CliRunner
from torch import Tensor

from unshade import model_card, processes, tasks, train
from unshade.checkpoint import CheckpointError
from unshade.cli import cli
from unshade.cli_train import MODELS
from unshade.errors import MissingWeightsError
from unshade.models import weights
from unshade.models.config import Config, TrainingConfig, find
from unshade.synthesis import Batch
from unshade.synthesis_shards import Plan, make
from unshade.tasks import overlap, psnr
from unshade.train import Run, learning_rate


def config(steps: int, batch: int = 4, rate: float = 3e-3) -> Config:
    tiny = find("tiny")
    return dataclasses.replace(tiny, training={name: TrainingConfig(steps, batch, rate, warmup=3) for name in tiny.training})


def run_of(folder: Path, task: str = "vqvae", steps: int = 8, **options: Any) -> Run:
    return Run(task, config(steps), folder, **{"report_every": 1, "evaluate_every": 4, **options})


def finish(run: Run) -> list[train.Progress]:
    return [progress for progress in train.train(run) if progress.figures]


def lines(run: Run) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run.folder / run.task / "log.jsonl").read_text().splitlines()]


def tensors(run: Run) -> dict[str, Tensor]:
    return safetensors.torch.load_file(run.state)


@pytest.fixture(scope="module", autouse=True)
def _few_evaluated() -> Iterator[None]:
    """One batch of each style says enough here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "EVALUATED", 1)
        patch.setattr(train, "EVALUATED_LAST", 1)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[train.Progress]]:
    """Every model trained for a few steps, one after the other, as `unshade train all` does."""
    folder = tmp_path_factory.mktemp("trained")
    steps = {"vqvae": 100, "prior": 40, "heads": 60, "reflection": 60}
    return {task: finish(Run(task, config(steps[task], 8), folder, report_every=10, evaluate_every=1000)) for task in MODELS}


@pytest.mark.parametrize("task", MODELS)
def test_the_loss_falls(task: str, trained: dict[str, list[train.Progress]]) -> None:
    losses = [progress.loss for progress in trained[task]]
    # Other pictures at every step: what a few of them reflect, a tiny network learns in `test_reflection_training`.
    assert losses[-1] < (0.9 if task == "reflection" else 0.8) * losses[0]
    figures = trained[task][-1].test
    assert {name.partition("_")[0] for name in figures} == {"realistic", "toon"}
    if task == "vqvae":
        assert figures["realistic_bottom_codes_used"] >= 5
        assert figures["toon_psnr"] > 12.0


@pytest.mark.parametrize("task", MODELS)
def test_resume_equals_no_interruption(task: str, tmp_path: Path) -> None:
    """Bit for bit, although the second run was killed between two saves."""
    whole, cut = run_of(tmp_path / "whole", task), run_of(tmp_path / "cut", task)
    if task == "prior":
        for run in (whole, cut):
            finish(run_of(run.folder, "vqvae", 4))
    finish(whole)
    for progress in train.train(cut):
        if progress.step == 6:
            break
    assert [line["step"] for line in lines(cut) if line["split"] == "train"] == [1, 2, 3, 4, 5, 6]
    seen = [progress.step for progress in train.train(cut)]
    assert seen == [4, 5, 6, 7, 8]
    assert lines(cut) == lines(whole)
    first, second = tensors(whole), tensors(cut)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[key], second[key]) for key in first)


def test_ctrl_c_ends_the_step_and_saves(tmp_path: Path) -> None:
    run = run_of(tmp_path, steps=8)
    before = signal.getsignal(signal.SIGINT)
    seen = []
    with pytest.raises(KeyboardInterrupt):
        for progress in train.train(run):
            seen.append(progress.step)
            if progress.step == 2:
                signal.raise_signal(signal.SIGINT)
    assert seen == [0, 1, 2]
    assert signal.getsignal(signal.SIGINT) is before
    assert next(train.train(run)).step == 2


def test_more_steps_may_be_asked_for_later(tmp_path: Path) -> None:
    finish(run_of(tmp_path, steps=2))
    assert [progress.step for progress in finish(run_of(tmp_path, steps=4))] == [3, 4]
    assert finish(run_of(tmp_path, steps=4)) == []


def test_a_second_call_says_what_it_finds(tmp_path: Path) -> None:
    def note(steps: int, rate: float = 3e-3) -> str:
        return next(train.train(Run("vqvae", config(steps, rate=rate), tmp_path))).notes[-1]

    finish(run_of(tmp_path, steps=2))
    assert note(2).startswith("done before, 2 of 2 steps; more --steps go on")
    assert "nothing was trained with learning_rate 0.5 instead of 0.003;" in note(2, rate=0.5)
    assert note(4, rate=0.5) == "going on from step 2, now with steps 4 instead of 2, learning_rate 0.5 instead of 0.003"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seed": 1}, "seed 0, not 1;"),
        ({"style": "toon"}, "style both, not toon;"),
        ({"precision": "bfloat16"}, "precision float32, not bfloat16;"),
        ({"batch": 5}, "begun with batch 4, not 5;"),
        ({"codes": 8, "batch": 5}, "begun with vqvae.codes 16, not 8; batch 4, not 5;"),
    ],
)
def test_a_run_goes_on_only_as_it_began(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    finish(run_of(tmp_path, steps=1))
    options = dict(change)
    wanted = config(2, options.pop("batch", 4))
    wanted = dataclasses.replace(wanted, vqvae=dataclasses.replace(wanted.vqvae, codes=options.pop("codes", wanted.vqvae.codes)))
    with pytest.raises(CheckpointError, match="choose another folder") as caught:
        finish(Run("vqvae", wanted, tmp_path, **options))
    assert said in str(caught.value) and "steps" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("broken", [3, 1])
def test_a_run_that_diverges_keeps_its_last_good_state(broken: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although it saves after every step here; and no state is named that is not there."""
    outcome, calls = tasks.VQVAETask.outcome, iter(range(1, 9))

    def diverges(self: tasks.VQVAETask, model: torch.nn.Module, batch: Batch) -> tasks.Outcome:
        found = outcome(self, model, batch)
        return dataclasses.replace(found, loss=found.loss * (torch.nan if next(calls) == broken else 1.0))

    monkeypatch.setattr(train, "SAVE_EVERY_SECONDS", -1.0)
    monkeypatch.setattr(tasks.VQVAETask, "outcome", diverges)
    run = run_of(tmp_path, report_every=100, evaluate_every=100)
    with pytest.raises(train.TrainingError, match=rf"the loss is nan.* at step {broken};") as caught:
        finish(run)
    assert run.state.exists() == (str(run.state) in str(caught.value)) == (broken > 1)
    if broken > 1:
        assert all(bool(value.isfinite().all()) for value in tensors(run).values())
        assert next(train.train(run)).step == broken - 1


@pytest.mark.parametrize("data", [b"", b"state", "cut"])
def test_a_damaged_state_is_one_line(data: bytes | str, tmp_path: Path) -> None:
    run = run_of(tmp_path, steps=1)
    finish(run)
    run.state.write_bytes(run.state.read_bytes()[:-9] if isinstance(data, str) else data)
    with pytest.raises(CheckpointError, match=r"damaged.*delete it") as caught:
        finish(run_of(tmp_path, steps=2))
    assert "\n" not in str(caught.value)


def test_shards_train_and_go_on(tmp_path: Path) -> None:
    """Bit for bit, over the ends of rounds."""
    plan = Plan("both", "train", 5, 16, 4, 2)
    made = make(plan, tmp_path / "data")
    assert made["examples"] < 12 * 4
    whole, cut = (run_of(tmp_path / name, steps=12, shards=tmp_path / "data") for name in ("whole", "cut"))
    finish(whole)
    for progress in train.train(cut):
        if progress.step == 6:
            break
    assert next(train.train(cut)).step == 4
    finish(cut)
    assert lines(cut) == lines(whole)
    assert all(torch.equal(value, tensors(cut)[key]) for key, value in tensors(whole).items())
    assert "shards: 4 trees of seed 5" in weights.read_card(weights.file_of("vqvae", whole.weights))["data"]
    with pytest.raises(CheckpointError, match=r"begun with shards 4 trees of seed 5 \(\w+\), not none;"):
        finish(run_of(whole.folder, steps=16))
    for change, said in (({"style": "toon"}, "style toon, got style both"), ({"task": "reflection"}, "whole trees")):
        with pytest.raises(train.TrainingError, match=said):
            finish(dataclasses.replace(whole, **change))
    with pytest.raises(train.UnshadeError, match="manifest"):
        finish(dataclasses.replace(whole, shards=tmp_path))


def test_the_command_trains_from_shards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With nothing drawn for them."""
    make(Plan("both", "train", 5, 16, 8, 4), tmp_path / "data")
    stream = tasks.Task.stream

    def only_tests(self: tasks.Task[Any], style: Any, split: str, **options: Any) -> Iterator[Any]:
        assert split == "test"
        return stream(self, style, split, **options)

    monkeypatch.setattr(tasks.Task, "stream", only_tests)
    for model in ("vqvae", "prior", "heads"):
        command = [
            "train",
            model,
            "--config",
            "tiny",
            "--steps",
            "2",
            "--shards",
            str(tmp_path / "data"),
            "-q",
            "-o",
            str(tmp_path / "run"),
        ]
        done = CliRunner().invoke(cli, command)
        assert done.exit_code == 0, (done.output, done.exception)
    done = CliRunner().invoke(cli, ["train", "all", "--config", "tiny", "--shards", str(tmp_path / "data"), "-o", str(tmp_path / "all")])
    assert "reflection learns from whole trees" in str(done.exception)
    assert not (tmp_path / "all").exists()


def test_prior_needs_a_vqvae_of_its_configuration(tmp_path: Path) -> None:
    with pytest.raises(MissingWeightsError, match="vqvae"):
        finish(run_of(tmp_path, "prior"))
    finish(run_of(tmp_path, steps=1))
    other = dataclasses.replace(config(2), name="other", vqvae=dataclasses.replace(config(2).vqvae, codes=8))
    with pytest.raises(train.UnshadeError, match="does not fit 'other'"):
        finish(Run("prior", other, tmp_path))


def test_without_tensorboard_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    run = run_of(tmp_path, steps=1)
    notes = next(train.train(run)).notes
    assert any("unshade[train]" in note for note in notes)


def test_what_a_run_leaves(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    run = run_of(tmp_path, steps=2, evaluate_every=2)
    finish(run)
    names = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert {"vqvae/pictures/0000002-toon.png", "vqvae/log.jsonl", "weights/vqvae.safetensors"} <= names
    assert any(name.startswith("vqvae/tensorboard/events") for name in names)
    card = weights.read_card(weights.file_of("vqvae", run.weights))
    assert (card["steps"], card["examples"], card["config"]) == (2, 8, "tiny")
    # Not `auto`, which says nothing about what was computed.
    assert run.precision == "auto" and card["precision"] in ("float32", "bfloat16")


def test_a_run_changes_nothing_around_it(tmp_path: Path) -> None:
    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    finish(run_of(tmp_path, steps=1))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_learning_rate_rises_holds_and_falls() -> None:
    training = TrainingConfig(steps=100, batch=1, learning_rate=1.0, warmup=10, decay=0.5)
    rates = [learning_rate(training, step) for step in range(100)]
    assert rates[0] == 0.1
    assert rates[10:50] == [1.0] * 40
    assert 0.0 < rates[99] < 0.05


def test_figures_are_right() -> None:
    from unshade.metrics import psnr as reference

    a, b = torch.rand(2, 3, 32, 32), torch.rand(2, 3, 32, 32)
    assert psnr(a, b).tolist() == pytest.approx([reference(x, y) for x, y in zip(a, b, strict=True)], rel=1e-4)
    half = torch.zeros(2, 1, 8, 8, dtype=torch.bool)
    half[0, :, :, :4] = True
    assert overlap(half, torch.ones_like(half)).tolist() == pytest.approx([0.5, 0.0])
    assert overlap(half, half).tolist() == [1.0, 1.0]


def test_precision_is_known() -> None:
    assert processes.precision("auto", torch.device("cpu")) == torch.float32
    with pytest.raises(processes.DeviceError, match="float16"):
        processes.precision("float16", torch.device("cpu"))


def test_mixed_precision_trains(tmp_path: Path) -> None:
    """Its losses are rounded more coarsely than those of float32, and lead to the same place."""
    runs = {precision: run_of(tmp_path / precision, steps=4, precision=precision) for precision in ("float32", "bfloat16")}
    losses = {precision: [progress.loss for progress in finish(run)] for precision, run in runs.items()}
    assert all(mixed != exact for mixed, exact in zip(losses["bfloat16"], losses["float32"], strict=True))
    assert losses["bfloat16"] == pytest.approx(losses["float32"], rel=0.02)


def test_the_command_trains_all(tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["train", "all", "--config", "tiny", "--steps", "2", "-o", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    reports = [json.loads(line) for line in done.stdout.splitlines()]
    assert [report["task"] for report in reports] == list(MODELS)
    page = (tmp_path / "weights" / "model-card.md").read_text(encoding="utf-8")
    assert all(title in page for title in model_card.TITLES.values())
    assert "one run of `unshade train`" in page and "that ship" not in page and "baselines" not in page
    # Drawings reflect nothing, so two figures of one model are of realistic trees alone.
    assert page.count("–") == 2 == page.split("## Reflection")[1].count("–")
    assert weights.available(tmp_path / "weights")


def test_the_commands_mistakes(tmp_path: Path) -> None:
    from unshade.cli import run

    assert run(["train", "vqvae", "--config", "smal", "-o", str(tmp_path)]) == 2
    assert run(["train", "prior", "--config", "tiny", "-o", str(tmp_path)]) == 6
    (tmp_path / "file").write_text("")
    assert run(["train", "vqvae", "--config", "tiny", "-o", str(tmp_path / "file")]) == 5


@pytest.mark.parametrize("rate", ["nan", "inf", "-inf", "0", "-0.1"])
def test_a_rate_is_a_number_over_0(rate: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from unshade.cli import run

    assert run(["train", "vqvae", "--config", "tiny", "--steps", "1", f"--rate={rate}", "-o", str(tmp_path / "run")]) == 2
    assert "expected a finite learning rate over 0" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_the_command_knows_every_task() -> None:
    assert set(MODELS) <= set(train.TASKS)


TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "unshade"]


@pytest.mark.slow
def test_two_processes_train_all(tmp_path: Path) -> None:
    """Under torchrun they meet once for all four models, and the first one speaks."""
    command = [*TORCHRUN, "train", "all", "--config", "tiny", "--steps", "2", "-o", str(tmp_path), "--json"]
    done = subprocess.run(command, capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr.decode()
    assert [json.loads(line)["task"] for line in done.stdout.splitlines()] == list(MODELS)
    assert weights.read_card(weights.file_of("vqvae", tmp_path / "weights"))["examples"] == 2 * 4 * 2


def test_the_command_joins_one_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second group of the same processes often cannot connect."""
    places, place = [], processes.place

    @contextlib.contextmanager
    def counted() -> Iterator[processes.Place]:
        with place() as found:
            places.append(found)
            yield found

    monkeypatch.setattr(processes, "place", counted)
    done = CliRunner().invoke(cli, ["train", "all", "--config", "tiny", "--steps", "1", "-q", "-o", str(tmp_path)])
    assert (done.exit_code, len(places)) == (0, 1), done.output


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_two_processes_stop_quietly(tmp_path: Path) -> None:
    """Ctrl-C reaches them from the terminal and once more from torchrun; what torchrun sets is set by hand, to see how each ends."""
    command = [sys.executable, "-m", "unshade", "train", "all", "--config", "tiny", "--steps", "100000", "-o", str(tmp_path), "--json"]
    base = {**os.environ, "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(20_000 + os.getpid() % 20_000)}
    started = [
        subprocess.Popen(command, env={**base, "RANK": str(rank), "LOCAL_RANK": str(rank)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for rank in range(2)
    ]
    try:
        assert started[0].stdout is not None and started[0].stdout.readline()
        for _ in range(2):
            for process in started:
                process.send_signal(signal.SIGINT)
            time.sleep(0.1)
        outputs = [process.communicate(timeout=120)[1].decode() for process in started]
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [130, 130], outputs
    assert outputs[0].count("interrupted") == 1 and "Traceback" not in outputs[0]
    assert outputs[1] == ""
    run = run_of(tmp_path)
    assert json.loads(safetensors.safe_open(run.state, "pt").metadata()["position"])["step"] >= 50


def test_the_model_cards_are_of_the_weights_that_ship() -> None:
    """The page of the documentation, and the one in the package."""
    root = Path(__file__).resolve().parent.parent
    assert (root / "docs" / "model-card.md").read_text(encoding="utf-8") == model_card.page(weights.FOLDER, weights.BASELINE_FOLDER)
    assert (weights.FOLDER / model_card.CARD).read_text(encoding="utf-8") == model_card.page(weights.FOLDER)
    packaged = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["package-data"]["*"]
    assert {"weights/*.safetensors", "weights/*.md"} <= set(packaged)
