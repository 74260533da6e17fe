"""A reflected environment as a picture: a tree of what is beneath, and a lat-long raster of all that it reflects.

A network (`models.reflection`) guesses the picture beneath. Its paints end where the picture has edges (`circles`), its lights are
those of the guess and of a tree that was found before; all are fitted to how the picture bends (`separation`), and what is left of
the picture then is the environment. Made for pictures of the released grammar: white highlights, one form, two masks at most.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from functools import lru_cache, partial
from itertools import permutations
from pathlib import Path
from typing import cast

import torch
import torch.nn.functional as F

from unshade.atoms import dictionary_of, directions
from unshade.circles import edge_circles, edges_left, masks_of
from unshade.fit.least_squares import COARSE_SIZE, fit_pixels
from unshade.fit.pixels import Pixels
from unshade.growth import Candidate, Effort, Growth, Samples
from unshade.models import weights
from unshade.models.reflection import ReflectionNet
from unshade.moves import add_light
from unshade.node_image import node_image
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, leaf, walk
from unshade.pictures import SphereImage
from unshade.pixel_sets import grain
from unshade.render import render
from unshade.separation import LIMITS, SIDES, Separation
from unshade.sphere import disc_mask, sphere_normals
from unshade.types import Image, Mask

SHOWS = 0.03
"""Mean brightness of the environment, as the network takes it, from which on one is looked for."""

GRAIN = 6.0
"""Most grain of a picture (`pixel_sets.grain`): a sharp reflection has up to 5, a noisy photograph more."""

KNOWN = 200
"""Least pixels that are known and not white."""

DRAWN, BRIGHT = 0.5, 0.2
"""Share of the jumps of a picture's edges in what is left for an environment from which on it is a drawing, unless the network takes
the environment for this bright."""

HEIGHT = 64
"""Rows of the environment's picture."""

SMOOTH = 0.03
"""Weight of the environment's own smoothness, which fills in what is not seen: what lies behind the ball and beneath highlights."""

SOLVED = 40
"""Steps of conjugate gradients for the environment."""

HIDDEN = 0.02
"""Where less than this is missing to white beneath, nothing is seen of the environment."""

AMBIENT = 0.35
"""Of a form before it is fitted, the middle of the released grammar's."""

CLOSE = 1e-4
"""Mean squared error at which what the network takes for the picture beneath is explained."""

LIGHTS = Effort(40, price=0.02)
"""Of the search for lights in what the network takes for the picture beneath."""

STRONG = 0.5
"""Least amplitude of a highlight that is one beneath."""

NARROW = 15.0
"""And its least sharpness."""

SAME_HIGHLIGHT, SAME_RIM = 0.985, 0.8
"""Cosine from which two lights are one."""


def load(folder: str | os.PathLike[str] | None = None) -> ReflectionNet:
    """The network that ships, or that of a folder. Raises MissingWeightsError, WeightsError."""
    path = weights.file_of("reflection", folder)
    return _loaded(path, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=2)
def _loaded(path: Path, age: int) -> ReflectionNet:
    """Read once as long as the file stays the same."""
    return cast(ReflectionNet, weights.load("reflection", path.parent).model)


def beneath(image: Image, valid: Mask, network: ReflectionNet) -> tuple[Image, float]:
    """What the network takes for the picture (3, H, H) beneath an environment, and how bright the environment is on the average."""
    size = network.places.shape[-1]
    with torch.inference_mode():
        environment, plain = network(node_image(image, valid, size)[None])
    share = float(environment[0][:, disc_mask(size)[0]].mean())
    return F.interpolate(plain, size=image.shape[-1], mode="bilinear")[0].clamp(0.0, 1.0), share


def uncover(sphere: SphereImage, found: Node, network: ReflectionNet, seed: int) -> Iterator[Node | None]:
    """Work on a tree of a picture with its environment as a raster, on top of all; about ten seconds of one core.

    Args:
        found: a tree of the picture, whose lights are tried.

    Yields:
        None after each piece of work, then the tree. It stays at None where the picture reflects no environment, is a drawing, is too
        white or has too much grain to tell (which pictures of less than about 64 pixels seem to have: their shading is as rough).
    """
    image, valid = sphere.image, sphere.valid
    if grain(image, valid) > GRAIN:
        return
    plain, share = beneath(image, valid, network)
    if share < SHOWS:
        return
    separation = Separation(image, valid, plain, seed)
    if separation.pixels.count < KNOWN:
        return
    yield None
    pixels = Pixels.of(plain, valid, COARSE_SIZE)
    starts = []
    circles = edge_circles(image, valid, seed)
    for root in _starts(pixels, masks_of(circles, sphere.size)):
        starts.append(separation.fit(root, 8))
        yield None
    current = separation.fit(min(starts, key=lambda separated: separated.cost).root, 25)
    for improve in (
        separation.prune,
        separation.turn,
        partial(separation.grow, known=list(_lights(found))),
        separation.prune,
        separation.turn,
    ):
        current = improve(current)
        yield None
    root = separation.fit(current.root, 40, 1e-6).root
    under = render(root, sphere_normals(sphere.size))
    seen = (1.0 - (1.0 - image) / (1.0 - under).clamp(min=HIDDEN)).clamp(0.0, 1.0)
    if share < BRIGHT and edges_left(circles, image, seen) > DRAWN:
        return
    environment = panorama(seen, (1.0 - under).square() * valid)
    yield add_light(root, leaf("environment_map", pixels=Raster.from_array(environment)))


