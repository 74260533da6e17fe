"""MatCaps as pictures: any size, continued past the silhouette so that no look-up meets a background.

A MatCap is looked up by ``n.xy``: the disc touches the sides of the picture, or leaves ``padding`` pixels on each. Past
the disc every pixel has the normal of the nearest point of the silhouette.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from unshade.errors import MissingExtraError, UnshadeError
from unshade.nodes import Node, Tree
from unshade.picture_output import write_picture
from unshade.render import part, render, srgb_decode
from unshade.sphere import normals_from_xy, sphere_grid
from unshade.types import Image

BLENDER_PADDING = 0.004
"""Of the size: Blender looks a MatCap up at ``0.5 + 0.496 n.xy``, so that this share of the picture is left on each side."""

BAND_PIXELS = 2**18
"""A large picture is rendered in bands of rows of about this many pixels; all at once it takes many times its size."""


def padded(tree: Tree | Node, size: int, padding: float = 0) -> Image:
    """(3, size, size) display-encoded picture of the sphere and what continues it.

    Raises UnshadeError where the padding leaves no sphere.
    """
    if 2 * padding >= size:
        raise UnshadeError(f"expected a padding under half the size, got {padding} of {size}")
    grid = sphere_grid(size) * (size / (size - 2 * padding))
    bands = [render(tree, normals_from_xy(band)) for band in grid.split(max(1, BAND_PIXELS // size), dim=1)]
    return torch.cat(bands, dim=1)


def write_png(tree: Tree, path: Path, size: int = 512, bits: int | str = 8, padding: int = 0) -> None:
    """A PNG of 8 or 16 bits."""
    write_picture(path, padded(tree, size, padding), bits=int(bits))


def write_exr(tree: Tree, path: Path, size: int = 512, padding: int = 0) -> None:
    """An EXR of linear light, half floats, divided by the exposure that the tree was made with. Raises MissingExtraError."""
    write_picture(path, padded(tree, size, padding), exposure=tree.exposure)


def write_blender_matcap(tree: Tree, path: Path, size: int = 512, padding: float | None = None) -> None:
    """An EXR with the layers ``diffuse`` and ``specular``, which Blender's MatCap adds in linear light.

    A tree screens its lights over its form instead. So ``specular`` is what the lights add to the light of the whole picture,
    ``decode(all) - decode(form)``, and the sum is the tree's picture; it is never negative, since no operator darkens where an
    input brightens. The padding is the one that Blender expects unless it is given. Raises MissingExtraError.
    """
    padding = BLENDER_PADDING * size if padding is None else padding
    try:
        import OpenEXR
    except ImportError:
        raise MissingExtraError(f"{path}: EXR files need the OpenEXR library; install it with: pip install 'unshade[exr]'") from None
    form = padded(dataclasses.replace(tree, root=part(tree.root, "diffuse")), size, padding)
    diffuse, whole = (srgb_decode(shown.double().clamp(0.0, 1.0)) / tree.exposure for shown in (form, padded(tree, size, padding)))
    layers = {"diffuse": diffuse, "specular": (whole - diffuse).clamp(min=0.0)}
    opaque = torch.ones_like(diffuse[0])
    channels = {
        f"{name}.{letter}": plane.half().numpy()
        for name, light in layers.items()
        for letter, plane in zip("RGBA", (*light, opaque), strict=True)
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
