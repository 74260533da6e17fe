"""What is measured of an answer: how near it looks, how large it is, and whether it means the right thing."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch

from unshade import metrics
from unshade.bench.datasets import Subject
from unshade.grammar import same_structure
from unshade.nodes import KINDS, Leaf, Node, Role, Tree, Value
from unshade.render import part, render
from unshade.sphere import sphere_normals
from unshade.types import Image, Mask

EXACT = 50.0
"""dB between an answer and the true tree from which an answer that is no larger counts as right."""

CEILING = 100.0

Row = dict[str, Any]


def measure(subject: Subject, tree: Tree, perceptual: bool) -> Row:
    """Every figure of one answer but its time."""
    image, scored = subject.sphere.image, subject.scored
    normals = sphere_normals(subject.sphere.size)
    found = render(tree, normals)
    row: Row = {
        "psnr": decibels(image, found, scored),
        "psnr_frame": min(metrics.psnr_full_frame(image, found, scored), CEILING),
        "ssim": metrics.ssim(image, found, scored),
        "st_lpips": metrics.st_lpips(image, found, mask=scored) if perceptual else None,
        "values": tree.values,
        "leaves": tree.leaves,
    }
    if subject.diffuse is not None:
        diffuse = render(Tree(part(tree.root, "diffuse"), tree.blend_space), normals)
        row["diffuse_psnr"] = decibels(subject.diffuse, diffuse, scored)
        row["diffuse_gain"] = row["diffuse_psnr"] - decibels(subject.diffuse, image, scored)
    if subject.truth is not None:
        row |= compare_trees(tree, subject.truth, scored)
    return row


def decibels(a: Image, b: Image, mask: Mask) -> float:
    """`metrics.psnr`, 100 at most: JSON has no infinity."""
    return min(metrics.psnr(a, b, mask), CEILING)


def compare_trees(found: Tree, truth: Tree, scored: Mask) -> Row:
    """Is the structure right, and how far are lights and colours of the leaves that match?"""
    normals = sphere_normals(scored.shape[-1])
    apart = decibels(render(found, normals), render(truth, normals), scored)
    exact = bool(same_structure(found, truth))
    lights = _matched_lights(_lights(found.root), _lights(truth.root))
    paints = _nearest(_paints(found.root), _paints(truth.root), metrics.ciede2000)
    colors = [metrics.ciede2000(a[1], b[1]) for _, a, b in lights] + [cost for cost, _, _ in paints]
    return {
        "structure_exact": exact,
        "structure_right": exact or (found.values <= truth.values and apart >= EXACT),
        "has_environment": any(isinstance(node, Leaf) and node.role is Role.ENVIRONMENT for _, node in truth.walk()),
        "truth_values": truth.values,
        "truth_psnr": apart,
        "light_degrees": _mean([cost for cost, _, _ in lights]),
        "color_ciede2000": _mean(colors),
    }


def _mean(numbers: Sequence[float]) -> float | None:
    return sum(numbers) / len(numbers) if numbers else None


Color = tuple[float, ...]
Light = tuple[tuple[float, ...], Color, str]
"""Direction, colour, and the group of kinds that it can match."""

_GROUPS = {Role.DIFFUSE: "form", Role.HIGHLIGHT: "light", Role.RIM: "rim"}


def _lights(root: Node, tint: Color = (1.0, 1.0, 1.0)) -> list[Light]:
    """Leaves with one direction; their colour is that of the albedos beside them and their amplitude, form has none."""
    if isinstance(root, Leaf):
        group = _GROUPS.get(KINDS[root.kind].role)
        if group is None or "direction" not in (parameter.name for parameter in KINDS[root.kind].parameters):
            return []
        amplitude = KINDS[root.kind].amplitude
        strength = min(_numbers(root[amplitude])[0], 1.0) if amplitude else 1.0
        color = (1.0, 1.0, 1.0) if group == "form" else tuple(channel * strength for channel in tint)
        return [(_numbers(root["direction"]), color, group)]
    beside = (1.0, 1.0, 1.0) if root.kind != "multiply" else _product(child for child in root.children if _is_paint(child))
    return [light for child in root.children for light in _lights(child, beside)]


def _paints(root: Node, lit: bool = False) -> list[Color]:
    """Colours of the albedos that do not tint a light alone."""
    if isinstance(root, Leaf):
        return [] if lit or not _is_paint(root) else [_numbers(root["color"])]
    tints = root.kind == "multiply" and any(
        isinstance(child, Leaf) and KINDS[child.kind].role in (Role.HIGHLIGHT, Role.RIM) for child in root.children
    )
    return [color for child in root.children for color in _paints(child, tints)]


def _is_paint(node: Node) -> bool:
    return isinstance(node, Leaf) and node.kind == "albedo"


def _product(albedos: Any) -> Color:
    product = (1.0, 1.0, 1.0)
    for albedo in albedos:
        product = tuple(a * b for a, b in zip(product, _numbers(albedo["color"]), strict=True))  # type: ignore[assignment]
    return product


def _numbers(value: Value) -> tuple[float, ...]:
    assert isinstance(value, tuple)
    return value


def _degrees(a: Sequence[float], b: Sequence[float]) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, sum(x * y for x, y in zip(a, b, strict=True))))))


def _matched_lights(found: list[Light], truth: list[Light]) -> list[tuple[float, Light, Light]]:
    return [
        match
        for group in _GROUPS.values()
        for match in _nearest(
            [light for light in found if light[2] == group],
            [light for light in truth if light[2] == group],
            lambda a, b: _degrees(a[0], b[0]),
        )
    ]


def _nearest(found: list[Any], truth: list[Any], cost: Any) -> list[tuple[float, Any, Any]]:
    """(cost, found, true) one to one, the nearest pair first."""
    costs = sorted((cost(a, b), i, j) for (i, a), (j, b) in itertools.product(enumerate(found), enumerate(truth)))
    matches, left, right = [], set(range(len(found))), set(range(len(truth)))
    for price, i, j in costs:
        if i in left and j in right:
            matches.append((price, found[i], truth[j]))
            left.remove(i)
            right.remove(j)
    return matches


def quantile(numbers: Sequence[float], share: float) -> float:
    """Linear interpolation between order statistics."""
    return float(torch.tensor(list(numbers), dtype=torch.float64).quantile(share))
