"""The network that tells what a picture reflects: what it is given to learn, that it learns it, and its weights."""

from __future__ import annotations

import dataclasses
import json
import random
from itertools import islice
from pathlib import Path

import pytest
import torch

from unshade import environments, made_environments, reflection_data
from unshade.blend import screen
from unshade.errors import MissingWeightsError, TreeError
from unshade.forest import CODES, Forest, Outline, grow
from unshade.model_card import page
from unshade.models import weights
from unshade.models.config import CONFIGS, Config, ConfigError, ReflectionConfig, find
from unshade.models.reflection import DARKEST, ReflectionNet, without
from unshade.reflection_data import ReflectionBatch, ReflectionBatches, rendered
from unshade.reflection_task import ReflectionTask
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals
from unshade.synthesis import Style

TINY = find("tiny")
ROUNDING = 0.5 / 255.0 + 1e-6


def batches(count: int, split: str = "train", *, style: Style = "realistic", size: int = 16, start: int = 0, workers: int = 0):  # type: ignore[no-untyped-def]
    return list(islice(ReflectionBatches(style, split, size, 8, 3).stream(start=start, workers=workers), count))


@pytest.fixture(scope="module")
def drawn() -> list[ReflectionBatch]:
    """Ten batches of the training half, the last two with other environments than those before."""
    return batches(10)


@pytest.mark.parametrize("name", ["small", "tiny"])
def test_the_two_pictures_make_the_one(name: str) -> None:
    config = find(name)
    pictures = torch.rand(2, 3, config.size, config.size)
    with torch.no_grad():
        environment, plain = ReflectionNet(config)(pictures)
    assert environment.shape == plain.shape == pictures.shape
    assert environment.dtype == plain.dtype == torch.float32
    assert float(environment.min()) >= 0.0 <= float(plain.min())
    assert bool((environment <= pictures).all())
    assert torch.allclose(screen(environment, plain), pictures, atol=1e-6)


def test_under_the_brightest_environments_the_plain_picture_stays_in_range() -> None:
    pictures = torch.linspace(0.9, 1.0, 401).expand(1, 3, 1, -1)
    for share in (0.0, 0.9, 0.999, 1.0):
        environment = share * pictures
        plain = without(pictures, environment)
        assert 0.0 <= float(plain.min()) <= float(plain.max()) <= 1.0
        assert float((screen(environment, plain) - pictures).abs().max()) <= DARKEST


def test_it_sees_the_whole_picture_and_where_it_is() -> None:
    """Every part of the answer may depend on every pixel, and a picture of one colour is not of one environment."""
    torch.manual_seed(0)
    net = ReflectionNet(find("small"))
    grey = torch.full((1, 3, 64, 64), 0.5, requires_grad=True)
    environment, _ = net(grey)
    environment[0, :, 0, 0].sum().backward()  # type: ignore[no-untyped-call]
    assert grey.grad is not None
    assert bool((grey.grad[0, :, -8:, -8:] != 0.0).any())
    assert float(environment.detach().std()) > 1e-4


def test_sizes_of_every_configuration_fit() -> None:
    for config in CONFIGS.values():
        levels = config.reflection.channels
        assert len(levels) == len(config.reflection.blocks)
        assert config.size % (2 << (len(levels) - 1)) == 0
        assert all(channels % 8 == 0 for channels in levels)


def test_pictures_are_plain_ones_under_their_environments(drawn: list[ReflectionBatch]) -> None:
    for batch in drawn:
        assert torch.equal((batch.pictures * 255.0).round() / 255.0, batch.pictures)
        visible = batch.environments.amax(1, keepdim=True) < 0.9
        plain = batch.plain * visible
        # Rounding by half a step is as much more of the plain picture as the environment covers.
        slack = ROUNDING / (1.0 - batch.environments * visible)
        assert bool((plain >= -slack).all() and (plain <= 1.0 + slack).all())
        assert torch.allclose(screen(batch.plain, batch.environments) * visible, batch.pictures * visible, atol=1e-5)
        assert float((batch.pictures * ~disc_mask(16)).max()) == 0.0 == float((batch.environments * ~disc_mask(16)).max())
    reflects = torch.cat([batch.environments.amax((1, 2, 3)) > 0.0 for batch in drawn]).float().mean()
    assert 0.7 < float(reflects) < 0.97


