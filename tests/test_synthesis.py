"""Synthetic data: halves that share no leaf, batches that depend on nothing but their number, shards that stay whole."""

from __future__ import annotations

import errno
import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from unshade import cli, environments, synthesis, synthesis_shards
from unshade.base_nodes import BASES, SPLITS, half_of
from unshade.blend import BLENDS
from unshade.canonical import structure_key
from unshade.errors import OutputError, TreeError
from unshade.grammar import all_canonical_structures
from unshade.nodes import KINDS, Leaf, Node, Operator, Role, leaf, steps, walk
from unshade.render import render
from unshade.sampler import VISIBLE, every_leaf_shows
from unshade.sphere import disc_mask, sphere_normals
from unshade.synthesis import OPERATORS, TYPES, Batch, batches, examples, plants, trees
from unshade.synthesis_shards import DatasetError, Plan

CASES = list(itertools.product(("realistic", "toon"), SPLITS))
PLAN = Plan("both", "train", seed=3, size=16, trees=9, shard_trees=4)


def leaves(root: Node) -> list[Leaf]:
    return [node for _, node in walk(root) if isinstance(node, Leaf)]


@pytest.fixture(scope="module")
def drawn() -> dict[tuple[str, str], list[Node]]:
    return {case: [tree.root for tree in itertools.islice(trees(*case, seed=1), 96)] for case in CASES}


@pytest.mark.parametrize("case", CASES)
def test_no_leaf_of_one_half_is_in_the_other(drawn: dict[tuple[str, str], list[Node]], case: tuple[str, str]) -> None:
    found = {half_of(node) for root in drawn[case] for node in leaves(root)}
    assert found == {case[1]}


def test_the_halves_are_halves() -> None:
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(2000, 3, generator=generator, dtype=torch.float64).tolist()
    directions = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator, dtype=torch.float64), dim=1).tolist()
    for made in (
        [leaf("albedo", color=color) for color in colors],
        [leaf("diffuse", direction=direction) for direction in directions],
        [leaf("stripe", direction=direction) for direction in directions],
    ):
        share = np.mean([half_of(node) == "test" for node in made])
        assert 0.45 < share < 0.55, made[0].kind
    # A mask and a light of one direction are told apart: their halves are independent of each other.
    both = [half_of(leaf("diffuse", direction=d)) == half_of(leaf("stripe", direction=d)) for d in directions]
    assert 0.4 < np.mean(both) < 0.6


@pytest.mark.parametrize("case", CASES)
def test_every_leaf_shows(drawn: dict[tuple[str, str], list[Node]], case: tuple[str, str]) -> None:
    assert all(every_leaf_shows(root, 0.999 * VISIBLE) for root in drawn[case][:40])


@pytest.mark.parametrize("style", ["realistic", "toon"])
def test_trees_are_of_the_released_grammar_or_the_stated_share_is_wider(drawn: dict[tuple[str, str], list[Node]], style: str) -> None:
    released = set(all_canonical_structures(style, environment=None, rim=None))
    lobes = ("environment", ((0.0, 0.0, 1.0), (10.0,), (0.5, 0.5, 0.5)))

    def plain(node: Node) -> Node:
        """With lobes in place of pictures, and masks and softness as they were."""
        if isinstance(node, Leaf):
            return Leaf(*lobes) if node.kind == "environment_map" else node
        mask = node.mask
        return Operator(node.kind, tuple(plain(child) for child in node.children), mask)

    known = [structure_key(plain(root)) in released for root in drawn[style, "train"] + drawn[style, "test"]]
    share = synthesis.WIDE_SHARE[style]
    # A tree drawn wider may still have a released structure.
    assert 1.0 - share - 0.1 < np.mean(known) < 1.0


@pytest.mark.parametrize("style", ["realistic", "toon"])
def test_all_base_nodes_occur_in_their_ranges(style: str) -> None:
    seen: dict[str, list[np.ndarray]] = {}
    for grove in range(10):
        for plant in plants(style, "train", 5, grove):
            for word, numbers in zip(plant.outline.words, plant.numbers, strict=True):
                if word in BASES:
                    seen.setdefault(word, []).append(numbers.numpy())
    toon = {"toon_diffuse", "toon_highlight", "hard_diffuse", "hard_highlight", "warm", "cool", "ramp", "ink", "outline"}
    real = {"diffuse", "highlight", "environment", "wide_diffuse", "wide_highlight", "broad_highlight", "wide_rim"}
    assert set(seen) == {"albedo", "rim", "threshold", "stripe"} | (toon if style == "toon" else real)
    for word, rows in seen.items():
        table, base = np.stack(rows), BASES[word]
        first = 3
        if word not in ("environment", "toon_highlight"):
            for numbers in base.scalars:
                assert numbers.low - 1e-9 <= table[:, first].min() <= table[:, first].max() <= numbers.high + 1e-9, word
                first += 1
        if KINDS[base.kind].role not in (Role.PAINT, Role.ENVIRONMENT):
            assert np.allclose(np.linalg.norm(table[:, :3], axis=1), 1.0)
            assert base.toward or table[:, 2].min() >= base.lowest - 1e-9


