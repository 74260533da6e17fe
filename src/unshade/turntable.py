"""A tree under a light that goes round: frames, with the lighting as an inset, as GIF, MP4 or a folder of PNG."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image as PILImage

from unshade.components import Use, uses
from unshade.errors import MissingExtraError, OutputError
from unshade.files import check_place
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, Role, Tree, find
from unshade.picture_output import replacing
from unshade.relight import lit_leaves, relight
from unshade.render import render, srgb_encode
from unshade.shading import environment_map, spot
from unshade.sphere import sphere_grid, sphere_normals
from unshade.staging import check_folder, staged
from unshade.types import Image

INSET_SHARE = 0.34
"""Width of the inset as a share of the frame's; it is half as high as wide."""

FORM_SHARPNESS, RIM_SHARPNESS = 1.5, 1.0
"""How broad diffuse shading and rims are drawn in the picture of the lighting, where they have no width of their own."""

BACKGROUND = 0.12
"""Grey around a sphere."""

AXES = {"vertical": (360.0, 0.0, 0.0), "horizontal": (0.0, 360.0, 0.0), "view": (0.0, 0.0, 360.0)}
"""The axes a light can go round: what a whole turn is in degrees to the right, up and about the viewer."""

MOST_PIXELS = 400_000_000
"""Of all frames of a turntable together, which are held in memory at once."""

VIDEO_SUFFIXES = (".gif", ".mp4")


