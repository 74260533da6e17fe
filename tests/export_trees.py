"""The fixture trees of every exporter: every leaf, operator, nesting and mask, and trees as `decompose` finds them.

``TREES`` maps a name to a tree; ``PARAMETRIC`` are those without a raster, ``SRGB`` those whose operators work on
encoded values.
"""

from __future__ import annotations

import numpy as np

from unshade.nodes import Leaf, Operator, Raster, Tree, leaf, mix, multiply, screen


def raster(channels: int, height: int, width: int, seed: int = 0) -> Raster:
    """A smooth picture: a few waves."""
    generator = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / max(height, width)
    waves = [0.5 + 0.45 * np.sin(2 * np.pi * (a * x + b * y) + c) for a, b, c in generator.uniform(0.2, 1.2, (channels, 3))]
    return Raster.from_array(np.stack(waves))


def lamp(color: tuple[float, float, float], name: str | None = None, **values: object) -> Operator:
    """A tinted highlight."""
    return multiply(leaf("albedo", color=color), leaf("highlight", **values), name=name)


LEFT_UP, RIGHT, GRAZING, BEHIND = (-0.5, 0.6, 0.62), (0.8, 0.1, 0.59), (0.9, 0.35, 0.26), (0.6, -0.7, -0.39)
RED, BLUE, SAND = (0.8, 0.13, 0.19), (0.1, 0.25, 0.6), (0.85, 0.72, 0.5)

LEAVES: dict[str, Leaf] = {
    "albedo": leaf("albedo", color=RED),
    "diffuse": leaf("diffuse", direction=LEFT_UP, ambient=0.25),
    "diffuse-behind": leaf("diffuse", direction=BEHIND, ambient=0.1),
    "highlight": leaf("highlight", direction=LEFT_UP, sharpness=30.0),
    "highlight-broad": leaf("highlight", direction=RIGHT, sharpness=1.2, amplitude=0.8),
    "highlight-plateau": leaf("highlight", direction=LEFT_UP, sharpness=8.0, amplitude=1.8),
    "highlight-sharp": leaf("highlight", direction=(0.2, 0.3, 0.93), sharpness=900.0),
    "highlight-grazing": leaf("highlight", direction=GRAZING, sharpness=12.0),
    "highlight-behind": leaf("highlight", direction=BEHIND, sharpness=3.0, amplitude=1.5),
    "rim": leaf("rim", direction=(-0.3, 0.9, 0.3), exponent=2.5),
    "toon_diffuse": leaf("toon_diffuse", direction=LEFT_UP, ambient=0.35, threshold=0.1, softness=0.1),
    "toon_diffuse-soft": leaf("toon_diffuse", direction=RIGHT, ambient=0.2, threshold=-0.4, softness=1.1),
    "toon_diffuse-hard": leaf("toon_diffuse", direction=BEHIND, ambient=0.3, threshold=0.2, softness=0.0),
    "toon_highlight": leaf("toon_highlight", direction=LEFT_UP, radius=0.35, brightness=0.9),
    "toon_highlight-soft": leaf("toon_highlight", direction=GRAZING, radius=0.6, brightness=1.0, softness=0.3),
    "environment": leaf("environment", direction=(-0.4, 0.8, 0.45), sharpness=6.0, color=(0.9, 0.8, 0.6)),
    "environment-lobes": leaf(
        "environment",
        direction=(-0.4, 0.8, 0.45, 0.9, 0.1, -0.4, 0.0, -1.0, 0.1),
        sharpness=(25.0, 4.0, 1.0),
        color=(1.0, 0.9, 0.8, 0.2, 0.3, 0.7, 0.25, 0.2, 0.1),
    ),
    "environment_map": leaf("environment_map", pixels=raster(3, 16, 32, 1), rotation=(0.2, 0.9, -0.1)),
    "image": leaf("image", pixels=raster(3, 24, 24, 2)),
}
"""One leaf of each kind and of each way it can look."""

MASKS: dict[str, Leaf] = {
    "threshold": leaf("threshold", direction=(0.3, 0.8, 0.52), threshold=0.2),
    "threshold-soft": leaf("threshold", direction=BEHIND, threshold=-0.1, softness=0.4),
    "stripe": leaf("stripe", direction=(0.3, 0.9, 0.3), center=0.1, width=0.4),
    "stripe-soft": leaf("stripe", direction=RIGHT, center=0.4, width=0.5, softness=0.25),
    "image_mask": leaf("image_mask", pixels=raster(1, 24, 24, 3)),
}

BODY = multiply(leaf("albedo", color=RED, name="lacquer"), LEAVES["diffuse"], name="body")
LIGHT = lamp((1.0, 0.95, 0.85), "window", direction=LEFT_UP, sharpness=60.0)
BROAD = lamp((0.25, 0.3, 0.45), "sky", direction=(0.1, 0.95, 0.3), sharpness=2.0)

OPERATORS: dict[str, Operator] = {
    "multiply": multiply(leaf("albedo", color=SAND), LEAVES["diffuse"], LEAVES["toon_diffuse"]),
    "screen": screen(leaf("albedo", color=(0.2, 0.05, 0.1)), LEAVES["highlight"], LEAVES["highlight-broad"]),
    "tinted": LIGHT,
    "lit": screen(BODY, LIGHT, BROAD),
    "nested": multiply(screen(BODY, LIGHT, name="lit"), screen(leaf("albedo", color=(0.4, 0.4, 0.4)), LEAVES["diffuse-behind"])),
    "deep": screen(multiply(screen(multiply(LEAVES["albedo"], LEAVES["diffuse"]), LEAVES["highlight"]), leaf("albedo", color=SAND)), BROAD),
    **{f"mix-{name}": mix(leaf("albedo", color=RED), leaf("albedo", color=BLUE), mask) for name, mask in MASKS.items()},
    "mix-lit": mix(screen(BODY, LIGHT), multiply(leaf("albedo", color=BLUE), LEAVES["toon_diffuse"]), MASKS["threshold"]),
    "mix-in-multiply": multiply(
        mix(leaf("albedo", color=RED), leaf("albedo", color=SAND), MASKS["stripe"], name="paint"), LEAVES["diffuse"]
    ),
    "mix-in-mix": mix(
        mix(leaf("albedo", color=RED), leaf("albedo", color=SAND), MASKS["stripe-soft"]),
        multiply(leaf("albedo", color=BLUE), LEAVES["diffuse"]),
        MASKS["threshold-soft"],
    ),
    "mix-in-screen": screen(mix(BODY, leaf("albedo", color=BLUE), MASKS["threshold-soft"]), LIGHT, LEAVES["rim"]),
    "environment": screen(BODY, LEAVES["environment-lobes"]),
    "rasters": screen(multiply(LEAVES["image"], LEAVES["diffuse"]), multiply(leaf("albedo", color=SAND), LEAVES["environment_map"])),
}

TREES: dict[str, Tree] = {
    **{f"leaf-{name}": Tree(node) for name, node in LEAVES.items()},
    **{name: Tree(node) for name, node in OPERATORS.items()},
    "linear": Tree(OPERATORS["lit"], "linear"),
    "linear-mix": Tree(OPERATORS["mix-in-screen"], "linear", 2.0),
}

RASTER_KINDS = {"image", "image_mask", "environment_map"}
PARAMETRIC = {name: tree for name, tree in TREES.items() if not RASTER_KINDS & {node.kind for _, node in tree.walk()}}
SRGB = {name: tree for name, tree in TREES.items() if tree.blend_space == "srgb"}
