"""Normal maps in any of the usual conventions, told apart by what the map itself shows.

Two things betray a wrong axis. At the silhouette of an object the normals point outward, away from it. And the slopes of a
surface have no curl: with green turned round they seem to. A map without a silhouette whose relief runs one way only shows
neither; it is read as what was asked for, or as OpenGL.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from unshade.color_profiles import srgb_decode
from unshade.errors import PictureError
from unshade.picture_files import Picture, read_picture
from unshade.reflectance import Array
from unshade.types import Mask, Normals

SURE = 0.25
"""How much better than its opposite a reading must fit the silhouette, as a cosine, to be taken for certain."""

CURL = 1.3
"""How many times more curl the opposite reading must have."""

LONG, UNUSUAL_LONG = 0.15, 0.06
"""Deviation from unit length of colours that are no normals, in the usual reading and in another, of which one may fit a photo by
chance; three quarters of a map's are nearer."""

Space = Literal["auto", "tangent", "camera"]
Green = Literal["auto", "opengl", "directx"]


@dataclass(frozen=True)
class Convention:
    """How a map's colours stand for a normal with +x right, +y up, +z to the viewer.

    ``green`` is opengl (up) or directx (down). ``depth`` is 1 where blue points to the viewer, as in tangent space and in most
    camera spaces, and -1 where it points into the picture, as in a camera that looks along +z. ``red`` is -1 where red points
    left. ``encoding`` is unit (``2c - 1``), plain blue (blue holds z itself), two channels (z is computed), srgb (the map was
    saved as if it were a picture) or vectors (the numbers themselves).
    """

    green: Literal["opengl", "directx"] = "opengl"
    depth: int = 1
    red: int = 1
    encoding: str = "unit"

    @property
    def flips(self) -> tuple[int, int, int]:
        """Signs that bring the map's numbers to ours."""
        return self.red, 1 if self.green == "opengl" else -1, self.depth

    def __str__(self) -> str:
        words = ["OpenGL (green up)" if self.green == "opengl" else "DirectX (green down)"]
        words += ["blue into the picture"] if self.depth < 0 else []
        words += ["red to the left"] if self.red < 0 else []
        words += {
            "plain blue": ["blue not halved"],
            "two channels": ["blue computed from red and green"],
            "srgb": ["saved with the sRGB curve"],
            "vectors": ["vectors as they are"],
        }.get(self.encoding, [])
        return ", ".join(words)


@dataclass(frozen=True)
class NormalMap:
    """(3, H, W) float64 unit ``normals``, +x right, +y up, +z to the viewer, where ``mask`` (1, H, W) is over 0.

    ``told`` says whether the map itself shows its convention (else it was assumed).
    """

    normals: Normals
    mask: Mask
    convention: Convention
    told: bool

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.normals.shape[-1], self.normals.shape[-2]


def read_normal_map(path: str | Path, *, green: Green = "auto", space: Space = "auto") -> NormalMap:
    """Read a normal map and find out what its colours mean.

    Args:
        path: any picture; transparent, black and (in a map with a plain background) grey pixels are not of the object.
        green: opengl or directx holds against a map that does not show it; a map that shows the other is an error.
        space: tangent (blue must point out of the surface) or camera (blue may point into the picture).
    Raises:
        PictureError: no normal map, one of world space, or one that contradicts what was asked for.
    """
    path = Path(path)
    picture = read_picture(path, colors=False)
    vectors, mask, encoding = _decoded(path, picture)
    inside = mask > 0.5
    if inside.sum() < 16:
        raise PictureError(f"{path}: expected a normal map, got one with {int(inside.sum())} pixels that hold a normal")
    found, told = _axes(path, vectors, inside, space)
    found = replace(found, encoding=encoding)
    if green != "auto" and green != found.green:
        if told:
            raise PictureError(
                f"{path}: expected {Convention(green)}, but its silhouette or its relief shows {Convention(found.green)}; "
                f"leave --green out or give --green {found.green}"
            )
        found = replace(found, green=green)
    normals = vectors * np.array(found.flips, dtype=np.float64)
    normals[~inside] = (0.0, 0.0, 1.0)
    # What faces away by a hair, at a silhouette, is brought to it.
    behind = normals[..., 2] < 0.0
    normals[..., 2] = np.where(behind, 0.0, normals[..., 2])
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    return NormalMap(
        torch.from_numpy(np.ascontiguousarray(np.moveaxis(normals, -1, 0))), torch.from_numpy(mask[None].astype(np.float32)), found, told
    )


