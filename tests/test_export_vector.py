"""SVG, PDF and CSS against `render`, in the programs that show them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from export_trees import LEAVES, MASKS, PARAMETRIC, SRGB, TREES
from renderers import by_chromium, by_inkscape, by_pdfium, by_poppler, by_resvg, expected, psnr, rendered
from unshade.edit import remove
from unshade.errors import PictureError
from unshade.export import ExportWarning, export
from unshade.export.css import STYLE, div
from unshade.export.profiles import lobes, profile
from unshade.export.svg import number, svg
from unshade.export.vectors import TOLERANCE, drawn, error, simplified, simulate
from unshade.nodes import Tree
from unshade.serde import load

HERE = Path(__file__).parent
NEAR = 40.0
SVG = "{http://www.w3.org/2000/svg}"
QUICK = ("lit", "deep", "mix-in-mix", "mix-lit", "leaf-rim", "leaf-environment-lobes", "rasters", "leaf-toon_highlight")
BALANCED = load(HERE / "fixtures" / "balanced.json")

HEART = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 90" width="200" height="180">
<path id="heart" d="M50 82 C10 55 4 35 8 24 C13 8 35 4 50 24 C65 4 87 8 92 24 C96 35 90 55 50 82 Z"/>
<circle id="ball" cx="50" cy="45" r="40"/><path id="open" d="M0 0 L50 50 L90 0"/></svg>"""


def drawable() -> list[tuple[str, object]]:
    """Every profile of the fixture leaves and masks."""
    found: list[tuple[str, object]] = []
    for name, leaf in {**LEAVES, **MASKS}.items():
        if leaf.kind == "environment":
            found += [(f"{name}-{k}", lobe) for k, (lobe, _) in enumerate(lobes(leaf))]
        elif leaf.kind not in ("albedo", "image", "image_mask", "environment_map"):
            found.append((name, profile(leaf)))
    return found


@pytest.mark.parametrize(("name", "found"), drawable())
def test_a_drawing_is_near_its_profile(name: str, found: object) -> None:
    assert error(found, drawn(found)) <= 2.0 * TOLERANCE, name  # type: ignore[arg-type]


def test_a_drawing_is_symmetric_and_in_range() -> None:
    found = profile(LEAVES["highlight-grazing"])
    u, v = np.random.default_rng(0).uniform(-0.7, 0.7, (2, 500))
    drawing = drawn(found)
    shown = simulate(drawing, u, v)
    np.testing.assert_allclose(shown, simulate(drawing, u, -v))
    assert shown.min() >= 0.0
    assert shown.max() <= 1.0


def test_simplified_lines_keep_their_distance() -> None:
    points = simplified(np.sin, 0.0, 6.0, 0.01)
    x = np.linspace(0.0, 6.0, 400)
    assert np.abs(np.interp(x, *np.array(points).T) - np.sin(x)).max() <= 0.011
    assert len(points) < 30


def test_numbers_are_short() -> None:
    assert [number(value) for value in (0.5, -0.25, 2.0, -0.00001, 100.0, 10.5)] == [".5", "-.25", "2", "0", "100", "10.5"]


@pytest.mark.parametrize("name", SRGB)
def test_svg_in_resvg(name: str) -> None:
    assert psnr(by_resvg(svg(TREES[name]), 256), expected(TREES[name], 256)) >= NEAR


@pytest.mark.slow
def test_svg_in_inkscape(tmp_path: Path) -> None:
    names = ["mix-stripe", "mix-in-mix", "leaf-toon_diffuse-hard", "screen"]
    for name in names:
        (tmp_path / f"{name}.svg").write_text(svg(TREES[name]), encoding="utf-8")
    shown = by_inkscape([tmp_path / f"{name}.svg" for name in names], 256)
    found = {name: psnr(picture, expected(TREES[name], 256)) for name, picture in zip(names, shown, strict=True)}
    assert min(found.values()) >= NEAR, found


