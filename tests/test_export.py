"""The table of targets, `export`, and the verb."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from export_trees import RASTER_KINDS, TREES
from unshade import cli
from unshade.blend import BLENDS
from unshade.errors import OutputError, UnshadeError
from unshade.export import OPTIONS, TARGETS, ExportWarning, degradations, export, target_of
from unshade.export import __all__ as public
from unshade.nodes import KINDS
from unshade.serde import dump

ROOT = Path(__file__).resolve().parent.parent
TEXT = "multiply(albedo(#cc2030), diffuse(left up))"


def test_the_fixture_trees_hold_every_kind() -> None:
    built_in = {name for name, kind in KINDS.items() if kind.formula.__module__ == "unshade.shading"}
    found = {node.kind for tree in TREES.values() for _, node in tree.walk()}
    assert found == built_in | set(BLENDS)
    assert found >= RASTER_KINDS


@pytest.mark.parametrize("name", TARGETS)
def test_a_target_has_a_writer_and_says_what_it_cannot_do(name: str) -> None:
    target = TARGETS[name]
    module, function = target.writer.split(".")
    assert callable(getattr(importlib.import_module(f"unshade.export.{module}"), function))
    assert set(target.options) <= set(OPTIONS)
    assert all(suffix.startswith(".") for suffix in target.suffixes)
    assert all(loss.cannot and loss.instead for loss in target.losses)


def test_exporters_load_no_network() -> None:
    modules = ", ".join(f"unshade.export.{target.writer.split('.')[0]}" for target in TARGETS.values())
    heavy = ("unshade.models", "unshade.fit", "psd_tools", "pikepdf")
    code = f"import sys, {modules}; print([name for name in sys.modules if name.startswith({heavy})])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_wrong_word_is_answered_with_the_right_one(tmp_path: Path) -> None:
    with pytest.raises(UnshadeError, match="did you mean 'svg'"):
        target_of("svgg")
    with pytest.raises(OutputError, match=r"svg expects a name that ends in \.svg, got '\.png'"):
        export(TREES["lit"], tmp_path / "x.png", "svg")
    with pytest.raises(UnshadeError, match="svg has no option 'bits'; it takes size, shape, region"):
        export(TREES["lit"], tmp_path / "x.svg", "svg", bits=8)
    with pytest.raises(UnshadeError, match="expected a size between 1 and 8192, got 0"):
        export(TREES["lit"], tmp_path / "x.png", "png", size=0)
    with pytest.raises(UnshadeError, match="expected a bits out of 8, 16, got 12"):
        export(TREES["lit"], tmp_path / "x.png", "png", bits=12)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_loses_nothing(tmp_path: Path) -> None:
    (tmp_path / "x.png").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        export(TREES["lit"], tmp_path / "x.png", "png", size=16)
    with pytest.raises(OutputError, match="cannot be written"):
        export(TREES["lit"], tmp_path / "none" / "x.png", "png", size=16)
    assert [path.name for path in tmp_path.iterdir()] == ["x.png"]


def test_degradations_name_their_nodes(tmp_path: Path) -> None:
    [sentence] = degradations(TREES["mix-image_mask"], "svg")
    assert sentence.endswith("(at mix.mask)")
    with pytest.warns(ExportWarning, match="a mask over several nodes"):
        export(TREES["mix-lit"], tmp_path / "x.ora", "ora", size=16)
    assert degradations(TREES["lit"], "svg") == []


def test_the_verb_writes_and_warns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dump(TREES["rasters"], tmp_path / "tree.json")
    assert cli.run(["export", TEXT, "-o", str(tmp_path / "a.svg")]) == 0
    assert capsys.readouterr().err == ""
    assert cli.run(["export", str(tmp_path / "tree.json"), "--to", "svg", "-o", str(tmp_path / "b.svg")]) == 0
    assert "cannot hold a raster leaf as vectors" in capsys.readouterr().err
    assert cli.run(["export", str(tmp_path / "tree.json"), "-q", "-o", str(tmp_path / "b.svg")]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["-o", "x.exr"], 2, "may be exr or blender-matcap"),
        (["-o", "x.xyz"], 2, "no target writes '.xyz'"),
        (["--to", "sgv", "-o", "x.svg"], 2, "did you mean 'svg'"),
        (["-o", "none/x.svg"], 5, "cannot be written"),
        (["-o", "x.svg", "--bits", "16"], 2, "svg has no option 'bits'"),
        (["-o", "x.svg", "--shape", "nowhere.svg"], 3, "nowhere.svg: cannot be read (No such file or directory)"),
        (["-o", "x.svg", "--region", "a"], 2, "--region is for --shape"),
    ],
)
def test_the_verb_says_what_is_wrong(
    arguments: list[str], code: int, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.run(["export", TEXT, *arguments]) == code
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_list_says_every_target(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["export", "--list"]) == 0
    shown = capsys.readouterr().out
    for target in TARGETS.values():
        assert f"\n{target.name} " in f"\n{shown}"
        assert "experimental" in shown or not target.experimental


@pytest.mark.parametrize("name", public)
def test_public_name_is_documented(name: str) -> None:
    assert re.search(rf"`(unshade\.export\.)?{name}\b", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"))


def test_the_page_is_fresh() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "export_page.py"), "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
