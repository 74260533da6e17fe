"""Turning the light, turntables, and new environments."""

from __future__ import annotations

import builtins
import math
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from PIL import Image as PILImage

from strategies import trees
from unshade.components import Component
from unshade.edit import component
from unshade.errors import MissingExtraError, OutputError, PictureError, TreeError
from unshade.metrics import psnr
from unshade.nodes import Raster, Tree, leaf
from unshade.relight import (
    axis_angle,
    lit_leaves,
    main_light,
    relight,
    relight_to,
    rotation_matrix,
    turn,
    turn_between,
    turn_of,
    turned_leaf,
)
from unshade.render import render, srgb_decode, srgb_encode
from unshade.serde import parse
from unshade.shading import rotate
from unshade.sphere import disc_mask, sphere_normals
from unshade.surroundings import Surroundings, under
from unshade.turntable import directions, frame, lighting, turntable, write_turntable

PAINT = "mix(albedo(red), albedo(blue), stripe(up))"
BALL = parse(f"screen(multiply({PAINT}, diffuse(front, 0.2)), highlight(front), rim(up), environment(left, 8, gold))")


def test_rotations() -> None:
    chance = np.random.default_rng(0)
    for _ in range(50):
        vector = chance.normal(size=3)
        vector *= chance.uniform(0.0, math.pi) / np.linalg.norm(vector)
        matrix = rotation_matrix(vector)
        assert np.allclose(axis_angle(matrix), vector, atol=1e-7)
        point = chance.normal(size=3)
        assert np.allclose(rotate(torch.tensor(point)[:, None, None], torch.tensor(vector)).ravel(), matrix @ point)
        a, b = chance.normal(size=(2, 3))
        turned = turn_between(a, b) @ a
        assert np.allclose(turned / np.linalg.norm(turned), b / np.linalg.norm(b))
    for opposite in ((0, 1, 0), (0, 0, 1), (1, 0, 0)):
        assert np.allclose(turn_between(opposite, [-part for part in opposite]) @ opposite, [-part for part in opposite])
    assert np.allclose(axis_angle(rotation_matrix((0, math.pi, 0))), (0, math.pi, 0))


def test_turns_go_where_they_say() -> None:
    front = np.array([0.0, 0.0, 1.0])
    assert np.allclose(turn_of(90.0) @ front, (1, 0, 0))
    assert np.allclose(turn_of(0.0, 90.0) @ front, (0, 1, 0))
    assert np.allclose(turn_of(0.0, 0.0, 90.0) @ [1.0, 0.0, 0.0], (0, 1, 0))
    with pytest.raises(TreeError, match="finite"):
        turn_of(math.nan)


@given(trees())
def test_a_turn_back_undoes_a_turn(tree: Tree) -> None:
    normals = sphere_normals(16, dtype=torch.float64)
    back = relight(relight(tree, 37.0, -20.0, 11.0), -37.0, 20.0, -11.0)
    assert [node.kind for _, node in back.walk()] == [node.kind for _, node in tree.walk()]
    difference = (render(back, normals) - render(tree, normals)).abs()
    # Hard edges may move by a rounding error.
    assert float((difference > 1e-4).double().mean()) < 0.05


def test_light_turns_and_paint_stays() -> None:
    lit = relight(BALL, 90.0)
    assert np.allclose(lit.find("diffuse")["direction"], (1, 0, 0)) and np.allclose(lit.find("highlight")["direction"], (1, 0, 0))  # type: ignore[index]
    assert np.allclose(lit.find("environment")["direction"], (0, 0, 1))  # type: ignore[index]
    assert lit.find("screen.0.multiply.0.mix.mask") == BALL.find("screen.0.multiply.0.mix.mask"), "a mask between paints is paint"
    assert set(lit_leaves(BALL.root)) == {"screen.0.multiply.1.diffuse", "screen.1.highlight", "screen.2.rim", "screen.3.environment"}


def test_a_mask_between_shadings_turns() -> None:
    tree = parse("multiply(albedo(red), mix(diffuse(up), diffuse(down), threshold(left)))")
    assert "multiply.1.mix.mask" in lit_leaves(tree.root)


