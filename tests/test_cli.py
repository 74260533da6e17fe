"""Every verb of the command line: what it writes, prints and returns. The decomposition itself is stood in for here, `slow` tests aside."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image as PILImage

import photo_scenes
import unshade
from unshade import cli
from unshade.nodes import Family, Member, Tree
from unshade.picture_output import write_picture
from unshade.render import render
from unshade.serde import dump, load, load_family, parse
from unshade.sphere import sphere_normals

ROOT = Path(__file__).resolve().parent.parent
RED = "multiply(albedo(#cc2030), diffuse(left up, ambient=0.2))"
LIT = f"screen({RED}, highlight(right up))"


@dataclasses.dataclass
class Outcome:
    """What a command line did."""

    code: int
    out: str
    err: str

    @property
    def records(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.out.splitlines()]


Run = Callable[..., Outcome]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    """Run a command line in this process."""

    def call(*arguments: object) -> Outcome:
        code = cli.run([str(argument) for argument in arguments])
        return Outcome(code, *capfd.readouterr())

    return call


@dataclasses.dataclass
class StandInResult:
    family: Family
    seed: int
    preset: str = "balanced"
    stages: dict[str, Any] | None = None

    @property
    def tree(self) -> Tree:
        return self.family.tree

    @property
    def psnr(self) -> float:
        return self.family.members[self.family.chosen].psnr


class StandInDecomposition:
    def __init__(self, result: StandInResult) -> None:
        self._result = result

    def __iter__(self) -> Iterator[Any]:
        return iter(())

    def result(self) -> StandInResult:
        return self._result


@pytest.fixture
def decomposed(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """A decomposition that answers at once with a fixed family, and a list of what it was asked."""
    asked: list[dict[str, Any]] = []
    family = Family(tuple(Member(parse(text), psnr) for text, psnr in ((RED, 20.0), (LIT, 25.0))), 1, (Member(parse(RED), 19.0),))

    def decompose(image: Any, **options: Any) -> StandInDecomposition:
        asked.append(options)
        if float(image.image[0].mean()) > 0.9:
            raise KeyboardInterrupt
        return StandInDecomposition(StandInResult(family, options["seed"]))

    def fit(image: Any, tree: Tree, **options: Any) -> StandInResult:
        asked.append(options)
        return StandInResult(Family((Member(tree, 30.0),), 0), options["seed"])

    module = ModuleType("unshade.decompose")
    vars(module).update(decompose=decompose, fit=fit)
    monkeypatch.setitem(sys.modules, "unshade.decompose", module)
    return asked


def paint(path: Path, text: str = LIT, size: int = 64) -> Path:
    """A full-frame picture of a tree."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = render(parse(text), sphere_normals(size)).permute(1, 2, 0).mul(255).round().byte().numpy()
    PILImage.fromarray(pixels).save(path)
    return path


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    return paint(tmp_path / "ball.png")


def pixels_of(path: Path) -> np.ndarray:
    with PILImage.open(path) as picture:
        return np.array(picture)


def files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


# --- the package and the reference -----------------------------------------------------------------------------------


