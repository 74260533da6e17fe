"""What two pictures tell about the part that differs."""

from __future__ import annotations

import pytest
import torch

from unshade.analogy import Seen, explain
from unshade.components import Component
from unshade.edit import transfer
from unshade.environments import raster
from unshade.nodes import Leaf, Operator, Raster, Tree
from unshade.ratio import Ratio, moved
from unshade.render import render
from unshade.serde import parse
from unshade.sphere import disc_mask, sphere_normals
from unshade.types import Image

DISC = disc_mask(256)


def _reflecting(version: int, text: str) -> Tree:
    coat = Leaf("environment_map", (raster("test", version), (0.0, 0.0, 0.0)))
    return Tree(Operator("screen", (coat, *parse(text).root.children)))  # type: ignore[union-attr]


A = _reflecting(
    14,
    "screen(multiply(mix(albedo(#c04030), albedo(#308040), stripe(right up, 0.1, 0.4)), diffuse(left up front, 0.3)), "
    "highlight(right up front, 40), rim(left))",
)
B = _reflecting(50, "screen(multiply(albedo(#3060a0), diffuse(right front, 0.4)), highlight(left front, 30), rim(down))")


def shown(tree: Tree) -> Image:
    return (render(tree, sphere_normals(256)) * 255.0).round() / 255.0


@pytest.mark.parametrize("which", list(Component))
def test_the_ratio_tells_what_was_moved(which: Component) -> None:
    assert moved(shown(A), shown(B), shown(transfer(B, A, which)), DISC) is which


def test_what_is_on_top_of_both_cancels() -> None:
    """The environment is the same before and after, whatever lies below it."""
    plain = Tree(Operator("screen", A.root.children[1:]))  # type: ignore[union-attr]
    trees = [A, transfer(B, A, "albedo"), plain, transfer(B, plain, "albedo")]
    pictures = [render(tree, sphere_normals(256, dtype=torch.float64)) for tree in trees]
    with_coat, without = Ratio.of(pictures[1], pictures[0], DISC), Ratio.of(pictures[3], pictures[2], DISC)
    both = (with_coat.inside & without.inside).expand(3, -1, -1)
    assert float((with_coat.log - without.log)[both].abs().max()) < 1e-9


@pytest.mark.parametrize("how", ["alike", "grey", "grain", "nothing"])
def test_pictures_that_tell_nothing(how: str) -> None:
    a, b, ab = (shown(tree) for tree in (A, B, transfer(B, A, "albedo")))
    valid = DISC
    if how == "alike":
        ab = a
    elif how == "grey":
        a, b, ab = (picture.mean(0, keepdim=True).expand(3, -1, -1) for picture in (a, b, ab))
    elif how == "grain":
        generator = torch.Generator().manual_seed(0)
        a, b, ab = ((picture + 0.02 * torch.randn(picture.shape, generator=generator)).clamp(0, 1) for picture in (a, b, ab))
    else:
        valid = torch.zeros_like(DISC)
    assert moved(a, b, ab, valid) is None


@pytest.mark.parametrize("which", [Component.ENVIRONMENT, Component.HIGHLIGHTS])
def test_analogy_sees_a_reflection_that_trees_do_not_hold(which: Component) -> None:
    pictures = [shown(tree) for tree in (A, B, transfer(B, A, which))]
    # What is found where nothing holds the reflections: all else, and a broad light in the place of the environment.
    stand_in = parse("highlight(up, 8, 0.4)").root
    found = [Tree(Operator("screen", (*tree.root.children[1:], stand_in))) for tree in (A, B)]  # type: ignore[union-attr]
    a, b = (Seen(picture, DISC, tree) for picture, tree in zip(pictures, found, strict=False))
    explained = explain(a, b, pictures[2], DISC)
    is_environment = which is Component.ENVIRONMENT
    assert explained.component is which and (explained.seen is which or not is_environment)
    assert explained.apply(b.tree, a.tree) == transfer(b.tree, a.tree, which, stand_ins=is_environment)


def test_one_picture_does_not_tell_how_bright_an_environment_is() -> None:
    """Why an analogy with reflections has a limit: two trees, other paint and form, other environment, one picture."""
    stored = raster("test", 14)
    paint, ambient, other = torch.tensor([0.7, 0.4, 0.3], dtype=torch.float64), 0.4, 0.25
    scale = 1.0 - paint * ambient + other / (1.0 - other) * paint * (1.0 - ambient)
    brighter = Raster.from_array(1.0 - scale[:, None, None] * (1.0 - stored.tensor(dtype=torch.float64)))

    def ball(pixels: Raster, color: torch.Tensor, share: float) -> Tree:
        shade = Operator("multiply", (Leaf("albedo", (tuple(color.tolist()),)), parse(f"diffuse(left up front, {share})").root))
        return Tree(Operator("screen", (Leaf("environment_map", (pixels, (0.0, 0.0, 0.0))), shade)))

    normals = sphere_normals(32, dtype=torch.float64)
    first, second = ball(stored, paint, ambient), ball(brighter, (scale - 1.0 + paint) / scale, other)
    assert float((brighter.tensor() - stored.tensor()).mean()) > 0.03
    # What is left is the 16 bits of a raster.
    assert float((render(first, normals) - render(second, normals)).abs().max()) < 2e-5
