"""Addresses that stand for several nodes, edits, colours, edit scripts, variations, the library page."""

from __future__ import annotations

import dataclasses
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given

from strategies import trees
from unshade.assignment import read_color
from unshade.edit import harden, move_light, remove, rename, set_value, soften
from unshade.edit_script import EditScript
from unshade.errors import AddressError, TreeError
from unshade.library import library_html, parts
from unshade.nodes import Leaf, Raster, Tree, leaf
from unshade.recolor import mean_color, moved_colors, recolor
from unshade.render import render
from unshade.selection import select, select_one
from unshade.serde import dumps, parse
from unshade.sphere import sphere_normals
from unshade.vary import contact_sheet, vary

NORMALS = sphere_normals(32, dtype=torch.float64)

BALL = parse(
    'screen(multiply(albedo(#cc2030), diffuse(left up, 0.2)), highlight(left up, 60, name="key"), '
    "multiply(albedo(gold), highlight(right, 40)), multiply(albedo(navy), highlight(down, 2)), rim(up))"
)


def picture(tree: Tree) -> torch.Tensor:
    return render(tree, NORMALS)


@pytest.mark.parametrize(
    ("where", "found"),
    [
        ("screen.1.highlight", ["screen.1.highlight"]),
        ("screen.1", ["screen.1.highlight"]),
        ("key", ["screen.1.highlight"]),
        ("highlight", ["screen.1.highlight", "screen.2.multiply.1.highlight", "screen.3.multiply.1.highlight"]),
        ("highlight:1", ["screen.2.multiply.1.highlight"]),
        ("multiply.0", ["screen.0.multiply.0.albedo", "screen.2.multiply.0.albedo", "screen.3.multiply.0.albedo"]),
        ("multiply.1.diffuse", ["screen.0.multiply.1.diffuse"]),
        ("rim", ["screen.4.rim"]),
    ],
)
def test_select(where: str, found: list[str]) -> None:
    assert select(BALL.root, where) == found


def test_a_full_address_is_that_node_alone() -> None:
    tree = parse("multiply(albedo(red), screen(multiply(albedo(blue), diffuse()), highlight()))")
    assert select(tree.root, "multiply.0") == ["multiply.0.albedo"]
    assert select(tree.root, "multiply") == ["multiply"]


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("highligt", "did you mean 'highlight'"),
        ("highlight:3", "fits 3 of the nodes, counted from 0"),
        ("screen.9", "no node 'screen.9'"),
        ("kee", "did you mean 'key'"),
        ("", "no node ''"),
    ],
)
def test_select_nothing(where: str, message: str) -> None:
    with pytest.raises(AddressError, match=re.escape(message)):
        select(BALL.root, where)


def test_select_one_of_several() -> None:
    with pytest.raises(AddressError, match="highlight:0 is the first"):
        select_one(BALL.root, "highlight")


@given(trees())
def test_every_address_selects_itself(tree: Tree) -> None:
    for address, _ in tree.walk():
        assert select(tree.root, address) == [address]


def test_set_value() -> None:
    before = dumps(BALL)
    assert set_value(BALL, "multiply.0.color=#3366ff").find("screen.2.multiply.0")["color"] == (0.2, 0.4, 1.0)  # type: ignore[index]
    doubled = set_value(BALL, "highlight.sharpness *= 2")
    assert [doubled.find(a)["sharpness"] for a in select(BALL.root, "highlight")] == [(120.0,), (80.0,), (4.0,)]  # type: ignore[index]
    assert set_value(BALL, "key.direction=right").find("key")["direction"] == (1.0, 0.0, 0.0)  # type: ignore[index]
    for twenty in ("20", "(20)", " ( 20 ) "):
        assert set_value(BALL, f"key.sharpness={twenty}").find("key")["sharpness"] == (20.0,)  # type: ignore[index]
    assert set_value(BALL, "key.direction=0,0,-2").find("key")["direction"] == (0.0, 0.0, -1.0)  # type: ignore[index]
    assert set_value(BALL, "screen.2.color/=2").find("screen.2.multiply.0")["color"][0] == 0.5  # type: ignore[index]
    assert dumps(BALL) == before, "the tree before an edit is still there"


def test_relative_changes_stop_at_the_range() -> None:
    assert set_value(BALL, "key.amplitude*=100").find("key")["amplitude"] == (2.0,)  # type: ignore[index]
    assert set_value(BALL, "diffuse.ambient-=1").find("diffuse")["ambient"] == (0.0,)  # type: ignore[index]


