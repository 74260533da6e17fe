"""Edits: functions from a tree to a tree. Trees are frozen, so the one before an edit is still there to go back to.

Every edit takes addresses as `selection.select` reads them, and raises AddressError for one that stands for nothing and
TreeError for a value that its parameter cannot take.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from unshade.components import Component, is_paint, uses
from unshade.errors import TreeError
from unshade.nodes import BROAD_SHARPNESS, KINDS, Leaf, Node, Parameter, Raster, Role, Tree, Value, find
from unshade.relight import rebuild, turn, turn_of
from unshade.selection import holders, select, select_all, select_one
from unshade.text import parse

EDGE = 0.05
"""Added to an edge's softness before it is scaled, so that a hard edge can be softened."""

OPERATIONS: dict[str, Callable[[float, float], float]] = {
    "=": lambda old, new: new,
    "*=": lambda old, new: old * new,
    "/=": lambda old, new: old / new,
    "+=": lambda old, new: old + new,
    "-=": lambda old, new: old - new,
}

FORM = re.compile(r"\s*(?P<where>.+?)\.(?P<parameter>\w+)\s*(?P<operation>[*/+-]?=)\s*(?P<value>.*?)\s*", re.DOTALL)


@dataclass(frozen=True)
class Assignment:
    """``ADDRESS.PARAMETER=VALUE``, or with ``*=``, ``/=``, ``+=`` or ``-=``."""

    where: str
    parameter: str
    operation: str
    value: str

    @staticmethod
    def of(text: str) -> Assignment:
        """Read ``multiply.0.color=#3366ff``. Raises TreeError."""
        found = FORM.fullmatch(text)
        if found is None:
            raise TreeError(f"expected ADDRESS.PARAMETER=VALUE such as highlight.sharpness*=2, got {text!r}")
        return Assignment(**found.groupdict())


def set_value(tree: Tree, assignment: str | Assignment) -> Tree:
    """The tree with a parameter changed in every leaf that the address stands for.

    ``=`` takes what the text form takes: a number, ``#hex`` or a word for a colour, three numbers or words for a direction.
    The other operations take a number, or one a channel, and stop at the end of the parameter's range.

    >>> tree = parse("screen(multiply(albedo(red), diffuse()), highlight())")
    >>> set_value(tree, "highlight.sharpness*=2").find("highlight")["sharpness"]
    (60.0,)
    """
    given = assignment if isinstance(assignment, Assignment) else Assignment.of(assignment)
    changed = {}
    for address, leaf in holders(tree.root, given.where, given.parameter):
        parameter = KINDS[leaf.kind].parameter(given.parameter)
        changed[address] = with_value(leaf, parameter, _assigned(parameter, leaf[parameter.name], given), address)
    return dataclasses.replace(tree, root=rebuild(tree.root, changed))


def with_value(leaf: Leaf, parameter: Parameter, value: object, address: str) -> Leaf:
    """A leaf with one parameter changed; a fault is told with its address."""
    try:
        return leaf.set(**{parameter.name: value})
    except TreeError as error:
        raise TreeError(str(error), address) from None


