"""Parts of a tree, moving them, the analogy, and repeating an edit on another tree."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import pytest
import torch
from hypothesis import given

from strategies import trees
from unshade.analogy import analogy
from unshade.cli import run as run_command
from unshade.components import Component, put_together, take_apart, uses
from unshade.edit import component, components, mix, move_light, remove, set_value, transfer
from unshade.errors import PictureError, TreeError
from unshade.grammar import sample
from unshade.metrics import psnr
from unshade.models import weights
from unshade.nodes import Leaf, Tree, walk
from unshade.pictures import write_picture
from unshade.render import render
from unshade.replay import match, replay
from unshade.serde import parse
from unshade.sphere import disc_mask, sphere_normals

NORMALS = sphere_normals(32, dtype=torch.float64)

A = parse("screen(multiply(mix(albedo(red), albedo(blue), stripe(up)), diffuse(left up)), highlight(left up, 60), rim(up))")
B = parse("screen(multiply(albedo(teal), toon_diffuse(up), toon_diffuse(left)), toon_highlight(up), environment(up, 9, gold))")


def same(a: Tree, b: Tree) -> bool:
    return bool((render(a, NORMALS) - render(b, NORMALS)).abs().max() < 1e-9)


@given(trees())
def test_parts_make_the_same_picture(tree: Tree) -> None:
    assert same(dataclasses.replace(tree, root=put_together(take_apart(tree.root))), tree)


@given(trees())
def test_every_leaf_has_a_use(tree: Tree) -> None:
    assert list(uses(tree.root)) == [address for address, node in tree.walk() if isinstance(node, Leaf)]


def test_uses() -> None:
    tree = parse(
        "mix(albedo(black), screen(multiply(albedo(red), diffuse(), highlight(up, 50)), highlight(front, 60), "
        "multiply(albedo(gold), highlight(left, 1)), multiply(albedo(navy), rim())), threshold(up))"
    )
    known = {address: (use.component.value, use.top, use.tint, use.over) for address, use in uses(tree.root).items()}
    assert known == {
        "mix.0.albedo": ("albedo", False, False, True),
        "mix.1.screen.0.multiply.0.albedo": ("albedo", False, False, False),
        "mix.1.screen.0.multiply.1.diffuse": ("diffuse", False, False, False),
        "mix.1.screen.0.multiply.2.highlight": ("diffuse", False, False, False),
        "mix.1.screen.1.highlight": ("highlights", True, False, False),
        "mix.1.screen.2.multiply.0.albedo": ("diffuse", True, True, False),
        "mix.1.screen.2.multiply.1.highlight": ("diffuse", True, False, False),
        "mix.1.screen.3.multiply.0.albedo": ("rim", True, True, False),
        "mix.1.screen.3.multiply.1.rim": ("rim", True, False, False),
        "mix.mask": ("albedo", False, False, True),
    }


@given(trees(max_leaves=5))
def test_a_component_moved_onto_itself_changes_nothing(tree: Tree) -> None:
    """But for trees whose sides are mixed: there the parts are mixed, not the sides."""
    if any(node.kind == "mix" for _, node in tree.walk()):
        return
    for which in Component:
        assert same(transfer(tree, tree, which), tree)


@given(trees(max_leaves=5), trees(max_leaves=5))
def test_any_component_of_any_tree_moves(a: Tree, b: Tree) -> None:
    if a.blend_space != b.blend_space:
        with pytest.raises(TreeError, match="cannot move rim"):
            transfer(a, b, "rim")
        return
    for which in Component:
        picture = render(transfer(a, b, which), NORMALS)
        assert float(picture.min()) >= -1e-9 and float(picture.max()) <= 1.0 + 1e-9


def test_transfer() -> None:
    paint, form, lights = "mix(albedo(red), albedo(blue), stripe(up))", "diffuse(left up)", "highlight(left up, 60), rim(up)"
    expected = {
        "albedo": f"screen(multiply(albedo(teal), {form}), {lights})",
        "diffuse": f"screen(multiply({paint}, toon_diffuse(up), toon_diffuse(left)), {lights})",
        "highlights": f"screen(multiply({paint}, {form}), toon_highlight(up), rim(up))",
        "rim": f"screen(multiply({paint}, {form}), highlight(left up, 60))",
    }
    for which, text in expected.items():
        assert same(transfer(B, A, which), parse(text)), which
    assert set(components(A)) == {Component.ALBEDO, Component.DIFFUSE, Component.HIGHLIGHTS, Component.RIM}
    assert component(A, "environment") is None
    everything = mix(A, B, [which.value for which in Component])
    assert same(everything, B)
    with pytest.raises(TreeError, match="did you mean 'albedo'"):
        transfer(A, B, "albdo")


def test_paint_over_the_whole_stays() -> None:
    outlined = parse("mix(albedo(black), screen(multiply(albedo(red), diffuse(up)), highlight()), threshold(up, 0.9))")
    moved = transfer(B, outlined, "albedo")
    assert same(moved, parse("mix(albedo(black), screen(multiply(albedo(teal), diffuse(up)), highlight()), threshold(up, 0.9))"))
    assert component(outlined, "albedo") == parse("albedo(red)").root


def test_sides_with_the_same_light_share_it() -> None:
    """What `canonical` writes, the light on both sides of a mix, is understood as one light on mixed paint."""
    tree = parse(
        "mix(screen(multiply(albedo(red), diffuse(up)), rim()), screen(multiply(albedo(blue), diffuse(up)), rim()), threshold(up))"
    )
    assert component(tree, "diffuse") == parse("diffuse(up)").root
    assert component(tree, "rim") == parse("rim()").root
    assert component(tree, "albedo") == parse("mix(albedo(red), albedo(blue), threshold(up))").root


def test_broad_lights_take_the_colour_of_their_new_paint() -> None:
    tree = parse("screen(multiply(albedo(#c04040), diffuse(up)), multiply(albedo(#602020), highlight(left, 1)))")
    green = transfer(parse("multiply(albedo(#40c040), diffuse(up))"), tree, "albedo")
    red, lit, _ = green.find("screen.1.multiply.0")["color"]  # type: ignore[index]
    assert lit > 2 * red


# The analogy


@pytest.mark.parametrize("which", list(Component))
def test_analogy_of_trees(which: Component) -> None:
    generator = torch.Generator().manual_seed(3)
    a, p = (sample(generator, "realistic", environment=True, rim=True) for _ in range(2))
    b, q = (sample(generator, "realistic", environment=True, rim=True) for _ in range(2))
    found = analogy(a, b, transfer(b, a, which), p, q)
    assert found.component is which and found.sure
    assert same(found.tree, transfer(q, p, which))
    report = found.report()
    assert report["component"] == which.value and report["scores_db"][which.value] == max(report["scores_db"].values())


def test_analogy_of_pictures() -> None:
    a, b = (
        parse("screen(multiply(albedo(red), diffuse(left up)), highlight(right up, 60))"),
        parse("multiply(albedo(teal), diffuse(down, 0.3))"),
    )
    p, q = parse("multiply(albedo(gold), diffuse(right))"), parse("multiply(albedo(navy), diffuse(up))")
    pictures = [render(tree, sphere_normals(256)).clamp(0, 1) for tree in (a, b, transfer(b, a, "albedo"), p, q)]
    told: list[str] = []
    found = analogy(*pictures, preset="draft", told=told.append)
    assert found.component is Component.ALBEDO and told == ["A", "B", "P", "Q"]
    wanted = render(parse("multiply(albedo(navy), diffuse(right))"), sphere_normals(256))
    assert psnr(render(found.tree, sphere_normals(256)), wanted) > 40.0


def test_lights_that_stand_for_an_environment_move_with_it() -> None:
    a = parse("screen(multiply(albedo(red), diffuse(left)), highlight(right, 60, 1), highlight(up, 8, 0.4))")
    b = parse("screen(multiply(albedo(blue), diffuse(up)), highlight(left, 60, 1), toon_highlight(down, 0.3))")
    both = transfer(b, a, "environment", stand_ins=True)
    assert [leaf.kind for _, leaf in walk(both.root) if "highlight" in leaf.kind] == ["highlight", "toon_highlight"]
    assert both.find("screen.1.highlight")["direction"] == a.find("screen.1.highlight")["direction"]  # type: ignore[index]
    one, other = "screen(multiply(albedo(red), diffuse(left)), highlight(up, 8, 0.4))", "multiply(albedo(blue), diffuse(up))"
    lit = parse(f"screen(mix({one}, {other}, threshold(left)), highlight(right, 60, 1))")
    gone = transfer(parse("multiply(albedo(red), diffuse(left))"), lit, "environment", stand_ins=True)
    assert sum(node.kind == "highlight" for _, node in walk(gone.root)) == 1, "the one on one side of the mask is gone, too"
    assert same(transfer(b, a, "environment"), a), "without it nothing of a highlight is an environment"


def test_analogy_refuses() -> None:
    grey = parse("multiply(albedo(#808080), diffuse(left up))")
    with pytest.raises(TreeError, match="no component of B changes A"):
        analogy(grey, grey, transfer(B, grey, "albedo"), A, A)
    told: list[str] = []
    with pytest.raises(PictureError, match="no such file"):
        analogy(render(A, sphere_normals(256)).clamp(0, 1), A, "nosuch.png", A, A, told=told.append)
    assert not told, "nothing is decomposed before all five are read"


@pytest.mark.parametrize("as_picture", [False, True])
def test_an_analogy_in_which_nothing_moved_is_refused_before_the_work(as_picture: bool) -> None:
    picture = (render(A, sphere_normals(256)) * 255.0).round() / 255.0
    told: list[str] = []
    near = "is identical to A," if as_picture else r"looks like A, \d\d\.\d dB apart,"
    with pytest.raises(TreeError, match=f"nothing was moved: AB {near}"):
        analogy(picture if as_picture else A, B, picture, picture, B, told=told.append)
    assert not told


def test_an_analogy_is_not_sure_where_nothing_explains_ab_better() -> None:
    """AB is A with some noise, as another encoder leaves it."""
    dark = parse("multiply(albedo(#301010), diffuse(left up))")
    noise = 0.01 * torch.randn(3, 256, 256, generator=torch.Generator().manual_seed(0))
    found = analogy(dark, B, (render(dark, sphere_normals(256)) + noise).clamp(0, 1), A, B)
    assert not found.sure and found.report()["sure"] is False
    assert re.match(r"AB is nearer to A as it is, \d+\.\d dB", found.report()["doubt"])


def test_an_analogy_says_how_reflections_were_held(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert analogy(A, B, transfer(B, A, "albedo"), A, B).report()["reflections"] is None, "no picture was decomposed"
    write_picture(tmp_path / "p.png", render(parse("albedo(red)"), sphere_normals(64)).clamp(0, 1), disc_mask(64).float())
    words = ["analogy", "albedo(red)", "albedo(blue)", "albedo(blue)", str(tmp_path / "p.png"), "albedo(gold)", "--preset", "draft"]
    note = "reflections were held as lights, since the network for pictures of them is missing"
    for folder, held in ((weights.FOLDER, "picture"), (tmp_path, "lights")):
        if held == "lights" or weights.file_of("reflection", folder).is_file():
            monkeypatch.setattr(weights, "FOLDER", folder)
            assert run_command([*words, "-o", str(tmp_path / held)]) == 0
            assert (note in capsys.readouterr().err) == (held == "lights")
            assert json.loads((tmp_path / held / "analogy.json").read_text(encoding="utf-8"))["reflections"] == held


def test_damaged_weights_of_reflections_are_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    weights.file_of("reflection", tmp_path).write_bytes(b"no weights")
    with pytest.raises(weights.WeightsError, match="damaged"):
        analogy(A, B, transfer(B, A, "albedo"), render(A, sphere_normals(256)).clamp(0, 1), B)


# The same edit on another tree


def test_replay_on_another_structure() -> None:
    other = parse(
        "screen(rim(up), multiply(albedo(white), highlight(left up, 60)), "
        "multiply(diffuse(left up), mix(albedo(blue), mix(albedo(red), albedo(#ee0808), threshold(left)), stripe(up, 0.3, 0.4))))"
    )
    assert match(A.root, "screen.1.highlight", other.root) == ["screen.1.multiply.1.highlight"]
    assert set(match(A.root, "screen.0.multiply.0.mix.1.albedo", other.root)) != set()
    moved = replay(A, set_value(A, "highlight.direction=right up"), other)
    assert moved.find("screen.1.multiply.1")["direction"] == pytest.approx((0.7071, 0.7071, 0.0), abs=1e-3)  # type: ignore[index]
    sharper = replay(A, set_value(A, "highlight.sharpness*=3"), other)
    assert sharper.find("screen.1.multiply.1")["sharpness"] == pytest.approx((180.0,))  # type: ignore[index]
    gone = replay(A, remove(A, "highlight"), other)
    assert "highlight" not in {node.kind for _, node in gone.walk()}


def test_replay_on_the_same_tree_is_the_edit() -> None:
    for edit in ("albedo:0.color=#20a040", "diffuse.ambient=0.5", "rim.exponent*=2", "stripe.direction=left"):
        edited = set_value(A, edit)
        assert same(replay(A, edited, A), edited), edit


def test_replay_of_all_kinds_of_edits_at_once() -> None:
    edited = remove(move_light(set_value(A, "highlight.sharpness*=2"), 20.0, 10.0), "rim")
    assert same(replay(A, edited, A), edited)
    two = parse("screen(albedo(#202020), highlight(left, 20), highlight(right, 50))")
    edited = remove(set_value(two, "highlight:1.amplitude=0.5"), "highlight:0")
    assert same(replay(two, edited, two), edited), "the one that is left is told by what it keeps"


def test_replay_refuses() -> None:
    with pytest.raises(TreeError, match=r"nothing like screen\.2\.rim"):
        replay(A, remove(A, "rim"), parse("albedo(red)"))
    with pytest.raises(TreeError, match="not where it adds leaves"):
        replay(parse("albedo(red)"), parse("screen(albedo(red), highlight())"), A)