def test_operands_are_in_the_order_of_the_grammar(drawn: dict[tuple[str, str], list[Node]]) -> None:
    for roots in drawn.values():
        for root in roots:
            for _, node in walk(root):
                if isinstance(node, Operator):
                    assert len(node.children) == 2
                    left, right = (child.kind for child in node.children)
                    assert right != "environment_map"
                    assert left != "rim"
                    if node.kind == "multiply" and "diffuse" in (left, right):
                        assert right == "diffuse"


def test_batches_are_what_rendering_one_node_at_a_time_gives() -> None:
    grown = list(plants("both", "train", 2, 0)[:12])
    size = 24
    made, owners = examples(grown, size)
    inside, normals = disc_mask(size), sphere_normals(size)
    row = 0

    def picture(node: Node) -> torch.Tensor:
        # A mask is no tree by itself: shown as a mix of white and black.
        if isinstance(node, Leaf) and KINDS[node.kind].role is Role.MASK:
            node = Operator("mix", (leaf("albedo", color=(1, 1, 1)), leaf("albedo", color=(0, 0, 0))), node)
        return render(node, normals) * inside

    def compare(node: Node) -> None:
        nonlocal row
        if isinstance(node, Leaf):
            return
        for _, below in steps(node):
            compare(below)
        left, right = node.children
        assert OPERATORS[int(made.operator[row])] == node.kind
        for image, part in ((made.parent, node), (made.left, left), (made.right, right)):
            assert torch.allclose(image[row], picture(part), atol=2e-5), node.kind
        expected = picture(node.mask)[:1] if node.mask is not None else torch.zeros(1, size, size)
        assert torch.allclose(made.mask[row], expected, atol=2e-5)
        for code, child in ((made.left_type, left), (made.right_type, right)):
            name = "operator" if isinstance(child, Operator) else child.kind.removesuffix("_map")
            assert TYPES[int(code[row])] == name
        row += 1

    for index, plant in enumerate(grown):
        first = row
        compare(plant.tree().root)
        assert set(owners[first:row].tolist()) == {index}
    assert row == len(made)


def test_a_parent_is_its_operands_joined() -> None:
    batch = next(batches("both", "test", size=16, batch=64, seed=0))
    for index, name in enumerate(OPERATORS):
        rows = batch.operator == index
        assert rows.any()
        layers = [batch.left[rows], batch.right[rows]] + ([batch.mask[rows]] if name == "mix" else [])
        joined = BLENDS[name].apply(*layers) * disc_mask(16)
        assert torch.allclose(batch.parent[rows], joined, atol=1e-6)
    assert (batch.mask[batch.operator != OPERATORS.index("mix")] == 0).all()
    assert all(image.min() >= 0.0 and image.max() <= 1.0 + 1e-6 for image in (batch.parent, batch.left, batch.right, batch.mask))


def same(a: Batch, b: Batch) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("parent", "left", "right", "operator", "mask", "left_type"))


def test_a_batch_depends_on_its_number_alone() -> None:
    def stream(start: int = 0, seed: int = 7, split: str = "train") -> list[Batch]:
        return list(itertools.islice(batches("toon", split, size=8, batch=4, seed=seed, start=start), 20 - start))

    whole = stream()
    for start in (1, 15, 16, 19):
        assert all(same(a, b) for a, b in zip(whole[start:], stream(start), strict=True))
    assert not same(whole[0], stream(seed=8)[0])
    assert not same(whole[0], stream(split="test")[0])
    assert not any(same(a, b) for a, b in itertools.combinations(whole, 2))


@pytest.mark.slow
def test_workers_change_nothing() -> None:
    here = list(itertools.islice(batches("realistic", "train", size=8, batch=8, seed=1, start=14), 6))
    there = list(itertools.islice(batches("realistic", "train", size=8, batch=8, seed=1, start=14, workers=2), 6))
    assert all(same(a, b) for a, b in zip(here, there, strict=True))


