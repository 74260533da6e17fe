"""What the baselines that write trees learn from: pictures of whole trees, and the trees in tokens."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice

import torch

from unshade.decoded import SIZE, leaf_of
from unshade.forest import Forest, pictures_of
from unshade.models.tokens import LIGHTS, START, slots_of, tokens_of
from unshade.nodes import Leaf, Node, Operator, Raster, Tree, leaf
from unshade.render import render
from unshade.shading import rotate
from unshade.sphere import disc_mask, sphere_normals
from unshade.synthesis import GROVE, Batches, plants
from unshade.types import Image


@dataclass(frozen=True)
class TreeBatch:
    """Trees with their pictures."""

    images: Image
    """(B, 3, S, S) display-encoded in [0, 1], 0 outside the disc."""
    tokens: torch.Tensor
    """(B, L) int64; a shorter tree is filled with `START`."""
    slots: torch.Tensor
    """(B, L) int64, what each token stands for."""

    def to(self, device: torch.device | str) -> TreeBatch:
        """The same on another device."""
        return TreeBatch(self.images.to(device), self.tokens.to(device), self.slots.to(device))

    def __len__(self) -> int:
        """Trees."""
        return len(self.tokens)


class TreeBatches(Batches[TreeBatch]):
    """The trees of `synthesis.trees` in order, none twice."""

    def __getitem__(self, number: int) -> TreeBatch:
        """See `Batches`."""
        first = number * self.batch
        groves = range(first // GROVE, (first + self.batch - 1) // GROVE + 1)
        grown = [plant for grove in groves for plant in plants(self.style, self.split, self.seed, grove)]
        grown = list(islice(grown, first % GROVE, first % GROVE + self.batch))
        forest = Forest(grown)
        inside = disc_mask(self.size)[0]
        shaded = forest.shade(sphere_normals(self.size)[:, inside][:, None])
        images = pictures_of(shaded[torch.from_numpy(forest.roots())], self.size)
        return TreeBatch(images, *filled([tokens_of(with_lights(plant.tree())) for plant in grown]))


def filled(written: list[list[int]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Sequences of several lengths as tokens and slots (B, L)."""
    length = max(map(len, written))
    tokens = torch.tensor([row + [START] * (length - len(row)) for row in written])
    slots = torch.tensor([slots_of(row) + [0] * (length - len(row)) for row in written])
    return tokens, slots


def with_lights(tree: Tree) -> Tree:
    """The tree with each environment map as a few lights, for it cannot be told in tokens."""
    return dataclasses.replace(tree, root=_with_lights(tree.root))


def _with_lights(node: Node) -> Node:
    if isinstance(node, Operator):
        return dataclasses.replace(node, children=tuple(map(_with_lights, node.children)))
    if node.kind != "environment_map":
        return node
    lit = _lights(node["pixels"])
    directions = torch.tensor(lit["direction"], dtype=torch.float64).view(-1, 3, 1, 1)
    turned = rotate(directions, torch.tensor(node["rotation"], dtype=torch.float64))
    return lit.set(direction=turned.flatten().tolist())


@lru_cache(maxsize=1024)
def _lights(pixels: Raster) -> Leaf:
    """The lights nearest to an environment map, the brightest first."""
    shown = render(Tree(leaf("environment_map", pixels=pixels)), sphere_normals(SIZE)) * disc_mask(SIZE)
    found = leaf_of("environment", shown)
    by_lobe = [
        (found["color"][3 * k : 3 * k + 3], found["sharpness"][k], found["direction"][3 * k : 3 * k + 3]) for k in range(found.lobes)
    ]
    by_lobe.sort(key=lambda lobe: (-sum(lobe[0]) / lobe[1], lobe))
    colors, sharpnesses, directions = zip(*by_lobe[:LIGHTS], strict=True)
    return leaf("environment", direction=sum(directions, ()), sharpness=sharpnesses, color=sum(colors, ()))
