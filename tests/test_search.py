"""The dictionary, the moves and the search: what a move promises is what it brings, and every grown or pruned tree is a tree."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings

import strategies
from unshade.atoms import FAMILIES, Dictionary, directions
from unshade.beam import Seen
from unshade.changes import removals, swaps
from unshade.fit.least_squares import error_of, fit_pixels
from unshade.fit.model import Model
from unshade.fit.pixels import Pixels
from unshade.grammar import validate
from unshade.growth import Candidate, Effort, Front, Samples
from unshade.moves import Anatomy, Move, Proposer, add_light, add_shade, complement, is_paint, recolored
from unshade.nodes import Leaf, Node, count_values, find, leaf, mix, multiply, screen, walk
from unshade.render import render
from unshade.search_reflecting import ReflectingSearch
from unshade.sphere import sphere_normals
from unshade.tree_size import MAX_NODES

A, B, C = (leaf("albedo", color=color) for color in ((0.5, 0.3, 0.2), (0.15, 0.25, 0.5), (0.3, 0.6, 0.3)))
WHITE, BLACK = leaf("albedo", color=(1.0, 1.0, 1.0)), leaf("albedo", color=(0.0, 0.0, 0.0))
FORM = leaf("diffuse", direction=(-0.3, 0.6, 0.7), ambient=0.4)
TOON = leaf("toon_diffuse", direction=(0.5, 0.6, 0.3), ambient=0.5, threshold=0.1, softness=0.2)
LIGHT = leaf("highlight", direction=(0.3, 0.5, 0.8), sharpness=40.0, amplitude=0.6)
SPOT = leaf("toon_highlight", direction=(-0.4, 0.3, 0.8), radius=0.2, brightness=0.5, softness=0.1)
HALF = leaf("threshold", direction=(0.8, 0.1, 0.5), threshold=0.1, softness=0.1)
BAND = leaf("stripe", direction=(0.1, 0.9, 0.2), center=0.1, width=0.4, softness=0.1)
RIM = leaf("rim", direction=(-0.8, 0.4, 0.2), exponent=2.0)
TINTED = multiply(C, leaf("highlight", direction=(0.1, 0.8, 0.5), sharpness=15.0, amplitude=1.0))


def small_pixels(root: Node, size: int = 32) -> Pixels:
    return Pixels.of(render(root, sphere_normals(size, dtype=torch.float64)))


def leaf_count(root: Node) -> int:
    """Leaves, every light of an environment by itself."""
    return sum(node.lobes for _, node in walk(root) if isinstance(node, Leaf))


def kinds(root: Node) -> list[str]:
    return sorted(node.kind for _, node in walk(root))


# The dictionary


def test_directions_are_spread_evenly() -> None:
    found = directions(200, -0.5)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(200, dtype=torch.float64))
    assert found[:, 2].min() > -0.5
    nearest = (found @ found.T - 2.0 * torch.eye(200, dtype=torch.float64)).amax(1).acos()
    assert nearest.min() > 0.5 * nearest.max()
    assert abs(float(found[:, 2].mean()) - 0.25) < 0.01, "the mean height of the cap z > -0.5"


@pytest.mark.parametrize("family", FAMILIES)
def test_atoms_are_the_renders_of_their_leaves(family: str) -> None:
    normals = small_pixels(A, 12).normals
    atoms = Dictionary(normals)[family]
    assert len(atoms.leaves) == len(set(atoms.leaves)) == len(atoms.pictures)
    for k in range(0, len(atoms.leaves), max(len(atoms.leaves) // 7, 1)):
        entry = atoms.leaves[k]
        expected = render(
            mix(leaf("albedo", color=(1, 1, 1)), leaf("albedo", color=(0, 0, 0)), entry) if "mask" in family else entry, normals[:, None]
        )
        torch.testing.assert_close(atoms.pictures[k], expected[0, 0])
    torch.testing.assert_close(atoms.squares, atoms.pictures.square())
    assert atoms.scalable.tolist() == [entry.kind in ("highlight", "toon_highlight") for entry in atoms.leaves]


# The moves

GROWING = {
    "one colour": A,
    "flat": multiply(A, FORM),
    "lit": screen(multiply(A, FORM), LIGHT),
    "painted": screen(multiply(mix(A, B, HALF), FORM), TINTED),
    "edged": mix(B, screen(multiply(A, FORM), LIGHT), BAND),
}
TARGET = screen(multiply(mix(A, C, BAND), FORM, TOON), LIGHT, SPOT, TINTED, RIM)


def proposed(root: Node, families: tuple[str, ...], best: int = 100) -> tuple[Pixels, list[Move]]:
    pixels = small_pixels(TARGET)
    model = Model(root, pixels)
    proposer = Proposer(Dictionary(pixels.normals), pixels.target, pixels.weight)
    return pixels, proposer.propose(model, model.layout.pack(root), families, best)


@pytest.mark.parametrize("start", GROWING)
@pytest.mark.parametrize("family", ["lights", "spots", "rims", "environments", "masks", "plain_lights", "plain_masks", "plain_rims"])
def test_a_move_brings_what_it_promises(start: str, family: str) -> None:
    root = GROWING[start]
    pixels, moves = proposed(root, (family,))
    assert moves
    before = error_of(pixels, root)
    for move in moves:
        assert before - error_of(pixels, move.root) == pytest.approx(move.gain, rel=1e-6, abs=1e-12), (move.family, move.where)
        assert move.cost == count_values(move.root) - count_values(root) > 0
        assert leaf_count(move.root) > leaf_count(root)
    assert max(move.gain for move in moves) > 0.0
    assert [move.relative for move in moves] == sorted((move.relative for move in moves), reverse=True)
    places = [(move.family, move.where) for move in moves]
    assert max(places.count(place) for place in places) <= 2
    assert [move.root for move in moves[:2]] == [move.root for move in proposed(root, (family,), 2)[1]]


@pytest.mark.parametrize("start", ["one colour", "flat", "lit"])
@pytest.mark.parametrize("family", ["shades", "plain_shades"])
def test_a_shade_brings_what_it_promises(start: str, family: str) -> None:
    """Shading recolours the base, so the promise holds where no colour would have to leave its range."""
    root = GROWING[start]
    pixels, moves = proposed(root, (family,))
    before = error_of(pixels, root)
    kept = 0
    for move in moves:
        colors = [node["color"] for _, node in walk(move.root) if isinstance(node, Leaf) and node.kind == "albedo"]
        if max(max(color) for color in colors) < 1.0:
            kept += 1
            assert before - error_of(pixels, move.root) == pytest.approx(move.gain, rel=1e-6, abs=1e-12)
    assert kept > 0


def test_a_tree_without_paint_is_given_none_where_none_can_be() -> None:
    assert proposed(FORM, ("plain_masks",))[1] == []
    moves = proposed(mix(B, mix(C, FORM, BAND), HALF), ("masks", "lights"))[1]
    assert moves and not any(move.family == "masks" for move in moves), "two drawn edges lie over the whole already"


def test_the_missing_leaf_is_proposed_first() -> None:
    true = screen(multiply(A, FORM), leaf("highlight", direction=(0.3, 0.5, 0.8), sharpness=35.0, amplitude=0.6))
    pixels = small_pixels(true)
    model = Model(multiply(A, FORM), pixels)
    proposer = Proposer(Dictionary(pixels.normals), pixels.target, pixels.weight)
    first = proposer.propose(model, model.layout.pack(model.root), ("lights", "masks", "shades", "environments"), 1)[0]
    assert first.family == "grey lights"
    assert first.where == "multiply"
    found = find(first.root, "screen.1")
    assert sum(a * b for a, b in zip(found["direction"], find(true, "screen.1")["direction"], strict=True)) > 0.98
    assert fit_pixels(pixels, first.root).error < 1e-9


def test_leaves_are_added_flat() -> None:
    assert add_light(screen(A, LIGHT), SPOT) == screen(A, LIGHT, SPOT)
    assert add_light(multiply(A, FORM), SPOT) == screen(multiply(A, FORM), SPOT)
    assert add_shade(A, FORM) == multiply(A, FORM)
    assert add_shade(multiply(A, FORM), TOON) == multiply(A, FORM, TOON)
    assert add_shade(TINTED, FORM) == multiply(TINTED, FORM), "a tint stays a pair"


def test_recoloring_stays_in_range() -> None:
    assert recolored(multiply(mix(A, B, HALF), FORM), [2.0, 4.0, 0.5]) == multiply(
        mix(leaf("albedo", color=(1.0, 1.0, 0.1)), leaf("albedo", color=(0.3, 1.0, 0.25)), HALF), FORM
    )


def test_a_complement_is_one_minus_the_mask() -> None:
    normals = sphere_normals(32)
    turned = complement(HALF)
    assert turned is not None
    torch.testing.assert_close(render(mix(WHITE, BLACK, HALF), normals), render(mix(BLACK, WHITE, turned), normals))
    assert complement(BAND) is None


# Anatomy

ANATOMIES = {
    "colour": (A, Anatomy("albedo", "albedo", ("albedo",), (), 0)),
    "shaded": (
        multiply(A, FORM, TOON),
        Anatomy("multiply", "multiply", ("multiply.0.albedo",), ("multiply.1.diffuse", "multiply.2.toon_diffuse"), 0),
    ),
    "painted": (
        screen(multiply(mix(A, mix(B, C, BAND), HALF), FORM), LIGHT),
        Anatomy(
            "screen",
            "screen.0.multiply",
            (
                "screen.0.multiply.0.mix.0.albedo",
                "screen.0.multiply.0.mix.1.mix.0.albedo",
                "screen.0.multiply.0.mix.1.mix.1.albedo",
            ),
            ("screen.0.multiply.1.diffuse",),
            0,
        ),
    ),
    "only paint": (mix(A, B, HALF), Anatomy("mix", "mix", ("mix.0.albedo", "mix.1.albedo"), (), 0)),
    "two edges": (
        mix(A, mix(B, screen(multiply(C, FORM), LIGHT), BAND), HALF),
        Anatomy(
            "mix.1.mix.1.screen",
            "mix.1.mix.1.screen.0.multiply",
            ("mix.1.mix.1.screen.0.multiply.0.albedo",),
            ("mix.1.mix.1.screen.0.multiply.1.diffuse",),
            2,
        ),
    ),
    "only light": (LIGHT, Anatomy("highlight", "highlight", (), (), 0)),
    "lights": (screen(LIGHT, SPOT), Anatomy("screen", "screen.0.highlight", (), (), 0)),
    "an edge under which there is no paint": (
        mix(multiply(A, FORM), B, HALF),
        Anatomy("mix", "mix", (), (), 0),
    ),
}


@pytest.mark.parametrize("name", ANATOMIES)
def test_the_parts_of_a_tree(name: str) -> None:
    root, parts = ANATOMIES[name]
    assert Anatomy.of(root) == parts


@given(strategies.nodes(named=False))
def test_the_parts_of_any_tree_are_there(root: Node) -> None:
    parts, known = Anatomy.of(root), dict(walk(root))
    assert {parts.canvas, parts.base, *parts.paints, *parts.forms} <= set(known)
    assert parts.base.startswith(parts.canvas)
    assert all(known[where].kind == "albedo" and where.startswith(parts.base) for where in parts.paints)
    assert not any(is_paint(known[where]) for where in parts.forms)


# Smaller and other trees

RICH = screen(multiply(mix(mix(A, B, BAND), C, HALF), FORM, TOON), LIGHT, SPOT, TINTED, RIM)


def test_removals_are_smaller_trees() -> None:
    found = removals(RICH)
    assert all(count_values(root) < count_values(RICH) and leaf_count(root) < leaf_count(RICH) for root in found)
    lost = [tuple(sorted(leaves_of(RICH) - leaves_of(root))) for root in found]
    assert len(set(lost)) == len(lost) == 2 + 4 + 4, "two forms, four lights, and either side of two mixes"
    for root in found:
        validate(root)
        assert "albedo" in kinds(root), "the base keeps a colour"
    assert removals(A) == []
    assert removals(multiply(A, FORM)) == [A]


def leaves_of(root: Node) -> set[str]:
    """Leaves as text, without the place where they stand."""
    return {repr(node) for _, node in walk(root) if isinstance(node, Leaf)}


def test_swaps_are_other_trees() -> None:
    found = swaps(RICH)
    assert len(found) >= 9
    for root in found:
        validate(root)
        assert kinds(root) != kinds(RICH), "another structure, not other numbers"
        assert count_values(root) <= count_values(RICH) + 5
    before = kinds(RICH)
    pairs = [("highlight", "toon_highlight"), ("toon_highlight", "highlight"), ("diffuse", "toon_diffuse"), ("stripe", "threshold")]
    for lost, gained in pairs:
        exchanged = [k for k in map(kinds, found) if k.count(lost) < before.count(lost) and k.count(gained) > before.count(gained)]
        assert exchanged, f"no {lost} becomes a {gained}"


def test_an_environment_behind_the_sphere_may_be_a_rim() -> None:
    behind = leaf("environment", direction=(0.7, -0.2, -0.7, 0.0, 0.0, 1.0), sharpness=(3.0, 5.0), color=(0.5, 0.5, 0.5, 0.1, 0.2, 0.3))
    rims = [node for root in swaps(screen(multiply(A, FORM), behind)) for _, node in walk(root) if node.kind == "rim"]
    assert len(rims) == 1
    (rim,) = rims
    assert isinstance(rim, Leaf)
    assert rim["direction"][0] > 0.9 > abs(rim["direction"][1])


def test_a_tree_that_will_end_as_another_is_not_new() -> None:
    other = LIGHT.set(direction=(-0.6, 0.2, 0.7))
    near = LIGHT.set(direction=(0.35, 0.45, 0.8), sharpness=60.0)
    seen = Seen()
    assert seen.is_new(screen(A, LIGHT, other))
    assert not seen.is_new(screen(B, other, near)), "colours and the order of lights do not matter"
    assert seen.is_new(screen(A, LIGHT)), "a light less"
    assert seen.is_new(screen(A, LIGHT, LIGHT)), "both lights in one place"
    assert seen.is_new(mix(A, B, HALF))
    assert not seen.is_new(mix(A, B, HALF.set(threshold=0.2)))
    assert seen.is_new(mix(A, B, HALF.set(threshold=-0.4))), "an edge in another place"
    assert seen.is_new(mix(A, B, BAND)), "another mask"


@pytest.mark.parametrize(
    ("edged", "size", "lag", "given_up"),
    [
        (False, 20, 1.0, False),
        (False, 20, 1.2, True),
        (True, 20, 2.0, False),
        (True, 44, 1.0, False),
        (True, 44, 2.0, True),
        (True, 56, 0.7, True),
    ],
)
def test_the_second_pass_gives_up_once_it_does_not_lead(edged: bool, size: int, lag: float, given_up: bool, monkeypatch: Any) -> None:
    pixels = small_pixels(A)
    dictionary = Dictionary(pixels.normals)
    search = ReflectingSearch(Samples(pixels, pixels, pixels, dictionary, dictionary), Effort(64), edged)
    monkeypatch.setattr(Candidate, "values", property(lambda candidate: size))
    leader, rival = Candidate(A, lag * 1e-3), Candidate(B, 1e-3)
    assert search._is_photograph([leader], leader, [rival]) is given_up


def test_a_swap_looks_alike() -> None:
    """A swap is a start for a fit: the same light in the same place, about as large and as bright."""
    normals = sphere_normals(48)
    for light in (LIGHT, SPOT):
        before = render(screen(A, light), normals)
        other = next(root for root in swaps(screen(A, light)) if find(root, "screen.1").kind not in (light.kind, "multiply"))
        after = render(other, normals)
        added, instead = (picture - render(A, normals) for picture in (before, after))
        assert float((added * instead).sum() / (added.norm() * instead.norm())) > 0.8
        assert 0.5 < float(instead.sum() / added.sum()) < 2.0


@settings(max_examples=60)
@given(strategies.nodes(named=False, max_leaves=6))
def test_removals_and_swaps_of_any_tree_are_trees(root: Node) -> None:
    for changed in removals(root):
        validate(changed)
        assert leaf_count(changed) < leaf_count(root)
    for changed in swaps(root):
        validate(changed)
        assert sum(1 for _ in walk(changed)) < MAX_NODES
        assert render(changed, sphere_normals(8)).isfinite().all()


# The front


def test_a_front_keeps_the_best_of_each_size() -> None:
    front = Front()
    for root, error in ((multiply(A, FORM), 0.1), (A, 0.2), (multiply(B, FORM), 0.05), (screen(multiply(A, FORM), LIGHT), 0.06)):
        front.add(Candidate(root, error))
    assert [(member.values, member.error) for member in front.members()] == [(3, 0.2), (6, 0.05)]