def _decoded(path: Path, picture: Picture) -> tuple[Array, Array, str]:
    """Unit vectors with the map's own signs (H, W, 3), the object (H, W) in [0, 1], and the name of the encoding."""
    rgb = picture.rgb.astype(np.float64)
    mask = np.ones(rgb.shape[:2]) if picture.alpha is None else picture.alpha.astype(np.float64)
    if picture.scene_linear and rgb.min() < -0.01:
        candidates = {"vectors": rgb}
        mask = mask * (np.linalg.norm(rgb, axis=-1) > 0.1)
    else:
        mask = mask * _foreground(rgb, mask)
        signed = 2.0 * rgb - 1.0
        # 8-bit maps store 128 of 255 for zero.
        signed = np.where(np.abs(signed) < 0.51 / 127.5, 0.0, signed)
        candidates = {"unit": signed}
        inside = mask > 0.5
        if inside.any():
            blue = rgb[..., 2][inside]
            flat = np.clip(1.0 - np.square(signed[..., :2]).sum(-1), 0.0, None)
            if np.ptp(blue) < 2.5 / 255 and (blue.mean() < 0.01 or np.ptp(rgb[..., :2][inside]) > 0.05):
                candidates = {"two channels": np.concatenate([signed[..., :2], np.sqrt(flat)[..., None]], axis=-1)}
            candidates["plain blue"] = np.concatenate([signed[..., :2], rgb[..., 2:]], axis=-1)
            candidates["srgb"] = 2.0 * np.asarray(srgb_decode(rgb)) - 1.0
    inside = mask > 0.5
    errors = {
        name: float(np.quantile(np.abs(np.linalg.norm(found[inside], axis=-1) - 1.0), 0.75)) if inside.any() else 1.0
        for name, found in candidates.items()
    }
    # The usual reading unless another fits clearly better.
    usual = next(iter(errors))
    fitting = [name for name, off in errors.items() if off <= (LONG if name == usual else UNUSUAL_LONG)]
    if not fitting:
        raise PictureError(
            f"{path}: expected a normal map, whose colours are unit vectors, but the length of many is off by {errors[usual]:.2f}"
        )
    best = min(fitting, key=lambda name: (errors[name] + (0.0 if name == usual else 0.02), name))
    found = candidates[best]
    return found / np.maximum(np.linalg.norm(found, axis=-1, keepdims=True), 1e-9), mask, best


def _foreground(rgb: Array, alpha: Array) -> NDArray[np.bool_]:
    """Not black, not white, and not the mid-grey that stands for the zero vector."""
    signed = 2.0 * rgb - 1.0
    background: NDArray[np.bool_] = (rgb.max(-1) < 0.02) | (rgb.min(-1) > 0.98) | (np.abs(signed).max(-1) < 0.03)
    return ~background & (alpha > 0.0)


