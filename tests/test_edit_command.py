"""The verbs that edit and combine trees, from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PILImage

from unshade.cli import run
from unshade.serde import load, parse

BALL = "screen(multiply(albedo(red), diffuse(left up)), highlight(left up, 60), rim(up))"
PLAIN = "multiply(albedo(teal), diffuse(up))"


def fails(capsys: pytest.CaptureFixture[str], code: int, *arguments: object) -> str:
    """Run, expect one line of error, and return it."""
    assert run([str(argument) for argument in arguments]) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("unshade: error: ")
    return lines[0]


def done(*arguments: object) -> None:
    assert run([str(argument) for argument in arguments]) == 0


def test_edit(tmp_path: Path) -> None:
    new = tmp_path / "new.json"
    edits = ["--set", "multiply.0.color=#3366ff", "--set", "highlight.sharpness*=2", "--move-light", "30,10", "--remove", "rim"]
    done("edit", BALL, *edits, "--name", "highlight=lamp", "-o", new, "--render", tmp_path / "new.png")
    tree = load(new)
    assert tree.find("albedo")["color"] == pytest.approx((0.2, 0.4, 1.0))  # type: ignore[index]
    assert tree.find("lamp")["sharpness"] == (120.0,)  # type: ignore[index]
    assert "rim" not in str(tree) and tree.find("diffuse") != parse(BALL).find("diffuse")
    with PILImage.open(tmp_path / "new.png") as picture:
        assert picture.size == (256, 256)


def test_edit_one_light_by_its_address(tmp_path: Path) -> None:
    done("edit", BALL, "--move-light", "highlight=20,0", "--recolor", "albedo=gold", "-o", tmp_path / "new.json")
    tree = load(tmp_path / "new.json")
    assert tree.find("diffuse") == parse(BALL).find("diffuse") and tree.find("highlight") != parse(BALL).find("highlight")


def test_edit_many_with_a_script(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "colder.toml"
    script.write_text('[[edit]]\nrecolor = "navy"\n[[edit]]\nremove = "rim"\n', encoding="utf-8")
    for name, text in {"a": BALL, "b": PLAIN, "c": BALL}.items():
        (tmp_path / f"{name}.{'txt' if name == 'b' else 'json'}").write_text(text, encoding="utf-8")
    trees = [tmp_path / f"{name}.{'txt' if name == 'b' else 'json'}" for name in "abc"]
    assert "edit 2 (remove): no node 'rim'" in fails(
        capsys, 7, "edit", *trees, "--script", script, "-o", tmp_path / "out", "--render", ".png"
    )
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.json", "a.png", "c.json", "c.png"]
    script.write_text(script.read_text(encoding="utf-8") + "optional = true\n", encoding="utf-8")
    done("edit", *trees, "--script", script, "-o", tmp_path / "out")
    assert (tmp_path / "out" / "b.json").exists()
    monkeypatch.chdir(tmp_path / "out")
    (tmp_path / "out" / "tree.json").write_text(BALL, encoding="utf-8")
    done("edit", "tree.json", "a.json", "--recolor", "teal", "-o", tmp_path / "named")
    assert sorted(path.name for path in (tmp_path / "named").iterdir()) == ["a.json", "out.json"]
    script.write_text("[[edit]]\nmove_light = [30]\n", encoding="utf-8")
    assert "takes [right, up] or [right, up, roll] in degrees, got [30]" in fails(
        capsys, 4, "edit", BALL, "--script", script, "-o", tmp_path / "x.json"
    )
    assert load(tmp_path / "out" / "b.json").find("albedo")["color"] == pytest.approx((0, 0, 128 / 255))  # type: ignore[index]


def test_several_trees_need_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "expected a folder for several trees" in fails(capsys, 5, "soften", BALL, PLAIN, "-o", tmp_path / "one.json")


def test_edit_like_another(tmp_path: Path) -> None:
    done("edit", PLAIN, "--like", BALL, BALL.replace("red", "#40a040"), "-o", tmp_path / "new.json")
    assert load(tmp_path / "new.json").find("albedo") != parse(PLAIN).find("albedo")


@pytest.mark.parametrize(
    ("code", "arguments", "message"),
    [
        (4, ["--remove", "rmi"], "no node 'rmi'; did you mean 'rim'?"),
        (4, ["--set", "highlight.sharpnes=2"], "did you mean 'sharpness'?"),
        (4, ["--set", "diffuse.ambient=3"], "must be in [0, 1], got 3 (at screen.0.multiply.1.diffuse)"),
        (2, ["--move-light", "far"], "expected degrees to the right and up such as 30,10"),
        (2, ["--name", "rim"], "expected ADDRESS=NAME"),
        (2, [], "nothing to do"),
        (4, ["--script", "nosuch.toml"], "cannot read nosuch.toml"),
        (4, ["--like", PLAIN, BALL], "not where it adds leaves"),
    ],
)
def test_edit_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str], code: int, arguments: list[str], message: str) -> None:
    assert message in fails(capsys, code, "edit", BALL, *arguments, "-o", tmp_path / "new.json")
    assert not list(tmp_path.iterdir())


def test_the_tree_that_was_read_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.json").write_text(BALL, encoding="utf-8")
    assert "give -o another name" in fails(capsys, 5, "soften", tmp_path / "a.json", "-o", tmp_path / "a.json")
    assert "give -o another name" in fails(capsys, 5, "soften", tmp_path / "a.json", "-o", tmp_path)
    assert "ends in .json" in fails(capsys, 5, "soften", tmp_path / "a.json", "-o", tmp_path / "b.png")
    assert (tmp_path / "a.json").read_text(encoding="utf-8") == BALL


def test_recolor_soften_harden(tmp_path: Path) -> None:
    done("recolor", "teal", BALL, PLAIN, "-o", tmp_path / "teal")
    assert sorted(path.name for path in (tmp_path / "teal").iterdir()) == ["000.json", "001.json"]
    done("soften", BALL, "--by", "2", "-o", tmp_path / "soft.json")
    done("harden", BALL, "--by", "2", "--where", "highlight", "-o", tmp_path / "hard.json")
    sharpness = [load(tmp_path / f"{name}.json").find("highlight")["sharpness"][0] for name in ("soft", "hard")]  # type: ignore[index]
    assert sharpness == [15.0, 240.0]


def test_vary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done("vary", BALL, "-n", 3, "--seed", 5, "-o", tmp_path / "v")
    assert sorted(path.name for path in (tmp_path / "v").iterdir()) == [
        "0.json",
        "0.png",
        "1.json",
        "1.png",
        "2.json",
        "2.png",
        "sheet.png",
    ]
    assert "new or an empty folder" in fails(capsys, 5, "vary", BALL, "-o", tmp_path / "v")


def test_relight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done("relight", BALL, "--from", "right", "-o", tmp_path / "r.json", "--render", tmp_path / "r.png", "--size", 64)
    assert load(tmp_path / "r.json").find("diffuse")["direction"] == pytest.approx((1, 0, 0))  # type: ignore[index]
    sky = np.full((32, 64, 3), 90, np.uint8)
    sky[:16] = (120, 170, 250)
    PILImage.fromarray(sky).save(tmp_path / "sky.png")
    done("relight", BALL, "--environment", tmp_path / "sky.png", "--turntable", tmp_path / "t.gif", "--frames", 3, "--size", 32)
    with PILImage.open(tmp_path / "t.gif") as gif:
        assert gif.n_frames == 3
    assert "twice as wide as high" in fails(capsys, 3, "relight", BALL, "--environment", tmp_path / "r.png", "-o", tmp_path / "x.json")
    huge = ["--turntable", tmp_path / "h.gif", "--frames", 2000, "--size", 2048]
    assert "take fewer or smaller" in fails(capsys, 5, "relight", BALL, *huge)
    assert "nothing to write" in fails(capsys, 2, "relight", BALL, "--turn", "30,10")
    assert "turns all of the light" in fails(capsys, 2, "relight", BALL, "--turn", "rim=30,10", "-o", tmp_path / "x.json")
    assert "cannot be written" in fails(capsys, 5, "relight", BALL, "--turntable", tmp_path / "no" / "t.gif", "--frames", 2, "--size", 16)
    assert not (tmp_path / "x.json").exists()


def test_transfer_and_mix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done("transfer", "highlights", BALL, PLAIN, "-o", tmp_path / "a.json")
    assert "highlight" in str(load(tmp_path / "a.json"))
    done("mix", PLAIN, BALL, "--take", "albedo", "--take", "rim", "-o", tmp_path / "b.json")
    assert str(load(tmp_path / "b.json").find("albedo")) == str(parse(BALL).find("albedo"))
    assert "cannot move albedo" in fails(capsys, 4, "transfer", "albedo", f"{BALL} @linear", PLAIN, "-o", tmp_path / "c.json")
    assert "is not one of" in fails(capsys, 2, "mix", PLAIN, BALL, "--take", "albdo", "-o", tmp_path / "c.json")


def test_analogy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edited = PLAIN.replace("teal", "red")
    done("analogy", PLAIN, BALL, edited, BALL, "multiply(albedo(gold), diffuse(left))", "-o", tmp_path / "answer", "--json", "-q")
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "answer" / "analogy.json").read_text(encoding="utf-8"))
    assert printed["component"] == "albedo" and printed["sure"] is True
    assert sorted(path.name for path in (tmp_path / "answer").iterdir()) == ["analogy.json", "render.png", "tree.json"]
    assert load(tmp_path / "answer" / "tree.json") == parse(BALL.replace("red", "gold"))
    assert "no such file" in fails(capsys, 3, "analogy", PLAIN, BALL, "nosuch.png", BALL, BALL, "-o", tmp_path / "x")


def test_library(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done("library", BALL, PLAIN, "-o", tmp_path / "parts.html")
    assert 'data-group="rim"' in (tmp_path / "parts.html").read_text(encoding="utf-8")
    done("library", BALL, PLAIN, "-o", tmp_path / "parts.json")
    assert {entry["group"] for entry in json.loads((tmp_path / "parts.json").read_text(encoding="utf-8"))} >= {"albedo", "diffuse", "rim"}
    assert "ends in .html or .json" in fails(capsys, 5, "library", BALL, "-o", tmp_path / "parts.pdf")
