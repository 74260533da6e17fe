"""GLSL, WGSL, HLSL, Godot and three.js against `render`, in the programs that compile and draw them."""

from __future__ import annotations

import re
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from chromium import OPTIONS, Job, decoded, shaders
from export_trees import TREES
from godot_web import godot_pictures
from shader_pictures import (
    ES,
    by_three,
    by_wgpu,
    compiled,
    fragment,
    glsl_job,
    glslang_or_skip,
    hlsl_job,
    unity_properties,
    wgpu_or_skip,
    wgsl_module,
)
from unshade.errors import TreeError
from unshade.export import ExportWarning, export
from unshade.export.formulas import SOURCE, functions
from unshade.export.glsl import glsl
from unshade.export.godot import godot
from unshade.export.program import Program, program
from unshade.export.three import module, page
from unshade.export.unity import unity
from unshade.export.wgsl import wgsl
from unshade.nodes import KINDS, Kind, Leaf, Parameter, Role, Tree, leaf, multiply, screen
from unshade.render import render, srgb_encode
from unshade.sphere import disc_mask, sphere_normals

PROGRAMS = {name: program(tree) for name, tree in TREES.items()}
SOME = ["lit", "nested", "mix-in-mix", "mix-in-screen", "mix-image_mask", "environment", "rasters", "linear", "linear-mix"]
"""For programs that are slow to start; the leaves' formulas are the same text as in GLSL."""
SIZE = 256
NEAR = 45.0
"""dB inside the scored disc that every target must reach."""

HOSTILE = ["gl_x", "float", "*/ }", "</script>", 'a"b\\', "é", "out", "multiply", "n", "line\nbreak", "_", "1st", "unshade", "a" * 300]
"""Names that no language may stumble over."""


def expected(tree: Tree, size: int = SIZE) -> np.ndarray:
    return render(tree, sphere_normals(size, dtype=torch.float64)).numpy()


def psnr(picture: np.ndarray, wanted: np.ndarray) -> float:
    inside = disc_mask(picture.shape[-1], 0.97)[0].numpy()
    return float(-10.0 * np.log10(np.mean((picture - wanted)[:, inside] ** 2) + 1e-14))


def assert_near(pictures: dict[str, np.ndarray], near: float = NEAR) -> None:
    assert pictures
    figures = {name: round(psnr(picture, expected(TREES[name], picture.shape[-1])), 1) for name, picture in pictures.items()}
    assert min(figures.values()) >= near, {name: figure for name, figure in figures.items() if figure < near}


def hostile_tree() -> Tree:
    lights = [multiply(leaf("albedo", name=name, color=(0.05, 0.02, 0.03)), leaf("diffuse", name=name), name=name) for name in HOSTILE]
    return Tree(screen(*lights, name="</materialx> --> }} {title} %s"))


class Vector(np.ndarray):
    """(3, H, W), or (3, 1, 1), with the parts that shading languages name."""

    x = property(lambda self: np.asarray(self[0]))
    y = property(lambda self: np.asarray(self[1]))
    z = property(lambda self: np.asarray(self[2]))


def vector(*values: float | np.ndarray) -> Vector:
    parts = np.broadcast_arrays(*(values * 3 if len(values) == 1 else values))
    return np.stack([np.broadcast_to(part, part.shape or (1, 1)) for part in parts]).view(Vector)


def computed(made: Program, normals: np.ndarray) -> np.ndarray:
    """A program run as Python on numpy arrays."""
    space: dict = {
        "vec3": vector,
        "dot": lambda a, b: np.asarray((a * b).sum(0)),
        "normalize": lambda a: a / np.sqrt((a * a).sum(0)),
        "length": lambda a: np.asarray(np.sqrt((a * a).sum(0))),
        "cross": lambda a, b: np.cross(*np.broadcast_arrays(a, b), axis=0).view(Vector),
        "clamp": np.clip,
        "mix": lambda a, b, share: a + share * (b - a),
        "step": lambda edge, a: np.asarray(a >= edge, float),
        "min": np.minimum,
        "max": np.maximum,
        "abs": np.abs,
        "exp": np.exp,
        "pow": np.power,
        "cos": np.cos,
        "sin": np.sin,
        "acos": np.arccos,
        "atan2": np.arctan2,
    }
    exec(SOURCE, space)
    space["n"] = normals.view(Vector)
    for item in made.uniforms:
        space[item.name] = item.value[0] if item.type == "float" else np.array(item.value).reshape(3, 1, 1).view(Vector)
    for line in made.statements:
        space[line.name] = eval(line.text, space)
    found = eval(made.result("srgb"), space)
    return np.broadcast_to(found, normals.shape)


@pytest.mark.parametrize("name", [name for name, made in PROGRAMS.items() if not made.pictures])
def test_formulas_are_those_of_the_renderer(name: str) -> None:
    normals = sphere_normals(48, dtype=torch.float64)
    found = computed(PROGRAMS[name], normals.numpy())
    np.testing.assert_allclose(found, render(TREES[name], normals).numpy(), atol=1e-6)


