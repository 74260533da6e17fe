"""Scene-linear pictures, OpenEXR and Radiance HDR: reading, writing, and the exposure that brings them to [0, 1]."""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from unshade.color_profiles import matrix_to_srgb, srgb_encode
from unshade.errors import MissingExtraError, PictureError

Array: TypeAlias = NDArray[np.float32]
CheckSize: TypeAlias = Callable[[Path, int, int], None]

WHITE_PERCENTILE = 99.5
"""The exposure brings this percentile of the brightest channel to 1, so that a lamp's few pixels do not darken the rest."""


def is_exr(start: bytes) -> bool:
    """From a file's first bytes."""
    return start[:4] == b"\x76\x2f\x31\x01"


def is_radiance(start: bytes) -> bool:
    """From a file's first bytes."""
    return start.startswith((b"#?RADIANCE", b"#?RGBE", b"#?AUTOPANO"))


def exposure_for(rgb: Array, where: NDArray[np.bool_]) -> float:
    """The factor for scene-linear colour: 1 where the picture already fills [0, 1], else what brings its white to 1.

    Args:
        rgb: (H, W, 3) scene-linear.
        where: (H, W) the sphere.
    """
    brightest = rgb[where].max(axis=-1)
    white = float(np.percentile(brightest, WHITE_PERCENTILE)) if brightest.size else 0.0
    return 1.0 if white <= 0.0 or 0.25 <= white <= 1.0 else 1.0 / white


def encode(rgb: Array, exposure: float) -> Array:
    """Scene-linear colour to display-encoded [0, 1]."""
    return srgb_encode(np.clip(rgb * np.float32(exposure), 0.0, 1.0))


def _checked(path: Path, rgb: Array) -> Array:
    bad = ~np.isfinite(rgb).all(axis=-1)
    if bad.any():
        row, column = (int(k) for k in np.argwhere(bad)[0])
        raise PictureError(
            f"{path}: expected finite numbers, got NaN or infinity in {int(bad.sum())} pixels, "
            f"the first at x {column}, y {row}; replace them first"
        )
    return np.maximum(rgb, np.float32(0))


def _openexr(path: Path) -> Any:
    try:
        import OpenEXR
    except ImportError:
        raise MissingExtraError(f"{path}: EXR files need the OpenEXR library; install it with: pip install 'unshade[exr]'") from None
    return OpenEXR


