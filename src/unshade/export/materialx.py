"""MaterialX: a node graph with an interface, each formula as a node definition of its own.

The formulas run here with values that add nodes. The graph takes world-space normals and the view direction, so the tree
turns with an upright camera. MaterialX works on linear light; a tree of encoded numbers converts at both ends.
"""

from __future__ import annotations

import ast
import zipfile
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from unshade.export.formulas import Function, functions
from unshade.export.program import Program, Uniform, program
from unshade.export.shader_text import number
from unshade.nodes import Tree
from unshade.rasters import raster_to_png

TYPES = {"float": "float", "vec3": "vector3"}

ROOT = {"version": "1.39", "colorspace": "lin_rec709"}

UNARY = {"normalize": "normalize", "exp": "exp", "cos": "cos", "sin": "sin", "acos": "acos", "abs": "absval"}
"""Nodes of one input that give what they take."""


class Value:
    """Something that the input of a node can hold: an output, an input of the graph, or a constant."""

    def __init__(self, kind: str, attributes: dict[str, str]) -> None:
        self.kind, self.attributes = kind, attributes


class Graph:
    """A node graph that is being built."""

    def __init__(self, element: ElementTree.Element) -> None:
        self.element = element
        self.count = 0

    def add(self, category: str, kind: str, inputs: dict[str, Value], **settings: tuple[str, str]) -> Value:
        """A node with its inputs and settings (type, value), and its output."""
        self.count += 1
        name = f"{category}_{self.count}"
        node = ElementTree.SubElement(self.element, category, name=name, type=kind)
        for label, value in inputs.items():
            ElementTree.SubElement(node, "input", {"name": label, "type": value.kind, **value.attributes})
        for label, (type_, text) in settings.items():
            ElementTree.SubElement(node, "input", name=label, type=type_, value=text)
        return Value(kind, {"nodename": name})

    def evaluate(self, node: ast.expr, known: dict[str, Value]) -> Value:
        """An expression of `formulas` as nodes."""
        match node:
            case ast.Constant(value=float(value)):
                return constant(value)
            case ast.Name(id=name):
                return known[name]
            case ast.Attribute(value=value, attr=part):
                return self.part(self.evaluate(value, known), part)
            case ast.UnaryOp(operand=ast.Constant(value=float(value))):
                return constant(-value)
            case ast.UnaryOp(operand=operand):
                return self.binary("multiply", self.evaluate(operand, known), constant(-1.0))
            case ast.BinOp(left=left, op=op, right=right):
                name = {ast.Add: "add", ast.Sub: "subtract", ast.Mult: "multiply", ast.Div: "divide"}[type(op)]
                return self.binary(name, self.evaluate(left, known), self.evaluate(right, known))
            case ast.Call(func=ast.Name(id="sample"), args=[ast.Name(id=picture), place]):
                return self.sample(picture, self.evaluate(place, known))
            case ast.Call(func=ast.Name(id=name), args=arguments):
                return self.call(name, [self.evaluate(argument, known) for argument in arguments])
        raise AssertionError(ast.dump(node))

    def binary(self, name: str, left: Value, right: Value) -> Value:
        """A node of two inputs. MaterialX takes a number only as the second of a vector and a number."""
        if left.kind != right.kind and left.kind == "float":
            left, right = (right, left) if name in ("add", "multiply", "min", "max") else (self.vector(left), right)
        return self.add(name, left.kind, {"in1": left, "in2": right})

    def vector(self, value: Value) -> Value:
        """A number three times."""
        if "value" in value.attributes:
            return Value("vector3", {"value": ", ".join([value.attributes["value"]] * 3)})
        return self.add("combine3", "vector3", {"in1": value, "in2": value, "in3": value})

    def part(self, value: Value, name: str) -> Value:
        """One number of a vector."""
        return self.add("extract", "float", {"in": value}, index=("integer", str("xyz".index(name))))

    def sample(self, picture: str, place: Value) -> Value:
        """A picture; rows run upwards in MaterialX."""
        flipped = self.binary("subtract", constant(1.0), self.part(place, "y"))
        coordinates = self.add("combine2", "vector2", {"in1": self.part(place, "x"), "in2": flipped})
        periodic = ("string", "periodic")
        looked_up = self.add("image", "vector3", {"texcoord": coordinates}, uaddressmode=periodic, vaddressmode=periodic)
        node = self.element[-1]
        ElementTree.SubElement(node, "input", name="file", type="filename", value=f"{picture}.png")
        ElementTree.SubElement(node, "input", name="filtertype", type="string", value="linear")
        return looked_up

    def call(self, name: str, values: list[Value]) -> Value:
        """A function that MaterialX brings, or one of `formulas`."""
        first = values[0]
        if name == "vec3":
            if len(values) == 1:
                return self.vector(first)
            if all("value" in value.attributes for value in values):
                return Value("vector3", {"value": ", ".join(value.attributes["value"] for value in values)})
            return self.add("combine3", "vector3", {f"in{k}": value for k, value in enumerate(values, 1)})
        if name in UNARY:
            return self.add(UNARY[name], first.kind, {"in": first})
        if name == "length":
            return self.add("magnitude", "float", {"in": first})
        if name == "dot":
            return self.add("dotproduct", "float", {"in1": first, "in2": values[1]})
        if name == "cross":
            return self.add("crossproduct", "vector3", {"in1": first, "in2": values[1]})
        if name in ("min", "max"):
            return self.binary(name, first, values[1])
        if name == "pow":
            return self.add("power", "float", {"in1": first, "in2": values[1]})
        if name == "atan2":
            return self.add("atan2", "float", {"iny": first, "inx": values[1]})
        if name == "clamp":
            return self.add("clamp", "float", {"in": first, "low": values[1], "high": values[2]})
        if name == "mix":
            return self.add("mix", first.kind, {"bg": first, "fg": values[1], "mix": values[2]})
        if name == "step":
            return self.add("ifgreatereq", "float", {"value1": values[1], "value2": first, "in1": constant(1.0), "in2": constant(0.0)})
        function = functions()[name]
        named = {label: value for (label, _), value in zip(function.parameters, values, strict=True)}
        return self.add(f"unshade_{name}", TYPES[function.result], named)

    def finish(self, value: Value, kind: str) -> None:
        """The graph's output."""
        if "nodename" not in value.attributes:
            value = self.add("dot", value.kind, {"in": value})
        ElementTree.SubElement(self.element, "output", {"name": "out", "type": kind, **value.attributes})