def test_trees_begin_anywhere() -> None:
    whole = [str(tree) for tree in itertools.islice(trees("toon", "test", seed=4), 40)]
    assert [str(tree) for tree in itertools.islice(trees("toon", "test", seed=4, start=30), 10)] == whole[30:]
    assert len(set(whole)) == 40


def test_unknown_words_are_named() -> None:
    with pytest.raises(TreeError, match="did you mean 'toon'"):
        next(trees("tone", "train", seed=0))  # type: ignore[arg-type]
    with pytest.raises(TreeError, match="did you mean 'test'"):
        next(batches("toon", "tests", size=8, batch=1, seed=0))


def test_environments_are_as_their_sources_say() -> None:
    listed = json.loads(environments.SOURCES.read_text(encoding="utf-8"))
    names = [entry["name"] for entry in listed["environments"]]
    assert sorted(environments.names("train") + environments.names("test")) == sorted(names)
    assert set(environments.names("train")).isdisjoint(environments.names("test"))
    assert all(listed["sources"][entry["source"]]["licence"] == "CC0-1.0" for entry in listed["environments"])
    assert environments.STORED.stat().st_size < 1_000_000
    for split in SPLITS:
        pictures = environments.panoramas(split)
        assert len(pictures) == len(environments.versions(split))
        assert pictures.min() >= 0.0
        assert pictures.max() <= 1.0
        assert half_of(leaf("environment_map", pixels=environments.raster(split, 5))) == split


def test_blurring_keeps_the_light_and_shows_no_seam() -> None:
    light = torch.zeros(1, 3, 64, 128)
    light[..., 31:33, :1] = 100.0
    light[..., 31:33, -1:] = 100.0
    blurred = environments.blurred(light, 12.0)
    area = torch.sin((torch.arange(64) + 0.5) / 64 * torch.pi)[:, None]
    assert torch.isclose((blurred * area).sum(), (light * area).sum(), rtol=0.02)
    assert torch.allclose(blurred, blurred.flip(-1), atol=1e-4)
    assert blurred[0, 0, 32, 0] > 5 * blurred[0, 0, 32, 20]


def test_a_data_set_is_whole_and_says_what_it_holds(tmp_path: Path) -> None:
    manifest = synthesis_shards.make(PLAN, tmp_path / "new")
    assert manifest["complete"]
    assert synthesis_shards.check(tmp_path / "new") == []
    assert [entry["trees"] for entry in manifest["shards"]] == [4, 4, 1]
    assert sum(manifest["operators"].values()) == manifest["examples"]
    assert sum(manifest["children"].values()) == 2 * manifest["examples"]
    nodes = synthesis_shards.read_shard(tmp_path / "new", manifest["shards"][1])
    made, _ = examples(plants("both", "train", 3, 0)[4:8], 16)
    roots = nodes["image"][nodes["left"] >= 0].float() / 255.0
    assert (roots - made.parent).abs().max() <= 0.5 / 255.0 + 1e-6
    assert nodes["tree"].unique().tolist() == [4, 5, 6, 7]


def test_an_interrupted_data_set_is_completed(tmp_path: Path) -> None:
    fresh = synthesis_shards.make(PLAN, tmp_path / "fresh")

    def stop(made: int, total: int) -> None:
        if made == 1:
            raise KeyboardInterrupt

    folder = tmp_path / "cut"
    with pytest.raises(KeyboardInterrupt):
        synthesis_shards.make(PLAN, folder, done=stop)
    assert not synthesis_shards.read_manifest(folder)["complete"]
    assert synthesis_shards.check(folder) == ["1 of 3 shards were made"]
    kept = (folder / "shard-00000.safetensors").stat().st_mtime_ns
    assert synthesis_shards.make(PLAN, folder) == fresh
    assert (folder / "shard-00000.safetensors").stat().st_mtime_ns == kept
    # More trees add to it, a shard that is gone is made again.
    (folder / "shard-00001.safetensors").unlink()
    longer = synthesis_shards.make(Plan("both", "train", 3, 16, 14, 4), folder)
    assert longer["shards"][:2] == fresh["shards"][:2]
    assert synthesis_shards.check(folder) == []
    assert (folder / "shard-00000.safetensors").stat().st_mtime_ns == kept


