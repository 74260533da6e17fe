"""Where the pictures come from: folders, and trees drawn from the grammar."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from PIL import Image as PILImage

from unshade.bench.options import SAMPLED
from unshade.nodes import Tree
from unshade.pictures import SIZE, Disc, SphereImage, find_pictures, read_sphere
from unshade.render import render
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.types import Image, Mask

INSCRIBED = ("wild", "layered")
"""Sets whose spheres fill the frame; in the others the sphere is found by itself."""

GOLDEN = (5.0**0.5 - 1.0) / 2.0
"""Its multiples modulo 1 fall evenly, however many there are."""

BLACK = 4.0 / 255.0
"""A diffuse layer that is nowhere brighter holds no diffuse part."""


@dataclass(frozen=True)
class Case:
    """One picture of one set: a file, or a tree of the sampler by its number."""

    dataset: str
    name: str
    path: Path | None = None
    number: int = 0


@dataclass(frozen=True)
class Subject:
    """A case with its pictures read."""

    sphere: SphereImage
    scored: Mask
    """(1, S, S) bool: inside the scored disc and valid."""
    truth: Tree | None = None
    diffuse: Image | None = None
    """(3, S, S), the layer that its artist painted as the diffuse one."""


def find_cases(dataset: str, data: Path, limit: int | None) -> list[Case]:
    """The cases of a set by name, spread evenly where there is a limit; none where the set is absent."""
    if dataset.startswith("sampler:"):
        return [Case(dataset, f"{number:04d}", None, number) for number in range(SAMPLED if limit is None else limit)]
    folder = Path("examples") if dataset == "examples" else data / dataset
    if not folder.is_dir():
        return []
    paths = [path for path in find_pictures([folder]) if not path.stem.endswith((".diffuse", ".specular"))]
    if limit is not None and limit < len(paths):
        paths = [paths[k] for k in spread(len(paths), limit)]
    return [Case(dataset, path.name, path) for path in paths]


def spread(count: int, limit: int) -> list[int]:
    """``limit`` of ``count`` places, spread evenly, so that those of a smaller limit are among those of a larger one."""
    return sorted(sorted(range(count), key=lambda k: k * GOLDEN % 1.0)[:limit])


def load(case: Case, seed: int) -> Subject:
    """Read or render one case. Raises PictureError."""
    if case.path is None:
        return _sampled(case, seed)
    disc = None
    if case.dataset in INSCRIBED:
        with PILImage.open(case.path) as picture:
            disc = (picture.width / 2, picture.height / 2, min(picture.size) / 2)
    sphere = read_sphere(case.path, disc=disc, size=SIZE)
    scored = sphere.valid & disc_mask(SIZE, SCORED_RADIUS)
    layer = case.path.with_name(f"{case.path.stem}.diffuse{case.path.suffix}")
    diffuse = read_sphere(layer, disc=sphere.disc, size=SIZE).image if layer.exists() else None
    if diffuse is not None and diffuse[:, scored[0]].max() <= BLACK:
        diffuse = None
    return Subject(sphere, scored, None, diffuse)


def _sampled(case: Case, seed: int) -> Subject:
    """Tree number n of a seed does not depend on how many are drawn."""
    from unshade.grammar import sample

    generator = torch.Generator().manual_seed(1_000_003 * seed + case.number)
    tree = sample(generator, case.dataset.partition(":")[2])
    picture = (render(tree, sphere_normals(SIZE)) * 255.0).round() / 255.0
    half = SIZE / 2
    sphere = SphereImage(picture, disc_mask(SIZE), Disc(half, half, half, 1.0))
    return Subject(sphere, disc_mask(SIZE, SCORED_RADIUS), tree)