def test_an_environment_is_the_leaf_of_its_tree() -> None:
    """As the renderer shows the tree and its leaf, one tree at a time."""
    structures = [("screen", "environment", ("multiply", "albedo", "diffuse")), ("multiply", "albedo", "diffuse")]
    grown = grow([Outline.of(structure) for structure in structures], "test", torch.Generator().manual_seed(1))
    found, normals, disc = rendered(Forest(grown), 32), sphere_normals(32), disc_mask(32)
    for row, plant in enumerate(grown):
        tree = plant.tree()
        assert torch.allclose(found.pictures[row], render(tree, normals) * disc, atol=ROUNDING)
        leaves = [node for node in tree.root.children if node.kind == "environment_map"]  # type: ignore[union-attr]
        assert len(leaves) == 1 - row
        shown = render(dataclasses.replace(tree, root=leaves[0]), normals) * disc if leaves else torch.zeros(3, 32, 32)
        assert torch.allclose(found.environments[row], shown, atol=1e-5)


def test_a_batch_depends_on_its_number_alone(drawn: list[ReflectionBatch]) -> None:
    """Neither on where the stream began nor on the workers."""
    reflection_data._panoramas.cache_clear()
    later = batches(2, start=7)
    prepared = batches(2, start=7, workers=1)
    for one, two, three in zip(drawn[7:9], later, prepared, strict=True):
        assert torch.equal(one.pictures, two.pictures) and torch.equal(one.environments, two.environments)
        assert torch.equal(one.pictures, three.pictures) and torch.equal(one.environments, three.environments)
    assert not torch.equal(drawn[7].pictures, drawn[8].pictures)


def test_the_test_half_has_its_own_environments_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[set[str]] = []
    original = Forest.__init__

    def watched(self, plants, device="cpu", panoramas=None) -> None:  # type: ignore[no-untyped-def]
        original(self, plants, device, panoramas)
        assert panoramas is not None
        assert all(shown is environments.panoramas(split) for split, shown in panoramas.items())
        seen.append(set(panoramas))

    monkeypatch.setattr(Forest, "__init__", watched)
    batches(9, "test")
    assert seen and all(splits == {"test"} for splits in seen)


def test_drawings_reflect_nothing() -> None:
    batch = batches(1, "test", style="toon")[0]
    assert float(batch.environments.max()) == 0.0
    assert torch.equal(batch.plain, batch.pictures)
    both = batches(1, "test", style="both")[0]
    assert torch.equal(both.pictures, batches(1, "test")[0].pictures)


def test_unknown_words_are_named() -> None:
    with pytest.raises(TreeError, match="unknown split 'tets'"):
        batches(1, "tets")


def test_made_environments_are_many_and_repeatable() -> None:
    first, again, other = (made_environments.panoramas(seed) for seed in (5, 5, 6))
    assert first.shape == environments.panoramas("train").shape
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert float(first.min()) >= 0.0 and float(first.max()) <= 1.0
    # None is flat, none black: every leaf of a tree must show.
    assert float(first.flatten(1).std(1).min()) > 0.005
    assert float(first.flatten(1).mean(1).min()) > 0.01
    # Four exposures of one environment follow each other.
    means = first.flatten(1).mean(1).unflatten(0, (-1, len(environments.EXPOSURES)))
    assert bool((means.diff(dim=1) > 0.0).all())


def test_a_made_environment_has_no_seam_and_mean_1() -> None:
    choices, generator = random.Random(2), torch.Generator().manual_seed(2)
    for _ in range(8):
        light = made_environments.made_up(choices, generator)
        assert light.shape == (3, 64, 128)
        assert float(light.mean()) == pytest.approx(1.0, abs=1e-4)
        across = light.clamp(max=4.0).diff(dim=-1).abs().mean()
        seam = (light[..., 0].clamp(max=4.0) - light[..., -1].clamp(max=4.0)).abs().mean()
        assert float(seam) < 6.0 * float(across)


