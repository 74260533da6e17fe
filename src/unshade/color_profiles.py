"""What a file says about its colours, and the way from there to sRGB: ICC profiles, PNG's gamma, primaries and cICP."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PILImage
from PIL import ImageCms

from unshade.errors import PictureError

Array: TypeAlias = NDArray[np.float32]
Chromaticities: TypeAlias = tuple[float, float, float, float, float, float, float, float]
"""x and y of white, red, green and blue."""

SRGB: Chromaticities = (0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
DISPLAY_P3: Chromaticities = (0.3127, 0.3290, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060)
REC2020: Chromaticities = (0.3127, 0.3290, 0.708, 0.292, 0.170, 0.797, 0.131, 0.046)

_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_D50 = np.array([0.96422, 1.0, 0.82521])


@dataclass(frozen=True)
class Icc:
    """An ICC profile that is not sRGB."""

    data: bytes


@dataclass(frozen=True)
class Primaries:
    """An RGB space by its curves and its matrix to linear sRGB."""

    curves: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
    """Linear light at evenly spaced encoded values from 0 to 1, one table a channel."""
    to_linear_srgb: NDArray[np.float64]
    """(3, 3)"""

    def to_srgb(self, rgb: Array) -> Array:
        """(..., 3) encoded in this space to sRGB-encoded in [0, 1]; colours outside sRGB are clipped."""
        linear = np.stack(
            [np.interp(rgb[..., c], np.linspace(0.0, 1.0, len(curve)), curve) for c, curve in enumerate(self.curves)], axis=-1
        )
        return srgb_encode(np.clip(linear @ self.to_linear_srgb.T, 0.0, 1.0))


Profile: TypeAlias = Icc | Primaries | None


def srgb_encode(linear: NDArray[np.floating]) -> Array:
    """Linear light in [0, 1] to sRGB, float32 (`render.srgb_encode` for arrays, so that reading a file needs no torch)."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
    return encoded.astype(np.float32)


def srgb_decode(encoded: NDArray[np.floating]) -> NDArray[np.float64]:
    """sRGB to linear light."""
    stored = encoded.astype(np.float64)
    light: NDArray[np.float64] = np.where(stored <= 0.04045, stored / 12.92, ((np.maximum(stored, 0.04045) + 0.055) / 1.055) ** 2.4)
    return light


def to_xyz(chromaticities: Chromaticities) -> NDArray[np.float64]:
    """(3, 3) from linear RGB to CIE XYZ, white at Y = 1 (SMPTE RP 177)."""
    xy = np.array(chromaticities, dtype=np.float64).reshape(4, 2)
    columns = np.stack([xy[:, 0] / xy[:, 1], np.ones(4), (1 - xy.sum(1)) / xy[:, 1]])
    return columns[:, 1:] * np.linalg.solve(columns[:, 1:], columns[:, 0])


def adapt(source_white: NDArray[np.float64], target_white: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) Bradford adaptation of XYZ from one white to another."""
    gains = (_BRADFORD @ target_white) / (_BRADFORD @ source_white)
    return np.asarray(np.linalg.solve(_BRADFORD, gains[:, None] * _BRADFORD), dtype=np.float64)


def matrix_to_srgb(chromaticities: Chromaticities) -> NDArray[np.float64]:
    """(3, 3) from linear RGB of these primaries to linear sRGB; white stays white."""
    source, target = to_xyz(chromaticities), to_xyz(SRGB)
    return np.asarray(np.linalg.solve(target, adapt(source.sum(1), target.sum(1)) @ source), dtype=np.float64)


def declared(path: Path, image: PILImage.Image) -> Profile:
    """What the file says about its colours; None where that is sRGB or nothing. cICP wins over ICC, ICC over gAMA."""
    if image.format == "PNG":
        code = _cicp(path)
        if code is not None:
            return _from_cicp(path, code)
    icc = image.info.get("icc_profile")
    if icc:
        return None if _is_srgb(path, icc, image.mode) else Icc(icc)
    if image.format != "PNG" or "srgb" in image.info:
        return None
    gamma = image.info.get("gamma")
    primaries = image.info.get("chromaticity")
    # 1/2.2 is how PNG writers approximate the sRGB curve; reading it literally would shift the shadows.
    plain_curve = gamma is None or abs(gamma - 1 / 2.2) < 0.005
    plain_primaries = primaries is None or max(abs(a - b) for a, b in zip(primaries, SRGB, strict=True)) < 0.005
    if plain_curve and plain_primaries:
        return None
    if gamma is not None and not 0.05 <= gamma <= 20:
        raise PictureError(f"{path}: expected a PNG gamma between 0.05 and 20, got {gamma:g}")
    steps = np.linspace(0.0, 1.0, 65536)
    curve = srgb_decode(steps) if plain_curve or gamma is None else steps ** (1.0 / gamma)
    matrix = np.eye(3) if plain_primaries or primaries is None else matrix_to_srgb(primaries)
    return Primaries((curve, curve, curve), matrix)


def _cicp(path: Path) -> tuple[int, int] | None:
    """(primaries, transfer) of a PNG's cICP chunk, which Pillow does not read."""
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            if name == b"cICP" and length == 4:
                primaries, transfer = file.read(2)
                return primaries, transfer
            if name in (b"IDAT", b"IEND"):
                return None
            file.seek(length + 4, io.SEEK_CUR)
    return None