@contextlib.contextmanager
def _unheard() -> Iterator[None]:
    """Nothing of what the library prints about a damaged file, on standard output from Python and on standard error from C:
    the error that it raises says it, and the first may be a program's input."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.ExitStack() as after:
        with contextlib.suppress(OSError):
            kept = os.dup(2)
            after.callback(os.close, kept)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            after.callback(os.close, nowhere)
            os.dup2(nowhere, 2)
            after.callback(os.dup2, kept, 2)
        yield


def read_exr(path: Path, check_size: CheckSize, colors: bool = True) -> tuple[Array, Array | None]:
    """The colour of an OpenEXR file in linear sRGB primaries, (H, W, 3), not premultiplied, and its alpha.

    The channels taken are R, G, B at the root or of the only layer; a grey Y; or ``diffuse`` and ``specular`` layers,
    which a MatCap in Blender adds. Without ``colors`` the numbers come as they are stored. Raises PictureError,
    MissingExtraError.
    """
    library = _openexr(path)
    try:
        with _unheard(), library.File(str(path), header_only=True) as file:
            header = dict(file.header())
    except (RuntimeError, ValueError, TypeError, OSError) as error:
        raise PictureError(f"{path}: damaged or truncated EXR ({str(error).splitlines()[0]})") from None
    low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
    check_size(path, *(int(k) for k in high - low + 1))
    shown_low, shown_high = (np.asarray(corner, dtype=np.int64) for corner in header["displayWindow"])
    check_size(path, *(int(k) for k in shown_high - shown_low + 1))
    try:
        with _unheard(), library.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, OSError) as error:
        raise PictureError(f"{path}: damaged or truncated EXR ({str(error).splitlines()[0]})") from None
    stacked, alpha = _exr_color(path, channels)
    if (low != shown_low).any() or (high != shown_high).any():
        if alpha is None:
            alpha = np.ones(stacked.shape[:2], dtype=np.float32)
        stacked, alpha = (_placed(part, low, shown_low, shown_high) for part in (stacked, alpha))
    checked = stacked if alpha is None else np.concatenate([stacked, alpha[..., None]], axis=-1)
    _checked(path, checked)
    if not colors:
        return stacked, alpha
    if "chromaticities" in header:
        red_first = [float(k) for k in header["chromaticities"]]
        if len(red_first) == 8 and all(np.isfinite(red_first)):
            matrix = matrix_to_srgb((*red_first[6:], *red_first[:6]))  # type: ignore[arg-type]
            if np.abs(matrix - np.eye(3)).max() > 1e-3:
                stacked = (stacked @ matrix.T).astype(np.float32)
    stacked = np.maximum(stacked, np.float32(0))
    if alpha is not None:
        alpha = np.clip(alpha, 0, 1)
        stacked = np.where(alpha[..., None] > 0, stacked / np.maximum(alpha[..., None], np.float32(1e-6)), 0).astype(np.float32)
    return stacked, alpha


def _exr_color(path: Path, channels: dict[str, NDArray[Any]]) -> tuple[Array, Array | None]:
    def layer(prefix: str) -> Array | None:
        names = [next((n for n in channels if n.lower() == (prefix + c).lower()), None) for c in "RGB"]
        if None in names or len({channels[n].shape for n in names if n}) != 1:
            return None
        return np.stack([channels[n].astype(np.float32) for n in names if n], axis=-1)

    def alpha(prefix: str, shape: tuple[int, ...]) -> Array | None:
        found = channels.get(prefix + "A")
        return found.astype(np.float32) if found is not None and found.shape == shape else None

    prefixes = [""] + sorted({name.rpartition(".")[0] + "." for name in channels if "." in name})
    found = {prefix: color for prefix in prefixes if (color := layer(prefix)) is not None}
    if "" in found or len(found) == 1:
        prefix = "" if "" in found else next(iter(found))
        return found[prefix], alpha(prefix, found[prefix].shape[:2])
    combined = [prefix for prefix in found if prefix.lower().endswith("combined.")]
    if len(combined) == 1:
        return found[combined[0]], alpha(combined[0], found[combined[0]].shape[:2])
    parts = {prefix.lower().rstrip(".").rpartition(".")[2]: color for prefix, color in found.items()}
    if set(parts) == {"diffuse", "specular"} and parts["diffuse"].shape == parts["specular"].shape:
        return parts["diffuse"] + parts["specular"], None
    if "Y" in channels and not found and "RY" not in channels:
        grey = channels["Y"].astype(np.float32)
        return grey[..., None].repeat(3, axis=-1), alpha("", grey.shape)
    raise PictureError(f"{path}: expected channels R, G, B (or Y, or diffuse and specular layers), got {', '.join(sorted(channels)[:8])}")


def _placed(part: Array, low: NDArray[np.int64], shown_low: NDArray[np.int64], shown_high: NDArray[np.int64]) -> Array:
    """The display window's pixels, transparent black where the file stores none."""
    width, height = (int(k) for k in shown_high - shown_low + 1)
    shown = np.zeros((height, width, *part.shape[2:]), dtype=np.float32)
    left, top = (int(k) for k in low - shown_low)
    target = shown[max(top, 0) : max(top + part.shape[0], 0), max(left, 0) : max(left + part.shape[1], 0)]
    target[:] = part[max(-top, 0) : max(-top, 0) + target.shape[0], max(-left, 0) : max(-left, 0) + target.shape[1]]
    return shown


def write_exr(path: Path, rgb: Array, alpha: Array | None) -> None:
    """Half-float RGB or premultiplied RGBA, scene-linear. Raises MissingExtraError, OSError, RuntimeError."""
    library = _openexr(path)
    pixels = rgb if alpha is None else np.concatenate([rgb * alpha[..., None], alpha[..., None]], axis=-1)
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    channels = {"RGB" if alpha is None else "RGBA": np.ascontiguousarray(pixels.astype(np.float16))}
    with library.File(header, channels) as file:
        file.write(str(path))


