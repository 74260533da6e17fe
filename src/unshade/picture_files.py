"""Picture files to arrays: size checks before decoding, 8 and 16 bits, alpha, orientation, colour to sRGB.

Nothing is guessed: EXR and Radiance HDR are scene-linear, everything else is sRGB unless its profile, gamma or
primaries say otherwise.
"""

from __future__ import annotations

import importlib.util
import struct
import sys
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PILImage
from PIL import UnidentifiedImageError

from unshade import color_profiles, scene_linear
from unshade.errors import PictureError

Array: TypeAlias = NDArray[np.float32]

MIN_SIDE = 8
"""Fewest pixels a side: below that a disc says nothing about shading."""

MAX_SIDE = 16384
MAX_PIXELS = 80_000_000
"""Largest picture that is decoded; one of 8,900 x 8,900 takes about 1 GB on the way."""

SUFFIXES = frozenset(".png .jpg .jpeg .webp .tif .tiff .exr .hdr .pic .bmp .gif .ppm .pgm .tga .avif".split())
"""What counts as a picture in a folder. A file named outright is read whatever its name."""

_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM", "TGA")
_BROKEN = (OSError, SyntaxError, ValueError, EOFError, KeyError, TypeError, OverflowError, struct.error, zlib.error)
"""What Pillow's readers raise for damaged files."""


@dataclass(frozen=True)
class Picture:
    """A decoded picture, upright.

    ``rgb`` is (H, W, 3) float32 and not premultiplied: display-encoded in [0, 1], or scene-linear from 0 up.
    ``alpha`` is (H, W) in [0, 1], or None where the file has none.
    """

    rgb: Array
    alpha: Array | None
    scene_linear: bool

    @property
    def width(self) -> int:
        """In pixels."""
        return self.rgb.shape[1]

    @property
    def height(self) -> int:
        """In pixels."""
        return self.rgb.shape[0]


def check_size(path: Path, width: int, height: int) -> None:
    """Raise PictureError for a picture too small to hold a sphere or too large to decode."""
    if width < MIN_SIDE or height < MIN_SIDE:
        raise PictureError(f"{path}: expected a picture of at least {MIN_SIDE} x {MIN_SIDE} pixels, got {width} x {height}")
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise PictureError(
            f"{path}: expected at most {MAX_SIDE:,} pixels a side and {MAX_PIXELS // 1_000_000} million in all, "
            f"got {width:,} x {height:,}; scale it down first (256 x 256 is what is used)"
        )


def read_picture(path: str | Path, colors: bool = True) -> Picture:
    """Read any supported picture file.

    Args:
        path: the file.
        colors: false for a file that holds other numbers, such as normals: they come as they are stored, no profile is
            applied and scene-linear numbers may be negative.
    Raises:
        PictureError: missing, a directory, not a picture, truncated, too small or too large, animated, NaN.
        MissingExtraError: an EXR without the reader for it.
    """
    path = Path(path)
    start = read_start(path)
    if scene_linear.is_exr(start) or scene_linear.is_radiance(start):
        read = scene_linear.read_exr if scene_linear.is_exr(start) else scene_linear.read_radiance
        rgb, alpha = read(path, check_size, colors)
        return Picture(rgb, alpha, True)
    return _read_display(path, start, colors)


def read_start(path: Path) -> bytes:
    """The first 32 bytes, enough to tell the format. Raises PictureError where there is no file to read."""
    if path.is_dir():
        raise PictureError(f"{path}: expected a picture file, got a directory")
    try:
        with path.open("rb") as file:
            start = file.read(32)
    except FileNotFoundError:
        raise PictureError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise PictureError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if not start:
        raise PictureError(f"{path}: expected a picture, got an empty file")
    return start


def _read_display(path: Path, start: bytes, colors: bool) -> Picture:
    if start[:8] == b"\x89PNG\r\n\x1a\n" and start[12:16] == b"IHDR" and len(start) >= 24:
        check_size(path, *struct.unpack(">II", start[16:24]))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", PILImage.DecompressionBombWarning)
            with PILImage.open(path, formats=_formats()) as image:
                check_size(path, *image.size)
                return _decode(path, image, colors)
    except UnidentifiedImageError:
        raise PictureError(
            f"{path}: expected a picture (PNG, JPEG, WebP, TIFF, EXR, HDR ...), got something else or a damaged header"
        ) from None
    except (PILImage.DecompressionBombError, PILImage.DecompressionBombWarning):
        raise PictureError(f"{path}: larger than {MAX_PIXELS // 1_000_000} million pixels; scale it down first") from None
    except _BROKEN as error:
        raise PictureError(f"{path}: damaged or truncated {_first_line(error)}") from None


def _formats() -> tuple[str, ...]:
    """What is asked of Pillow, which has known AVIF since its version 11.3."""
    return (*_FORMATS, "AVIF") if importlib.util.find_spec("PIL.AvifImagePlugin") else _FORMATS


def _first_line(error: Exception) -> str:
    return f"({str(error).splitlines()[0]})" if str(error) else ""


