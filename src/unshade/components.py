"""What each part of a tree is for: its paint, its form, its lights.

A tree is read as a picture is painted. Paint is multiplied with form (the diffuse shading), which makes the *base*; lights
are screened on top of it; paint may lie over the whole (a drawn edge), and a mask may set two lit sides beside each other.
What multiplies the paint is form, whatever its kinds are; of what is screened on top, a highlight broader than
`nodes.BROAD_SHARPNESS` belongs to the diffuse, too. `take_apart` finds these parts in any tree; `put_together` gives back a
tree that makes the same picture.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

from unshade.errors import TreeError, did_you_mean
from unshade.nodes import KINDS, Leaf, Node, Operator, Role, walk


class Component(enum.Enum):
    """A part of a tree that can be moved into another."""

    ALBEDO = "albedo"
    DIFFUSE = "diffuse"
    HIGHLIGHTS = "highlights"
    RIM = "rim"
    ENVIRONMENT = "environment"

    @classmethod
    def of(cls, word: str) -> Component:
        """The component of this name. Raises TreeError with the nearest known word."""
        words = [component.value for component in cls]
        if word not in words:
            raise TreeError(f"unknown component {word!r}{did_you_mean(word, words)}")
        return cls(word)


NARROW = 25.0
"""Least sharpness of a highlight that is surely none of an environment's lights."""

STRONG = 0.6
"""And what its amplitude is over."""

WHITE = Leaf("albedo", ((1.0, 1.0, 1.0),))
BLACK = Leaf("albedo", ((0.0, 0.0, 0.0),))


@dataclass(frozen=True)
class Part:
    """A node with its address in the tree it was taken from."""

    address: str
    node: Node


@dataclass(frozen=True)
class Light:
    """What is screened on top: one light with its colour."""

    component: Component
    part: Part


@dataclass(frozen=True)
class Base:
    """``multiply(paint..., form...)``. Without paint it is white, without form it is flat, without both it is black."""

    paint: tuple[Part, ...]
    form: tuple[Part, ...]
    name: str | None = None


@dataclass(frozen=True)
class Body:
    """``screen(base, lights...)``."""

    base: Base | Sides
    lights: tuple[Light, ...]
    name: str | None = None


@dataclass(frozen=True)
class Sides:
    """``mix(left, right, mask)`` of two lit sides."""

    left: Lit
    right: Lit
    mask: Part
    name: str | None = None


@dataclass(frozen=True)
class Over:
    """Paint over the whole: ``mix(paint, under, mask)``, or the other way round where the paint is not ``first``."""

    paint: Part
    under: Lit
    mask: Part
    first: bool
    name: str | None = None


Lit: TypeAlias = "Body | Sides | Over"


def is_paint(node: Node) -> bool:
    """Paint and nothing else: colours, also joined by operators."""
    if isinstance(node, Leaf):
        return KINDS[node.kind].role is Role.PAINT
    return all(is_paint(child) for child in node.children)


def take_apart(root: Node) -> Lit:
    """The parts of a tree."""
    return _lit(Part(root.kind, root))


def _children(part: Part, flat: str = "") -> Iterator[Part]:
    """The children of an operator; those of the operator ``flat`` inside it in their parent's place."""
    assert isinstance(part.node, Operator)
    for index, child in enumerate(part.node.children):
        below = Part(f"{part.address}.{index}.{child.kind}", child)
        if child.kind == flat:
            yield from _children(below, flat)
        else:
            yield below


def _mask(part: Part) -> Part:
    assert isinstance(part.node, Operator) and part.node.mask is not None
    return Part(f"{part.address}.mask", part.node.mask)


def _lit(part: Part) -> Lit:
    node = part.node
    if not isinstance(node, Operator) or is_paint(node) or node.kind == "multiply":
        light = light_component(node)
        alone = light is not None and isinstance(node, Leaf)
        return Body(Base((), ()), (Light(light, part),)) if alone and light else Body(_base(part), ())
    if node.kind == "mix":
        left, right = _children(part)
        for paint, under, first in ((left, right, True), (right, left, False)):
            if is_paint(paint.node):
                return Over(paint, _lit(under), _mask(part), first, node.name)
        return Sides(_lit(left), _lit(right), _mask(part), node.name)
    lights: list[Light] = []
    bases: list[Part] = []
    for child in _children(part, "screen"):
        component = light_component(child.node)
        if component is None:
            bases.append(child)
        else:
            lights.append(Light(component, child))
    if not bases:
        broad = [light for light in lights if light.component is Component.DIFFUSE]
        if broad:
            bases.append(broad[0].part)
            lights.remove(broad[0])
    lights += [Light(Component.DIFFUSE, other) for other in bases[1:]]
    return Body(_base(bases[0]) if bases else Base((), ()), tuple(lights), node.name)


