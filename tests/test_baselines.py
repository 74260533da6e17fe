"""The baselines: trees survive as tokens, losses fall, a killed run ends as one that was not, and what is decoded is a tree."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from torch import nn

from unshade import baselines, train
from unshade.baseline_data import TreeBatches, with_lights
from unshade.cli import run as command
from unshade.errors import MissingWeightsError, TreeError, UnshadeError
from unshade.grammar import same_structure, validate
from unshade.metrics import psnr
from unshade.models import weights
from unshade.models.config import BASELINES, CONFIGS, Config, TrainingConfig, find
from unshade.models.token_model import TokenModel
from unshade.models.tokens import LONGEST, VOCABULARY, Cursor, slots_of, token_of, tokens_of, tree_of
from unshade.nodes import Tree, leaf, multiply, screen
from unshade.pictures import Disc, SphereImage
from unshade.render import render
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.synthesis import Style, trees
from unshade.train import Run


def config(steps: int, batch: int = 4) -> Config:
    tiny = find("tiny")
    return dataclasses.replace(tiny, training={name: TrainingConfig(steps, batch, 3e-3, warmup=3) for name in tiny.training})


def finish(run: Run) -> list[train.Progress]:
    return [progress for progress in train.train(run) if progress.figures]


@pytest.fixture(scope="module", autouse=True)
def _few_evaluated() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "EVALUATED", 1)
        patch.setattr(train, "EVALUATED_LAST", 1)
        patch.setattr(train, "EVALUATION_BATCH", 4)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list[train.Progress]]]:
    folder = tmp_path_factory.mktemp("baselines")
    return folder / "weights", {name: finish(Run(name, config(40, 8), folder, report_every=8, evaluate_every=1000)) for name in BASELINES}


def picture(tree: Tree, size: int = 64) -> SphereImage:
    return SphereImage(render(tree, sphere_normals(size)), disc_mask(size), Disc(size / 2, size / 2, size / 2, 1.0))


BALL = Tree(screen(multiply(leaf("albedo", color=(0.8, 0.3, 0.2)), leaf("diffuse", ambient=0.3)), leaf("highlight", sharpness=50)))


@pytest.mark.parametrize("style", ["realistic", "toon"])
def test_trees_survive_as_tokens(style: Style) -> None:
    normals = sphere_normals(64)
    for tree in islice(trees(style, "test", seed=1), 12):
        lit = with_lights(tree)
        tokens = tokens_of(lit)
        again = tree_of(tokens)
        assert tokens_of(again) == tokens
        assert len(slots_of(tokens)) == len(tokens) <= LONGEST
        if lit == tree:
            assert same_structure(again, tree)
            assert psnr(render(again, normals), render(tree, normals)) > 24.0
        else:
            assert psnr(render(lit, normals), render(tree, normals)) > 14.0
        validate(again)


def test_what_has_no_tokens_is_said() -> None:
    tree = next(tree for tree in trees("realistic", "test", seed=1) if any(node.kind == "environment_map" for _, node in tree.walk()))
    with pytest.raises(TreeError, match="environment_map: has no tokens"):
        tokens_of(tree)
    with pytest.raises(TreeError, match="not whole after 1 tokens: expected node"):
        tree_of([token_of("screen")])
    with pytest.raises(TreeError, match="token 0: expected node"):
        tree_of([VOCABULARY - 1])


def test_any_allowed_tokens_make_a_tree(generator: torch.Generator) -> None:
    """Even those that open as many operators as they may."""
    for greed in (1.0, 0.5, 0.0):
        cursor = Cursor()
        while not cursor.done:
            fits = cursor.allowed()
            operators = fits.clone()
            operators[4:] = False
            chosen = operators if operators.any() and float(torch.rand(1, generator=generator)) < greed else fits
            cursor.push(int(torch.multinomial(chosen.float(), 1, generator=generator)))
        assert len(cursor.tokens) <= LONGEST
        validate(tree_of(cursor.tokens))


def test_batches_depend_on_their_number_alone() -> None:
    batches = TreeBatches("toon", "train", 16, 5, 3)
    whole = list(islice(batches.stream(), 8))
    again = next(batches.stream(start=7))
    assert all(torch.equal(getattr(whole[7], name), getattr(again, name)) for name in ("images", "tokens", "slots"))
    drawn = [tokens_of(tree) for tree in islice(trees("toon", "train", seed=3), 5)]
    assert [[token for token in row if token] for row in whole[0].tokens.tolist()] == drawn


@pytest.mark.parametrize("name", BASELINES)
def test_the_loss_falls(name: str, trained: tuple[Path, dict[str, list[train.Progress]]]) -> None:
    losses = [progress.loss for progress in trained[1][name]]
    # Of a number's softened target some 2 nats can never be foretold.
    assert losses[-1] < 0.92 * losses[0]
    assert {key.partition("_")[0] for key in trained[1][name][-1].test} == {"realistic", "toon"}


@pytest.mark.parametrize("name", BASELINES)
def test_resume_equals_no_interruption(name: str, tmp_path: Path) -> None:
    whole, cut = (Run(name, config(4), tmp_path / where, report_every=1, evaluate_every=2) for where in ("whole", "cut"))
    finish(whole)
    for progress in train.train(cut):
        if progress.step == 3:
            break
    assert [progress.step for progress in train.train(cut)] == [2, 3, 4]
    logs = [[json.loads(line) for line in (run.folder / name / "log.jsonl").read_text().splitlines()] for run in (whole, cut)]
    assert logs[0] == logs[1]
    first, second = (safetensors.torch.load_file(run.state) for run in (whole, cut))
    assert all(torch.equal(first[key], second[key]) for key in first | second)


@pytest.mark.parametrize("name", BASELINES)
def test_a_picture_becomes_a_tree(name: str, trained: tuple[Path, dict[str, list[train.Progress]]]) -> None:
    baseline = baselines.Baseline.load(name, trained[0])
    tree = baseline.tree(picture(BALL))
    validate(tree)
    assert tree.leaves >= 1
    assert baseline.tree(picture(BALL)) == tree
    if name == "cnn":
        assert max(address.count(".") for address, _ in tree.walk()) <= 2 * baselines.DEPTH + 1


@pytest.mark.parametrize("name", ["lstm", "transformer"])
def test_one_token_at_a_time_is_the_same(name: str) -> None:
    """With the state that it keeps, a model writes what it would with all tokens before it."""
    torch.manual_seed(1)
    model = weights.BASELINES[name](find("tiny")).eval()
    assert isinstance(model, TokenModel)
    images = torch.rand(2, 3, 16, 16)
    tokens = torch.tensor([tokens_of(BALL)] * 2)
    slots = torch.tensor([slots_of(tokens_of(BALL))] * 2)
    before = torch.nn.functional.pad(tokens[:, :-1], (1, 0))
    with torch.no_grad():
        expected = model.logits(images, before, slots)
        state = model.begin(images)
        for k in range(tokens.shape[1]):
            found, state = model.step(before[:, k], slots[:, k], state)
            assert torch.allclose(found, expected[:, k], atol=1e-4)


@pytest.mark.parametrize("name", ["small", "paper"])
def test_all_are_about_as_large_as_the_learned_method(name: str) -> None:
    def size(models: Any) -> list[int]:
        with torch.device("meta"):
            built: list[nn.Module] = [make(CONFIGS[name]) for make in models.values()]
        return [sum(parameter.numel() for parameter in model.parameters()) for model in built]

    learned = sum(size(weights.MODELS))
    assert all(0.9 < one / learned < 1.1 for one in size(weights.BASELINES))


@pytest.mark.parametrize("name", [*weights.BASELINES])
def test_the_trained_baselines_see_something(name: str) -> None:
    """Of paint with form more than the best single colour, the mean over the scored disc, would show."""
    baseline, normals = baselines.Baseline.load(name), sphere_normals(64)
    gains = []
    for color, kind, direction in (
        ((0.8, 0.3, 0.2), "diffuse", (0.3, 0.5, 0.8)),
        ((0.2, 0.3, 0.8), "diffuse", (-0.6, 0.5, 0.5)),
        ((0.2, 0.6, 0.3), "toon_diffuse", (-0.6, 0.5, 0.5)),
    ):
        seen = picture(Tree(multiply(leaf("albedo", color=color), leaf(kind, direction=direction))))
        mean = seen.image[:, disc_mask(64, SCORED_RADIUS)[0]].mean(1)
        one_color = mean[:, None, None].expand_as(seen.image)
        gains.append(psnr(render(baseline.tree(seen), normals), seen.image) - psnr(one_color, seen.image))
    assert sum(gains) / len(gains) > 1.5, gains


def test_the_configuration_is_that_of_the_weights() -> None:
    """`unshade train` with `small` trains as those that ship were trained, the baselines included."""
    small = find("small")
    for name in (*weights.MODELS, *weights.SEARCH, *weights.BASELINES):
        loaded = weights.load(name)
        assert loaded.config.training[name] == small.training[name], name
        assert dataclasses.replace(loaded.config, training=small.training) == small, name
        assert loaded.card["steps"] == small.training[name].steps


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(UnshadeError, match="did you mean 'lstm'"):
        baselines.Baseline.load("lstn")
    with pytest.raises(MissingWeightsError, match="unshade train baseline lstm"):
        baselines.Baseline.load("lstm", tmp_path)
    assert command(["train", "vqvae", "lstm", "-o", str(tmp_path)]) == 2
    assert not list(tmp_path.iterdir())


def test_the_command_trains_a_baseline(tmp_path: Path) -> None:
    assert (
        command(["train", "baseline", "transformer", "--config", "tiny", "--steps", "1", "--rate", "0.01", "-q", "-o", str(tmp_path)]) == 0
    )
    assert weights.file_of("transformer", tmp_path / "weights").is_file()
    assert not weights.file_of("cnn", tmp_path / "weights").is_file()
