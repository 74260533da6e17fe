"""Trees as one line of text, lossless: ``screen(multiply(albedo(#cc2030), diffuse(left up, ambient=0.2)), highlight(...))``.

The grammar, with white space, line breaks included, free between any two words and marks::

    tree      = node ["@" ("srgb" | "linear")] ["exposure" "=" number]
    node      = kind "(" [argument {"," argument}] ")"
    argument  = [parameter "="] value | "name" "=" string | "mask" "=" node
    value     = number | "(" number "," number "," number ")" | string | "#rgb" | "#rrggbb" | word {word}

A value stands in the parameter's place or after its name. Where a colour is meant, a hex colour or a word such as
``red`` will do; where a direction is meant, words such as ``left up``. A leaf with several lobes separates them by
``;``: ``environment((0, 0, 1), 20, white; left up, 50, red)``. A raster is the base64 of a 16-bit PNG.
"""

from __future__ import annotations

import json
import math
import re
from typing import Literal, NoReturn, cast

from unshade.blend import BLENDS
from unshade.errors import TreeError, TreeSyntaxError, did_you_mean
from unshade.grammar import check_size
from unshade.nodes import KINDS, Kind, Leaf, Node, Operator, Parameter, Raster, Role, Tree, Value, is_kind
from unshade.rasters import raster_from_base64, raster_to_base64
from unshade.tree_size import MAX_NODES, depth_limit