def _from_cicp(path: Path, code: tuple[int, int]) -> Profile:
    """ITU-T H.273 codes: the primaries and the curves that a display-referred picture may have."""
    primaries = {1: SRGB, 9: REC2020, 12: DISPLAY_P3}.get(code[0])
    steps = np.linspace(0.0, 1.0, 65536)
    curve = {13: srgb_decode(steps), 8: steps, 4: steps**2.2, 1: steps**2.4, 14: steps**2.4, 15: steps**2.4}.get(code[1])
    if primaries is None or curve is None:
        raise PictureError(
            f"{path}: expected sRGB, Display P3 or Rec. 2020 colours (cICP), got primaries {code[0]} with transfer {code[1]}; "
            "HDR transfers are not display-referred: save it as EXR or as sRGB"
        )
    if code == (1, 13):
        return None
    return Primaries((curve, curve, curve), matrix_to_srgb(primaries))


def _opened(path: Path, data: bytes) -> ImageCms.ImageCmsProfile:
    try:
        return ImageCms.ImageCmsProfile(io.BytesIO(data))
    except (OSError, ImageCms.PyCMSError) as error:
        raise PictureError(f"{path}: its ICC profile cannot be read ({error}); convert the picture to sRGB first") from None


def _transformed(path: Path, data: bytes, image: PILImage.Image) -> PILImage.Image:
    """littleCMS to 8-bit sRGB, relative colorimetric with black point compensation."""
    try:
        transform = ImageCms.buildTransform(
            _opened(path, data),
            ImageCms.createProfile("sRGB"),
            image.mode,
            "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
            ImageCms.Flags.BLACKPOINTCOMPENSATION,
        )
        converted = ImageCms.applyTransform(image, transform)
    except (ImageCms.PyCMSError, ValueError, TypeError) as error:
        raise PictureError(f"{path}: its ICC profile does not fit its {image.mode} pixels ({error}); convert it to sRGB first") from None
    assert converted is not None
    return converted


def _is_srgb(path: Path, data: bytes, mode: str) -> bool:
    """True where the profile changes no colour by more than 2 of 255, so that an sRGB picture passes bit for bit."""
    if mode in ("CMYK", "LAB"):
        return False
    if _opened(path, data).profile.xcolor_space.strip() != "RGB":
        return False
    steps = np.linspace(0, 255, 9).round().astype(np.uint8)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(27, 27, 3)
    converted = np.asarray(_transformed(path, data, PILImage.fromarray(grid)))
    return bool(np.abs(converted.astype(int) - grid).max() <= 2)


def convert(path: Path, profile: Icc, image: PILImage.Image) -> PILImage.Image:
    """An 8-bit picture with a profile to sRGB, RGB mode; alpha is left behind."""
    space = _opened(path, profile.data).profile.xcolor_space.strip()
    mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK", "Lab": "LAB"}.get(space)
    if mode is None:
        raise PictureError(f"{path}: expected an RGB, grey, CMYK or Lab profile, got {space}; convert it to sRGB first")
    return _transformed(path, profile.data, image if image.mode == mode else image.convert("RGB").convert(mode))


def convert_array(path: Path, profile: Icc, color: Array) -> Array:
    """16-bit colour through a profile that littleCMS alone can read: converted at 8 bits."""
    eight = PILImage.fromarray((color * 255 + 0.5).astype(np.uint8))
    return np.asarray(convert(path, profile, eight), dtype=np.float32) / np.float32(255)


def matrix_shaper(data: bytes) -> Primaries | None:
    """The curves and matrix of an ICC profile that is made of those (most RGB working spaces), None for any other.

    Source: ICC.1:2022, 7.3 (tag table), 10.6 (curveType), 10.18 (parametricCurveType), 10.31 (XYZType).
    """
    tags = _icc_tags(data)
    if (
        data[16:20] != b"RGB "
        or b"A2B0" in tags
        or any(name not in tags for name in (b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"))
    ):
        return None
    curves = tuple(_curve(tags[name]) for name in (b"rTRC", b"gTRC", b"bTRC"))
    if any(curve is None for curve in curves) or any(len(tags[name]) < 20 for name in (b"rXYZ", b"gXYZ", b"bXYZ")):
        return None
    columns = [np.array(struct.unpack(">3i", tags[name][8:20])) / 65536.0 for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
    srgb = to_xyz(SRGB)
    matrix = np.linalg.solve(adapt(srgb.sum(1), _D50) @ srgb, np.stack(columns, axis=1))
    return Primaries(curves, matrix)  # type: ignore[arg-type]


def _icc_tags(data: bytes) -> dict[bytes, bytes]:
    if len(data) < 132:
        return {}
    count = min(int.from_bytes(data[128:132], "big"), (len(data) - 132) // 12)
    entries = (struct.unpack(">4sII", data[132 + 12 * k : 144 + 12 * k]) for k in range(count))
    return {name: data[offset : offset + size] for name, offset, size in entries}


def _curve(tag: bytes) -> NDArray[np.float64] | None:
    steps = np.linspace(0.0, 1.0, 65536)
    if tag[:4] == b"curv":
        count = int.from_bytes(tag[8:12], "big")
        table = np.frombuffer(tag[12 : 12 + 2 * count], dtype=">u2").astype(np.float64)
        if len(table) != count:
            return None
        if count == 0:
            return steps
        return steps ** (table[0] / 256.0) if count == 1 else table / 65535.0
    if tag[:4] == b"para":
        kind = int.from_bytes(tag[8:10], "big")
        needed = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}.get(kind, 99)
        if len(tag) < 12 + 4 * needed:
            return None
        stored = [number / 65536.0 for number in struct.unpack(f">{needed}i", tag[12 : 12 + 4 * needed])]
        g, a, b, c, d, e, f = stored + [0.0] * (7 - needed)
        if kind == 0:
            return steps**g
        powered = np.maximum(a * steps + b, 0.0) ** g
        if kind <= 2:
            return np.where(steps >= -b / a, powered + c, c) if a else None
        return np.where(steps >= d, powered + e, c * steps + f)
    return None
