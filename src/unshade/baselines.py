"""Pictures to trees with the baselines that the paper's method is compared with (Geng et al. 2023, section 4.1).

The LSTM and the transformer write the tree with its numbers. The CNN takes the picture apart step by step, as the paper's first stage
does but with one answer each time and no criterion; its leaves become parametric as the paper's do. Nothing is optimised afterwards.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

import torch

from unshade.decoded import leaf_of, mask_of
from unshade.errors import UnshadeError, did_you_mean
from unshade.models import weights
from unshade.models.cnn_baseline import CNNBaseline
from unshade.models.token_model import TokenModel
from unshade.models.tokens import tree_of
from unshade.node_image import node_image
from unshade.nodes import Node, Operator, Tree
from unshade.pictures import SphereImage
from unshade.proposals import arranged
from unshade.synthesis import OPERATORS, TYPES
from unshade.types import Image, Mask

NAMES = tuple(weights.BASELINES)

DEPTH = 5
"""Levels of operators that the CNN goes down, as the paper's first stage; a node below them is one colour."""


@dataclass(frozen=True)
class Baseline:
    """A trained baseline."""

    name: str
    loaded: weights.Loaded

    @staticmethod
    def load(name: str, folder: str | os.PathLike[str] | None = None, device: torch.device | str = "cpu") -> Baseline:
        """One that ships, or that of a folder.

        Raises:
            UnshadeError: an unknown name. MissingWeightsError: its file is not there. WeightsError: it is damaged.
        """
        if name not in NAMES:
            raise UnshadeError(f"unknown baseline {name!r}{did_you_mean(name, NAMES)}")
        path = weights.file_of(name, folder)
        return Baseline(name, _loaded(name, path.parent, path.stat().st_mtime_ns if path.is_file() else 0, str(device)))

    @torch.no_grad()
    def tree(self, sphere: SphereImage) -> Tree:
        """The tree of a picture."""
        model = self.loaded.model
        image = node_image(sphere.image, sphere.valid, self.loaded.config.size)
        device = next(model.parameters()).device
        if isinstance(model, TokenModel):
            root = tree_of(model.write(image[None].to(device))[0]).root
        else:
            root = arranged(_apart(cast(CNNBaseline, model), image.to(device)))
        return Tree(root, exposure=sphere.exposure)


@lru_cache(maxsize=4)
def _loaded(name: str, folder: Path, age: int, device: str) -> weights.Loaded:
    """Read once as long as the file stays the same."""
    return weights.load(name, folder, device)


@dataclass
class _Part:
    """A node on the way: a leaf, or an operator of other parts."""

    image: Image
    kind: str
    depth: int
    children: tuple[_Part, _Part] | None = None
    operator: str = ""
    mask: Mask | None = None


def _apart(model: CNNBaseline, image: Image) -> Node:
    """Level by level, all open nodes of a level as one batch."""
    root = _Part(image, "operator", 0)
    level = [root]
    while level:
        split = model(torch.stack([part.image for part in level]))
        operators, sides = split.operator.argmax(1).tolist(), (split.left_type.argmax(1).tolist(), split.right_type.argmax(1).tolist())
        below: list[_Part] = []
        for k, part in enumerate(level):
            images = (split.left[k].clamp(0.0, 1.0), split.right[k].clamp(0.0, 1.0))
            first, second = (_Part(own, TYPES[kinds[k]], part.depth + 1) for own, kinds in zip(images, sides, strict=True))
            part.children, part.operator = (first, second), OPERATORS[operators[k]]
            part.mask = split.mask[k].sigmoid() if part.operator == "mix" else None
            below += [child for child in (first, second) if child.kind == "operator" and child.depth < DEPTH]
        level = below
    return _node(root)


def _node(part: _Part) -> Node:
    """With its leaves and masks parametric."""
    if part.children is None:
        return leaf_of(part.kind if part.kind != "operator" else "albedo", part.image.cpu())
    left, right = part.children
    if part.mask is None:
        return Operator(part.operator, (_node(left), _node(right)))
    shown = (left.image - right.image).abs().mean(0, keepdim=True)
    return Operator(part.operator, (_node(left), _node(right)), mask_of(part.mask.cpu(), shown.cpu()))
