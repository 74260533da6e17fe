"""The gallery shows the catalogue as it is."""

from __future__ import annotations

import importlib.util
import itertools
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from unshade.blend import BLENDS
from unshade.nodes import KINDS, leaf

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "scripts" / "gallery.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("gallery_script", SCRIPT)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_the_gallery_is_fresh() -> None:
    """In a process of its own, since another test may have registered a kind."""
    done = subprocess.run([sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def test_everything_is_shown_and_every_picture_is_there() -> None:
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^### (\w+)$", page, re.MULTILINE)) >= set(BLENDS) | {"albedo", "diffuse", "environment", "stripe", "image_mask"}
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page)
    assert len(pictures) == len(set(pictures)) >= 30
    assert all((ROOT / "docs" / name).is_file() for name in pictures)
    assert sum((ROOT / "docs" / name).stat().st_size for name in pictures) < 1_000_000


def test_a_row_differs_in_its_parameter_alone(script: ModuleType) -> None:
    kind = KINDS["toon_highlight"]
    caption, leaves = script.swept(kind, kind.parameter("radius"))
    assert caption.split(", ")[0] == "0.08"
    assert [node["radius"] for node in leaves] == [(value,) for value in script.SWEEPS["toon_highlight", "radius"]]
    assert len({(node["direction"], node["brightness"], node["softness"]) for node in leaves}) == 1


def test_every_row_shows_a_change(script: ModuleType) -> None:
    for kind in list(script.KINDS.values()):
        if kind.name not in script.EXAMPLES:
            continue
        for parameter in kind.parameters:
            found = script.swept(kind, parameter)
            if found:
                pictures = [script.picture(node) for node in found[1]]
                changes = [float((first - second).abs().mean()) for first, second in itertools.pairwise(pictures)]
                assert min(changes) > 1e-3, f"{kind.name}.{parameter.name}: {changes}"


def test_a_scalar_without_a_row_is_swept_over_its_range(script: ModuleType) -> None:
    sharpness = KINDS["highlight"].parameter("sharpness")
    values = script.spread(sharpness)
    assert values[0] == pytest.approx(sharpness.low)
    assert values[-1] == pytest.approx(sharpness.high)
    ratios = [second / first for first, second in itertools.pairwise(values)]
    assert ratios == pytest.approx([ratios[0]] * len(ratios))


def test_a_changed_formula_would_be_noticed(script: ModuleType) -> None:
    def row(ambient: float) -> np.ndarray:
        pixels: np.ndarray = script.drawn(script.Strip("x", "", (script.picture(leaf("diffuse", ambient=ambient)),)))
        return pixels

    assert script.same(row(0.2), row(0.2005))
    assert not script.same(row(0.2), row(0.22))
