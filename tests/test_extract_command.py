"""The verbs `extract` and `apply` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image as PILImage

import photo_scenes as scenes
from unshade.cli import run
from unshade.picture_files import read_picture
from unshade.picture_output import write_picture
from unshade.serde import load

RED = "albedo(red)"
SVG = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 90 60"><defs><linearGradient id="g"><stop stop-color="#ffe0a0"/>'
    '<stop offset="1" stop-color="#602010"/></linearGradient></defs><circle id="body" cx="40" cy="30" r="25" fill="url(#g)"/></svg>'
)


def done(*arguments: object) -> None:
    assert run([str(argument) for argument in arguments]) == 0


def fails(capsys: pytest.CaptureFixture[str], code: int, *arguments: object) -> str:
    """Run, expect one line of error, and return it."""
    capsys.readouterr()
    assert run([str(argument) for argument in arguments]) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("unshade: error: ")
    return lines[0]


@pytest.fixture
def knot(tmp_path: Path) -> Path:
    """A folder with a photo and its normal map, green down."""
    normals, mask = scenes.knot(128)
    write_picture(tmp_path / "photo.png", scenes.photo(scenes.tree_of("wax"), normals, mask, "patch"))
    write_picture(tmp_path / "normals.png", normals * torch.tensor([1, -1, 1]).view(3, 1, 1) * 0.5 + 0.5, mask)
    return tmp_path


def test_a_photo_there_and_back(knot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = knot / "out"
    done("extract", knot / "photo.png", "--normals", knot / "normals.png", "--decompose", "draft", "--size", 128, "--json", "-o", out)
    said = capsys.readouterr()
    assert "read as DirectX (green down)" in said.err and "taken out: a paint of" in said.err
    report = json.loads(said.out)
    assert report == json.loads((out / "extract.json").read_text(encoding="utf-8"))
    assert report["how"] == "normal map" and report["convention"] == "DirectX (green down)" and report["seen"] > 0.9
    assert {path.name for path in out.iterdir()} == {
        *("matcap.png", "coverage.png", "unseen.png", "normals.png"),
        *("extract.json", "tree.json"),
    }
    # Its own normals are read back as they are.
    done("edit", out, "--recolor", "#3060c0", "-o", knot / "blue.json")
    done("apply", knot / "blue.json", "--from", out, "--normals", out / "normals.png", "--photo", knot / "photo.png", "-o", knot / "b.png")
    capsys.readouterr()
    before, after = (read_picture(knot / name).rgb for name in ("photo.png", "b.png"))
    outside = read_picture(out / "normals.png", colors=False).alpha == 0.0
    assert np.array_equal(before[outside], after[outside])
    assert after[~outside][:, 2].mean() > before[~outside][:, 2].mean() + 0.1
    done("apply", out, "--from", out, "--normals", out / "normals.png", "--photo", knot / "photo.png", "-o", knot / "same.png")
    assert np.array_equal(before, read_picture(knot / "same.png").rgb)
    assert load(out / "tree.json").values <= 30


def test_matcap_and_unseen_go_into_decompose(knot: Path) -> None:
    done("extract", knot / "photo.png", "--normals", knot / "normals.png", "--size", 64, "-q", "-o", knot / "out")
    done("decompose", knot / "out" / "matcap.png", "--mask", knot / "out" / "unseen.png", "--preset", "draft", "-q", "-o", knot / "trees")
    assert (knot / "trees" / "matcap" / "tree.json").exists()


def test_a_ball_and_an_outline(tmp_path: Path, examples: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done("extract", examples / "green_metal.png", "--disc", "--size", 64, "-o", tmp_path / "ball")
    done("extract", examples / "green_metal.png", "--disc", "128,128,128", "-q", "--size", 64, "-o", tmp_path / "given")
    with PILImage.open(examples / "green_metal.png") as image:
        image.getchannel("A").save(tmp_path / "mask.png")
    capsys.readouterr()
    done("extract", examples / "green_metal.png", "--mask", tmp_path / "mask.png", "--size", 64, "-o", tmp_path / "guess")
    assert "the normals are a guess" in capsys.readouterr().err
    ball, given, guess = (read_picture(tmp_path / name / "matcap.png").rgb for name in ("ball", "given", "guess"))
    middle = np.s_[10:54, 10:54]
    assert np.abs(ball - given)[middle].max() < 0.02 and np.abs(ball - guess)[middle].mean() < 0.03


def test_a_drawing_there_and_back(tmp_path: Path) -> None:
    pytest.importorskip("resvg_py")
    drawing, out = tmp_path / "d.svg", tmp_path / "out"
    drawing.write_text(SVG, encoding="utf-8")
    done("extract", drawing, "--region", "body", "--decompose", "draft", "-q", "--size", 64, "-o", out)
    assert (out / "shape.png").exists()
    done("apply", out, "--from", out, "--drawing", drawing, "--region", "body", "-o", tmp_path / "new.svg")
    assert 'id="body"' in (tmp_path / "new.svg").read_text(encoding="utf-8")
    done("extract", tmp_path / "new.svg", "--region", "body", "-q", "--size", 64, "-o", tmp_path / "again")
    first, second = (read_picture(folder / "matcap.png").rgb for folder in (out, tmp_path / "again"))
    assert np.abs(first - second).mean() < 0.01


def test_a_mesh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("trimesh")
    (tmp_path / "tent.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 3 4\n", encoding="utf-8")
    arguments = ["apply", scenes.TREES["wax"], "--mesh", tmp_path / "tent.obj", "--turn=20,10", "--size", 32, "-o", tmp_path / "tent.png"]
    done(*arguments)
    assert "has no normals, or not for all of it; they were computed" in capsys.readouterr().err
    with PILImage.open(tmp_path / "tent.png") as image:
        assert image.size == (32, 32) and image.mode == "RGBA" and image.getchannel("A").getextrema() == (0, 255)


@pytest.mark.parametrize(
    ("code", "arguments", "message"),
    [
        (2, ["extract", "photo.png", "--disc", "--normals", "normals.png", "-o", "out"], "--disc and --normals exclude each other"),
        (2, ["extract", "d.svg", "-o", "out"], "an SVG needs --region ID"),
        (2, ["extract", "photo.png", "--region", "x", "-o", "out"], "--region is for an SVG"),
        (2, ["extract", "photo.png", "--mask", "photo.png", "--green", "opengl", "-o", "out"], "are for --normals"),
        (3, ["extract", "photo.png", "--normals", "small.png", "-o", "out"], "size of photo.png, 128 x 128, got 64 x 64"),
        (3, ["extract", "photo.png", "--normals", "normals.png", "--green", "opengl", "-o", "out"], "shows DirectX (green down)"),
        (3, ["extract", "none.png", "--disc", "-o", "out"], "no such file"),
        (3, ["extract", "photo.png", "--mask", "black.png", "-o", "out"], "black.png: expected a shape of at least 16 pixels, got 0"),
        (5, ["extract", "photo.png", "--normals", "normals.png", "-o", "photo.png"], "expected a folder to write into"),
        (2, ["apply", "albedo(red)", "-o", "x.png"], "give one of --normals, --drawing and --mesh"),
        (2, ["apply", "albedo(red)", "--normals", "normals.png", "--photo", "photo.png", "-o", "x.png"], "--photo and --from go together"),
        (2, ["apply", "albedo(red)", "--mesh", "a.glb", "--region", "b", "-o", "x.png"], "--drawing and --region go together"),
        (3, ["apply", "albedo(red)", "--mesh", "a.glb", "-o", "x.png"], "a.glb: no such file"),
        (3, ["apply", RED, "--from", RED, "--photo", "photo.png", "--normals", "small.png", "-o", "x.png"], "of the size of photo.png"),
        (5, ["apply", "albedo(red)", "--normals", "normals.png", "-o", "no/x.png"], "no/x.png: cannot be written"),
        (5, ["apply", "albedo(red)", "--drawing", "d.svg", "--region", "body", "-o", "x.png"], "ends in .svg"),
    ],
)  # fmt: skip
def test_bad_input(
    knot: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, code: int, arguments: list[str], message: str
) -> None:
    """One line, the right code, and nothing written."""
    monkeypatch.chdir(knot)
    normals, mask = scenes.knot(64)
    write_picture(knot / "small.png", normals * 0.5 + 0.5, mask)
    write_picture(knot / "black.png", torch.zeros(3, 128, 128))
    (knot / "d.svg").write_text(SVG, encoding="utf-8")
    before = {path.name: path.read_bytes() for path in knot.iterdir()}
    capsys.readouterr()
    assert run(arguments) == code
    *said, line = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("unshade: error: ") and message in line
    assert all("read as DirectX" in other for other in said)
    assert {path.name: path.read_bytes() for path in knot.iterdir()} == before
