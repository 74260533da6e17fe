"""From photos with a known answer to the sphere: directions seen, texture, shadow, conventions, outlines, drawings."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch

import photo_scenes as scenes
from unshade import scene_linear
from unshade.color_profiles import srgb_encode
from unshade.errors import PictureError
from unshade.extract import from_ball, from_drawing, from_mask, from_normal_map
from unshade.inflate import inflate
from unshade.metrics import psnr
from unshade.normal_maps import NormalMap, read_normal_map
from unshade.picture_output import write_picture
from unshade.reflectance import coverage, solve
from unshade.render import render
from unshade.sphere import disc_mask, normals_from_xy, sphere_grid, sphere_normals
from unshade.types import Image, Mask, Normals
from unshade.vector_art import Drawing

SIZE = 192
TRUTH = {name: render(scenes.tree_of(name), sphere_normals(128)) for name in scenes.TREES}
DISC = disc_mask(128, 0.97)


def written(folder: Path, image: Image, normals: Normals, mask: Mask, signs: tuple[int, int, int] = (1, 1, 1)) -> tuple[Path, Path]:
    photo, where = folder / "photo.png", folder / "normals.png"
    write_picture(photo, image)
    write_picture(where, normals * torch.tensor(signs).view(3, 1, 1) * 0.5 + 0.5, mask, bits=16)
    return photo, where


@pytest.mark.parametrize(
    ("kind", "fault", "least", "gain"),
    [
        ("clay", "clean", 50.0, -0.1),
        ("wax", "stripes", 40.0, 15.0),
        ("lacquer", "patch", 40.0, 10.0),
        ("wax", "stripes and shadow", 27.0, 9.0),
        ("lacquer", "noise", 33.0, 5.0),
    ],
)
def test_known_tree_comes_back(tmp_path: Path, kind: str, fault: str, least: float, gain: float) -> None:
    """``gain`` is over the plain mean of the pixels that see a direction."""
    normals, mask = scenes.knot(SIZE)
    files = written(tmp_path, scenes.photo(scenes.tree_of(kind), normals, mask, fault), normals, mask)
    found = from_normal_map(*files, size=128)
    plain = from_normal_map(*files, size=128, even=False)
    where = DISC & (found.coverage >= 0.5)
    assert found.seen > 0.95 and not found.guess
    reached = psnr(found.image, TRUTH[kind], where)
    assert reached >= least
    assert reached >= psnr(plain.image, TRUTH[kind], where) + gain
    assert bool(found.paints) == ("stripes" in fault or fault == "patch")


def test_paints_are_named(tmp_path: Path) -> None:
    normals, mask = scenes.knot(SIZE)
    found = from_normal_map(*written(tmp_path, scenes.photo(scenes.tree_of("wax"), normals, mask, "stripes"), normals, mask))
    assert found.paints[0].ratio == pytest.approx((0.45, 0.6, 1.3), abs=0.1) and not found.paints[0].shadow
    assert found.paints[0].share == pytest.approx(0.4, abs=0.08)


def test_unseen_directions_are_filled_cleanly() -> None:
    """Seen from the front only: what was seen is right, the rest goes on without a seam and stays in range."""
    tree = scenes.tree_of("clay")
    generator = np.random.default_rng(0)
    xy = generator.uniform(-1, 1, (40_000, 2))
    xy = xy[np.hypot(*xy.T) < 0.7]
    normals = np.concatenate([xy, np.sqrt(1 - np.square(xy).sum(1, keepdims=True))], axis=1)
    colors = render(tree, torch.from_numpy(normals.T.reshape(3, 1, -1)))[:, 0].T.numpy()
    image = torch.from_numpy(solve(normals, colors, np.ones(len(normals)), 128)).permute(2, 0, 1)
    seen = torch.from_numpy(coverage(normals, np.ones(len(normals)), 128))
    radius = sphere_grid(128).square().sum(0).sqrt()
    assert (seen[radius < 0.66] == 1.0).all() and (seen[radius > 0.82] == 0.0).all()
    assert psnr(image.float(), TRUTH["clay"], (radius < 0.66)[None]) > 45.0
    assert psnr(image.float(), TRUTH["clay"], ((radius > 0.78) & (radius < 0.97))[None]) > 22.0
    step = (image[:, 1:] - image[:, :-1]).abs().amax(0)
    assert float(step[((radius > 0.6) & (radius < 0.9))[1:]].max()) < 0.06


def test_ball_that_the_frame_cuts(tmp_path: Path) -> None:
    picture = torch.full((3, 150, 180), 0.3)
    x, y = sphere_grid(200)
    ball = render(scenes.tree_of("clay"), sphere_normals(200))
    inside = torch.hypot(x, y) < 1.0
    picture[:, :, 20:] = torch.where(inside, ball, 0.3)[:, :150, :160]
    write_picture(tmp_path / "ball.png", picture)
    found = from_ball(tmp_path / "ball.png", disc=(120.0, 100.0, 100.0), size=128)
    assert 0.6 < found.seen < 0.85
    assert psnr(found.image, TRUTH["clay"], DISC & (found.coverage >= 0.5)) > 40.0
    ignored = torch.zeros(1, 150, 180)
    ignored[:, :, :100] = 1.0
    write_picture(tmp_path / "hand.png", ignored)
    less = from_ball(tmp_path / "ball.png", disc=(120.0, 100.0, 100.0), ignore=tmp_path / "hand.png", size=128)
    assert less.seen < found.seen - 0.2 and float(less.mask[0, :, :95].max()) == 0.0


def read(folder: Path, normals: Normals, mask: Mask | None, encode: str = "unit", **options: str) -> NormalMap:
    stored = normals * 0.5 + 0.5
    if encode == "srgb":
        stored = torch.from_numpy(srgb_encode(stored.numpy()))
    elif encode != "unit":
        stored = torch.cat([stored[:2], normals[2:] if encode == "plain blue" else torch.zeros_like(stored[2:])])
    write_picture(folder / "n.png", stored, mask)
    return read_normal_map(folder / "n.png", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("signs", "words"),
    [
        ((1, 1, 1), "OpenGL (green up)"),
        ((1, -1, 1), "DirectX (green down)"),
        ((1, 1, -1), "OpenGL (green up), blue into the picture"),
        ((1, -1, -1), "DirectX (green down), blue into the picture"),
        ((-1, 1, 1), "OpenGL (green up), red to the left"),
    ],
)
def test_axes_are_told_by_the_silhouette(tmp_path: Path, signs: tuple[int, int, int], words: str) -> None:
    for shape in scenes.OBJECTS.values():
        normals, mask = shape(SIZE)
        found = read(tmp_path, normals * torch.tensor(signs).view(3, 1, 1), mask)
        assert str(found.convention) == words and found.told
        assert float((found.normals - normals).abs().amax(0)[mask[0] > 0].max()) < 0.02


def relief(slope: float = 1.0) -> Normals:
    x, y = sphere_grid(160, dtype=torch.float64)
    across = 0.45 * torch.cos(9 * x + 3 * y) - slope * 0.2 * torch.sin(4 * x - 11 * y)
    up = 0.15 * torch.cos(9 * x + 3 * y) + slope * 0.55 * torch.sin(4 * x - 11 * y)
    field = torch.stack([-across, -up, torch.ones_like(x)])
    return field / field.norm(dim=0)


def test_green_of_a_relief_is_told_by_its_curl(tmp_path: Path) -> None:
    for sign, green in ((1, "opengl"), (-1, "directx")):
        found = read(tmp_path, relief() * torch.tensor([1, sign, 1]).view(3, 1, 1), None, space="tangent")
        assert found.convention.green == green and found.told
        assert float((found.normals - relief()).abs().max()) < 0.02


def test_what_cannot_be_told_is_taken_as_asked(tmp_path: Path) -> None:
    x, _ = sphere_grid(64, dtype=torch.float64)
    waves = torch.stack([torch.sin(9 * x), torch.zeros_like(x), torch.ones_like(x)])
    waves = waves / waves.norm(dim=0)
    assert not read(tmp_path, waves, None).told
    assert read(tmp_path, waves, None, green="directx").convention.green == "directx"


@pytest.mark.parametrize("encode", ["srgb", "plain blue", "two channels"])
def test_encodings_are_told(tmp_path: Path, encode: str) -> None:
    normals, mask = scenes.pebble(SIZE)
    found = read(tmp_path, normals, mask, encode)
    assert found.convention.encoding == encode
    assert float((found.normals - normals).norm(dim=0)[mask[0] > 0].median()) < 0.02


@pytest.mark.skipif(importlib.util.find_spec("OpenEXR") is None, reason="OpenEXR is not installed")
def test_an_exr_holds_vectors_or_colours(tmp_path: Path) -> None:
    normals = np.moveaxis(sphere_normals(32).numpy(), 0, -1)
    for encoding, pixels in (("vectors", normals), ("unit", normals * 0.5 + 0.5)):
        scene_linear.write_exr(tmp_path / "n.exr", pixels.astype(np.float32), None)
        found = read_normal_map(tmp_path / "n.exr")
        assert found.convention.encoding == encoding
        assert float((found.normals - sphere_normals(32)).abs().max()) < 1e-3


@pytest.mark.parametrize("fault", ["clean", "stripes and shadow"])
def test_a_photo_is_no_normal_map(tmp_path: Path, fault: str) -> None:
    for shape in scenes.OBJECTS.values():
        for kind in scenes.TREES:
            write_picture(tmp_path / "photo.png", scenes.photo(scenes.tree_of(kind), *shape(SIZE), fault))
            with pytest.raises(PictureError, match="expected a normal map, whose colours are unit vectors"):
                read_normal_map(tmp_path / "photo.png")


def test_wrong_maps_are_named(tmp_path: Path, examples: Path) -> None:
    normals, mask = scenes.knot(SIZE)
    with pytest.raises(PictureError, match=r"expected DirectX \(green down\), but its silhouette .* shows OpenGL.*--green opengl"):
        read(tmp_path, normals, mask, green="directx")
    turned = torch.stack([normals[2], normals[1], -normals[0]])
    with pytest.raises(PictureError, match="face away from the viewer: a map of world or object space"):
        read(tmp_path, turned, mask)
    with pytest.raises(PictureError, match="blue points out of the surface, but it points in"):
        read(tmp_path, normals * torch.tensor([1, 1, -1]).view(3, 1, 1), mask, space="tangent")
    with pytest.raises(PictureError, match="whose colours are unit vectors"):
        read_normal_map(examples / "red_lacquer.png")


def test_sizes_must_agree(tmp_path: Path) -> None:
    photo, where = written(tmp_path, torch.full((3, 100, 90), 0.5), *scenes.pebble(SIZE))
    with pytest.raises(PictureError, match=f"expected a normal map of the size of .*, 90 x 100, got {SIZE} x {SIZE}"):
        from_normal_map(photo, where)
    with pytest.raises(PictureError, match=f"expected a mask of the size of .*, 90 x 100, got {SIZE} x {SIZE}"):
        from_mask(photo, where)


def test_inflated_disc_is_a_sphere() -> None:
    grid = sphere_grid(200, dtype=torch.float64) / 0.9
    radius = grid.square().sum(0).sqrt()
    found = inflate(((1.0 - radius) * 90.0 + 0.5).clamp(0.0, 1.0))
    cosine = (found * normals_from_xy(grid)).sum(0).clamp(-1.0, 1.0)
    angle = torch.rad2deg(cosine.acos())
    assert float(angle[radius < 0.97].mean()) < 0.4 and float(angle[radius < 0.9].max()) < 1.5
    with pytest.raises(PictureError, match="at least 16 pixels"):
        inflate(torch.zeros(50, 50))


def test_outline_of_a_ball_does_as_well_as_the_ball(tmp_path: Path) -> None:
    inside = disc_mask(160, 0.96).float()
    image = render(scenes.tree_of("wax"), normals_from_xy(sphere_grid(160) / 0.96))
    write_picture(tmp_path / "photo.png", image * inside + 0.5 * (1 - inside))
    write_picture(tmp_path / "mask.png", inside)
    found = from_mask(tmp_path / "photo.png", tmp_path / "mask.png", size=128, even=False)
    assert found.guess and psnr(found.image, TRUTH["wax"], disc_mask(128, 0.9)) > 33.0


SVG = """<svg xmlns="http://www.w3.org/2000/svg" width="300" height="200" viewBox="0 0 300 200">
<defs><radialGradient id="g" cx="0.3" cy="0.3" r="0.9"><stop stop-color="#ffe0a0"/><stop offset="1" stop-color="#602010"/></radialGradient>
<circle id="only" r="9"/></defs><rect id="sky" width="300" height="200" fill="#80a0ff"/>
<g id="group" transform="translate(50 10) scale(1.5 1.2)" opacity="0.5">
<ellipse id="body" cx="50" cy="60" rx="40" ry="45" fill="url(#g)"/></g>
<circle id="front" cx="140" cy="90" r="12" fill="#111"/></svg>"""


def test_drawing_is_lifted_and_given_back(tmp_path: Path) -> None:
    pytest.importorskip("resvg_py")
    (tmp_path / "d.svg").write_text(SVG, encoding="utf-8")
    drawing = Drawing.read(tmp_path / "d.svg")
    shape = drawing.lift("body")
    # Alone and in full: neither the circle in front nor the group's opacity is in it.
    assert float(np.median(shape.alpha[shape.alpha > 0])) == 1.0 and float(shape.rgb[shape.alpha > 0.99].max(-1).min()) > 0.3
    assert shape.box == pytest.approx((50 + 1.5 * 10, 10 + 1.2 * 15, 1.5 * 80, 1.2 * 90), abs=1.0)
    (tmp_path / "again.svg").write_text(drawing.give_back("body", shape), encoding="utf-8")
    before, after = (Drawing.read(tmp_path / name)._draw(Drawing.read(tmp_path / name).root, 300) for name in ("d.svg", "again.svg"))
    assert -10 * np.log10(np.square(before - after).mean()) > 38.0
    assert Drawing.read(tmp_path / "again.svg").ids == ["sky", "group", "body", "front"]
    found = from_drawing(tmp_path / "d.svg", "body", size=64)
    # The gradient's bright side is up and left.
    assert float(found.image[:, 20, 20].mean()) > float(found.image[:, 44, 44].mean()) + 0.2


@pytest.mark.parametrize(
    ("text", "region", "message"),
    [
        (SVG, "bdy", "the region #bdy is not there; did you mean 'body'?"),
        (SVG, "only", "#only is only defined, not drawn"),
        ("<svg", "a", "expected an SVG, got something that is no XML"),
        ("<html/>", "a", "expected an SVG, got <html>"),
        ('<svg xmlns="http://www.w3.org/2000/svg"/>', "a", "with a viewBox, or with a width and height"),
    ],
)
def test_bad_drawings(tmp_path: Path, text: str, region: str, message: str) -> None:
    pytest.importorskip("resvg_py")
    (tmp_path / "d.svg").write_text(text, encoding="utf-8")
    with pytest.raises(PictureError) as caught:
        Drawing.read(tmp_path / "d.svg").lift(region)
    assert message in str(caught.value)


def test_the_page_says_what_was_measured() -> None:
    root = Path(__file__).resolve().parent.parent
    found = json.loads((root / "benchmarks" / "results" / "photographs" / "photographs.json").read_text(encoding="utf-8"))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in (root / "docs" / "photographs.md").read_text("utf-8").splitlines()]
    page = {row[0]: [float(cell) for cell in row[1:]] for row in rows if len(row) in (5, 7) and row[1][:1].isdigit()}
    keys = ("psnr_seen", "worst", "psnr_seen_plain")
    for fault in scenes.FAULTS:
        measured = [found["summary"][f"{shape}, {fault}"][key] for shape in ("knot", "pebble") for key in keys]
        assert page.pop(fault) == pytest.approx(measured, abs=0.051), fault
    keys = ("photo itself", "residual", "ratio", "ratio, known tree")
    for case, measured in found["apply"].items():
        assert page.pop(case) == pytest.approx([measured[key] for key in keys], abs=0.051), case
    assert not page
