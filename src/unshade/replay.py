"""Do to one tree what was done to another: the same edit on a tree of another structure.

What a leaf is, another tree may hold in another kind or in several leaves. So leaves are matched by what they do to the
picture (`effect`), one leaf with as many as it takes.
Changes are repeated relative to what the other tree holds: a direction is turned by as much, a sharpness multiplied, a
colour carried over with the scale between the two.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
import torch

from unshade.components import BLACK, WHITE, Use, uses
from unshade.edit import remove
from unshade.errors import TreeError
from unshade.nodes import KINDS, Leaf, Node, Operator, Parameter, Raster, Role, Tree, find, walk
from unshade.recolor import mean_color, moved_colors
from unshade.relight import rebuild, turn_between, turned_leaf
from unshade.render import render
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals

SIZE = 48
"""Pixels of the pictures that leaves are compared by."""

BETTER = 0.7
"""Another leaf is taken into a match where it leaves less than this share of the squared difference."""

ALIKE = 0.1
"""Colours this near, up to a scale, are the same colour; another colour takes the change of hue and lightness."""

MOST = 6
"""Most leaves that one leaf is matched with."""

RATIOS = ("sharpness", "amplitude", "brightness", "exponent", "radius", "width", "ambient")
"""Parameters that change by a factor; other numbers change by a difference."""


def _normals() -> torch.Tensor:
    """(3, 1, N) normals inside the scored disc."""
    inside = disc_mask(SIZE, SCORED_RADIUS)[0]
    return sphere_normals(SIZE, dtype=torch.float64)[:, inside][:, None, :]


def effect(root: Node, address: str, known: dict[str, Use]) -> torch.Tensor:
    """(3, N) what a leaf that is no mask does to the picture, inside the scored disc.

    Of paint, how much of its colour shows where: a tree is affine in every leaf, so that is white minus black in its place. Of
    form, what it adds to its mean, which is the same under a multiply and a screen; of a light, what it adds to the dark.
    """
    leaf, use = find(root, address), known[address]
    assert isinstance(leaf, Leaf)
    if leaf.role is Role.PAINT:
        with_leaf, without = WHITE, BLACK
    else:
        with_leaf, without = leaf, BLACK if use.top else Leaf("albedo", (mean_color(leaf),))
    normals = _normals()
    first, second = (render(rebuild(root, {address: other}), normals)[:, 0] for other in (with_leaf, without))
    return first - second


def match(root: Node, leaf: str, other: Node) -> list[str]:
    """The leaves of another tree that do in its picture what a leaf does in its own, the most alike first; none where none does."""
    known, theirs = uses(root), uses(other)
    of = find(root, leaf)
    assert isinstance(of, Leaf)
    candidates = [address for address, use in theirs.items() if _comparable(of, known[leaf], find(other, address), use)]
    if of.role is Role.MASK:
        return _masks(of, other, candidates)
    wanted = effect(root, leaf, known)
    effects = {address: effect(other, address, theirs) for address in candidates}
    chosen: list[str] = []
    while effects and len(chosen) < MOST:
        left = float(wanted.square().sum())
        errors = {address: float((wanted - own).square().sum()) for address, own in effects.items()}
        best = min(errors, key=errors.__getitem__)
        if errors[best] >= (BETTER if chosen else 1.0) * left:
            break
        chosen.append(best)
        wanted = wanted - effects.pop(best)
    return chosen


def _comparable(of: Leaf, use: Use, other: Node, theirs: Use) -> bool:
    """Can these two be the same? Paint is matched with paint, masks with masks, lights and form with any light or form."""
    assert isinstance(other, Leaf)
    if KINDS[of.kind].role is Role.PAINT:
        return KINDS[other.kind].role is Role.PAINT and use.tint == theirs.tint
    return other.role is not Role.PAINT and (of.role is Role.MASK) == (other.role is Role.MASK)


def _masks(of: Leaf, other: Node, candidates: Iterable[str]) -> list[str]:
    """The mask with the nearest picture, whichever of its sides is 1."""
    normals = sphere_normals(SIZE, dtype=torch.float64)
    inside = disc_mask(SIZE, SCORED_RADIUS)

    def errors(address: str) -> float:
        mask = find(other, address)
        assert isinstance(mask, Leaf)
        mine, theirs = (_mask_picture(leaf, normals) for leaf in (of, mask))
        return min(float((picture - mine)[inside].square().mean()) for picture in (theirs, 1.0 - theirs))

    found = sorted((errors(address), address) for address in candidates)
    return [found[0][1]] if found and found[0][0] < 0.15 else []


def _mask_picture(mask: Leaf, normals: torch.Tensor) -> torch.Tensor:
    return render(Operator("mix", (WHITE, BLACK), mask), normals)[:1]


def replay(before: Tree, after: Tree, onto: Tree) -> Tree:
    """The tree ``onto`` with the edit that made ``after`` of ``before``.

    The edit may change numbers of leaves and take leaves away. Raises TreeError where it does anything else, or where
    ``onto`` holds nothing that a changed leaf could be matched with.
    """
    changed, lost = _changes(before.root, after.root)
    root = onto.root
    done: dict[str, Leaf] = {}
    for address, (old, new) in changed.items():
        for place in _matched(before.root, address, root):
            leaf = done.get(place, find(root, place))
            assert isinstance(leaf, Leaf)
            done[place] = _changed_alike(leaf, old, new, find(before.root, address).kind == leaf.kind)
    doomed = [place for address in lost for place in _matched(before.root, address, root)]
    edited = dataclasses.replace(onto, root=rebuild(root, done))
    return remove(edited, *doomed) if doomed else edited


def _matched(root: Node, address: str, other: Node) -> list[str]:
    found = match(root, address, other)
    if not found:
        raise TreeError(f"the other tree has nothing like {address}")
    return found


def _changes(before: Node, after: Node) -> tuple[dict[str, tuple[Leaf, Leaf]], list[str]]:
    """Leaves with other numbers, and leaves that are gone, by their addresses before."""
    ours = {address: node for address, node in walk(before) if isinstance(node, Leaf)}
    theirs = [node for _, node in walk(after) if isinstance(node, Leaf)]
    kept = _kept(list(ours.values()), theirs)
    if kept is None:
        raise TreeError("an edit can be repeated where it changes numbers of leaves or takes leaves away, not where it adds leaves")
    addresses = [*ours]
    pairs = {addresses[number]: (ours[addresses[number]], leaf) for number, leaf in zip(kept, theirs, strict=True)}
    lost = [address for address in ours if address not in pairs]
    tints = uses(before)
    changed = {address: (old, new) for address, (old, new) in pairs.items() if old.values != new.values}
    return changed, [address for address in lost if not tints[address].tint] or lost


def _kept(ours: Sequence[Leaf], theirs: Sequence[Leaf]) -> tuple[int, ...] | None:
    """Which of our leaves became theirs: in the same order, of the same kinds, with the fewest changed parameters. None if none can."""
    # For each number of our first leaves, the fewest changes to what has been seen of theirs, and who became it.
    best: list[tuple[int, tuple[int, ...]] | None] = [(0, ())] * (len(ours) + 1)
    for leaf in theirs:
        row: list[tuple[int, tuple[int, ...]] | None] = [None]
        for number, own in enumerate(ours):
            found = [row[number]]
            if (so_far := best[number]) is not None and own.kind == leaf.kind:
                changes = sum(mine != other for mine, other in zip(own.values, leaf.values, strict=True))
                found.append((so_far[0] + changes, (*so_far[1], number)))
            row.append(min((one for one in found if one is not None), default=None))
        best = row
    return None if best[-1] is None else best[-1][1]


def _changed_alike(leaf: Leaf, old: Leaf, new: Leaf, same_kind: bool) -> Leaf:
    """A leaf with the change from ``old`` to ``new``, as far as it has the parameters that changed."""
    for parameter, before, after in zip(KINDS[old.kind].parameters, old.values, new.values, strict=True):
        own = next((entry for entry in KINDS[leaf.kind].parameters if entry.name == parameter.name), None)
        if before == after or isinstance(before, Raster) or isinstance(after, Raster):
            if same_kind and before != after:
                leaf = leaf.set(**{parameter.name: after})
            continue
        if parameter.type == "direction":
            leaf = turned_leaf(leaf, turn_between(before[:3], after[:3]))
        elif own is not None and own.type == parameter.type:
            leaf = leaf.set(**{own.name: _number_alike(own, leaf[own.name], before, after)})
    return leaf


def _number_alike(parameter: Parameter, value: tuple[float, ...], before: tuple[float, ...], after: tuple[float, ...]) -> np.ndarray:
    own, old, new = (np.asarray(numbers, dtype=float) for numbers in (value, before, after))
    if parameter.type == "color" and own.shape == old.shape:
        scale = float(own @ old) / max(float(old @ old), 1e-9)
        if np.abs(own - scale * old).max() > ALIKE:
            return np.concatenate(
                [moved_colors(own[k : k + 3], old[k : k + 3].tolist(), new[k : k + 3].tolist()) for k in range(0, len(own), 3)]
            )
        # The same colour up to a scale, which stays, and so does what is left of the difference.
        moved = scale * new + (own - scale * old)
    elif parameter.name in RATIOS and old.shape[0] == 1 and old[0] > 0.0:
        moved = own * (new[0] / old[0])
    else:
        moved = own + (new - old if own.shape == old.shape else float((new - old).mean()))
    return moved.clip(parameter.low, parameter.high)