@pytest.mark.slow
def test_inkscape_edits_the_nodes(tmp_path: Path) -> None:
    if shutil.which("inkscape") is None:
        pytest.skip("needs Inkscape (apt-get install inkscape)")
    tree = TREES["screen"]
    light = next(address for address, node in tree.walk() if node.kind == "highlight")
    (tmp_path / "tree.svg").write_text(svg(tree, 256), encoding="utf-8")
    actions = f"select-by-id:{light};delete;export-filename:{tmp_path / 'less.svg'};export-plain-svg;export-do"
    environment = {**os.environ, "HOME": str(tmp_path)}
    command = ["inkscape", f"--actions={actions}", str(tmp_path / "tree.svg")]
    subprocess.run(command, env=environment, capture_output=True, timeout=240, check=True)
    left = {group.get("id") for group in ElementTree.parse(tmp_path / "less.svg").iter(f"{SVG}g")}
    assert {address for address, _ in tree.walk()} - left == {light}
    [shown] = by_inkscape([tmp_path / "less.svg"], 256)
    assert psnr(shown, expected(remove(tree, light), 256)) >= NEAR


@pytest.mark.parametrize("name", PARAMETRIC)
def test_svg_of_parametric_leaves_holds_no_picture(name: str) -> None:
    root = ElementTree.fromstring(svg(TREES[name]))
    assert not list(root.iter(f"{SVG}image"))
    assert not list(root.iter(f"{SVG}filter"))
    groups = {group.get("id") for group in root.iter(f"{SVG}g")}
    assert {address for address, _ in TREES[name].walk()} <= groups


