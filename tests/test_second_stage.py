"""What the second stage asks of a node that was left over, and what its fits leave on the curve."""

from __future__ import annotations

import dataclasses
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from lit_spheres import PAINTED, picture
from unshade import second_stage
from unshade.fit.pixels import Pixels
from unshade.growth import Growth
from unshade.inference import Part, Pool
from unshade.models.vqvae import Codes
from unshade.nodes import Tree, leaf
from unshade.presets import PRESETS
from unshade.proposals import Fits
from unshade.render import render
from unshade.threads import threads


def test_undoing_the_operators_gives_what_a_node_shows() -> None:
    paint, shade, light = PAINTED.children[0].children[0], PAINTED.children[0].children[1], PAINTED.children[1]  # type: ignore[union-attr]
    blank = torch.zeros(3, 8, 8)
    codes = Codes(*[torch.zeros(1)] * 4)
    root = Part(blank, codes, "operator", "split", 0, operator="screen", children=(1, 2))
    body = Part(blank, codes, "operator", "split", 1, operator="multiply", children=(3, 4))
    rest = Part(blank, codes, "operator", "left over", 1)
    pool = Pool((root, body, rest, rest, rest))
    true = {2: light, 3: paint, 4: shade}
    pixels = Pixels.of(picture(PAINTED))
    for place, node in true.items():
        others = {other: node for other, node in true.items() if other != place}
        found, gain = second_stage.wanted(pool, place, others, Fits(), pixels)
        shown = render(node, found.normals[:, None])[:, 0]
        assert (found.target - shown).abs().max() < 1e-3 and 0.1 < gain < 1.0
        assert found.weight.sum().item() == pytest.approx(1.0, abs=1e-5)
    hidden = {2: leaf("albedo", color=(1.0, 1.0, 1.0)), 4: shade}
    assert second_stage.wanted(pool, 3, hidden, Fits(), pixels)[1] < second_stage.HIDDEN
    assert second_stage.SecondStage(SimpleNamespace(samples=SimpleNamespace(coarse=pixels)), Fits()).in_place(pool, 3, hidden) is None  # type: ignore[arg-type]


def test_a_node_that_shows_little_of_itself_gets_few_values() -> None:
    stage = second_stage.SecondStage(SimpleNamespace(), Fits())  # type: ignore[arg-type]
    codes, image = Codes(*[torch.zeros(1)] * 4), picture(PAINTED, 64)
    sizes = []
    for gain in (0.01, 0.25, 1.0):
        part = Part(image, codes, "operator", "left over", 1, gain=torch.full_like(image, gain))
        assert second_stage.gain_of(part) == pytest.approx(gain)
        sizes.append(Tree(stage.decompose(part).root).values)
    most = second_stage.NODE_EFFORT.max_values
    assert sizes[0] == 3 < sizes[1] <= most / 2 < sizes[2] <= most
    assert second_stage.gain_of(dataclasses.replace(part, gain=None)) == 1.0
    half = torch.full_like(image, 1.0) * (torch.arange(64) < 32)
    assert second_stage.gain_of(dataclasses.replace(part, gain=half)) == pytest.approx(0.5**0.5, abs=0.01)


def test_what_copies_note_on_the_curve_is_noted_here() -> None:
    pixels = Pixels.of(picture(PAINTED))
    samples: Any = SimpleNamespace(coarse=None, points=pixels)
    growth = Growth(samples, PRESETS["draft"].effort)
    trees = [leaf("albedo", color=(0.5, 0.4, 0.3)), PAINTED]
    found = list(growth.side_by_side([partial(growth.fit, root, pixels, 1) for root in trees], 2))
    assert growth.front.best == {candidate.values: candidate for candidate in found} and len(found) == 2


def test_jobs_of_a_growth_compute_with_one_thread() -> None:
    samples: Any = SimpleNamespace(coarse=None)
    with threads(2):
        for workers in (1, 2):
            assert list(Growth(samples, PRESETS["draft"].effort).side_by_side([torch.get_num_threads] * 2, workers)) == [1, 1]
