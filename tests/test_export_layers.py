"""Layered files and MatCaps against `render`: PSD, OpenRaster, PNG, EXR."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from blender_pictures import blender_or_skip, by_workbench
from export_trees import SRGB, TREES
from renderers import by_krita, by_psd_tools, by_pyora, psnr, rendered, scored
from unshade.errors import TreeError, UnshadeError
from unshade.export import export
from unshade.export.matcap import padded
from unshade.export.ora import write_ora
from unshade.nodes import Operator, Tree, leaf
from unshade.pictures import read_sphere
from unshade.render import render
from unshade.sphere import sphere_normals

SIZE = 64
NEAR = 2.0
"""Of 255."""


def assert_near(picture: np.ndarray, tree: Tree, name: str = "", size: int = SIZE) -> None:
    away = 255.0 * np.abs(picture - rendered(tree, size))[scored(size)].max()
    assert away <= NEAR, f"{name}: {away:.2f} of 255"


@pytest.fixture
def psd_tools() -> object:
    return pytest.importorskip("psd_tools", reason="needs psd-tools")


@pytest.mark.parametrize("bits", [8, 16])
def test_psd_in_psd_tools(psd_tools: object, bits: int, tmp_path: Path) -> None:
    from psd_tools import PSDImage

    for name, tree in SRGB.items():
        export(tree, tmp_path / "tree.psd", "psd", size=SIZE, bits=bits)
        document = PSDImage.open(tmp_path / "tree.psd")
        assert document.depth == bits
        shown = by_psd_tools(tmp_path / "tree.psd")
        assert_near(shown[..., :3], tree, name)
        assert shown[scored(SIZE), 3].min() > 0.99
        assert shown[0, 0, 3] == 0.0
        merged = document.numpy("color")
        assert_near(merged, tree, f"{name}, merged")


def composed(layers: object, shape: tuple[int, int], peak: float) -> np.ndarray:
    """What PhotoshopAPI's layers say, blended here: topmost first, groups isolated, masks of 8 or 16 bits."""
    below = np.zeros((*shape, 3))
    for above in reversed(list(layers)):  # type: ignore[call-overload]
        if hasattr(above, "layers"):
            over = composed(above.layers, shape, peak)
        else:
            channels = above.get_image_data()
            over = np.stack([channels[k] for k in range(3)], axis=-1) / peak
        mode = str(above.blend_mode).rpartition(".")[2]
        over = {"normal": over, "multiply": below * over, "screen": 1.0 - (1.0 - below) * (1.0 - over)}[mode]
        share = np.asarray(above.mask).reshape(*shape, 1) / peak if above.has_mask() else 1.0
        below = below + share * (over - below)
    return below


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", ["lit", "mix-in-mix", "mix-lit", "rasters"])
def test_psd_in_photoshopapi(psd_tools: object, name: str, bits: int, tmp_path: Path) -> None:
    api = pytest.importorskip("photoshopapi", reason="needs PhotoshopAPI")
    export(TREES[name], tmp_path / "tree.psd", "psd", size=SIZE, bits=bits)
    document = api.LayeredFile.read(str(tmp_path / "tree.psd"))
    assert_near(composed(document.layers, (SIZE, SIZE), 2.0**bits - 1), TREES[name], name)
    words = sorted(node.name or node.kind for address, node in TREES[name].walk() if not address.endswith(".mask"))
    assert sorted(layer.name for layer in document.flat_layers) == words


@pytest.mark.parametrize("name", TREES)
def test_psd_and_back(psd_tools: object, name: str, tmp_path: Path) -> None:
    from unshade.export.psd import read_psd, write_psd

    write_psd(TREES[name], tmp_path / "tree.psd", 8)
    assert read_psd(tmp_path / "tree.psd") == TREES[name]


def test_edits_of_a_psd_come_back(psd_tools: object, tmp_path: Path) -> None:
    from psd_tools import PSDImage

    from unshade.export.psd import read_psd, write_psd

    path = tmp_path / "tree.psd"
    write_psd(TREES["lit"], path, 16)
    document = PSDImage.open(path)
    layers = {layer.name: layer for layer in document.descendants()}
    layers["window"].visible = False
    layers["sky"].name = "ceiling"
    document.save(path)
    root = read_psd(path).root
    assert isinstance(root, Operator)
    assert [child.name for child in root.children] == ["body", "ceiling"]
    for layer in document.descendants():
        layer.visible = False
    document.save(path)
    with pytest.raises(TreeError, match="no layer of the tree is left visible"):
        read_psd(path)


def test_a_new_colour_in_a_psd_comes_back(psd_tools: object, tmp_path: Path) -> None:
    from unshade.export.psd import read_psd, write_psd

    before, after = Tree(leaf("albedo", color=(0.8, 0.1, 0.2))), Tree(leaf("albedo", color=(0.1, 0.6, 0.2)))
    write_psd(after, tmp_path / "after.psd", 8)
    write_psd(before, tmp_path / "before.psd", 8)
    stored = (tmp_path / "after.psd").read_bytes()
    old, new = (b"[%s, %s, %s]" % tuple(str(number).encode() for number in tree.root["color"]) for tree in (after, before))  # type: ignore[index]
    assert stored.count(old) == 1
    (tmp_path / "painted.psd").write_bytes(stored.replace(old, new))
    found = read_psd(tmp_path / "painted.psd").root["color"]  # type: ignore[index]
    np.testing.assert_allclose(found, after.root["color"], atol=1.0 / 255)  # type: ignore[index]