def test_svg_names_are_unique_and_lead_somewhere() -> None:
    text = svg(TREES["mix-in-mix"])
    ids = re.findall(r' id="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'url\(#([^)]+)\)|xlink:href="#([^"]+)"', text)) <= {pair for name in ids for pair in ((name, ""), ("", name))}


def test_names_that_xml_knows_are_escaped() -> None:
    tree = Tree(LEAVES["albedo"])
    hostile = Tree(type(tree.root)(tree.root.kind, tree.root.values, '<&">\x00'))  # type: ignore[call-arg, union-attr]
    assert ElementTree.fromstring(svg(hostile)).tag == f"{SVG}svg"
    assert "<&" not in div(hostile)


@pytest.mark.parametrize("size", [512, pytest.param(2048, marks=pytest.mark.slow)])
def test_a_balanced_tree_stays_sharp_and_small(size: int) -> None:
    text = svg(BALANCED, size)
    assert len(text) < 60_000
    assert psnr(by_resvg(text, size), rendered(BALANCED, size)) >= NEAR


@pytest.mark.slow
@pytest.mark.browser
def test_a_balanced_tree_in_chromium(browser: str, tmp_path: Path) -> None:
    """`scripts/measure_exports.py` does the same at 2048 pixels, which takes Chromium a minute without a GPU."""
    (tmp_path / "tree.svg").write_text(svg(BALANCED), encoding="utf-8")
    [shown] = by_chromium(browser, tmp_path, ['<img src="tree.svg">'], 512)
    assert psnr(shown, rendered(BALANCED, 512)) >= NEAR


@pytest.mark.browser
def test_svg_in_chromium(browser: str, tmp_path: Path) -> None:
    for name in SRGB:
        (tmp_path / f"{name}.svg").write_text(svg(TREES[name], 256), encoding="utf-8")
    shown = by_chromium(browser, tmp_path, [f'<img src="{name}.svg">' for name in SRGB], 256)
    found = {name: psnr(picture, expected(TREES[name], 256)) for name, picture in zip(SRGB, shown, strict=True)}
    assert min(found.values()) >= NEAR, sorted(found.items(), key=lambda entry: entry[1])[:3]


@pytest.mark.browser
def test_css_in_chromium(browser: str, tmp_path: Path) -> None:
    shown = by_chromium(browser, tmp_path, [div(TREES[name], 256) for name in SRGB], 256, f"<style>{STYLE}</style>")
    found = {name: psnr(picture, expected(TREES[name], 256)) for name, picture in zip(SRGB, shown, strict=True)}
    assert min(found.values()) >= NEAR, sorted(found.items(), key=lambda entry: entry[1])[:3]


@pytest.mark.parametrize("name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in SRGB])
def test_pdf_in_pdfium(name: str, tmp_path: Path) -> None:
    pytest.importorskip("pikepdf", reason="needs pikepdf")
    from unshade.export.pdf import write_pdf

    write_pdf(TREES[name], tmp_path / "tree.pdf")
    assert psnr(by_pdfium(tmp_path / "tree.pdf", 256), expected(TREES[name], 256)) >= NEAR


@pytest.mark.parametrize("name", QUICK[:4])
def test_pdf_in_poppler(name: str, tmp_path: Path) -> None:
    pytest.importorskip("pikepdf", reason="needs pikepdf")
    from unshade.export.pdf import write_pdf

    write_pdf(TREES[name], tmp_path / "tree.pdf")
    assert psnr(by_poppler(tmp_path / "tree.pdf", 512), expected(TREES[name], 512)) >= NEAR


def test_pdf_layers_are_the_nodes(tmp_path: Path) -> None:
    pikepdf = pytest.importorskip("pikepdf", reason="needs pikepdf")
    export(TREES["lit"], tmp_path / "tree.pdf", "pdf")
    with pikepdf.open(tmp_path / "tree.pdf") as document:
        names = [str(group.Name) for group in document.Root.OCProperties.OCGs]
        order = document.Root.OCProperties.D.Order
        assert str(order[0].Name) == "screen"
        assert len(order[1]) == 6
    assert sorted(names) == sorted(node.name or node.kind for _, node in TREES["lit"].walk())


@pytest.fixture
def heart(tmp_path: Path) -> Path:
    path = tmp_path / "heart.svg"
    path.write_text(HEART, encoding="utf-8")
    return path


def test_a_ball_as_a_shape_is_the_sphere(heart: Path, tmp_path: Path) -> None:
    export(TREES["lit"], tmp_path / "ball.svg", "svg", shape=heart, region="ball")
    shown = by_resvg((tmp_path / "ball.svg").read_text(encoding="utf-8"), 400)[:360]
    ball = shown[20:340, 40:360]
    assert psnr(ball, expected(TREES["lit"], 320)) >= NEAR


def test_a_shape_is_shaded_inside_and_nowhere_else(heart: Path, tmp_path: Path) -> None:
    export(TREES["lit"], tmp_path / "heart-out.svg", "svg", shape=heart, region="heart")
    export(TREES["lit"], tmp_path / "heart-out.pdf", "pdf", shape=heart, region="heart")
    vector = by_resvg((tmp_path / "heart-out.svg").read_text(encoding="utf-8"), 400)
    page = by_pdfium(tmp_path / "heart-out.pdf", 400)
    height = min(len(vector), len(page))
    inside = page[:height].min(axis=-1) < 0.97
    assert 0.3 < inside.mean() < 0.7
    # The edge is antialiased against white in one and black in the other.
    assert np.quantile(np.abs(vector[:height] - page[:height])[inside], 0.95) < 0.02
    assert vector[2, 2].max() == 0.0


@pytest.mark.parametrize(
    ("region", "message"),
    [(None, "expected one shape, got 3"), ("hart", "did you mean 'heart'"), ("open", "expected a closed path")],
)
def test_a_shape_that_cannot_be_used(heart: Path, tmp_path: Path, region: str | None, message: str) -> None:
    with pytest.raises(PictureError, match=message):
        export(TREES["lit"], tmp_path / "out.svg", "svg", shape=heart, **({"region": region} if region else {}))
    assert not (tmp_path / "out.svg").exists()


def test_linear_light_is_said_and_leaves_are_right() -> None:
    with pytest.warns(ExportWarning, match="operators that work on linear light"):
        export(TREES["linear"], Path("linear.svg"), "svg")
    alone = Tree(LEAVES["diffuse"], "linear")
    assert psnr(by_resvg(svg(alone), 256), expected(alone, 256)) >= NEAR


def test_a_raster_leaf_is_said() -> None:
    with pytest.warns(ExportWarning, match=r"raster leaf as vectors.*at screen\.0\.multiply\.0\.image"):
        export(TREES["rasters"], Path("rasters.svg"), "svg")


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
