"""A tree on anything that has normals; and an edit of a tree as an edit of the photo that the tree was made of.

The photo holds what no tree does: texture, dirt, shadows. It is carried over in one of two ways:

- ``residual``: the difference of the photo and the unedited tree is added to the edited one.
- ``ratio``: a texture t lies on the paint and form of the tree, under its lights: ``photo = screen(t * base, lights)``. That is
  affine in t, so a ridge regression per pixel gives ``t = 1 + (photo - tree) g / (g^2 + ridge)`` with ``g = base (1 - lights)``:
  the plain ratio where the base can be seen, 1 where a highlight or darkness hides it. What t does not explain is added.
  A glint that the tree has not would come out as a texture of white on red, and turn with the paint; see `glints`.

Both give the photo back exactly where the trees are one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from unshade.errors import PictureError, TreeError, did_you_mean
from unshade.inflate import inflate
from unshade.nodes import Tree
from unshade.render import part, render
from unshade.types import Image, Mask, Normals
from unshade.vector_art import Shape

RIDGE = 2e-3
MOST_TEXTURE = 6.0
BRIGHT = 1.5
GREY = 3e-3
"""Spread of a base's channels below which it is grey."""

PARTS_AGREE = 1e-3
"""A tree is lights over a base where their screen differs from it by less than this."""

BAND_PIXELS = 1 << 20
Detail = Literal["ratio", "residual"]
DETAILS = ("ratio", "residual")


def shade(tree: Tree, normals: Normals) -> Image:
    """(3, H, W) of a tree at the normals of a picture, in bands of rows so that a large one takes little memory."""
    rows = max(1, BAND_PIXELS // normals.shape[-1])
    return torch.cat([render(tree, band) for band in normals.split(rows, dim=-2)], dim=-2)


def split(tree: Tree, normals: Normals, whole: Image) -> tuple[Image, Image] | None:
    """The base of a tree and the lights over it, whose screen is the tree; None for a tree that is built otherwise."""
    base, lights = (shade(Tree(part(tree.root, which), tree.blend_space, tree.exposure), normals) for which in ("diffuse", "specular"))
    agree = tree.blend_space == "srgb" and float((1.0 - (1.0 - base) * (1.0 - lights) - whole).abs().max()) < PARTS_AGREE
    return (base, lights) if agree else None


def glints(photo: Image, base: Image, lights: Image) -> Image:
    """White light in a photo that the tree has not, (1, H, W) in [0, 1).

    Under the tree's lights a pixel is ``u = light + s * base`` in its three channels (the dichromatic model, Shafer 1985), a line
    whose slope and offset least squares find. It is believed only where the pixel is brighter than the base in every channel: a
    texture may be of any colour. A grey base shows no such line; up to `BRIGHT` times it is texture.
    """
    under = (1.0 - (1.0 - photo) / (1.0 - lights).clamp(min=0.05)).clamp(0.0, 1.0)
    middle, level = base.mean(-3, keepdim=True), under.mean(-3, keepdim=True)
    spread = (base - middle).square().sum(-3, keepdim=True)
    usual = (level / middle.clamp(min=0.02)).clamp(max=BRIGHT)
    slope = (((under - level) * (base - middle)).sum(-3, keepdim=True) + GREY * usual) / (spread + GREY)
    light = (level - slope.clamp(min=0.0) * middle).clamp(min=0.0).minimum(under.amin(-3, keepdim=True))
    brighter = ((under + 0.02) / (base + 0.02)).amin(-3, keepdim=True)
    return (light * ((brighter - 1.05) / 0.3).clamp(0.0, 1.0)).clamp(0.0, 0.98)


def apply_to_photo(edited: Tree, original: Tree, photo: Image, normals: Normals, mask: Mask, detail: Detail = "ratio") -> Image:
    """The photo with the object shaded by the edited tree, its own detail kept.

    Args:
        edited: the tree that is wanted. original: the tree that the photo was explained by.
        photo: (3, H, W) display-encoded in [0, 1]. normals: (3, H, W). mask: (1, H, W) in [0, 1], 1 on the object.
        detail: ``ratio`` or ``residual``.
    Returns:
        (3, H, W) in [0, 1]; the photo itself outside the mask.
    Raises:
        PictureError: sizes that differ. TreeError: an unknown detail, or trees of two blend spaces.
    """
    if detail not in DETAILS:
        raise TreeError(f"detail must be ratio or residual, got {detail!r}{did_you_mean(detail, DETAILS)}")
    if edited.blend_space != original.blend_space:
        raise TreeError(f"both trees must blend in one space, got {edited.blend_space} and {original.blend_space}")
    if photo.shape != normals.shape or mask.shape[-2:] != photo.shape[-2:]:
        sizes = [f"{image.shape[-1]} x {image.shape[-2]}" for image in (photo, normals, mask)]
        raise PictureError(f"expected a photo, normals and a mask of one size, got {', '.join(sizes)}")
    before, after = shade(original, normals), shade(edited, normals)
    if detail == "residual":
        result = after + (photo - before)
    else:
        parts = split(original, normals, before), split(edited, normals, after)
        black = torch.zeros_like(before)
        (base, lights), (new_base, new_lights) = parts if None not in parts else ((before, black), (after, black))  # type: ignore[misc]
        glint = glints(photo, base, lights)
        lights, new_lights = (1.0 - (1.0 - part) * (1.0 - glint) for part in (lights, new_lights))
        before, gain = 1.0 - (1.0 - base) * (1.0 - lights), base * (1.0 - lights)
        texture = (1.0 + (photo - before) * gain / (gain.square() + RIDGE)).clamp(0.0, MOST_TEXTURE)
        explained = 1.0 - (1.0 - texture * base) * (1.0 - lights)
        result = 1.0 - (1.0 - texture * new_base) * (1.0 - new_lights) + (photo - explained)
    return (photo + mask.to(photo) * (result - photo)).clamp(0.0, 1.0)


def shade_shape(edited: Tree, original: Tree | None, shape: Shape, detail: Detail = "ratio") -> Shape:
    """A shape of a drawing shaded by a tree; with the original tree, its own detail stays as in `apply_to_photo`."""
    alpha = torch.from_numpy(shape.alpha)[None]
    normals = inflate(shape.alpha)
    if original is None:
        shaded = shade(edited, normals)
    else:
        photo = torch.from_numpy(np.ascontiguousarray(np.moveaxis(shape.rgb, -1, 0)))
        shaded = apply_to_photo(edited, original, photo, normals, (alpha > 0.0).to(photo), detail)
    return replace(shape, rgb=np.moveaxis(shaded.numpy(), 0, -1))