def _axes(path: Path, vectors: Array, inside: NDArray[np.bool_], space: Space) -> tuple[Convention, bool]:
    """The convention that the vectors show, and whether they show which way green points."""
    z = vectors[..., 2][inside]
    away = float((z < -0.05).mean())
    depth = -1 if away > 0.5 else 1
    if space == "tangent" and depth < 0:
        raise PictureError(f"{path}: expected a tangent-space map, whose blue points out of the surface, but it points in; camera space?")
    wrong = away if depth > 0 else float((z > 0.05).mean())
    if wrong > 0.03:
        raise PictureError(
            f"{path}: {wrong:.0%} of its normals face away from the viewer: a map of world or object space; "
            "expected tangent or camera space, so turn it with the camera's rotation first"
        )
    outward, strength = _silhouette(vectors, inside)
    signs = [1, 1]
    told = strength > 0
    if told:
        signs = [-1 if outward[k] < -SURE else 1 for k in range(2)]
        told = abs(outward[1]) > SURE
    if not told:
        ours, other = _curl(vectors, inside, depth), _curl(vectors * np.array([1.0, -1.0, 1.0]), inside, depth)
        told = max(ours, other) > 1e-4 and max(ours, other) > CURL * min(ours, other)
        # Turning red and green both round leaves the curl as it is; red is taken to point right.
        signs = [1, -1 if told and other < ours else 1]
    return Convention("opengl" if signs[1] > 0 else "directx", depth, signs[0]), told


def _silhouette(vectors: Array, inside: NDArray[np.bool_]) -> tuple[tuple[float, float], int]:
    """How well red follows the outward direction to the right, and green up, in [-1, 1], and at how many pixels that was seen.

    Only where the normals lie in the picture's plane: an object that the frame or an occluder cuts shows nothing there.
    """
    solid = inside.astype(np.float64)
    down, right = (np.asarray(part) for part in np.gradient(_smoothed(solid)))
    steep: Array = np.asarray(np.hypot(right, down))
    edge: NDArray[np.bool_] = inside & (steep > 0.5 * steep.max(initial=0.0)) & (np.abs(vectors[..., 2]) < 0.6) & (steep > 1e-3)
    edge[:2], edge[-2:], edge[:, :2], edge[:, -2:] = False, False, False, False
    count = int(edge.sum())
    if count < 12:
        return (0.0, 0.0), 0
    # The mask falls outward; rows run down, green up.
    out = np.stack([-right[edge], down[edge]], axis=-1) / steep[edge][:, None]
    normals: Array = vectors[edge, :2]
    power = np.maximum(np.sqrt(np.square(out).sum(0) * np.square(normals).sum(0)), 1e-9)
    right_, up = ((out * normals).sum(0) / power).tolist()
    return (right_, up), count


def _smoothed(plane: Array, times: int = 3) -> Array:
    for _ in range(times):
        padded = np.pad(plane, 1, mode="edge")
        rows = padded[:-2] + 2.0 * padded[1:-1] + padded[2:]
        plane = (rows[:, :-2] + 2.0 * rows[:, 1:-1] + rows[:, 2:]) / 16.0
    return plane


def _curl(vectors: Array, inside: NDArray[np.bool_], depth: int) -> float:
    """Mean curl of the surface's slopes, where it is not steep."""
    z = np.maximum(vectors[..., 2] * depth, 1e-3)
    across, up = -vectors[..., 0] / z, -vectors[..., 1] / z
    # d across / d y - d up / d x, with y up and rows down.
    curl = -np.gradient(_smoothed(across, 1), axis=0) - np.gradient(_smoothed(up, 1), axis=1)
    gentle = inside & (z > 0.4)
    core = gentle[2:-2, 2:-2] & gentle[:-4, 2:-2] & gentle[4:, 2:-2] & gentle[2:-2, :-4] & gentle[2:-2, 4:]
    return float(np.abs(curl[2:-2, 2:-2][core]).mean()) if core.any() else 0.0


def check_size(found: NormalMap, path: str | Path, width: int, height: int, of: str | Path) -> None:
    """Raises PictureError where the map is not of the photo's size."""
    if found.size != (width, height):
        raise PictureError(f"{path}: expected a normal map of the size of {of}, {width} x {height}, got {found.size[0]} x {found.size[1]}")
