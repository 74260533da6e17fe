"""Figures against published values, and the properties that they must have."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest
import torch

from unshade import metrics
from unshade.errors import MissingExtraError
from unshade.grammar import canonical, sample
from unshade.models import perceptual
from unshade.nodes import Node, Raster, Tree, leaf, mix, multiply, screen
from unshade.sphere import disc_mask
from unshade.tree_distance import assignment, cheapest_pairing

needs_weights = pytest.mark.skipif(importlib.util.find_spec("stlpips_pytorch") is None, reason="the weight files are not installed")


def picture(seed: int = 0, size: int = 64) -> torch.Tensor:
    coarse = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(coarse, (size, size), mode="bilinear")[0]


def noisy(image: torch.Tensor, amount: float) -> torch.Tensor:
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(7))
    return (image + amount * noise).clamp(0, 1)


# --- Pictures


def test_psnr_counts_the_scored_disc_alone() -> None:
    a = torch.full((3, 64, 64), 0.5)
    b = a + 0.1
    assert metrics.psnr(a, b) == pytest.approx(20.0, abs=1e-4)
    assert metrics.psnr(a, torch.where(disc_mask(64, 0.97), a, 1.0)) == math.inf
    share = float(disc_mask(64, 0.97).double().mean())
    assert metrics.psnr_full_frame(a, b) == pytest.approx(20.0 - 10 * math.log10(share), abs=1e-4)
    left = torch.zeros(1, 64, 64, dtype=torch.bool)
    left[..., :32] = True
    b[..., 32:] = 0.0
    assert metrics.psnr(a, b, left) == pytest.approx(20.0, abs=1e-4)


def test_ssim_agrees_with_a_plain_sum() -> None:
    a, b = picture(0, 20), noisy(picture(0, 20), 0.2)
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(taps, taps) / np.outer(taps, taps).sum()
    scored = disc_mask(20, 0.97)
    values = []
    for x, y in zip((a * scored).double().numpy(), (b * scored).double().numpy(), strict=True):
        for row in range(10):
            for column in range(10):
                u, v = x[row : row + 11, column : column + 11], y[row : row + 11, column : column + 11]
                mu, mv = (window * u).sum(), (window * v).sum()
                uu, vv, uv = (window * u * u).sum() - mu**2, (window * v * v).sum() - mv**2, (window * u * v).sum() - mu * mv
                values.append((2 * mu * mv + 1e-4) * (2 * uv + 9e-4) / ((mu**2 + mv**2 + 1e-4) * (uu + vv + 9e-4)))
    assert metrics.ssim(a, b) == pytest.approx(float(np.mean(values)), abs=1e-9)
    assert metrics.ssim(a, a) == pytest.approx(1.0)


def test_figures_fall_with_noise() -> None:
    a = picture()
    for figure in (metrics.psnr, metrics.ssim):
        found = [figure(a, noisy(a, amount)) for amount in (0.02, 0.05, 0.1, 0.3)]
        assert found == sorted(found, reverse=True) and len(set(found)) == 4


def test_shapes_are_checked() -> None:
    for a, b in (
        (torch.zeros(3, 8, 9), torch.zeros(3, 8, 9)),
        (torch.zeros(3, 8, 8), torch.zeros(3, 9, 9)),
        (torch.zeros(8, 8), torch.zeros(8, 8)),
    ):
        with pytest.raises(ValueError, match="expected"):
            metrics.psnr(a, b)
    with pytest.raises(ValueError, match="no pixel"):
        metrics.psnr(torch.zeros(3, 8, 8), torch.zeros(3, 8, 8), torch.zeros(1, 8, 8))


@needs_weights
@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_st_lpips_is_a_distance_that_grows_with_noise(net: perceptual.Net) -> None:
    a = picture()
    assert metrics.st_lpips(a, a, net) == 0.0
    found = [metrics.st_lpips(a, noisy(a, amount), net) for amount in (0.02, 0.1, 0.3)]
    assert 0 < found[0] < found[1] < found[2] < 1
    assert metrics.st_lpips(noisy(a, 0.1), a, net) == pytest.approx(found[1], rel=1e-5)
    outside = torch.where(disc_mask(64, 0.97), a, 1 - a)
    assert metrics.st_lpips(a, outside, net) == 0.0


@needs_weights
def test_st_lpips_hardly_sees_a_shift_by_a_pixel() -> None:
    a = picture(size=96)
    shifted, far = torch.roll(a, 1, dims=2), picture(1, 96)
    assert metrics.st_lpips(a, shifted, "alex") < 0.1 * metrics.st_lpips(a, far, "alex")


@needs_weights
def test_vgg_features_have_gradients_and_batch_equals_loop() -> None:
    images = torch.stack([picture(0), picture(1)]).requires_grad_()
    together = perceptual.vgg_features(images)
    assert [tuple(maps.shape[1:]) for maps in together] == [(64, 64, 64), (128, 33, 33), (256, 17, 17), (512, 9, 9), (512, 5, 5)]
    for k in range(2):
        for maps, alone in zip(together, perceptual.vgg_features(images[k : k + 1].detach()), strict=True):
            assert torch.allclose(maps[k], alone[0], atol=1e-3)
    perceptual.distance(images[:1], images[1:]).sum().backward()
    assert images.grad is not None and torch.isfinite(images.grad).all() and float(images.grad.abs().max()) > 0


@needs_weights
def test_the_wheel_itself_is_never_imported() -> None:
    import subprocess
    import sys

    code = (
        "import sys, torch; from unshade import metrics; a = torch.rand(3, 32, 32); metrics.st_lpips(a, a, 'alex'); "
        "assert not [m for m in sys.modules if m.startswith(('stlpips_pytorch', 'torchvision'))]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_missing_weights_name_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"unshade\[perceptual\]"):
        perceptual.weight_file("vgg")


# --- Colours

# Sharma, Wu and Dalal 2005, table 1.
SHARMA = """
50.0000 2.6772 -79.7751 50.0000 0.0000 -82.7485 2.0425
50.0000 3.1571 -77.2803 50.0000 0.0000 -82.7485 2.8615
50.0000 2.8361 -74.0200 50.0000 0.0000 -82.7485 3.4412
50.0000 -1.3802 -84.2814 50.0000 0.0000 -82.7485 1.0000
50.0000 -1.1848 -84.8006 50.0000 0.0000 -82.7485 1.0000
50.0000 -0.9009 -85.5211 50.0000 0.0000 -82.7485 1.0000
50.0000 0.0000 0.0000 50.0000 -1.0000 2.0000 2.3669
50.0000 -1.0000 2.0000 50.0000 0.0000 0.0000 2.3669
50.0000 2.4900 -0.0010 50.0000 -2.4900 0.0009 7.1792
50.0000 2.4900 -0.0010 50.0000 -2.4900 0.0010 7.1792
50.0000 2.4900 -0.0010 50.0000 -2.4900 0.0011 7.2195
50.0000 2.4900 -0.0010 50.0000 -2.4900 0.0012 7.2195
50.0000 -0.0010 2.4900 50.0000 0.0009 -2.4900 4.8045
50.0000 -0.0010 2.4900 50.0000 0.0010 -2.4900 4.8045
50.0000 -0.0010 2.4900 50.0000 0.0011 -2.4900 4.7461
50.0000 2.5000 0.0000 50.0000 0.0000 -2.5000 4.3065
50.0000 2.5000 0.0000 73.0000 25.0000 -18.0000 27.1492
50.0000 2.5000 0.0000 61.0000 -5.0000 29.0000 22.8977
50.0000 2.5000 0.0000 56.0000 -27.0000 -3.0000 31.9030
50.0000 2.5000 0.0000 58.0000 24.0000 15.0000 19.4535
50.0000 2.5000 0.0000 50.0000 3.1736 0.5854 1.0000
50.0000 2.5000 0.0000 50.0000 3.2972 0.0000 1.0000
50.0000 2.5000 0.0000 50.0000 1.8634 0.5757 1.0000
50.0000 2.5000 0.0000 50.0000 3.2592 0.3350 1.0000
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644
63.0109 -31.0961 -5.8663 62.8187 -29.7946 -4.0864 1.2630
61.2901 3.7196 -5.3901 61.4292 2.2480 -4.9620 1.8731
35.0831 -44.1164 3.7933 35.0232 -40.0716 1.5901 1.8645
22.7233 20.0904 -46.6940 23.0331 14.9730 -42.5619 2.0373
36.4612 47.8580 18.3852 36.2715 50.5065 21.2231 1.4146
90.8027 -2.0831 1.4410 91.1528 -1.6435 0.0447 1.4441
90.9257 -0.5406 -0.9208 88.6381 -0.8985 -0.7239 1.5381
6.7747 -0.2908 -2.4247 5.8714 -0.0985 -2.2286 0.6377
2.0776 0.0795 -1.1350 0.9033 -0.0636 -0.5514 0.9082
"""


@pytest.mark.parametrize("line", SHARMA.strip().splitlines())
def test_ciede2000_gives_the_published_values(line: str) -> None:
    l1, a1, b1, l2, a2, b2, expected = map(float, line.split())
    assert metrics.ciede2000_lab((l1, a1, b1), (l2, a2, b2)) == pytest.approx(expected, abs=1e-4)
    assert metrics.ciede2000_lab((l2, a2, b2), (l1, a1, b1)) == pytest.approx(expected, abs=1e-4)


def test_ciede2000_of_srgb_colours() -> None:
    assert metrics.ciede2000((0, 0, 0), (1, 1, 1)) == pytest.approx(100.0, abs=1e-3)
    assert metrics.ciede2000((0.3, 0.5, 0.7), (0.3, 0.5, 0.7)) == 0.0
    assert 0.0 < metrics.ciede2000((0.5, 0.5, 0.5), (0.505, 0.5, 0.5)) < 1.0


# --- Trees


def base(ambient: float = 0.2) -> Node:
    return multiply(leaf("albedo", color=(0.8, 0.3, 0.2)), leaf("diffuse", direction=(-1, 1, 1), ambient=ambient))


SPOT = leaf("highlight", direction=(0, 0.6, 0.8), sharpness=50.0)


def test_tree_distance_of_small_edits() -> None:
    assert metrics.tree_distance(base(), base()) == 0.0
    assert metrics.tree_distance(screen(base(), SPOT), screen(SPOT, base())) == 0.0
    assert metrics.tree_distance(base(), base(0.4)) == pytest.approx(0.1)
    assert metrics.tree_distance(base(), screen(base(), SPOT)) == 2.0
    assert metrics.tree_distance(screen(base(), SPOT), screen(base(), leaf("rim"))) == 2.0
    assert metrics.tree_distance(Tree(base()), Tree(base(), "linear")) == 1.0
    mask = leaf("threshold", threshold=0.1)
    half = mix(base(), leaf("albedo", color=(0, 0, 0)), mask)
    assert 0 < metrics.tree_distance(half, mix(base(), leaf("albedo", color=(0, 0, 0)), mask.set(threshold=0.2))) < 0.1
    assert metrics.tree_distance(base(), base(math.nextafter(0.2, 1))) > 0


def test_tree_distance_pairs_lobes_and_rasters() -> None:
    two = leaf("environment", direction=(0, 0, 1, 0, 1, 0), sharpness=(5, 9), color=(0.2, 0.2, 0.2, 0.9, 0.1, 0.1))
    swapped = leaf("environment", direction=(0, 1, 0, 0, 0, 1), sharpness=(9, 5), color=(0.9, 0.1, 0.1, 0.2, 0.2, 0.2))
    one = leaf("environment", direction=(0, 0, 1), sharpness=(5,), color=(0.2, 0.2, 0.2))
    assert metrics.tree_distance(two, swapped) == 0.0
    assert metrics.tree_distance(two, one) == pytest.approx(0.5)
    dark, light = (leaf("image", pixels=Raster.from_array(np.full((3, 2, 2), level))) for level in (0.2, 0.6))
    assert metrics.tree_distance(dark, light) == pytest.approx(0.4, abs=1e-4)


def test_tree_distance_is_a_metric_on_sampled_trees() -> None:
    generator = torch.Generator().manual_seed(3)
    trees = [sample(generator, style) for style in ("realistic", "toon") for _ in range(5)]
    table = [[metrics.tree_distance(a, b) for b in trees] for a in trees]
    for i, a in enumerate(trees):
        for j, b in enumerate(trees):
            assert table[i][j] == table[j][i]
            assert (table[i][j] == 0.0) == (canonical(a.root) == canonical(b.root))
            assert all(table[i][j] <= table[i][k] + table[k][j] + 1e-9 for k in range(len(trees)))


def test_the_assignment_is_the_cheapest() -> None:
    import itertools

    random = np.random.default_rng(0)
    for n in (1, 2, 3, 5):
        for _ in range(10):
            costs = random.random((n, n)).round(2)
            found = assignment(costs)
            best = min(sum(costs[i, p[i]] for i in range(n)) for p in itertools.permutations(range(n)))
            assert sorted(found) == list(range(n)) and costs[np.arange(n), found].sum() == pytest.approx(best)


def test_pairing_of_many_children_is_near_the_cheapest() -> None:
    ones = np.ones(60)
    assert cheapest_pairing(1.0 - np.eye(60), ones, ones) == pytest.approx(0.0)
    assert cheapest_pairing(np.full((60, 10), 0.25), ones, ones[:10]) == pytest.approx(52.5)
