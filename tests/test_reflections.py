"""What is beneath a reflected environment: drawn edges, the tree that the bends of a picture tell, and the environment as a raster."""

from __future__ import annotations

import dataclasses
import json
from functools import lru_cache
from itertools import islice
from pathlib import Path

import pytest
import torch

from unshade import metrics, reflections
from unshade.analogy import analogy
from unshade.batch import stages_words
from unshade.circles import edge_circles, edge_masks, edges_left
from unshade.cli import run as run_command
from unshade.components import Component
from unshade.decompose import Result, decompose
from unshade.edit import transfer
from unshade.environments import blurred, raster
from unshade.errors import MissingWeightsError, TreeError, UnshadeError
from unshade.experiments import methods, subjects
from unshade.grammar import same_structure
from unshade.inference import Inference
from unshade.learned import Settings
from unshade.models import weights
from unshade.models.config import find
from unshade.models.reflection import ReflectionNet
from unshade.nodes import Leaf, Node, Operator, Raster, Tree, leaf, mix, multiply, replace, screen, walk
from unshade.nodes import find as node_at
from unshade.pictures import write_picture
from unshade.render import render
from unshade.separation import Separation
from unshade.serde import parse
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.synthesis import trees
from unshade.threads import threads
from unshade.types import Image

DISC, SCORED = disc_mask(256), disc_mask(256, SCORED_RADIUS)
NORMALS = sphere_normals(256)

COAT = Leaf("environment_map", (raster("test", 5), (0.0, 0.7, 0.0)))
BENEATH = (
    "screen(multiply(mix(albedo(#c04030), albedo(#308040), stripe(right up, 0.1, 0.4)), diffuse(left up front, 0.3)), "
    "highlight(right up front, 40, 1.2), rim(left))"
)


def shown(root: Node | Tree) -> Image:
    return (render(root, NORMALS) * 255.0).round() / 255.0


def under(coat: Leaf, text: str = BENEATH) -> Node:
    return Operator("screen", (*parse(text).root.children, coat))  # type: ignore[union-attr]


def environment_of(root: Node) -> Leaf:
    return next(node for _, node in walk(root) if isinstance(node, Leaf) and node.kind == "environment_map")


@lru_cache(maxsize=1)
def found() -> Result:
    """With the weights that ship."""
    return decompose(shown(under(COAT)), reflections="picture").result()


@pytest.mark.parametrize(
    "masks",
    [
        (),
        ("threshold(left up front, 0.3)",),
        ("stripe(right up, 0.1, 0.4)",),
        ("stripe(right up, 0.1, 0.4)", "stripe(left up front, 0.1, 0.7)"),
        ("threshold(down, -0.1)", "stripe(left front, 0.1, 0.6)"),
    ],
)
def test_edges_of_masks_are_found_beneath_a_reflection(masks: tuple[str, ...]) -> None:
    paint: Node = leaf("albedo", color=(0.7, 0.3, 0.2))
    wanted = [parse(f"mix(albedo(#fff), albedo(#000), {mask})").root.mask for mask in masks]  # type: ignore[union-attr]
    for mask, color in zip(wanted, ((0.2, 0.4, 0.6), (0.6, 0.6, 0.1)), strict=False):
        assert mask is not None
        paint = mix(paint, leaf("albedo", color=color), mask)
    base = multiply(paint, leaf("diffuse", direction=(-0.5, 0.5, 0.7), ambient=0.4))
    masks_found = edge_masks(shown(screen(base, COAT)), DISC)
    # A mask and its complement have one edge, and hardly differ where it is found.
    pictures = [(render(mask, NORMALS)[0] > 0.5)[SCORED[0]] for mask in masks_found]
    assert len(masks_found) == len(wanted) and {mask.kind for mask in masks_found} == {mask.kind for mask in wanted if mask}
    for mask in wanted:
        assert mask is not None
        true = (render(mask, NORMALS)[0] > 0.5)[SCORED[0]]
        assert min(min(float((true != one).float().mean()), float((true == one).float().mean())) for one in pictures) < 0.004


def pair(first: str, second: str) -> Node:
    """Two paints across a third, a photograph on top."""
    masks = [parse(f"mix(albedo(#fff), albedo(#000), {mask})").root.mask for mask in (first, second)]  # type: ignore[union-attr]
    one, two, three = (leaf("albedo", color=color) for color in ((0.7, 0.3, 0.2), (0.2, 0.4, 0.6), (0.6, 0.6, 0.1)))
    assert masks[0] is not None and masks[1] is not None
    paint = mix(mix(one, two, masks[0]), three, masks[1])
    return screen(multiply(paint, leaf("diffuse", direction=(-0.5, 0.5, 0.7), ambient=0.4)), COAT)