def constant(value: float) -> Value:
    """A number."""
    return Value("float", {"value": number(value)})


def _define(root: ElementTree.Element, function: Function) -> None:
    """A node definition and the graph that is its meaning."""
    definition = ElementTree.SubElement(root, "nodedef", name=f"ND_unshade_{function.name}", node=f"unshade_{function.name}")
    definition.set("doc", function.summary)
    for name, kind in function.parameters:
        ElementTree.SubElement(definition, "input", name=name, type=TYPES[kind], value="0" if kind == "float" else "0, 0, 0")
    ElementTree.SubElement(definition, "output", name="out", type=TYPES[function.result])
    body = ElementTree.SubElement(root, "nodegraph", name=f"NG_unshade_{function.name}", nodedef=f"ND_unshade_{function.name}")
    graph = Graph(body)
    known = {name: Value(TYPES[kind], {"interfacename": name}) for name, kind in function.parameters}
    for name, _, value in function.statements:
        known[name] = graph.evaluate(value, known)
    graph.finish(graph.evaluate(function.value, known), TYPES[function.result])


def _interface(element: ElementTree.Element, uniform: Uniform, made: Program) -> Value:
    """An input of the tree's graph with its range."""
    value = made.picked(uniform, "linear") if uniform.is_color else uniform.value
    kind = "color3" if uniform.is_color else TYPES[uniform.type]
    entry = ElementTree.SubElement(element, "input", name=uniform.name, type=kind, value=", ".join(number(part) for part in value))
    low, high = ([number(end)] * len(uniform.value) for end in (uniform.parameter.low, uniform.parameter.high))
    entry.attrib.update(uimin=", ".join(low), uimax=", ".join(high))
    entry.attrib.update(uiname=uniform.name.replace("_", " "), uifolder=uniform.leaf, doc=uniform.parameter.meaning)
    return Value(kind, {"interfacename": uniform.name})


def materialx(made: Program) -> str:
    """The text of a MaterialX document."""
    root = ElementTree.Element("materialx", ROOT)
    for function in made.functions("linear", "seen", *(["encode_color"] if made.space == "srgb" else [])):
        _define(root, function)
    element = ElementTree.SubElement(root, "nodegraph", name="unshade_tree")
    given = {uniform.name: _interface(element, uniform, made) for _, group in made.by_leaf() for uniform in group}
    graph = Graph(element)
    known: dict[str, Value] = {}
    for uniform in made.uniforms:
        value = given[uniform.name]
        if uniform.is_color:
            value = graph.add("convert", "vector3", {"in": value})
            value = graph.call("encode_color", [value]) if made.space == "srgb" else value
        known[uniform.name] = value
    world = ("string", "world")
    normal = graph.add("normal", "vector3", {}, space=world)
    ray = graph.add("viewdirection", "vector3", {}, space=world)
    known["n"] = graph.call("seen", [normal, graph.binary("multiply", ray, constant(-1.0))])
    main = made.main("linear")
    for name, _, expression in main.statements:
        known[name] = graph.evaluate(expression, known)
    color = graph.add("convert", "color3", {"in": graph.evaluate(main.value, known)})
    graph.finish(color, "color3")
    surface = ElementTree.SubElement(root, "surface_unlit", name="unshade_surface", type="surfaceshader")
    ElementTree.SubElement(surface, "input", name="emission_color", type="color3", nodegraph="unshade_tree", output="out")
    material = ElementTree.SubElement(root, "surfacematerial", name="unshade", type="material")
    ElementTree.SubElement(material, "input", name="surfaceshader", type="surfaceshader", nodename="unshade_surface")
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def write(tree: Tree, path: Path) -> Iterator[str]:
    """Write a document (.mtlx), or one with its pictures (.zip); yields warnings."""
    made = program(tree)
    text = materialx(made)
    if path.suffix.lower() == ".mtlx":
        path.write_text(text, encoding="utf-8")
        if made.pictures:
            names = ", ".join(f"{picture.name}.png" for picture in made.pictures)
            yield f"a .mtlx holds no pictures: {names} must stand beside it; a .zip brings them along"
        return
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in [("tree.mtlx", text.encode()), *((f"{item.name}.png", raster_to_png(item.raster)) for item in made.pictures)]:
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
