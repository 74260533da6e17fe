"""The benchmark: what it measures is right, it can be stopped, and it publishes nothing that renders to a picture."""

from __future__ import annotations

import importlib.util
import itertools
import json
import math

import pytest
import torch

from unshade import bench, serde
from unshade.bench import datasets, measures, methods, report, runner
from unshade.bench.journal import Journal
from unshade.errors import UnshadeError
from unshade.nodes import Tree, count_values, leaf, mix, multiply, screen
from unshade.pictures import Disc, SphereImage, write_picture
from unshade.render import part, render
from unshade.sphere import disc_mask, sphere_normals

SIZE = 64
SCORED = disc_mask(SIZE, 0.97)


def tree(red=0.8, angle=0.0, extra=()):
    light = (math.sin(math.radians(40 + angle)), 0.0, math.cos(math.radians(40 + angle)))
    body = multiply(leaf("albedo", color=(red, 0.3, 0.2)), leaf("diffuse", direction=light, ambient=0.3))
    return Tree(screen(body, leaf("highlight", direction=light, sharpness=50, amplitude=1.2), *extra))


def picture(shown, size=SIZE):
    return render(shown, sphere_normals(size))


def row_of(**changes):
    row = {
        "dataset": "set",
        "name": "a.png",
        "method": "adam:4",
        "seed": 0,
        "perceptual": False,
        "psnr": 30.0,
        "psnr_frame": 31.0,
        "ssim": 0.9,
    }
    return row | {"values": 36, "leaves": 12, "seconds": 1.0, "cpu_seconds": 1.0, "curve": [], "tree": serde.dumps(tree())} | changes


class TestMeasures:
    def test_the_true_tree_is_right_in_every_way(self):
        row = measures.compare_trees(tree(), tree(), SCORED)
        assert row["structure_exact"] and row["structure_right"]
        assert row["light_degrees"] == pytest.approx(0.0, abs=1e-4) and row["color_ciede2000"] == pytest.approx(0.0, abs=1e-4)

    def test_lights_are_matched_by_what_they_are_and_measured_in_degrees(self):
        assert measures.compare_trees(tree(angle=5.0), tree(), SCORED)["light_degrees"] == pytest.approx(5.0, abs=1e-3)
        swapped = Tree(screen(*reversed(tree(angle=3.0).root.children)))
        assert measures.compare_trees(swapped, tree(), SCORED)["light_degrees"] == pytest.approx(3.0, abs=1e-3)

    def test_a_tint_is_the_colour_of_its_light(self):
        def lit(color):
            return tree(extra=[multiply(leaf("albedo", color=color), leaf("rim"))])

        apart = measures.compare_trees(lit((0.9, 0.5, 0.1)), lit((0.5, 0.5, 0.1)), SCORED)["color_ciede2000"]
        paint = measures.compare_trees(tree(red=0.7), tree(red=0.8), SCORED)["color_ciede2000"]
        assert apart > 5.0 and paint > 1.0
        assert measures.compare_trees(lit((0.9, 0.5, 0.1)), lit((0.9, 0.5, 0.1)), SCORED)["color_ciede2000"] == pytest.approx(0.0, abs=1e-4)

    def test_a_smaller_answer_that_looks_the_same_is_right_but_not_exact(self):
        color = (0.8, 0.3, 0.2)
        body = leaf("diffuse", ambient=0.3)
        truth = Tree(
            mix(multiply(leaf("albedo", color=color), body), multiply(leaf("albedo", color=color), body), leaf("threshold", threshold=1.2))
        )
        answer = Tree(multiply(leaf("albedo", color=color), body))
        small = measures.compare_trees(answer, truth, SCORED)
        assert small["structure_right"]
        large = measures.compare_trees(tree(extra=[multiply(leaf("albedo", color=(0, 0, 0)), leaf("rim"))]), tree(), SCORED)
        assert large["truth_psnr"] > measures.EXACT and not (large["structure_right"] and not large["structure_exact"])

    def test_the_diffuse_part_is_scored_against_the_painted_layer(self):
        shown = tree()
        layer = picture(Tree(part(shown.root, "diffuse")))
        subject = datasets.Subject(SphereImage(picture(shown), disc_mask(SIZE), Disc(32, 32, 32, 1.0)), SCORED, None, layer)
        row = measures.measure(subject, shown, perceptual=False)
        assert row["psnr"] == measures.CEILING and row["diffuse_psnr"] == measures.CEILING
        whole = measures.measure(subject, Tree(leaf("albedo")), perceptual=False)
        assert row["diffuse_gain"] == pytest.approx(measures.CEILING - measures.decibels(layer, picture(shown), SCORED))
        assert whole["diffuse_psnr"] < 30 and row["st_lpips"] is None

    def test_the_frame_is_flattered_by_its_black(self):
        subject = datasets.Subject(SphereImage(picture(tree()), disc_mask(SIZE), Disc(32, 32, 32, 1.0)), SCORED)
        row = measures.measure(subject, tree(red=0.7), perceptual=False)
        share = float(SCORED.double().mean())
        assert row["psnr_frame"] - row["psnr"] == pytest.approx(-10 * math.log10(share), abs=1e-6)


