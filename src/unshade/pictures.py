"""Pictures in: find the sphere in a file and bring it to one square size. Pictures out: `picture_output`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image as PILImage

from unshade import scene_linear
from unshade.errors import PictureError
from unshade.picture_files import MIN_SIDE, SUFFIXES, Picture, read_picture
from unshade.picture_output import write_picture
from unshade.sphere import sphere_grid
from unshade.sphere_finder import Disc, disc_of_alpha, find_disc
from unshade.types import Image, Mask

__all__ = ["Disc", "SphereImage", "find_pictures", "read_sphere", "sphere_from_array", "write_picture"]

SIZE = 256
"""Width and height a sphere is brought to."""


@dataclass(frozen=True)
class SphereImage:
    """A sphere cut from its picture: the disc of radius 1 touches the four sides.

    ``image`` is (3, S, S) float32, sRGB-encoded in [0, 1]. ``valid`` is (1, S, S) bool, true for pixels inside the disc
    that show the sphere and are not ignored. ``exposure`` is the factor that scene-linear input was multiplied by, 1 for
    any other.
    """

    image: Image
    valid: Mask
    disc: Disc
    exposure: float = 1.0

    @property
    def size(self) -> int:
        """Width and height."""
        return self.image.shape[-1]


def read_sphere(
    path: str | Path,
    *,
    disc: Sequence[float] | Disc | None = None,
    ignore: str | Path | None = None,
    size: int = SIZE,
    exposure: float | None = None,
) -> SphereImage:
    """Read a picture and find its sphere: the given disc, the alpha channel's silhouette, a circle on a plain
    background, or the inscribed disc of a full-frame MatCap, in this order.

    Args:
        path: any supported picture; see `picture_files`.
        disc: centre x, centre y and radius in pixels of the picture, from its top left corner.
        ignore: a picture of the same size, white where pixels do not count (a watermark, a hand, a hole).
        size: width and height of the result.
        exposure: factor for scene-linear input; found from the sphere's brightness where it is None.
    Raises:
        PictureError: the file cannot be used, or no sphere is found.
        MissingExtraError: an EXR without the reader for it.
    """
    path = Path(path)
    picture = read_picture(path)
    ignored = None if ignore is None else _read_ignored(Path(ignore), path, picture)
    return _cut(str(path), picture, disc, ignored, size, exposure)


def sphere_from_array(
    image: torch.Tensor | NDArray[np.floating], *, disc: Sequence[float] | Disc | None = None, size: int = SIZE
) -> SphereImage:
    """The same for a picture in memory: (3, H, W) tensor or array, display-encoded in [0, 1]; (4, H, W) has alpha."""
    array = np.asarray(image.detach().cpu() if isinstance(image, torch.Tensor) else image)
    if array.ndim != 3 or array.shape[0] not in (3, 4) or not np.issubdtype(array.dtype, np.floating):
        raise PictureError(f"image: expected (3, H, W) or (4, H, W) floats in [0, 1], got {array.dtype} {tuple(array.shape)}")
    if min(array.shape[1:]) < MIN_SIDE:
        raise PictureError(f"image: expected at least {MIN_SIDE} x {MIN_SIDE} pixels, got {array.shape[2]} x {array.shape[1]}")
    if not np.isfinite(array).all() or array.min() < 0.0 or array.max() > 1.0:
        raise PictureError("image: expected finite numbers in [0, 1]")
    array = np.moveaxis(array, 0, -1).astype(np.float32)
    return _cut("image", Picture(array[..., :3], array[..., 3] if array.shape[-1] == 4 else None, False), disc, None, size, None)


def _read_ignored(path: Path, of: Path, picture: Picture) -> NDArray[np.float32]:
    """(H, W), 1 where a pixel is to be ignored."""
    mask = read_picture(path)
    if (mask.width, mask.height) != (picture.width, picture.height):
        raise PictureError(
            f"{path}: expected a mask of the size of {of}, {picture.width} x {picture.height}, got {mask.width} x {mask.height}"
        )
    white = mask.rgb.mean(axis=-1).clip(0, 1)
    return white if mask.alpha is None else white * mask.alpha


def _cut(
    name: str, picture: Picture, disc: Sequence[float] | Disc | None, ignored: NDArray[np.float32] | None, size: int, exposure: float | None
) -> SphereImage:
    if size < MIN_SIDE:
        raise PictureError(f"{name}: expected a size of at least {MIN_SIDE}, got {size}")
    alpha = picture.alpha
    if alpha is not None:
        if alpha.max() < 1 / 255:
            raise PictureError(f"{name}: fully transparent; nothing of a sphere can be seen")
        if alpha.min() > 0.5:
            alpha = None
    rgb = picture.rgb
    if picture.scene_linear:
        everywhere = np.ones(rgb.shape[:2], dtype=bool)
        seen = scene_linear.encode(rgb, scene_linear.exposure_for(rgb, everywhere if alpha is None else alpha > 0.5))
    else:
        seen = rgb
    found = _given(name, disc, picture) if disc is not None else _locate(name, seen, alpha)
    inside = _inside(picture, found)
    if picture.scene_linear:
        if exposure is None:
            exposure = scene_linear.exposure_for(rgb, inside if inside.any() else np.ones_like(inside))
        elif not (math.isfinite(exposure) and exposure > 0):
            raise PictureError(f"{name}: expected an exposure above 0, got {exposure}")
        rgb = scene_linear.encode(rgb, exposure)
    else:
        exposure = 1.0
    return _resample(rgb, alpha, ignored, found, size, exposure)


def _locate(name: str, rgb: NDArray[np.float32], alpha: NDArray[np.float32] | None) -> Disc:
    height, width = rgb.shape[:2]
    if alpha is not None:
        found = disc_of_alpha(alpha.astype(np.float64))
        if found is None:
            raise PictureError(f"{name}: no sphere found: the outline of its alpha channel is no circle; use --disc cx,cy,r")
        return found
    found = find_disc(rgb.astype(np.float64))
    if found is None:
        frame = (
            "neither a circle on a plain background nor a smooth square MatCap" if width == height else "no circle on a plain background"
        )
        raise PictureError(f"{name}: no sphere found in {width} x {height} pixels ({frame}); use --disc cx,cy,r")
    return found


def _given(name: str, disc: Sequence[float] | Disc, picture: Picture) -> Disc:
    numbers = (disc.cx, disc.cy, disc.r) if isinstance(disc, Disc) else tuple(disc)
    if len(numbers) != 3 or not all(isinstance(n, int | float | np.number) and math.isfinite(n) for n in numbers):
        raise PictureError(f"{name}: expected a disc as cx,cy,r in pixels, got {disc!r}")
    cx, cy, r = (float(n) for n in numbers)
    if r < MIN_SIDE / 2:
        raise PictureError(f"{name}: expected a disc radius of at least {MIN_SIDE / 2:g} pixels, got {r:g}")
    if not (0 <= cx <= picture.width and 0 <= cy <= picture.height) or r > max(picture.width, picture.height):
        raise PictureError(
            f"{name}: expected a disc inside {picture.width} x {picture.height} pixels, got centre {cx:g},{cy:g} and radius {r:g}"
        )
    return disc if isinstance(disc, Disc) else Disc(cx, cy, r)


def _inside(picture: Picture, disc: Disc) -> NDArray[np.bool_]:
    rows, columns = np.indices(picture.rgb.shape[:2])
    inside: NDArray[np.bool_] = np.hypot(columns + 0.5 - disc.cx, rows + 0.5 - disc.cy) <= disc.r
    return inside if picture.alpha is None else inside & (picture.alpha > 0.5)


def _resample(
    rgb: NDArray[np.float32], alpha: NDArray[np.float32] | None, ignored: NDArray[np.float32] | None, disc: Disc, size: int, exposure: float
) -> SphereImage:
    """The disc's square at the new size.

    Pixels are weighted by alpha, so that what is behind the silhouette does not bleed in; what lies outside the frame
    repeats its border and does not count.
    """
    height, width = rgb.shape[:2]
    coverage = np.ones((height, width), dtype=np.float32) if alpha is None else alpha
    planes = [*np.moveaxis(rgb if alpha is None else rgb * alpha[..., None], -1, 0), coverage]
    planes.append(np.ones((height, width), dtype=np.float32) if ignored is None else (ignored < 0.5).astype(np.float32))
    box = (disc.cx - disc.r, disc.cy - disc.r, disc.cx + disc.r, disc.cy + disc.r)
    whole = [round(edge) for edge in box]
    if max(abs(edge - near) for edge, near in zip(box, whole, strict=True)) < 1e-3:
        box = (float(whole[0]), float(whole[1]), float(whole[2]), float(whole[3]))
    pad = max(0, math.ceil(-min(box[0], box[1], width - box[2], height - box[3])))
    scale = 2 * disc.r / size
    # Hamming averages areas without ringing, bicubic interpolates; both keep a picture that has the size already.
    method = PILImage.Resampling.HAMMING if scale >= 1 else PILImage.Resampling.BICUBIC
    box = (box[0] + pad, box[1] + pad, box[2] + pad, box[3] + pad)

    def resized(plane: NDArray[np.float32], mode: str) -> NDArray[np.float32]:
        padded = np.pad(plane, pad, mode=mode) if pad else plane  # type: ignore[call-overload]
        return np.array(PILImage.fromarray(np.ascontiguousarray(padded)).resize((size, size), method, box=box), dtype=np.float32)

    red, green, blue, cover = (resized(plane, "edge") for plane in planes[:4])
    counted = resized(planes[4], "constant")
    color = np.stack([red, green, blue])
    if alpha is not None:
        color = np.where(cover > 1 / 512, color / np.maximum(cover, np.float32(1 / 512)), 0)
        exact = cover == 1.0
        color[:, exact] = np.stack([red, green, blue])[:, exact]
    image = torch.from_numpy(np.clip(color, 0.0, 1.0).astype(np.float32))
    # In front of a background the silhouette's own pixels show some of it; a MatCap that fills its frame goes on past them.
    fills_frame = abs(disc.r - min(width, height) / 2) < 0.5
    reach = 1.0 if alpha is not None or fills_frame else 1.0 - 0.75 / disc.r
    valid = (sphere_grid(size).square().sum(0) <= reach * reach) & torch.from_numpy((cover > 0.5) & (counted > 0.5))
    return SphereImage(image, valid[None], disc, exposure)


def find_pictures(paths: Iterable[str | Path]) -> list[Path]:
    """The pictures among files and folders: a file stands for itself, a folder for the pictures in it, by name.

    Raises PictureError for a path that does not exist and for a folder without pictures.
    """
    found: list[Path] = []
    for path in (Path(p) for p in paths):
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file() and not p.name.startswith("."))
            if not inside:
                raise PictureError(f"{path}: expected a folder with pictures ({', '.join(sorted(SUFFIXES))}), found none")
            found += inside
        elif path.exists():
            found.append(path)
        else:
            raise PictureError(f"{path}: no such file")
    return list(dict.fromkeys(found))
