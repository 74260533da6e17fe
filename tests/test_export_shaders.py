"""GLSL, WGSL, HLSL, Godot and three.js against `render`, in the programs that compile and draw them."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
import warnings
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch

from chromium import NORMAL, OPTIONS, Job, decoded, posted_by, shaders
from export_trees import TREES
from godot_web import godot_pictures
from unshade.errors import TreeError
from unshade.export import ExportWarning, export
from unshade.export.formulas import SOURCE, functions
from unshade.export.glsl import glsl
from unshade.export.godot import godot
from unshade.export.program import Program, program
from unshade.export.three import module, page
from unshade.export.unity import hlsl, unity
from unshade.export.wgsl import offsets, wgsl
from unshade.nodes import KINDS, Kind, Leaf, Parameter, Role, Tree, leaf, multiply, screen
from unshade.render import render, srgb_decode, srgb_encode
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


def numbers(made: Program) -> dict[str, float | list[float]]:
    return {item.name: item.value[0] if item.type == "float" else list(item.value) for item in made.uniforms}


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


def fragment(made: Program, head: str = "#version 300 es\nprecision highp float;\n") -> str:
    return f"{head}{NORMAL}{glsl(made)}out vec4 color;\nvoid main() {{ color = vec4(unshade(unit_normal()), 1.0); }}\n"


@pytest.mark.slow
@pytest.mark.browser
def test_glsl_in_chromium(browser: str, tmp_path: Path) -> None:
    jobs = {name: Job(fragment(made), numbers(made), {p.name: p.raster for p in made.pictures}) for name, made in PROGRAMS.items()}
    constants = Job(fragment(PROGRAMS["nested"]).replace("out vec4", "out vec4", 1), {}, {})
    hostile = program(hostile_tree())
    jobs["constants"] = Job(constants.source.replace("precision highp float;", "precision highp float;\n#define UNSHADE_CONSTANTS"), {}, {})
    jobs["hostile"] = Job(fragment(hostile), numbers(hostile), {})
    found = shaders(browser, tmp_path, jobs, SIZE)
    np.testing.assert_allclose(found.pop("constants"), found["nested"], atol=1.01 / 255)
    assert psnr(found.pop("hostile"), expected(hostile_tree())) >= NEAR
    assert_near(found)


def compiled(arguments: list[str], folder: Path) -> None:
    done = subprocess.run(["glslangValidator", *arguments], capture_output=True, text=True, cwd=folder, check=False)
    assert done.returncode == 0, done.stdout


@pytest.fixture(scope="module")
def glslang() -> str:
    if not shutil.which("glslangValidator"):
        pytest.skip("needs glslang (apt-get install glslang-tools)")
    return "glslangValidator"


def test_glsl_by_glslang(glslang: str, tmp_path: Path) -> None:
    for head in ("#version 330\n", "#version 300 es\nprecision highp float;\n", "#version 330\n#define UNSHADE_CONSTANTS\n"):
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

ENTRY = """
float4 main(float4 position : SV_Position) : SV_Target
{
    float2 xy = position.xy / (0.5 * SIZE) - 1.0;
    xy /= max(length(xy), 1.0);
    float3 color = unshade(float3(xy, sqrt(max(1.0 - dot(xy, xy), 0.0))));
    return float4(SHOWN(UNSHADE_SHOWN(color)), 1.0);
}
"""


def unity_properties(text: str) -> dict[str, tuple[str, list[float]]]:
    """(type, value) of each property of a ShaderLab text."""
    found = re.findall(r'^\s*(?:\[\w+[^]]*\] )?(_\w+) \("[^"]*", (\w+)[^=]*\) = \(?([^)\n{]*)\)?$', text, re.MULTILINE)
    return {name: (kind, [float(part) for part in value.split(",")]) for name, kind, value in found}


def as_unity_gives(kind: str, value: list[float], gamma: bool) -> str:
    """A property as the shader sees it: Unity converts picked colours in projects with linear colour."""
    if kind == "Color" and not gamma:
        value = [*srgb_decode(torch.tensor(value[:3], dtype=torch.float64)).tolist(), 1.0]
    return f"{value[0]:.9g}" if len(value) == 1 else f"float4({', '.join(f'{part:.9g}' for part in value)})"


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
def test_hlsl_in_chromium(gamma: bool, glslang: str, browser: str, tmp_path: Path) -> None:
    if not shutil.which("spirv-cross"):
        pytest.skip("needs SPIRV-Cross (apt-get install spirv-cross)")
    jobs = {}
    for name, made in PROGRAMS.items():
        given = [
            f"static const {'float' if len(value) == 1 else 'float4'} {key} = {as_unity_gives(kind, value, gamma)};"
            for key, (kind, value) in unity_properties(unity(made)).items()
        ]
        code = re.sub(r"CBUFFER_START.*?CBUFFER_END", "\n".join(given), hlsl(made), flags=re.DOTALL).partition("struct Varyings")[0]
        shown = "#define UNITY_COLORSPACE_GAMMA\n#define SHOWN(c) (c)\n" if gamma else "#define SHOWN(c) encode_color(c)\n"
        (tmp_path / "tree.hlsl").write_text(shown + code + ENTRY.replace("SIZE", str(SIZE)), encoding="utf-8")
        compiled(["-D", "-S", "frag", "-e", "main", "-V", "--auto-map-bindings", "-o", "tree.spv", "tree.hlsl"], tmp_path)
        command = ["spirv-cross", "tree.spv", "--es", "--version", "300"]
        source = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True).stdout
        source = source.replace("precision mediump float;", "precision highp float;")
        pictures = {}
        for sampler in re.findall(r"uniform \w* *sampler2D (\w+);", source):
            picture = next(item for item in made.pictures if sampler.endswith(f"sampler_{item.name}"))
            pictures[sampler] = picture.raster
        assert len(pictures) == len(made.pictures)
        jobs[name] = Job(source, {}, pictures, flipped=True)
    assert_near(shaders(browser, tmp_path, jobs, SIZE))


THREE_PAGE = """<!doctype html><meta charset="utf-8"><script type="importmap">{"imports": {"three": "./three.js"}}</script>
<script type="module">
import * as THREE from "three";
const found = {}, places = [], normals = [], index = [];
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setSize(SIZE, SIZE, false);
const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, 0, 10);
camera.position.z = 5;
for (let k = 0; k < SIZE * SIZE; k++) {  // a vertex at every pixel's centre, so that normals there are not interpolated
  const x = ((k % SIZE) + 0.5) / (SIZE / 2) - 1, y = 1 - (Math.floor(k / SIZE) + 0.5) / (SIZE / 2), r = Math.max(Math.hypot(x, y), 1);
  places.push(x, y, 0);
  normals.push(x / r, y / r, Math.sqrt(Math.max(1 - (x * x + y * y) / (r * r), 0)));
  if (k % SIZE < SIZE - 1 && k < SIZE * (SIZE - 1)) index.push(k, k + SIZE, k + 1, k + 1, k + SIZE, k + SIZE + 1);
}
const geometry = new THREE.BufferGeometry();
geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(places), 3));
geometry.setAttribute("normal", new THREE.BufferAttribute(new Float32Array(normals), 3));
geometry.setIndex(index);
for (const name of NAMES) {
  const { createMaterial, ready } = await import(`./${name}.js`);
  const scene = new THREE.Scene();
  scene.add(new THREE.Mesh(geometry, createMaterial()));
  await ready;
  renderer.render(scene, camera);
  found[name] = renderer.domElement.toDataURL("image/png");
}
await fetch("found", { method: "POST", body: JSON.stringify(found) });
</script>"""


@pytest.mark.slow
@pytest.mark.browser
def test_three_in_chromium(browser: str, tmp_path: Path) -> None:
    (tmp_path / "three.js").write_bytes(files("unshade.export").joinpath("three.module.min.js").read_bytes())
    for name in SOME:
        (tmp_path / f"{name}.js").write_text(module(PROGRAMS[name]), encoding="utf-8")
    (tmp_path / "index.html").write_text(THREE_PAGE.replace("SIZE", str(SIZE)).replace("NAMES", json.dumps(SOME)), encoding="utf-8")
    found = json.loads(posted_by(browser, tmp_path, "index.html"))
    assert_near({name: decoded(base64.b64decode(url.partition(",")[2])) for name, url in found.items()})


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


WGSL_ENTRY = """
@group(0) @binding(0) var<storage, read_write> found: array<vec4f>;
@group(0) @binding(1) var<uniform> bound: Parameters;
@compute @workgroup_size(8, 8) fn main(@builtin(global_invocation_id) id: vec3u) {
    let place = (vec2f(id.xy) + 0.5) / (0.5 * SIZE) - 1.0;
    let xy = vec2f(place.x, -place.y) / max(length(place), 1.0);
    let n = vec3f(xy, sqrt(max(1.0 - dot(xy, xy), 0.0)));
    let color = unshade(n, bound);
    found[id.y * SIZEu + id.x] = vec4f(color, distance(color, unshade(n, unshade_tree)));
}
"""


@pytest.mark.slow
def test_wgsl_by_naga() -> None:
    """Compiled by naga and run by wgpu; the bound structure and the constant one agree."""
    wgpu = pytest.importorskip("wgpu", reason="needs wgpu (pip install wgpu) and a Vulkan driver")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        adapters = wgpu.gpu.enumerate_adapters_sync()
    if not adapters:
        pytest.skip("needs a driver for wgpu (apt-get install mesa-vulkan-drivers)")
    device = next((found for found in adapters if "Vulkan" in found.summary), adapters[0]).request_device_sync()
    usage, pictures = wgpu.BufferUsage, {}
    for name, made in PROGRAMS.items():
        code = device.create_shader_module(code=wgsl(made) + WGSL_ENTRY.replace("SIZE", str(SIZE)))
        if name not in SOME and not name.startswith("leaf-"):
            continue
        pipeline = device.create_compute_pipeline(layout="auto", compute={"module": code, "entry_point": "main"})
        *places, total = offsets(made)
        data = np.zeros(max(total // 4, 4), np.float32)
        for place, item in zip(places, made.uniforms, strict=True):
            data[place // 4 : place // 4 + len(item.value)] = item.value
        result = device.create_buffer(size=SIZE * SIZE * 16, usage=usage.STORAGE | usage.COPY_SRC)
        bound = device.create_buffer_with_data(data=data, usage=usage.UNIFORM)
        buffers = [
            {"binding": k, "resource": {"buffer": buffer, "offset": 0, "size": buffer.size}} for k, buffer in enumerate([result, bound])
        ]
        encoder = device.create_command_encoder()
        job = encoder.begin_compute_pass()
        job.set_pipeline(pipeline)
        job.set_bind_group(0, device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=buffers))
        if made.pictures:
            wrapped = {"address_mode_u": "repeat", "address_mode_v": "repeat", "min_filter": "linear", "mag_filter": "linear"}
            entries = [{"binding": 0, "resource": device.create_sampler(**wrapped)}]
            for k, item in enumerate(made.pictures, 1):
                height, width = item.raster.height, item.raster.width
                texels = np.ones((height, width, 4), np.float16)
                texels[..., :3] = item.raster.array().transpose(1, 2, 0)
                kind = wgpu.TextureUsage.TEXTURE_BINDING | wgpu.TextureUsage.COPY_DST
                texture = device.create_texture(size=(width, height, 1), format="rgba16float", usage=kind)
                layout = {"bytes_per_row": width * 8, "rows_per_image": height}
                device.queue.write_texture({"texture": texture}, texels.tobytes(), layout, (width, height, 1))
                entries.append({"binding": k, "resource": texture.create_view()})
            job.set_bind_group(1, device.create_bind_group(layout=pipeline.get_bind_group_layout(1), entries=entries))
        job.dispatch_workgroups(SIZE // 8, SIZE // 8)
        job.end()
        device.queue.submit([encoder.finish()])
        drawn = np.frombuffer(device.queue.read_buffer(result), np.float32).reshape(SIZE, SIZE, 4)
        assert drawn[..., 3].max() < 1e-3, name
        pictures[name] = drawn[..., :3].transpose(2, 0, 1)
    assert_near(pictures)


def godot_shows(color: np.ndarray) -> np.ndarray:
    """Compatibility takes an albedo to linear light with a cubic, and back with a power: dark tones come out darker."""
    linear = color * (color * (color * 0.305306011 + 0.682171111) + 0.012522878)
    return np.maximum(1.055 * linear ** (1 / 2.4) - 0.055, 0.0)


@pytest.mark.slow
@pytest.mark.browser
def test_godot(browser: str, tmp_path: Path) -> None:
    engine = os.environ.get("UNSHADE_GODOT_WEB")
    if not engine:
        pytest.skip("needs UNSHADE_GODOT_WEB, the folder of a Godot 4 web export")
    texts = {name: godot(PROGRAMS[name]) for name in SOME}
    rasters = {name: {item.name: item.raster for item in PROGRAMS[name].pictures} for name in SOME}
    for name, (known, picture) in godot_pictures(browser, Path(engine), tmp_path, texts, rasters, SIZE).items():
        assert {item.name for item in (*PROGRAMS[name].uniforms, *PROGRAMS[name].pictures)} <= known
        assert psnr(picture, godot_shows(expected(TREES[name]))) >= NEAR, name


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
