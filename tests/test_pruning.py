"""What is least useful in a tree goes first, and what its loss costs is told without building the tree that is left."""

from __future__ import annotations

import pytest

from unshade import pruning
from unshade.changes import removals
from unshade.fit.least_squares import error_of
from unshade.fit.pixels import Pixels
from unshade.nodes import Leaf, Node, count_values, leaf, mix, multiply, replace, screen, walk
from unshade.render import render
from unshade.sphere import sphere_normals

SIMPLE = screen(
    multiply(leaf("albedo", color=(0.8, 0.3, 0.2)), leaf("diffuse", direction=(0.3, 0.6, 0.7), ambient=0.3)),
    leaf("highlight", direction=(-0.3, 0.4, 0.85), sharpness=40.0, amplitude=1.0),
)
ROOM = leaf("environment", direction=(0.1, 0.5, 0.8, -0.6, 0.1, 0.7), sharpness=(8.0, 20.0), color=(0.3, 0.2, 0.1, 0.1, 0.2, 0.4))
HALF = leaf("threshold", direction=(0.4, 0.2, 0.9), threshold=0.4, softness=0.2)
RICH = mix(
    leaf("albedo", color=(0.1, 0.1, 0.2)),
    screen(
        multiply(
            mix(leaf("albedo", color=(0.8, 0.6, 0.2)), leaf("albedo", color=(0.2, 0.3, 0.6)), HALF),
            leaf("diffuse", direction=(0.3, 0.6, 0.7), ambient=0.3),
            leaf("toon_diffuse", direction=(-0.5, 0.2, 0.7), ambient=0.6, threshold=0.1, softness=0.3),
        ),
        leaf("highlight", direction=(-0.3, 0.4, 0.85), sharpness=40.0, amplitude=0.7),
        multiply(leaf("albedo", color=(0.5, 0.2, 0.1)), leaf("rim", direction=(1.0, 0.0, 0.2), exponent=2.0)),
        ROOM,
    ),
    leaf("stripe", direction=(0.0, 1.0, 0.3), center=0.6, width=0.2, softness=0.1),
)


def pixels_of(root: Node) -> Pixels:
    return Pixels.of(render(root, sphere_normals(96)), None, 40)


@pytest.mark.parametrize("root", [SIMPLE, RICH, leaf("albedo")], ids=["simple", "rich", "one leaf"])
def test_a_loss_is_the_error_of_the_tree_that_is_left(root: Node) -> None:
    pixels = pixels_of(SIMPLE)
    found = pruning.losses(root, pixels)
    assert [replace(root, where, kept) for _, where, kept in found] == removals(root)
    for (error, where, _), smaller in zip(found, removals(root), strict=True):
        assert error == pytest.approx(error_of(pixels, smaller), rel=1e-4, abs=1e-10), where


@pytest.mark.parametrize("looked_at", [1, 5])
def test_the_leaf_that_is_missed_least_goes_first(looked_at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pruning, "REMOVED", looked_at)
    faint = leaf("highlight", direction=(0.5, 0.2, 0.85), sharpness=20.0, amplitude=0.05)
    root = screen(SIMPLE, faint)
    smaller = pruning.least_useful(root, pixels_of(root))
    assert smaller is not None and sorted(entry.kind for entry in leaves(smaller)) == ["albedo", "diffuse", "highlight"]
    assert min(float(entry["amplitude"][0]) for entry in leaves(smaller) if entry.kind == "highlight") > 0.5
    assert pruning.least_useful(leaf("albedo"), pixels_of(root)) is None


def leaves(root: Node) -> list[Leaf]:
    return [node for _, node in walk(root) if isinstance(node, Leaf)]


@pytest.mark.parametrize("most", [40, 20, 3])  # over by less than twelve values, and by more
def test_a_tree_that_is_too_large_comes_within(most: int) -> None:
    found = pruning.within(RICH, pixels_of(RICH), most)
    assert found is not None and count_values(found) <= most
    assert pruning.within(RICH, pixels_of(RICH), count_values(RICH)) is RICH


def test_nothing_is_left_of_a_leaf_that_is_too_large() -> None:
    assert pruning.within(ROOM, pixels_of(RICH), 2) is None
