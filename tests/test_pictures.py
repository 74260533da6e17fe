"""Reading, finding and writing spheres. Every picture is made here; no data folder is needed."""

from __future__ import annotations

import importlib.util
import struct
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms, ImageDraw

from unshade import color_profiles
from unshade.errors import MissingExtraError, OutputError, PictureError
from unshade.nodes import leaf, multiply, screen
from unshade.picture_files import read_picture
from unshade.pictures import Disc, find_pictures, read_sphere, sphere_from_array, write_picture
from unshade.png import write_png
from unshade.render import render, srgb_encode
from unshade.sphere import disc_mask, normals_from_xy, sphere_normals
from unshade.sphere_finder import disc_of_alpha, find_disc

needs_exr = pytest.mark.skipif(importlib.util.find_spec("OpenEXR") is None, reason="OpenEXR is not installed")

SPHERES = (
    screen(
        multiply(leaf("albedo", color=(0.8, 0.3, 0.2)), leaf("diffuse", direction=(-1, 1, 1), ambient=0.3)),
        leaf("highlight", direction=(-0.5, 0.5, 0.7), sharpness=60.0),
    ),
    multiply(leaf("albedo", color=(0.2, 0.5, 0.9)), leaf("toon_diffuse", direction=(1, 0.4, 0.8), ambient=0.5)),
    screen(leaf("albedo", color=(0.15, 0.2, 0.1)), leaf("rim", direction=(0, 1, 0.2), exponent=2.0)),
)


def shaded(x: np.ndarray, y: np.ndarray, which: int) -> np.ndarray:
    """(H, W, 3) colours of a sphere at positions in its disc, x right and y down."""
    normals = normals_from_xy(torch.from_numpy(np.stack([x, -y])).float())
    return np.moveaxis(render(SPHERES[which], normals).numpy(), 0, -1)


def scene(width: int, height: int, disc: tuple[float, float, float], which: int, background: str, seed: int) -> np.ndarray:
    """(H, W, 3) of a sphere in front of a background, antialiased by 4 x 4 samples and rounded to 8 bits."""
    random = np.random.default_rng(seed)
    samples = 4
    y, x = np.mgrid[0 : height * samples, 0 : width * samples]
    u, v = ((x + 0.5) / samples - disc[0]) / disc[2], ((y + 0.5) / samples - disc[1]) / disc[2]
    behind = {"plain": np.full((1, 1, 3), 0.5) * (1.0, 1.1, 1.3), "black": np.zeros((1, 1, 3))}.get(background)
    if behind is None:
        behind = np.array([0.9, 0.8, 0.5]) + (y / y.size * x.shape[1])[..., None] * np.array([-0.5, -0.2, 0.3])
    picture = np.where((u * u + v * v <= 1)[..., None], shaded(u, v, which), behind)
    picture = picture.reshape(height, samples, width, samples, 3).mean((1, 3))
    if background == "noisy":
        picture = picture + random.normal(0.0, 0.03, picture.shape)
    return np.round(picture.clip(0, 1) * 255).astype(np.uint8)


def matcap(size: int = 64, which: int = 0) -> torch.Tensor:
    return render(SPHERES[which], sphere_normals(size))


def save(path: Path, pixels: np.ndarray, **options: object) -> Path:
    Image.fromarray(pixels).save(path, **options)
    return path


def as_bytes(image: torch.Tensor) -> np.ndarray:
    return np.round(np.moveaxis(image.numpy(), 0, -1) * 255).astype(np.uint8)