def panorama(reflection: Image, weight: Image, height: int = HEIGHT) -> Image:
    """The lat-long picture (3, height, 2 height) in [0, 1] that a mirror ball shows as ``reflection``.

    Least squares by conjugate gradients; what no pixel sees is filled in smoothly.

    Args:
        reflection: (3, H, H) in [0, 1]. weight: (3, H, H), of each pixel; 0 leaves one out.
    """
    size = reflection.shape[-1]
    inside = disc_mask(size)[0]
    normals = sphere_normals(size)[:, inside][:, None]
    target, weights, still = reflection[:, inside], weight[:, inside], torch.zeros(3)
    formula = KINDS["environment_map"].formula

    def pulled(panorama: Image, residual_of: torch.Tensor | None) -> Image:
        """The transposed look-up of the weighted target, or of the weighted look-up of a panorama."""
        with torch.inference_mode(False), torch.enable_grad():
            variable = panorama.clone().requires_grad_(True)
            looked = formula(normals.clone(), variable, still.clone())[..., 0, :]
            pull = weights.clone() * (looked.detach() if residual_of is None else residual_of.clone())
            return torch.autograd.grad(looked, variable, pull)[0]

    mean = (target * weights).sum(1) / weights.sum(1).clamp(min=1e-6)
    found = mean[:, None, None].expand(3, height, 2 * height).clone()
    residual = pulled(found, target) - pulled(found, None)
    direction, energy = residual, float(residual.square().sum())
    for _ in range(SOLVED):
        image = pulled(direction, None) + SMOOTH * _bent(direction)
        length = energy / max(float((direction * image).sum()), 1e-20)
        found, residual = found + length * direction, residual - length * image
        last, energy = energy, float(residual.square().sum())
        direction = residual + energy / max(last, 1e-20) * direction
    return found.clamp(0.0, 1.0)


def _bent(panorama: Image) -> Image:
    """The negative Laplacian; longitude wraps."""
    around = torch.cat([panorama[..., -1:], panorama, panorama[..., :1]], -1)
    around = torch.cat([around[:, :1], around, around[:, -1:]], 1)
    inner = 4.0 * around[:, 1:-1, 1:-1]
    return inner - around[:, 1:-1, 2:] - around[:, 1:-1, :-2] - around[:, 2:, 1:-1] - around[:, :-2, 1:-1]


def _starts(pixels: Pixels, masks: list[Leaf]) -> Iterator[Node]:
    """Trees of what the network takes for the picture beneath, one of each way to paint it with these masks."""
    dictionary = dictionary_of(pixels)
    growth = Growth(Samples(pixels, pixels, pixels, dictionary, dictionary), LIGHTS)
    for paint in _paints(masks):
        bare = _formed(pixels, paint)
        *_, lit = [bare, *growth.grow(bare, pixels, dictionary, CLOSE, ("plain_lights", "plain_rims"), LIMITS)]
        yield lit.root


def _paints(masks: list[Leaf]) -> Iterator[Node]:
    """Every way to mix colours by the first two masks."""
    color, masks = leaf("albedo", color=(0.5, 0.5, 0.5)), masks[:2]
    if not masks:
        yield color
    if len(masks) == 1:
        yield Operator("mix", (color, color), masks[0])
    for inner, outer in permutations(masks) if len(masks) == 2 else ():
        mixed = Operator("mix", (color, color), inner)
        yield Operator("mix", (mixed, color), outer)
        yield Operator("mix", (color, mixed), outer)


def _formed(pixels: Pixels, paint: Node) -> Candidate:
    """The paint under a light, from its best direction."""
    options = []
    for direction in directions(SIDES, -0.1).tolist():
        root = Operator("multiply", (paint, leaf("diffuse", direction=direction, ambient=AMBIENT)))
        options.append(fit_pixels(pixels, root, steps=3, limits=LIMITS))
    best = fit_pixels(pixels, min(options, key=lambda option: option.error).root, steps=15, limits=LIMITS)
    return Candidate(best.root, best.error)


def _lights(root: Node) -> Iterator[Leaf]:
    """Highlights and rims of a tree as the released grammar has them, each once."""
    kept: list[tuple[str, torch.Tensor]] = []
    for _, node in walk(root):
        light = _plain_light(node)
        if light is None:
            continue
        direction = F.normalize(torch.tensor(light["direction"], dtype=torch.float64), dim=0)
        same = SAME_RIM if light.kind == "rim" else SAME_HIGHLIGHT
        if not any(kind == light.kind and float(other @ direction) > same for kind, other in kept):
            kept.append((light.kind, direction))
            yield light


def _plain_light(node: Node) -> Leaf | None:
    """A light in the released grammar's words, or None."""
    if not isinstance(node, Leaf):
        return None
    if node.kind == "rim":
        return leaf("rim", direction=node["direction"], exponent=1.0)
    sharp, strong = LIMITS["highlight.sharpness"], LIMITS["highlight.amplitude"]
    if node.kind == "toon_highlight":
        sharpness = _within(1.0 / max(node["radius"][0], 0.02) ** 2, sharp)
        return leaf("highlight", direction=node["direction"], sharpness=sharpness, amplitude=math.sqrt(strong[0] * strong[1]))
    if node.kind != "highlight" or node["sharpness"][0] < NARROW or node["amplitude"][0] < STRONG:
        return None
    sharpness, amplitude = _within(node["sharpness"][0], sharp), _within(node["amplitude"][0], strong)
    return leaf("highlight", direction=node["direction"], sharpness=sharpness, amplitude=amplitude)


def _within(number: float, bounds: tuple[float, float]) -> float:
    return min(max(number, bounds[0]), bounds[1])
