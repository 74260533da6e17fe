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
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, Role, count_values, find, leaf, mix, multiply, replace, screen, tint, walk

GREY = ("plain_lights", "plain_spots", "plain_rims")
"""Families whose lights have no colour of their own."""


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


def _environment_at(root: Node, canvas: str) -> str | None:
    """The address of the environment that is screened onto the canvas."""
    node = find(root, canvas)
    below = enumerate(node.children) if isinstance(node, Operator) and node.kind == "screen" else ()
    return next((f"{canvas}.{k}.{child.kind}" for k, child in below if child.kind == "environment"), None)


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
            environment = _environment_at(root, parts.canvas) if family.endswith("environments") else None
            if environment:
                found += self._lobes(root, known[environment], residual, family)
            elif family.endswith(("lights", "rims", "spots", "environments")):
                forms = parts.forms[:1] if family in ("lights", "spots") else ()
                found += self._lights(root, [known[where] for where in (parts.canvas, *forms)], residual, family)
            elif family in ("masks", "plain_masks"):
                whole = (root.kind,) if family == "masks" and parts.edges < 2 else ()
                found += self._paints(root, [known[where] for where in dict.fromkeys(whole + parts.paints)], residual, family)
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

    def _lights(self, root: Node, places: list[_Place], residual: torch.Tensor, family: str) -> list[Move]:
        """Lights on the canvas, the first of the places, and grey ones on the others."""
        atoms = self.dictionary[family]
        basis = torch.stack([place.gain * (1.0 - place.value) for place in places])
        moves = []
        for number, (place, up, down) in enumerate(zip(places, *atoms.project(basis, residual, self.weight), strict=True)):
            if number == 0 and family not in GREY:
                color = (up / down.clamp(min=1e-12)).clamp(0.0, 1.0)
                saved = (2.0 * color * up - color.square() * down).sum(0) / 3.0
                for k in self._best(atoms, saved, 2):
                    shade = tuple(color[:, k].tolist())
                    entry = atoms.leaves[k]
                    light = entry.set(color=shade) if entry.kind == "environment" else multiply(leaf("albedo", color=shade), entry)
                    moves.append(self._move(root, place, add_light(place.node, light), f"tinted {family}", float(saved[k])))
            if not family.endswith("environments"):
                up, down = up.sum(0), down.sum(0)
                grey = torch.where(atoms.scalable, (up / down.clamp(min=1e-12)).clamp(0.0, 1.0), torch.ones(()))
                saved = (2.0 * grey * up - grey.square() * down) / 3.0
                for k in self._best(atoms, saved, 2):
                    entry = atoms.leaves[k]
                    amplitude = KINDS[entry.kind].amplitude
                    light = entry.set(**{amplitude: float(grey[k])}) if amplitude else entry
                    moves.append(self._move(root, place, add_light(place.node, light), f"grey {family}", float(saved[k])))
        return moves

    def _lobes(self, root: Node, place: _Place, residual: torch.Tensor, family: str) -> list[Move]:
        """One light more in the environment that the tree has."""
        atoms = self.dictionary[family]
        up, down = atoms.project(place.gain, residual, self.weight)
        color = (up / down.clamp(min=1e-12)).clamp(0.0, 1.0)
        saved = (2.0 * color * up - color.square() * down).sum(0) / 3.0
        assert isinstance(place.node, Leaf)
        moves = []
        for k in self._best(atoms, saved, 2):
            lobe = atoms.leaves[k].set(color=tuple(color[:, k].tolist()))
            joined = tuple(own + more for own, more in zip(plain_numbers(place.node), plain_numbers(lobe), strict=True))
            moves.append(self._move(root, place, dataclasses.replace(place.node, values=joined), family, float(saved[k])))
        return moves

    def _paints(self, root: Node, places: list[_Place], residual: torch.Tensor, family: str) -> list[Move]:
        """Another colour where a mask is 1."""
        if not places:
            return []
        atoms = self.dictionary[family]
        # the picture changes by A m (c - X): least squares in c of (residual + A m X) - A m c
        gain = torch.stack([place.gain for place in places])
        value = torch.stack([place.value for place in places])
        pulled, square = self.weight * gain * residual, self.weight * gain.square()
        straight = torch.cat([pulled, pulled * value], 1) @ atoms.pictures.T
        squared = torch.cat([square, square * value, square * value.square()], 1) @ atoms.squares.T
        squares_gain = squared[:, :3]
        cross = straight[:, :3] + squared[:, 3:6]
        colors = (cross / squares_gain.clamp(min=1e-12)).clamp(0.0, 1.0)
        constant = 2.0 * straight[:, 3:] + squared[:, 6:]
        saved_at = (2.0 * colors * cross - colors.square() * squares_gain - constant).sum(1) / 3.0
        moves = []
        for place, color, saved in zip(places, colors, saved_at, strict=True):
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


def plain_numbers(leaf: Leaf) -> list[tuple[float, ...]]:
    """The values of a leaf without rasters."""
    return [value for value in leaf.values if not isinstance(value, Raster)]