def png(width: int, height: int, *chunks: tuple[bytes, bytes], depth: int = 8) -> bytes:
    """A PNG whose header says what it likes."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 2, 0, 0, 0)), *chunks, (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts)


# --- Where the sphere is


@pytest.mark.parametrize("background", ["plain", "black", "gradient", "noisy"])
@pytest.mark.parametrize("which", range(len(SPHERES)))
def test_a_sphere_in_front_of_a_background_is_found_within_a_hundredth_of_its_radius(background: str, which: int) -> None:
    random = np.random.default_rng(which)
    width, height = (int(k) for k in random.integers(130, 260, 2))
    r = float(random.uniform(0.2, 0.42)) * min(width, height)
    cx, cy = (float(random.uniform(r + 2, side - r - 2)) for side in (width, height))
    found = find_disc(scene(width, height, (cx, cy, r), which, background, which) / 255)
    assert found is not None
    assert max(abs(found.r - r), np.hypot(found.cx - cx, found.cy - cy)) < 0.01 * r
    assert 0.4 < found.score <= 1.0


@pytest.mark.parametrize("which", range(len(SPHERES)))
def test_a_full_frame_matcap_is_the_inscribed_disc_bit_for_bit(tmp_path: Path, which: int) -> None:
    pixels = as_bytes(matcap(256, which))
    sphere = read_sphere(save(tmp_path / "matcap.png", pixels))
    assert (sphere.disc.cx, sphere.disc.cy, sphere.disc.r) == (128, 128, 128)
    assert torch.equal(sphere.image, torch.from_numpy(np.moveaxis(pixels, -1, 0) / np.float32(255)))
    assert torch.equal(sphere.valid, disc_mask(256)) and sphere.exposure == 1.0


@pytest.mark.parametrize("color", [(0, 0, 0), (255, 255, 255), (200, 30, 90)])
def test_one_colour_is_a_matcap(tmp_path: Path, color: tuple[int, int, int]) -> None:
    for width in (40, 70):
        sphere = read_sphere(save(tmp_path / "flat.png", np.full((40, width, 3), color, dtype=np.uint8)), size=64)
        assert (sphere.disc.cx, sphere.disc.r) == (width / 2, 20)
        assert float((sphere.image - torch.tensor(color).view(3, 1, 1) / 255).abs().max()) < 1e-6


def test_the_disc_of_alpha_is_exact_to_a_fifth_of_a_pixel() -> None:
    y, x = np.mgrid[0:600, 0:800] / 4
    for cx, cy, r in ((100.3, 70.6, 50.2), (60.0, 75.0, 8.0), (40.0, 75.0, 60.0)):
        alpha = (np.hypot(x + 0.125 - cx, y + 0.125 - cy) <= r).astype(float).reshape(150, 4, 200, 4).mean((1, 3))
        found = disc_of_alpha(alpha)
        assert found is not None
        assert max(abs(found.cx - cx), abs(found.cy - cy), abs(found.r - r)) < 0.2


def no_sphere(kind: str) -> np.ndarray:
    random = np.random.default_rng(0)
    if kind == "noise":
        return random.integers(0, 256, (128, 128, 3)).astype(np.uint8)
    if kind == "wide noise":
        return random.integers(0, 256, (100, 180, 3)).astype(np.uint8)
    if kind == "landscape":
        return (np.linspace(0, 1, 100)[:, None, None] * np.array([200, 120, 60]) + np.zeros((100, 170, 3))).astype(np.uint8)
    page = Image.new("RGB", (160, 160) if kind == "text" else (220, 160), "white")
    draw = ImageDraw.Draw(page)
    if kind == "text":
        for line in range(10):
            draw.text((5, 4 + 15 * line), "a page of text, no sphere", fill="black")
    else:
        draw.rectangle((60, 40, 150, 120), fill=(180, 40, 40))
    return np.asarray(page)


@pytest.mark.parametrize("kind", ["noise", "wide noise", "landscape", "text", "rectangle"])
def test_a_picture_without_a_sphere_says_what_to_do(tmp_path: Path, kind: str) -> None:
    path = save(tmp_path / "nothing.png", no_sphere(kind))
    with pytest.raises(PictureError, match=r"no sphere found.*--disc cx,cy,r"):
        read_sphere(path)
    assert read_sphere(path, disc=(50, 50, 40)).disc == Disc(50, 50, 40, 1.0)


def test_a_given_disc_wins_and_must_lie_in_the_picture(tmp_path: Path) -> None:
    path = save(tmp_path / "matcap.png", as_bytes(matcap()))
    assert read_sphere(path, disc=(30, 31, 20.5)).disc == Disc(30, 31, 20.5)
    for wrong in ((30, 30), (30, 30, 1), (-5, 30, 20), (30, 30, 500), (30, float("nan"), 20)):
        with pytest.raises(PictureError, match="expected a disc"):
            read_sphere(path, disc=wrong)


def test_what_lies_outside_the_frame_does_not_count(tmp_path: Path) -> None:
    sphere = read_sphere(save(tmp_path / "cut.png", as_bytes(matcap(64))), disc=(20, 32, 30))
    left = sphere.valid[0, :, : round(256 * 9 / 60)]
    assert not left.any() and sphere.valid[0, 128, 60]


def test_the_silhouette_in_front_of_a_background_does_not_count(tmp_path: Path) -> None:
    sphere = read_sphere(save(tmp_path / "scene.png", scene(150, 120, (70, 60, 40), 0, "plain", 0)))
    radius = np.sqrt(float(sphere.valid.float().mean()) * 4 / np.pi)
    assert 0.975 < radius < 0.99


# --- Resampling


@pytest.mark.parametrize("size", [100, 512, 700])
def test_resampling_keeps_the_shading(tmp_path: Path, size: int) -> None:
    sphere = read_sphere(save(tmp_path / "matcap.png", as_bytes(matcap(size))))
    inside = disc_mask(256, 0.95)[0]
    error = (sphere.image - matcap(256))[:, inside].abs()
    assert float(error.mean()) < 0.004 and float(error.max()) < 0.08


def test_downsampling_averages_areas() -> None:
    stripes = torch.zeros(3, 512, 512)
    stripes[:, :, ::2] = 1.0
    image = sphere_from_array(stripes, disc=(256, 256, 256), size=64).image
    assert float((image[:, 4:-4, 4:-4] - 0.5).abs().max()) < 0.01


def test_what_is_behind_alpha_does_not_bleed_in(tmp_path: Path) -> None:
    y, x = np.mgrid[0:800, 0:800] / 8
    alpha = (np.hypot(x + 0.0625 - 50.4, y + 0.0625 - 49.7) <= 40.3).astype(float).reshape(100, 8, 100, 8).mean((1, 3))
    pixels = np.full((100, 100, 4), 255, dtype=np.uint8)
    pixels[alpha > 0, :3] = (60, 120, 180)
    pixels[..., 3] = np.round(alpha * 255)
    sphere = read_sphere(save(tmp_path / "alpha.png", pixels))
    assert abs(sphere.disc.cx - 50.4) < 0.1 and abs(sphere.disc.r - 40.3) < 0.1
    color = torch.tensor([60, 120, 180]).view(3, 1) / 255
    assert float((sphere.image[:, sphere.valid[0]] - color).abs().max()) < 0.01
    assert sphere.valid.sum() > 0.98 * disc_mask(256).sum()


def test_ignored_pixels_do_not_count(tmp_path: Path) -> None:
    path = save(tmp_path / "matcap.png", as_bytes(matcap()))
    mask = np.zeros((64, 64), dtype=np.uint8)
    mask[:, :32] = 255
    sphere = read_sphere(path, ignore=save(tmp_path / "mask.png", mask))
    assert not sphere.valid[0, :, :126].any() and sphere.valid[0, 128, 130]
    with pytest.raises(PictureError, match="64 x 64, got 32 x 64"):
        read_sphere(path, ignore=save(tmp_path / "small.png", mask[:, :32]))


# --- Formats


@pytest.mark.parametrize("suffix", ["png", "webp", "tif", "bmp", "jpg"])
def test_eight_bit_formats_read_what_was_written(tmp_path: Path, suffix: str) -> None:
    image = torch.from_numpy(np.moveaxis(as_bytes(matcap()), -1, 0) / np.float32(255))
    write_picture(tmp_path / f"a.{suffix}", image)
    error = np.abs(np.moveaxis(read_picture(tmp_path / f"a.{suffix}").rgb, -1, 0) - image.numpy()).max()
    assert error < (0.06 if suffix == "jpg" else 1e-6)


@pytest.mark.parametrize("suffix", ["png", "webp", "tif"])
def test_alpha_is_kept(tmp_path: Path, suffix: str) -> None:
    alpha = disc_mask(64).float() * 0.6
    write_picture(tmp_path / f"a.{suffix}", matcap(), alpha)
    found = read_picture(tmp_path / f"a.{suffix}").alpha
    assert found is not None and np.abs(found - alpha[0].numpy()).max() < 0.003


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bit_png_keeps_every_bit(tmp_path: Path, channels: int) -> None:
    values = np.random.default_rng(channels).integers(0, 65536, (channels, 12, 17)).astype(np.uint16)
    (tmp_path / "deep.png").write_bytes(write_png(values))
    picture = read_picture(tmp_path / "deep.png")
    expected = values.astype(int)
    assert np.array_equal(np.round(picture.rgb[..., 0] * 65535).astype(int), expected[0])
    assert np.array_equal(np.round(picture.rgb[..., 2] * 65535).astype(int), expected[2 if channels > 2 else 0])
    if channels in (2, 4):
        assert picture.alpha is not None and np.array_equal(np.round(picture.alpha * 65535).astype(int), expected[-1])


@pytest.mark.parametrize("order", "<>")
def test_sixteen_bit_tiff_keeps_every_bit(tmp_path: Path, order: str) -> None:
    values = np.random.default_rng(1).integers(0, 65536, (10, 11, 3)).astype(order + "u2")
    entries = [
        (256, 3, 1, 11),
        (257, 3, 1, 10),
        (258, 3, 3, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, 14),
        (277, 3, 1, 3),
        (278, 3, 1, 10),
        (279, 4, 1, 660),
    ]
    data = (
        (b"II" if order == "<" else b"MM")
        + struct.pack(order + "HI", 42, 14 + 660)
        + struct.pack(order + "HHH", 16, 16, 16)
        + values.tobytes()
    )
    data += struct.pack(order + "H", len(entries))
    for tag, kind, count, value in entries:
        packed = struct.pack(order + "HH", value, 0) if kind == 3 and count == 1 else struct.pack(order + "I", value)
        data += struct.pack(order + "HHI", tag, kind, count) + packed
    (tmp_path / "deep.tif").write_bytes(data + struct.pack(order + "I", 0))
    assert np.array_equal(np.round(read_picture(tmp_path / "deep.tif").rgb * 65535).astype(int), values.astype(int))


def test_sixteen_bit_writing(tmp_path: Path) -> None:
    image = torch.rand(3, 9, 9, generator=torch.Generator().manual_seed(0))
    write_picture(tmp_path / "deep.png", image, bits=16)
    assert np.abs(np.moveaxis(read_picture(tmp_path / "deep.png").rgb, -1, 0) - image.numpy()).max() < 0.51 / 65535


def test_palette_grey_and_black_and_white(tmp_path: Path) -> None:
    source = Image.fromarray(as_bytes(matcap()))
    for mode in ("P", "L", "1", "LA"):
        source.convert(mode).save(tmp_path / f"{mode}.png")
        expected = np.asarray(source.convert(mode).convert("RGB")) / 255
        assert np.abs(read_picture(tmp_path / f"{mode}.png").rgb - expected).max() < 1e-6


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path: Path, orientation: int) -> None:
    from PIL import ImageOps

    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (10, 14, 3)).astype(np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(tmp_path / "turned.png", exif=exif)
    with Image.open(tmp_path / "turned.png") as saved:
        upright = np.asarray(ImageOps.exif_transpose(saved))
    assert np.array_equal(np.round(read_picture(tmp_path / "turned.png").rgb * 255), upright)


# --- Colour


def rgb_profile(primaries: color_profiles.Chromaticities, gamma: float) -> bytes:
    """A minimal ICC v2 matrix profile."""
    srgb = color_profiles.to_xyz(primaries)
    matrix = color_profiles.adapt(srgb.sum(1), np.array([0.96422, 1.0, 0.82521])) @ srgb

    def xyz(column: np.ndarray) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *np.round(np.asarray(column) * 65536).astype(int))

    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256)) + b"\0\0"
    text = b"desc\0\0\0\0" + struct.pack(">I", 5) + b"test\0" + b"\0" * 79
    tags = [(b"desc", text), (b"wtpt", xyz(np.array([0.96422, 1.0, 0.82521])))]
    tags += [(name, xyz(matrix[:, k])) for k, name in enumerate((b"rXYZ", b"gXYZ", b"bXYZ"))] + [
        (name, curve) for name in (b"rTRC", b"gTRC", b"bTRC")
    ]
    table, body = b"", b""
    for name, data in tags:
        data += b"\0" * (-len(data) % 4)
        table += name + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(data))
        body += data
    size = 132 + len(table) + len(body)
    white = struct.pack(">3i", 63190, 65536, 54061)
    header = (
        struct.pack(">I4sI4s4s4s", size, b"\0" * 4, 0x02400000, b"mntr", b"RGB ", b"XYZ ")
        + b"\0" * 12
        + b"acsp"
        + b"\0" * 28
        + white
        + b"\0" * 48
    )
    return header + struct.pack(">I", len(tags)) + table + body


WIDE = {"Display P3": (color_profiles.DISPLAY_P3, 2.2), "Adobe RGB": ((0.3127, 0.3290, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06), 2.19921875)}


@pytest.mark.parametrize("space", WIDE)
def test_wide_gamut_is_converted_alike_at_8_and_16_bits(tmp_path: Path, space: str) -> None:
    primaries, gamma = WIDE[space]
    inside = np.random.default_rng(0).uniform(0.25, 0.75, (16, 16, 3))
    linear = color_profiles.srgb_decode(inside) @ np.linalg.inv(color_profiles.matrix_to_srgb(primaries)).T
    stored = linear ** (1 / round(gamma * 256) * 256)
    profile = rgb_profile(primaries, gamma)
    save(tmp_path / "8.png", np.round(stored * 255).astype(np.uint8), icc_profile=profile)
    assert np.abs(read_picture(tmp_path / "8.png").rgb - inside).max() < 4 / 255
    deep = write_png(np.moveaxis(np.round(stored * 65535).astype(np.uint16), -1, 0))
    chunk = b"iCCP" + b"x\0\0" + zlib.compress(profile)
    deep = deep[:33] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + deep[33:]
    (tmp_path / "16.png").write_bytes(deep)
    assert np.abs(read_picture(tmp_path / "16.png").rgb - inside).max() < 0.002
    assert np.abs(stored - inside).max() > 0.01


def test_an_srgb_profile_changes_nothing(tmp_path: Path) -> None:
    pixels = as_bytes(matcap())
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    assert np.array_equal(np.round(read_picture(save(tmp_path / "a.png", pixels, icc_profile=profile)).rgb * 255), pixels)


def test_png_gamma_and_cicp_are_followed(tmp_path: Path) -> None:
    raw = np.random.default_rng(0).integers(0, 256, (10, 10, 3)).astype(np.uint8)
    rows = np.concatenate([np.zeros((10, 1), np.uint8), raw.reshape(10, -1)], axis=1)
    pixels = (b"IDAT", zlib.compress(rows.tobytes()))
    expected = {100000: color_profiles.srgb_encode(raw / 255), 45455: raw / 255, 50000: color_profiles.srgb_encode((raw / 255) ** 2.0)}
    for gamma, values in expected.items():
        (tmp_path / "g.png").write_bytes(png(10, 10, (b"gAMA", struct.pack(">I", gamma)), pixels))
        assert np.abs(read_picture(tmp_path / "g.png").rgb - values).max() < 1e-4
    (tmp_path / "p3.png").write_bytes(png(10, 10, (b"cICP", bytes([12, 13, 0, 1])), pixels))
    converted = read_picture(tmp_path / "p3.png").rgb
    linear = color_profiles.srgb_decode(raw / 255) @ color_profiles.matrix_to_srgb(color_profiles.DISPLAY_P3).T
    assert np.abs(converted - color_profiles.srgb_encode(linear.clip(0, 1))).max() < 1e-3
    (tmp_path / "hdr.png").write_bytes(png(10, 10, (b"cICP", bytes([9, 16, 0, 1])), pixels))
    with pytest.raises(PictureError, match="transfer 16"):
        read_picture(tmp_path / "hdr.png")


def test_cmyk_is_converted(tmp_path: Path) -> None:
    pixels = as_bytes(matcap())
    Image.fromarray(pixels).convert("CMYK").save(tmp_path / "cmyk.tif")
    Image.fromarray(pixels).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    assert np.abs(read_picture(tmp_path / "cmyk.tif").rgb * 255 - pixels).max() < 2
    assert np.abs(read_picture(tmp_path / "cmyk.jpg").rgb * 255 - pixels).mean() < 3


# --- Scene-linear


def hdr(pixels: np.ndarray, width: int, height: int) -> bytes:
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width) + pixels.tobytes()


def test_radiance_hdr_flat_and_run_length(tmp_path: Path) -> None:
    rgbe = np.zeros((12, 16, 4), dtype=np.uint8)
    rgbe[:] = (128, 64, 32, 130)
    (tmp_path / "flat.hdr").write_bytes(hdr(rgbe, 16, 12))
    row = b"\x02\x02\x00\x10" + b"".join(bytes([128 + 10, value, 6]) + bytes([value]) * 6 for value in (128, 64, 32, 130))
    (tmp_path / "runs.hdr").write_bytes(hdr(np.frombuffer(row * 12, dtype=np.uint8), 16, 12))
    for name in ("flat.hdr", "runs.hdr"):
        picture = read_picture(tmp_path / name)
        assert picture.scene_linear and np.allclose(picture.rgb, (2.0, 1.0, 0.5))
        with pytest.raises(PictureError, match="truncated"):
            (tmp_path / "cut.hdr").write_bytes((tmp_path / name).read_bytes()[:-20])
            read_picture(tmp_path / "cut.hdr")


def test_radiance_hdr_gets_an_exposure(tmp_path: Path) -> None:
    rgbe = np.zeros((16, 16, 4), dtype=np.uint8)
    rgbe[:] = (128, 64, 32, 131)
    (tmp_path / "bright.hdr").write_bytes(hdr(rgbe, 16, 16))
    sphere = read_sphere(tmp_path / "bright.hdr", size=32)
    assert sphere.exposure == pytest.approx(0.25)
    assert torch.allclose(sphere.image[:, 16, 16], srgb_encode(torch.tensor([1.0, 0.5, 0.25])), atol=1e-4)
    assert read_sphere(tmp_path / "bright.hdr", exposure=0.1).exposure == 0.1


@needs_exr
def test_exr_comes_back_within_half_float(tmp_path: Path) -> None:
    image = matcap()
    write_picture(tmp_path / "a.exr", image, disc_mask(64).float())
    sphere = read_sphere(tmp_path / "a.exr", size=64)
    assert sphere.exposure == 1.0 and (sphere.disc.cx, sphere.disc.r) == (32, 32)
    assert float((sphere.image - image)[:, sphere.valid[0]].abs().max()) < 0.001
    write_picture(tmp_path / "b.exr", image, exposure=0.1)
    brighter = read_sphere(tmp_path / "b.exr", size=64)
    assert read_picture(tmp_path / "b.exr").rgb.max() > 5 and brighter.exposure < 0.3


@needs_exr
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_exr_with_nan_or_infinity_says_where(tmp_path: Path, bad: float) -> None:
    import OpenEXR

    pixels = np.full((16, 16, 3), 0.5, dtype=np.float32)
    pixels[3, 7, 1] = bad
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"RGB": pixels}) as file:
        file.write(str(tmp_path / "bad.exr"))
    with pytest.raises(PictureError, match="1 pixels, the first at x 7, y 3"):
        read_sphere(tmp_path / "bad.exr")


@needs_exr
def test_exr_layers_of_a_blender_matcap_add(tmp_path: Path) -> None:
    import OpenEXR

    half = {
        f"{layer}.{c}": np.full((16, 16), value, dtype=np.float32) for layer, value in (("diffuse", 0.25), ("specular", 0.5)) for c in "RGB"
    }
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, half) as file:
        file.write(str(tmp_path / "layers.exr"))
    assert np.allclose(read_picture(tmp_path / "layers.exr").rgb, 0.75)


@needs_exr
def test_exr_chromaticities_are_converted(tmp_path: Path) -> None:
    import OpenEXR

    path = tmp_path / "wide.exr"
    pixels = np.full((16, 16, 3), 0.5, dtype=np.float32)
    pixels[:, 8:] = (0.4, 0.5, 0.5)
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"RGB": pixels}) as file:
        file.write(str(path))
    # The library does not write this attribute: put it first, and move the one entry of the table of offsets.
    data = path.read_bytes()
    red_first = (*color_profiles.REC2020[2:], *color_profiles.REC2020[:2])
    attribute = b"chromaticities\0chromaticities\0" + struct.pack("<i8f", 32, *red_first)
    end = 8
    while data[end]:
        end = data.index(b"\0", data.index(b"\0", end) + 1) + 1
        end += 4 + struct.unpack("<i", data[end : end + 4])[0]
    offset = struct.unpack("<Q", data[end + 1 : end + 9])[0] + len(attribute)
    path.write_bytes(data[:8] + attribute + data[8 : end + 1] + struct.pack("<Q", offset) + data[end + 9 :])
    expected = color_profiles.matrix_to_srgb(color_profiles.REC2020) @ (0.4, 0.5, 0.5)
    found = read_picture(path).rgb
    assert np.allclose(found[0, 0], 0.5, atol=1e-4) and np.allclose(found[0, -1], expected, atol=1e-4)
    assert np.abs(expected - (0.4, 0.5, 0.5)).max() > 0.03


def test_exr_without_its_reader_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    (tmp_path / "a.exr").write_bytes(b"\x76\x2f\x31\x01" + b"\0" * 40)
    with pytest.raises(MissingExtraError, match=r"unshade\[exr\]"):
        read_picture(tmp_path / "a.exr")


# --- Bad input


def bad_inputs(folder: Path) -> dict[str, tuple[bytes, str]]:
    whole = BytesIO()
    Image.fromarray(as_bytes(matcap())).save(whole, "PNG")
    jpeg = BytesIO()
    Image.fromarray(as_bytes(matcap())).save(jpeg, "JPEG")
    animated = BytesIO()
    frames = [Image.fromarray(as_bytes(matcap(32, k))) for k in range(3)]
    frames[0].save(animated, "GIF", save_all=True, append_images=frames[1:])
    clear = BytesIO()
    Image.new("RGBA", (32, 32), (255, 0, 0, 0)).save(clear, "PNG")
    one = BytesIO()
    Image.new("RGB", (1, 1)).save(one, "PNG")
    return {
        "text.png": (b"this is no picture\n" * 20, "expected a picture"),
        "empty.png": (b"", "empty file"),
        "truncated.png": (whole.getvalue()[:600], "damaged or truncated"),
        "truncated.jpg": (jpeg.getvalue()[:700], "damaged or truncated"),
        "zero.png": (png(0, 0, (b"IDAT", zlib.compress(b""))), "got 0 x 0"),
        "one.png": (one.getvalue(), "got 1 x 1"),
        "huge.png": (png(40000, 40000, (b"IDAT", b"")), "40,000 x 40,000"),
        "huge.hdr": (hdr(np.zeros(0, np.uint8), 40000, 40000), "40,000 x 40,000"),
        "huge.bmp": (
            b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + struct.pack("<IiiHHIIiiII", 40, 40000, 40000, 1, 24, 0, 0, 0, 0, 0, 0),
            "larger than|40,000",
        ),
        "animated.gif": (animated.getvalue(), "3 frames"),
        "clear.png": (clear.getvalue(), "fully transparent"),
        "cut.exr": (b"\x76\x2f\x31\x01\x02\0\0\0chan", "damaged|OpenEXR"),
        "cut.hdr": (b"#?RADIANCE\n", "Radiance header"),
    }


@pytest.mark.parametrize("name", sorted(bad_inputs(Path())))
def test_bad_input_is_one_clear_line(tmp_path: Path, name: str) -> None:
    data, says = bad_inputs(tmp_path)[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises((PictureError, MissingExtraError), match=says) as raised:
        read_sphere(tmp_path / name)
    assert "\n" not in str(raised.value) and name in str(raised.value)


def test_a_pillow_that_knows_no_avif_still_tells_what_is_no_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if "Avif" in name else find(name))
    monkeypatch.delitem(Image.OPEN, "AVIF", raising=False)
    monkeypatch.setattr(Image, "init", lambda: True)
    (tmp_path / "letter.png").write_bytes(b"dear reader, " * 20)
    with pytest.raises(PictureError, match="expected a picture"):
        read_picture(tmp_path / "letter.png")
    assert read_picture(save(tmp_path / "matcap.png", as_bytes(matcap()))).width


@needs_exr
def test_a_truncated_exr_prints_nothing_of_its_own(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_picture(tmp_path / "whole.exr", torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0)))
    data = (tmp_path / "whole.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(data[: len(data) // 2])
    with pytest.raises(PictureError, match="damaged or truncated EXR"):
        read_picture(tmp_path / "cut.exr")
    assert capfd.readouterr() == ("", "")


def test_missing_files_and_directories(tmp_path: Path) -> None:
    with pytest.raises(PictureError, match="no such file"):
        read_sphere(tmp_path / "missing.png")
    with pytest.raises(PictureError, match="got a directory"):
        read_sphere(tmp_path)


def test_find_pictures_expands_folders_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "many"
    folder.mkdir()
    for name in ("b.png", "a.JPG", "notes.txt", ".hidden.png"):
        (folder / name).write_bytes(b"")
    odd = tmp_path / "odd.name"
    odd.write_bytes(b"")
    assert find_pictures([odd, folder, folder / "b.png"]) == [odd, folder / "a.JPG", folder / "b.png"]
    (tmp_path / "none").mkdir()
    with pytest.raises(PictureError, match="found none"):
        find_pictures([tmp_path / "none"])
    with pytest.raises(PictureError, match="no such file"):
        find_pictures([tmp_path / "missing"])


def test_arrays_are_checked() -> None:
    assert sphere_from_array(matcap().numpy()).size == 256
    for wrong in (torch.zeros(64, 64, 3), torch.zeros(3, 4, 4), torch.full((3, 16, 16), 2.0), torch.full((3, 16, 16), float("nan"))):
        with pytest.raises(PictureError, match="expected"):
            sphere_from_array(wrong)


# --- Output


def test_writing_is_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "a.png"
    write_picture(target, matcap())
    before = target.read_bytes()
    with pytest.raises(OutputError, match="finite"):
        write_picture(target, torch.full((3, 8, 8), float("nan")))
    with pytest.raises(OutputError, match="cannot be written"):
        write_picture(tmp_path / "absent" / "a.png", matcap())
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(OutputError, match="directory"):
        write_picture(tmp_path / "folder.png", matcap())
    with pytest.raises(OutputError, match="ends in"):
        write_picture(tmp_path / "a.xyz", matcap())
    assert target.read_bytes() == before and {p.name for p in tmp_path.iterdir()} == {"a.png", "folder.png"}
