"""Families to report on: hand-made trees that grow towards a picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from unshade.nodes import Family, Member, Operator, Raster, Tree, leaf, mix, multiply, screen
from unshade.pictures import Disc, SphereImage
from unshade.render import render
from unshade.report import report_html
from unshade.sphere import disc_mask, sphere_normals

SIZE = 128


@dataclass(frozen=True)
class Outcome:
    """What the report needs of a `decompose.Result`."""

    tree: Tree
    family: Family
    psnr: float
    seed: int
    preset: str


def light(index: int, name: str | None = None) -> Operator:
    turn = torch.tensor(2.4 * index)
    towards = (float(turn.cos()), float(turn.sin()), 0.8)
    return multiply(
        leaf("albedo", color=(0.9, 0.7 - 0.015 * index, 0.4)), leaf("highlight", direction=towards, sharpness=12.0 + 8.0 * index), name=name
    )


def grown(lights: int, name: str | None = None) -> Tree:
    base = multiply(leaf("albedo", color=(0.75, 0.25, 0.15)), leaf("diffuse", direction=(-0.5, 0.7, 0.6), ambient=0.15))
    return Tree(screen(base, *[light(index, name if index == 0 else None) for index in range(lights)]) if lights else base)


def everything() -> Tree:
    """A tree with every role and every type of parameter."""
    paint = mix(
        leaf("albedo", color=(0.7, 0.3, 0.2)),
        leaf("image", pixels=Raster.from_array(torch.full((3, 4, 4), 0.4))),
        leaf("stripe", width=0.5, softness=0.1),
    )
    sky = leaf("environment_map", pixels=Raster.from_array(torch.rand(3, 4, 8, generator=torch.Generator().manual_seed(1)) * 0.3))
    lamps = leaf("environment", direction=(0, 1, 1, 1, 0, -0.2), sharpness=(5, 20), color=(0.2, 0.3, 0.5, 0.4, 0.1, 0.1))
    return Tree(screen(multiply(paint, leaf("toon_diffuse")), light(1), leaf("toon_highlight", name="sun"), leaf("rim"), lamps, sky))


def outcome(members: list[Tree], chosen: int, alternatives: tuple[Tree, ...] = ()) -> tuple[Outcome, SphereImage]:
    """A family that grows towards a picture which its last member draws perfectly but for a little noise."""
    noise = torch.rand(3, SIZE, SIZE, generator=torch.Generator().manual_seed(0)) * 0.02
    picture = (render(members[-1], sphere_normals(SIZE)) + noise).clamp(0.0, 1.0)
    inside = disc_mask(SIZE)

    def member(tree: Tree) -> Member:
        error = (render(tree, sphere_normals(SIZE)) - picture)[:, inside[0]].square().mean()
        return Member(tree, float(-10.0 * error.log10()))

    family = Family(tuple(map(member, members)), chosen, tuple(map(member, alternatives)))
    best = family.members[chosen]
    return Outcome(best.tree, family, best.psnr, 7, "balanced"), SphereImage(picture, inside, Disc(SIZE / 2, SIZE / 2, SIZE / 2, 1.0))


@lru_cache(maxsize=1)
def balanced() -> tuple[Outcome, SphereImage]:
    return outcome([grown(lights) for lights in range(10)], 8, (everything(), grown(8, "other")))


def page(found: tuple[Outcome, SphereImage], name: str = "sphere.png", **figures: Any) -> str:
    return report_html(found[0], found[1], name, {"psnr": found[0].psnr, "ssim": 0.9713, "seconds": 1.234, **figures})  # type: ignore[arg-type]


@lru_cache(maxsize=1)
def balanced_page() -> str:
    return page(balanced())


@pytest.fixture(scope="session")
def made() -> SimpleNamespace:
    """The functions above, for the tests of this folder."""
    return SimpleNamespace(
        size=SIZE,
        outcome_type=Outcome,
        grown=grown,
        everything=everything,
        outcome=outcome,
        balanced=balanced,
        page=page,
        balanced_page=balanced_page,
    )
