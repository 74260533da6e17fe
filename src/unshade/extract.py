"""A photo or a drawing of anything -> a picture of a sphere with the same shading, which `decompose` takes apart.

What is needed are normals: a ball has them by itself, a normal map brings them, an outline lets them be guessed. What comes back
is a MatCap, how well each direction was seen, and the normals of the photo, so that an edited tree can be put back (`apply`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from unshade import scene_linear
from unshade.errors import PictureError
from unshade.inflate import inflate
from unshade.normal_maps import Convention, Green, Space, check_size, read_normal_map
from unshade.paints import NONE, Paint, separate
from unshade.picture_files import Picture, read_picture
from unshade.pictures import SIZE, Disc, read_sphere
from unshade.reflectance import SMOOTH, Array, coverage, solve
from unshade.types import Image, Mask, Normals
from unshade.vector_art import Drawing

MOST_PIXELS = 500_000
"""Of the object that are looked at; of a larger one every second, third ... row and column."""

QUIET = 0.004
"""Deviation of a clean 8-bit photo; smoothness goes with the square of how many times more there is."""

MOST_SMOOTH = 20.0
LEAST = 64
"""Pixels of the object that are needed."""

OPAQUE = 0.98
"""An edge pixel that shows some of the background does not count."""


@dataclass(frozen=True)
class Extraction:
    """A MatCap made of a photo.

    ``image`` (3, S, S) in [0, 1] goes on past the silhouette; ``coverage`` (1, S, S) in [0, 1] says how well each direction was
    seen, the rest is filled. ``photo`` (3, H, W), ``normals`` (3, H, W) and ``mask`` (1, H, W) are of the photo, display-encoded.
    ``guess`` says that the normals come from an outline alone. ``paints`` are the other paints and shadows that were taken out.
    """

    image: Image
    coverage: Mask
    photo: Image
    normals: Normals
    mask: Mask
    how: str
    guess: bool = False
    paints: tuple[Paint, ...] = ()
    exposure: float = 1.0
    disc: Disc | None = None
    convention: Convention | None = None
    told: bool = True
    unexplained: float = 0.0

    @property
    def seen(self) -> float:
        """Share of the sphere's disc that was seen."""
        size = self.coverage.shape[-1]
        steps = (torch.arange(size) + 0.5) * (2.0 / size) - 1.0
        disc = steps.square()[None] + steps.square()[:, None] <= 1.0
        return float((self.coverage[0][disc] >= 0.5).float().mean())


@dataclass(frozen=True)
class _Object:
    """What an extraction starts from: (H, W, 3) ``rgb`` and ``normals``, and ``inside`` (H, W) in [0, 1]."""

    rgb: Array
    normals: Array
    inside: Array
    how: str
    extra: dict[str, object] = field(default_factory=dict)


def from_ball(
    path: str | Path, *, disc: Sequence[float] | Disc | None = None, ignore: str | Path | None = None, size: int = SIZE, even: bool = False
) -> Extraction:
    """The MatCap of a photo of a ball; the ball is found as `read_sphere` does, or given, and may be cut by the frame.

    Args:
        ignore: a picture of the photo's size, white where pixels are not of the object; they are not in ``mask`` either.
        even: take texture and shadow out, which on a ball can only be told from shading by their sharp edges.
    Raises:
        PictureError: see `read_sphere`.
    """
    sphere = read_sphere(path, disc=disc, ignore=ignore)
    picture = read_picture(path)
    found = sphere.disc
    rows, columns = np.indices((picture.height, picture.width))
    x, y = (columns + 0.5 - found.cx) / found.r, (found.cy - rows - 0.5) / found.r
    radius = np.hypot(x, y)
    inside = np.clip((1.0 - radius) * found.r + 0.5, 0.0, 1.0)
    flat = np.maximum(radius, 1.0)
    x, y = x / flat, y / flat
    normals = np.stack([x, y, np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))], axis=-1)
    normals[inside == 0.0] = (0.0, 0.0, 1.0)
    rgb, exposure = _encoded(picture, inside > 0.5, sphere.exposure)
    # A MatCap that fills its frame may be used to its last pixel; in front of something the outermost show some of it.
    given = _Object(rgb, normals, inside * _opacity(picture), "ball", {"exposure": exposure, "disc": found})
    return _extract(path, given, _ignored(path, ignore, picture), size, even)


def from_normal_map(
    path: str | Path,
    normals: str | Path,
    *,
    green: Green = "auto",
    space: Space = "auto",
    ignore: str | Path | None = None,
    size: int = SIZE,
    even: bool = True,
) -> Extraction:
    """The MatCap of a photo of any object whose normal map is known. Raises PictureError, also for one of another size."""
    picture = read_picture(path)
    found = read_normal_map(normals, green=green, space=space)
    check_size(found, normals, picture.width, picture.height, path)
    inside = found.mask[0].double().numpy() * _opacity(picture)
    rgb, exposure = _encoded(picture, inside > 0.5)
    extra = {"exposure": exposure, "convention": found.convention, "told": found.told}
    given = _Object(rgb, np.moveaxis(found.normals.numpy(), 0, -1), inside, "normal map", extra)
    return _extract(path, given, _ignored(path, ignore, picture), size, even)


