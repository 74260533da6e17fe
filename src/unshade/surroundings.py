"""Put a tree under a new environment: a lat-long picture lights it, and its paint stays.

The environment gives the tree three things. Its form becomes what the environment sheds on a matt white sphere, fitted by a
few broad coloured lights, so that the result can still be edited and turned. Its highlights and reflections become a
reflection of the environment (an `environment_map`): of a tree with highlights as blurred as they were wide, as bright as they
were, and only of what stands out; of a tree with an environment sharp and whole, on the average as bright. Its
rim turns to where the environment is brightest. Brightness is kept: the new form is on the average as bright as the old one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image as PILImage

from unshade.color_profiles import srgb_decode
from unshade.components import WHITE, Component, Part, join, leaves_below
from unshade.edit import component, mix
from unshade.errors import PictureError
from unshade.fit.least_squares import fit_pixels
from unshade.fit.pixels import Pixels
from unshade.nodes import Leaf, Node, Operator, Raster, Role, Tree, find, leaf
from unshade.picture_files import read_picture
from unshade.relight import lit_leaves, turn, turn_between
from unshade.render import render, srgb_encode
from unshade.render import srgb_decode as decode
from unshade.sphere import disc_mask, sphere_normals
from unshade.turntable import directions
from unshade.types import Image

HEIGHT = 64
"""Rows to which an environment is averaged: what lights a sphere, and mirrors on it, needs no more."""

GLOSSY_HEIGHT = 32
"""Rows of the reflection of a highlight's width."""

SIZE = 64
"""Pixels of the spheres whose brightness is compared."""

FORM_HEIGHT = 16
"""Rows of directions that the form is fitted at; light on a matt surface changes slowly."""


SURROUND = 0.8
"""Share of all directions that a highlight stands out from."""


@dataclass(frozen=True)
class Surroundings:
    """An environment: scene-linear light from everywhere, (3, HEIGHT, 2 HEIGHT), +y up and +z (behind the viewer) at the centre."""

    light: Image

    @staticmethod
    def read(path: str | Path) -> Surroundings:
        """Read a lat-long picture, twice as wide as high; HDR, EXR, or any other, whose colours are decoded.

        Raises PictureError, MissingExtraError.
        """
        picture = read_picture(path)
        if not 1.9 <= picture.width / picture.height <= 2.1:
            raise PictureError(f"{path}: expected a lat-long environment, twice as wide as high, got {picture.width} x {picture.height}")
        linear = picture.rgb if picture.scene_linear else np.asarray(srgb_decode(picture.rgb.astype(np.float64)))
        if float(linear.max()) <= 0.0:
            raise PictureError(f"{path}: this environment is black, so nothing would be seen in it")
        method = PILImage.Resampling.BOX if picture.height >= HEIGHT else PILImage.Resampling.BILINEAR
        planes = [
            np.asarray(PILImage.fromarray(np.ascontiguousarray(linear[..., k], dtype=np.float32)).resize((2 * HEIGHT, HEIGHT), method))
            for k in range(3)
        ]
        return Surroundings(torch.from_numpy(np.stack(planes).astype(np.float32)))

    @property
    def display(self) -> Image:
        """The environment as a picture to look at, (3, HEIGHT, 2 HEIGHT) in [0, 1], bright lights clipped."""
        mean = float(self.light.mean())
        return srgb_encode((self.light * (0.25 / max(mean, 1e-12))).clamp(0.0, 1.0))

    @property
    def raster(self) -> Raster:
        """`display` as a tree stores it."""
        return Raster.from_array(self.display)

    def shed(self, normals: torch.Tensor) -> Image:
        """Light on a matt white surface, (3, H, W) scene-linear, for (3, H, W) normals."""
        weights, sky = _solid_angles(HEIGHT), directions(HEIGHT).reshape(3, -1)
        cosines = torch.einsum("chw,cd->hwd", normals, sky).clamp(min=0.0) * (weights / math.pi)
        return torch.einsum("hwd,cd->chw", cosines, self.light.reshape(3, -1))

    def blurred(self, sharpness: float, height: int) -> Image:
        """The light as a surface mirrors it that spreads every point to ``exp(-sharpness |d - d'|^2)``, (3, height, 2 height)."""
        weights, sky = _solid_angles(HEIGHT), directions(HEIGHT).reshape(3, -1)
        lobes = torch.exp(-2.0 * sharpness * (1.0 - torch.einsum("chw,cd->hwd", directions(height), sky))) * weights
        return torch.einsum("hwd,cd->chw", lobes / lobes.sum(-1, keepdim=True).clamp(min=1e-12), self.light.reshape(3, -1))

    @property
    def brightest(self) -> tuple[float, ...]:
        """The direction that most light comes from."""
        soft = self.blurred(8.0, GLOSSY_HEIGHT).sum(0).flatten()
        return tuple(directions(GLOSSY_HEIGHT).reshape(3, -1)[:, int(soft.argmax())].tolist())


def _solid_angles(height: int) -> torch.Tensor:
    """(height * 2 height,) steradians of the pixels of a lat-long picture."""
    latitude = (0.5 - (torch.arange(height) + 0.5) / height) * math.pi
    return (latitude.cos() * (math.pi / height) ** 2)[:, None].expand(height, 2 * height).flatten()


