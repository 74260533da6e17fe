"""The files of one result."""

from __future__ import annotations

import hashlib
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import torch

from unshade import drawing, metrics, report
from unshade.errors import OutputError
from unshade.nodes import Tree
from unshade.pictures import SphereImage, write_picture
from unshade.render import render
from unshade.serde import dump
from unshade.sphere import disc_mask, normals_from_xy, sphere_grid, sphere_normals
from unshade.staging import TREE_FILE, staged

if TYPE_CHECKING:
    from unshade.decompose import Result

Figures: TypeAlias = "dict[str, Any]"

DIFFERENCE_GAIN = 4.0
"""``difference.png`` shows the absolute difference this many times brighter."""

LONGEST_NAME = 120
"""Letters of an address that stand in a file's name; file systems take 255 at most, and Windows 260 for the whole path."""

BAND_PIXELS = 1 << 20
"""Pixels that `write_render` shades at once."""


def figures(result: Result, sphere: SphereImage, perceptual: bool) -> Figures:
    """How good a result is and how large: PSNR, SSIM and ST-LPIPS (None unless ``perceptual``), values, leaves and seed.

    Raises:
        MissingExtraError: ``perceptual`` without its weight file.
    """
    size = sphere.image.shape[-1]
    rendered = render(result.tree, sphere_normals(size))
    return {
        "psnr": _finite(metrics.psnr(rendered, sphere.image, sphere.valid)),
        "ssim": _finite(metrics.ssim(rendered, sphere.image, sphere.valid)),
        "st_lpips": _finite(metrics.st_lpips(rendered, sphere.image, mask=sphere.valid)) if perceptual else None,
        "values": result.tree.values,
        "leaves": result.tree.leaves,
        "seed": result.seed,
    }


def _finite(number: float) -> float | None:
    """JSON knows no infinity: a perfect PSNR becomes 200 dB, which float32 cannot reach otherwise."""
    return None if math.isnan(number) else min(float(number), 200.0)


def write(result: Result, sphere: SphereImage, folder: Path, which: str, source_name: str, shown: Figures) -> Path | None:
    """Write what ``which`` asks for and return the path of the tree, or None where nothing is written.

    Args:
        result: what to write.
        sphere: the picture that it explains.
        folder: where; made when missing. Other files in it are left alone.
        which: ``none``, ``tree`` (only ``tree.json``) or ``all``.
        source_name: what the report calls the picture.
        shown: the figures in the report.
    Raises:
        OutputError: the folder cannot be written.
    """
    if which == "none":
        return None
    with staged(folder) as staging:
        dump(result.family, staging / TREE_FILE)
        if which == "all":
            with ThreadPoolExecutor(1) as beside:  # encoders let go of the interpreter, so both go on at once
                pictures = beside.submit(_write_pictures, result, sphere, staging)
                (staging / "tree.svg").write_text(drawing.tree_svg(result.tree), encoding="utf-8")
                (staging / "report.html").write_text(report.report_html(result, sphere, source_name, shown), encoding="utf-8")
                pictures.result()
    return folder / TREE_FILE


def _write_pictures(result: Result, sphere: SphereImage, staging: Path) -> None:
    size = sphere.image.shape[-1]
    normals, alpha = sphere_normals(size), disc_alpha(size)
    rendered = render(result.tree, normals)
    write_picture(staging / "render.png", rendered, alpha)
    difference = (rendered - sphere.image).abs() * DIFFERENCE_GAIN * (sphere.valid & disc_mask(size))
    write_picture(staging / "difference.png", difference.clamp(max=1.0))
    (staging / "layers").mkdir()
    for address, layer in drawing.layers(result.tree, size).items():
        write_picture(staging / "layers" / f"{layer_name(address)}.png", layer, alpha)
    (staging / "family").mkdir()
    for member in result.family.members:
        write_picture(staging / "family" / f"{member.values:04d}.png", render(member.tree, normals), alpha)
    if result.family.alternatives:
        (staging / "alternatives").mkdir()
    for number, member in enumerate(result.family.alternatives, start=1):
        write_picture(staging / "alternatives" / f"{number}.png", render(member.tree, normals), alpha)


def layer_name(address: str) -> str:
    """What a node's picture is called: its address, or a digest and the end of one that no file system would take."""
    if len(address) <= LONGEST_NAME:
        return address
    return f"{hashlib.sha256(address.encode()).hexdigest()[:8]}...{address[-LONGEST_NAME:]}"


def disc_alpha(size: int) -> torch.Tensor:
    """(1, size, size) opacity of the sphere in [0, 1], its edge one pixel wide."""
    radius = sphere_grid(size).square().sum(0, keepdim=True).sqrt()
    return ((1.0 - radius) * (size / 2.0) + 0.5).clamp(0.0, 1.0)


def write_render(tree: Tree, path: Path, size: int) -> None:
    """Draw a tree as a sphere of ``size`` pixels into a picture file. Raises OutputError."""
    grid = sphere_grid(size)
    # In bands of rows: a large picture would otherwise take many times its size in memory.
    bands = [render(tree, normals_from_xy(band)) for band in grid.split(max(1, BAND_PIXELS // size), dim=1)]
    write_picture(path, torch.cat(bands, dim=1), disc_alpha(size), exposure=tree.exposure)


def write_sample(tree: Tree, folder: Path, name: str, size: int) -> None:
    """Write ``name.json`` and ``name.png``. Raises OutputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made: {error.strerror}") from error
    write_picture(folder / f"{name}.png", render(tree, sphere_normals(size)), disc_alpha(size))
    dump(tree, folder / f"{name}.json")