def test_a_picture_turns_as_a_whole() -> None:
    """Of a tree that knows no viewer, the light turned is the picture of the turned normals."""
    tree = parse("screen(multiply(albedo(red), toon_diffuse(up)), highlight(left, 20), toon_highlight(front, 0.4, 1, 0.2))")
    rotation = turn_of(40.0, 25.0)
    normals = sphere_normals(32, dtype=torch.float64)
    turned = torch.einsum("ij,ihw->jhw", torch.tensor(rotation), normals)
    assert (render(turn(tree, rotation), normals) - render(tree, turned)).abs().max() < 1e-9


def test_environment_map_turns_by_its_stored_rotation() -> None:
    pixels = Raster.from_array(np.random.default_rng(0).uniform(0, 1, (3, 8, 16)))
    tree = Tree(leaf("environment_map", pixels=pixels, rotation=(0.1, 0.2, 0.3)))
    lit = relight(tree, 30.0)
    assert lit.root["pixels"] is pixels  # type: ignore[index]
    assert np.allclose(rotation_matrix(lit.root["rotation"]), turn_of(30.0) @ rotation_matrix((0.1, 0.2, 0.3)))  # type: ignore[index]


def test_light_from_a_direction() -> None:
    assert main_light(BALL.root) == ("screen.0.multiply.1.diffuse", (0.0, 0.0, 1.0))
    lit = relight_to(BALL, (0.0, 1.0, 0.0))
    assert np.allclose(lit.find("highlight")["direction"], (0, 1, 0))  # type: ignore[index]
    with pytest.raises(TreeError, match="no light with a direction"):
        relight_to(parse("albedo(red)"), (0.0, 1.0, 0.0))


# Turntables


def test_lighting_shows_lights_where_they_are() -> None:
    sky = directions(32)
    assert torch.allclose(sky.square().sum(0), torch.ones(32, 64))
    picture = lighting(parse("screen(multiply(albedo(red), highlight(right, 5)), highlight(up, 5))"), 32).reshape(3, -1)
    right, up, left = (int(place.argmax()) for place in (sky[0].flatten(), sky[1].flatten(), -sky[0].flatten()))
    assert picture[0, right] > 0.95 and picture[1, right] < 0.1, "the light on the right is red"
    assert picture[1, up] > 0.95 and picture[:, left].max() < 0.1


def test_lighting_of_an_environment_map_is_the_map() -> None:
    pixels = torch.rand(3, 8, 16, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.interpolate(pixels[None], (32, 64), mode="bilinear")[0].clamp(0, 1)
    shown = lighting(Tree(leaf("environment_map", pixels=Raster.from_array(smooth))), 32)
    assert (shown - smooth).abs().mean() < 0.02


def test_turntable_begins_with_the_tree_and_goes_round() -> None:
    frames = list(turntable(BALL, 4, 32, lights=BALL))
    assert len(frames) == 4 and frames[0].shape == (3, 32, 32)
    assert torch.equal(frames[0], frame(BALL, 32, BALL))
    assert torch.allclose(frames[1], frame(relight(BALL, 90.0), 32, relight(BALL, 90.0)), atol=1e-5)


def test_turntable_files(tmp_path: Path) -> None:
    assert write_turntable(tmp_path / "t.gif", turntable(BALL, 5, 48), 25.0) == 5
    with PILImage.open(tmp_path / "t.gif") as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"], gif.size) == (5, 40, 0, (48, 48))
        shown = torch.from_numpy(np.array(gif.convert("RGB"))).permute(2, 0, 1) / 255.0
    assert psnr(shown, frame(BALL, 48)) > 26.0
    write_turntable(tmp_path / "frames", turntable(BALL, 3, 32))
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["0.png", "1.png", "2.png"]
    with pytest.raises(OutputError, match="new or an empty folder"):
        write_turntable(tmp_path / "frames", turntable(BALL, 2, 32))
    with pytest.raises(OutputError, match=r"ends in \.gif or \.mp4"):
        write_turntable(tmp_path / "t.avi", turntable(BALL, 2, 32))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames", "t.gif"]


def test_turntable_mp4(tmp_path: Path) -> None:
    encoder = pytest.importorskip("imageio_ffmpeg")
    grey = parse("screen(diffuse(left up), highlight(right, 20, 0.5))")  # colours are stored at half the size
    write_turntable(tmp_path / "t.mp4", turntable(grey, 6, 65), 24.0)
    command = [encoder.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(tmp_path / "t.mp4"), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    frames = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, np.uint8).reshape(-1, 64, 64, 3)
    assert len(frames) == 6
    shown = torch.from_numpy(frames[0].copy()).permute(2, 0, 1) / 255.0
    assert psnr(shown, frame(grey, 65)[:, :64, :64]) > 35.0


def test_mp4_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any, **named: Any) -> Any:
        if name == "imageio_ffmpeg":
            raise ImportError(name)
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"unshade\[video\]"):
        write_turntable(tmp_path / "t.mp4", turntable(BALL, 2, 32))
    assert not list(tmp_path.iterdir())


