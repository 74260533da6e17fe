"""Photos with a known answer: a knot and a pebble whose normals are exact, under known trees, with texture and cast shadow."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from unshade.apply import split
from unshade.mesh import Mesh, View, compute_normals, look
from unshade.nodes import Leaf, Tree, leaf
from unshade.render import render
from unshade.serde import parse
from unshade.types import Image, Mask, Normals

TREES = {
    "clay": "screen(multiply(albedo(#c05030), diffuse(left up, ambient=0.25)), highlight(left up, 40, 0.6),"
    " multiply(albedo(#3050a0), rim(right up)))",
    "lacquer": "screen(multiply(albedo(#508050), diffuse(right up, ambient=0.3)), highlight(right up, 200, 0.9),"
    " multiply(albedo(#806040), highlight(left, 8)))",
    "toon": "screen(multiply(albedo(#4060b0), toon_diffuse(left up, 0.4, 0.1, 0.1)), toon_highlight(left up, 0.2))",
    "wax": "screen(multiply(albedo(#d0b060), diffuse(up front, ambient=0.35)), multiply(albedo(#a04030), highlight(right, 3)),"
    " highlight(up front, 90, 0.8))",
}
"""Known trees, lights screened over one painted form."""

FAULTS = ("clean", "noise", "stripes", "patch", "shadow", "stripes and shadow")


def tree_of(name: str) -> Tree:
    return parse(TREES[name])


@lru_cache(maxsize=4)
def knot(size: int) -> tuple[Normals, Mask]:
    """A trefoil knot, on which most directions are seen in several places: (3, S, S) float64 and (1, S, S)."""
    around, across = np.meshgrid(np.linspace(0, 2 * np.pi, 361), np.linspace(0, 2 * np.pi, 33), indexing="ij")

    def place(t: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=-1)

    along = place(around + 1e-4) - place(around - 1e-4)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    side = np.cross(along, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    points = place(around) + 0.75 * (np.cos(across)[..., None] * side + np.sin(across)[..., None] * np.cross(side, along))
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    corners = np.stack([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)
    normals, covered = look(Mesh(corners, compute_normals(corners), True), size, View((15.0, -25.0, 0.0), 0.0), finer=1)
    return normals.double(), covered


@lru_cache(maxsize=4)
def pebble(size: int) -> tuple[Normals, Mask]:
    """A bumpy stone, on which most directions are seen once or twice."""
    steps = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(steps, -steps)
    angle = np.arctan2(y, x)
    rest = 1.0 - np.square(np.hypot(x, y) / (0.8 + 0.06 * np.cos(3 * angle) + 0.04 * np.sin(5 * angle)))
    z = np.sqrt(np.maximum(rest, 0.0)) * 0.8 * (1.0 + 0.12 * np.sin(7 * x) * np.cos(6 * y))
    down, right = np.gradient(z, steps[1] - steps[0])
    normals = np.stack([-right, down, np.ones_like(z)])
    normals /= np.linalg.norm(normals, axis=0)
    return torch.from_numpy(normals), torch.from_numpy((rest > 0.0)[None]).float()


OBJECTS = {"knot": knot, "pebble": pebble}


def texture(fault: str, size: int, seed: int = 0) -> Image:
    """(3, S, S) ratios to the common paint."""
    down, right = torch.meshgrid(torch.arange(size) / size, torch.arange(size) / size, indexing="ij")
    found = torch.ones(3, size, size, dtype=torch.float64)
    if "stripes" in fault:
        found[:, torch.sin(50 * right + 8 * down) > 0.3] = torch.tensor([0.45, 0.6, 1.3], dtype=torch.float64)[:, None]
    if "patch" in fault:
        found[:, torch.hypot(right - 0.6, down - 0.55) < 0.2] = torch.tensor([0.9, 0.5, 0.3], dtype=torch.float64)[:, None]
    if "noise" in fault:
        generator = torch.Generator().manual_seed(seed)
        found = found * torch.exp(0.15 * torch.randn(1, size, size, generator=generator, dtype=torch.float64))
    return found


def shadowed(tree: Tree) -> Tree:
    """The base without direct light: what is left of each form is its ambient part."""
    for address, node in list(tree.walk()):
        if isinstance(node, Leaf) and node.kind in ("diffuse", "toon_diffuse"):
            tree = tree.replace(address, leaf("albedo", color=node["ambient"] * 3))
    return tree


def photo(tree: Tree, normals: Normals, mask: Mask, fault: str) -> Image:
    """(3, S, S) float64, 8 bits deep: what a camera sees of an object of this tree, with texture under the lights and a band of shadow."""
    parts = split(tree, normals, render(tree, normals))
    assert parts is not None
    base, lights = parts
    size = normals.shape[-1]
    if "shadow" in fault:
        down, right = torch.meshgrid(torch.arange(size) / size, torch.arange(size) / size, indexing="ij")
        band = (down > 0.42 + 0.2 * right) & (down < 0.62 + 0.2 * right)
        dark = split(shadowed(tree), normals, render(shadowed(tree), normals))
        assert dark is not None
        base, lights = torch.where(band, torch.minimum(base, dark[0]), base), torch.where(band, 0.0, lights)
    seen = 1.0 - (1.0 - (base * texture(fault, size)).clamp(0.0, 1.0)) * (1.0 - lights)
    return ((seen * mask + 0.5 * (1 - mask)) * 255.0).round().clamp(0, 255) / 255.0
