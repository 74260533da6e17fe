"""The experiments: each part from raw data to the page, with weights that were never trained; what is measured is right."""

from __future__ import annotations

import dataclasses
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from rich.console import Console

from unshade import baselines, second_stage
from unshade.bench.datasets import Case
from unshade.cli import run as command
from unshade.components import Component
from unshade.errors import UnshadeError
from unshade.experiments import Options, jobs, methods, page, parts, run, subjects
from unshade.experiments.damage import ALL, damaged
from unshade.experiments.drawings import DRAWINGS, drawing
from unshade.experiments.options import METHODS, PARTS
from unshade.experiments.pieces import pieces, swapped
from unshade.experiments.runner import write_page
from unshade.experiments.summaries import best_within, figures
from unshade.growth import Effort
from unshade.inference import Inference
from unshade.learned import Settings
from unshade.metrics import psnr
from unshade.models import weights
from unshade.models.config import find
from unshade.nodes import Operator, Tree, leaf, mix, multiply, screen
from unshade.pictures import write_picture
from unshade.presets import PRESETS
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals

RED, BLUE = leaf("albedo", color=(0.8, 0.3, 0.2)), leaf("albedo", color=(0.1, 0.3, 0.9))
FORM, SHADE = leaf("diffuse", ambient=0.3), leaf("toon_diffuse", direction=(0, 1, 1))
LIGHT, RIM = leaf("highlight", direction=(0.3, 0.3, 1), sharpness=50), leaf("rim")
BALL = Tree(screen(screen(multiply(RED, FORM), LIGHT), RIM))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of everything, as they are before training."""
    found = tmp_path_factory.mktemp("weights")
    card = {"config": "tiny", "steps": 0, "of": 1, "examples": 0, "hours": 0.0, "hardware": "none"}
    for name, make in {**weights.MODELS, **weights.BASELINES}.items():
        torch.manual_seed(0)
        weights.save(weights.file_of(name, found), name, make(find("tiny")), find("tiny"), card)
    return found


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One real sphere, and one that must not be shown."""
    found = tmp_path_factory.mktemp("data")
    for name in ("pbr", "wild"):
        (found / name).mkdir()
        write_picture(found / name / "ball.png", render(BALL, sphere_normals(256)), disc_mask(256).float())
    return found


