"""How a tree can lose a leaf, or give one another kind: what a search offers once a tree has grown."""

from __future__ import annotations

import dataclasses
import math

from unshade.moves import Anatomy, add_shade, complement, is_paint, plain_numbers
from unshade.nodes import KINDS, Leaf, Node, Operator, find, leaf, mix, multiply, replace, tint, walk


def removals(root: Node) -> list[Node]:
    """Every tree that has one light, form or paint less."""
    return [replace(root, address, kept) for address, kept in removable(root)]


def removable(root: Node) -> list[tuple[str, Node | None]]:
    """What `removals` takes out: an address, and what stands there instead, None for nothing."""
    parts = Anatomy.of(root)
    found: list[tuple[str, Node | None]] = []
    for address, node in walk(root):
        parent = address.rsplit(".", 2)
        if len(parent) == 3 and parent[2] != "mask" and parent[0].rpartition(".")[2] in ("screen", "multiply"):
            inside_pair = tint(find(root, parent[0])) is not None and parent[0] != parts.base
            if address != parts.base and not inside_pair and not (is_paint(node) and parent[0] == parts.base):
                found.append((address, None))
        if isinstance(node, Operator) and node.kind == "mix":
            found += [(address, child) for child in node.children]
        if isinstance(node, Leaf) and node.kind == "environment" and node.lobes > 1:
            found += [(address, _without_lobe(node, k)) for k in range(node.lobes)]
    return found


def _without_lobe(environment: Leaf, number: int) -> Leaf:
    """An environment with one light less."""
    sizes = [parameter.size for parameter in KINDS[environment.kind].parameters]
    kept = [value[: number * size] + value[(number + 1) * size :] for value, size in zip(plain_numbers(environment), sizes, strict=True)]
    return dataclasses.replace(environment, values=tuple(kept))


def swaps(root: Node) -> list[Node]:
    """Every tree in which one leaf has another kind, or a light has lost or found its colour."""
    found = []
    for address, node in walk(root):
        pair = tint(node)
        if pair and pair[1].kind == "rim":
            found.append(replace(root, address, pair[1]))
        scale = KINDS[pair[1].kind].amplitude if pair else None
        if pair and scale:
            grey = sum(pair[0]["color"]) / 3.0
            found.append(replace(root, address, pair[1].set(**{scale: min(grey, 1.0)})))
        found += _as_shade(root, address, node) + _as_stripe(root, address, node)
        if not isinstance(node, Leaf):
            continue
        for other in _relatives(node):
            found.append(replace(root, address, other))
        amplitude = KINDS[node.kind].amplitude
        parent = address.rsplit(".", 2)
        if amplitude and len(parent) == 3 and parent[0].rpartition(".")[2] == "screen":
            strength = min(node[amplitude][0], 1.0)
            found.append(replace(root, address, multiply(leaf("albedo", color=(strength,) * 3), node.set(**{amplitude: 1.0}))))
    return found


def paints_as_shades(root: Node) -> list[Node]:
    """Every tree in which a mix of paints has become two-tone shading."""
    return [found for address, node in walk(root) if node.kind == "mix" for found in _as_shade(root, address, node)]


def _as_shade(root: Node, address: str, node: Node) -> list[Node]:
    """What a soft mask or a spot does to the base, done by two-tone shading instead."""
    found = []
    if isinstance(node, Operator) and node.kind == "mix" and node.mask and is_paint(node):
        for mask in [node.mask] if node.mask.kind == "threshold" else _relatives(node.mask):
            bright, dark = sorted(node.children, key=lambda paint: -_brightness(paint))
            edge = mask if bright is node.children[0] else complement(mask) or mask
            softness = min(max(edge["softness"][0], 0.05), 4.0)
            ambient = min(_brightness(dark) / max(_brightness(bright), 1e-3), 1.0)
            found.append((replace(root, address, bright), edge["direction"], edge["threshold"][0] - 0.5 * softness, softness, ambient))
    elif isinstance(node, Leaf) and node.kind == "toon_highlight" and address.rsplit(".", 2)[0] in Anatomy.of(root).forms:
        start = math.cos(min(node["radius"][0], math.pi)) - 0.05
        for gone in (address, address.rsplit(".", 2)[0]):  # the spot alone, or with the form that it lies on
            found.append((replace(root, gone, None), node["direction"], start, 0.1, 0.5))
    shaded = []
    for kept, direction, start, softness, ambient in found:
        base = Anatomy.of(kept).base
        shade = leaf("toon_diffuse", direction=direction, ambient=ambient, threshold=min(max(start, -3.5), 1.0), softness=softness)
        shaded.append(replace(kept, base, add_shade(find(kept, base), shade)))
    return shaded