def test_lobes_are_set_together() -> None:
    tree = parse("environment(front, 5, red; left, 6, blue)")
    assert set_value(tree, "environment.sharpness*=2").root["sharpness"] == (10.0, 12.0)  # type: ignore[index]
    assert set_value(tree, "environment.color=white").root["color"] == (1.0,) * 6  # type: ignore[index]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("key.sharpnes=2", "did you mean 'sharpness'"),
        ("screen.sharpness=2", "an operator has none"),
        ("key.sharpness", "expected ADDRESS.PARAMETER=VALUE"),
        ("key.sharpness=many", "expected a number, got 'many'"),
        ("key.sharpness=1e999", "expected a number"),
        ("key.sharpness=((20", "expected a number, got '((20'"),
        ("key.sharpness=(20", "expected a number"),
        ("key.sharpness=20)", "expected a number"),
        ("key.sharpness=((20))", "expected a number"),
        ("key.sharpness=9000", "must be in [0.05, 5000], got 9000 (at screen.1.highlight)"),
        ("key.sharpness/=0", "divided by 0"),
        ("key.direction*=2", "set it with ="),
        ("albedo.color=blurple", "did you mean 'purple'"),
        ("albedo.color*=1,2", "expected 1 or 3 numbers"),
    ],
)
def test_set_value_refuses(text: str, message: str) -> None:
    with pytest.raises(TreeError, match=re.escape(message)):
        set_value(BALL, text)


def test_remove() -> None:
    assert [node.kind for _, node in remove(BALL, "rim").walk()].count("rim") == 0
    without = remove(BALL, "highlight:1")
    assert "screen.2.multiply.1.highlight" in dict(without.walk()), "the broad light has moved up"
    assert len(without.root.children) == 4, "a light takes its colour with it"  # type: ignore[union-attr]
    flat = remove(BALL, "diffuse")
    assert isinstance(flat.find("screen.0"), Leaf), "a form leaves its paint flat"
    mixed = parse("mix(albedo(red), multiply(albedo(blue), diffuse()), threshold(up))")
    assert remove(mixed, "mix.0").root.kind == "multiply"


def test_remove_looks_all_addresses_up_first() -> None:
    together = remove(BALL, "screen.0", "screen.4.rim", "screen.1")
    assert together == remove(remove(remove(BALL, "screen.4"), "screen.1"), "screen.0")


def test_remove_refuses() -> None:
    with pytest.raises(TreeError, match="nothing of the tree"):
        remove(BALL, "screen")
    with pytest.raises(TreeError, match="mask of a mix cannot be removed"):
        remove(parse("mix(albedo(red), albedo(blue), threshold(up))"), "mask")


def test_rename() -> None:
    assert rename(BALL, "rim", "edge").find("edge").kind == "rim"
    assert rename(BALL, "key", None).find("screen.1").name is None


def test_move_light() -> None:
    moved = move_light(parse("screen(highlight(front), highlight(up))"), 90.0, where="highlight:0")
    assert np.allclose(moved.find("screen.0")["direction"], (1, 0, 0))  # type: ignore[index]
    assert moved.find("screen.1")["direction"] == (0.0, 1.0, 0.0)  # type: ignore[index]
    with pytest.raises(TreeError, match="has no direction"):
        move_light(BALL, 10.0, where="albedo:0")


def test_harden_undoes_soften() -> None:
    tree = parse(
        "screen(multiply(albedo(red), toon_diffuse(up, 0.4, 0.1, 0.2)), toon_highlight(front, 0.3, 1, 0), highlight(left, 60), rim(up, 2))"
    )
    soft = soften(tree, 1.7)
    assert soft.find("toon_highlight")["softness"][0] > 0.0  # type: ignore[index]
    assert (picture(harden(soft, 1.7)) - picture(tree)).abs().max() < 1e-6
    middle = [t.find("toon_diffuse")["threshold"][0] + 0.5 * t.find("toon_diffuse")["softness"][0] for t in (tree, soft)]  # type: ignore[index]
    assert middle[0] == pytest.approx(middle[1])


def test_soften_leaves_a_highlight_one_and_form_alone() -> None:
    soft = soften(BALL, 50.0)
    assert soft.find("key")["sharpness"] == (4.0,)  # type: ignore[index]
    assert soft.find("screen.3") == BALL.find("screen.3")
    with pytest.raises(TreeError, match="neither an edge nor a width"):
        soften(BALL, 2.0, "albedo:0")
    with pytest.raises(TreeError, match="positive"):
        soften(BALL, 0.0)


