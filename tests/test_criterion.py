"""The criterion that picks one of several samples of a node's children."""

from __future__ import annotations

import pytest
import torch

from unshade import synthesis
from unshade.criterion import Terms, criterion
from unshade.nodes import leaf, multiply, screen
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals

SIZE = 32

BALL = screen(
    multiply(leaf("albedo", color=(0.8, 0.3, 0.2)), leaf("diffuse", direction=(0.3, 0.6, 0.7), ambient=0.3)),
    leaf("highlight", direction=(-0.3, 0.4, 0.85), sharpness=40.0, amplitude=1.0),
)


def terms(
    parent: torch.Tensor,
    left: torch.Tensor,
    right: torch.Tensor,
    operator: str,
    mask: torch.Tensor | None = None,
    drawn: tuple[torch.Tensor, torch.Tensor] | None = None,
) -> Terms:
    masks = torch.zeros(1, 1, SIZE, SIZE) if mask is None else mask[None]
    number = torch.tensor([synthesis.OPERATORS.index(operator)])
    children = left[None], right[None]
    first = children if drawn is None else (drawn[0][None], drawn[1][None])
    return criterion(parent[None], parent[None], first, children, children, number, masks, (0.02, 0.02, 0.02, 0.5))[0]


def test_the_criterion_of_a_right_decomposition_is_nothing() -> None:
    disc = disc_mask(SIZE)
    left, right = (render(child, sphere_normals(SIZE)) * disc for child in BALL.children)
    found = terms(render(BALL, sphere_normals(SIZE)) * disc, left, right, "screen")
    assert found.recon == pytest.approx(0.0, abs=1e-6)
    assert found.similar == found.blank == found.white == 0.0


def test_of_two_that_explain_a_node_alike_the_one_that_was_drawn_right_is_better() -> None:
    disc = disc_mask(SIZE)
    parent = render(BALL, sphere_normals(SIZE)) * disc
    left, right = (render(child, sphere_normals(SIZE)) * disc for child in BALL.children)
    good, bad = (terms(parent, left, right, "screen", drawn=(first, right)) for first in (left * 0.99, left * 0.6))
    assert good.recon == bad.recon < 1e-6 and 0.0 < good.drawn < bad.drawn
    assert bad.select == good.select == good.recon and bad.rank - good.rank == pytest.approx(0.5 * (bad.drawn - good.drawn), abs=1e-6)


def test_one_useless_child_is_enough_to_cost() -> None:
    disc = disc_mask(SIZE)
    parent = render(BALL, sphere_normals(SIZE)) * disc
    black, white = torch.zeros_like(parent), disc.expand(3, -1, -1).float()
    blank, copied = terms(parent, parent, black, "screen"), terms(parent, parent, white, "multiply")
    assert blank.recon < 1e-6 and blank.blank > 1.0 and blank.similar > 1.0
    assert copied.recon < 1e-6 and copied.white > 1.0 and copied.similar > 1.0
    assert blank.select > 0.05 and copied.select > 0.05


def test_black_and_white_paint_is_welcome_in_a_mix() -> None:
    disc = disc_mask(SIZE)
    mask = disc & (sphere_normals(SIZE)[:1] > 0)
    black, white = torch.zeros(3, SIZE, SIZE), disc.expand(3, -1, -1).float()
    found = terms(mask.expand(3, -1, -1).float(), white, black, "mix", mask.float())
    assert found.recon < 1e-6 and found.select < 1e-6