# New environments


@pytest.fixture(scope="module")
def sky() -> Surroundings:
    """Blue above, brown below, a sun up on the right."""
    along = directions(64)
    up = (along[1:2] > 0).float()
    light = up * torch.tensor([0.4, 0.6, 1.0])[:, None, None] + (1 - up) * torch.tensor([0.3, 0.2, 0.1])[:, None, None]
    sun = torch.nn.functional.normalize(torch.tensor([0.6, 0.6, 0.5]), dim=0)
    spot = torch.exp(200.0 * (torch.einsum("c,chw->hw", sun, along) - 1.0))
    return Surroundings(light + 40.0 * spot * torch.tensor([1.0, 0.9, 0.7])[:, None, None])


def test_form_is_what_the_environment_sheds_at_any_turn(sky: Surroundings) -> None:
    tree = under(parse("multiply(albedo(white), diffuse(left up))"), sky)
    normals, inside = sphere_normals(64), disc_mask(64)[0]
    for angle in (0.0, 90.0, 180.0):
        rotation = turn_of(angle, 20.0)
        form = component(turn(tree, rotation), Component.DIFFUSE)
        assert form is not None
        shown = render(form, normals)
        shed = sky.shed(torch.einsum("ij,ihw->jhw", torch.tensor(rotation, dtype=torch.float32), normals))
        scale = float(srgb_decode(shown)[:, inside].mean() / shed[:, inside].mean())
        assert psnr(shown, srgb_encode((shed * scale).clamp(0, 1))) > 36.0


def test_light_shed_by_a_white_environment_is_white() -> None:
    white = Surroundings(torch.ones(3, 64, 128))
    assert (white.shed(sphere_normals(16)) - 1.0).abs().max() < 0.01
    assert (white.blurred(20.0, 16) - 1.0).abs().max() < 1e-4


def test_paint_and_brightness_stay(sky: Surroundings) -> None:
    tree = parse(f"screen(multiply({PAINT}, diffuse(left up)), highlight(right, 60), multiply(albedo(gold), rim(left)))")
    lit = under(tree, sky)
    assert component(lit, "albedo") == component(tree, "albedo")
    assert component(lit, "highlights") is None and lit.find("environment_map").role.value == "environment"
    forms = [
        srgb_decode(render(form, sphere_normals(64)))[:, disc_mask(64)[0]].mean() for t in (tree, lit) if (form := component(t, "diffuse"))
    ]
    assert float(forms[0]) == pytest.approx(float(forms[1]), rel=0.03)
    assert np.dot(lit.find("rim")["direction"], sky.brightest) > 0.999  # type: ignore[index]
    assert component(under(parse("multiply(albedo(red), diffuse(up))"), sky), "environment") is None, "a matt tree stays matt"


def test_read_surroundings(tmp_path: Path) -> None:
    array = np.zeros((32, 64, 3), np.uint8)
    array[:8] = 255
    PILImage.fromarray(array).save(tmp_path / "sky.png")
    read = Surroundings.read(tmp_path / "sky.png")
    assert read.light.shape == (3, 64, 128) and read.brightest[1] > 0.5
    PILImage.fromarray(array[:, :40]).save(tmp_path / "square.png")
    with pytest.raises(PictureError, match="twice as wide as high, got 40 x 32"):
        Surroundings.read(tmp_path / "square.png")
    PILImage.fromarray(array * 0).save(tmp_path / "black.png")
    with pytest.raises(PictureError, match="black"):
        Surroundings.read(tmp_path / "black.png")


def test_turned_leaf_without_a_direction() -> None:
    with pytest.raises(TreeError, match="has no direction"):
        turn(BALL, np.eye(3), ["screen.0.multiply.0.mix.0.albedo"])
    assert turned_leaf(leaf("albedo"), turn_of(30.0)) == leaf("albedo")
