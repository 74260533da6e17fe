"""Edits: functions from a tree to a tree. Trees are frozen, so the one before an edit is still there to go back to.

Edits of one tree take addresses as `selection.select` reads them, and raise AddressError for one that stands for nothing and
TreeError for a value that its parameter cannot take.

`transfer` moves a component of one tree into another: its paint, its form, its highlights, its rim or its environment. The parts
are those of `components`. What is not moved stays as it is, bit for bit, but for broad lights of the colour of the paint, which
take on the colour of the paint that they now lie on (`recolor.recast`). Paint over the whole (a drawn edge) belongs to the
picture rather than to a component and stays with the tree it is in.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

from unshade.assignment import Assignment
from unshade.components import (
    BLACK,
    WHITE,
    Base,
    Body,
    Component,
    Light,
    Lit,
    Over,
    Part,
    Sides,
    is_paint,
    join,
    put_together,
    reflecting,
    take_apart,
    uses,
)
from unshade.errors import TreeError
from unshade.nodes import BROAD_SHARPNESS, KINDS, Leaf, Node, Operator, Parameter, Role, Tree, find
from unshade.recolor import mean_color, recast
from unshade.relight import rebuild, turn, turn_of
from unshade.selection import holders, select, select_all, select_one

EDGE = 0.05
"""Added to an edge's softness before it is scaled, so that a hard edge can be softened."""


def set_value(tree: Tree, assignment: str | Assignment) -> Tree:
    """The tree with a parameter changed in every leaf that the address stands for.

    ``=`` takes what the text form takes: a number, ``#hex`` or a word for a colour, three numbers or words for a direction.
    The other operations take a number, or one a channel, and stop at the end of the parameter's range.

    >>> from unshade.text import parse
    >>> tree = parse("screen(multiply(albedo(red), diffuse()), highlight())")
    >>> set_value(tree, "highlight.sharpness*=2").find("highlight")["sharpness"]
    (60.0,)
    """
    given = assignment if isinstance(assignment, Assignment) else Assignment.of(assignment)
    changed = {}
    for address, leaf in holders(tree.root, given.where, given.parameter):
        parameter = KINDS[leaf.kind].parameter(given.parameter)
        changed[address] = with_value(leaf, parameter, given.of_value(parameter, leaf[parameter.name]), address)
    return dataclasses.replace(tree, root=rebuild(tree.root, changed))


def with_value(leaf: Leaf, parameter: Parameter, value: object, address: str) -> Leaf:
    """A leaf with one parameter changed; a fault is told with its address."""
    try:
        return leaf.set(**{parameter.name: value})
    except TreeError as error:
        raise TreeError(str(error), address) from None


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


def component(tree: Tree, which: Component | str) -> Node | None:
    """What a tree has of a component, as one node; None where it has none of it."""
    which = Component.of(which) if isinstance(which, str) else which
    lit = take_apart(tree.root)
    if which is Component.ALBEDO:
        return _paint(lit)
    nodes = _lights(lit, which)
    if which is Component.DIFFUSE:
        form = _form(lit)
        nodes = [*([form] if form is not None else []), *nodes]
    return join("screen", nodes) if nodes else None


def components(tree: Tree) -> dict[Component, Node]:
    """All that a tree has."""
    found = {which: component(tree, which) for which in Component}
    return {which: node for which, node in found.items() if node is not None}


def transfer(source: Tree, target: Tree, which: Component | str, stand_ins: bool = False) -> Tree:
    """The target with a component of the source in the place of its own; where the source has none, without it.

    ``stand_ins``: count lights that may stand for a reflected photograph to the environment (`components.reflecting`).

    Raises TreeError for trees of different blend spaces, whose numbers mean different things.
    """
    which = Component.of(which) if isinstance(which, str) else which
    if source.blend_space != target.blend_space:
        raise TreeError(f"cannot move {which.value} from a tree that blends in {source.blend_space} to one in {target.blend_space}")
    theirs, ours = take_apart(source.root), take_apart(target.root)
    if stand_ins:
        theirs, ours = reflecting(theirs), reflecting(ours)
    old, new = (_paint_color(lit) for lit in (ours, theirs))
    if which is Component.ALBEDO:
        paint = _paint(theirs)
        changed = _repainted(ours, (paint,) if paint is not None else (), old, new)
    elif which is Component.DIFFUSE:
        form = _form(theirs)
        broad = [recast(light, new, old) for light in _lights(theirs, which)]
        changed = _relit(_formed(ours, (form,) if form is not None else ()), which, broad)
    else:
        changed = _relit(ours, which, _lights(theirs, which))
    return dataclasses.replace(target, root=put_together(changed))


def mix(first: Tree, second: Tree, take: Iterable[Component | str]) -> Tree:
    """The first tree with these components of the second."""
    for which in take:
        first = transfer(second, first, which)
    return first


