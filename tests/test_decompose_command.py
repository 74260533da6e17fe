"""The command with the real decomposition: one answer whatever the workers, an interrupt, plain pictures."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from PIL import Image as PILImage

from unshade import cli
from unshade.presets import PRESETS
from unshade.serde import load, load_family


@pytest.fixture(autouse=True)
def _as_the_program_runs() -> None:
    # A shell has its background work ignore interrupts, which a child would inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def program(*arguments: object) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "unshade", *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def trees(folder: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in folder.glob("*/tree.json")}


def records(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def test_the_presets_are_those_of_the_package() -> None:
    option = next(option for option in cli.cli.commands["decompose"].params if option.name == "preset")
    assert isinstance(option.type, click.Choice)
    assert list(option.type.choices) == list(PRESETS)
    limits = [str(preset.max_values) for preset in PRESETS.values()]
    assert isinstance(option, click.Option)
    assert f"Up to {limits[0]}, {limits[1]} or {limits[2]} values" in str(option.help)


@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (12, 130, 250)])
def test_one_colour_is_one_albedo(colour: tuple[int, int, int], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    PILImage.fromarray(np.full((64, 64, 3), colour, np.uint8)).save(tmp_path / "plain.png")
    code = cli.run(["decompose", str(tmp_path / "plain.png"), "-o", str(tmp_path / "out"), "--json"])
    out, err = capfd.readouterr()
    assert code == 0, err
    (record,) = records(out)
    assert (record["values"], record["leaves"]) == (3, 1)
    root = load(tmp_path / "out" / "plain" / "tree.json").root
    assert root.kind == "albedo"
    assert np.abs(np.array(root.values[0]) * 255 - colour).max() < 0.5
    assert (tmp_path / "out" / "plain" / "report.html").is_file()


def test_cmyk_is_converted(examples: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with PILImage.open(examples / "red_lacquer.png") as picture:
        picture.convert("RGB").convert("CMYK").save(tmp_path / "press.jpg", quality=95)
    code = cli.run(["decompose", str(tmp_path / "press.jpg"), "--artifacts", "none", "--json", "--preset", "draft"])
    out, err = capfd.readouterr()
    assert code == 0, err
    assert records(out)[0]["psnr"] > 20


def test_a_hybrid_without_networks_says_how_to_train_them(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """And not that a search would need none: a search is what it did."""
    PILImage.new("RGB", (64, 64), (90, 60, 40)).save(tmp_path / "flat.png")
    words = ["decompose", str(tmp_path / "flat.png"), "--artifacts", "none", "--preset", "draft", "--weights", str(tmp_path)]
    assert cli.run([*words, "--method", "hybrid"]) == 0
    assert "no such weights; train them with: unshade train all\n" in capfd.readouterr().err


@pytest.mark.slow
def test_the_tree_does_not_depend_on_the_workers_or_the_batch(examples: Path, tmp_path: Path) -> None:
    with program(
        "decompose", examples, "-o", tmp_path / "two", "--workers", 2, "--preset", "draft", "--artifacts", "tree", "--json"
    ) as together:
        out, err = together.communicate(timeout=300)
    assert together.returncode == 0, err
    assert len(records(out)) == 3
    for picture in sorted(examples.glob("*.png"), reverse=True):
        assert cli.run(["decompose", str(picture), "-o", str(tmp_path / "one"), "--preset", "draft", "--artifacts", "tree", "-q"]) == 0
    assert trees(tmp_path / "one") == trees(tmp_path / "two")
    for record in records(out):
        family = load_family(record["tree"])
        assert (family.tree.values, family.tree.leaves) == (record["values"], record["leaves"])
        assert abs(family.members[family.chosen].psnr - record["psnr"]) < 0.05


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_ctrl_c_keeps_what_is_done_and_a_later_call_goes_on(examples: Path, tmp_path: Path) -> None:
    pictures = [tmp_path / f"{copy}_{path.name}" for path in sorted(examples.glob("*.png")) for copy in range(2)]
    for picture in pictures:
        shutil.copy(examples / picture.name[2:], picture)
    arguments = ("decompose", *pictures, "-o", tmp_path / "out", "--workers", 2, "--preset", "draft", "--artifacts", "tree", "--json")
    with program(*arguments) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        first = json.loads(process.stdout.readline())
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
        errors = [line for line in process.stderr.read().splitlines() if "error" in line or "Traceback" in line]
    assert errors == ["unshade: error: interrupted; what was done is kept"]
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert not [name for name in left if "partial" in name]
    kept = Path(first["tree"]).stat().st_mtime_ns
    with program(*arguments) as process:
        out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert [record["input"] for record in records(out)] == [str(path) for path in pictures]
    assert records(out)[0] == first
    assert Path(first["tree"]).stat().st_mtime_ns == kept