def from_mask(path: str | Path, mask: str | Path, *, ignore: str | Path | None = None, size: int = SIZE, even: bool = True) -> Extraction:
    """The MatCap of a photo of an object whose outline is known: its normals are guessed by `inflate`. Raises PictureError."""
    picture = read_picture(path)
    inside = read_mask(mask, picture, path) * _opacity(picture)
    rgb, exposure = _encoded(picture, inside > 0.5)
    given = _Object(rgb, np.moveaxis(inflate(inside, mask).numpy(), 0, -1), inside, "outline", {"exposure": exposure, "guess": True})
    return _extract(path, given, _ignored(path, ignore, picture), size, even)


def from_drawing(path: str | Path, region: str, *, size: int = SIZE, even: bool = False) -> Extraction:
    """The MatCap of one shape or group of an SVG: its shading, lifted off by guessing normals from its outline.

    Raises:
        PictureError: no such drawing or shape. MissingExtraError: without the library that draws SVG.
    """
    shape = Drawing.read(path).lift(region)
    normals = np.moveaxis(inflate(shape.alpha, f"{path}, region {region}").numpy(), 0, -1)
    return _extract(path, _Object(shape.rgb, normals, shape.alpha, f"drawing, region {region}", {"guess": True}), None, size, even)


def read_mask(path: str | Path, picture: Picture, of: str | Path) -> Array:
    """(H, W) in [0, 1]: a picture's alpha where it has some, else how white it is. Raises PictureError for another size."""
    mask = read_picture(path, colors=False)
    if (mask.width, mask.height) != (picture.width, picture.height):
        raise PictureError(
            f"{path}: expected a mask of the size of {of}, {picture.width} x {picture.height}, got {mask.width} x {mask.height}"
        )
    white = mask.rgb.mean(axis=-1).clip(0, 1).astype(np.float64)
    if mask.alpha is not None and mask.alpha.min() < 0.5:
        return mask.alpha.astype(np.float64)
    return white


def read_photo(path: str | Path, exposure: float = 1.0) -> tuple[Image, Mask | None, float]:
    """A photo (3, H, W) display-encoded, its alpha (1, H, W), and what its light was multiplied by.

    Args:
        exposure: of the tree that explains it; for scene-linear photos where it is 1 too, one is found.
    """
    picture = read_picture(path)
    rgb, factor = _encoded(picture, _opacity(picture) > 0.5, exposure if exposure != 1.0 else None)
    alpha = None if picture.alpha is None else torch.from_numpy(picture.alpha.astype(np.float32))[None]
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(rgb, -1, 0))).float(), alpha, factor


def _ignored(path: str | Path, ignore: str | Path | None, picture: Picture) -> Array | None:
    return None if ignore is None else read_mask(ignore, picture, path)


def _opacity(picture: Picture) -> Array:
    return np.ones((picture.height, picture.width)) if picture.alpha is None else picture.alpha.astype(np.float64)


def _encoded(picture: Picture, inside: np.ndarray, exposure: float | None = None) -> tuple[Array, float]:
    """Display-encoded colour, and what scene-linear light was multiplied by."""
    if not picture.scene_linear:
        return picture.rgb.astype(np.float64), 1.0
    factor = scene_linear.exposure_for(picture.rgb, inside) if exposure is None else exposure
    return scene_linear.encode(picture.rgb, factor).astype(np.float64), factor


def _extract(path: str | Path, given: _Object, ignored: Array | None, size: int, even: bool) -> Extraction:
    if size < 16 or size > 2048:
        raise PictureError(f"{path}: expected a size from 16 to 2048, got {size}")
    inside = given.inside if ignored is None else given.inside * (1.0 - ignored)
    valid = inside >= OPAQUE
    if valid.sum() < LEAST:
        raise PictureError(f"{path}: expected an object of at least {LEAST} pixels, got {int(valid.sum())}")
    step = max(1, int(np.ceil(np.sqrt(valid.sum() / MOST_PIXELS))))
    rgb, normals = given.rgb[::step, ::step], given.normals[::step, ::step]
    valid = valid[::step, ::step]
    paints: tuple[Paint, ...] = ()
    unexplained = 0.0
    if even:
        found = separate(rgb, normals, valid)
        paints, weights, flat = found.paints, found.weights[valid], found.flat[valid]
        smooth = float(np.clip(SMOOTH * (found.noise / QUIET) ** 2, SMOOTH, MOST_SMOOTH))
        counted = (found.labels[valid] != NONE).astype(np.float64)
        unexplained = 1.0 - float(counted.mean())
    else:
        flat, smooth = rgb[valid], SMOOTH
        weights = np.ones(len(flat))
        counted = weights
    image = solve(normals[valid], flat, weights, size, smooth)
    seen = coverage(normals[valid], counted, size)
    return Extraction(
        torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 0))).float(),
        torch.from_numpy(seen[None]).float(),
        torch.from_numpy(np.ascontiguousarray(np.moveaxis(given.rgb, -1, 0))).float(),
        torch.from_numpy(np.ascontiguousarray(np.moveaxis(given.normals, -1, 0))).float(),
        torch.from_numpy(inside[None]).float(),
        given.how,
        paints=paints,
        unexplained=unexplained,
        **given.extra,  # type: ignore[arg-type]
    )