def under(tree: Tree, surroundings: Surroundings, exposure: float = 1.0) -> Tree:
    """The tree in an environment.

    Args:
        exposure: times as bright as the tree was.
    """
    linear = tree.blend_space == "linear"
    form = _form(tree, surroundings, exposure, linear)
    layers: list[Node] = [Operator("multiply", (WHITE, form))]
    reflection = _reflection(tree, surroundings, exposure, linear)
    layers += [reflection] if reflection is not None else []
    source = Tree(join("screen", layers), tree.blend_space)
    lit = mix(tree, source, (Component.DIFFUSE, Component.HIGHLIGHTS, Component.ENVIRONMENT))
    rims = [address for address, leaf_ in lit_leaves(lit.root).items() if leaf_.role is Role.RIM]
    for address in rims:
        lit = turn(lit, turn_between(find(lit.root, address)["direction"], surroundings.brightest), [address])  # type: ignore[index]
    return lit


def _form(tree: Tree, surroundings: Surroundings, exposure: float, linear: bool) -> Node:
    """Broad lights fitted to what the environment sheds on a matt sphere that is as bright as the old form."""
    normals, inside = sphere_normals(SIZE), disc_mask(SIZE)
    old = component(tree, Component.DIFFUSE)
    shown = render(old, normals) if old is not None else torch.full((3, SIZE, SIZE), 0.7)
    wanted = float((shown if linear else decode(shown))[:, inside[0]].mean()) * exposure
    seen = surroundings.shed(normals)[:, inside[0]]
    scale = wanted / max(float(seen.mean()), 1e-12)
    for _ in range(20):  # what is clipped has to be made up for
        scale *= wanted / max(float((seen * scale).clamp(max=1.0).mean()), 1e-12)
    # Fitted to the side away from the viewer as well, so that the form is right when it is turned.
    shed = (surroundings.shed(directions(FORM_HEIGHT)) * scale).clamp(0.0, 1.0)
    target = (shed if linear else srgb_encode(shed)).reshape(3, -1)
    weight = _solid_angles(FORM_HEIGHT)
    pixels = Pixels(directions(FORM_HEIGHT).reshape(3, -1), target, weight / weight.sum())
    lights: list[Node] = [Leaf("albedo", (tuple((0.5 * target.amin(-1)).tolist()),))]
    color = target.mean(-1).mul(0.4).tolist()
    best = surroundings.brightest
    for direction in (
        best,
        (0.0, 1.0, 0.0),
        (0.0, -1.0, 0.0),
        (-best[0], 0.1, -best[2]),
        (best[2], 0.1, -best[0]),
        (-best[2], 0.1, best[0]),
    ):
        lights.append(Operator("multiply", (leaf("albedo", color=color), leaf("highlight", direction=direction, sharpness=0.5))))
    return fit_pixels(pixels, Operator("screen", tuple(lights)), steps=60).root


def _reflection(tree: Tree, surroundings: Surroundings, exposure: float, linear: bool) -> Node | None:
    """The environment as the old highlights and reflections would mirror it; None for a matt tree."""
    normals, inside = sphere_normals(SIZE), disc_mask(SIZE)[0]
    old = component(tree, Component.ENVIRONMENT)
    if old is not None:
        shown = render(old, normals)[:, inside]
        mirrored = surroundings.light
        scale = float((shown if linear else decode(shown)).mean()) / max(float(mirrored.mean()), 1e-12)
    else:
        old = component(tree, Component.HIGHLIGHTS)
        if old is None:
            return None
        widths = sorted(_sharpness(spot) for _, spot in leaves_below(Part("", old)) if spot.role is Role.HIGHLIGHT)
        # A light of the mirrored world moves twice as fast as the normal that mirrors it.
        mirrored = surroundings.blurred(widths[len(widths) // 2] / 4.0, GLOSSY_HEIGHT)
        mirrored = _standing_out(mirrored)
        shown = render(old, normals)[:, inside]
        peak = shown if linear else decode(shown)
        scale = float(peak.amax()) / max(float(mirrored.amax()), 1e-12)
    light = (mirrored * scale * exposure).clamp(0.0, 1.0)
    return leaf("environment_map", pixels=Raster.from_array(light if linear else srgb_encode(light)))


def _standing_out(light: Image) -> Image:
    """What a highlight is of a reflection (3, H, 2 H): the light over that of `SURROUND` of the directions, in its own colour.

    What is mirrored around a highlight is no part of it; paint and form hold it already.
    """
    brightness = light.mean(0)
    order = brightness.flatten().argsort()
    below = _solid_angles(light.shape[1])[order].cumsum(0)
    floor = brightness.flatten()[order[int((below < SURROUND * float(below[-1])).sum())]]
    return light * ((brightness - floor).clamp(min=0.0) / brightness.clamp(min=1e-12))


def _sharpness(spot: Leaf) -> float:
    if spot.kind == "highlight":
        return float(spot["sharpness"][0])
    return 1.0 / max(float(spot["radius"][0]), 0.02) ** 2