def _paint(lit: Lit | Base) -> Node | None:
    """The paint of a tree as one node; None where it has neither paint nor form, which is black."""
    if isinstance(lit, Base):
        if not lit.paint and not lit.form:
            return None
        return join("multiply", [part.node for part in lit.paint])
    if isinstance(lit, Body):
        return _paint(lit.base)
    if isinstance(lit, Over):
        return _paint(lit.under)
    return _mixed(_paint(lit.left), _paint(lit.right), lit.mask, BLACK)


def _form(lit: Lit | Base) -> Node | None:
    """The form as one node; None where the paint is flat."""
    if isinstance(lit, Base):
        return join("multiply", [part.node for part in lit.form]) if lit.form else None
    if isinstance(lit, Body):
        return _form(lit.base)
    if isinstance(lit, Over):
        return _form(lit.under)
    return _mixed(_form(lit.left), _form(lit.right), lit.mask, WHITE)


def _mixed(left: Node | None, right: Node | None, mask: Part, nothing: Node) -> Node | None:
    if left == right:
        return left
    assert isinstance(mask.node, Leaf)
    return Operator("mix", (left or nothing, right or nothing), mask.node)


def _lights(lit: Lit, which: Component) -> list[Node]:
    if isinstance(lit, Body):
        inside = _lights(lit.base, which) if isinstance(lit.base, Sides) else []
        return [*inside, *(light.part.node for light in lit.lights if light.component is which)]
    if isinstance(lit, Over):
        return _lights(lit.under, which)
    left, right = _lights(lit.left, which), _lights(lit.right, which)
    shared = [node for node in left if node in right]
    only = [[node for node in side if node not in shared] for side in (left, right)]
    if not any(only):
        return shared
    mixed = _mixed(join("screen", only[0]), join("screen", only[1]), lit.mask, BLACK)
    return [*shared, *([mixed] if mixed is not None else [])]


def _paint_color(lit: Lit) -> tuple[float, ...]:
    paint = _paint(lit)
    return mean_color(paint) if paint is not None else (1.0, 1.0, 1.0)


def _parts(nodes: Iterable[Node]) -> tuple[Part, ...]:
    return tuple(Part("", node) for node in nodes)


def _repainted(lit: Lit, paint: tuple[Node, ...], old: tuple[float, ...], new: tuple[float, ...]) -> Lit:
    """Another paint in every base, broad lights with it."""
    if isinstance(lit, Over):
        return dataclasses.replace(lit, under=_repainted(lit.under, paint, old, new))
    if isinstance(lit, Sides):
        left, right = (_repainted(side, paint, old, new) for side in (lit.left, lit.right))
        return dataclasses.replace(lit, left=left, right=right)
    lights = tuple(
        Light(light.component, Part("", recast(light.part.node, old, new))) if light.component is Component.DIFFUSE else light
        for light in lit.lights
    )
    if isinstance(lit.base, Sides):
        inner = _repainted(lit.base, paint, old, new)
        assert isinstance(inner, Sides)
        return dataclasses.replace(lit, base=inner, lights=lights)
    base = dataclasses.replace(lit.base, paint=_parts(paint or (BLACK,)))
    return dataclasses.replace(lit, base=base, lights=lights)


def _formed(lit: Lit, form: tuple[Node, ...]) -> Lit:
    """Another form in every base."""
    if isinstance(lit, Over):
        return dataclasses.replace(lit, under=_formed(lit.under, form))
    if isinstance(lit, Sides):
        return dataclasses.replace(lit, left=_formed(lit.left, form), right=_formed(lit.right, form))
    if isinstance(lit.base, Sides):
        inner = _formed(lit.base, form)
        assert isinstance(inner, Sides)
        return dataclasses.replace(lit, base=inner)
    if not lit.base.paint and not lit.base.form:
        return lit
    paint = lit.base.paint or _parts((WHITE,))
    return dataclasses.replace(lit, base=dataclasses.replace(lit.base, paint=paint, form=_parts(form)))


def _relit(lit: Lit, which: Component, lights: Iterable[Node]) -> Lit:
    """Other lights of one component, on top of what has a base; those inside are gone."""
    nodes = list(lights)
    if isinstance(lit, Over):
        return dataclasses.replace(lit, under=_relit(lit.under, which, nodes))
    if isinstance(lit, Sides):
        return dataclasses.replace(lit, left=_relit(lit.left, which, nodes), right=_relit(lit.right, which, nodes))
    base: Base | Sides = lit.base
    if isinstance(base, Sides):
        inner = _relit(base, which, ())
        assert isinstance(inner, Sides)
        base = inner
    kept = tuple(light for light in lit.lights if light.component is not which)
    return dataclasses.replace(lit, base=base, lights=(*kept, *(Light(which, part) for part in _parts(nodes))))