class TestDatasets:
    def test_a_sampled_tree_does_not_depend_on_how_many_are_drawn(self):
        cases = datasets.find_cases("sampler:toon", datasets.Path("nowhere"), 3)
        again = datasets.find_cases("sampler:toon", datasets.Path("nowhere"), 9)
        assert [case.name for case in cases] == ["0000", "0001", "0002"]
        first, same = datasets.load(cases[2], 0), datasets.load(again[2], 0)
        assert first.truth == same.truth and first.truth != datasets.load(cases[2], 1).truth
        levels = first.sphere.image * 255.0
        torch.testing.assert_close(levels, levels.round(), rtol=0, atol=1e-3)

    def test_layers_belong_to_their_picture(self, tmp_path):
        folder = tmp_path / "layered"
        folder.mkdir()
        for name, shown in (
            ("a", tree()),
            ("a.diffuse", Tree(part(tree().root, "diffuse"))),
            ("b", tree()),
            ("b.diffuse", Tree(leaf("albedo", color=(0, 0, 0)))),
        ):
            write_picture(folder / f"{name}.png", picture(shown))
        cases = datasets.find_cases("layered", tmp_path, None)
        assert [case.name for case in cases] == ["a.png", "b.png"]
        assert datasets.load(cases[0], 0).diffuse is not None
        assert datasets.load(cases[1], 0).diffuse is None, "a black layer says nothing"

    def test_a_limit_spreads_over_the_names(self, tmp_path):
        folder = tmp_path / "many"
        folder.mkdir()
        for number in range(10):
            (folder / f"{number}.png").touch()
        assert [case.name for case in datasets.find_cases("many", tmp_path, 2)] == ["0.png", "5.png"]
        for limit in range(1, 60):
            fewer, more = datasets.spread(142, limit), datasets.spread(142, limit + 1)
            assert set(fewer) < set(more)
            gaps = [b - a for a, b in itertools.pairwise([*more, more[0] + 142])]
            assert max(gaps) <= 3 * 142 / (limit + 1)


class TestMethods:
    def test_the_fixed_structure_counts_as_documented(self):
        for highlights in (1, 4, 8):
            assert count_values(methods.fixed_structure(picture(tree()), SCORED, highlights)) == 12 + 6 * highlights

    @pytest.mark.parametrize("name", ["secnd:4", "adam:none", "basin:0", "second:99"])
    def test_an_unknown_method_is_refused(self, name):
        with pytest.raises(UnshadeError, match="method"):
            methods.method_of(name)

    def test_an_unknown_method_ends_the_run_before_it_begins(self, tmp_path):
        with pytest.raises(UnshadeError, match="did you mean 'adam'"):
            bench.run(bench.Options(datasets=["sampler:toon"], methods=["adm:4"], out=tmp_path / "results"))
        assert not (tmp_path / "results").exists()