def _decode(path: Path, image: PILImage.Image, colors: bool) -> Picture:
    frames = getattr(image, "n_frames", 1)
    # An MPO is a camera's JPEG with previews or a second view behind the first picture.
    if frames > 1 and image.format != "MPO":
        raise PictureError(f"{path}: expected one picture, got {frames} frames or pages; save the one you mean by itself")
    profile = color_profiles.declared(path, image) if colors else None
    pixels, alpha = _channels(path, image, profile)
    # After the pixels: asking a PNG for its EXIF decodes it, and with that the depth of its file is forgotten.
    orientation = image.getexif().get(0x0112, 1)
    if isinstance(profile, color_profiles.Primaries):
        pixels = profile.to_srgb(pixels)
    pixels = _upright(pixels, orientation)
    return Picture(np.ascontiguousarray(pixels), None if alpha is None else np.ascontiguousarray(_upright(alpha, orientation)), False)


def _channels(path: Path, image: PILImage.Image, profile: color_profiles.Profile) -> tuple[Array, Array | None]:
    """Colour in [0, 1] (converted where the profile is an ICC one that only littleCMS can read) and alpha."""
    deep = _sixteen_bit(image)
    if deep is not None:
        channels = deep.shape[-1]
        alpha = deep[..., -1] if channels in (2, 4) else None
        color = deep[..., :1].repeat(3, axis=-1) if channels <= 2 else deep[..., :3]
        if isinstance(profile, color_profiles.Icc):
            shaper = color_profiles.matrix_shaper(profile.data)
            color = shaper.to_srgb(color) if shaper and channels > 2 else color_profiles.convert_array(path, profile, color)
        return color, alpha
    if image.mode in ("I", "F"):
        raise PictureError(f"{path}: expected 8 or 16 bits a channel, got 32; save it as 16-bit PNG or TIFF, or as EXR")
    alpha = None
    if "A" in image.getbands() or "a" in image.getbands() or "transparency" in image.info:
        image = image.convert("RGBA")
        alpha = np.asarray(image.getchannel("A"), dtype=np.float32) / np.float32(255)
    if isinstance(profile, color_profiles.Icc):
        image = color_profiles.convert(path, profile, image)
    return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255), alpha


def _upright(array: Array, orientation: int) -> Array:
    """Apply the EXIF orientation 1 to 8."""
    if orientation in (5, 6, 7, 8):
        array = array.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        array = array[::-1]
    if orientation in (2, 3, 6, 7):
        array = array[:, ::-1]
    return array


def _sixteen_bit(image: PILImage.Image) -> Array | None:
    """(H, W, 1 to 4) in [0, 1] of a 16-bit PNG or TIFF, None for any other picture.

    Pillow keeps only the high byte of 16-bit colour. Asked for the other byte order it keeps the low one, so decoding
    twice gives both and needs no other library.
    """
    if image.mode.startswith("I;16"):
        return (np.asarray(image).astype(np.float32) / np.float32(65535))[..., None]
    rawmode = _rawmode(image)
    if rawmode == "LA;16B":
        parts = np.asarray(_loaded(image, "RGBA")).astype(np.float32)
        return (parts[..., 0::2] * np.float32(256) + parts[..., 1::2]) / np.float32(65535)
    name, _, order = rawmode.partition(";")
    if name not in ("RGB", "RGBA", "RGBX", "RGBa") or order not in ("16B", "16L", "16N"):
        return None
    native = "16L" if sys.byteorder == "little" else "16B"
    other = {"16L": "16B", "16B": "16L"}[native if order == "16N" else order]
    straight = "RGBA" if name == "RGBa" else name
    low = np.asarray(_loaded(image, f"{straight};{other}")).astype(np.float32)
    high = np.asarray(_loaded(image, f"{straight};{order}")).astype(np.float32)
    deep: Array = (high * np.float32(256) + low) / np.float32(65535)
    if name == "RGBa":
        deep[..., :3] /= np.maximum(deep[..., 3:], np.float32(1 / 65535))
        np.clip(deep, 0, 1, out=deep)
    return deep


def _rawmode(image: PILImage.Image) -> str:
    tiles = getattr(image, "tile", None)
    if not tiles:
        return ""
    arguments = tiles[0][3]
    found = arguments[0] if isinstance(arguments, tuple) else arguments
    return found if isinstance(found, str) else ""


def _loaded(image: PILImage.Image, rawmode: str) -> PILImage.Image:
    """Decode a fresh copy of the file with another rawmode."""
    source = image.filename  # type: ignore[attr-defined]
    with PILImage.open(source, formats=[image.format or ""]) as again:
        tiles = []
        for codec, extents, offset, arguments in again.tile:
            changed = (rawmode, *arguments[1:]) if isinstance(arguments, tuple) else rawmode
            tiles.append((codec, extents, offset, changed))
        again.tile = [type(old)(*new) for old, new in zip(again.tile, tiles, strict=True)]
        again.load()
        return again.copy()
