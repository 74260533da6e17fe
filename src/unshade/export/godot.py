"""Godot: a spatial shader, every parameter in the inspector with its range, colours with a picker.

For 4.4 and later: before, Godot did not convert the colours that a shader begins with.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from unshade.export.glsl import GLSL
from unshade.export.program import Program, Uniform, program
from unshade.export.shader_text import number, parts, picture_comments
from unshade.nodes import Tree

HEAD = """\
shader_type spatial;
render_mode unshaded;

// Made by unshade, for Godot 4.4 and later. Forward+ and Mobile give picked colours as linear light and want linear light
// back; Compatibility works on sRGB at both ends. The tree converts where its own numbers are of the other kind.
"""

FRAGMENT = """
void fragment() {{
    bool perspective = PROJECTION_MATRIX[3][3] == 0.0;
    vec3 to_eye = perspective ? VIEW : vec3(0.0, 0.0, 1.0);
    vec3 color = unshade(seen(normalize(NORMAL), to_eye), OUTPUT_IS_SRGB);
    ALBEDO = OUTPUT_IS_SRGB ? {0} : {1};
}}
"""

PICKED = """\
// A colour of the inspector as the tree's numbers.
vec3 picked(vec3 c, bool is_srgb) {{
    return is_srgb ? {0} : {1};
}}
"""

SPACES = {
    "srgb": (("c", "encode_color(c)"), ("color", "decode_color(color)")),
    "linear": (("decode_color(c)", "c"), ("encode_color(color)", "color")),
}
"""How a tree of each blend space reads a colour, and gives its own, where Godot means sRGB and where it means linear light."""


def _declared(uniform: Uniform, made: Program) -> str:
    if uniform.is_color:
        return f"uniform vec3 {uniform.name} : source_color = {GLSL.constant_vector(made.picked(uniform, 'srgb'))};"
    low, high = uniform.parameter.low, uniform.parameter.high
    ranged = f" : hint_range({number(low)}, {number(high)}, 0.001)" if uniform.type == "float" else ""
    return f"uniform {uniform.type} {uniform.name}{ranged} = {GLSL.constant(uniform)};"


def godot(made: Program) -> str:
    """The text of a Godot shader."""
    language = replace(GLSL, color="picked({name}, is_srgb)")
    reads, gives = SPACES[made.space]
    lines = [HEAD]
    for address, uniforms in made.by_leaf():
        lines += [f"group_uniforms {uniforms[0].name.removesuffix('_' + uniforms[0].parameter.name)};  // {address}"]
        lines += [f"{_declared(uniform, made)}  // {uniform.parameter.meaning}" for uniform in uniforms]
    lines += ["group_uniforms;"] * bool(made.uniforms)
    for picture in made.pictures:
        lines.append(f"uniform sampler2D {picture.name} : filter_linear, repeat_enable;  // {picture.address}; the PNG is at the end")
    functions, main = parts(made, language, made.space, "encode_color", "decode_color", "seen", extra=["bool is_srgb"])
    text = "\n\n".join([*functions, PICKED.format(*reads), main]) + "\n" + FRAGMENT.format(*gives)
    return "\n".join([*lines, "", text, *picture_comments(made.pictures, GLSL), ""])


def write(tree: Tree, path: Path) -> None:
    """Write a .gdshader."""
    path.write_text(godot(program(tree)), encoding="utf-8")
