"""What the network of reflections learns from: pictures of whole trees, and the environments that are screened on them."""

from __future__ import annotations

import random
from dataclasses import dataclass
from functools import lru_cache

import torch

from unshade import environments, made_environments
from unshade.forest import CODES, Forest, Outline, grow, pictures_of
from unshade.models.reflection import without
from unshade.sampler import Structure, structures
from unshade.sphere import disc_mask, sphere_normals
from unshade.synthesis import Batches, random_structure, seed_of, with_real_lights
from unshade.types import Image

ENVIRONMENT_SHARE = 0.85
"""Of the trees, those with an environment."""

WIDE_SHARE = 0.15
"""Of the trees, those with the broad and coloured lights of real pictures."""

TOGETHER = 8
"""Batches with the same environments, which take longer to make than the trees of one."""

UNALTERED_SHARE = 0.08
"""Of such batches of the training half, those that see the real environments as they are."""

ENVIRONMENT = CODES.index("environment_map")


@dataclass(frozen=True)
class ReflectionBatch:
    """Pictures with what they reflect, display-encoded in [0, 1], 0 outside the disc."""

    pictures: Image
    """(B, 3, S, S), rounded to 8 bits as files are."""
    environments: Image
    """(B, 3, S, S), 0 where a tree has none."""

    @property
    def plain(self) -> Image:
        """(B, 3, S, S), the pictures without the environments."""
        return without(self.pictures, self.environments)

    def to(self, device: torch.device | str) -> ReflectionBatch:
        """The same on another device."""
        return ReflectionBatch(self.pictures.to(device), self.environments.to(device))

    def __len__(self) -> int:
        """Pictures."""
        return len(self.pictures)


class ReflectionBatches(Batches[ReflectionBatch]):
    """Pictures of whole trees. Toon trees have no environment; of ``both`` styles only the realistic one is drawn.

    Environments of the training half are made up or altered, see `made_environments`; those of the test half are the real ones.
    """

    def __getitem__(self, number: int) -> ReflectionBatch:
        """See `Batches`."""
        style = "toon" if self.style == "toon" else "realistic"
        key = seed_of(f"reflection {style} {self.split} {self.batch} {self.seed} {number}")
        choices = random.Random(key)
        outlines = [Outline.of(_structure(style, choices)) for _ in range(self.batch)]
        shown = _panoramas(self.split, self.seed, number // TOGETHER)
        grown = grow(outlines, self.split, torch.Generator().manual_seed(key), shown)
        return rendered(Forest(grown, panoramas={self.split: shown}), self.size)


def rendered(forest: Forest, size: int) -> ReflectionBatch:
    """The trees of a forest with their environments."""
    values = forest.shade(sphere_normals(size, forest.device)[:, disc_mask(size)[0].to(forest.device)][:, None])
    roots = values[torch.from_numpy(forest.roots()).to(forest.device)]
    reflected = torch.zeros_like(roots)
    rows = (forest.kinds == ENVIRONMENT).nonzero()[0]
    reflected[torch.from_numpy(forest.tree[rows]).to(forest.device)] = values[torch.from_numpy(rows).to(forest.device)]
    return ReflectionBatch((pictures_of(roots, size) * 255.0).round() / 255.0, pictures_of(reflected, size))


def _structure(style: str, choices: random.Random) -> Structure:
    if style == "toon":
        return random_structure("toon", choices)
    structure = choices.choice(structures("realistic", choices.random() < ENVIRONMENT_SHARE, choices.random() < 0.5))
    return with_real_lights(structure, choices) if choices.random() < WIDE_SHARE else structure


@lru_cache(maxsize=2)
def _panoramas(split: str, seed: int, group: int) -> Image:
    key = seed_of(f"environments {split} {seed} {group}")
    if split == "test" or random.Random(key).random() < UNALTERED_SHARE:
        return environments.panoramas(split)
    return made_environments.panoramas(key)
