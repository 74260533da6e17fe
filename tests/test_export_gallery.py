"""The gallery of exports shows every target, and its figures are still those of the exporters."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from unshade.export import TARGETS

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "scripts" / "export_gallery.py"
PAGE = (ROOT / "docs" / "export-gallery.md").read_text(encoding="utf-8")
FIGURES = json.loads((ROOT / "benchmarks" / "results" / "export_gallery.json").read_text(encoding="utf-8"))["drawn"]


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, its pictures, figures and page in a folder of their own."""
    spec = importlib.util.spec_from_file_location("export_gallery_script", SCRIPT)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "PICTURES", tmp_path)
    return module


def test_the_page_is_fresh() -> None:
    done = subprocess.run([sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def test_every_target_has_a_row_and_every_picture_is_there() -> None:
    assert set(re.findall(r"^\| `([a-z-]+)`", PAGE, re.MULTILINE)) == set(TARGETS)
    named = set(re.findall(r"\(exports/([^)]+)\)", PAGE))
    pictures = list((ROOT / "docs" / "exports").iterdir())
    assert {path.name for path in pictures} == named
    assert sum(path.stat().st_size for path in pictures) < 500_000


def test_a_program_that_drew_is_near() -> None:
    assert all(found["psnr"] >= 40.0 for found in FIGURES.values() if "missing" not in found)


@pytest.mark.parametrize("name", ["svg-resvg", "pdf-pdfium", "psd-psd-tools", "ora-pyora"])
def test_the_figures_are_still_true(name: str, script: ModuleType) -> None:
    [drawing] = [drawing for drawing in script.DRAWINGS if drawing.name == name]
    found = script.draw(drawing, script.of.rendered(script.load(script.TREE), script.SIZE))
    if "missing" in found:
        pytest.skip(found["missing"])
    assert found["psnr"] == pytest.approx(FIGURES[name]["psnr"], abs=0.5), "run scripts/export_gallery.py"
    assert found["bytes"] == pytest.approx(FIGURES[name]["bytes"], rel=0.02), "run scripts/export_gallery.py"


def test_a_program_that_is_not_here_is_said(script: ModuleType) -> None:
    def absent(path: Path) -> None:
        pytest.skip("needs Nothing")

    drawing = script.Drawing("svg", "Nothing", absent)
    found = script.draw(drawing, script.of.rendered(script.load(script.TREE), script.SIZE))
    assert found == {"missing": "needs Nothing"}
    assert "| not drawn: needs Nothing | |" in script.line(drawing, found)


def test_the_last_picture_of_a_program_stays(script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """First drawn, then absent: the page is the same."""
    folder = tmp_path / "docs"
    folder.mkdir()
    for name, place in (("PAGE", folder / "page.md"), ("FIGURES", folder / "figures.json"), ("PICTURES", folder / "exports")):
        monkeypatch.setattr(script, name, place)
    monkeypatch.setattr(sys, "argv", ["export_gallery.py"])
    [resvg] = [drawing for drawing in script.DRAWINGS if drawing.name == "svg-resvg"]
    monkeypatch.setattr(script, "DRAWINGS", (resvg,))
    pytest.importorskip("resvg_py", reason="needs resvg-py")
    script.main()
    before = script.PAGE.read_text(encoding="utf-8")
    assert "(exports/svg-resvg.png)" in before
    monkeypatch.setattr(script.of, "by_resvg", lambda *_: pytest.skip("needs resvg-py"))
    script.main()
    assert script.PAGE.read_text(encoding="utf-8") == before
    assert {path.name for path in script.PICTURES.iterdir()} == {"matcap.png", "svg-resvg.png"}
