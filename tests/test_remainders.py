"""What a node's picture leaves for one child once the other is known."""

from __future__ import annotations

import pytest
import torch

from unshade.blend import BLENDS
from unshade.nodes import leaf
from unshade.remainders import cleaned, completed, contrast, gains, remainder
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals

SIZE = 32
DISC = disc_mask(SIZE)


def shown(kind: str, **values: object) -> torch.Tensor:
    return render(leaf(kind, **values), sphere_normals(SIZE)) * DISC


def blurred(image: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(image[None], 5, stride=1, padding=2)[0] * DISC


def rms(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(((a - b).square() * DISC).mean().sqrt())


LEFT = shown("albedo", color=(0.8, 0.5, 0.3))
RIGHT = shown("toon_diffuse", direction=(0.5, 0.5, 0.7), ambient=0.4, threshold=0.1, softness=0.0)
MASK = (sphere_normals(SIZE)[:1] > 0.1).float()


def parent_of(operator: str) -> tuple[torch.Tensor, torch.Tensor | None]:
    mask = MASK if operator == "mix" else None
    return BLENDS[operator].apply(LEFT, RIGHT, *([mask] if mask is not None else [])) * DISC, mask


@pytest.mark.parametrize("operator", BLENDS)
def test_a_blurred_child_is_sharp_again_where_it_shows(operator: str) -> None:
    parent, mask = parent_of(operator)
    soft = blurred(RIGHT)
    found = remainder(parent, operator, (LEFT, soft), mask, 1)
    share = gains(operator, (LEFT, soft), mask)[1]
    assert rms(soft * share, RIGHT * share) > 0.03
    assert rms(found * share, RIGHT * share) < 0.01
    assert float(found.min()) >= 0.0 and float(found.max()) <= 1.0 and not bool((found * ~DISC).any())


def test_what_does_not_show_stays_as_it_was_drawn() -> None:
    black = torch.zeros_like(LEFT)
    assert torch.allclose(remainder(black, "multiply", (black, RIGHT), None, 1), RIGHT * DISC, atol=1e-6)


def test_a_leaf_loses_what_its_type_cannot_have() -> None:
    noisy = LEFT + 0.1 * torch.rand(LEFT.shape, generator=torch.Generator().manual_seed(0)) * DISC
    paint = cleaned("albedo", noisy)
    assert torch.allclose(paint[:, DISC[0]].std(1), torch.zeros(3), atol=1e-6) and rms(paint, LEFT) < 0.06
    grey = cleaned("highlight", noisy)
    assert torch.equal(grey[0], grey[1]) and torch.equal(grey[1], grey[2])
    assert torch.equal(cleaned("environment", noisy), noisy)


@pytest.mark.parametrize(
    ("operator", "kinds", "sharp"),
    [
        ("multiply", ("albedo", "operator"), (False, True)),
        ("multiply", ("operator", "operator"), (False, True)),
        ("mix", ("operator", "operator"), (True, True)),
        ("screen", ("albedo", "toon_diffuse"), (False, False)),
    ],
)
def test_whose_picture_is_completed(operator: str, kinds: tuple[str, str], sharp: tuple[bool, bool]) -> None:
    """The one to be decomposed, of two such the one with more to show, under a mix both; leaves stay."""
    parent, mask = parent_of(operator)
    drawn = blurred(LEFT), blurred(RIGHT)
    found = completed(parent, operator, drawn, mask, kinds)
    for after, before, kind, changed in zip(found, drawn, kinds, sharp, strict=True):
        assert torch.allclose(after, cleaned(kind, before)) != changed


def test_contrast_is_what_one_colour_would_lose() -> None:
    everywhere = torch.ones_like(RIGHT)
    assert float(contrast(LEFT, everywhere)) == pytest.approx(0.0, abs=1e-6)
    inside = RIGHT[:, DISC[0]]
    assert float(contrast(RIGHT, everywhere)) == pytest.approx(float(inside.std(correction=0)), rel=1e-4)
    assert float(contrast(RIGHT, 0.1 * everywhere)) == pytest.approx(0.1 * float(inside.std(correction=0)), rel=1e-4)