def test_every_kind_has_a_formula() -> None:
    apart = {"albedo", "environment", "environment_map", "image", "image_mask"}
    assert set(KINDS) - apart <= set(functions())
    assert {node.kind for tree in TREES.values() for _, node in tree.walk()} >= set(KINDS)


def test_a_kind_from_outside_has_no_translation(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = Kind("glow", Role.HIGHLIGHT, lambda n, a: a, (Parameter("amount", "scalar", "", default=(1.0,)),), "")
    monkeypatch.setitem(KINDS, "glow", kind)
    with pytest.raises(TreeError, match=r"'glow' has no translation \(at multiply\.1\.glow\)"):
        program(Tree(multiply(leaf("albedo"), Leaf("glow", ((0.5,),)))))


def test_names_are_unique_and_safe() -> None:
    made = program(hostile_tree())
    names = [item.name for item in made.uniforms] + [line.name for line in made.statements]
    assert len(set(names)) == len(names) >= 4 * len(HOSTILE)
    assert all(re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) and not name.startswith("gl_") for name in names)
    for text in (glsl(made), wgsl(made), godot(made), unity(made)):
        assert "*/" not in text and "</script>" not in text and "-->" not in text
    assert "</script> -->" not in page(made) and page(made).count("</script>") == 2


def test_export_writes_them_and_says_what_is_lost(tmp_path: Path) -> None:
    for target, suffix in (("glsl", "glsl"), ("wgsl", "wgsl"), ("godot", "gdshader"), ("unity", "shader")):
        with pytest.warns(ExportWarning) as said:
            path = export(TREES["rasters"], tmp_path / f"tree.{suffix}", target)
        words = " ".join(str(warning.message) for warning in said)
        assert "screen.0.multiply.0.image" in words and ("experimental" in words) == (target == "unity")
        assert path.read_text(encoding="utf-8").count("data:image/png;base64,") == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for suffix in ("html", "js"):
            assert export(TREES["rasters"], tmp_path / f"tree.{suffix}", "three").stat().st_size > 5000
    many = Tree(screen(*(leaf("highlight", sharpness=float(k + 1)) for k in range(100))))
    with pytest.warns(ExportWarning, match="300 uniforms are more than the 224"):
        export(many, tmp_path / "many.glsl", "glsl")


@pytest.mark.slow
@pytest.mark.browser
def test_glsl_in_chromium(browser: str, tmp_path: Path) -> None:
    jobs = {name: glsl_job(made) for name, made in PROGRAMS.items()}
    jobs["constants"] = Job(fragment(PROGRAMS["nested"], f"{ES}#define UNSHADE_CONSTANTS\n"), {}, {})
    jobs["hostile"] = glsl_job(program(hostile_tree()))
    found = shaders(browser, tmp_path, jobs, SIZE)
    np.testing.assert_allclose(found.pop("constants"), found["nested"], atol=1.01 / 255)
    assert psnr(found.pop("hostile"), expected(hostile_tree())) >= NEAR
    assert_near(found)


@pytest.fixture(scope="module")
def glslang() -> str:
    return glslang_or_skip()


def test_glsl_by_glslang(glslang: str, tmp_path: Path) -> None:
    for head in ("#version 330\n", ES, "#version 330\n#define UNSHADE_CONSTANTS\n"):
        for name in ("mix-in-mix", "rasters", "linear-mix", "environment"):
            (tmp_path / "tree.frag").write_text(fragment(PROGRAMS[name], head).replace("SIZE", "64"), encoding="utf-8")
            compiled(["tree.frag"], tmp_path)


UNITY = """
#define CBUFFER_START(name) cbuffer name {
#define CBUFFER_END };
cbuffer Frame { float4x4 UNITY_MATRIX_V; float4x4 UNITY_MATRIX_VP; float4x4 unity_ObjectToWorld; float4x4 unity_WorldToObject;
                float4 unity_OrthoParams; };
float4 UnityObjectToClipPos(float4 place) { return mul(UNITY_MATRIX_VP, mul(unity_ObjectToWorld, place)); }
"""
"""What the shader takes from Unity's own include, declared as Unity documents it."""


def test_unity_stages_by_glslang(glslang: str, tmp_path: Path) -> None:
    (tmp_path / "UnityCG.cginc").write_text(UNITY, encoding="utf-8")
    for name in ("mix-in-mix", "rasters", "linear-mix", "environment"):
        text = unity(PROGRAMS[name])
        code = text.partition("HLSLPROGRAM")[2].partition("ENDHLSL")[0]
        assert len(unity_properties(text)) == len(PROGRAMS[name].uniforms)
        for gamma in ("", "#define UNITY_COLORSPACE_GAMMA\n"):
            (tmp_path / "tree.hlsl").write_text(f"#extension GL_GOOGLE_include_directive : enable\n{gamma}{code}", encoding="utf-8")
            for stage in ("vertex", "fragment"):
                compiled(["-D", "-S", stage[:4], "-e", stage, "-V", "-I.", "tree.hlsl"], tmp_path)


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize("gamma", [True, False])
def test_hlsl_in_chromium(gamma: bool, browser: str, tmp_path: Path) -> None:
    jobs = {name: hlsl_job(made, tmp_path, SIZE, gamma) for name, made in PROGRAMS.items()}
    assert_near(shaders(browser, tmp_path, jobs, SIZE))


