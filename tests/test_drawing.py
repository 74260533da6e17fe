"""One picture a node, and the drawn tree."""

from __future__ import annotations

import base64
import io
import re
import xml.etree.ElementTree as ElementTree

import pytest
import torch
from PIL import Image as PillowImage

from unshade import drawing, labels
from unshade.artifacts import layer_name
from unshade.nodes import Leaf, Node, Operator, Raster, Tree, leaf, mix, multiply, screen, walk
from unshade.render import render, srgb_encode
from unshade.sphere import sphere_normals

SVG = "{http://www.w3.org/2000/svg}"


def lamp(name: str | None = None) -> Operator:
    return multiply(leaf("albedo", color=(0.9, 0.6, 0.3)), leaf("highlight", direction=(-1.0, 1.0, 2.0), sharpness=40.0), name=name)


def painted(space: str = "srgb") -> Tree:
    paint = mix(
        leaf("albedo", color=(0.8, 0.2, 0.1), name="lacquer"),
        leaf("albedo", color=(0.1, 0.3, 0.7)),
        leaf("threshold", threshold=0.6, softness=0.2),
    )
    return Tree(screen(multiply(paint, leaf("diffuse", direction=(1.0, 1.0, 1.0))), lamp("window"), leaf("rim")), space)  # type: ignore[arg-type]


def shapes(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


@pytest.mark.parametrize("space", ["srgb", "linear"])
def test_a_layer_is_the_render_of_its_own_subtree(space: str) -> None:
    tree = painted(space)
    layers = drawing.layers(tree, 24)
    assert list(layers) == [address for address, _ in tree.walk()]
    for address, node in tree.walk():
        assert layers[address].shape == (3, 24, 24)
        if not labels.is_mask(node):
            torch.testing.assert_close(layers[address], render(Tree(node, tree.blend_space), sphere_normals(24)))


def test_a_mask_is_grey_and_never_encoded() -> None:
    flat, linear = (drawing.layers(painted(space), 24)["screen.0.multiply.0.mix.mask"] for space in ("srgb", "linear"))
    torch.testing.assert_close(flat, linear)
    torch.testing.assert_close(flat[0], flat[2])
    assert flat.min() == 0.0
    assert flat.max() == 1.0


def test_a_linear_tree_is_shown_encoded() -> None:
    albedo = drawing.layers(Tree(leaf("albedo", color=(0.2, 0.2, 0.2)), "linear"), 4)["albedo"]
    torch.testing.assert_close(albedo, srgb_encode(torch.full((3, 4, 4), 0.2)))


def test_pictures_of_a_deep_tree_have_names_that_a_file_system_takes() -> None:
    root: Node = leaf("albedo")
    for _ in range(40):
        root = screen(leaf("highlight"), root)
    addresses = [address for address, _ in walk(root)]
    names = [layer_name(address) for address in addresses]
    assert max(map(len, addresses)) > 255
    assert max(map(len, names)) < 140
    assert len({name.lower() for name in names}) == len(names)
    assert names[:3] == addresses[:3]
    assert names[-1].endswith(addresses[-1][-40:])


def test_a_deep_tree_is_drawn() -> None:
    node: Leaf | Operator = leaf("diffuse")
    for _ in range(150):
        node = screen(node, leaf("highlight"))
    assert len(drawing.layers(Tree(node), 4)) == 301
    assert shapes(drawing.tree_svg(Tree(node), thumbnail=8)).tag == f"{SVG}svg"


def test_every_node_has_its_picture_and_its_title() -> None:
    tree = painted()
    root = shapes(drawing.tree_svg(tree, thumbnail=32))
    symbols = {symbol.get("id"): symbol for symbol in root.iter(f"{SVG}symbol")}
    used = {use.get("href", "")[1:] for use in root.iter(f"{SVG}use")}
    assert used == set(symbols) == {f"node-{index}" for index in range(len(list(tree.walk())))}
    layers = drawing.layers(tree, 32)
    for index, (address, node) in enumerate(tree.walk()):
        picture = symbols[f"node-{index}"].find(f"{SVG}image")
        if node.kind == "albedo":
            assert picture is None
            continue
        assert picture is not None
        stored = PillowImage.open(io.BytesIO(base64.b64decode(picture.get("href", "").split(",")[1]))).convert("RGB")
        pixels = torch.tensor(list(stored.tobytes())).reshape(32, 32, 3).permute(2, 0, 1) / 255.0
        torch.testing.assert_close(pixels, layers[address], atol=0.6 / 255.0, rtol=0.0)
    titles = " ".join(title.text or "" for title in root.iter(f"{SVG}title"))
    assert "screen.0.multiply.0.mix.mask: threshold" in titles
    assert "screen.0.multiply.0.mix.0.albedo “lacquer”" in titles


def test_a_tinted_light_is_one_sphere_unless_told_otherwise() -> None:
    folded, whole = (shapes(drawing.tree_svg(painted(), thumbnail=8, fold=fold)) for fold in (True, False))
    address = "screen.1.multiply.0.albedo"
    assert address not in [group.get("data-address") for group in folded.iter()]
    assert address in [group.get("data-address") for group in whole.iter()]
    assert float(folded.get("width", 0)) < float(whole.get("width", 0))


def test_spheres_do_not_overlap_and_stay_inside() -> None:
    root = shapes(drawing.tree_svg(painted(), thumbnail=8, fold=False))
    spheres = [tuple(float(use.get(key, 0)) for key in ("x", "y", "width")) for use in root.iter(f"{SVG}use")]
    for index, (x, y, size) in enumerate(spheres):
        assert x >= 0.0 and y >= 0.0 and x + size <= float(root.get("width", 0)) and y + size <= float(root.get("height", 0))
        for u, v, other in spheres[index + 1 :]:
            assert max(abs(x + size / 2 - u - other / 2), abs(y + size / 2 - v - other / 2)) >= (size + other) / 2


def test_words_are_inside_the_drawing_and_operators_are_named() -> None:
    words = [text.text for text in shapes(drawing.tree_svg(painted(), thumbnail=8)).iter(f"{SVG}text")]
    assert {"screen", "mix", "×", "lacquer", "window", "#cc331a", "rim", "exponent 1"} <= set(words)


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "a & b \"c\" 'd'", "nul\x00bell\x07", "\ud800", "]]>", "{{title}}"])
def test_any_name_makes_well_formed_xml(name: str) -> None:
    svg = drawing.tree_svg(Tree(screen(lamp(name), leaf("diffuse", name=name))), title=name, thumbnail=8)
    svg.encode("utf-8")
    titles = [title.text or "" for title in shapes(svg).iter(f"{SVG}title")]
    cleaned = re.sub("[\x00\x07\ud800]", "\ufffd", name)
    assert any(cleaned in title for title in titles)


