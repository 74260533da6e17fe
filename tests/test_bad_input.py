"""What a user can get wrong: one clear line, the right exit code, nothing half-written."""

from __future__ import annotations

import io
import json
import os
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PILImage

from unshade import cli
from unshade.render import render
from unshade.serde import dumps, parse
from unshade.sphere import sphere_normals

RED = "multiply(albedo(#cc2030), diffuse(left up, ambient=0.2))"
PICTURE, TREE, OUTPUT = 3, 4, 5

Fails = Callable[..., str]


@pytest.fixture
def fails(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Fails:
    """Run a command line that must fail with this code in one line, leaving every folder as it was; gives the line."""

    def call(code: int, *arguments: object) -> str:
        before = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()}
        folders = {path for path in tmp_path.rglob("*") if path.is_dir()}
        found = cli.run([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert found == code, err
        assert out == ""
        assert err.startswith("unshade: error: ")
        assert err.count("\n") == 1
        assert err.endswith("\n")
        assert len(err) < 400
        assert {path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()} == before
        assert {path for path in tmp_path.rglob("*") if path.is_dir()} == folders
        return err

    return call


def ball(size: int = 96) -> np.ndarray:
    """(size, size, 3) bytes of a red ball on black, with room around it."""
    pixels = render(parse(RED), sphere_normals(size)).permute(1, 2, 0).mul(255).round().byte().numpy()
    y, x = np.indices((size, size)) + 0.5 - size / 2
    framed = np.zeros((size * 3 // 2, size * 3 // 2, 3), np.uint8)
    framed[size // 4 : size // 4 + size, size // 4 : size // 4 + size] = np.where((np.hypot(x, y) < size / 2)[..., None], pixels, 0)
    return framed


def encoded(pixels: np.ndarray, kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    PILImage.fromarray(pixels).save(file, kind, **options)
    return file.getvalue()


def png_header(width: int, height: int) -> bytes:
    """A PNG that promises a size and holds next to nothing."""
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), (b"IDAT", zlib.compress(b"\0" * 64)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)


def frames(kind: str) -> bytes:
    """Three pictures in one file."""
    file = io.BytesIO()
    first, *rest = (PILImage.fromarray(np.roll(ball(), shift, 1)) for shift in (0, 5, 10))
    first.save(file, kind, save_all=True, append_images=rest)
    return file.getvalue()


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


BAD_PICTURES: dict[str, tuple[str, Callable[[], bytes], str]] = {
    "text": ("a.png", lambda: b"this is no picture\n" * 20, "expected a picture"),
    "empty": ("a.png", lambda: b"", "empty file"),
    "truncated PNG": ("a.png", lambda: encoded(noise(80, 80), "PNG")[:9000], "truncated"),
    "truncated JPEG": ("a.jpg", lambda: encoded(noise(80, 80), "JPEG")[:3000], "truncated"),
    "0 x 0": ("a.png", lambda: png_header(0, 0), "0 x 0"),
    "1 x 1": ("a.png", lambda: encoded(noise(1, 1), "PNG"), "1 x 1"),
    "40,000 x 40,000": ("a.png", lambda: png_header(40_000, 40_000), "40,000"),
    "animated GIF": ("a.gif", lambda: frames("GIF"), "3 frames"),
    "animated PNG": ("a.png", lambda: frames("PNG"), "3 frames"),
    "animated WebP": ("a.webp", lambda: frames("WEBP"), "3 frames"),
    "no sphere": ("a.png", lambda: encoded(noise(120, 200), "PNG"), "no sphere found"),
    "transparent": ("a.png", lambda: encoded(np.zeros((64, 64, 4), np.uint8), "PNG"), "fully transparent"),
}


@pytest.mark.parametrize("case", BAD_PICTURES)
def test_a_bad_picture(case: str, tmp_path: Path, fails: Fails) -> None:
    name, make, says = BAD_PICTURES[case]
    (tmp_path / name).write_bytes(make())
    line = fails(PICTURE, "decompose", tmp_path / name, "-o", tmp_path / "out")
    assert says in line
    assert str(tmp_path / name) in line
    assert says in fails(PICTURE, "fit", tmp_path / name, "--structure", RED, "-o", tmp_path / "out")


def test_a_picture_too_large_is_refused_before_it_is_decoded(tmp_path: Path, fails: Fails) -> None:
    (tmp_path / "a.png").write_bytes(png_header(40_000, 40_000))
    begin = time.monotonic()
    fails(PICTURE, "decompose", tmp_path / "a.png", "-o", tmp_path / "out")
    assert time.monotonic() - begin < 2


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_an_exr_with_numbers_that_are_none(bad: float, tmp_path: Path, fails: Fails) -> None:
    library = pytest.importorskip("OpenEXR", reason="needs the extra exr")
    pixels = np.full((64, 64, 3), 0.5, np.float32)
    pixels[3, 5, 1] = bad
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    with library.File(header, {"RGB": pixels}) as file:
        file.write(str(tmp_path / "a.exr"))
    line = fails(PICTURE, "decompose", tmp_path / "a.exr", "-o", tmp_path / "out")
    assert "NaN or infinity" in line
    assert "x 5, y 3" in line


def test_a_missing_picture_and_a_folder_without_pictures(tmp_path: Path, fails: Fails) -> None:
    assert "no such file" in fails(PICTURE, "decompose", tmp_path / "none.png", "-o", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    assert "found none" in fails(PICTURE, "decompose", tmp_path / "empty", "-o", tmp_path / "out")


def test_a_mask_that_does_not_fit(tmp_path: Path, fails: Fails) -> None:
    (tmp_path / "ball.png").write_bytes(encoded(ball(), "PNG"))
    (tmp_path / "mask.png").write_bytes(encoded(noise(20, 20), "PNG"))
    assert "mask" in fails(PICTURE, "decompose", tmp_path / "ball.png", "--mask", tmp_path / "mask.png", "-o", tmp_path / "out")


def test_an_output_that_cannot_be_written(tmp_path: Path, fails: Fails) -> None:
    (tmp_path / "ball.png").write_bytes(encoded(ball(), "PNG"))
    (tmp_path / "file").write_text("mine")
    assert "is a file" in fails(OUTPUT, "decompose", tmp_path / "ball.png", "-o", tmp_path / "file")
    assert "is a file" in fails(OUTPUT, "fit", tmp_path / "ball.png", "--structure", RED, "-o", tmp_path / "file" / "out")
    assert "is a file" in fails(OUTPUT, "sample", "-o", tmp_path / "file")
    fails(OUTPUT, "render", RED, "-o", tmp_path / "none" / "a.png")
    fails(OUTPUT, "render", RED, "-o", tmp_path)
    assert ".xyz" in fails(OUTPUT, "render", RED, "-o", tmp_path / "a.xyz")


@pytest.mark.skipif(
    os.name == "nt" or (hasattr(os, "geteuid") and os.geteuid() == 0), reason="needs folders that deny writing to this user"
)
def test_a_folder_without_permission(tmp_path: Path, fails: Fails) -> None:
    (tmp_path / "ball.png").write_bytes(encoded(ball(), "PNG"))
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    assert "no permission" in fails(OUTPUT, "decompose", tmp_path / "ball.png", "-o", locked / "out")


def test_a_protected_file_stays(tmp_path: Path, fails: Fails) -> None:
    for name, command in {
        "a.png": ["render", RED],
        "a.json": ["edit", RED, "--recolor", "teal"],
        "a.svg": ["export", RED],
        "a.gif": ["relight", RED, "--frames", 2, "--size", 16],
    }.items():
        (tmp_path / name).write_text("mine")
        (tmp_path / name).chmod(0o444)
        option = "--turntable" if name == "a.gif" else "-o"
        assert "write-protected" in fails(OUTPUT, *command, option, tmp_path / name)


@pytest.mark.parametrize(
    "command",
    [
        ["apply", RED, "--normals", "normals.png", "-o", "normals.png"],
        ["apply", RED, "--from", RED, "--normals", "normals.png", "--photo", "photo.png", "-o", "photo.png"],
        ["apply", RED, "--drawing", "d.svg", "--region", "a", "-o", "d.svg"],
        ["render", RED, "--normals", "normals.png", "-o", "normals.png"],
        ["export", RED, "--shape", "d.svg", "-o", "d.svg"],
        ["relight", RED, "--environment", "sky.png", "--render", "sky.png"],
        ["edit", "tree.json", "--recolor", "teal", "-o", "tree.json"],
        ["edit", "out/a.json", "a.json", "--recolor", "teal", "-o", "."],
        ["edit", RED, "--like", RED, "tree.json", "-o", "tree.json"],
        ["mix", RED, "tree.json", "--take", "albedo", "-o", "tree.json"],
        ["transfer", "albedo", "tree.json", RED, "-o", "tree.json"],
        ["library", "tree.json", "-o", "tree.json"],
        ["extract", "out/matcap.png", "-o", "out"],
        ["extract", "photo.png", "--normals", "normals.png", "-o", "."],
    ],
)
def test_what_is_read_is_kept(command: list[str], tmp_path: Path, fails: Fails, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "extract.json").write_text("{}")
    for name in ("photo.png", "normals.png", "sky.png", "out/matcap.png"):
        (tmp_path / name).write_bytes(encoded(ball(), "PNG"))
    (tmp_path / "d.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg"><circle id="a" r="9"/></svg>')
    for name in ("tree.json", "a.json", "out/a.json"):
        (tmp_path / name).write_text(RED)
    found = fails(OUTPUT, *command)
    assert ("would be lost" if command[0] == "extract" and command[-1] == "." else "give -o another name") in found


@pytest.mark.parametrize("name", ["normals.png", "tree.json", "layers"])
def test_files_of_someone_else_stay(name: str, tmp_path: Path, fails: Fails) -> None:
    (tmp_path / "ball.png").write_bytes(encoded(ball(), "PNG"))
    (tmp_path / name).write_text("mine")
    assert f"since {name} in this one would be lost" in fails(OUTPUT, "extract", tmp_path / "ball.png", "-o", tmp_path)
    if name != "normals.png":
        assert f"since {name} in this one would be lost" in fails(OUTPUT, "analogy", *[RED] * 5, "-o", tmp_path)


def test_all_outputs_are_looked_at_before_the_first_is_written(tmp_path: Path, fails: Fails) -> None:
    new, nowhere = tmp_path / "new.json", tmp_path / "none" / "a.png"
    fails(OUTPUT, "edit", RED, "--recolor", "teal", "-o", new, "--render", nowhere)
    fails(OUTPUT, "edit", RED, "--recolor", "teal", "-o", new, "--render", tmp_path / "a.xyz")
    fails(OUTPUT, "relight", RED, "--turn", "9,9", "-o", new, "--render", nowhere)
    large = ["--turntable", tmp_path / "a.gif", "--frames", 2000, "--size", 2048]
    assert "take fewer or smaller" in fails(OUTPUT, "relight", RED, "--turn", "9,9", "-o", new, *large)
    assert ".avi" in fails(OUTPUT, "relight", RED, "--turn", "9,9", "-o", new, "--turntable", tmp_path / "a.avi")


def test_a_choice_that_is_missing_is_one_line(tmp_path: Path, fails: Fails) -> None:
    assert "'--take'. Choose from: albedo," in fails(2, "mix", RED, RED, "-o", tmp_path / "x.json")


GOOD = dumps(parse(RED))


def changed(change: Callable[[dict[str, Any]], None]) -> str:
    document = json.loads(GOOD)
    change(document)
    return json.dumps(document)


def screens(depth: int) -> str:
    leaf = '{"kind": "albedo", "parameters": {"color": [0, 0, 0]}}'
    head = '{"kind": "screen", "children": [' + leaf + ", "
    return '{"version": 1, "tree": {"blend_space": "srgb", "exposure": 1, "root": ' + head * depth + leaf + "]}" * depth + "}}"


BAD_TREES: dict[str, tuple[Callable[[], str], str]] = {
    "empty": (lambda: "", "got the end"),
    "a line of text": (lambda: "albedo(#fff), albedo", "column 13"),
    "truncated": (lambda: GOOD[: len(GOOD) // 2], "truncated"),
    "another kind of JSON": (lambda: "[1, 2]", ""),
    "later version": (lambda: changed(lambda d: d.update(version=99)), "99"),
    "unknown kind": (lambda: changed(lambda d: d["tree"]["root"]["children"][1].update(kind="difuse")), "did you mean 'diffuse'"),
    "unknown operator": (lambda: changed(lambda d: d["tree"]["root"].update(kind="multipli")), "did you mean 'multiply'"),
    "out of range": (lambda: changed(lambda d: d["tree"]["root"]["children"][1]["parameters"].update(ambient=3)), "[0, 1]"),
    "not finite": (lambda: GOOD.replace("0.2", "NaN"), "finite"),
    "a million nodes": (
        lambda: GOOD.replace('"children": [', '"children": [' + '{"kind": "albedo", "parameters": {"color": [0, 0, 0]}},' * 1_000_000),
        "nodes",
    ),
    "ten thousand deep": (lambda: screens(10_000), "deep"),
    "a thousand deep": (lambda: screens(1_000), "deep"),
}


@pytest.mark.parametrize("case", BAD_TREES)
def test_a_bad_tree_file(case: str, tmp_path: Path, fails: Fails) -> None:
    make, says = BAD_TREES[case]
    path = tmp_path / "bad.json"
    path.write_text(make())
    for arguments in (("show", path), ("render", path, "-o", tmp_path / "a.png")):
        line = fails(TREE, *arguments)
        assert says in line
        assert str(path) in line


def test_bytes_that_are_no_text(tmp_path: Path, fails: Fails) -> None:
    (tmp_path / "bad.json").write_bytes(b"\xff\xfe{}")
    assert "UTF-8" in fails(TREE, "info", tmp_path / "bad.json")
    assert "bad.json" in fails(TREE, "diff", tmp_path / "bad.json", RED)


def test_a_bad_tree_text_is_pointed_at(capfd: pytest.CaptureFixture[str]) -> None:
    for text, column in (("screen(albedo(#fff), difuse())", 22), ("screen(" * 10_000, None), ("albedo(" + "(" * 10_000, None)):
        assert cli.run(["show", text]) == TREE
        err = capfd.readouterr().err
        assert err.startswith("unshade: error: ")
        assert len(err) < 600
        assert column is None or f"column {column}: unknown kind 'difuse'; did you mean 'diffuse'?" in err


def test_a_tree_that_is_nowhere(tmp_path: Path, fails: Fails) -> None:
    assert "expected a tree file" in fails(TREE, "show", tmp_path / "none.json")
    assert "expected a tree file" in fails(TREE, "show", tmp_path)
    assert "expected a tree file" in fails(TREE, "show", "x" * 5000)