def masks_right(picture: Image, *wanted: str) -> bool:
    """Are just these found?"""
    masks = [parse(f"mix(albedo(#fff), albedo(#000), {text})").root.mask for text in wanted]  # type: ignore[union-attr]
    inside = disc_mask(256, SCORED_RADIUS)[0]
    true = [(render(mask, NORMALS)[0] > 0.5)[inside] for mask in masks if mask is not None]
    ours = [(render(mask, NORMALS)[0] > 0.5)[inside] for mask in edge_masks(picture, disc_mask(picture.shape[-1]))]

    def near(a: torch.Tensor, b: torch.Tensor) -> bool:
        return min(float((a != b).float().mean()), float((a == b).float().mean())) < 1.5 / picture.shape[-1]

    return len(ours) == len(true) and all(any(near(one, mask) for one in ours) for mask in true)


def test_two_stripes_across_each_other() -> None:
    """Four circles, parallel in pairs; planes of one tilt are not taken for each other."""
    first, second = "stripe(up front, 0.4, 0.4)", "stripe(left, 0.5, 0.6)"
    assert masks_right(shown(pair(first, second)), first, second)


@pytest.mark.parametrize("size", [128, 512, 1024, "smooth"])
def test_edges_are_found_at_every_size(size: int | str) -> None:
    """Also where each pixel is the mean of many, as programs draw."""
    stripe = "stripe(right up, 0.1, 0.4)"
    root = under(COAT, f"screen(multiply(mix(albedo(#c04030), albedo(#308040), {stripe}), diffuse(left up front, 0.3)), rim(left))")
    if isinstance(size, int):
        picture = render(root, sphere_normals(size))
    else:
        picture = torch.nn.functional.avg_pool2d(render(root, sphere_normals(1024)), 4)
    assert masks_right((picture * 255.0).round() / 255.0, stripe)


def test_what_is_left_of_edges() -> None:
    picture, bare = shown(pair("stripe(up front, 0.4, 0.4)", "stripe(left, 0.5, 0.6)")), shown(COAT)
    circles = edge_circles(picture, DISC)
    assert edges_left(circles, picture, picture) == 1.0
    assert edges_left(circles, picture, bare) < 0.3
    assert edges_left([], picture, bare) == 0.0


def test_a_drawing_reflects_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The network takes some for photographs; what is left for the environment then still has the drawing's edges."""
    sphere = subjects.known(next(islice(trees("toon", "test", seed=77), 3, None))).sphere
    network = reflections.load()
    assert reflections.beneath(sphere.image, DISC, network)[1] > reflections.SHOWS

    def uncovered() -> list[Node | None]:
        return list(filter(None, reflections.uncover(sphere, leaf("albedo"), network, 0)))

    assert uncovered() == []
    monkeypatch.setattr(reflections, "DRAWN", 2.0)
    assert len(uncovered()) == 1


def test_uncovering_can_be_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reflections, "panorama", None)
    work = decompose(shown(under(COAT)), preset="draft", reflections="picture")
    told = 0
    for step in work:
        told += step.stage == "reflections"
        if told == 3:
            work.cancel()
    assert told == 3 and work.result().tree.values <= 30


def test_environments_do_not_depend_on_cores() -> None:
    light = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    with threads(1):
        once = blurred(light, 60.0)
    with threads(2):
        assert torch.equal(blurred(light, 60.0), once)


def test_no_edges_where_there_are_none() -> None:
    noise = torch.rand(3, 256, 256, generator=torch.Generator().manual_seed(0))
    assert edge_circles(noise, DISC) == []
    assert edge_circles(shown(parse("multiply(albedo(#a06040), diffuse(up, 0.2))")), DISC) == []
    assert edge_circles(torch.zeros(3, 256, 256), DISC) == []
    assert edge_circles(shown(under(COAT)), DISC & False) == []


@pytest.mark.parametrize("height", [32, 64])
def test_a_panorama_is_read_off_a_mirror_ball(height: int) -> None:
    mirror = shown(COAT)
    read = reflections.panorama(mirror, DISC.expand(3, -1, -1).float(), height)
    assert read.shape == (3, height, 2 * height)
    again = leaf("environment_map", pixels=Raster.from_array(read))
    assert metrics.psnr(shown(again), mirror, SCORED) > (38.0 if height == 32 else 48.0)