def test_a_batch_is_learned_by_heart(drawn: list[ReflectionBatch]) -> None:
    task = ReflectionTask(TINY, Path(), torch.device("cpu"))
    torch.manual_seed(0)
    model, batch = task.build(), drawn[0]
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    losses = []
    for _ in range(80):
        loss = task.outcome(model, batch).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]


class _Exact(torch.nn.Module):
    """Knows a batch."""

    def __init__(self, batch: ReflectionBatch, error: float = 0.0) -> None:
        super().__init__()
        self.batch, self.error = batch, error

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        assert pictures.shape[1:] == self.batch.pictures.shape[1:]
        rows = len(pictures)
        return self.batch.environments[:rows] + self.error, self.batch.plain[:rows] + self.error


def test_figures_are_of_what_they_say(drawn: list[ReflectionBatch]) -> None:
    task, batch = ReflectionTask(TINY, Path(), torch.device("cpu")), drawn[0]
    reflects = batch.environments.amax((1, 2, 3)) > 0.0
    assert 0 < int(reflects.sum()) < len(batch)
    assert task.evaluate(_Exact(batch), [batch]) == pytest.approx(
        {"environment_psnr": 100.0, "plain_psnr": 100.0, "untouched_psnr": 100.0}, abs=1e-3
    )
    off = task.evaluate(_Exact(batch, 0.1), [batch])
    assert off == pytest.approx({"environment_psnr": 20.0, "plain_psnr": 20.0, "untouched_psnr": 20.0}, abs=1e-3)
    shown = task.pictures(_Exact(batch), batch)
    assert shown.shape == (3, 5 * 16, 8 * 16)
    assert torch.equal(shown[:, 16:32], shown[:, 32:48])
    plain = batches(1, "test", style="toon")[0]
    assert task.evaluate(_Exact(plain), [plain]) == pytest.approx({"untouched_psnr": 100.0})


def test_weights_come_back(tmp_path: Path) -> None:
    torch.manual_seed(1)
    model = ReflectionNet(TINY).eval()
    path = weights.file_of("reflection", tmp_path)
    figures = {"realistic_plain_psnr": 21.5, "toon_untouched_psnr": 60.0}
    card = {"config": "tiny", "data": "unshade.reflection_data", "steps": 3, "of": 3, "examples": 12, "hours": 0.1, "hardware": "a CPU"}
    weights.save(path, "reflection", model, TINY, {**card, "precision": "float32", "torch": "2", "figures": figures})
    loaded = weights.load("reflection", tmp_path)
    assert loaded.config == TINY
    pictures = torch.rand(1, 3, 16, 16)
    with torch.no_grad():
        assert torch.allclose(loaded.model(pictures)[1], model(pictures)[1], atol=2e-3)
    text = page(tmp_path)
    assert "## Reflection" in text and "| PSNR of pictures without their environment, dB | 21.5 | – |" in text


def test_the_learned_method_does_not_wait_for_it(tmp_path: Path) -> None:
    assert "reflection" not in weights.MODELS
    with pytest.raises(MissingWeightsError, match=r"reflection.*unshade train reflection"):
        weights.load("reflection", tmp_path)


def test_configurations_from_before_still_load() -> None:
    text = json.loads(find("small").to_json())
    assert Config.from_json(json.dumps(text)) == find("small")
    del text["reflection"]
    assert Config.from_json(json.dumps(text)).reflection == ReflectionConfig()
    with pytest.raises(ConfigError, match="expected the JSON"):
        Config.from_json(json.dumps({**text, "reflection": {"channels": 3}}))


def test_every_tree_with_an_environment_has_one() -> None:
    """What `rendered` rests on."""
    choices = random.Random(0)
    kinds = [Outline.of(reflection_data._structure("realistic", choices)).kinds.tolist() for _ in range(200)]
    counts = {row.count(CODES.index("environment_map")) for row in kinds}
    assert counts == {0, 1}
