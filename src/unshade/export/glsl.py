"""GLSL: one function of the normal, for OpenGL 3.3 and later, WebGL 2 and Vulkan with a uniform block of one's own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from unshade.export.program import Program, program
from unshade.export.shader_text import Language, picture_comments, printed
from unshade.nodes import Tree

GLSL = Language(words={"atan2": "atan"})

USUAL_UNIFORMS = 224
"""Vectors of uniforms that every WebGL 2 implementation gives a fragment shader."""

HEAD = """\
// vec3 unshade(vec3 n): the display-encoded (sRGB) colour of a unit normal, +x right, +y up, +z to the viewer.
// Made by unshade. With UNSHADE_CONSTANTS defined the parameters are constants with the values of the tree.
#ifdef UNSHADE_CONSTANTS
#define PARAMETER(type, name, value) const type name = value;
#else
#define PARAMETER(type, name, value) uniform type name;
#endif
"""


def glsl(program: Program) -> str:
    """The text of a GLSL include file."""
    lines = [HEAD]
    for address, uniforms in program.by_leaf():
        lines.append(f"// {address}")
        lines += [f"PARAMETER({item.type}, {item.name}, {GLSL.constant(item)})  // {item.summary}" for item in uniforms]
    for picture in program.pictures:
        lines.append(f"// {picture.address}: bilinear, repeating, row 0 at v = 0, not converted; the PNG is at the end of this file")
        lines.append(f"uniform sampler2D {picture.name};")
    return "\n".join([*lines, "#undef PARAMETER", "", printed(program, GLSL, "srgb"), *picture_comments(program.pictures, GLSL), ""])


def write(tree: Tree, path: Path) -> Iterator[str]:
    """Write an include file; yields warnings."""
    made = program(tree)
    path.write_text(glsl(made), encoding="utf-8")
    yield from too_many(made)


def too_many(program: Program) -> Iterator[str]:
    """A warning where some graphics drivers cannot hold the uniforms."""
    if len(program.uniforms) > USUAL_UNIFORMS:
        yield f"{len(program.uniforms)} uniforms are more than the {USUAL_UNIFORMS} that every WebGL 2 driver holds"
