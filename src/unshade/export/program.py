"""A tree as a small program: what every shader and node target translates.

`program` names each number of a tree as a uniform and writes the tree as one function of the normal, a statement an
operator, in the language of `formulas`. ``render`` and the program agree on every normal; where a target works on linear
light, `Program.function` puts the conversion at the end.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce
from itertools import groupby
from typing import Literal, TypeAlias

import torch

from unshade.errors import TreeError
from unshade.export.formulas import Function, called, expression, functions, needed
from unshade.nodes import KINDS, Leaf, Node, Parameter, Raster, Tree
from unshade.render import srgb_decode, srgb_encode

Space: TypeAlias = Literal["srgb", "linear"]

RESERVED = re.compile(r"^(gl|webgl|unity|webgpu|std|leaf)(_|$)")
"""What a name must not begin with: prefixes that shading languages keep for themselves."""

LONGEST = 6
"""Operands that one statement joins at most."""


@dataclass(frozen=True)
class Uniform:
    """A number of the tree that can be set from outside, or three that belong together."""

    name: str
    type: Literal["float", "vec3"]
    value: tuple[float, ...]
    parameter: Parameter
    address: str
    """Of the leaf."""
    leaf: str
    """How a person calls the leaf."""
    label: str
    """How a person calls the parameter."""

    @property
    def is_color(self) -> bool:
        """Is it a colour, in the tree's blend space?"""
        return self.parameter.type == "color"

    @property
    def summary(self) -> str:
        """Range, unit and meaning in one line."""
        unit = f" {self.parameter.unit}" if self.parameter.unit else ""
        span = "a vector" if self.parameter.type == "direction" else f"{self.parameter.low:.4g} to {self.parameter.high:.4g}{unit}"
        return f"{span}; {self.parameter.meaning}"


@dataclass(frozen=True)
class Picture:
    """A raster of the tree, to be looked up bilinear and repeating, its first row at v = 0, its numbers not converted."""

    name: str
    raster: Raster
    address: str


@dataclass(frozen=True)
class Statement:
    """One line of the tree's function, in the language of `formulas`."""

    name: str
    type: Literal["float", "vec3"]
    text: str
    comment: str


@dataclass(frozen=True)
class Program:
    """A tree taken apart for translation."""

    space: Space
    uniforms: tuple[Uniform, ...]
    pictures: tuple[Picture, ...]
    statements: tuple[Statement, ...]
    value: str
    """The tree's colour in its blend space."""

    def by_leaf(self) -> Iterator[tuple[str, list[Uniform]]]:
        """The uniforms of each leaf with its address."""
        for address, found in groupby(self.uniforms, key=lambda uniform: uniform.address):
            yield address, list(found)

    def picked(self, uniform: Uniform, space: Space) -> tuple[float, ...]:
        """A colour's value as a colour picker that works in another space gives it."""
        if space == self.space:
            return uniform.value
        convert = srgb_encode if space == "srgb" else srgb_decode
        return tuple(round(number, 9) for number in convert(torch.tensor(uniform.value, dtype=torch.float64)).tolist())

    def result(self, space: Space) -> str:
        """The tree's colour, converted where the target's space is another one."""
        if space == self.space:
            return self.value
        return f"encode_color({self.value})" if space == "srgb" else f"decode_color({self.value})"

    def functions(self, space: Space, *others: str) -> tuple[Function, ...]:
        """All functions that the program and ``others`` call, callers last."""
        lines = [expression(statement.text) for statement in self.statements] + [expression(self.result(space))]
        return needed([*called(lines), *others])

    def main(self, space: Space, name: str = "unshade") -> Function:
        """The tree as one function of the normal; uniforms and pictures stand outside of it."""
        statements = tuple((line.name, line.type, expression(line.text)) for line in self.statements)
        return Function(name, (("n", "vec3"),), "vec3", "", statements, expression(self.result(space)), "")


def program(tree: Tree) -> Program:
    """Take a tree apart. Raises TreeError for a kind of leaf that has no translation."""
    return _Writer(tree).program()