class TestRun:
    @pytest.fixture
    def options(self, tmp_path):
        return bench.Options(
            datasets=["sampler:realistic", "absent"], methods=["adam:1"], data=tmp_path, out=tmp_path / "b", limit=2, workers=1
        )

    @pytest.fixture
    def counted(self, monkeypatch):
        """Tasks done, each answered at once with the true tree."""
        done = []

        def measure(task):
            done.append(task)
            return row_of(dataset=task.case.dataset, name=task.case.name, method=task.method, psnr=20.0 + len(done))

        monkeypatch.setattr(runner, "measure_task", measure)
        return done

    def test_it_measures_and_writes(self, options, capsys):
        measured = bench.run(options)
        assert len(measured.rows) == 2 and not measured.failed
        assert list(measured.skipped) == ["absent"] and "skipped absent" in capsys.readouterr().err
        text = (options.out / "results" / "sampler-realistic.adam-1.json").read_text()
        document = json.loads(text)
        assert document["summary"]["pictures"] == 2 and document["seed"] == 0 and document["versions"]["torch"]
        assert all(row["psnr"] > 10 and row["values"] == 18 and row["cpu_seconds"] > 0 for row in document["pictures"])
        assert "tree" not in document["pictures"][0] and "albedo" not in text and str(options.out) not in text
        page = (options.out / "results.md").read_text()
        assert "## sampler:realistic" in page and "| adam:1 | 2 |" in page and "structure right" in page and "30.89" in page
        assert (options.out / "sheets" / "sampler-realistic.adam-1.png").stat().st_size > 1000
        if importlib.util.find_spec("matplotlib"):
            assert (options.out / "curve.png").exists() and "<svg" in (options.out / "curve.svg").read_text()

    def test_it_goes_on_where_it_was_and_starts_again_when_asked(self, options, counted):
        bench.run(options)
        bench.run(options)
        assert len(counted) == 2
        bench.run(bench.Options(**{**vars(options), "fresh": True}))
        assert len(counted) == 4
        bench.run(bench.Options(**{**vars(options), "seed": 1}))
        assert len(counted) == 6

    def test_an_interrupt_keeps_what_is_done(self, options, counted, monkeypatch):
        answer = runner.measure_task

        def measure(task):
            if counted:
                raise KeyboardInterrupt
            return answer(task)

        monkeypatch.setattr(runner, "measure_task", measure)
        with pytest.raises(KeyboardInterrupt):
            bench.main(options)
        assert json.loads((options.out / "results" / "sampler-realistic.adam-1.json").read_text())["summary"]["pictures"] == 1
        monkeypatch.setattr(runner, "measure_task", answer)
        bench.main(options)
        assert [task.case.name for task in counted] == ["0000", "0001"]

    def test_a_failure_does_not_end_the_run_and_is_no_success(self, options, counted, monkeypatch, capsys):
        answer = runner.measure_task
        monkeypatch.setattr(runner, "measure_task", lambda task: {"error": "ValueError: no"} if task.case.number == 0 else answer(task))
        with pytest.raises(UnshadeError, match="1 of 2 measurements failed"):
            bench.main(options)
        assert "failed: adam:1 on sampler:realistic/0000: ValueError: no" in capsys.readouterr().err

    def test_no_data_set_at_all_is_an_error(self, options):
        with pytest.raises(UnshadeError, match="absent"):
            bench.run(bench.Options(**{**vars(options), "datasets": ["absent"]}))

    def test_the_words_of_a_command_line(self, options, counted):
        words = f"--dataset sampler:toon --method adam:2 --limit 1 --workers 1 --seed 3 --out {options.out}".split()
        bench.main(words)
        assert [(task.case.dataset, task.method, task.seed) for task in counted] == [("sampler:toon", "adam:2", 3)]

    @pytest.mark.slow
    def test_processes_find_what_one_finds(self, options, tmp_path):
        alone = bench.run(options).rows
        together = bench.run(bench.Options(**{**vars(options), "workers": 2, "out": tmp_path / "c"})).rows
        assert [row["tree"] for row in alone] == [row["tree"] for row in together]


class TestReport:
    def test_half_a_row_at_the_end_is_not_a_row(self, tmp_path):
        path = tmp_path / "journal.jsonl"
        journal = Journal(path)
        journal.add(row_of())
        with path.open("a") as file:
            file.write('{"dataset": "set", "na')
        again = Journal(path)
        assert list(again.rows.values()) == [row_of()]
        again.add(row_of(name="b.png"))
        assert len(Journal(path).rows) == 2

    def test_a_summary_says_how_many_and_leaves_out_what_was_not_measured(self):
        rows = [row_of(psnr=float(psnr), diffuse_psnr=28.0 if psnr == 30 else None, st_lpips=None) for psnr in (10, 20, 30)]
        found = report.summary(rows)
        assert found["psnr"] == {"median": 20.0, "mean": 20.0, "p10": 12.0, "count": 3}
        assert found["diffuse_psnr"]["count"] == 1
        assert "st_lpips" not in found and "structure" not in found

    def test_trees_with_environments_stand_apart(self):
        rows = [row_of(has_environment=apart, structure_right=True, structure_exact=not apart) for apart in (False, False, True)]
        found = report.summary(rows)
        assert found["structure"] == {"right": 1.0, "exact": 1.0, "count": 2}
        assert found["structure_with_environment"] == {"right": 1.0, "exact": 0.0, "count": 1}

    def test_the_curve_is_the_best_of_each_size(self):
        rows = [row_of(curve=[[3, 20.0], [9, 30.0], [12, 29.0]]), row_of(curve=[[6, 24.0], [12, 40.0]])]
        found = report.curve(rows)
        assert [(point["values"], point["median"]) for point in found] == [(8, 22.0), (12, 35.0)]
        assert report.curve([row_of()]) == []

    def test_methods_with_fewer_pictures_are_also_compared_on_those(self):
        def document(method, figures):
            rows = [{"name": name, "psnr": psnr} for name, psnr in figures.items()]
            where = {"machine": {"processor": "p", "cores": 2, "system": "s"}, "versions": {}}
            return {"dataset": "wild", "method": method, "summary": report.summary(rows), "pictures": rows} | where

        fast, slow = document("fast", {"a": 30.0, "b": 20.0, "c": 10.0}), document("slow", {"a": 25.0})
        page = report.table([fast, slow])
        assert "| fast | 3 | 20.0 / 20.0 / 12.0 |" in page
        assert "Only the pictures that all of these methods had, 1 in number" in page
        assert "| fast | 1 | 30.0 / 30.0 / 30.0 |" in page
        assert "Only" not in report.table([slow, document("other", {"a": 1.0})])

    def test_the_page_does_not_change_when_nothing_did(self, tmp_path):
        documents = [report.document(bench.Options(), "set", "adam:4", [row_of()])]
        assert report.table(documents) == report.table(json.loads(json.dumps(documents)))
