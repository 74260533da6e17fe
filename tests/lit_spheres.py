"""Two known trees that the learned method is tried on, and their pictures."""

from __future__ import annotations

from unshade.nodes import Node, leaf, mix, multiply, screen
from unshade.render import render
from unshade.sphere import sphere_normals
from unshade.types import Image

SIMPLE = screen(
    multiply(leaf("albedo", color=(0.8, 0.3, 0.2)), leaf("diffuse", direction=(0.3, 0.6, 0.7), ambient=0.3)),
    leaf("highlight", direction=(-0.3, 0.4, 0.85), sharpness=40.0, amplitude=1.0),
)

PAINTED = screen(
    multiply(
        mix(
            leaf("albedo", color=(0.8, 0.6, 0.2)),
            leaf("albedo", color=(0.2, 0.3, 0.6)),
            leaf("threshold", direction=(0.4, 0.2, 0.9), threshold=0.4),
        ),
        leaf("toon_diffuse", direction=(0.3, 0.6, 0.7), ambient=0.4, threshold=0.0, softness=0.1),
    ),
    leaf("toon_highlight", direction=(-0.3, 0.5, 0.8), radius=0.25, brightness=0.6),
)


def picture(root: Node, size: int = 96) -> Image:
    """(3, size, size)."""
    return render(root, sphere_normals(size))