def _as_stripe(root: Node, address: str, node: Node) -> list[Node]:
    """Two parallel edges with the same paint outside them as one band."""
    if not (isinstance(node, Operator) and node.mask and node.mask.kind == "threshold"):
        return []
    found = []
    for outer, inner in enumerate(node.children):
        if not (isinstance(inner, Operator) and inner.mask and inner.mask.kind == "threshold" and is_paint(node.children[1 - outer])):
            continue
        direction = node.mask["direction"]
        along = sum(a * b for a, b in zip(direction, inner.mask["direction"], strict=True))
        if abs(along) < 0.9:
            continue
        for shown, paint in enumerate(inner.children):
            # where the inner child is seen, and where this child of it is, as bounds on n.l
            bounds = [
                (outer == 0, node.mask["threshold"][0]),
                ((shown == 0) == (along > 0), math.copysign(1.0, along) * inner.mask["threshold"][0]),
            ]
            low = [edge for above, edge in bounds if above]
            high = [edge for above, edge in bounds if not above]
            if len(low) == 1 and high[0] > low[0]:
                center, width = min(max(0.5 * (low[0] + high[0]), -1.0), 1.0), min(high[0] - low[0], 2.0)
                band = leaf("stripe", direction=direction, center=center, width=width, softness=node.mask["softness"][0])
                found.append(replace(root, address, mix(paint, inner.children[1 - shown], band)))
    return found


def _as_rims(environment: Leaf) -> list[Leaf]:
    """What lights of an environment that show at the silhouette look like: a rim on their side."""
    directions = environment["direction"]
    sides = [directions[3 * k : 3 * k + 2] for k in range(environment.lobes)]
    return [leaf("rim", direction=(x, y, 0.2), exponent=1.0) for x, y in sides if math.hypot(x, y) > 0.1]


def _brightness(paint: Node) -> float:
    """Mean of the channels of a paint's colours."""
    colors = [node["color"] for _, node in walk(paint) if isinstance(node, Leaf) and node.kind == "albedo"]
    return sum(sum(color) for color in colors) / max(3 * len(colors), 1)


def _relatives(node: Leaf) -> list[Leaf]:
    """The same light, form or mask as the kinds next to it."""
    direction: tuple[float, ...] = () if node.kind in ("albedo", "image", "image_mask", "environment_map") else node["direction"]
    match node.kind:
        case "highlight":
            sharpness, amplitude = node["sharpness"][0], node["amplitude"][0]
            radius = min(1.2 / math.sqrt(sharpness), 1.5)
            return [
                leaf("toon_highlight", direction=direction, radius=radius, brightness=min(0.65 * amplitude, 1.0), softness=0.3 * radius)
            ]
        case "toon_highlight":
            sharpness = min(max(0.7 / max(node["radius"][0], 0.01) ** 2, 0.1), 2000.0)
            return [leaf("highlight", direction=direction, sharpness=sharpness, amplitude=node["brightness"][0])]
        case "diffuse":
            return [leaf("toon_diffuse", direction=direction, ambient=node["ambient"][0], threshold=-0.2, softness=1.3)]
        case "toon_diffuse":
            return [leaf("diffuse", direction=direction, ambient=node["ambient"][0])]
        case "stripe":
            low, high = (node["center"][0] + side * 0.5 * node["width"][0] for side in (-1.0, 1.0))
            softness = node["softness"][0]
            return [
                leaf("threshold", direction=direction, threshold=low, softness=softness),
                leaf("threshold", direction=[-part for part in direction], threshold=-high, softness=softness),
            ]
        case "threshold":
            edge = node["threshold"][0]
            if abs(edge) >= 0.9:
                return []
            return [leaf("stripe", direction=direction, center=min(edge + 0.5, 1.0), width=1.0, softness=node["softness"][0])]
        case "environment":
            return _as_rims(node)
        case _:
            return []