def test_a_changed_shard_is_found(tmp_path: Path) -> None:
    manifest = synthesis_shards.make(PLAN, tmp_path)
    path = tmp_path / manifest["shards"][2]["file"]
    good, kept = path.read_bytes(), (tmp_path / manifest["shards"][0]["file"]).stat().st_mtime_ns
    path.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    (wrong,) = synthesis_shards.check(tmp_path)
    assert "shard-00002" in wrong
    assert "checksum" in wrong
    # The same call writes it anew, and no other.
    assert synthesis_shards.make(PLAN, tmp_path) == manifest
    assert path.read_bytes() == good and synthesis_shards.check(tmp_path) == []
    assert (tmp_path / manifest["shards"][0]["file"]).stat().st_mtime_ns == kept


def test_a_full_disk_leaves_what_was_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = itertools.count()
    real = os.fsync

    def full(descriptor: int) -> None:
        if next(calls) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(descriptor)

    with monkeypatch.context() as patched:
        patched.setattr("unshade.files.os.fsync", full)
        with pytest.raises(OutputError, match="No space left"):
            synthesis_shards.make(PLAN, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "shard-00000.safetensors"]
    assert len(synthesis_shards.read_manifest(tmp_path)["shards"]) == 1
    assert synthesis_shards.make(PLAN, tmp_path)["complete"]


def test_what_cannot_fit_is_not_begun(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="needs about"):
        synthesis_shards.make(Plan("toon", "train", 0, 1024, 10_000_000, 256), tmp_path / "huge")
    assert not (tmp_path / "huge").exists()


def test_other_data_is_left_alone(tmp_path: Path) -> None:
    synthesis_shards.make(Plan("toon", "train", 0, 8, 2, 2), tmp_path / "a")
    with pytest.raises(OutputError, match="seed 0, not 1"):
        synthesis_shards.make(Plan("toon", "train", 1, 8, 2, 2), tmp_path / "a")
    with pytest.raises(OutputError, match="holds 2 trees"):
        synthesis_shards.make(Plan("toon", "train", 0, 8, 1, 2), tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="expected an empty folder"):
        synthesis_shards.make(PLAN, tmp_path / "b")
    assert [path.name for path in (tmp_path / "b").iterdir()] == ["letter.txt"]


def test_shards_train_as_the_stream_does(tmp_path: Path) -> None:
    manifest = synthesis_shards.make(PLAN, tmp_path)
    each_round = sum(entry["examples"] // 5 for entry in manifest["shards"])

    def stream(start: int) -> list[Batch]:
        stop = 2 * each_round - start
        return list(itertools.islice(synthesis_shards.shard_batches(tmp_path, batch=5, seed=0, start=start), stop))

    whole = stream(0)
    for start in (1, each_round - 1, each_round, each_round + 3):
        assert all(same(a, b) for a, b in zip(whole[start:], stream(start), strict=True))
    mixes = torch.cat([batch.mask.amax((1, 2, 3)) > 0 for batch in whole])
    assert torch.equal(mixes, torch.cat([batch.operator for batch in whole]) == OPERATORS.index("mix"))
    with pytest.raises(DatasetError, match="no shard has 1000 examples"):
        next(synthesis_shards.shard_batches(tmp_path, batch=1000, seed=0))


def test_the_command_makes_looks_at_and_checks(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = str(tmp_path / "toon")
    made = ["dataset", "make", "toon", "-o", folder, "--trees", "3", "--size", "8", "--workers", "1"]
    assert cli.run([*made, "--json", "--quiet"]) == 0
    told = capfd.readouterr()
    assert json.loads(told.out)["complete"]
    assert told.err == ""
    assert cli.run(["dataset", "info", folder]) == 0
    assert "3 trees" in capfd.readouterr().out
    assert cli.run(["dataset", "check", folder]) == 0
    assert "good" in capfd.readouterr().out
    (Path(folder) / "shard-00000.safetensors").write_bytes(b"")
    assert cli.run(["dataset", "check", folder]) == 1
    assert cli.run([*made, "--seed", "9"]) == OutputError.exit_code
    assert cli.run(["dataset", "info", str(tmp_path)]) == 1
    assert all(line.startswith("unshade: error: ") for line in capfd.readouterr().err.splitlines())


@pytest.mark.slow
def test_the_page_about_the_data_is_fresh() -> None:
    script = Path(__file__).resolve().parent.parent / "scripts" / "dataset_page.py"
    done = subprocess.run([sys.executable, str(script), "--check"], capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stderr