def test_a_standalone_drawing_needs_no_other_file_and_follows_the_screen() -> None:
    svg = drawing.tree_svg(painted(), thumbnail=8)
    assert "prefers-color-scheme:dark" in svg
    assert not re.findall(r"(?:href|src)=\"(?!#|data:)", svg)
    assert "@font-face" not in svg and "@import" not in svg
    assert "<style>" not in drawing.tree_svg(painted(), thumbnail=8, standalone=False)


def test_a_huge_tree_is_drawn_without_pictures() -> None:
    tree = Tree(screen(*[leaf("highlight") for _ in range(drawing.DRAWN_NODES)]))
    svg = drawing.tree_svg(tree)
    assert "data:image" not in svg
    assert svg.count("<symbol") == drawing.DRAWN_NODES + 1


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("encoding", ["png", "webp"])
def test_lossless_pictures_come_back(channels: int, encoding: str, generator: torch.Generator) -> None:
    picture = torch.rand(channels, 5, 7, generator=generator)
    picture[3:] = 1.0
    data = base64.b64decode(drawing.data_uri(picture, encoding).split(",")[1])
    mode = {1: "L", 3: "RGB", 4: "RGBA"}[channels]
    back = torch.tensor(list(PillowImage.open(io.BytesIO(data)).convert(mode).tobytes())).reshape(5, 7, channels).permute(2, 0, 1)
    assert torch.equal(back, (picture * 255).round().long())


def test_labels_say_what_a_person_looks_for() -> None:
    assert labels.direction((-1.0, 1.0, 1.0)) == "↖ 55°"
    assert labels.direction((0.0, 0.0, 1.0)) == "⊙ 0°"
    assert labels.direction((0.0, -1.0, -1.0)) == "↓ 135°"
    assert labels.direction_words((-1.0, 1.0, 1.0)) == "55 degrees left up"
    assert [labels.number(value) for value in (0.0413, 1.5, 120.0, 4820.4, -2.0, 0.0, 1e-9, float("inf"))] == [
        "0.0413",
        "1.5",
        "120",
        "4820",
        "−2",
        "0",
        "0",
        "∞",
    ]
    assert labels.outline(painted()) == "2 albedos, diffuse, tinted highlight, rim, threshold mask"
    assert labels.key_values(leaf("image", pixels=Raster.from_array(torch.zeros(3, 4, 6)))) == ["6 × 4 pixels"]
    assert labels.shown_color((0.5, 0.5, 0.5), "linear") == "#bcbcbc"
