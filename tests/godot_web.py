"""Pictures that Godot 4 makes of spatial shaders: its web build in headless Chromium, with a project made here.

The engine is the ``index.js`` and ``index.wasm`` of any Godot 4 web export; ``UNSHADE_GODOT_WEB`` names their folder.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import shutil
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from chromium import decoded, posted_by
from unshade.nodes import Raster
from unshade.rasters import raster_to_png

PROJECT = """config_version=5
[application]
config/name="shaders"
run/main_scene="res://main.tscn"
[rendering]
renderer/rendering_method="gl_compatibility"
textures/vram_compression/import_etc2_astc=false
"""

SCENE = """[gd_scene load_steps=2 format=3]
[ext_resource type="Script" path="res://main.gd" id="1"]
[node name="Main" type="Node"]
script = ExtResource("1")
"""

# A grid with a vertex at every pixel's centre, so that normals there are not interpolated.
SCRIPT = """extends Node

const SIZE = {size}

func grid() -> ArrayMesh:
    var places := PackedVector3Array()
    var normals := PackedVector3Array()
    var index := PackedInt32Array()
    for row in SIZE:
        for column in SIZE:
            var place := Vector2(column + 0.5, SIZE - row - 0.5) / (0.5 * SIZE) - Vector2.ONE
            var shown: Vector2 = place / max(place.length(), 1.0)
            places.append(Vector3(place.x, place.y, 0.0))
            normals.append(Vector3(shown.x, shown.y, sqrt(max(1.0 - shown.length_squared(), 0.0))))
            if row < SIZE - 1 and column < SIZE - 1:
                var k := row * SIZE + column
                index.append_array([k, k + 1, k + SIZE, k + 1, k + SIZE + 1, k + SIZE])
    var arrays := []
    arrays.resize(Mesh.ARRAY_MAX)
    arrays[Mesh.ARRAY_VERTEX] = places
    arrays[Mesh.ARRAY_NORMAL] = normals
    arrays[Mesh.ARRAY_INDEX] = index
    var mesh := ArrayMesh.new()
    mesh.add_surface_from_arrays(Mesh.PRIMITIVE_TRIANGLES, arrays)
    return mesh

func _ready() -> void:
    var jobs: Dictionary = JSON.parse_string(JavaScriptBridge.eval("window.jobs", true))
    var viewport := SubViewport.new()
    viewport.size = Vector2i(SIZE, SIZE)
    viewport.render_target_update_mode = SubViewport.UPDATE_ALWAYS
    add_child(viewport)
    var camera := Camera3D.new()
    camera.projection = Camera3D.PROJECTION_ORTHOGONAL
    camera.size = 2.0
    camera.position = Vector3(0.0, 0.0, 2.0)
    viewport.add_child(camera)
    var shape := MeshInstance3D.new()
    shape.mesh = grid()
    viewport.add_child(shape)
    var found := {}
    for name in jobs:
        var shader := Shader.new()
        shader.code = jobs[name].code
        var material := ShaderMaterial.new()
        material.shader = shader
        for picture in jobs[name].pictures:
            var image := Image.new()
            image.load_png_from_buffer(Marshalls.base64_to_raw(jobs[name].pictures[picture]))
            material.set_shader_parameter(picture, ImageTexture.create_from_image(image))
        shape.material_override = material
        for frame in 3:
            await RenderingServer.frame_post_draw
        var uniforms := RenderingServer.get_shader_parameter_list(shader.get_rid()).map(func(entry): return entry.name)
        var drawn := viewport.get_texture().get_image()
        var picture := Marshalls.raw_to_base64(drawn.save_png_to_buffer())
        found[name] = {"uniforms": uniforms, "picture": picture, "version": Engine.get_version_info().string}
    JavaScriptBridge.eval("window.finish(%s)" % JSON.stringify(JSON.stringify(found)), true)
"""

PAGE = """<!doctype html><meta charset="utf-8"><canvas id="canvas"></canvas><script src="index.js"></script><script>
window.jobs = JSON.stringify(JOBS);
const said = [];
window.finish = (found) => fetch("found", { method: "POST", body: JSON.stringify({ found: JSON.parse(found), said }) });
new Engine({ args: ["--audio-driver", "Dummy"], executable: "index", mainPack: "project.pck", canvasResizePolicy: 0,
  emscriptenPoolSize: 8, godotPoolSize: 4, gdextensionLibs: [],
  onPrintError: (...words) => said.push(words.join(" ")) }).startGame({ canvas: document.querySelector("canvas") });
</script>"""


def pack(files: Mapping[str, bytes]) -> bytes:
    """A Godot 4 pack, format 3: a header, the files, and their directory."""
    base = 112
    directory, content = struct.pack("<I", len(files)), b""
    for name, data in files.items():
        path = name.encode()
        path += b"\0" * (-len(path) % 4)
        entry = struct.pack("<QQ16sI", len(content), len(data), hashlib.md5(data, usedforsecurity=False).digest(), 0)
        directory += struct.pack("<I", len(path)) + path + entry
        content += data + b"\0" * (-len(data) % 32)
    header = struct.pack("<4sIIIIIQQ", b"GDPC", 3, 4, 5, 0, 2, base, base + len(content))
    return header + b"\0" * (base - len(header)) + content + directory


@dataclass(frozen=True)
class Drawn:
    """What Godot made of a shader."""

    parameters: set[str]
    picture: np.ndarray
    """(3, size, size)."""
    version: str


def engine_or_skip() -> Path:
    """The folder of the engine; skipped where none is named."""
    named = os.environ.get("UNSHADE_GODOT_WEB")
    if not named:
        pytest.skip("needs UNSHADE_GODOT_WEB, the folder of a Godot 4 web export")
    return Path(named)


def godot_pictures(
    browser: str, folder: Path, shaders: Mapping[str, str], pictures: Mapping[str, Mapping[str, Raster]], size: int
) -> dict[str, Drawn]:
    """What Godot makes of each shader and its pictures. Raises AssertionError with Godot's words."""
    engine = engine_or_skip()
    for file in (*engine.glob("index*.js"), engine / "index.wasm"):
        shutil.copy(file, folder / file.name)
    script = SCRIPT.replace("{size}", str(size)).replace("    ", "\t")
    project = {"project.godot": PROJECT.encode(), "main.tscn": SCENE.encode(), "main.gd": script.encode()}
    project[".godot/global_script_class_cache.cfg"] = b"list=[]"
    (folder / "project.pck").write_bytes(pack(project))
    jobs = {
        name: {"code": code, "pictures": {key: base64.b64encode(raster_to_png(r)).decode() for key, r in pictures[name].items()}}
        for name, code in shaders.items()
    }
    (folder / "godot.html").write_text(PAGE.replace("JOBS", json.dumps(jobs).replace("</", "<\\/")), encoding="utf-8")
    answer = json.loads(posted_by(browser, folder, "godot.html", timeout=240.0))
    assert not answer["said"], answer["said"]
    return {
        name: Drawn(set(entry["uniforms"]), decoded(base64.b64decode(entry["picture"])), entry["version"])
        for name, entry in answer["found"].items()
    }
