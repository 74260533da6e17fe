"""From a decoded picture of one node to a parametric leaf: the best entry of the dictionary, then a second-order fit.

A decoded picture is a little coloured and a little blurred, whatever its leaf is; the fit of the whole tree mends that later.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch

from unshade.atoms import dictionary_of
from unshade.fit.least_squares import COARSE_SOFTNESS, fit_pixels
from unshade.fit.pixels import Pixels
from unshade.nodes import KINDS, Leaf, Role, leaf
from unshade.types import Image, Mask

SIZE = 40
"""Decoded pictures are compared at this size."""

FAMILIES = {
    "diffuse": ("shades",),
    "toon_diffuse": ("plain_shades", "shades"),
    "highlight": ("lights",),
    "toon_highlight": ("spots",),
    "rim": ("rims",),
    "environment": ("environments",),
    "mask": ("plain_masks", "masks"),
}
"""Where the dictionary keeps entries of a type."""

STARTS = 3
"""Entries that are fitted."""

STEPS = 15

LIGHTS = 4
"""Most lights of an environment leaf."""

WORTH = 0.75
"""One more light must lower the squared error of an environment to this share."""


def pixels_of(image: Image) -> Pixels:
    """The pixels of a decoded picture (3, S, S) that are compared."""
    return Pixels.of(image, None, SIZE)


def leaf_of(kind: str, image: Image) -> Leaf:
    """The leaf of a type that looks most like a picture.

    Args:
        kind: one of `synthesis.TYPES`, ``operator`` aside; an environment comes as a few lights.
        image: (3, S, S) in [0, 1].
    """
    pixels = pixels_of(image)
    mean = (pixels.target * pixels.weight).sum(1).clamp(0.0, 1.0)
    if kind == "albedo":
        return leaf("albedo", color=mean.tolist())
    if kind == "environment":
        return _environment(pixels)
    return _best(pixels, list(_nearest(pixels, kind)))


def mask_of(mask: Mask, weight: torch.Tensor | None = None) -> Leaf:
    """The threshold or stripe that is most like a mask (1, S, S).

    Args:
        weight: (1, S, S), how much it shows where the mask is; None is everywhere alike.
    """
    pixels = pixels_of(mask.expand(3, -1, -1))
    if weight is not None:
        # A little everywhere, so that a mask between two like children is still placed.
        shown = pixels_of(weight.expand(3, -1, -1)).target[0]
        counts = pixels.weight * (shown + 0.05 * shown.amax() + 1e-6)
        pixels = Pixels(pixels.normals, pixels.target, counts / counts.sum())
    return _best(pixels, list(_nearest(pixels, "mask")))


def _best(pixels: Pixels, starts: list[Leaf]) -> Leaf:
    fitted = [fit_pixels(pixels, start, steps=STEPS, tolerance=1e-3, softest=COARSE_SOFTNESS) for start in starts]
    found = min(fitted, key=lambda fit: fit.error).root
    assert isinstance(found, Leaf)
    return found


def _nearest(pixels: Pixels, kind: str) -> Iterator[Leaf]:
    """The entries of a kind nearest to the picture in grey, each with its best strength or ambient, nearest first."""
    dictionary = dictionary_of(pixels)
    grey = pixels.target.mean(0)
    scored: list[tuple[float, Leaf]] = []
    for family in FAMILIES[kind]:
        atoms = dictionary[family]
        picture, weight = atoms.pictures, pixels.weight
        if kind in ("diffuse", "toon_diffuse"):
            # grey = 1 - (1 - ambient) (1 - picture)
            down = 1.0 - picture
            share = ((down * (1.0 - grey)) @ weight / (down.square() @ weight).clamp(min=1e-9)).clamp(0.0, 1.0)
            shown = 1.0 - share[:, None] * down
        elif kind in ("highlight", "toon_highlight"):
            share = ((picture * grey) @ weight / (atoms.squares @ weight).clamp(min=1e-9)).clamp(0.02, 1.0)
            shown = share[:, None] * picture
        else:
            share, shown = torch.ones(len(picture)), picture
        error = (shown - grey).square() @ weight
        fits = torch.tensor([kind == "mask" or entry.kind == kind for entry in atoms.leaves])
        error = error.masked_fill(~fits, torch.inf)
        for k in torch.topk(error, min(STARTS, int(fits.sum())), largest=False).indices.tolist():
            scored.append((float(error[k]), _strengthened(atoms.leaves[k], float(share[k]))))
    for _, entry in sorted(scored, key=lambda pair: pair[0])[:STARTS]:
        yield entry


def _strengthened(entry: Leaf, share: float) -> Leaf:
    kind = KINDS[entry.kind]
    if kind.role is Role.DIFFUSE:
        return entry.set(ambient=1.0 - share)
    return entry.set(**{kind.amplitude: share}) if kind.amplitude else entry


def _environment(pixels: Pixels) -> Leaf:
    """Lights one after the other, where each lowers the error most, until one is not worth its values."""
    atoms = dictionary_of(pixels)["environments"]
    found: Leaf | None = None
    error = float("inf")
    for _ in range(LIGHTS):
        shown = torch.zeros_like(pixels.target) if found is None else _shown(found, pixels)
        residual = pixels.target - shown
        up = (pixels.weight * residual) @ atoms.pictures.T
        down = atoms.squares @ pixels.weight
        color = (up / down.clamp(min=1e-9)).clamp(0.0, 1.0)
        saved = (2.0 * color * up - color.square() * down).sum(0)
        best = int(saved.argmax())
        light = atoms.leaves[best].set(color=color[:, best].tolist())
        start = light if found is None else Leaf(light.kind, tuple(a + b for a, b in zip(found.values, light.values, strict=True)))  # type: ignore[operator]
        fitted = fit_pixels(pixels, start, steps=STEPS, tolerance=1e-3)
        if fitted.error > WORTH * error:
            break
        assert isinstance(fitted.root, Leaf)
        found, error = fitted.root, fitted.error
    assert found is not None
    return found


def _shown(node: Leaf, pixels: Pixels) -> torch.Tensor:
    """A leaf at the pixels, (3, N)."""
    kind = KINDS[node.kind]
    arguments = [
        torch.tensor(value, dtype=pixels.normals.dtype).view(-1, parameter.size)
        for value, parameter in zip(node.values, kind.parameters, strict=True)
    ]
    return kind.formula(pixels.normals[:, None], *arguments)[:, 0]
