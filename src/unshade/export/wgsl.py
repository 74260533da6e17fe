"""WGSL: one function of the normal and of a structure of parameters, for WebGPU.

The structure can be bound as a uniform or be the constant ``unshade_tree``, which holds the numbers of the tree.
"""

from __future__ import annotations

from pathlib import Path

from unshade.export.program import Program, program
from unshade.export.shader_text import Language, picture_comments, printed
from unshade.nodes import Tree

WGSL = Language(
    types={"float": "f32", "vec3": "vec3f"},
    function="fn {name}({parameters}) -> {type} {{",
    parameter="{name}: {type}",
    statement="let {name} = {value};",
    splat="vec3f({value})",
    sample="textureSampleLevel({picture}, pictures, {place}.xy, 0.0).rgb",
    uniform="p.{name}",
)

HEAD = """\
// fn unshade(n: vec3f, p: Parameters) -> vec3f: the display-encoded (sRGB) colour of a unit normal,
// +x right, +y up, +z to the viewer. Made by unshade.
// Bind `Parameters` as a uniform of your own, or pass `unshade_tree`, the numbers of the tree.
"""


def offsets(program: Program) -> list[int]:
    """Where each uniform stands in the structure, in bytes, and at the end how long that is (WGSL's layout of structures)."""
    found, place = [], 0
    for uniform in program.uniforms:
        align, size = (4, 4) if uniform.type == "float" else (16, 12)
        place = -(-place // align) * align
        found.append(place)
        place += size
    return [*found, -(-place // 16) * 16]


def wgsl(program: Program) -> str:
    """The text of a WGSL module."""
    places = iter(offsets(program))
    lines = [HEAD, "struct Parameters {"]
    for address, uniforms in program.by_leaf():
        lines.append(f"    // {address}")
        lines += [f"    {item.name}: {WGSL.types[item.type]},  // byte {next(places)}; {item.summary}" for item in uniforms]
    lines += ["    unshade_end: f32,"] * (not program.uniforms) + ["}", ""]
    values = [WGSL.constant(uniform) for uniform in program.uniforms] or ["0.0"]
    lines += ["const unshade_tree = Parameters(", *(f"    {value}," for value in values), ");", ""]
    if program.pictures:
        lines.append("// Bilinear, repeating, row 0 at v = 0, not converted; the PNGs are at the end of this file.")
        lines.append("@group(1) @binding(0) var pictures: sampler;")
        for place, picture in enumerate(program.pictures, 1):
            lines.append(f"@group(1) @binding({place}) var {picture.name}: texture_2d<f32>;  // {picture.address}")
        lines.append("")
    text = printed(program, WGSL, "srgb", extra=["p: Parameters"])
    return "\n".join([*lines, text, *picture_comments(program.pictures, WGSL), ""])


def write(tree: Tree, path: Path) -> None:
    """Write a module."""
    path.write_text(wgsl(program(tree)), encoding="utf-8")
