"""tree, normals -> image: pure, batched, differentiable, on any device, in float32 or float64."""

from __future__ import annotations

import numpy as np
import torch

from unshade.blend import BLENDS
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, Role, Tree
from unshade.parameters import Layout
from unshade.types import Image, Normals, Params


def srgb_encode(linear: torch.Tensor) -> torch.Tensor:
    """Linear light to sRGB, both in [0, 1] (IEC 61966-2-1)."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def srgb_decode(encoded: torch.Tensor) -> torch.Tensor:
    """sRGB to linear light, both in [0, 1] (IEC 61966-2-1)."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def render(tree: Tree | Node, normals: Normals, parameters: Params | None = None) -> Image:
    """Evaluate a tree at every normal.

    Args:
        tree: what to render.
        normals: (*, 3, H, W) unit vectors of a sphere, a normal map or a mesh. Device and dtype follow them.
        parameters: (*, P) numbers to use instead of the tree's own, laid out as `parameters.Layout` says; gradients
            flow through them, and a leading batch renders that many variants at once.
    Returns:
        (*, 3, H, W) display-encoded colour in [0, 1].
    """
    root, space = (tree.root, tree.blend_space) if isinstance(tree, Tree) else (tree, "srgb")
    layout = Layout.of(root)
    if parameters is None:
        parameters = layout.pack(root).to(normals)
    shaded = evaluate(root, normals, parameters, layout)
    batch = np.broadcast_shapes(normals.shape[:-3], parameters.shape[:-1])
    shaded = shaded.expand(*batch, 3, *normals.shape[-2:])
    return srgb_encode(shaded) if space == "linear" else shaded


def evaluate(root: Node, normals: Normals, parameters: Params, layout: Layout) -> Image:
    """The value of a node in the tree's blend space, (*, 1 or 3, H, W)."""
    found = iter(layout.slots)

    def value(node: Node) -> Image:
        if isinstance(node, Leaf):
            return shade_leaf(node, normals, parameters, next(found))
        layers = [value(child) for child in node.children]
        if node.mask is not None:
            layers.append(value(node.mask))
        return BLENDS[node.kind].apply(*layers)

    return value(root)


def shade_leaf(node: Leaf, normals: Normals, parameters: Params, slots: tuple[slice, ...]) -> Image:
    """One leaf, its numbers taken from the flat vector; rasters come from the leaf itself."""
    kind = KINDS[node.kind]
    arguments = []
    for parameter, stored, slot in zip(kind.parameters, node.values, slots, strict=True):
        if isinstance(stored, Raster):
            arguments.append(stored.tensor(normals.device, normals.dtype))
        elif kind.repeats:
            arguments.append(parameters[..., slot].unflatten(-1, (-1, parameter.size)))
        else:
            arguments.append(parameters[..., slot])
    return kind.formula(normals, *arguments)


DIFFUSE_PART = {Role.PAINT, Role.DIFFUSE}


def part(root: Node, which: str) -> Node:
    """The tree with the leaves of the other part black: highlights, rims and environments, or all but them.

    ``diffuse`` keeps paint and form; ``specular`` keeps the lights, each with its own tint. A diffuse leaf's albedo goes
    with the leaf it colours, since black times a colour is black.
    """
    black = Leaf("albedo", ((0.0, 0.0, 0.0),))

    def has_light(node: Node) -> bool:
        if isinstance(node, Leaf):
            return node.role not in DIFFUSE_PART
        return any(has_light(child) for child in node.children)

    def diffuse_part(node: Node) -> Node:
        if isinstance(node, Leaf):
            return node if node.role in DIFFUSE_PART else black
        return Operator(node.kind, tuple(diffuse_part(child) for child in node.children), node.mask, node.name)

    def specular_part(node: Node) -> Node:
        if not has_light(node):
            return black
        if isinstance(node, Leaf):
            return node
        if node.kind == "multiply":
            return Operator("multiply", tuple(specular_part(c) if has_light(c) else c for c in node.children), None, node.name)
        return Operator(node.kind, tuple(specular_part(child) for child in node.children), node.mask, node.name)

    return diffuse_part(root) if which == "diffuse" else specular_part(root)