def read_radiance(path: Path, check_size: CheckSize, colors: bool = True) -> tuple[Array, None]:
    """The colour of a Radiance HDR file, (H, W, 3) in linear sRGB primaries. Raises PictureError.

    Source: Ward, "Real Pixels", Graphics Gems II (1991), and the Radiance file format's page on pictures.
    """
    data = path.read_bytes()
    head, blank, body = data.partition(b"\n\n")
    match = re.match(rb"([-+])Y +(\d+) +([-+])X +(\d+)\n", body)
    if not blank or not match:
        raise PictureError(f"{path}: expected a Radiance header that ends in '-Y height +X width', got none")
    height, width = int(match[2]), int(match[4])
    check_size(path, width, height)
    fields = dict(line.split(b"=", 1) for line in head.split(b"\n") if b"=" in line and not line.startswith(b"#"))
    form = fields.get(b"FORMAT", b"32-bit_rle_rgbe").strip()
    if form != b"32-bit_rle_rgbe":
        raise PictureError(f"{path}: expected Radiance pixels as 32-bit_rle_rgbe, got {form.decode(errors='replace')}")
    rgbe = _radiance_pixels(path, body[match.end() :], width, height)
    rgb = np.ldexp(rgbe[..., :3].astype(np.float32), rgbe[..., 3:].astype(np.int32) - 136)
    rgb[rgbe[..., 3] == 0] = 0
    try:
        rgb /= np.prod([float(line.split(b"=")[1]) for line in head.split(b"\n") if line.startswith(b"EXPOSURE=")], dtype=np.float32)
        if colors and b"PRIMARIES" in fields:
            red_first = [float(k) for k in fields[b"PRIMARIES"].split()]
            rgb = (rgb @ matrix_to_srgb((*red_first[6:8], *red_first[:6])).T).astype(np.float32)  # type: ignore[arg-type]
    except (ValueError, np.linalg.LinAlgError):
        raise PictureError(f"{path}: expected numbers after EXPOSURE= and PRIMARIES= in the header") from None
    rgb = rgb[:: 1 if match[1] == b"-" else -1, :: 1 if match[3] == b"+" else -1]
    return _checked(path, rgb), None


def _radiance_pixels(path: Path, body: bytes, width: int, height: int) -> NDArray[np.uint8]:
    pixels = np.zeros((height, width, 4), dtype=np.uint8)
    at = 0
    for row in range(height):
        if body[at : at + 2] == b"\x02\x02" and len(body) >= at + 4 and int.from_bytes(body[at + 2 : at + 4], "big") == width:
            at = _run_length_row(body, at + 4, pixels[row])
        else:
            end = at + 4 * width
            if end <= len(body):
                pixels[row] = np.frombuffer(body[at:end], dtype=np.uint8).reshape(width, 4)
            at = end
            if row == 0 and (pixels[0, 1:, :3] == 1).all(axis=-1).any():
                raise PictureError(
                    f"{path}: expected Radiance pixels flat or in the run lengths of 1991, got the older ones; save it again or as EXR"
                )
        if at < 0 or at > len(body):
            raise PictureError(f"{path}: truncated or damaged Radiance picture, rows end at {row} of {height}")
    return pixels


def _run_length_row(body: bytes, at: int, row: NDArray[np.uint8]) -> int:
    """Decode one row, channel after channel; returns where the next begins, -1 where the runs do not fit."""
    width = row.shape[0]
    for channel in range(4):
        filled = 0
        while filled < width:
            if at + 1 >= len(body):
                return -1
            count = body[at]
            if count > 128:
                count -= 128
                values: Any = body[at + 1]
                at += 2
            else:
                values = np.frombuffer(body[at + 1 : at + 1 + count], dtype=np.uint8)
                at += 1 + count
                if len(values) != count:
                    return -1
            if count == 0 or filled + count > width:
                return -1
            row[filled : filled + count, channel] = values
            filled += count
    return at