@pytest.mark.slow
@pytest.mark.browser
def test_three_in_chromium(browser: str, tmp_path: Path) -> None:
    for name in SOME:
        (tmp_path / f"{name}.js").write_text(module(PROGRAMS[name]), encoding="utf-8")
    assert_near(by_three(browser, tmp_path, SOME, SIZE))


@pytest.mark.slow
@pytest.mark.browser
def test_three_page_runs_from_the_disk(browser: str, tmp_path: Path) -> None:
    """The page as one opens it: the ball of its canvas, and a control for every parameter."""
    size, margin = 512, 1.05
    path = export(TREES["lit"], tmp_path / "ball.html", "three")
    picture = tmp_path / "ball.png"
    arguments = [f"--window-size={size + 300},{size}", "--hide-scrollbars", "--virtual-time-budget=10000", f"--screenshot={picture}"]
    command = [browser, *OPTIONS, f"--user-data-dir={tmp_path}/profile", *arguments, path.as_uri()]
    subprocess.run(command, capture_output=True, timeout=120, check=True)
    shown = decoded(picture.read_bytes())[:, :size, :size]
    grid = torch.stack(torch.meshgrid(*[(torch.arange(size, dtype=torch.float64) + 0.5) * 2 / size - 1] * 2, indexing="xy")) * margin
    grid[1] *= -1
    radius = grid.square().sum(0).sqrt()
    normals = torch.cat([grid, (1 - grid.square().sum(0, keepdim=True)).clamp(min=0).sqrt()]) / radius.clamp(min=1.0)
    inside = (radius < 0.97).numpy()
    error = (shown - render(TREES["lit"], normals).numpy())[:, inside]
    assert -10 * np.log10(np.mean(error**2)) >= NEAR
    assert page(PROGRAMS["lit"]).count('"meaning"') == len(PROGRAMS["lit"].uniforms)


@pytest.mark.slow
def test_wgsl_by_naga() -> None:
    """Compiled by naga and run by wgpu; the bound structure and the constant one agree."""
    device, pictures = wgpu_or_skip(), {}
    for name, made in PROGRAMS.items():
        if name in SOME or name.startswith("leaf-"):
            drawn = by_wgpu(device, made, SIZE)
            assert drawn[3].max() < 1e-3, name
            pictures[name] = drawn[:3]
        else:
            wgsl_module(device, made, SIZE)
    assert_near(pictures)


def godot_shows(color: np.ndarray) -> np.ndarray:
    """Compatibility takes an albedo to linear light with a cubic, and back with a power: dark tones come out darker."""
    linear = color * (color * (color * 0.305306011 + 0.682171111) + 0.012522878)
    return np.maximum(1.055 * linear ** (1 / 2.4) - 0.055, 0.0)


@pytest.mark.slow
@pytest.mark.browser
def test_godot(browser: str, tmp_path: Path) -> None:
    texts = {name: godot(PROGRAMS[name]) for name in SOME}
    rasters = {name: {item.name: item.raster for item in PROGRAMS[name].pictures} for name in SOME}
    for name, drawn in godot_pictures(browser, tmp_path, texts, rasters, SIZE).items():
        assert {item.name for item in (*PROGRAMS[name].uniforms, *PROGRAMS[name].pictures)} <= drawn.parameters
        assert psnr(drawn.picture, godot_shows(expected(TREES[name]))) >= NEAR, name


def test_normals_are_seen_along_the_ray() -> None:
    """In perspective the silhouette keeps the normals of the silhouette; without it nothing changes."""
    space = {"vec3": vector, "dot": lambda a, b: np.asarray((a * b).sum(0)), "cross": lambda a, b: np.cross(a, b, axis=0).view(Vector)}
    space["normalize"] = lambda a: a / np.sqrt((a * a).sum(0))
    exec(functions()["seen"].source, space)
    normals = sphere_normals(32, dtype=torch.float64).numpy().view(Vector)
    to_eye = np.zeros_like(normals) + np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1)
    np.testing.assert_allclose(space["seen"](normals, to_eye), normals, atol=1e-12)
    eye = np.array([0.3, -0.2, 3.0]).reshape(3, 1, 1)
    to_eye = (eye - normals) / np.sqrt(((eye - normals) ** 2).sum(0))
    found = space["seen"](normals, to_eye.view(Vector))
    np.testing.assert_allclose((found**2).sum(0), 1.0, atol=1e-12)
    np.testing.assert_allclose(found[2], (normals * to_eye).sum(0), atol=1e-12)


def test_colors_round_trip_between_spaces() -> None:
    """The formulas of the two conversions are those of the renderer."""
    made = program(Tree(leaf("albedo", color=(0.002, 0.03, 0.7)), "linear"))
    found = computed(made, np.zeros((3, 1, 1)))
    np.testing.assert_allclose(found[:, 0, 0], srgb_encode(torch.tensor([0.002, 0.03, 0.7], dtype=torch.float64)).numpy(), atol=1e-9)