def _base(part: Part) -> Base | Sides:
    node = part.node
    if isinstance(node, Operator) and node.kind == "multiply":
        factors = list(_children(part, "multiply"))
        paint = tuple(factor for factor in factors if is_paint(factor.node))
        return Base(paint, tuple(factor for factor in factors if factor not in paint), node.name)
    if is_paint(node):
        return Base((part,), ())
    if isinstance(node, Operator) and node.kind == "mix":
        inside = _lit(part)
        return inside if isinstance(inside, Sides) else Base((), (part,))
    return Base((), (part,))


def light_component(node: Node) -> Component | None:
    """Which light a node is, with its colour; None for paint and for what holds form."""
    shades = [leaf for _, leaf in walk(node) if isinstance(leaf, Leaf) and KINDS[leaf.kind].role not in (Role.PAINT, Role.MASK)]
    roles = {KINDS[leaf.kind].role for leaf in shades}
    if not roles or Role.DIFFUSE in roles:
        return None
    if Role.ENVIRONMENT in roles:
        return Component.ENVIRONMENT
    if Role.RIM in roles:
        return Component.RIM
    return Component.DIFFUSE if all(leaf.role is Role.DIFFUSE for leaf in shades) else Component.HIGHLIGHTS


def reflecting(lit: Lit) -> Lit:
    """The parts with every highlight that is broad, weak, tinted or cut taken for a part of the environment.

    Where a photograph is reflected, a tree of few values holds it as lights like these; a highlight is narrow, strong and white.
    """
    if isinstance(lit, Over):
        return dataclasses.replace(lit, under=reflecting(lit.under))
    if isinstance(lit, Sides):
        return _reflecting_sides(lit)
    lights = tuple(
        Light(Component.ENVIRONMENT, light.part) if light.component is Component.HIGHLIGHTS and not _is_strong(light.part.node) else light
        for light in lit.lights
    )
    return dataclasses.replace(lit, base=_reflecting_sides(lit.base) if isinstance(lit.base, Sides) else lit.base, lights=lights)


def _reflecting_sides(sides: Sides) -> Sides:
    return dataclasses.replace(sides, left=reflecting(sides.left), right=reflecting(sides.right))


def _is_strong(node: Node) -> bool:
    return isinstance(node, Leaf) and node.kind == "highlight" and node["sharpness"][0] >= NARROW and node["amplitude"][0] > STRONG


def join(kind: str, nodes: list[Node], name: str | None = None) -> Node:
    """A multiply or a screen of nodes; of none its identity, of one that node."""
    if not nodes:
        return WHITE if kind == "multiply" else BLACK
    return nodes[0] if len(nodes) == 1 else Operator(kind, tuple(nodes), None, name)


def put_together(lit: Lit | Base) -> Node:
    """The tree of its parts."""
    if isinstance(lit, Base):
        return join("multiply", [part.node for part in (*lit.paint, *lit.form)], lit.name) if lit.paint or lit.form else BLACK
    if isinstance(lit, Body):
        base = put_together(lit.base)
        lights = [light.part.node for light in lit.lights]
        return join("screen", [*([] if base == BLACK and lights else [base]), *lights], lit.name)
    mask = lit.mask.node
    assert isinstance(mask, Leaf)
    if isinstance(lit, Sides):
        return Operator("mix", (put_together(lit.left), put_together(lit.right)), mask, lit.name)
    pair = (lit.paint.node, put_together(lit.under))
    return Operator("mix", pair if lit.first else pair[::-1], mask, lit.name)


@dataclass(frozen=True)
class Use:
    """What a leaf is for: ``top`` of a light on top, ``tint`` that light's colour, ``over`` of paint over the whole."""

    component: Component
    top: bool = False
    tint: bool = False
    over: bool = False


def uses(root: Node) -> dict[str, Use]:
    """The use of every leaf of a tree, masks among them, by address in the order of `nodes.walk`."""
    found: dict[str, Use] = {}
    _note(take_apart(root), found)
    return {address: found[address] for address, node in walk(root) if isinstance(node, Leaf)}


def leaves_below(part: Part) -> Iterator[tuple[str, Leaf]]:
    """The leaves of a part with their addresses in its tree."""
    for below, node in walk(part.node):
        if isinstance(node, Leaf):
            yield part.address + below[len(part.node.kind) :], node


def _note(lit: Lit | Base, found: dict[str, Use]) -> None:
    if isinstance(lit, Base):
        for component, parts in ((Component.ALBEDO, lit.paint), (Component.DIFFUSE, lit.form)):
            found.update((address, Use(component)) for part in parts for address, _ in leaves_below(part))
    elif isinstance(lit, Body):
        _note(lit.base, found)
        for light in lit.lights:
            for address, leaf in leaves_below(light.part):
                found[address] = Use(light.component, top=True, tint=leaf.role in (Role.PAINT, Role.MASK))
    else:
        sides = (lit.left, lit.right) if isinstance(lit, Sides) else (lit.under,)
        found[lit.mask.address] = Use(Component.ALBEDO, over=isinstance(lit, Over))
        if isinstance(lit, Over):
            found.update((address, Use(Component.ALBEDO, over=True)) for address, _ in leaves_below(lit.paint))
        for side in sides:
            _note(side, found)
