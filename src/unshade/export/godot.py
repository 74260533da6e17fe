"""Godot 4: a spatial shader, every parameter in the inspector with its range, colours with a picker."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from unshade.export.glsl import GLSL
from unshade.export.program import Program, Uniform, program
from unshade.export.shader_text import by_leaf, encoded, number, picture_comments, printed
from unshade.nodes import Tree

HEAD = """\
shader_type spatial;
render_mode unshaded;

// Made by unshade. Godot turns picked colours into linear light and shows linear light, so the tree converts at both ends.
"""

FRAGMENT = """
void fragment() {
    bool perspective = PROJECTION_MATRIX[3][3] == 0.0;
    vec3 to_eye = perspective ? VIEW : vec3(0.0, 0.0, 1.0);
    ALBEDO = unshade(seen(normalize(NORMAL), to_eye));
}
"""


def _declared(uniform: Uniform, made: Program) -> str:
    if uniform.is_color:
        return f"uniform vec3 {uniform.name} : source_color = {GLSL.constant_vector(encoded(uniform, made.space))};"
    low, high = uniform.parameter.low, uniform.parameter.high
    ranged = f" : hint_range({number(low)}, {number(high)}, 0.001)" if uniform.type == "float" else ""
    return f"uniform {uniform.type} {uniform.name}{ranged} = {GLSL.constant(uniform)};"


def godot(made: Program) -> str:
    """The text of a Godot shader."""
    language = replace(GLSL, color="encode_color({name})" if made.space == "srgb" else "")
    lines = [HEAD]
    for address, uniforms in by_leaf(made.uniforms):
        lines += [f"group_uniforms {uniforms[0].name.removesuffix('_' + uniforms[0].parameter.name)};  // {address}"]
        lines += [f"{_declared(uniform, made)}  // {uniform.parameter.meaning}" for uniform in uniforms]
    lines += ["group_uniforms;"] * bool(made.uniforms)
    for picture in made.pictures:
        lines.append(f"uniform sampler2D {picture.name} : filter_linear, repeat_enable;  // {picture.address}; the PNG is at the end")
    text = printed(made, language, "linear", "seen", *(["encode_color"] if language.color else []))
    return "\n".join([*lines, "", text + FRAGMENT, *picture_comments(made.pictures, GLSL), ""])


def write(tree: Tree, path: Path) -> None:
    """Write a .gdshader."""
    path.write_text(godot(program(tree)), encoding="utf-8")
