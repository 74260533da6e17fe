"""What two pictures tell about the part that differs."""

from __future__ import annotations

import pytest
import torch

from unshade.components import Component
from unshade.environments import raster
from unshade.nodes import Leaf, Operator, Tree
from unshade.ratio import Ratio, moved
from unshade.render import render
from unshade.serde import parse
from unshade.sphere import disc_mask, sphere_normals
from unshade.transfer import transfer
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