class _Writer:
    """Walks a tree from the leaves up, in the order of `nodes.walk`'s addresses."""

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self.uniforms: list[Uniform] = []
        self.pictures: list[Picture] = []
        self.statements: list[Statement] = []
        self.names = {*functions(), "n"}
        kinds = [node.kind for _, node in tree.walk()]
        self.repeated = {kind for kind in kinds if kinds.count(kind) > 1}
        self.seen: dict[str, int] = {}

    def program(self) -> Program:
        text, kind = self.node(self.tree.root, self.tree.root.kind)
        return Program(self.tree.blend_space, tuple(self.uniforms), tuple(self.pictures), tuple(self.statements), _color(text, kind))

    def node(self, node: Node, address: str) -> tuple[str, str]:
        """The expression for a node and its type."""
        if isinstance(node, Leaf):
            return self.leaf(node, address)
        parts = [self.node(child, f"{address}.{k}.{child.kind}") for k, child in enumerate(node.children)]
        kind: Literal["float", "vec3"] = "vec3"
        if node.mask is not None:
            mask, _ = self.leaf(node.mask, f"{address}.mask")
            (left, right) = (_color(*part) for part in parts)
            text = f"mix({right}, {left}, {mask})"
        elif node.kind == "screen":
            text = self.chain([_color(*part) for part in parts], _screened, kind, node.kind, address)
        elif node.kind == "multiply":
            parts.sort(key=lambda part: part[1] == "float")
            kind = "vec3" if parts[0][1] == "vec3" else "float"
            text = self.chain([text for text, _ in parts], " * ".join, kind, node.kind, address)
        else:
            raise TreeError(f"the operator {node.kind!r} has no translation", address)
        name = self.unique(f"{_identifier(node.name)}_{node.kind}" if _identifier(node.name) else self.numbered(node.kind))
        comment = address if node.name is None else f"{address}: {_line(node.name)}"
        self.statements.append(Statement(name, kind, text, comment))
        return name, kind

    def chain(self, texts: list[str], join: Callable[[list[str]], str], kind: Literal["float", "vec3"], stem: str, comment: str) -> str:
        """The operands joined, in several statements where there are many: lines stay readable, and compilers' stacks are finite."""
        while len(texts) > LONGEST:
            name = self.unique(self.numbered(stem))
            self.statements.append(Statement(name, kind, join(texts[:LONGEST]), comment))
            texts = [name, *texts[LONGEST:]]
        return join(texts)

    def numbered(self, kind: str) -> str:
        """``screen_1``: no language keeps a word with a number for itself."""
        self.seen[kind] = self.seen.get(kind, 0) + 1
        return f"{kind}_{self.seen[kind]}"

    def unique(self, name: str) -> str:
        found, count = name, 1
        while found in self.names:
            count += 1
            found = f"{name}_{count}"
        self.names.add(found)
        return found

    def leaf(self, leaf: Leaf, address: str) -> tuple[str, str]:
        kind = KINDS[leaf.kind]
        prefix = _identifier(leaf.name) or (self.numbered(leaf.kind) if leaf.kind in self.repeated else leaf.kind)
        title = _line(leaf.name) if leaf.name else prefix.replace("_", " ")
        lobes: list[dict[str, str]] = []
        for lobe in range(leaf.lobes):
            names = {}
            for parameter, value in zip(kind.parameters, leaf.values, strict=True):
                name = self.unique(f"{prefix}_{parameter.name}" + (f"_{lobe + 1}" if leaf.lobes > 1 else ""))
                names[parameter.name] = name
                if isinstance(value, Raster):
                    self.pictures.append(Picture(name, value, address))
                    continue
                number = value[lobe * parameter.size : (lobe + 1) * parameter.size]
                label = parameter.name + (f" {lobe + 1}" if leaf.lobes > 1 else "")
                self.uniforms.append(Uniform(name, "float" if parameter.size == 1 else "vec3", number, parameter, address, title, label))
            lobes.append(names)
        if leaf.kind == "environment":
            lights = [f"{name['color']} * spot(mirrored(n), {name['direction']}, {name['sharpness']})" for name in lobes]
            return f"min({self.chain(lights, ' + '.join, 'vec3', leaf.kind, address)}, vec3(1.0))", "vec3"
        return _shaded(leaf, address, lobes[0])


def _screened(texts: list[str]) -> str:
    return reduce(lambda below, above: f"screen({below}, {above})", texts)


def _shaded(leaf: Leaf, address: str, names: dict[str, str]) -> tuple[str, str]:
    """A leaf as an expression of its uniforms, and the type of that."""
    if leaf.kind == "albedo":
        return names["color"], "vec3"
    if leaf.kind in ("image", "image_mask", "environment_map"):
        raster = leaf["pixels"]
        texel = f"vec3({1.0 / raster.width!r}, {1.0 / raster.height!r}, 0.0)"
        if leaf.kind == "environment_map":
            return f"sample({names['pixels']}, environment_place(n, {names['rotation']}, {texel}))", "vec3"
        picture = f"sample({names['pixels']}, picture_place(n, {texel}))"
        return (picture, "vec3") if leaf.kind == "image" else (f"{picture}.x", "float")
    if leaf.kind in functions() and len(functions()[leaf.kind].parameters) == 1 + len(names):
        return f"{leaf.kind}(n, {', '.join(names.values())})", functions()[leaf.kind].result
    raise TreeError(f"the leaf {leaf.kind!r} has no translation", address)


def _color(text: str, kind: str) -> str:
    return text if kind == "vec3" else f"vec3({text})"


def _identifier(name: str | None) -> str:
    """A name as lower-case ASCII words joined by underscores; empty where nothing is left of it."""
    word = re.sub(r"[^a-z0-9]+", "_", (name or "").lower()).strip("_")[:40].strip("_")
    return "" if not word or word[0].isdigit() or RESERVED.match(word) else word


def _line(name: str) -> str:
    """A name that is safe in a one-line comment, a string and an attribute: no line ends, quotes or control characters."""
    return re.sub(r"[^\w .,:;+()#-]+", " ", name).strip()[:60] or "unnamed"
