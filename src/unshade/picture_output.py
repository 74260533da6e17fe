"""Write pictures: whole or not at all, in the format that the suffix names."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PILImage

from unshade import scene_linear
from unshade.color_profiles import srgb_decode
from unshade.errors import OutputError
from unshade.files import check_place
from unshade.png import write_png
from unshade.types import Image, Mask

_PILLOW = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WEBP", ".tif": "TIFF", ".tiff": "TIFF", ".bmp": "BMP"}


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside ``path`` that takes its place when the block ends well, and vanishes otherwise.

    Raises OutputError where the folder cannot be written.
    """
    temporary: Path | None = None
    try:
        check_place(path)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem[:40]}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with contextlib.suppress(OSError):
            # mkstemp makes a private file; give it the rights a plain open() would.
            mask = os.umask(0)
            os.umask(mask)
            temporary.chmod(0o666 & ~mask)
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


_OPTIONS: dict[str, dict[str, Any]] = {
    "JPEG": {"quality": 95, "subsampling": 0},
    "WEBP": {"lossless": True, "exact": True},
    "PNG": {"compress_level": 4},  # a third of the default's time, a few percent larger
}
"""What Pillow is told for each format."""


def write_picture(path: str | Path, image: Image, alpha: Mask | None = None, *, bits: int = 8, exposure: float = 1.0) -> None:
    """Write a display-encoded picture.

    Args:
        path: the suffix chooses PNG, JPEG, WebP, TIFF, BMP or EXR. A JPEG with alpha is put on black; an EXR holds linear
            light.
        image: (3, H, W) or (1, H, W), in [0, 1]; other numbers are clipped.
        alpha: (1, H, W) in [0, 1], not premultiplied.
        bits: 8, or 16 for PNG.
        exposure: what the picture's light was multiplied by when it was read; an EXR is divided by it.
    Raises:
        OutputError: an unknown suffix, or a place that cannot be written. Nothing half-written is left.
    """
    path = Path(path)
    suffix = _suffix(path)
    if bits not in (8, 16) or (bits == 16 and suffix not in (".png", ".exr")):
        raise OutputError(f"{path}: expected 8 bits, or 16 for PNG, got {bits} for {suffix}")
    if image.ndim != 3 or image.shape[0] not in (1, 3) or (alpha is not None and alpha.shape != (1, *image.shape[1:])):
        raise OutputError(
            f"{path}: expected an image (3, H, W) and alpha (1, H, W), "
            f"got {tuple(image.shape)} and {None if alpha is None else tuple(alpha.shape)}"
        )
    color = np.moveaxis(image.detach().cpu().expand(3, -1, -1).double().numpy(), 0, -1)
    opacity = None if alpha is None else alpha[0].detach().cpu().double().clamp(0, 1).numpy()
    if not np.isfinite(color).all():
        raise OutputError(f"{path}: expected finite numbers, got NaN or infinity in the picture to write")
    color = color.clip(0.0, 1.0)
    with replacing(path) as temporary:
        _writer(suffix, color, opacity, bits, exposure)(temporary)


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _PILLOW and suffix != ".exr":
        raise OutputError(f"{path}: expected a name that ends in {', '.join([*_PILLOW, '.exr'])}, got {path.suffix or 'no suffix'!r}")
    return suffix


def check_picture(path: Path) -> None:
    """Fail before other files are written: raises OutputError where `write_picture` would for this name."""
    _suffix(path)
    try:
        check_place(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None


def _writer(
    suffix: str, color: NDArray[np.float64], alpha: NDArray[np.float64] | None, bits: int, exposure: float
) -> Callable[[Path], None]:
    if suffix == ".exr":
        linear = (srgb_decode(color) / exposure).astype(np.float32)
        return lambda path: scene_linear.write_exr(path, linear, None if alpha is None else alpha.astype(np.float32))
    if suffix in (".jpg", ".jpeg", ".bmp") and alpha is not None:
        color, alpha = color * alpha[..., None], None
    channels = color if alpha is None else np.concatenate([color, alpha[..., None]], axis=-1)
    if bits == 16:
        data = write_png(np.round(np.moveaxis(channels, -1, 0) * 65535).astype(np.uint16))
        return lambda path: _write_bytes(path, data)
    options = _OPTIONS.get(_PILLOW[suffix], {})
    picture = PILImage.fromarray(np.round(channels * 255).astype(np.uint8))
    return lambda path: picture.save(path, format=_PILLOW[suffix], **options)


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)