def test_a_foreign_psd_holds_no_tree(psd_tools: object, tmp_path: Path) -> None:
    from psd_tools import PSDImage

    from unshade.export.psd import read_psd

    PSDImage.new("RGB", (8, 8)).save(tmp_path / "foreign.psd")
    with pytest.raises(TreeError, match="no tree in it"):
        read_psd(tmp_path / "foreign.psd")
    (tmp_path / "broken.psd").write_bytes(b"8BPS broken")
    with pytest.raises(TreeError, match="not a PSD"):
        read_psd(tmp_path / "broken.psd")


def test_ora_in_pyora(tmp_path: Path) -> None:
    for name, tree in SRGB.items():
        write_ora(tree, tmp_path / "tree.ora", SIZE)
        shown = by_pyora(tmp_path / "tree.ora")
        assert_near(shown[..., :3], tree, name)
        assert shown[0, 0, 3] == 0.0


def test_ora_is_laid_out_as_its_specification_says(tmp_path: Path) -> None:
    export(TREES["lit"], tmp_path / "tree.ora", "ora", size=SIZE, bits=16)
    with zipfile.ZipFile(tmp_path / "tree.ora") as archive:
        first = archive.infolist()[0]
        assert (first.filename, first.compress_type) == ("mimetype", zipfile.ZIP_STORED)
        assert archive.read("mimetype") == b"image/openraster"
        assert {"stack.xml", "mergedimage.png", "Thumbnails/thumbnail.png"} <= set(archive.namelist())
        assert Image.open(io.BytesIO(archive.read("Thumbnails/thumbnail.png"))).size == (SIZE, SIZE)
        assert b'isolation="isolate"' in archive.read("stack.xml")


@pytest.mark.slow
def test_ora_in_krita(tmp_path: Path) -> None:
    write_ora(TREES["mix-lit"], tmp_path / "tree.ora", SIZE)
    shown = by_krita(tmp_path / "tree.ora")
    assert_near(shown[..., :3], TREES["mix-lit"])
    assert shown[0, 0, 3] == 0.0


def test_a_matcap_goes_on_past_the_silhouette(tmp_path: Path) -> None:
    tree = TREES["lit"]
    export(tree, tmp_path / "matcap.png", "png", size=96, padding=16, bits=16)
    found = read_sphere(tmp_path / "matcap.png", disc=(48, 48, 32), size=64)
    assert psnr(np.moveaxis(found.image.numpy(), 0, -1), rendered(tree, 64)) >= 60.0
    shown = padded(tree, 96, 16)
    rim = render(tree, torch.nn.functional.normalize(torch.tensor([-1.0, 1.0, 0.0]), dim=0).view(3, 1, 1))
    torch.testing.assert_close(shown[:, :1, :1], rim, atol=1e-3, rtol=0)
    with pytest.raises(UnshadeError, match="padding under half the size"):
        export(tree, tmp_path / "matcap.png", "png", size=32, padding=16)


@pytest.mark.parametrize("target", ["exr", "blender-matcap"])
def test_exr_holds_the_light(target: str, tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR", reason="needs OpenEXR")
    for name, tree in TREES.items():
        export(tree, tmp_path / "matcap.exr", target, size=SIZE, padding=0)
        found = read_sphere(tmp_path / "matcap.exr", disc=(SIZE / 2, SIZE / 2, SIZE / 2), size=SIZE, exposure=tree.exposure)
        assert psnr(np.moveaxis(found.image.numpy(), 0, -1), rendered(tree, SIZE)) >= 60.0, name


def test_blenders_layers_are_form_and_light(tmp_path: Path) -> None:
    library = pytest.importorskip("OpenEXR", reason="needs OpenEXR")
    export(TREES["lit"], tmp_path / "matcap.exr", "blender-matcap", size=SIZE, padding=0)
    with library.File(str(tmp_path / "matcap.exr"), separate_channels=True) as file:
        channels = {name: np.asarray(channel.pixels, dtype=np.float64) for name, channel in file.channels().items()}
    assert set(channels) == {f"{name}.{letter}" for name in ("diffuse", "specular") for letter in "RGBA"}
    assert min(plane.min() for plane in channels.values()) >= 0.0
    body = TREES["lit"].root.children[0]  # type: ignore[union-attr]
    form = np.asarray(read_layer(channels, "diffuse"))
    black_lights = render(Tree(body), sphere_normals(SIZE)).permute(1, 2, 0).numpy()
    sky = TREES["lit"].root.children[2]  # type: ignore[union-attr]
    both = 1.0 - (1.0 - black_lights) * (1.0 - render(Tree(sky), sphere_normals(SIZE)).permute(1, 2, 0).numpy())
    assert psnr(form, both) >= 55.0


def read_layer(channels: dict[str, np.ndarray], name: str) -> np.ndarray:
    """A layer, display-encoded."""
    from unshade.render import srgb_encode

    return srgb_encode(torch.from_numpy(np.stack([channels[f"{name}.{letter}"] for letter in "RGB"], axis=-1))).numpy()


@pytest.mark.slow
def test_blender_shows_the_matcaps(tmp_path: Path) -> None:
    """Also that it adds the layers: the form alone would be far away."""
    blender_or_skip()
    export(TREES["lit"], tmp_path / "layers.exr", "blender-matcap", size=256)
    export(TREES["lit"], tmp_path / "light.exr", "exr", size=250, padding=1)
    export(TREES["lit"], tmp_path / "plain.png", "png", size=250, padding=1)
    shown = by_workbench(tmp_path, 128)
    assert set(shown) == {"layers", "light", "plain"}
    for name, picture in shown.items():
        assert psnr(np.moveaxis(picture, 0, -1), rendered(TREES["lit"], 128)) >= 45.0, name