@pytest.fixture(autouse=True)
def _short() -> Iterator[None]:
    """The same experiments with less of each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts.damage, "ALL", ("clean", "jpeg:50", "size:32"))
        patch.setattr(parts, "ABLATION", ("learned:base", "learned:alone"))
        yield


def options(tmp_path: Path, data: Path, folder: Path, *chosen: str, **more: object) -> Options:
    given = Options((), chosen, data, tmp_path, 1, folder, workers=1, perceptual=False)
    return dataclasses.replace(given, **more)  # type: ignore[arg-type]


def test_from_data_to_the_page(tmp_path: Path, data: Path, folder: Path) -> None:
    """Every part, with methods that take no time; pictures of `wild` stay out of what is published."""
    quick = options(tmp_path, data, folder, "cnn", "lstm")
    ran = run(dataclasses.replace(quick, parts=("decomposition", "robustness", "wild")), Console(quiet=True))
    ran.documents |= run(options(tmp_path, data, folder, "lstm", parts=("analogy",)), Console(quiet=True)).documents
    ran.documents |= run(options(tmp_path, data, folder, "learned", parts=("ablation",)), Console(quiet=True)).documents
    ran.documents |= run(options(tmp_path, data, folder, "search:draft", parts=("anytime",)), Console(quiet=True)).documents
    assert not ran.failed
    assert set(ran.documents) == set(PARTS)
    for part in PARTS:
        document = json.loads((quick.results / f"{part}.json").read_text())
        assert document["summary"], part
        assert "albedo(" not in json.dumps(document) and '"tree"' not in json.dumps(document)
    page = quick.page.read_text()
    assert "Not run yet" not in page
    assert "| lstm+fit |" in page and "| realistic | search:draft |" in page and "| lstm | rim |" in page
    for name in ("decomposition", "analogy", "ablation", "robustness", "anytime", "wild"):
        assert (quick.figures / f"{name}.png").stat().st_size > 1000
        assert f"](experiments/{name}.png)" in page
    assert (quick.sheets / "experiments-wild.png").is_file()
    assert {row["dataset"] for row in ran.documents["decomposition"]["summary"]} == {"realistic", "toon", "pbr", "wild"}
    staged = [row["stages"]["second_stage_share"] for row in ran.documents["ablation"]["summary"]]
    assert len(staged) == 6
    steps = ran.documents["anytime"]["rows"][0]["anytime"]
    curve = ran.documents["anytime"]["summary"][0]["curve"]
    assert curve[-1] == {"at": parts.SECONDS[-1], "median": max(step[1] for step in steps), "p10": max(step[1] for step in steps)}


def test_what_is_done_is_not_done_again(tmp_path: Path, data: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = options(tmp_path, data, folder, "lstm", parts=("wild",))
    first = run(asked, Console(quiet=True)).documents["wild"]
    done: list[jobs.Job] = []

    def counted(job: jobs.Job) -> jobs.Row:
        done.append(job)
        return row_of(job)

    row_of = jobs.row_of
    monkeypatch.setattr(jobs, "row_of", counted)
    assert run(asked, Console(quiet=True)).documents["wild"] == first
    assert not done
    run(dataclasses.replace(asked, resume=False), Console(quiet=True))
    assert len(done) == len(first["rows"])


def test_methods_are_added_to_what_is_there(tmp_path: Path, data: Path, folder: Path) -> None:
    first = options(tmp_path, data, folder, "cnn", "lstm", parts=("robustness", "wild"))
    before = run(first, Console(quiet=True)).documents
    picture = (first.figures / "wild.png").read_bytes()
    said = Console(file=io.StringIO(), width=200)
    more = dataclasses.replace(first, methods=("lstm", "transformer"), add=True)
    spoilt = json.loads((first.results / "wild.json").read_text()) | {
        "failed": ["cnn on wild/ball: out of memory", "lstm on wild/ball: killed"]
    }
    (first.results / "wild.json").write_text(json.dumps(spoilt))
    after = run(more, said).documents
    assert after["wild"]["failed"] == ["cnn on wild/ball: out of memory"]
    for part in first.parts:
        kept = [row for row in before[part]["rows"] if row["method"] == "cnn"]
        assert kept and [row for row in after[part]["rows"] if row["method"] == "cnn"] == kept
        assert [row["method"] for row in after[part]["summary"]].count("transformer") == len(kept)
        assert {(row["method"], row["dataset"]) for row in after[part]["summary"]} >= {(row["method"], row["dataset"]) for row in kept}
        assert len(after[part]["rows"]) == len(before[part]["rows"]) * 3 // 2
        assert set(after[part]["weights"]) == {"cnn", "lstm", "transformer"}
        assert after[part]["notes"] == ["Measured last: `lstm`, `transformer`; the other methods are of an earlier run."]
        assert json.loads((first.results / f"{part}.json").read_text()) == after[part]
    # Trees of the earlier run are not kept, so its picture stays.
    assert (first.figures / "wild.png").read_bytes() == picture and "not drawn: wild.png; trees of cnn" in said.file.getvalue()
    assert run(more, Console(quiet=True)).documents == after
    with pytest.raises(UnshadeError, match="limit 1, not 2; leave out --add"):
        run(dataclasses.replace(more, limit=2), Console(quiet=True))
    (first.results / "wild.json").write_text('{"format": 1')
    with pytest.raises(UnshadeError, match=r"wild\.json is not JSON"):
        run(more, Console(quiet=True))


def test_other_weights_are_another_method(tmp_path: Path, folder: Path) -> None:
    before = methods.digest("lstm", folder)
    torch.manual_seed(5)
    card = weights.read_card(weights.file_of("lstm", folder))
    weights.save(weights.file_of("lstm", tmp_path), "lstm", weights.BASELINES["lstm"](find("tiny")), find("tiny"), card)
    assert methods.digest("lstm", tmp_path) != before


def test_other_settings_are_another_method(monkeypatch: pytest.MonkeyPatch) -> None:
    before = {
        method: methods.digest(method, None) for method in ("search:draft", "search:best", "hybrid:draft", "learned", "learned:alone")
    }
    assert len(set(before.values())) == len(before)
    assert methods.digest("learned", None) == methods.digest("learned:full", None)
    monkeypatch.setitem(methods.VARIANTS, "full", Settings(Inference(draws=3)))
    assert methods.digest("learned", None) != before["learned"]
    assert methods.digest("learned:alone", None) == before["learned:alone"]
    monkeypatch.setattr(second_stage, "NODE_EFFORT", Effort(9))
    assert methods.digest("learned:alone", None) != before["learned:alone"]
    assert methods.digest("hybrid:draft", None) == before["hybrid:draft"]


def test_rows_name_the_code_that_measured(tmp_path: Path, data: Path) -> None:
    rows = run(options(tmp_path, data, None, "search:draft", parts=("wild",)), Console(quiet=True)).documents["wild"]["rows"]
    assert {row["commit"] for row in rows} == {jobs.commit()}


def test_what_is_missing_is_named(tmp_path: Path, data: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert methods.missing("search:best", tmp_path) is None
    why = methods.missing("cnn", tmp_path)
    assert why is not None and "unshade train baseline cnn" in why
    ran = run(options(tmp_path, data / "none", tmp_path, "cnn", "search:draft", parts=("wild",)), Console(quiet=True))
    page = (tmp_path / "docs" / "experiments.md").read_text()
    assert "- skipped `cnn`" in page and "- skipped `layered`" in page
    assert set(ran.skipped) == {"cnn"}
    with pytest.raises(UnshadeError, match="no method can run; cnn: "):
        run(options(tmp_path, data, tmp_path, "cnn"), Console(quiet=True))
    for wrong in ("lstn", "search:bast", "learned+fit"):
        with pytest.raises(UnshadeError, match=wrong.partition(":")[0].partition("+")[0]):
            methods.name_of(wrong)
    assert command(["experiments", "wild", "--method", "nosuch", "-o", str(tmp_path)]) == 1
    assert "unknown method 'nosuch'" in capsys.readouterr().err


def test_a_failure_is_told_and_ends_nothing(tmp_path: Path, data: Path, folder: Path) -> None:
    (tmp_path / "data" / "pbr").mkdir(parents=True)
    (tmp_path / "data" / "pbr" / "broken.png").write_bytes(b"no picture")
    ran = run(options(tmp_path, tmp_path / "data", folder, "lstm", parts=("wild",)), Console(quiet=True))
    assert len(ran.failed) == 1 and "lstm on pbr/broken.png: PictureError" in ran.failed[0]
    assert "- failed: lstm on pbr/broken.png" in (tmp_path / "docs" / "experiments.md").read_text()


def test_documents_of_another_version_are_left_out(tmp_path: Path) -> None:
    where = Options(out=tmp_path)
    where.results.mkdir(parents=True)
    (where.results / "wild.json").write_text('{"format": 0}')
    write_page(where)
    assert "Not run yet: `unshade experiments wild`" in where.page.read_text()


def test_names_are_the_commands() -> None:
    from unshade import cli_experiments

    assert cli_experiments.PARTS == PARTS == tuple(parts.PARTS)
    for method in METHODS:
        methods.name_of(method)
    told = cli_experiments.experiments.help or ""
    for word in (*baselines.NAMES, *methods.VARIANTS, *PRESETS, methods.FIT, methods.REFLECTIONS):
        assert re.search(rf"(?<!\w){re.escape(word)}\b", told), f"unshade experiments -h does not mention {word}"


@pytest.mark.parametrize("what", ALL)
def test_damage(what: str) -> None:
    sphere = subjects.known(BALL).sphere
    spoiled, again = damaged(sphere, what, 3), damaged(sphere, what, 3)
    assert torch.equal(spoiled.image, again.image)
    assert spoiled.size == (32 if what == "size:32" else 256)
    if what != "clean" and spoiled.size == 256:
        assert 18.0 < psnr(spoiled.image, sphere.image) < 70.0
    if what == "noise:20":
        inside = disc_mask(256, 0.9) & (sphere.image > 0.2).all(0, keepdim=True) & (sphere.image < 0.8).all(0, keepdim=True)
        assert float((spoiled.image - sphere.image)[:, inside[0]].std()) == pytest.approx(20 / 255, rel=0.1)


def test_a_shifted_disc_shows_the_picture_to_the_lower_left() -> None:
    spot = Tree(leaf("highlight", direction=(0, 0, 1), sharpness=200))
    image = damaged(subjects.known(spot).sphere, "shift:10", 0).image[0]
    row, column = divmod(int(image.argmax()), 256)
    assert column == pytest.approx(127.5 - 12.8 / 2**0.5, abs=1.5)
    assert row == pytest.approx(127.5 + 12.8 / 2**0.5, abs=1.5)


@pytest.mark.parametrize("name", list(DRAWINGS))
def test_drawings(name: str) -> None:
    image = drawing(name)
    assert image.shape == (3, 256, 256)
    assert float(image[:, disc_mask(256)[0]].std()) > 0.05


def test_components_are_told_apart() -> None:
    other = Tree(screen(multiply(mix(BLUE, RED, leaf("threshold")), multiply(SHADE, SHADE)), RIM))
    assert pieces(BALL) == {
        Component.ALBEDO: (RED,),
        Component.DIFFUSE: (FORM,),
        Component.HIGHLIGHTS: (LIGHT,),
        Component.RIM: (RIM,),
        Component.ENVIRONMENT: (),
    }
    found = swapped(BALL, other, Component.DIFFUSE).root
    assert isinstance(found, Operator) and found.children[0] == multiply(RED, SHADE, SHADE)
    assert swapped(other, BALL, Component.RIM).root == Operator("screen", (multiply(mix(BLUE, RED, leaf("threshold")), SHADE, SHADE), RIM))
    for wide in (leaf("albedo"), screen(multiply(RED, FORM), multiply(BLUE, LIGHT)), mix(BALL.root, BLUE, leaf("threshold"))):
        assert pieces(Tree(wide)) is None


def test_questions_show_a_change_and_stay() -> None:
    asked = parts.questions(Component.HIGHLIGHTS, 3, 6, 0)
    assert asked == parts.questions(Component.HIGHLIGHTS, 3, 6, 0)
    assert len(asked) == 3 and {question.dataset for question in asked} == set(subjects.POOLS)
    for question in asked:
        a, _, p, _, ab, answer = parts.truths(question, 0)
        assert a != ab and p != answer


def test_the_true_trees_understand_every_analogy() -> None:
    """With nothing left to decompose, what remains is the task itself."""
    from unshade import serde
    from unshade.experiments.understanding import understood

    for which in (Component.ALBEDO, Component.RIM, Component.ENVIRONMENT):
        question = parts.questions(which, 1, 6, 0)[0]
        found = tuple(serde.dumps(tree) for tree in parts.truths(question, 0)[:4])
        row = understood(dataclasses.replace(question, found=found), 0, False)
        assert row["right"] and row["psnr"] > 45.0
        assert row["with_environment"] == any("environment" in tree for tree in found)


def test_test_trees_do_not_depend_on_how_many_are_asked_for() -> None:
    case = Case("toon", "0003", None, 3)
    assert subjects.load(case, 0).truth == subjects.load(subjects.find_cases("toon", Path("none"), 5)[3], 0).truth
    assert subjects.pool("pool-toon", 2, 0) == subjects.pool("pool-toon", 5, 0)[:2]


def test_a_curve_is_the_median_of_the_best_so_far() -> None:
    """A tree that is worse than one before lowers nothing, and a limit within which some picture has none is left out."""
    rows = [
        {"anytime": [[0.15, 20.0, 5], [0.4, 30.0, 9], [3.0, 26.0, 7]]},
        {"anytime": [[0.05, 10.0, 3], [1.5, 40.0, 9]]},
        {"anytime": [[0.18, 24.0, 4]]},
    ]
    assert parts._over(rows, "anytime", (0.1, 0.2, 0.5, 2.0, 5.0)) == [
        {"at": 0.2, "median": 20.0, "p10": 12.0},
        {"at": 0.5, "median": 24.0, "p10": 12.8},
        {"at": 2.0, "median": 30.0, "p10": 25.2},
        {"at": 5.0, "median": 30.0, "p10": 25.2},
    ]


def test_figures() -> None:
    assert best_within([[1.0, 20.0], [2.0, 30.0], [3.0, 25.0]], 2.5) == 30.0
    assert best_within([[1.0, 20.0]], 0.5) is None
    row = {"psnr": 30.0, "values": 9}
    staged = [
        row | {"stages": {"nodes": n, "second_stage_nodes": k, "left_over": {"draws": k, "loss": 0}, "seconds": {"first stage": 1.0}}}
        for n, k in ((4, 1), (1, 1), (5, 0))
    ]
    found = figures(staged)["stages"]
    assert found["left_over"] == {"draws": 2, "loss": 0}
    assert found["second_stage_share"] == 0.2
    assert found["root_left_over"] == pytest.approx(1 / 3, abs=1e-4)


def test_the_page_says_what_was_aimed_at_and_links_only_to_what_is_there(tmp_path: Path) -> None:
    summary = [{"dataset": "toon", "method": "learned:overall", "pictures": 8, "psnr": {"count": 8, "mean": mean}} for mean in (30.0, 30.1)]
    missed, reached = (page._targets({"decomposition": {"summary": [entry]}})[2] for entry in summary)
    assert missed == "| the paper's method, toon, dB | 30.08 | 30.0 | 8 | no |" and reached.endswith("| 8 | yes |")
    assert page._targets({}) == []
    (tmp_path / "there.md").write_text("")
    text = "[a](there.md#x), [b](gone.md) and\n![c](gone.png)\n![d](there.md)"
    assert page._existing(text, tmp_path) == "[a](there.md#x), b and\n![d](there.md)\n"