DIRECTION_WORDS = {
    "right": (1.0, 0.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "up": (0.0, 1.0, 0.0),
    "down": (0.0, -1.0, 0.0),
    "front": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
}
"""Words that add up to a direction: ``left up front``."""

COLOR_WORDS = {
    "black": "#000000",
    "white": "#ffffff",
    "grey": "#808080",
    "gray": "#808080",
    "silver": "#c0c0c0",
    "red": "#ff0000",
    "green": "#008000",
    "blue": "#0000ff",
    "yellow": "#ffff00",
    "orange": "#ffa500",
    "brown": "#a52a2a",
    "pink": "#ffc0cb",
    "purple": "#800080",
    "magenta": "#ff00ff",
    "cyan": "#00ffff",
    "teal": "#008080",
    "navy": "#000080",
    "olive": "#808000",
    "gold": "#ffd700",
}
"""Colour words and what they stand for, as in CSS."""


def to_text(tree: Tree | Node) -> str:
    """A tree as one line; `parse` gives the same tree back. Raises TreeError for one too large or too deep to be read."""
    root = tree.root if isinstance(tree, Tree) else tree
    check_size(root)
    parts = [_node_text(root)]
    if isinstance(tree, Tree):
        parts += [f"@{tree.blend_space}"] * (tree.blend_space != "srgb")
        parts += [f"exposure={number_text(tree.exposure)}"] * (tree.exposure != 1.0)
    return " ".join(parts)


def number_text(number: float) -> str:
    """The shortest text that reads back as the same number."""
    text = repr(float(number))
    return text[:-2] if text.endswith(".0") else text


def _node_text(node: Node) -> str:
    name = [] if node.name is None else [f"name={json.dumps(node.name)}"]
    if isinstance(node, Leaf):
        lobes = [_lobe_text(node, k) for k in range(node.lobes)]
        return f"{node.kind}({'; '.join(', '.join(lobe) for lobe in [*lobes[:-1], [*lobes[-1], *name]])})"
    inside = [_node_text(child) for child in node.children]
    if node.mask is not None:
        inside.append(_node_text(node.mask))
    return f"{node.kind}({', '.join(inside + name)})"


def _lobe_text(node: Leaf, lobe: int) -> list[str]:
    """The arguments of one lobe; only the first is given by place."""
    written: list[str] = []
    for parameter, value in zip(KINDS[node.kind].parameters, node.values, strict=True):
        if isinstance(value, Raster):
            text = f'"{raster_to_base64(value)}"' if lobe == 0 else ""
        else:
            numbers = [number_text(number) for number in value[lobe * parameter.size : (lobe + 1) * parameter.size]]
            text = numbers[0] if parameter.type == "scalar" else f"({', '.join(numbers)})"
        if text:
            written.append(f"{parameter.name}={text}" if written else text)
    return written


def parse(text: str) -> Tree:
    """Read a tree from text. Raises TreeSyntaxError with the column of the fault."""
    return _Parser(text).tree()


TOKEN = re.compile(
    r"""(?P<word>[^\W\d]\w*)
      | (?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)
      | (?P<hex>\#\w*)
      | (?P<string>"[^"\\]*(?:\\.[^"\\]*)*")
      | (?P<mark>[(),;=@])""",
    re.VERBOSE | re.DOTALL,
)
SPACE = re.compile(r"\s*")
EQUALS = re.compile(r"\s*=")


class _Parser:
    """Recursive descent over one token at a time, so that a text that is far too long is refused early."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.end = self.column = self.nodes = 0
        self.type = self.token = ""
        self.take()

    def fault(self, message: str, column: int | None = None) -> NoReturn:
        """Raise, pointing at a column or at the current token."""
        one_line = re.sub(r"\s", " ", self.text)
        raise TreeSyntaxError(message, one_line, self.column if column is None else column) from None

    def take(self) -> str:
        """Step to the next token and return the one left behind."""
        left = self.token
        space = SPACE.match(self.text, self.end)
        start = space.end() if space else self.end
        self.column = start + 1
        self.type, self.token = "end", ""
        if start < len(self.text):
            found = TOKEN.match(self.text, start)
            if found is None:
                self.fault("this string has no end" if self.text[start] == '"' else f"unexpected character {self.text[start]!r}")
            self.type, self.token, start = found.lastgroup or "", found.group(), found.end()
        self.end = start
        return left

    @property
    def here(self) -> str:
        """The current token for a message."""
        return repr(self.token[:40]) if self.token else "the end"

    @property
    def names_a_value(self) -> bool:
        """Is the current token a word before an equals sign?"""
        return self.type == "word" and EQUALS.match(self.text, self.end) is not None

    def at(self, *marks: str) -> bool:
        """Is the current token one of these marks?"""
        return self.type == "mark" and self.token in marks

    def expect(self, mark: str, meaning: str) -> None:
        """Step over a mark that must come now."""
        if not self.at(mark):
            self.fault(f"expected {mark!r} {meaning}, got {self.here}")
        self.take()

    def tree(self) -> Tree:
        """A whole text."""
        root_column = self.column
        root = self.node(1)
        if isinstance(root, Leaf) and KINDS[root.kind].role is Role.MASK:
            self.fault(f"a tree cannot be only a mask ({root.kind})", root_column)
        space, exposure = "srgb", 1.0
        if self.at("@"):
            self.take()
            if self.token not in ("srgb", "linear"):
                self.fault(f"expected a blend space, srgb or linear, got {self.here}")
            space = self.take()
        if self.token == "exposure":
            self.take()
            self.expect("=", "after exposure")
            column, exposure = self.column, self.number()
            if not (math.isfinite(exposure) and exposure > 0):
                self.fault(f"exposure must be a positive number, got {exposure:g}", column)
        if self.type != "end":
            self.fault(f"expected the end of the tree, got {self.here}")
        return Tree(root, cast(Literal["srgb", "linear"], space), exposure)

    def node(self, depth: int) -> Node:
        """An operator or a leaf."""
        column, kind = self.column, self.token
        if self.type != "word":
            self.fault(f"expected a node such as albedo(...), got {self.here}")
        if kind not in BLENDS and not is_kind(kind):
            self.fault(f"unknown kind {kind!r}{did_you_mean(kind, [*KINDS, *BLENDS])}")
        self.nodes += 1
        if self.nodes > MAX_NODES:
            self.fault(f"a tree may have {MAX_NODES} nodes at most")
        if depth > depth_limit():
            self.fault(f"nested too deep: {depth_limit()} levels at most")
        self.take()
        self.expect("(", f"after {kind}")
        return self.operator(kind, column, depth) if kind in BLENDS else self.leaf(KINDS[kind], column)

    def operator(self, kind: str, column: int, depth: int) -> Operator:
        """What stands between the brackets of an operator."""
        children: list[tuple[int, Node]] = []
        mask: tuple[int, Node] | None = None
        name = None
        while not self.at(")"):
            if self.names_a_value:
                if self.token == "name":
                    name = self.name(name)
                elif self.token == "mask" and kind == "mix" and mask is None:
                    self.take()
                    self.take()
                    mask = self.column, self.node(depth + 1)
                else:
                    self.fault(f"{kind} takes nodes and a name, got {self.token}=")
            else:
                children.append((self.column, self.node(depth + 1)))
            self.separator(kind)
        if kind == "mix" and mask is None and len(children) == 3:
            mask = children.pop()
        for where, child in children:
            if isinstance(child, Leaf) and KINDS[child.kind].role is Role.MASK:
                self.fault(f"{kind}: a mask ({child.kind}) cannot be a child; give it as the mask of a mix", where)
        if kind == "mix" and mask is not None and not (isinstance(mask[1], Leaf) and KINDS[mask[1].kind].role is Role.MASK):
            self.fault(f"mix: needs a mask (threshold, stripe or image_mask), got {mask[1].kind}", mask[0])
        try:
            node = Operator(kind, tuple(child for _, child in children), cast(Leaf, mask[1]) if mask else None, name)
        except TreeError as error:
            self.fault(str(error))
        self.take()
        return node

    def leaf(self, kind: Kind, column: int) -> Leaf:
        """What stands between the brackets of a leaf."""
        lobes: list[dict[str, tuple[int, Value]]] = [{}]
        name, by_place = None, 0
        while not self.at(")"):
            if self.at(";"):
                if not kind.repeats:
                    self.fault(f"{kind.name} has one set of parameters, so it takes no ';'")
                self.take()
                lobes.append({})
                by_place = 0
                continue
            if self.names_a_value and self.token == "name":
                name = self.name(name)
            else:
                column_of_argument, named = self.column, self.names_a_value
                parameter = self.parameter(kind, by_place)
                by_place = len(kind.parameters) + 1 if named else by_place + 1
                if parameter.name in lobes[-1]:
                    self.fault(f"{kind.name} has its {parameter.name} already", column_of_argument)
                lobes[-1][parameter.name] = (self.column, self.value(kind, parameter))
            if not self.at(";"):
                self.separator(kind.name)
        node = self.joined(kind, column, lobes, name)
        self.take()
        return node

    def joined(self, kind: Kind, column: int, lobes: list[dict[str, tuple[int, Value]]], name: str | None) -> Leaf:
        """The leaf of all its lobes. Each is checked by itself, so that a fault is found in its own."""
        checked = []
        for given in lobes:
            values: list[Value] = []
            for parameter in kind.parameters:
                source = lobes[0] if parameter.type == "raster" else given
                if parameter.name in source:
                    values.append(source[parameter.name][1])
                elif parameter.default is not None:
                    values.append(parameter.default)
                else:
                    self.fault(f"{kind.name}: needs {parameter.name}", column)
            try:
                checked.append(Leaf(kind.name, tuple(values), name))
            except TreeError as error:
                at = [place for key, (place, _) in given.items() if str(error).startswith(f"{kind.name}.{key}:")]
                self.fault(str(error), at[0] if at else column)
        if len(checked) == 1:
            return checked[0]
        joined: list[Value] = []
        for entries in zip(*(lobe.values for lobe in checked), strict=True):
            numbers = tuple(number for entry in entries if not isinstance(entry, Raster) for number in entry)
            joined.append(numbers or entries[0])
        return Leaf(kind.name, tuple(joined), name)

    def parameter(self, kind: Kind, by_place: int) -> Parameter:
        """The parameter that the next value is for, by its name or by its place."""
        if self.names_a_value:
            try:
                parameter = kind.parameter(self.token)
            except TreeError as error:
                self.fault(str(error))
            self.take()
            self.take()
            return parameter
        if by_place == len(kind.parameters):
            self.fault(f"{kind.name} takes {len(kind.parameters)} values ({', '.join(p.name for p in kind.parameters)}), got another")
        if by_place > len(kind.parameters):
            self.fault("a value after a named one needs its name, too")
        return kind.parameters[by_place]

    def separator(self, kind: str) -> None:
        """A comma, or the closing bracket, which is left standing."""
        if self.at(","):
            self.take()
        elif not self.at(")"):
            self.fault(f"expected ',' or ')' in {kind}(...), got {self.here}")

    def name(self, known: str | None) -> str:
        """``name="..."``."""
        if known is not None:
            self.fault("a node has one name")
        self.take()
        self.take()
        column = self.column
        text = self.string("a name in double quotes")
        try:
            return cast(str, json.loads(text, strict=False))
        except ValueError:
            self.fault("this string has an escape that is not one of JSON's", column)

    def string(self, meaning: str) -> str:
        """A string with its quotes."""
        if self.type != "string":
            self.fault(f"expected {meaning}, got {self.here}")
        return self.take()

    def number(self) -> float:
        """One number."""
        if self.type != "number":
            self.fault(f"expected a number, got {self.here}")
        return float(self.take())

    def value(self, kind: Kind, parameter: Parameter) -> Value:
        """The value of one parameter, sugar resolved."""
        if parameter.type == "raster":
            column, text = self.column, self.string("a PNG as a base64 string")
            try:
                return raster_from_base64(text[1:-1])
            except TreeError as error:
                self.fault(f"{kind.name}.{parameter.name}: {error}", column)
        if parameter.type == "scalar":
            return (self.number(),)
        if parameter.type == "color" and self.type in ("hex", "word"):
            return self.color()
        if parameter.type == "direction" and self.type == "word":
            return self.direction()
        return self.vector(f"{kind.name}.{parameter.name}")

    def vector(self, where: str) -> tuple[float, ...]:
        """``(x, y, z)``."""
        column = self.column
        self.expect("(", f"and 3 numbers for {where}")
        numbers = [self.number()]
        while self.at(","):
            self.take()
            numbers.append(self.number())
        self.expect(")", f"after the numbers of {where}")
        if len(numbers) != 3:
            self.fault(f"{where}: expected 3 numbers, got {len(numbers)}", column)
        return tuple(numbers)

    def color(self) -> tuple[float, ...]:
        """``#rgb``, ``#rrggbb`` or a word."""
        column, text = self.column, self.token
        if self.type == "word":
            if text not in COLOR_WORDS:
                self.fault(f"unknown colour {text!r}{did_you_mean(text, COLOR_WORDS)}")
            text = COLOR_WORDS[text]
        digits = text[1:]
        if not re.fullmatch(r"[0-9a-fA-F]{3}|[0-9a-fA-F]{6}", digits):
            self.fault(f"expected #rgb or #rrggbb, got {text[:20]!r}", column)
        self.take()
        digits = "".join(digit * 2 for digit in digits) if len(digits) == 3 else digits
        return tuple(int(digits[k : k + 2], 16) / 255.0 for k in (0, 2, 4))

    def direction(self) -> tuple[float, ...]:
        """``left up``: the sum of the words."""
        column, total = self.column, (0.0, 0.0, 0.0)
        while self.type == "word":
            if self.token not in DIRECTION_WORDS:
                self.fault(f"unknown direction {self.token!r}{did_you_mean(self.token, DIRECTION_WORDS)}")
            x, y, z = DIRECTION_WORDS[self.take()]
            total = (total[0] + x, total[1] + y, total[2] + z)
        if not any(total):
            self.fault("these directions cancel out", column)
        return total
