"""From a pool of decoded pictures to a tree: leaves and masks become parametric, operators are arranged as the searches like them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

from unshade.decoded import leaf_of, mask_of
from unshade.inference import Part, Pool
from unshade.moves import is_paint
from unshade.nodes import KINDS, Leaf, Node, Operator, Role, leaf, tint


class Fits:
    """The leaves and masks of pools, each fitted once, however many pools share it."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Part, Leaf]] = {}
        self.count = 0

    def _of(self, part: Part, operands: tuple[Part, Part] | None) -> Leaf:
        # The part is kept with its leaf: the number of a part that is gone may be another's.
        if id(part) not in self._known:
            self.count += 1
            if operands is None:
                found = leaf_of(part.kind if part.state == "leaf" else "albedo", part.image.cpu())
            else:
                assert part.mask is not None
                shown = (operands[0].image - operands[1].image).abs().mean(0, keepdim=True)
                found = mask_of(part.mask.cpu(), shown.cpu())
            self._known[id(part)] = part, found
        return self._known[id(part)][1]

    def mask(self, pool: Pool, place: int) -> Leaf:
        """The mask of a part that is a mix."""
        part = pool.parts[place]
        assert part.children is not None
        left, right = part.children
        return self._of(part, (pool.parts[left], pool.parts[right]))

    def tree(self, pool: Pool, second: Mapping[int, Node] | None = None, place: int = 0) -> Node:
        """The tree of a pool, or of one of its parts.

        Args:
            second: what a second stage found for parts that were left over, by their place. Others, and open parts, are
                one colour each.
            place: of the part on top.
        """
        second = second or {}

        def node(place: int) -> Node:
            part = pool.parts[place]
            if place in second:
                return second[place]
            if part.children is None:
                return self._of(part, None)
            left, right = part.children
            assert part.operator is not None
            mask = self.mask(pool, place) if part.mask is not None else None
            return Operator(part.operator, (node(left), node(right)), mask)

        return arranged(node(place))


def arranged(root: Node) -> Node:
    """The same picture with multiply and screen flat, one albedo in each product, and paint and form before lights.

    So the searches find their way in it (`moves.Anatomy`).
    """
    if isinstance(root, Leaf):
        return root
    children = tuple(arranged(child) for child in root.children)
    if root.kind == "mix":
        return dataclasses.replace(root, children=children)
    flat = [
        below for child in children for below in (child.children if isinstance(child, Operator) and child.kind == root.kind else (child,))
    ]
    if root.kind == "multiply":
        flat = _one_albedo(flat)
        flat.sort(key=lambda child: not is_paint(child))
    else:
        flat.sort(key=_is_light)
    return _tinted(Operator(root.kind, tuple(flat))) if len(flat) > 1 else flat[0]


def _one_albedo(factors: list[Node]) -> list[Node]:
    colors = [factor["color"] for factor in factors if isinstance(factor, Leaf) and factor.kind == "albedo"]
    if len(colors) < 2:
        return factors
    color = tuple(math.prod(channel) for channel in zip(*colors, strict=True))
    return [leaf("albedo", color=color)] + [f for f in factors if not (isinstance(f, Leaf) and f.kind == "albedo")]


def _is_light(node: Node) -> bool:
    pair = tint(node)
    light = pair[1] if pair else node
    return isinstance(light, Leaf) and KINDS[light.kind].role in (Role.HIGHLIGHT, Role.RIM, Role.ENVIRONMENT)


def _tinted(node: Operator) -> Node:
    """The colour of a light carries its strength, which is then not stored twice."""
    pair = tint(node)
    amplitude = KINDS[pair[1].kind].amplitude if pair else None
    if pair is None or amplitude is None or not 0.0 < pair[1][amplitude][0] < 1.0:
        return node
    strength = pair[1][amplitude][0]
    return Operator("multiply", (pair[0].set(color=[c * strength for c in pair[0]["color"]]), pair[1].set(**{amplitude: 1.0})))
