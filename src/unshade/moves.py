"""How a tree can grow by one leaf: every place times every entry of the dictionary, with the gain each would bring.

With the rest of the tree fixed, a node's value X enters the picture as ``a + A X``. Putting a leaf beside it gives

- light:  ``screen(X, c h)``          changes the picture by ``A (1 - X) h c``,
- paint:  ``mix(X, albedo(c), 1 - m)`` by ``A m (c - X)``,
- shade:  ``multiply(X, k + (1 - k) d)`` by ``A X (d - 1) (1 - k)``,

each linear in one colour or strength, so the best one and what it saves are closed forms for all entries at once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass

import torch

from unshade.atoms import Atoms, Dictionary
from unshade.fit.model import Model
from unshade.nodes import KINDS, Leaf, Node, Operator, Role, count_values, find, leaf, mix, multiply, replace, screen, tint, walk


@dataclass(frozen=True)
class Move:
    """A grown tree, how much squared error it should save before any refitting, and what it costs."""

    root: Node
    family: str
    where: str
    gain: float
    cost: int
    relative: float
    """log(error before / error after) a stored value."""


@dataclass(frozen=True)
class _Place:
    address: str
    node: Node
    value: torch.Tensor
    gain: torch.Tensor


def add_light(node: Node, light: Node) -> Node:
    """``screen(node, light)``, flat."""
    if isinstance(node, Operator) and node.kind == "screen":
        return dataclasses.replace(node, children=(*node.children, light))
    return screen(node, light)


def add_shade(node: Node, shade: Node) -> Node:
    """``multiply(node, shade)``, flat, but a tint stays a pair."""
    pair = tint(node)
    if isinstance(node, Operator) and node.kind == "multiply" and (pair is None or KINDS[pair[1].kind].role is Role.DIFFUSE):
        return dataclasses.replace(node, children=(*node.children, shade))
    return multiply(node, shade)


def recolored(base: Node, scale: list[float]) -> Node:
    """The base with its paints scaled a channel, inside their range."""
    for address, node in walk(base):
        if isinstance(node, Leaf) and node.kind == "albedo":
            base = replace(base, address, node.set(color=[min(max(c * s, 0.0), 1.0) for c, s in zip(node["color"], scale, strict=True)]))
    return base


def is_paint(node: Node) -> bool:
    """An albedo, or albedos mixed by masks."""
    if isinstance(node, Leaf):
        return node.kind == "albedo"
    return node.kind == "mix" and all(is_paint(child) for child in node.children)


@dataclass(frozen=True)
class Anatomy:
    """Where the parts of a tree are that the search grows: ``mix(edge, screen(multiply(paint, form...), lights...))``.

    Growing only here keeps a tree readable: colour and form stand in the base, lights are screened on top of it, and only
    drawn edges lie over the whole.
    """

    canvas: str
    """What lights are screened onto."""
    base: str
    """Paint times form."""
    paints: tuple[str, ...]
    """The albedos of the base."""
    forms: tuple[str, ...]
    """The grey factors of the base."""
    edges: int
    """Paints that lie over the whole."""

    @staticmethod
    def of(root: Node) -> Anatomy:
        """Find the parts of a tree; any tree has a canvas and a base, perhaps the root itself."""
        address, node, edges = root.kind, root, 0
        while isinstance(node, Operator) and node.kind == "mix" and not is_paint(node) and is_paint(node.children[0]):
            edges += 1
            address, node = f"{address}.1.{node.children[1].kind}", node.children[1]
        canvas = address
        if isinstance(node, Operator) and node.kind == "screen":
            address, node = f"{address}.0.{node.children[0].kind}", node.children[0]
        base = address
        factors = [(address, node)]
        if isinstance(node, Operator) and node.kind == "multiply":
            factors = [(f"{address}.{k}.{child.kind}", child) for k, child in enumerate(node.children)]
        paints = tuple(
            f"{where}{below[len(part.kind) :]}"
            for where, part in factors
            if is_paint(part)
            for below, leaf in walk(part)
            if leaf.kind == "albedo"
        )
        forms = tuple(where for where, part in factors if not is_paint(part)) if len(factors) > 1 else ()
        return Anatomy(canvas, base, paints, forms, edges)


def complement(mask: Leaf) -> Leaf | None:
    """The threshold mask that is 1 where this one is 0."""
    if mask.kind != "threshold":
        return None
    return mask.set(direction=[-x for x in mask["direction"]], threshold=-mask["threshold"][0])


class Proposer:
    """Scores the dictionary against a fitted tree."""

    def __init__(self, dictionary: Dictionary, target: torch.Tensor, weight: torch.Tensor) -> None:
        self.dictionary, self.target, self.weight = dictionary, target, weight

    def propose(self, model: Model, vector: torch.Tensor, families: Collection[str], best: int) -> list[Move]:
        """The most promising moves, best first, at most two of one family at one place."""
        root = model.layout.unpack(model.root, vector)
        values = model.evaluate(vector)
        residual = self.target - model.compose(values)
        self.error = float((residual.square() * self.weight).sum()) / 3.0
        self.size = count_values(root)
        count = residual.shape[1]
        known = {
            address: _Place(address, node, value.expand(3, count), torch.as_tensor(gain, dtype=residual.dtype).expand(3, count))
            for address, node, value, gain in model.nodes(values)
        }
        parts = Anatomy.of(root)
        found: list[Move] = []
        for family in families:
            if family.endswith(("lights", "rims", "spots", "environments")):
                found += self._lights(root, known[parts.canvas], residual, family, grey_only=family.startswith("plain"))
                if family in ("lights", "spots"):
                    for where in parts.forms[:1]:
                        found += self._lights(root, known[where], residual, family, grey_only=True)
            elif family in ("masks", "plain_masks"):
                for where in dict.fromkeys(((root.kind,) if family == "masks" and parts.edges < 2 else ()) + parts.paints):
                    found += self._paints(root, known[where], residual, family)
            else:
                found += self._shades(root, known[parts.base], residual, family)
        found.sort(key=lambda move: -move.relative)
        taken: dict[tuple[str, str], int] = {}
        chosen = []
        for move in found:
            key = (move.family, move.where)
            if taken.get(key, 0) < 2:
                taken[key] = taken.get(key, 0) + 1
                chosen.append(move)
        return chosen[:best]

    def _best(self, atoms: Atoms, score: torch.Tensor, how_many: int) -> list[int]:
        return torch.topk(score, min(how_many, len(atoms.leaves))).indices.tolist()

    def _lights(self, root: Node, place: _Place, residual: torch.Tensor, family: str, grey_only: bool) -> list[Move]:
        atoms = self.dictionary[family]
        basis = place.gain * (1.0 - place.value)
        up = (self.weight * basis * residual) @ atoms.pictures.T  # (3, M)
        down = (self.weight * basis.square()) @ atoms.squares.T
        moves = []
        color = (up / down.clamp(min=1e-12)).clamp(0.0, 1.0)
        saved = (2.0 * color * up - color.square() * down).sum(0) / 3.0
        grey = torch.where(atoms.scalable, (up.sum(0) / down.sum(0).clamp(min=1e-12)).clamp(0.0, 1.0), torch.ones(()))
        saved_grey = (2.0 * grey * up.sum(0) - grey.square() * down.sum(0)) / 3.0
        if not grey_only:
            for k in self._best(atoms, saved, 2):
                shade = tuple(color[:, k].tolist())
                entry = atoms.leaves[k]
                light = entry.set(color=shade) if family == "environments" else multiply(leaf("albedo", color=shade), entry)
                moves.append(self._move(root, place, add_light(place.node, light), f"tinted {family}", float(saved[k])))
        if family != "environments":
            for k in self._best(atoms, saved_grey, 2):
                entry = atoms.leaves[k]
                amplitude = KINDS[entry.kind].amplitude
                light = entry.set(**{amplitude: float(grey[k])}) if amplitude else entry
                moves.append(self._move(root, place, add_light(place.node, light), f"grey {family}", float(saved_grey[k])))
        return moves

    def _paints(self, root: Node, place: _Place, residual: torch.Tensor, family: str) -> list[Move]:
        atoms = self.dictionary[family]
        # the picture changes by A m (c - X): least squares in c of (residual + A m X) - A m c
        gain, value = place.gain, place.value
        straight = torch.cat([self.weight * gain * residual, self.weight * gain * residual * value]) @ atoms.pictures.T
        square = self.weight * gain.square()
        squared = torch.cat([square, square * value, square * value.square()]) @ atoms.squares.T
        squares_gain = squared[:3]
        cross = straight[:3] + squared[3:6]
        color = (cross / squares_gain.clamp(min=1e-12)).clamp(0.0, 1.0)
        constant = 2.0 * straight[3:] + squared[6:]
        saved = (2.0 * color * cross - color.square() * squares_gain - constant).sum(0) / 3.0
        moves = []
        for k in self._best(atoms, saved, 3):
            paint = leaf("albedo", color=tuple(color[:, k].tolist()))
            moves.append(self._move(root, place, mix(paint, place.node, atoms.leaves[k]), family, float(saved[k])))
        return moves

    def _shades(self, root: Node, place: _Place, residual: torch.Tensor, family: str) -> list[Move]:
        """Shade the base and let its colours change with it: least squares in the lit and the unlit brightness."""
        atoms = self.dictionary[family]
        base = place.gain * place.value
        wanted = residual + base
        straight = (self.weight * base * wanted) @ atoms.pictures.T
        flat = (self.weight * base * wanted).sum(1, keepdim=True)
        square = self.weight * base.square()
        b_one, b_two, b_none = square @ atoms.pictures.T, square @ atoms.squares.T, square.sum(1, keepdim=True)
        determinant = (b_none * b_two - b_one.square()).clamp(min=1e-12)
        dark = ((b_two * flat - b_one * straight) / determinant).clamp(min=0.0)
        lit = ((straight - b_one * dark) / b_two.clamp(min=1e-12)).clamp(min=0.0)
        # one ambient for all channels, then the best brightness of each
        ambient = (dark.sum(0) / (dark + lit).sum(0).clamp(min=1e-9)).clamp(0.0, 1.0)
        top = ambient * flat + (1.0 - ambient) * straight
        bottom = ambient.square() * b_none + 2.0 * ambient * (1.0 - ambient) * b_one + (1.0 - ambient).square() * b_two
        scale = top / bottom.clamp(min=1e-12)
        now = (self.weight * residual.square()).sum(1, keepdim=True)
        after = (self.weight * wanted.square()).sum(1, keepdim=True) - scale * top
        saved = (now - after).sum(0) / 3.0
        moves = []
        for k in self._best(atoms, saved, 3):
            shaded = add_shade(recolored(place.node, scale[:, k].tolist()), atoms.leaves[k].set(ambient=float(ambient[k])))
            moves.append(self._move(root, place, shaded, family, float(saved[k])))
        return moves

    def _move(self, root: Node, place: _Place, node: Node, family: str, gain: float) -> Move:
        grown = replace(root, place.address, node)
        cost = count_values(grown) - self.size
        after = max(self.error - gain, 1e-3 * self.error, 1e-12)
        relative = math.log(max(self.error, 1e-12) / after) / max(cost, 1)
        return Move(grown, family, place.address, gain, cost, relative)


def removals(root: Node) -> list[Node]:
    """Every tree that has one light, form or paint less."""
    parts = Anatomy.of(root)
    found = []
    for address, node in walk(root):
        parent = address.rsplit(".", 2)
        if len(parent) == 3 and parent[2] != "mask" and parent[0].rpartition(".")[2] in ("screen", "multiply"):
            inside_pair = tint(find(root, parent[0])) is not None and parent[0] != parts.base
            if address != parts.base and not inside_pair and not (is_paint(node) and parent[0] == parts.base):
                found.append(replace(root, address, None))
        if isinstance(node, Operator) and node.kind == "mix":
            found += [replace(root, address, child) for child in node.children]
    return found


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
        case _:
            return []