# Colour


def test_recolor_moves_the_mean_and_keeps_differences() -> None:
    tree = parse("screen(multiply(mix(albedo(#aa3030), albedo(#cc6060), threshold(up)), diffuse(up)), highlight())")
    blue = recolor(tree, read_color("#3366ff"))
    found = mean_color(blue.find("screen.0.multiply.0.mix"))
    assert found == pytest.approx((0.2, 0.4, 1.0), abs=0.03)
    lighter, darker = (blue.find(f"screen.0.multiply.0.mix.{k}")["color"] for k in (1, 0))  # type: ignore[index]
    assert sum(lighter) > sum(darker) + 0.3
    assert blue.find("highlight") == tree.find("highlight")


def test_recolor_of_one_paint_is_exact_and_takes_broad_lights_of_its_colour_along() -> None:
    broad = "multiply(albedo(#602020), highlight(left, 1)), multiply(albedo(navy), highlight(right, 1))"
    tree = parse(f"screen(multiply(albedo(#c04040), diffuse(up)), {broad})")
    green = recolor(tree, (0.1, 0.6, 0.2))
    assert green.find("screen.0.multiply.0")["color"] == pytest.approx((0.1, 0.6, 0.2))  # type: ignore[index]
    red, lit, _ = green.find("screen.1.multiply.0")["color"]  # type: ignore[index]
    assert lit > 2 * red
    assert green.find("screen.2.multiply.0") == tree.find("screen.2.multiply.0"), "a light of another colour stays"


def test_recolor_of_a_picture_and_in_linear_light() -> None:
    pixels = Raster.from_array(np.random.default_rng(0).uniform(0.3, 0.5, (3, 4, 4)))
    tree = Tree(leaf("image", pixels=pixels))
    assert mean_color(recolor(tree, (0.2, 0.7, 0.3)).root) == pytest.approx((0.2, 0.7, 0.3), abs=0.05)
    linear = parse("multiply(albedo(red), diffuse()) @linear")
    assert render(recolor(linear, (0.5, 0.5, 0.5)).find("albedo"), NORMALS)[0, 0, 0] == pytest.approx(0.2140, abs=1e-3)


def test_recolor_refuses() -> None:
    with pytest.raises(TreeError, match="no paint to recolour"):
        recolor(parse("screen(highlight(), rim())"), (1.0, 0.0, 0.0))
    with pytest.raises(TreeError, match="holds no colour"):
        recolor(BALL, (1.0, 0.0, 0.0), "rim")
    with pytest.raises(TreeError, match=r"three numbers in \[0, 1\]"):
        recolor(BALL, (2.0, 0.0, 0.0))


def test_colors_moved_to_themselves_stay() -> None:
    colors = np.random.default_rng(1).uniform(0.0, 1.0, (50, 3))
    assert np.allclose(moved_colors(colors, (0.4, 0.5, 0.6), (0.4, 0.5, 0.6)), colors, atol=1e-6)


# Scripts

SCRIPT = """
[[edit]]
set = "highlight.sharpness *= 2"
[[edit]]
move_light = [30, 10]
[[edit]]
recolor = "#3366ff"
[[edit]]
soften = 1.5
where = "rim"
optional = true
[[edit]]
name = "spot"
where = "highlight:0"
[[edit]]
remove = "rim"
optional = true
"""


def test_script() -> None:
    script = EditScript.parse(SCRIPT)
    edited = script.apply(BALL)
    assert edited.find("spot")["sharpness"] == (120.0,)  # type: ignore[index]
    assert "rim" not in dumps(edited)
    plain = parse("screen(multiply(albedo(red), diffuse()), highlight())")
    assert script.apply(plain).find("albedo")["color"] == pytest.approx((0.2, 0.4, 1.0))  # type: ignore[index]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[edit]]\nremoov = 'rim'", "edit 1: unknown word 'remoov'; did you mean 'remove'"),
        ("[[edit]]\nremove = 'rim'\nset = 'a.b=1'", "edit 1: expected one of"),
        ("[[edit]]\nsoften = 'much'", "soften takes a factor, got 'much'"),
        ("[[edit]]\nname = 'x'", "name needs where"),
        ("[[edit]]\nremove = 'rim'\nwhere = 'rim'", "remove takes no where"),
        ("[[edit]]\nremove = 'rim'\noptional = 1", "optional must be true or false"),
        ("[[edits]]\nremove = 'rim'", "expected [[edit]] tables"),
        ("", "expected [[edit]] tables"),
        ("[[edit]", "as TOML"),
        ("edit = [3]", "edit 1: expected a table"),
    ],
)
def test_script_refuses(text: str, message: str) -> None:
    with pytest.raises(TreeError, match=re.escape(message)):
        EditScript.parse(text)