def test_help_and_import_load_no_torch() -> None:
    code = (
        "import sys, unshade; from unshade import cli; assert 'torch' not in sys.modules; "
        "code = cli.run(['decompose', '--help']); assert 'torch' not in sys.modules and 'numpy' not in sys.modules; sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Usage: unshade decompose" in done.stdout


def test_public_names_are_functions_whatever_was_imported_first() -> None:
    import unshade.render
    import unshade.serde

    assert callable(unshade.render)
    assert unshade.render(unshade.parse(RED), unshade.sphere_normals(8)).shape == (3, 8, 8)
    assert unshade.save is dump
    assert unshade.errors.UnshadeError.exit_code == 1
    assert set(unshade.__all__) <= set(dir(unshade))
    for name in set(unshade.__all__) - {"decompose", "fit"}:
        assert getattr(unshade, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        unshade.rendr  # noqa: B018


def test_every_public_name_has_a_home() -> None:
    assert set(unshade.__all__) == {*unshade._HOMES, "errors", "__version__"}


def _reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location("cli_reference", ROOT / "scripts" / "cli_reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_is_what_help_says() -> None:
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    assert page == _reference().reference(), "run scripts/cli_reference.py"
    for name in cli.cli.commands:
        assert f"## unshade {name}\n" in page


@pytest.mark.parametrize("name", sorted(cli.cli.commands))
def test_every_verb_has_help_with_examples(name: str, run: Run) -> None:
    told = run(name, "--help")
    assert told.code == 0
    assert "Examples:" in told.out
    assert f"unshade {name}" in told.out.split("Examples:")[1]


def test_trees_in_the_examples_can_be_read(run: Run) -> None:
    texts = re.findall(r'"(\w+\(.+\))"', (ROOT / "docs" / "cli.md").read_text(encoding="utf-8"))
    assert len(texts) >= 4
    for text in texts:
        assert run("validate", text).code == 0


def test_without_a_verb_it_says_what_there_is(run: Run) -> None:
    told = run()
    assert told.code == 0
    assert all(name in told.out for name in cli.cli.commands)
    assert "Exit codes:" in told.out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["decmpose"], "No such command"),
        (["render", RED], "'-o'"),
        (["decompose", "a.png"], "-o DIR is missing"),
        (["decompose", "a.png", "-o", "x", "--disc", "1,2"], "three numbers cx,cy,r"),
        (["decompose", "a.png", "-o", "x", "--preset", "fast"], "'draft', 'balanced', 'best'"),
        (["fit", "a.png", "-o", "x"], "either --structure TEXT or --from TREE"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_exit_code_2(arguments: list[str], says: str, run: Run) -> None:
    told = run(*arguments)
    assert told.code == 2
    assert told.err.startswith("unshade: error: ")
    assert says in told.err
    assert told.err.count("\n") == 1


# --- decompose and fit -----------------------------------------------------------------------------------------------


def test_decompose_writes_everything(decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run) -> None:
    told = run(
        "decompose",
        ball,
        "-o",
        tmp_path / "out",
        "--alternatives",
        2,
        "--seed",
        5,
        "--max-values",
        40,
        "--search",
        "depth",
        "--preset",
        "best",
    )
    assert told.code == 0, told.err
    asked = {"preset": "best", "max_values": 40, "seed": 5, "alternatives": 2, "search": "depth", "objective": "l2"}
    networks = {"method": "search", "second_stage": "size", "weights": None, "device": "cpu", "reflections": "lights"}
    assert decomposed == [asked | networks]
    folder = tmp_path / "out" / "ball"
    assert {"tree.json", "render.png", "difference.png", "tree.svg", "report.html"} <= set(files(folder))
    assert len(list((folder / "layers").iterdir())) == 5
    assert (folder / "layers" / "screen.0.multiply.1.diffuse.png").is_file()
    assert len(list((folder / "family").iterdir())) == 2
    assert (folder / "alternatives" / "1.png").is_file()
    assert load_family(folder / "tree.json").tree == parse(LIT) == load(folder / "tree.json")
    assert pixels_of(folder / "render.png").shape == (256, 256, 4)
    assert told.out == ""
    assert "ball.png" in told.err


def test_json_has_the_promised_keys_and_types(decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run) -> None:
    told = run("decompose", ball, "-o", tmp_path / "out", "--artifacts", "tree", "--json")
    (record,) = told.records
    assert list(record) == ["input", "tree", "psnr", "ssim", "st_lpips", "values", "leaves", "seconds", "seed"]
    assert record["tree"] == str(tmp_path / "out" / "ball" / "tree.json")
    assert record["psnr"] > 40
    assert 0.99 < record["ssim"] <= 1
    assert record["st_lpips"] is None
    assert (record["values"], record["leaves"], record["seed"]) == (10, 3, 0)
    assert 0 < record["seconds"] < 60
    assert files(tmp_path / "out") == ["ball/tree.json", "results.jsonl"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--second-stage", "size"], "--second-stage is of --method learned; --method search has none"),
        (["--second-stage", "depth", "--method", "hybrid"], "--method hybrid has none"),
        (["--weights", "nets"], "this asks no network"),
        (["--device", "cuda"], "the search is on the CPU"),
    ],
)
def test_options_of_networks_that_nobody_asks_are_refused(
    options: list[str], says: str, decomposed: list[dict[str, Any]], ball: Path, run: Run
) -> None:
    told = run("decompose", ball, "--artifacts", "none", *options)
    assert told.code == 2 and says in told.err and not decomposed


def test_weights_are_those_of_reflections_too(decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run) -> None:
    told = run("decompose", ball, "--artifacts", "none", "--weights", tmp_path, "--reflections", "picture")
    assert told.code == 0 and decomposed[0]["weights"] == str(tmp_path)


def test_networks_may_be_on_another_device(decomposed: list[dict[str, Any]], ball: Path, run: Run) -> None:
    words = ("decompose", ball, "--artifacts", "none", "--method")
    assert run(*words, "learned", "--second-stage", "none", "--device", "meta").code == 0
    assert run(*words, "hybrid").code == 0
    assert [asked["device"] for asked in decomposed] == ["meta", "cpu"]


def test_missing_weights_are_told_before_the_work(
    decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> None:
        raise unshade.errors.MissingExtraError("st_lpips needs weights")

    monkeypatch.setattr("unshade.models.perceptual.weight_file", missing)
    told = run("decompose", ball, "-o", tmp_path / "out", "--perceptual")
    assert (told.code, told.err) == (6, f"unshade: error: {ball}: st_lpips needs weights\n")
    assert decomposed == []
    assert not (tmp_path / "out").exists()


def test_nothing_is_written_when_nothing_is_asked_for(decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run) -> None:
    told = run("decompose", ball, "--artifacts", "none", "--json", "--quiet")
    assert told.records[0]["tree"] is None
    assert told.err == ""
    assert files(tmp_path) == ["ball.png"]


def test_a_finished_picture_is_skipped_unless_forced_or_asked_otherwise(
    decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run
) -> None:
    common = ("decompose", ball, "-o", tmp_path / "out", "--artifacts", "tree", "--json")
    first = run(*common)
    again = run(*common)
    assert again.records == first.records
    assert "done before" in again.err
    assert len(decomposed) == 1
    run(*common, "--force")
    assert len(decomposed) == 2
    run(*common, "--preset", "draft")
    assert len(decomposed) == 3
    (tmp_path / "out" / "ball" / "tree.json").unlink()
    run(*common, "--preset", "draft")
    assert len(decomposed) == 4
    assert (tmp_path / "out" / "ball" / "tree.json").is_file()


def test_a_failing_picture_is_told_and_the_rest_goes_on(decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run) -> None:
    (tmp_path / "bad.png").write_bytes(b"not a picture")
    paint(tmp_path / "more" / "ball.png", RED)
    inputs = (ball, tmp_path / "bad.png", tmp_path / "more", tmp_path / "missing.png")
    told = run("decompose", *inputs, "-o", tmp_path / "out", "--artifacts", "tree", "--json", "--workers", 1)
    assert told.code == 7
    assert [record["input"] for record in told.records] == [
        str(path) for path in (ball, inputs[1], tmp_path / "more" / "ball.png", inputs[3])
    ]
    assert [("error" in record) for record in told.records] == [False, True, False, True]
    assert told.records[1]["exit_code"] == 3
    assert "bad.png" in told.records[1]["error"]
    assert "2 done, 0 done before, 2 failed" in told.err
    errors = [line for line in told.err.splitlines() if line.startswith("unshade: error:")]
    assert len(errors) == 2
    assert files(tmp_path / "out") == ["ball-2/tree.json", "ball/tree.json", "results.jsonl"]


def test_an_unexpected_failure_of_one_picture_is_one_line(
    decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ValueError("two\nlines")

    monkeypatch.setattr(sys.modules["unshade.decompose"], "decompose", broken)
    told = run("decompose", ball, "-o", tmp_path / "out")
    assert told.code == 1
    assert told.err == f"unshade: error: {ball}: unexpected ValueError: two lines\n"
    assert not (tmp_path / "out").exists()


def test_an_interrupt_keeps_what_is_done(decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run) -> None:
    white = paint(tmp_path / "white.png", "albedo(#ffffff)")
    third = paint(tmp_path / "third.png", RED)
    arguments = ("decompose", ball, white, third, "-o", tmp_path / "out", "--artifacts", "tree", "--json", "--workers", 1)
    told = run(*arguments)
    assert told.code == 130
    assert told.err.splitlines()[-1] == "unshade: error: interrupted; what was done is kept"
    assert [record["input"] for record in told.records] == [str(ball)]
    assert files(tmp_path / "out") == ["ball/tree.json", "results.jsonl"]


def test_fit_starts_from_a_text_or_a_tree(decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run) -> None:
    told = run("fit", ball, "--structure", RED, "-o", tmp_path / "out", "--json", "--artifacts", "tree")
    assert told.code == 0, told.err
    assert told.records[0]["values"] == 6
    assert load(tmp_path / "out" / "ball" / "tree.json") == parse(RED)
    dump(parse(LIT), tmp_path / "lit.json")
    told = run(
        "fit", ball, "--from", tmp_path / "lit.json", "--lock", "screen.1", "--lock", "screen.0", "--seed", 3, "-o", tmp_path / "out"
    )
    assert told.code == 0, told.err
    assert tuple(decomposed[-1]["locked"]) == ("screen.1", "screen.0")
    assert decomposed[-1]["seed"] == 3
    assert load(tmp_path / "out" / "ball" / "tree.json") == parse(LIT)


def test_what_fit_wrote_does_not_count_as_decomposed(decomposed: list[dict[str, Any]], ball: Path, tmp_path: Path, run: Run) -> None:
    common = ("decompose", ball, "-o", tmp_path / "out", "--artifacts", "tree")
    run(*common)
    run("fit", ball, "--structure", RED, "-o", tmp_path / "out", "--artifacts", "tree")
    run(*common)
    assert load(tmp_path / "out" / "ball" / "tree.json") == parse(LIT)


# --- trees -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def tree_file(tmp_path: Path) -> Path:
    path = tmp_path / "out" / "lit" / "tree.json"
    path.parent.mkdir(parents=True)
    dump(parse(LIT), path)
    return path


def test_render_draws_what_the_renderer_renders(tree_file: Path, tmp_path: Path, run: Run) -> None:
    for source in (tree_file, tree_file.parent, LIT):
        assert run("render", source, "-o", tmp_path / "drawn.png", "--size", 48).code == 0
        pixels = pixels_of(tmp_path / "drawn.png")
        assert pixels.shape == (48, 48, 4)
        expected = render(parse(LIT), sphere_normals(48)).permute(1, 2, 0).mul(255).round().byte().numpy()
        assert np.abs(pixels[..., :3].astype(int) - expected).max() <= 1
        assert pixels[24, 24, 3] == 255
        assert pixels[0, 0, 3] == 0


def test_render_in_bands_is_render_at_once(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from unshade import artifacts

    monkeypatch.setattr(artifacts, "BAND_PIXELS", 500)
    assert run("render", LIT, "-o", tmp_path / "drawn.png", "--size", 50).code == 0
    pixels = pixels_of(tmp_path / "drawn.png")[..., :3]
    expected = render(parse(LIT), sphere_normals(50)).permute(1, 2, 0).mul(255).round().byte().numpy()
    assert np.abs(pixels.astype(int) - expected).max() <= 1


def test_render_tells_the_convention_of_a_normal_map(tmp_path: Path, run: Run) -> None:
    normals, mask = photo_scenes.knot(96)
    pictures = {}
    for name, green in (("up", 1.0), ("down", -1.0)):
        write_picture(tmp_path / f"{name}.png", normals * torch.tensor([1.0, green, 1.0]).view(3, 1, 1) * 0.5 + 0.5, mask)
        drawn = run("render", LIT, "-o", tmp_path / "drawn.png", "--normals", tmp_path / f"{name}.png")
        assert drawn.code == 0 and ("read as DirectX (green down)" in drawn.err) == (name == "down")
        pictures[name] = pixels_of(tmp_path / "drawn.png").astype(int)
    assert np.abs(pictures["up"] - pictures["down"]).max() <= 3
    assert set(np.unique(pictures["up"][..., 3])) >= {0, 255}
    wrong = run("render", LIT, "-o", tmp_path / "x.png", "--normals", tmp_path / "down.png", "--green", "opengl")
    assert wrong.code == 3 and "shows DirectX" in wrong.err
    assert run("render", LIT, "-o", tmp_path / "x.png", "--green", "opengl").code == 2


def test_render_over_normals_and_in_parts(tmp_path: Path, run: Run) -> None:
    normals = sphere_normals(32)[:, 4:20].clone()
    stored = ((normals + 1) * 127.5).round().byte().permute(1, 2, 0).numpy()
    PILImage.fromarray(stored).save(tmp_path / "normals.png")
    assert run("render", LIT, "-o", tmp_path / "shaded.png", "--normals", tmp_path / "normals.png").code == 0
    shaded = torch.from_numpy(pixels_of(tmp_path / "shaded.png")).permute(2, 0, 1) / 255
    assert shaded.shape == (3, 16, 32)
    assert float((shaded - render(parse(LIT), normals)).abs().max()) < 0.1
    for part in ("diffuse", "specular"):
        assert run("render", LIT, "-o", tmp_path / f"{part}.png", "--part", part).code == 0
    diffuse, specular = (pixels_of(tmp_path / f"{part}.png")[..., :3] / 255 for part in ("diffuse", "specular"))
    whole = render(parse(LIT), sphere_normals(256)).permute(1, 2, 0).numpy()
    assert np.abs(1 - (1 - diffuse) * (1 - specular) - whole).max() < 0.01


def test_show_prints_every_node(tree_file: Path, run: Run) -> None:
    told = run("show", tree_file)
    assert told.code == 0
    lines = told.out.splitlines()
    assert len(lines) == 5
    assert [word in line for word, line in zip(("screen", "multiply", "albedo", "diffuse", "highlight"), lines, strict=True)] == [True] * 5
    assert "#cc2030" in told.out
    assert "screen.0.multiply.1.diffuse" in told.out
    assert "\x1b" not in told.out


def test_show_has_colour_on_a_terminal() -> None:
    from rich.console import Console

    from unshade.terminal import tree_in_colour

    console = Console(force_terminal=True, color_system="truecolor", width=200, legacy_windows=False)
    with console.capture() as captured:
        console.print(tree_in_colour(parse("mix(albedo(#cc2030), albedo(#0000ff), threshold(up))")))
    assert "48;2;204;32;48m" in captured.get()
    assert len(captured.get().splitlines()) == 4


def test_a_tree_comes_from_standard_input(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    import io

    monkeypatch.setattr(sys, "stdin", io.StringIO(RED))
    told = run("info", "-", "--json")
    assert told.records[0]["text"] == str(parse(RED))


def test_info_tells_the_facts(tree_file: Path, tmp_path: Path, run: Run) -> None:
    (facts,) = run("info", tree_file, "--json").records
    assert (facts["values"], facts["leaves"], facts["nodes"], facts["depth"]) == (10, 3, 5, 3)
    assert facts["kinds"] == {"albedo": 1, "diffuse": 1, "highlight": 1, "multiply": 1, "screen": 1}
    assert parse(facts["text"]) == parse(LIT)
    assert facts["family"] == []
    family = Family((Member(parse(RED), 20.0), Member(parse(LIT), math.inf)), 0, (Member(parse(LIT), 21.0),))
    dump(family, tmp_path / "family.json")
    (facts,) = run("info", tmp_path / "family.json", "--json").records
    assert facts["psnr"] == 20.0
    assert [(member["values"], member["psnr"], member.get("chosen", False)) for member in facts["family"]] == [
        (6, 20.0, True),
        (10, None, False),
    ]
    assert facts["alternatives"][0]["psnr"] == 21.0
    told = run("info", tmp_path / "family.json")
    assert "chosen" in told.out
    assert "alternatives" in told.out


def test_diff_pairs_children_in_any_order(run: Run) -> None:
    other = "screen(highlight(right up), multiply(diffuse(left up, ambient=0.25), albedo(#cc2030)), rim(down))"
    (found,) = run("diff", LIT, other, "--json").records
    assert [(c["what"], c["address"], c["parameter"]) for c in found["changes"]] == [
        ("changed", "screen.0.multiply.1.diffuse", "ambient"),
        ("added", "screen.2.rim", ""),
    ]
    assert (found["changes"][0]["before"], found["changes"][0]["after"]) == ("0.2", "0.25")
    assert found["same"] is False
    assert 10 < found["psnr"] < 60
    assert found["distance"] > 0
    told = run("diff", LIT, other)
    assert "~ screen.0.multiply.1.diffuse.ambient: 0.2 -> 0.25" in told.out
    assert "+ screen.2.rim: rim" in told.out


def test_diff_of_equal_trees(run: Run) -> None:
    (found,) = run("diff", LIT, LIT, "--json").records
    assert (found["same"], found["changes"], found["distance"], found["psnr"]) == (True, [], 0, None)
    assert "the same tree" in run("diff", LIT, LIT).out


def test_validate_tells_each_tree(tree_file: Path, tmp_path: Path, run: Run) -> None:
    assert run("validate", tree_file, RED).out.count("good") == 2
    (tmp_path / "bad.json").write_text("{}")
    told = run("validate", tree_file, tmp_path / "bad.json", tree_file)
    assert told.code == 4
    assert told.out.count("good") == 2
    assert told.err.startswith(f"unshade: error: {tmp_path / 'bad.json'}: ")
    assert told.err.count("\n") == 1


def test_sample_is_seeded(tmp_path: Path, run: Run) -> None:
    assert run("sample", "-o", tmp_path / "trees", "--count", 3, "--style", "toon", "--seed", 7, "--size", 32).code == 0
    assert files(tmp_path / "trees") == ["0.json", "0.png", "1.json", "1.png", "2.json", "2.png"]
    printed = run("sample", "--count", 3, "--style", "toon", "--seed", 7).out.splitlines()
    assert [parse(line) for line in printed] == [load(tmp_path / "trees" / f"{k}.json") for k in range(3)]
    assert len(set(printed)) == 3


def test_the_ablation_needs_the_method_that_it_takes_apart(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    import unshade.experiments

    asked: list[Any] = []
    monkeypatch.setattr(unshade.experiments, "run", lambda options: asked.append(options.parts) or SimpleNamespace(failed=[]))
    told = run("experiments", "ablation", "wild", "--method", "search:draft", "-o", tmp_path)
    assert told.code == 2 and "add --method learned" in told.err and not asked
    assert run("experiments", "--method", "search:draft", "-o", tmp_path).code == 0
    assert run("experiments", "--method", "learned", "-o", tmp_path).code == 0
    assert "ablation" not in asked[0] and "wild" in asked[0] and "ablation" in asked[1]


# --- as a program ----------------------------------------------------------------------------------------------------


def program(*arguments: object, **options: Any) -> subprocess.Popen[str]:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    return subprocess.Popen([sys.executable, "-m", "unshade", *map(str, arguments)], **pipes)


@pytest.mark.skipif(os.name == "nt", reason="closing a pipe is told otherwise on Windows")
def test_a_reader_that_goes_away_is_no_error() -> None:
    with program("sample", "--count", 100000) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.wait(timeout=60) == 141
        assert process.stderr.read() == ""


def test_a_traceback_only_on_request(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    told = run("show", "albedo(#fff")
    assert told.code == 4
    assert "Traceback" not in told.err
    monkeypatch.setenv("UNSHADE_DEBUG", "1")
    assert "Traceback" in run("show", "albedo(#fff").err