def test_a_panorama_fills_in_what_is_not_seen() -> None:
    weight = DISC.expand(3, -1, -1).float().clone()
    weight[:, 100:140, 100:140] = 0.0
    read = reflections.panorama(torch.where(weight > 0.0, 0.4, 1.0) * DISC, weight)
    assert float((read - 0.4).abs().max()) < 0.02


def test_bends_tell_two_paints_and_their_light() -> None:
    """From numbers that are wrong, with a guess of the picture beneath that is too dark."""
    true, picture = parse(BENEATH).root, shown(under(COAT))
    start = replace(true, "screen.0.multiply.1.diffuse", node_at(true, "screen.0.multiply.1.diffuse").set(direction=(-0.3, 0.7, 0.6)))  # type: ignore[union-attr]
    for place, color in (("0.albedo", (0.6, 0.35, 0.3)), ("1.albedo", (0.3, 0.4, 0.35))):
        address = f"screen.0.multiply.0.mix.{place}"
        start = replace(start, address, leaf("albedo", color=color))
    guess = 0.8 * shown(true)
    separation = Separation(picture, DISC, guess, 0)
    fitted = separation.fit(start, 60, 1e-6)
    before, guessed, after = (metrics.psnr(image, shown(true), SCORED) for image in (shown(start), guess, shown(fitted.root)))
    assert after > max(before, guessed) + 2.0
    assert fitted.cost < separation.fit(start, 0).cost
    assert same_structure(Tree(fitted.root), Tree(true))


def test_lights_that_do_not_pay_are_left_out() -> None:
    true, picture = parse(BENEATH).root, shown(under(COAT))
    separation = Separation(picture, DISC, shown(true), 0)
    more = dataclasses.replace(true, children=(*true.children, leaf("highlight", direction=(-0.5, -0.5, 0.7), sharpness=60.0)))  # type: ignore[type-var,union-attr]
    assert same_structure(Tree(separation.prune(separation.fit(more, 10)).root), Tree(true))
    fewer = replace(true, "screen.1.highlight", None)
    assert same_structure(Tree(separation.grow(separation.fit(fewer, 10)).root), Tree(true))


def test_paint_and_form_are_never_left_out() -> None:
    """Not even where the light alone would be the cheaper tree."""
    lit = parse("screen(multiply(albedo(#a06040), diffuse(up, 0.3)), highlight(right front, 60, 1.2))").root
    separation = Separation(shown(COAT), DISC, torch.zeros(3, 256, 256), 0)
    current = separation.fit(lit, 2)
    light = node_at(lit, "screen.1.highlight")
    assert light is not None and separation.fit(light, 2).cost < current.cost
    kinds = [node.kind for _, node in walk(separation.prune(current).root)]
    assert kinds.count("albedo") == 1 and kinds.count("diffuse") == 1


def test_a_reflection_is_held_as_a_picture() -> None:
    result, picture = found(), shown(under(COAT))
    root = result.tree.root
    assert metrics.psnr(shown(root), picture, SCORED) > 44.0
    beneath = transfer(parse(BENEATH), result.tree, Component.ENVIRONMENT)
    assert same_structure(beneath, parse(BENEATH))
    assert metrics.psnr(shown(beneath), shown(parse(BENEATH)), SCORED) > 26.0
    assert metrics.psnr(shown(environment_of(root)), shown(COAT), SCORED) > 22.0
    # The tree of lights stays in the family, one size below.
    lights, chosen = result.family.members[-2:]
    assert chosen.tree == result.tree and chosen.psnr > lights.psnr
    assert lights.values <= 64 < chosen.values


def test_a_tree_in_the_place_of_the_networks_is_told() -> None:
    few = Settings(Inference(samples=1, draws=1, trees=1))
    result = decompose(shown(under(COAT)), method="hybrid", preset="draft", reflections="picture", settings=few).result()
    assert result.stages is not None and result.stages["uncovered"] and result.tree.values > 24_576
    assert "beneath a reflection" in stages_words(result.stages)


