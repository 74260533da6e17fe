"""Pictures that programs make of shading languages: GLSL and HLSL as jobs for Chromium, modules of three.js there, WGSL by wgpu."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import warnings
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from chromium import NORMAL, Job, decoded, posted_by
from unshade.export.glsl import glsl
from unshade.export.program import Program
from unshade.export.unity import hlsl, unity
from unshade.export.wgsl import offsets, wgsl
from unshade.render import srgb_decode

ES = "#version 300 es\nprecision highp float;\n"


def fragment(made: Program, head: str = ES) -> str:
    """A whole fragment shader of the sphere around the exported function."""
    return f"{head}{NORMAL}{glsl(made)}out vec4 color;\nvoid main() {{ color = vec4(unshade(unit_normal()), 1.0); }}\n"


def glsl_job(made: Program) -> Job:
    """The exported function with the tree's numbers as its uniforms."""
    numbers = {item.name: item.value[0] if item.type == "float" else list(item.value) for item in made.uniforms}
    return Job(fragment(made), numbers, {item.name: item.raster for item in made.pictures})


def glslang_or_skip() -> str:
    if not shutil.which("glslangValidator"):
        pytest.skip("needs glslang (apt-get install glslang-tools)")
    return "glslangValidator"


def compiled(arguments: list[str], folder: Path) -> None:
    """Raises AssertionError with glslang's words."""
    done = subprocess.run(["glslangValidator", *arguments], capture_output=True, text=True, cwd=folder, check=False)
    assert done.returncode == 0, done.stdout


HLSL_ENTRY = """
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


def _as_unity_gives(kind: str, value: list[float], gamma: bool) -> str:
    """A property as the shader sees it: Unity converts picked colours in projects with linear colour."""
    if kind == "Color" and not gamma:
        value = [*srgb_decode(torch.tensor(value[:3], dtype=torch.float64)).tolist(), 1.0]
    return f"{value[0]:.9g}" if len(value) == 1 else f"float4({', '.join(f'{part:.9g}' for part in value)})"


def hlsl_job(made: Program, folder: Path, size: int, gamma: bool) -> Job:
    """Unity's HLSL through glslang and SPIRV-Cross, in a project with gamma or linear colour; skipped without them."""
    glslang_or_skip()
    if not shutil.which("spirv-cross"):
        pytest.skip("needs SPIRV-Cross (apt-get install spirv-cross)")
    given = [
        f"static const {'float' if len(value) == 1 else 'float4'} {key} = {_as_unity_gives(kind, value, gamma)};"
        for key, (kind, value) in unity_properties(unity(made)).items()
    ]
    code = re.sub(r"CBUFFER_START.*?CBUFFER_END", "\n".join(given), hlsl(made), flags=re.DOTALL).partition("struct Varyings")[0]
    shown = "#define UNITY_COLORSPACE_GAMMA\n#define SHOWN(c) (c)\n" if gamma else "#define SHOWN(c) encode_color(c)\n"
    (folder / "tree.hlsl").write_text(shown + code + HLSL_ENTRY.replace("SIZE", str(size)), encoding="utf-8")
    compiled(["-D", "-S", "frag", "-e", "main", "-V", "--auto-map-bindings", "-o", "tree.spv", "tree.hlsl"], folder)
    command = ["spirv-cross", "tree.spv", "--es", "--version", "300"]
    source = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=True).stdout
    source = source.replace("precision mediump float;", "precision highp float;")
    pictures = {}
    for sampler in re.findall(r"uniform \w* *sampler2D (\w+);", source):
        picture = next(item for item in made.pictures if sampler.endswith(f"sampler_{item.name}"))
        pictures[sampler] = picture.raster
    assert len(pictures) == len(made.pictures)
    return Job(source, {}, pictures, flipped=True)


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


def by_three(browser: str, folder: Path, names: list[str], size: int) -> dict[str, np.ndarray]:
    """(3, size, size) of the material of each exported module FOLDER/NAME.js, in Chromium."""
    (folder / "three.js").write_bytes(files("unshade.export").joinpath("three.module.min.js").read_bytes())
    (folder / "index.html").write_text(THREE_PAGE.replace("SIZE", str(size)).replace("NAMES", json.dumps(names)), encoding="utf-8")
    found: Mapping[str, str] = json.loads(posted_by(browser, folder, "index.html"))
    return {name: decoded(base64.b64decode(url.partition(",")[2])) for name, url in found.items()}


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


def wgpu_or_skip() -> Any:
    """A device of wgpu, with Vulkan where there is one; skipped without a driver."""
    wgpu = pytest.importorskip("wgpu", reason="needs wgpu (pip install wgpu) and a Vulkan driver")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        adapters = wgpu.gpu.enumerate_adapters_sync()
    if not adapters:
        pytest.skip("needs a driver for wgpu (apt-get install mesa-vulkan-drivers)")
    return next((found for found in adapters if "Vulkan" in found.summary), adapters[0]).request_device_sync()


def wgsl_module(device: Any, made: Program, size: int) -> Any:
    """The exported text, compiled by naga. Raises wgpu's error with naga's words."""
    return device.create_shader_module(code=wgsl(made) + WGSL_ENTRY.replace("SIZE", str(size)))


def by_wgpu(device: Any, made: Program, size: int) -> np.ndarray:
    """(4, size, size): the picture with the structure bound, and how far the one with constants is from it; size in eights."""
    import wgpu

    usage = wgpu.BufferUsage
    compute = {"module": wgsl_module(device, made, size), "entry_point": "main"}
    pipeline = device.create_compute_pipeline(layout="auto", compute=compute)
    *places, total = offsets(made)
    data = np.zeros(max(total // 4, 4), np.float32)
    for place, item in zip(places, made.uniforms, strict=True):
        data[place // 4 : place // 4 + len(item.value)] = item.value
    result = device.create_buffer(size=size * size * 16, usage=usage.STORAGE | usage.COPY_SRC)
    bound = device.create_buffer_with_data(data=data, usage=usage.UNIFORM)
    buffers = [{"binding": k, "resource": {"buffer": buffer, "offset": 0, "size": buffer.size}} for k, buffer in enumerate([result, bound])]
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
    job.dispatch_workgroups(size // 8, size // 8)
    job.end()
    device.queue.submit([encoder.finish()])
    return np.frombuffer(device.queue.read_buffer(result), np.float32).reshape(size, size, 4).transpose(2, 0, 1)
