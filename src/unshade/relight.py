"""Turn the light: every leaf that depends on it turns together, and the paint stays where it is.

A turn is three angles in degrees, (right, up, roll): the axis of the rotation is (-up, right, roll) and its angle their
length, as when a ball is dragged. So the turn (-a, -b, -c) undoes (a, b, c) exactly.

What turns: the direction of highlights, of diffuse and toon shading and of rims (the silhouette is the viewer's and stays);
the lobes and the stored rotation of environments; masks between shadings that hold no paint. Albedos, pictures and the masks
between paints stay.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence

import numpy as np

from unshade.components import Component, Use, uses
from unshade.errors import TreeError
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, Role, Tree, Value, find, walk

MAIN_LIGHT = (Component.DIFFUSE, Component.HIGHLIGHTS, Component.RIM, Component.ENVIRONMENT)
"""Where `main_light` looks first."""


def rotation_matrix(axis_angle: Sequence[float] | np.ndarray) -> np.ndarray:
    """(3, 3) of an axis-angle vector in radians (Rodrigues)."""
    angle = math.sqrt(sum(part * part for part in axis_angle))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = (part / angle for part in axis_angle)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def axis_angle(matrix: np.ndarray) -> tuple[float, float, float]:
    """The axis-angle vector of a rotation matrix, its length in [0, pi], by way of the quaternion."""
    # Four times the outer product of the quaternion (w, x, y, z) with itself: the longest row is the safest.
    m = matrix
    outer = np.array(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    row = outer[int(np.argmax(np.diag(outer)))]
    w, *vector = (row / np.linalg.norm(row) * (1.0 if row[0] >= 0 else -1.0)).tolist()
    length = math.sqrt(sum(part * part for part in vector))
    scale = 2.0 * math.atan2(length, w) / length if length > 1e-12 else 2.0
    return vector[0] * scale, vector[1] * scale, vector[2] * scale


def turn_of(right: float, up: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """The (3, 3) rotation that moves a light in front by these degrees. Raises TreeError for numbers that are not finite."""
    if not all(math.isfinite(angle) for angle in (right, up, roll)):
        raise TreeError(f"a turn needs finite degrees, got {right}, {up}, {roll}")
    return rotation_matrix([math.radians(angle) for angle in (-up, right, roll)])


def turn_between(before: Sequence[float], after: Sequence[float]) -> np.ndarray:
    """The shortest rotation from one direction to another; half a turn about the vertical, or else x, where they are opposite."""
    a, b = (np.asarray(vector, dtype=float) / np.linalg.norm(vector) for vector in (before, after))
    axis, cosine = np.cross(a, b), float(a @ b)
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        if cosine > 0:
            return np.eye(3)
        other = np.array([0.0, 1.0, 0.0]) if abs(a[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        axis = other - a * (a @ other)
        return rotation_matrix(axis / np.linalg.norm(axis) * math.pi)
    return rotation_matrix(axis / length * math.atan2(length, cosine))


def turned_leaf(leaf: Leaf, rotation: np.ndarray) -> Leaf:
    """A leaf with its directions, or its stored rotation, turned by a (3, 3) matrix."""
    values: list[Value] = []
    for parameter, value in zip(KINDS[leaf.kind].parameters, leaf.values, strict=True):
        if parameter.type == "direction" and not isinstance(value, Raster):
            value = tuple((np.asarray(value).reshape(-1, 3) @ rotation.T).ravel().tolist())
        elif parameter.type == "rotation" and not isinstance(value, Raster):
            value = axis_angle(rotation @ rotation_matrix(value))
        values.append(value)
    return dataclasses.replace(leaf, values=tuple(values))


def turns(leaf: Leaf) -> bool:
    """Has this leaf a direction or a rotation?"""
    return any(parameter.type in ("direction", "rotation") for parameter in KINDS[leaf.kind].parameters)


def lit_leaves(root: Node) -> dict[str, Leaf]:
    """The leaves that turn with the light, by address: all that have a direction, masks between paints not among them."""
    known = uses(root)
    return {
        address: node
        for address, node in walk(root)
        if isinstance(node, Leaf) and turns(node) and (node.role is not Role.MASK or _is_form(root, address, known))
    }


def _is_form(root: Node, mask: str, known: dict[str, Use]) -> bool:
    """Does a mask stand inside the form or a light, with no paint in the mix that it belongs to?"""
    mix = find(root, mask.removesuffix(".mask"))
    inside = known[mask].component is not Component.ALBEDO
    return inside and not any(isinstance(node, Leaf) and node.role is Role.PAINT for _, node in walk(mix))


def rebuild(root: Node, leaves: dict[str, Leaf]) -> Node:
    """The tree with other leaves at some addresses, in one pass."""

    def rebuilt(node: Node, address: str) -> Node:
        if isinstance(node, Leaf):
            return leaves.get(address, node)
        children = tuple(rebuilt(child, f"{address}.{k}.{child.kind}") for k, child in enumerate(node.children))
        return Operator(node.kind, children, leaves.get(f"{address}.mask", node.mask) if node.mask else None, node.name)

    return rebuilt(root, root.kind)


def turn(tree: Tree, rotation: np.ndarray, addresses: Iterable[str] | None = None) -> Tree:
    """The tree with its light turned by a (3, 3) rotation.

    Args:
        addresses: only these leaves, whatever they are; all that depend on the light where it is None.
    Raises:
        TreeError: one of the addresses is of a leaf without a direction.
    """
    leaves = lit_leaves(tree.root)
    if addresses is not None:
        leaves = {address: node for address in addresses if isinstance(node := find(tree.root, address), Leaf)}
        for address, leaf in leaves.items():
            if not turns(leaf):
                raise TreeError(f"{leaf.kind} has no direction, so it cannot be turned", address)
    return dataclasses.replace(tree, root=rebuild(tree.root, {where: turned_leaf(leaf, rotation) for where, leaf in leaves.items()}))


def relight(tree: Tree, right: float = 0.0, up: float = 0.0, roll: float = 0.0) -> Tree:
    """The tree with all of its light moved by degrees to the right, up, and counter-clockwise about the viewer.

    >>> from unshade.serde import parse
    >>> tree = relight(parse("multiply(albedo(red), diffuse(front))"), right=90)
    >>> [round(number, 9) for number in tree.find("diffuse")["direction"]]
    [1.0, 0.0, 0.0]
    """
    return turn(tree, turn_of(right, up, roll))


def main_light(root: Node) -> tuple[str, tuple[float, ...]] | None:
    """The address and direction of the light that shapes a tree most: its first form, else its first highlight, and so on."""
    known = uses(root)
    leaves = lit_leaves(root)
    for component in MAIN_LIGHT:
        for address, leaf in leaves.items():
            if known[address].component is component and leaf.role is not Role.MASK:
                for parameter in KINDS[leaf.kind].parameters:
                    if parameter.type == "direction":
                        return address, tuple(leaf[parameter.name][:3])
    return None


def turn_to(root: Node, direction: Sequence[float]) -> np.ndarray:
    """The shortest rotation after which `main_light` comes from a direction. Raises TreeError for a tree without a light."""
    found = main_light(root)
    if found is None:
        raise TreeError("this tree has no light with a direction to turn")
    return turn_between(found[1], direction)


def relight_to(tree: Tree, direction: Sequence[float]) -> Tree:
    """The tree with its light turned, the shortest way, until the main light comes from a direction. Raises TreeError."""
    return turn(tree, turn_to(tree.root, direction))