def test_script_says_which_edit_failed() -> None:
    with pytest.raises(AddressError, match=r"edit 1 \(remove\): no node 'rmi'; did you mean 'rim'"):
        EditScript.parse("[[edit]]\nremove = 'rmi'").apply(BALL)


# Variations


def test_variations_are_seeded_and_differ() -> None:
    first, second = list(vary(BALL, 3, seed=4)), list(vary(BALL, 5, seed=4))
    assert first == second[:3]
    assert len({dumps(tree) for tree in second}) == 5
    assert list(vary(BALL, 1, seed=5)) != first[:1]
    assert (picture(next(vary(BALL, 1, strength=0.0))) - picture(BALL)).abs().max() < 1e-6


@pytest.mark.parametrize("aspect", ["light", "color", "shape"])
def test_only_what_varies_varies(aspect: str) -> None:
    varied = next(vary(BALL, 1, strength=1.0, only=[aspect]))
    assert varied != BALL
    directions = [node["direction"] for _, node in varied.walk() if node.kind == "highlight"]  # type: ignore[index]
    assert (directions != [node["direction"] for _, node in BALL.walk() if node.kind == "highlight"]) == (aspect == "light")  # type: ignore[index]
    same_paint = varied.find("screen.0.multiply.0") == BALL.find("screen.0.multiply.0")
    assert same_paint == (aspect != "color")


@given(trees())
def test_any_tree_varies_and_stays_in_range(tree: Tree) -> None:
    for varied in vary(tree, 1, strength=1.0):
        assert [node.kind for _, node in varied.walk()] == [node.kind for _, node in tree.walk()]


def test_contact_sheet() -> None:
    assert contact_sheet([torch.zeros(3, 10, 10)] * 5, gap=2).shape == (3, 26, 38)


def test_vary_refuses() -> None:
    with pytest.raises(TreeError, match="did you mean 'light'"):
        next(vary(BALL, 1, only=["ligth"]))


# Library


def test_library_parts() -> None:
    tree = parse("screen(multiply(mix(albedo(red), albedo(blue), stripe(up)), diffuse(up)), multiply(albedo(gold), highlight()), rim())")
    found = parts([("a", tree), ("b", tree)])
    groups = [entry.group for entry in found]
    assert groups == ["albedo", "albedo", "albedo", "diffuse", "highlights", "rim", "mask"]
    assert found[0].node.kind == "mix" and found[4].node.kind == "multiply"
    assert found[5].sources == ("a: screen.2.rim", "b: screen.2.rim")
    for entry in found:
        if entry.group != "mask":
            assert parse(entry.text).root == entry.node
        else:
            assert parse(f"mix(albedo(red), albedo(blue), {entry.text})").find("mix.mask") == entry.node


def test_library_page_is_offline_and_escaped() -> None:
    page = library_html([("<b>", BALL)], title="A & B")
    assert "A &amp; B" in page and "<b>:" not in page
    assert not re.search(r'(src|href)="(?!data:)', page) and "<!--" not in page
    with pytest.raises(TreeError, match="blends in srgb"):
        library_html([("x", dataclasses.replace(BALL, blend_space="linear"))])
    with pytest.raises(TreeError, match="at least one tree"):
        library_html([])


@pytest.mark.browser
@pytest.mark.slow
def test_library_page_combines(browser: str, tmp_path: Path) -> None:
    page = tmp_path / "parts.html"
    page.write_text(library_html([("ball", BALL)]), encoding="utf-8")
    command = [
        browser,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={tmp_path}/profile",
        "--virtual-time-budget=2000",
        "--dump-dom",
    ]
    done = subprocess.run([*command, page.as_uri()], capture_output=True, text=True, timeout=120, check=True)
    preview = re.search(r'<div id="preview"[^>]*>(.*?)</div>', done.stdout, re.DOTALL)
    assert preview is not None
    assert re.findall(r"mix-blend-mode: (\w+)", preview[1]) == ["multiply", "multiply", "screen"]
    assert len(re.findall(r'<button class="card"[^>]*aria-pressed="true"', done.stdout)) == 3
