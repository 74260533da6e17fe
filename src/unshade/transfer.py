"""Move a component of one tree into another: its paint, its form, its highlights, its rim or its environment.

The parts are those of `components`. What is not moved stays as it is, bit for bit, but for broad lights of the colour of the
paint, which take on the colour of the paint that they now lie on (`recolor.recast`). Paint over the whole (a drawn edge)
belongs to the picture rather than to a component and stays with the tree it is in.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

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
    join,
    put_together,
    reflecting,
    take_apart,
)
from unshade.errors import TreeError
from unshade.nodes import Leaf, Node, Operator, Tree
from unshade.recolor import mean_color, recast


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
