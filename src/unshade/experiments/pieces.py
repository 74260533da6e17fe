"""Components of trees of the released grammar, told apart by their places in it: the truth of the analogies.

Code of its own on purpose: what understands an analogy (`unshade.components`) must not also decide what is right.
"""

from __future__ import annotations

from unshade.components import Component
from unshade.nodes import Leaf, Node, Operator, Tree

LIGHTS = {
    "highlight": Component.HIGHLIGHTS,
    "toon_highlight": Component.HIGHLIGHTS,
    "rim": Component.RIM,
    "environment": Component.ENVIRONMENT,
    "environment_map": Component.ENVIRONMENT,
}

Pieces = dict[Component, tuple[Node, ...]]


def pieces(tree: Tree) -> Pieces | None:
    """The nodes of each component, None where the tree is wider than ``screen(lights..., multiply(paint, form))``."""
    layers = _flat(tree.root, "screen")
    bases = [layer for layer in layers if isinstance(layer, Operator)]
    lights = [layer for layer in layers if isinstance(layer, Leaf)]
    if len(bases) != 1 or bases[0].kind != "multiply" or any(light.kind not in LIGHTS for light in lights):
        return None
    factors = _flat(bases[0], "multiply")
    paint = tuple(factor for factor in factors if _is_paint(factor))
    form = tuple(factor for factor in factors if isinstance(factor, Leaf) and factor.kind in ("diffuse", "toon_diffuse"))
    if len(paint) != 1 or not form or len(paint) + len(form) != len(factors):
        return None
    found: Pieces = {Component.ALBEDO: paint, Component.DIFFUSE: form}
    for which in (Component.HIGHLIGHTS, Component.RIM, Component.ENVIRONMENT):
        found[which] = tuple(light for light in lights if LIGHTS[light.kind] is which)
    return found


def swapped(a: Tree, b: Tree, which: Component) -> Tree:
    """A with a component of B."""
    own, theirs = pieces(a), pieces(b)
    assert own is not None and theirs is not None
    own = own | {which: theirs[which]}
    base = Operator("multiply", (*own[Component.ALBEDO], *own[Component.DIFFUSE]))
    lights = [light for one in (Component.HIGHLIGHTS, Component.RIM, Component.ENVIRONMENT) for light in own[one]]
    return Tree(Operator("screen", (base, *lights)) if lights else base)


def _flat(node: Node, kind: str) -> list[Node]:
    """The operands of nested operators of one kind."""
    if isinstance(node, Operator) and node.kind == kind:
        return [below for child in node.children for below in _flat(child, kind)]
    return [node]


def _is_paint(node: Node) -> bool:
    if isinstance(node, Leaf):
        return node.kind == "albedo"
    return node.kind == "mix" and all(map(_is_paint, node.children))