def _assigned(parameter: Parameter, old: Value, given: Assignment) -> tuple[float, ...]:
    where = f"{given.where}.{given.parameter}"
    if isinstance(old, Raster):
        raise TreeError(f"{where} is a picture, which an edit cannot set")
    lobes = len(old) // parameter.size
    if given.operation == "=":
        return _read(parameter, given.value, where) * lobes
    if parameter.type == "direction":
        raise TreeError(f"{where} is a direction: set it with =, or move it by degrees")
    numbers = _numbers(given.value, where)
    if len(numbers) not in (1, parameter.size):
        raise TreeError(f"{where}: expected 1{' or 3' * (parameter.size == 3)} numbers after {given.operation}, got {given.value!r}")
    if given.operation == "/=" and 0.0 in numbers:
        raise TreeError(f"{where}: cannot be divided by 0")
    factors = numbers * (len(old) // len(numbers))
    changed = (OPERATIONS[given.operation](number, factor) for number, factor in zip(old, factors, strict=True))
    return tuple(min(max(number, parameter.low), parameter.high) for number in changed)


def _read(parameter: Parameter, text: str, where: str) -> tuple[float, ...]:
    """A value in any of the forms that the text of a tree may have."""
    if parameter.type in ("scalar", "rotation"):
        numbers = _numbers(text, where)
        if len(numbers) != parameter.size:
            raise TreeError(f"{where}: expected {parameter.size} number{'s' * (parameter.size > 1)}, got {text!r}")
        return numbers
    return read_color(text, where) if parameter.type == "color" else read_direction(text, where)


def read_color(text: str, where: str = "colour") -> tuple[float, ...]:
    """``#rgb``, ``#rrggbb``, a word, or three numbers in [0, 1]. Raises TreeError."""
    return _sugar("albedo", "color", text, where)


def read_direction(text: str, where: str = "direction") -> tuple[float, ...]:
    """Words such as ``left up``, or three numbers. Raises TreeError."""
    return _sugar("diffuse", "direction", text, where)


def _sugar(kind: str, parameter: str, text: str, where: str) -> tuple[float, ...]:
    written = f"({text})" if "," in text and "(" not in text else text
    try:
        leaf = parse(f"{kind}({parameter}={written})").root
    except TreeError as error:
        # The column would be that of the sentence made here, not of what was given.
        reason = str(error).partition("\n")[0].partition(": ")[2] or str(error)
        what = reason.removeprefix(f"{kind}.{parameter}: ")
        raise TreeError(f"{where}: {what}" + ("" if repr(text) in what else f" (in {text!r})")) from None
    assert isinstance(leaf, Leaf)
    return tuple(leaf[parameter])


def _numbers(text: str, where: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.strip("() ").split(","))
    except ValueError:
        numbers = (math.nan,)
    if not all(math.isfinite(number) for number in numbers):
        raise TreeError(f"{where}: expected a number, got {text!r}")
    return numbers


def move_light(tree: Tree, right: float, up: float = 0.0, roll: float = 0.0, where: str | None = None) -> Tree:
    """The tree with a light moved by degrees: the leaves that ``where`` stands for, with all below them, or all that is light."""
    if where is None:
        return turn(tree, turn_of(right, up, roll))
    found = [address for address in _leaves(tree.root, where) if _turnable(find(tree.root, address))]
    if not found:
        raise TreeError(f"{where} has no direction, so it cannot be moved")
    return turn(tree, turn_of(right, up, roll), found)


def _turnable(node: Node) -> bool:
    return isinstance(node, Leaf) and any(parameter.type in ("direction", "rotation") for parameter in KINDS[node.kind].parameters)


def _leaves(root: Node, where: str) -> list[str]:
    """The leaves that an address stands for, those below an operator among them."""
    heads = tuple(select(root, where))
    return [address for address in uses(root) if any(address == head or address.startswith(f"{head}.") for head in heads)]


def rename(tree: Tree, where: str, name: str | None) -> Tree:
    """The tree with another name for one node; None takes the name away."""
    address = select_one(tree.root, where)
    return tree.replace(address, dataclasses.replace(find(tree.root, address), name=name))


def remove(tree: Tree, *wheres: str) -> Tree:
    """The tree without the nodes that the addresses stand for, all of them looked up in the tree as it is given.

    A light takes its colour with it, a form leaves its paint flat, and where one side of a mix goes the other takes its
    place. An operator left with one child becomes that child. Raises TreeError for a mask and for all there is.
    """
    doomed = set(select_all(tree.root, wheres))
    for address in doomed:
        if address.endswith(".mask"):
            raise TreeError("the mask of a mix cannot be removed; remove the mix or one of its sides", address)
    left = _without(tree.root, tree.root.kind, doomed)
    if left is None:
        raise TreeError(f"removing {', '.join(wheres)} would leave nothing of the tree")
    return dataclasses.replace(tree, root=left)


def _without(node: Node, address: str, doomed: set[str]) -> Node | None:
    if address in doomed:
        return None
    if isinstance(node, Leaf):
        return node
    left = [(child, _without(child, f"{address}.{k}.{child.kind}", doomed)) for k, child in enumerate(node.children)]
    kept = [child for _, child in left if child is not None]
    lost = [child for child, rest in left if rest is None]
    if node.kind == "multiply" and kept and all(map(is_paint, kept)) and any(map(_is_light, lost)):
        return None
    if len(kept) < 2:
        return kept[0] if kept else None
    return dataclasses.replace(node, children=tuple(kept))


def _is_light(node: Node) -> bool:
    return isinstance(node, Leaf) and KINDS[node.kind].role in (Role.HIGHLIGHT, Role.RIM, Role.ENVIRONMENT)


def soften(tree: Tree, factor: float = 2.0, where: str | None = None) -> Tree:
    """The tree with lights ``factor`` times as wide and edges of shading as many times as soft; a factor below 1 hardens.

    Without an address: highlights, rims, environments and the edges of toon shading, and a highlight stays a highlight
    (`nodes.BROAD_SHARPNESS`); edges of paint and the broad lights of the form stay. Environment pictures stay as they are.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise TreeError(f"soften: the factor must be a positive number, got {factor}")
    if where is None:
        known = uses(tree.root)
        chosen = [address for address, use in known.items() if use.component is not Component.ALBEDO and not use.tint]
    else:
        chosen = _leaves(tree.root, where)
    changed: dict[str, Leaf] = {}
    for address in chosen:
        leaf = find(tree.root, address)
        assert isinstance(leaf, Leaf)
        if where is not None or leaf.kind != "highlight" or leaf.role is Role.HIGHLIGHT:
            softened = _softened(leaf, factor, BROAD_SHARPNESS if where is None else 0.0)
            changed |= {address: softened} if softened != leaf else {}
    if not changed and where is not None:
        raise TreeError(f"{where} has neither an edge nor a width that could be changed")
    return dataclasses.replace(tree, root=rebuild(tree.root, changed))


def harden(tree: Tree, factor: float = 2.0, where: str | None = None) -> Tree:
    """`soften` the other way."""
    if not (math.isfinite(factor) and factor > 0):
        raise TreeError(f"harden: the factor must be a positive number, got {factor}")
    return soften(tree, 1.0 / factor, where)


def _softened(leaf: Leaf, factor: float, broadest: float) -> Leaf:
    kind = KINDS[leaf.kind]
    for parameter in kind.parameters:
        old = leaf[parameter.name]
        if parameter.name == "sharpness":
            # exp(-s |n - l|^2): the width goes with one over the root of the sharpness.
            low = max(parameter.low, broadest if leaf.kind == "highlight" else 0.0)
            leaf = leaf.set(sharpness=[min(max(number / factor**2, low), parameter.high) for number in old])
        elif parameter.name == "exponent":
            leaf = leaf.set(exponent=min(max(old[0] / factor, parameter.low), parameter.high))
        elif parameter.name == "softness":
            new = min(max((old[0] + EDGE) * factor - EDGE, 0.0), parameter.high)
            if leaf.kind == "toon_diffuse":
                # Its edge begins at the threshold: the middle stays where it is.
                start = kind.parameter("threshold")
                begin = leaf["threshold"][0] + 0.5 * (old[0] - new)
                leaf = leaf.set(threshold=min(max(begin, start.low), start.high))
            leaf = leaf.set(softness=new)
    return leaf
