"""Blender: a node group driven by normals, a named and ranged socket for every parameter; as a script or as a .blend.

Blender gives picked colours as linear light and wants linear light back, so a tree of encoded numbers converts at both
ends. The .blend is what Blender itself saves after it has run the script.
"""

from __future__ import annotations

import ast
import base64
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from unshade.errors import MissingExtraError, OutputError
from unshade.export.blender_script import RUNTIME, SCENE
from unshade.export.program import Program, Uniform, program
from unshade.nodes import Tree
from unshade.rasters import raster_to_png

HEAD = '''\
"""Made by unshade: a shade tree as a node group, for Blender 4.2 and later.

Run it in Blender's text editor: it adds the node group "unshade tree" and the material "unshade" that uses it. The view
transform must be Standard for the colours of the tree. `blender -b -P THIS.py -- FILE.blend` saves a file with a sphere.
"""
'''

SOCKETS = {
    "float": ("NodeSocketFloat", ""),
    "direction": ("NodeSocketVector", "DIRECTION"),
    "rotation": ("NodeSocketVector", ""),
    "color": ("NodeSocketColor", ""),
}
"""The type and the subtype of the socket of each type of parameter."""


def _socket(uniform: Uniform, made: Program) -> str:
    kind = uniform.type if uniform.type == "float" else uniform.parameter.type
    socket, subtype = SOCKETS[kind]
    value: object = uniform.value[0] if kind == "float" else uniform.value
    if kind == "color":
        value = (*made.picked(uniform, "linear"), 1.0)
    span = (uniform.parameter.low, uniform.parameter.high)
    label = uniform.name.replace("_", " ")
    return f"    ({uniform.name!r}, {label!r}, {socket!r}, {subtype!r}, {value!r}, {span!r}, {uniform.parameter.meaning!r}),"


INTERFACE = '''
def interface():
    """The node group of the tree, its sockets in one panel a leaf."""
    global building
    tree = building = bpy.data.node_groups.new("unshade tree", "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    tree.interface.new_socket("Normal", in_out="INPUT", socket_type="NodeSocketVector")
    for leaf, parameters in LEAVES:
        panel = tree.interface.new_panel(leaf)
        for name, label, kind, subtype, value, (low, high), meaning in parameters:
            socket = tree.interface.new_socket(label, in_out="INPUT", socket_type=kind, parent=panel)
            socket.default_value, socket.description = value, meaning
            if subtype:
                socket.subtype = subtype
            if kind != "NodeSocketColor":
                socket.min_value, socket.max_value = low, high
    given = tree.nodes.new("NodeGroupInput")
    values = {}
    for _, parameters in LEAVES:
        for name, label, kind, *_ in parameters:
            value = Value(given.outputs[label], "float" if kind == "NodeSocketFloat" else "vec3")
            values[name] = shown(value) if kind == "NodeSocketColor" else value
    color = tree_color(Value(given.outputs["Normal"], "vec3"), **values)
    tree.links.new(color.socket, tree.nodes.new("NodeGroupOutput").inputs["Color"])
    arrange(tree)
    return tree


unshade = interface()
'''


def script(made: Program) -> str:
    """The text of a script for Blender."""
    lines = [HEAD + RUNTIME]
    functions = made.functions("linear", "seen", *(["encode_color"] if made.space == "srgb" else []))
    lines += [f"\n@group\n{function.source}\n" for function in functions]
    lines.append("\n# (name, label, socket, subtype, value, range, meaning) of each parameter, by leaf.\nLEAVES = [")
    for _, uniforms in made.by_leaf():
        lines += [f"    ({uniforms[0].leaf!r}, [", *(f"    {_socket(uniform, made)}" for uniform in uniforms), "    ]),"]
    lines += ["]", ""]
    for item in made.pictures:
        data = base64.b64encode(raster_to_png(item.raster)).decode("ascii")
        lines.append(f'{item.name} = picture({item.name!r}, "{data}")')
    shown = "encode_color(color)" if made.space == "srgb" else "color"
    lines += ["", "def shown(color):", '    """A colour of a socket as the tree\'s numbers."""', f"    return {shown}", ""]
    main = made.main("linear")
    lines += ["", f"def tree_color({', '.join(['n', *(item.name for item in made.uniforms)])}):", '    """The tree."""']
    for statement, (name, _, value) in zip(made.statements, main.statements, strict=True):
        lines += [f"    # {statement.comment}", f"    {name} = {ast.unparse(value)}"]
    lines += [f"    return {ast.unparse(main.value)}", "", INTERFACE + SCENE]
    return "\n".join(lines)


def command() -> list[str]:
    """How to run a script in Blender: ``UNSHADE_BLENDER`` (a Blender, or a Python that has bpy), ``blender``, or bpy here.

    Raises MissingExtraError.
    """
    named = os.environ.get("UNSHADE_BLENDER")
    if named and not shutil.which(named):
        raise MissingExtraError(f"UNSHADE_BLENDER: expected a program, got {named}")
    named = named or shutil.which("blender")
    if named and not Path(named).name.startswith("python"):
        return [named, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    if named or importlib.util.find_spec("bpy"):
        return [named or sys.executable]
    raise MissingExtraError(
        "a .blend needs Blender: install it, or set UNSHADE_BLENDER to a Blender or to a Python that has bpy; a .py needs none"
    )


def write(tree: Tree, path: Path) -> None:
    """Write a script (.py), or a .blend that Blender makes of it. Raises MissingExtraError, OutputError."""
    text = script(program(tree))
    if path.suffix.lower() == ".py":
        path.write_text(text, encoding="utf-8")
        return
    start = command()
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder, "tree.py"), Path(folder, "tree.blend")
        source.write_text(text, encoding="utf-8")
        done = subprocess.run([*start, str(source), "--", str(result)], capture_output=True, text=True, check=False)
        if not result.is_file():
            said = (done.stderr or done.stdout).strip().splitlines()
            raise OutputError(f"{path}: Blender saved nothing ({said[-1] if said else f'exit code {done.returncode}'})")
        shutil.copyfile(result, path)