def test_what_reflects_nothing_stays_as_it_is() -> None:
    plain = shown(parse(BENEATH))
    assert decompose(plain, reflections="picture").result().tree == decompose(plain).result().tree
    network = reflections.load()
    with torch.inference_mode():
        assert reflections.beneath(plain, DISC, network)[1] < reflections.SHOWS
        assert reflections.beneath(shown(under(COAT)), DISC, network)[1] > reflections.SHOWS


def test_pictures_with_grain_stay_as_they_are() -> None:
    grain = 0.02 * torch.randn(3, 256, 256, generator=torch.Generator().manual_seed(1))
    picture = (shown(under(COAT)) + grain).clamp(0.0, 1.0)
    result = decompose(picture, preset="draft", reflections="picture").result()
    assert result.tree.values <= 30


def test_pictures_that_tell_nothing() -> None:
    """White, or nearly all of it ignored: no place to look at, and no failure."""
    for picture in (torch.ones(3, 256, 256), 0.98 + 0.01 * shown(under(COAT))):
        separation = Separation(picture, DISC, picture, 0)
        assert separation.pixels.count == 0
        assert decompose(picture, preset="draft", reflections="picture").result().tree.values <= 30


def test_an_environment_moves_in_an_analogy() -> None:
    other = "screen(multiply(albedo(#3060a0), diffuse(right front, 0.4)), highlight(left front, 30, 1.2))"
    p, q = parse(other), Tree(under(COAT))
    a, b = parse("multiply(albedo(#808080), diffuse(up front, 0.3))"), Tree(screen(leaf("albedo", color=(0.5, 0.1, 0.1)), COAT))
    ab = transfer(b, a, Component.ENVIRONMENT)
    answer = analogy(a, b, shown(ab), p, found().tree)
    assert answer.component is Component.ENVIRONMENT
    wanted = transfer(q, p, Component.ENVIRONMENT)
    assert metrics.psnr(shown(answer.tree), shown(wanted), SCORED) > 24.0


def test_refusals(tmp_path: Path) -> None:
    picture = shown(under(COAT))
    with pytest.raises(MissingWeightsError, match="unshade train reflection"):
        decompose(picture, reflections="picture", weights=tmp_path)
    with pytest.raises(TreeError, match="lights or picture"):
        decompose(picture, reflections="mirror")  # type: ignore[arg-type]
    with pytest.raises(TreeError, match="search='size'"):
        decompose(picture, reflections="picture", search="depth")
    file = weights.file_of("reflection", tmp_path)
    file.write_bytes(b"no weights")
    with pytest.raises(weights.WeightsError, match="damaged"):
        decompose(picture, reflections="picture", weights=tmp_path)
    weights.save(file, "reflection", ReflectionNet(find("tiny")), find("tiny"), {})
    assert reflections.load(tmp_path).places.shape[-1] == 16


def test_without_weights_an_analogy_is_one_of_lights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    base = parse("multiply(albedo(#808080), diffuse(up front, 0.3))")
    lit = parse("screen(multiply(albedo(#204080), diffuse(left front, 0.3)), highlight(right front, 40, 1.2))")
    answer = analogy(base, lit, shown(transfer(lit, base, "highlights")), shown(base), lit, preset="draft")
    assert answer.component is Component.HIGHLIGHTS


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "ball.png"
    write_picture(picture, shown(parse("multiply(albedo(#a06040), diffuse(left up, 0.2))")), DISC)
    arguments = ["decompose", str(picture), "-o", str(tmp_path / "out"), "--artifacts", "tree", "--json", "--reflections"]
    for how in ("lights", "picture", "picture"):
        assert run_command([*arguments, how]) == 0
        assert json.loads(capsys.readouterr().out)["values"] < 30
    # Done again only where the settings differ.
    assert len((tmp_path / "out" / "results.jsonl").read_text().splitlines()) == 2


def test_the_command_holds_a_photograph(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "ball.png"
    write_picture(picture, shown(under(COAT)), DISC)
    arguments = ["decompose", str(picture), "-o", str(tmp_path / "out"), "--artifacts", "tree", "--json", "--preset", "draft"]
    assert run_command([*arguments, "--reflections", "picture"]) == 0
    assert json.loads(capsys.readouterr().out)["values"] > 24_576


def test_experiments_name_it() -> None:
    assert methods.name_of("search:balanced+reflections").reflecting
    assert methods.digest("search:balanced+reflections", None) != methods.digest("search:balanced", None)
    with pytest.raises(UnshadeError, match="baselines hold no reflections"):
        methods.name_of("cnn+reflections")
