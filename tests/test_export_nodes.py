"""Blender and MaterialX against `render`: Cycles on the CPU, and the GLSL that MaterialX generates."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from blender_pictures import blender_or_skip, by_cycles, run_in_blender
from chromium import shaders
from export_trees import LEAVES, TREES
from test_export_shaders import NEAR, PROGRAMS, assert_near, expected, hostile_tree, psnr
from unshade.errors import MissingExtraError, OutputError
from unshade.export import ExportWarning, export
from unshade.export import blender as blender_target
from unshade.export.blender import script
from unshade.export.materialx import materialx
from unshade.export.program import program
from unshade.nodes import Tree
from unshade.rasters import raster_from_png


@pytest.mark.slow
def test_blender_cycles(tmp_path: Path) -> None:
    blender_or_skip()
    for name, tree in TREES.items():
        export(tree, tmp_path / f"{name}.py", "blender")
    export(TREES["lit"], tmp_path / "file.blend", "blender")
    export(hostile_tree(), tmp_path / "hostile.py", "blender")
    found = by_cycles(tmp_path, 128)
    assert psnr(found.pop("hostile"), expected(hostile_tree(), 128)) >= NEAR
    assert psnr(found.pop("file"), expected(TREES["lit"], 128)) >= NEAR
    assert set(found) == set(TREES)
    assert_near(found)


SOCKETS = """
import json, sys
import bpy
bpy.ops.wm.open_mainfile(filepath=sys.argv[-1])
items = bpy.data.node_groups["unshade tree"].interface.items_tree
sockets = [item for item in items if item.item_type == "SOCKET" and item.in_out == "INPUT"]
def number(value):
    return [round(part, 5) for part in value] if hasattr(value, "__len__") else round(value, 5)
found = {item.name: [item.parent.name, number(item.default_value), getattr(item, "min_value", None), getattr(item, "max_value", None)]
         for item in sockets}
print("FOUND", json.dumps(found))
"""


@pytest.mark.slow
def test_blend_has_a_ranged_socket_for_every_parameter(tmp_path: Path) -> None:
    blender_or_skip()
    path = export(TREES["tinted"], tmp_path / "tree.blend", "blender")
    (tmp_path / "sockets.py").write_text(SOCKETS, encoding="utf-8")
    printed = run_in_blender(tmp_path / "sockets.py", path)
    found = json.loads(printed.partition("FOUND ")[2].splitlines()[0])
    assert list(found) == ["Normal", "albedo color", "highlight direction", "highlight sharpness", "highlight amplitude"]
    assert found["highlight sharpness"] == ["highlight", 60.0, pytest.approx(0.05), 5000.0]
    assert found["highlight direction"][1] == pytest.approx([-0.50141, 0.60169, 0.62174], abs=1e-5)
    assert found["albedo color"][1] == pytest.approx([1.0, 0.89001, 0.69207, 1.0], abs=1e-4)  # as linear light


def test_blender_scripts_are_python_and_say_the_formulas() -> None:
    for name, made in {**PROGRAMS, "hostile": program(hostile_tree())}.items():
        text = script(made)
        compile(text, name, "exec")
        assert text.count("@group\n") == len(made.functions("linear", "seen", *["encode_color"] * (made.space == "srgb")))
    assert "return ambient + (1.0 - ambient) * max(facing(n, direction), 0.0)" in script(PROGRAMS["leaf-diffuse"])


def test_a_blend_without_blender_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("UNSHADE_BLENDER", raising=False)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(blender_target.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"a \.blend needs Blender"):
        export(TREES["lit"], tmp_path / "tree.blend", "blender")
    monkeypatch.setenv("UNSHADE_BLENDER", "/bin/false")
    with pytest.raises(OutputError, match="Blender saved nothing"):
        export(TREES["lit"], tmp_path / "tree.blend", "blender")
    monkeypatch.setenv("UNSHADE_BLENDER", str(tmp_path / "nowhere"))
    with pytest.raises(MissingExtraError, match="UNSHADE_BLENDER"):
        export(TREES["lit"], tmp_path / "tree.blend", "blender")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.browser
def test_materialx_is_valid_and_its_glsl_renders(browser: str, tmp_path: Path) -> None:
    pytest.importorskip("MaterialX", reason="needs MaterialX (pip install MaterialX)")
    from materialx_glsl import job

    jobs = {name: job(materialx(made), made) for name, made in PROGRAMS.items()}
    hostile = program(hostile_tree())
    jobs["hostile"] = job(materialx(hostile), hostile)
    found = shaders(browser, tmp_path, jobs)
    assert psnr(found.pop("hostile"), expected(hostile_tree())) >= NEAR
    assert set(found) == set(TREES)
    assert_near(found)


def test_materialx_interface() -> None:
    mx = pytest.importorskip("MaterialX", reason="needs MaterialX (pip install MaterialX)")
    from materialx_glsl import document

    for name, made in PROGRAMS.items():
        whole = document(materialx(made))
        graph = whole.getNodeGraph("unshade_tree")
        inputs = graph.getInputs()
        assert [item.getName() for item in inputs] == [item.name for item in made.uniforms], name
        for item, uniform in zip(inputs, made.uniforms, strict=True):
            assert float(item.getAttribute("uimax").split(",")[0]) == pytest.approx(uniform.parameter.high)
            assert item.getAttribute("uifolder") == uniform.leaf
    assert mx.getVersionString().startswith("1.39")


def test_materialx_brings_pictures_in_a_zip(tmp_path: Path) -> None:
    tree = Tree(LEAVES["image"])
    with pytest.warns(ExportWarning, match=r"image_pixels\.png must stand beside it"):
        export(tree, tmp_path / "tree.mtlx", "materialx")
    with zipfile.ZipFile(export(tree, tmp_path / "tree.zip", "materialx")) as archive:
        assert archive.namelist() == ["tree.mtlx", "image_pixels.png"]
        assert raster_from_png(archive.read("image_pixels.png")) == LEAVES["image"]["pixels"]
        assert 'value="image_pixels.png"' in archive.read("tree.mtlx").decode()
