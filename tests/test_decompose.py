"""Picture in, trees out: improving steps, the same answer every time, no more values than asked for, and sampled trees recovered."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch

from unshade.decompose import Decomposition, Result, Step, decompose, fit
from unshade.errors import PictureError, TreeError
from unshade.grammar import same_structure, sample, structure_key, validate
from unshade.metrics import psnr
from unshade.nodes import KINDS, Leaf, Node, Tree, leaf, mix, multiply, screen
from unshade.picture_output import write_picture
from unshade.pictures import Disc, SphereImage, read_sphere
from unshade.pixel_sets import CLEAN, grain
from unshade.presets import PRESETS
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals

TRUE = screen(
    multiply(leaf("albedo", color=(0.7, 0.3, 0.2)), leaf("diffuse", direction=(-0.3, 0.6, 0.7), ambient=0.3)),
    leaf("highlight", direction=(0.3, 0.5, 0.8), sharpness=40.0, amplitude=0.8),
)


def sphere(tree: Tree | Node, size: int = 128, valid: torch.Tensor | None = None) -> SphereImage:
    disc = disc_mask(size)
    image = render(tree, sphere_normals(size))
    return SphereImage(image, disc if valid is None else disc & valid, Disc(size / 2, size / 2, size / 2, 1.0))


def rounded(tree: Tree, size: int = 256) -> SphereImage:
    """The picture as a file of 8 bits holds it."""
    half = size / 2
    image = (render(tree, sphere_normals(size)) * 255.0).round() / 255.0
    return SphereImage(image, disc_mask(size), Disc(half, half, half, 1.0))


def figure(found: Tree, picture: SphereImage) -> float:
    return psnr(render(found, sphere_normals(picture.size)), picture.image, picture.valid)


@pytest.fixture(scope="module")
def lacquer(examples: Path) -> SphereImage:
    return read_sphere(examples / "red_lacquer.png")


@pytest.fixture(scope="module")
def drafted(lacquer: SphereImage) -> tuple[list[Step], Result]:
    work = decompose(lacquer, preset="draft")
    return list(work), work.result()


def test_a_photograph_at_draft(lacquer: SphereImage, drafted: tuple[list[Step], Result]) -> None:
    _, result = drafted
    assert result.psnr >= 30.0
    assert result.tree.values <= PRESETS["draft"].max_values == 30
    assert result.psnr == pytest.approx(figure(result.tree, lacquer), abs=1e-6), "the figure is that of the tree"
    assert (result.seed, result.preset) == (0, "draft")
    validate(result.tree)


def test_the_steps_of_a_draft_improve(drafted: tuple[list[Step], Result]) -> None:
    steps, result = drafted
    assert len(steps) >= 5
    assert [step.psnr for step in steps[:-1]] == sorted(step.psnr for step in steps[:-1])
    grown = [step for step in steps if step.stage == "grow"]
    assert [step.values for step in grown] == sorted(step.values for step in grown)
    assert all(step.values == step.tree.values for step in steps)
    done = [step.done for step in steps]
    assert done == sorted(done)
    assert all(step.done < step.total for step in steps[:-1])
    assert (steps[-1].tree, steps[-1].stage, steps[-1].done) == (result.tree, "done", steps[-1].total)


def test_the_family_is_a_curve(lacquer: SphereImage, drafted: tuple[list[Step], Result]) -> None:
    family = drafted[1].family
    values, figures = [member.values for member in family.members], [member.psnr for member in family.members]
    assert len(values) >= 3
    assert all(small < large for small, large in itertools.pairwise(values))
    assert all(worse < better for worse, better in itertools.pairwise(figures))
    assert family.tree == drafted[1].tree == family.members[family.chosen].tree
    assert len(values) <= PRESETS["draft"].members + 1
    for member in family.members:
        assert member.psnr == pytest.approx(figure(member.tree, lacquer), abs=1e-6)
        validate(member.tree)


@pytest.mark.parametrize("most", [3, 5, 13])
def test_no_more_values_than_asked_for(lacquer: SphereImage, most: int) -> None:
    work = decompose(lacquer, preset="draft", max_values=most)
    steps, result = list(work), work.result()
    assert all(step.values <= most for step in steps)
    assert max(member.values for member in result.family.members) <= most
    assert result.tree.values >= min(most, 10) - 2, "and nearly as many as allowed"


def test_max_values_bounds_every_stage() -> None:
    work = decompose(sphere(TRUE), preset="balanced", max_values=7)
    assert all(step.values <= 7 for step in work)
    assert work.result().tree.values <= 7


@pytest.mark.parametrize(("style", "seed", "least"), [("realistic", 2, 48.0), ("realistic", 4, 48.0), ("toon", 2, 42.0)])
def test_a_sampled_tree_is_recovered(style: str, seed: int, least: float) -> None:
    tree = sample(torch.Generator().manual_seed(seed), style, rim=False)
    picture = sphere(tree)
    result = decompose(picture).result()
    assert result.psnr >= least
    assert same_structure(result.tree, tree), structure_key(result.tree)
    assert result.tree.values <= tree.values


def test_a_bare_structure_is_fitted_to_all_lights_of_the_picture(lacquer: SphereImage) -> None:
    form = multiply(leaf("albedo"), leaf("diffuse"))
    tree = Tree(screen(form, leaf("highlight"), leaf("highlight"), leaf("highlight", name="kept", direction=(0.0, -1.0, 0.2))))
    found = fit(lacquer, tree, locked=["kept"], anew=True)
    assert found.psnr > fit(lacquer, tree, locked=["kept"]).psnr + 3.0
    assert same_structure(found.tree, tree)
    assert found.tree.find("kept") == tree.find("kept")
    first, second = (found.tree.find(f"screen.{k}") for k in (1, 2))
    assert first != second
    assert isinstance(first, Leaf) and isinstance(second, Leaf)
    assert min(first["amplitude"][0], second["amplitude"][0]) > 0.05
    assert fit(lacquer, tree, locked=["kept"], anew=True).tree == found.tree


def test_one_colour_is_one_albedo() -> None:
    color = (0.25, 0.5, 0.7)
    for preset in ("draft", "balanced"):
        result = decompose(sphere(leaf("albedo", color=color)), preset=preset).result()
        assert result.tree.root.kind == "albedo"
        assert result.tree.root["color"] == pytest.approx(color, abs=1e-4)
        assert len(result.family.members) == 1


def test_the_same_seed_gives_the_same_tree_however_the_picture_comes(tmp_path: Path) -> None:
    path = tmp_path / "sphere.png"
    write_picture(path, render(TRUE, sphere_normals(256)), disc_mask(256).float())
    read = read_sphere(path)
    first, *others = (decompose(picture, preset="draft", seed=3).result() for picture in (read, read, path, str(path)))
    for other in others:
        assert (other.tree, other.family, other.psnr) == (first.tree, first.family, first.psnr)
    assert first.seed == 3
    other = decompose(read, preset="draft", seed=4).result()
    assert other.tree != first.tree, "other points"
    assert other.psnr == pytest.approx(first.psnr, abs=6.0)


def test_a_tensor_is_a_picture_too() -> None:
    image = render(TRUE, sphere_normals(256))
    result = decompose(image, preset="draft", max_values=12).result()
    assert psnr(render(result.tree, sphere_normals(256)), image) > 40.0


def test_cancelling_gives_the_best_so_far(lacquer: SphereImage) -> None:
    work = decompose(lacquer, preset="draft")
    steps = [next(work), next(work), next(work)]
    work.cancel()
    assert list(work) == []
    result = work.result()
    assert result.tree == steps[-1].tree
    assert result.psnr == pytest.approx(max(step.psnr for step in steps), abs=1.5)
    assert result.family.tree == result.tree
    assert result == work.result()


def test_cancelling_between_the_stages_gives_the_best_so_far() -> None:
    """The search for a plain tree starts anew from one colour, which is no reason to hand that out."""
    rich = screen(
        multiply(
            mix(leaf("albedo", color=(0.7, 0.3, 0.2)), leaf("albedo", color=(0.2, 0.3, 0.6)), leaf("threshold", softness=0.8)),
            leaf("diffuse", direction=(-0.3, 0.6, 0.7), ambient=0.3),
        ),
        leaf("environment", direction=(0.3, 0.5, 0.8, -0.6, 0.2, 0.4), sharpness=(3.0, 8.0), color=(0.3, 0.5, 0.2, 0.4, 0.2, 0.6)),
    )
    picture = sphere(rich)
    work = decompose(picture, max_values=24)
    best = 0.0
    climbed = 0.0
    for step in work:
        assert step.psnr >= climbed
        climbed = step.psnr
        best = max(best, figure(step.tree, picture))
        if step.stage == "plain":
            work.cancel()
    assert work.result().tree.values <= 24
    assert figure(work.result().tree, picture) >= best - 0.5


def test_cancelling_before_the_first_step() -> None:
    work = decompose(sphere(TRUE), preset="draft")
    work.cancel()
    with pytest.raises(TreeError, match="before its first step"):
        work.result()


def test_iterating_after_the_end_goes_on_ending() -> None:
    work = decompose(sphere(TRUE, 64), preset="draft", max_values=6)
    assert isinstance(work, Decomposition)
    result = work.result()
    assert list(work) == []
    assert work.result() is result


@pytest.mark.parametrize("count", [2, 3])
def test_alternatives_have_other_structures(lacquer: SphereImage, count: int) -> None:
    result = decompose(lacquer, preset="draft", alternatives=count, max_values=16).result()
    trees = [result.tree, *(member.tree for member in result.family.alternatives)]
    assert len(trees) == count
    assert len({structure_key(tree) for tree in trees}) == len(trees)
    assert all(tree.values <= 16 for tree in trees)
    for member in result.family.alternatives:
        assert member.psnr == pytest.approx(figure(member.tree, lacquer), abs=1e-6)
        assert member.psnr > result.psnr - 6.0, "another explanation, not a bad one"


def test_what_is_ignored_does_not_matter() -> None:
    """A white sticker on the sphere is ignored; under it the tree goes on as the sphere does."""
    valid = torch.ones(1, 128, 128, dtype=torch.bool)
    valid[:, 70:95, 40:70] = False
    clean = sphere(TRUE)
    spoilt = SphereImage(torch.where(valid, clean.image, torch.ones(())), clean.valid & valid, clean.disc)
    result = decompose(spoilt, preset="draft", max_values=12).result()
    found = render(result.tree, sphere_normals(128))
    assert psnr(found, clean.image, ~valid) > 38.0
    assert psnr(found, spoilt.image) < 30.0


def test_a_tree_is_made_of_known_kinds_and_keeps_the_exposure() -> None:
    picture = sphere(TRUE)
    exposed = SphereImage(picture.image, picture.valid, picture.disc, 0.37)
    work = decompose(exposed, preset="draft", max_values=10)
    assert all(step.tree.exposure == 0.37 for step in work)
    assert all(member.tree.exposure == 0.37 for member in work.result().family.members)
    assert all(node.kind in KINDS for _, node in work.result().tree.walk() if not hasattr(node, "children"))


# What cannot be done is said at once


def test_unknown_preset() -> None:
    with pytest.raises(TreeError, match=r"unknown preset 'balancd'; did you mean 'balanced'\?"):
        decompose(sphere(TRUE, 32), preset="balancd")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_values": 2}, "max_values must be at least 3.*got 2"),
        ({"alternatives": 0}, "alternatives must be at least 1, got 0"),
        ({"search": "width"}, "search must be size or depth, got 'width'"),
    ],
)
def test_options_out_of_range(options: dict, message: str) -> None:
    with pytest.raises(TreeError, match=message):
        decompose(sphere(TRUE, 32), **options)


def test_too_few_pixels_count() -> None:
    valid = torch.zeros(1, 64, 64, dtype=torch.bool)
    valid[:, 30:33, 30:35] = True
    with pytest.raises(PictureError, match="only 15 pixels of the sphere count; at least 16"):
        decompose(sphere(TRUE, 64, valid))
    valid[:, 29, 30] = True
    assert decompose(sphere(TRUE, 64, valid), preset="draft").result().tree.values >= 3


def test_no_picture(tmp_path: Path) -> None:
    with pytest.raises(PictureError, match=r"nothing\.png"):
        decompose(tmp_path / "nothing.png")
    with pytest.raises(PictureError, match="expected finite numbers"):
        decompose(torch.full((3, 64, 64), float("nan")))


@pytest.mark.parametrize("number", [3, 16])
def test_a_sampled_environment_is_found_as_one(number: int) -> None:
    truth = sample(torch.Generator().manual_seed(7_000_003 + number), "realistic", environment=True)
    found = decompose(rounded(truth)).result()
    assert found.psnr >= 50.0
    assert same_structure(found.tree, truth)


def test_grain_tells_renderings_from_photographs(lacquer: SphereImage) -> None:
    edged = rounded(sample(torch.Generator().manual_seed(3), "toon"))
    noise = 0.5 / 255.0 * torch.randn(edged.image.shape, generator=torch.Generator().manual_seed(0))
    noisy = ((edged.image + noise).clamp(0.0, 1.0) * 255.0).round() / 255.0
    assert grain(edged.image, edged.valid) < CLEAN < min(grain(noisy, edged.valid), grain(lacquer.image, lacquer.valid))
    assert grain(edged.image, torch.zeros_like(edged.valid)) == 0.0