def directions(height: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """(3, height, 2 height) directions of a lat-long picture: +y up, +z at the centre, +x to the right of it."""
    latitude = (0.5 - (torch.arange(height, dtype=dtype) + 0.5) / height) * math.pi
    longitude = ((torch.arange(2 * height, dtype=dtype) + 0.5) / height - 1.0) * math.pi
    up, along = torch.meshgrid(latitude, longitude, indexing="ij")
    return torch.stack([up.cos() * along.sin(), up.sin(), up.cos() * along.cos()])


def lighting(tree: Tree, height: int = 64) -> Image:
    """Where a tree's light comes from, as a lat-long picture (3, height, 2 height) in [0, 1]: each light a spot of its colour."""
    sky = directions(height)
    picture = torch.zeros(3, height, 2 * height)
    known = uses(tree.root)
    for address, leaf in lit_leaves(tree.root).items():
        if leaf.role is not Role.MASK:
            picture = picture + _tint(tree.root, address, known)[:, None, None] * _glow(leaf, sky)
    picture = picture.clamp(0.0, 1.0)
    return srgb_encode(picture) if tree.blend_space == "linear" else picture


def _tint(root: Node, address: str, known: dict[str, Use]) -> torch.Tensor:
    """The colour of the albedo beside a light."""
    above = address.rpartition(".")[0].rpartition(".")[0]
    parent = find(root, above) if above else None
    color = torch.ones(3)
    if isinstance(parent, Operator) and parent.kind == "multiply":
        for k, child in enumerate(parent.children):
            if isinstance(child, Leaf) and child.kind == "albedo" and known[f"{above}.{k}.albedo"].tint:
                color = color * torch.tensor(child["color"])
    return color


def _glow(leaf: Leaf, sky: torch.Tensor) -> torch.Tensor:
    """One light in the sky, (1 or 3, H, W)."""
    if leaf.kind == "environment_map":
        pixels, rotation = leaf["pixels"], torch.tensor(leaf["rotation"])
        assert isinstance(pixels, Raster)
        # The leaf looks up along the mirror direction; half-way normals make the sky's own directions of it.
        half = torch.nn.functional.normalize(sky + torch.tensor([0.0, 0.0, 1.0 + 1e-6])[:, None, None], dim=0)
        return environment_map(half, pixels.tensor(), rotation)
    names = [parameter.name for parameter in KINDS[leaf.kind].parameters]
    amplitude = KINDS[leaf.kind].amplitude
    strength = torch.tensor([min(leaf[amplitude][0], 1.0) if amplitude else 0.5])
    total = torch.zeros(1, *sky.shape[1:])
    for k in range(leaf.lobes):
        direction = torch.tensor(leaf["direction"][3 * k : 3 * k + 3])
        if "radius" in names:
            sharpness = 1.0 / max(leaf["radius"][0], 0.02) ** 2
        elif "sharpness" in names:
            sharpness = leaf["sharpness"][k]
        else:
            sharpness = RIM_SHARPNESS if leaf.role is Role.RIM else FORM_SHARPNESS
        color = torch.tensor(leaf["color"][3 * k : 3 * k + 3])[:, None, None] if "color" in names else 1.0
        # No narrower than what a small picture can show.
        total = total + color * spot(sky, direction, torch.tensor(min(float(sharpness), 200.0)), strength[:, None, None])
    return total


def framed(picture: Image, inset: Image | None = None) -> Image:
    """A square picture of a sphere on a background, the lighting in the lower left corner.

    Args:
        picture: (3, S, S). inset: (3, H, 2 H) in [0, 1]; fitted.
    """
    size = picture.shape[-1]
    radius = sphere_grid(size).square().sum(0, keepdim=True).sqrt()
    alpha = ((1.0 - radius) * (size / 2.0) + 0.5).clamp(0.0, 1.0)
    frame = picture * alpha + BACKGROUND * (1.0 - alpha)
    if inset is None:
        return frame
    width = max(2 * round(size * INSET_SHARE / 2), 8)
    shown = torch.nn.functional.interpolate(inset[None], (width // 2, width), mode="bilinear", align_corners=False)[0]
    edge = max(1, size // 128)
    bordered = torch.full((3, width // 2 + 2 * edge, width + 2 * edge), 0.75)
    bordered[:, edge:-edge, edge:-edge] = shown
    frame = frame.clone()
    frame[:, size - bordered.shape[1] :, : bordered.shape[2]] = bordered
    return frame


def frame(tree: Tree, size: int, lights: Tree | None = None) -> Image:
    """A tree as a picture (3, size, size), with the lighting of ``lights``, itself or the environment it is in, as an inset."""
    picture = render(tree, sphere_normals(size))
    return framed(picture, lighting(lights, max(size // 4, 16)) if lights is not None else None)


def turntable(tree: Tree, frames: int = 48, size: int = 256, axis: str = "vertical", lights: Tree | None = None) -> Iterator[Image]:
    """The frames of one whole turn of the light, each (3, size, size); the first is the tree as it is.

    Args:
        axis: of `AXES`. lights: what the inset shows, which turns as well; None for no inset.
    Raises:
        OutputError: more pixels than `MOST_PIXELS`.
    """
    if frames * size * size > MOST_PIXELS:
        raise OutputError(
            f"{frames} frames of {size} x {size} are {frames * size * size:,} pixels, {MOST_PIXELS:,} at most; take fewer or smaller"
        )
    return (_turned(tree, [angle * number / frames for angle in AXES[axis]], size, lights) for number in range(frames))


def _turned(tree: Tree, angles: list[float], size: int, lights: Tree | None) -> Image:
    if not any(angles):
        return frame(tree, size, lights)
    return frame(relight(tree, *angles), size, None if lights is None else relight(lights, *angles))


def check_new_folder(folder: Path) -> None:
    """Fail for a folder that cannot be written or that holds files already, among which new ones would be lost. Raises OutputError."""
    check_folder(folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise OutputError(f"{folder}: expected a new or an empty folder, and there are files in this one")


def check_turntable(path: Path) -> None:
    """Fail before other files are written: raises OutputError, MissingExtraError where `write_turntable` would for this name."""
    suffix = path.suffix.lower()
    if suffix and suffix not in VIDEO_SUFFIXES:
        raise OutputError(
            f"{path}: expected a name that ends in {' or '.join(VIDEO_SUFFIXES)}, or a folder's name without a suffix, got {suffix!r}"
        )
    if not suffix:
        check_new_folder(path)
        return
    try:
        check_place(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
    if suffix == ".mp4":
        _encoder(path)


def write_turntable(path: Path, pictures: Iterator[Image], fps: float = 24.0) -> int:
    """Write frames as an animated GIF, an MP4 (both play in a loop or once through), or, without a suffix, a folder of PNG.

    Returns how many there were. Raises OutputError, and MissingExtraError for an MP4 without its library.
    """
    check_turntable(path)
    suffix = path.suffix.lower()
    encoder = _encoder(path) if suffix == ".mp4" else None
    arrays = [(picture.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).permute(1, 2, 0).numpy() for picture in pictures]
    if not suffix:
        with staged(path) as folder:
            for number, array in enumerate(arrays):
                PILImage.fromarray(array).save(folder / f"{number:0{len(str(len(arrays) - 1))}d}.png")
    else:
        with replacing(path) as temporary:
            if encoder is None:
                _write_gif(temporary, arrays, fps)
            else:
                _write_mp4(encoder, temporary, arrays, fps)
    return len(arrays)


def _write_gif(path: Path, arrays: list[NDArray[np.uint8]], fps: float) -> None:
    # One palette for all frames, or colours would flicker; of the colours that occur, each once, or large dark areas would take it.
    several = np.concatenate([array.reshape(-1, 3) for array in arrays[:: max(1, len(arrays) // 12)]])
    colors = np.unique(several & 0xF8, axis=0) | 0x04
    palette = PILImage.fromarray(colors[None]).quantize(255, method=PILImage.Quantize.MEDIANCUT, kmeans=2)
    frames = [PILImage.fromarray(array).quantize(palette=palette, dither=PILImage.Dither.FLOYDSTEINBERG) for array in arrays]
    # A GIF counts in hundredths of a second, and programs play less than two of them slowly.
    duration = max(20, 10 * round(100.0 / fps))
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0, optimize=False, disposal=1)


def _encoder(path: Path) -> str:
    """The ffmpeg that comes with the library."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingExtraError(f"{path}: MP4 needs the imageio-ffmpeg library; install it with: pip install 'unshade[video]'") from None
    try:
        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise MissingExtraError(f"{path}: MP4 needs ffmpeg, which imageio-ffmpeg did not bring ({str(error).splitlines()[0]})") from None


def _write_mp4(encoder: str, path: Path, arrays: list[NDArray[np.uint8]], fps: float) -> None:
    # H.264 in its common form has colour at half resolution, so both sides must be even.
    even = [np.ascontiguousarray(array[: array.shape[0] // 2 * 2, : array.shape[1] // 2 * 2]) for array in arrays]
    height, width = even[0].shape[:2]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    target = ["-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", str(path)]
    done = subprocess.run(
        [encoder, "-y", "-loglevel", "error", *source, *target],
        input=b"".join(array.tobytes() for array in even),
        capture_output=True,
        check=False,
    )
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines() or [f"exit code {done.returncode}"]
        raise OutputError(f"{path}: the video cannot be written ({said[-1]})")
