"""The canonical form: one way to write each of the many trees that make the same picture.

`canonical` never changes the picture (to 1e-5) on any normals, in either blend space. Its rules:

- multiply and screen are flattened and their children sorted;
- albedos under one operator are folded into one; white under a multiply and black under a screen are dropped, and their
  opposites swallow the rest; a leaf or a mask that is constant whatever the normal counts as an albedo;
- a colour takes in the amplitudes of the leaves it multiplies, and where it is left grey, one of these leaves takes it
  back. An amplitude over 1 makes a plateau and stays. An environment that cannot saturate takes in the whole colour;
- multiply is distributed over mix;
- ``mix(a, b, m) = mix(b, a, 1 - m)``: the mask is turned so that the children are sorted, where the kind of mask has a
  complement of its own (a threshold and a picture have, a stripe has not);
- the lobes of an environment are sorted; names are dropped.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeAlias, cast

import numpy as np

from unshade.errors import TreeError
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, Role, Tree, Value
from unshade.shading import SHARPEST_EDGE
from unshade.tree_size import MAX_NODES, depth_limit

Color: TypeAlias = "tuple[float, float, float]"

SAME = 1e-9
"""Numbers this near count as equal when a leaf is folded away."""

WHITE: Color = (1.0, 1.0, 1.0)
BLACK: Color = (0.0, 0.0, 0.0)


def canonical(root: Node) -> Node:
    """The canonical form of a node and all below it. Raises TreeError where the tree, or its form, is too large."""
    try:
        return _Simplifier().node(root, 1)
    except RecursionError:
        raise TreeError("the canonical form is nested too deep") from None


def structure_key(root: Tree | Node) -> str:
    """The canonical structure as text, such as ``screen(highlight,multiply(albedo,diffuse))``: kinds without numbers.

    The number of lobes of an environment and the size of a raster belong to the structure.
    """
    return _written(canonical(root.root if isinstance(root, Tree) else root))


def same_structure(a: Tree | Node, b: Tree | Node) -> bool:
    """Are the canonical forms equal but for their numbers?"""
    return structure_key(a) == structure_key(b)


def _written(node: Node) -> str:
    if isinstance(node, Operator):
        return f"{node.kind}({','.join([_written(part) for part in _parts(node)])})"
    sizes = [f"{value.width}x{value.height}" for value in node.values if isinstance(value, Raster)]
    sizes += [f"{node.lobes} lobes"] * KINDS[node.kind].repeats
    return f"{node.kind}[{','.join(sizes)}]" if sizes else node.kind


def _parts(node: Operator) -> tuple[Node, ...]:
    return node.children if node.mask is None else (*node.children, node.mask)


def _order(node: Node) -> tuple[str, list[float | bytes]]:
    """What children are sorted by: the structure first, then the numbers."""
    return _written(node), _numbers(node)


def _numbers(node: Node) -> list[float | bytes]:
    if isinstance(node, Operator):
        return [number for part in _parts(node) for number in _numbers(part)]
    return [number for value in node.values for number in ([value.data] if isinstance(value, Raster) else value)]


def _albedo(color: Iterable[float]) -> Leaf:
    return Leaf("albedo", (tuple(min(max(float(channel), 0.0), 1.0) for channel in color),))


def _scalar(leaf: Leaf, parameter: str) -> float:
    return float(cast("tuple[float, ...]", leaf[parameter])[0])


def _near(color: Iterable[float], other: Iterable[float]) -> bool:
    return all(abs(a - b) <= SAME for a, b in zip(color, other, strict=True))


def constant(leaf: Leaf) -> Color | None:
    """The colour of a leaf or a mask that is the same at every normal, or None."""
    kind = KINDS[leaf.kind]
    if leaf.kind == "albedo":
        return cast(Color, leaf["color"])
    if kind.amplitude is not None and not kind.repeats and _scalar(leaf, kind.amplitude) == 0.0:
        return BLACK
    if leaf.kind == "toon_highlight" and _scalar(leaf, "radius") == _scalar(leaf, "softness") == 0.0:
        return BLACK
    if leaf.kind in ("diffuse", "toon_diffuse") and _scalar(leaf, "ambient") >= 1.0:
        return WHITE
    if leaf.kind in ("image", "environment_map", "image_mask"):
        pixels = cast(Raster, leaf["pixels"]).array()
        pixels = pixels.reshape(len(pixels), -1)
        color = [float(channel) for channel in pixels[:, 0]] * (3 // len(pixels))
        return cast(Color, tuple(color)) if (pixels == pixels[:, :1]).all() else None
    if leaf.kind == "environment" and not any(cast("tuple[float, ...]", leaf["color"])):
        return BLACK
    if leaf.kind in ("toon_diffuse", "threshold"):
        low, width = _scalar(leaf, "threshold"), max(_scalar(leaf, "softness"), SHARPEST_EDGE)
        low -= 0.5 * _scalar(leaf, "softness") if leaf.kind == "threshold" else 0.0
        if low + width <= -1.0:
            return WHITE
        if low >= 1.0:
            dark = _scalar(leaf, "ambient") if leaf.kind == "toon_diffuse" else 0.0
            return (dark, dark, dark)
    return None


def complement(mask: Leaf) -> Leaf | None:
    """The mask that is 1 minus this one, or None where its kind has none."""
    if mask.kind == "image_mask":
        raster = cast(Raster, mask["pixels"])
        turned = (65535 - np.frombuffer(raster.data, ">u2")).astype(">u2").tobytes()
        return Leaf("image_mask", (Raster(raster.channels, raster.height, raster.width, turned),))
    if mask.kind == "threshold":
        # A soft edge is centred on its threshold and turns about it. One below the sharpest edge that `shading` draws
        # reaches out on one side only, which has to be made up for.
        softness = _scalar(mask, "softness")
        excess = max(softness, SHARPEST_EDGE) - softness
        away = tuple(-part for part in cast("tuple[float, ...]", mask["direction"]))
        return Leaf("threshold", (away, (-_scalar(mask, "threshold") - excess,), (softness,)))
    return None


def _either_side(mask: Leaf) -> tuple[str, list[float | bytes]]:
    """An order of masks in which one and its complement are the same."""
    turned = complement(mask)
    return _order(mask) if turned is None else min(_order(mask), _order(turned))


def _size(node: Node) -> int:
    return 1 + sum(_size(part) for part in _parts(node)) if isinstance(node, Operator) else 1


def _sorted_lobes(leaf: Leaf) -> Leaf:
    sizes = [parameter.size for parameter in KINDS[leaf.kind].parameters]
    values = cast("tuple[tuple[float, ...], ...]", leaf.values)
    lobes = sorted(tuple(value[k * size : (k + 1) * size] for value, size in zip(values, sizes, strict=True)) for k in range(leaf.lobes))
    return Leaf(leaf.kind, tuple(sum((lobe[k] for lobe in lobes), ()) for k in range(len(sizes))))


class _Simplifier:
    """One pass from the leaves up. Counts what it makes, since distributing multiplies over mixes can grow a tree."""

    def __init__(self) -> None:
        self.made = 0

    def node(self, node: Node, depth: int) -> Node:
        if depth > depth_limit():
            raise TreeError(f"nested too deep: {depth_limit()} levels at most")
        if isinstance(node, Leaf):
            return self.leaf(node)
        children = [self.node(child, depth + 1) for child in node.children]
        if node.mask is not None:
            return self.mix(children[0], children[1], self.leaf(node.mask))
        return self.multiply(children) if node.kind == "multiply" else self.screen(children)

    def count(self, nodes: int) -> None:
        self.made += nodes
        if self.made > MAX_NODES:
            raise TreeError(f"the canonical form has more than {MAX_NODES} nodes")

    def leaf(self, leaf: Leaf) -> Leaf:
        self.count(1)
        if leaf.kind == "stripe":
            return self.stripe(leaf)
        color = constant(leaf)
        if color is not None and KINDS[leaf.kind].role is not Role.MASK:
            return _albedo(color)
        return _sorted_lobes(leaf) if leaf.kind == "environment" else Leaf(leaf.kind, leaf.values)

    def stripe(self, leaf: Leaf) -> Leaf:
        """A stripe seen from the other end is the same stripe: the first part of its direction that is not 0 is positive."""
        direction = cast("tuple[float, ...]", leaf["direction"])
        sign = next(math.copysign(1.0, part) for part in reversed(direction) if part)
        turned = tuple(sign * part for part in direction)
        return Leaf("stripe", (turned, (sign * _scalar(leaf, "center"),), *leaf.values[2:]))

    def mix(self, left: Node, right: Node, mask: Leaf) -> Node:
        share = constant(mask)
        if left == right or share == WHITE:
            return left
        if share == BLACK:
            return right
        turned = complement(mask)
        if turned is not None and _order(right) < _order(left):
            left, right, mask = right, left, turned
        return Operator("mix", (left, right), mask)

    def flat(self, kind: str, children: list[Node]) -> tuple[list[Node], list[Color]]:
        """The operands of a multiply or a screen, nested ones included: all but the albedos, and the albedos' colours."""
        operands: list[Node] = []
        for child in children:
            operands += child.children if isinstance(child, Operator) and child.kind == kind else (child,)
        rest = [node for node in operands if node.kind != "albedo"]
        return rest, [cast(Color, node["color"]) for node in operands if isinstance(node, Leaf) and node.kind == "albedo"]

    def screen(self, children: list[Node]) -> Node:
        rest, colors = self.flat("screen", children)
        color = [1.0 - math.prod(1.0 - other[k] for other in colors) for k in range(3)]
        if _near(color, WHITE):
            return _albedo(WHITE)
        return self.joined("screen", rest, None if _near(color, BLACK) else _albedo(color))

    def multiply(self, children: list[Node]) -> Node:
        rest, colors = self.flat("multiply", children)
        color = [math.prod(other[k] for other in colors) for k in range(3)]
        mixes = [node for node in rest if node.kind == "mix"]
        if mixes and not _near(color, BLACK):
            return self.distributed(mixes, rest, color)
        color, rest = self.gathered(color, rest)
        if _near(color, BLACK):
            return _albedo(BLACK)
        color, rest = self.handed_back(color, rest)
        return self.joined("multiply", rest, None if _near(color, WHITE) else _albedo(color))

    def distributed(self, mixes: list[Node], rest: list[Node], color: list[float]) -> Node:
        """``x * mix(a, b, m) = mix(x * a, x * b, m)``, the mix whose mask sorts first outermost."""
        outer = cast(Operator, min(mixes, key=lambda node: (_either_side(cast(Leaf, cast(Operator, node).mask)), _order(node))))
        others = list(rest)
        others.remove(outer)
        self.count(1 + sum(_size(node) for node in others))
        sides = [self.multiply([_albedo(color), side, *others]) for side in outer.children]
        return self.mix(sides[0], sides[1], cast(Leaf, outer.mask))

    def gathered(self, color: list[float], rest: list[Node]) -> tuple[list[float], list[Node]]:
        """Move every amplitude that only scales its leaf (up to 1) into the colour."""
        left: list[Node] = []
        for node in rest:
            amplitude = _amplitude(node)
            if amplitude is not None and isinstance(node, Leaf):
                scale = _scalar(node, amplitude)
                color = [channel * scale for channel in color]
                node = node.set(**{amplitude: 1.0})
            left.append(node)
        return color, left

    def handed_back(self, color: list[float], rest: list[Node]) -> tuple[list[float], list[Node]]:
        """Give a grey to one leaf with an amplitude, or any colour to an environment that does not saturate with it."""
        rest = sorted(rest, key=_order)
        for index, node in enumerate(rest):
            if not isinstance(node, Leaf):
                continue
            amplitude = _amplitude(node)
            if amplitude is not None and max(color) - min(color) <= SAME:
                return [1.0, 1.0, 1.0], [*rest[:index], node.set(**{amplitude: min(color[0], 1.0)}), *rest[index + 1 :]]
            if node.kind == "environment" and _never_saturates(node["color"]):
                tinted = tuple(min(number * color[k % 3], 1.0) for k, number in enumerate(cast("tuple[float, ...]", node["color"])))
                return [1.0, 1.0, 1.0], [*rest[:index], _sorted_lobes(node.set(color=tinted)), *rest[index + 1 :]]
        return color, rest

    def joined(self, kind: str, rest: list[Node], color: Leaf | None) -> Node:
        """The operator of its sorted operands, or the one operand that is left."""
        operands = sorted([*rest, *([color] if color is not None else [])], key=_order)
        if not operands:
            return _albedo(WHITE if kind == "multiply" else BLACK)
        return operands[0] if len(operands) == 1 else Operator(kind, tuple(operands))


def _amplitude(node: Node) -> str | None:
    """The name of an amplitude that only scales the leaf: not over 1, and free to take any value from 0 to 1."""
    if not isinstance(node, Leaf) or KINDS[node.kind].repeats:
        return None
    kind = KINDS[node.kind]
    if kind.amplitude is None or kind.parameter(kind.amplitude).low > 0.0 or kind.parameter(kind.amplitude).high < 1.0:
        return None
    return kind.amplitude if _scalar(node, kind.amplitude) <= 1.0 else None


def _never_saturates(color: Value) -> bool:
    """Do the lobes' colours sum to 1 at most, so that the clamp of `shading.environment` never acts?"""
    numbers = cast("tuple[float, ...]", color)
    return all(sum(numbers[k::3]) <= 1.0 for k in range(3))
