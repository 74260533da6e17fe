"""image -> trees: an iterator of improving trees, and fitting a given tree."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import torch

from unshade.errors import MissingWeightsError, PictureError, TreeError, UnshadeError, did_you_mean
from unshade.fit.least_squares import error_of, fit_least_squares
from unshade.growth import Effort, Samples, outline
from unshade.metrics import psnr
from unshade.nodes import Family, Member, Node, Tree, find_address
from unshade.pictures import SphereImage, read_sphere, sphere_from_array
from unshade.pixel_sets import samples_of
from unshade.presets import PRESETS, Preset
from unshade.render import render, srgb_decode
from unshade.search import Search
from unshade.sphere import sphere_normals
from unshade.starts import read_off
from unshade.threads import threads

if TYPE_CHECKING:
    from unshade.hybrid import Hybrid
    from unshade.learned import Learned, SecondStageName, Settings

METHODS = ("search", "learned", "hybrid")
"""Who proposes structures: the search, networks with a second stage as in the paper, or networks and the search together."""


@dataclass(frozen=True)
class Step:
    """The best tree so far. ``psnr`` in dB is measured on some of the pixels and never falls until the last step, which is the
    choice, measured on all: perhaps a smaller tree than the one before. ``done`` of ``total`` says how far the work is."""

    tree: Tree
    psnr: float
    values: int
    stage: str
    done: int
    total: int


@dataclass(frozen=True)
class Result:
    """What a decomposition found: the chosen ``tree``, and the ``family`` from the simplest tree to the most faithful.

    ``stages`` says what networks did: `learned.Stages` as a dictionary; None for the search.
    """

    tree: Tree
    family: Family
    psnr: float
    seed: int
    preset: str
    stages: dict[str, Any] | None = None


class Decomposition(Iterator[Step]):
    """The work on one picture. Iterate for improving trees, or ask for the `result` at once.

    >>> import torch
    >>> picture = torch.full((3, 64, 64), 0.5)
    >>> decompose(picture, preset="draft").result().tree.leaves
    1
    """

    def __init__(self, work: Iterator[Step | Result], sphere: SphereImage, seed: int, preset: str) -> None:
        self._work, self._sphere, self._seed, self._preset = work, sphere, seed, preset
        self._best: Step | None = None
        self._result: Result | None = None
        self._cancelled = False

    def __next__(self) -> Step:
        if self._cancelled or self._result is not None:
            raise StopIteration
        with threads(1):
            found = next(self._work)
        if isinstance(found, Result):
            self._result = found
            raise StopIteration
        if self._best is None or found.psnr > self._best.psnr:
            self._best = found
        return found

    def cancel(self) -> None:
        """Stop after the current step. `result` then holds the best tree so far."""
        self._cancelled = True
        # Let go of the work, with the processes that it may have.
        self._work = iter(())

    def result(self) -> Result:
        """Run to the end and return what was found; after `cancel`, the best so far, its family that tree alone."""
        for _ in self:
            pass
        if self._result is not None:
            return self._result
        if self._best is None:
            raise TreeError("the decomposition was cancelled before its first step")
        member = Member(self._best.tree, _psnr(self._sphere, self._best.tree))
        return Result(member.tree, Family((member,), 0), member.psnr, self._seed, self._preset)


def decompose(
    image: SphereImage | torch.Tensor | Any | str | Path,
    *,
    preset: str = "balanced",
    max_values: int | None = None,
    seed: int = 0,
    alternatives: int = 1,
    search: Literal["size", "depth"] = "size",
    objective: Literal["l2", "paper"] = "l2",
    method: Literal["search", "learned", "hybrid"] = "search",
    second_stage: SecondStageName = "size",
    weights: str | Path | None = None,
    device: str = "cpu",
    settings: Settings | None = None,
    reflections: Literal["lights", "picture"] = "lights",
) -> Decomposition:
    """Decompose a picture of a shaded sphere into a shade tree.

    Args:
        image: a path, a `SphereImage`, or a (3, H, W) tensor or array in [0, 1].
        preset: draft, balanced or best.
        max_values: most values the tree may store, instead of the preset's.
        seed: of everything drawn at random. The same seed gives the same tree, bit for bit.
        alternatives: how many structurally different trees of about one size are wanted, the chosen one among them.
        search: ``size`` grows trees leaf by leaf; ``depth`` is the paper's second stage, structures in order of depth
            fitted by BasinCMA, and takes about half a minute.
        objective: of ``depth``: ``l2`` compares pixels, ``paper`` pixels and VGG features, a hundred times slower.
        method: who proposes structures: the ``search`` alone; ``learned``, networks and a second stage, as in the paper; ``hybrid``,
            networks whose trees the search finishes. Without weights the hybrid is the search, and `Result.stages` says so.
        second_stage: of ``learned``, for nodes that the networks leave over: ``size`` is our search, ``depth``
            the paper's, minutes a picture, ``none`` makes them one colour.
        weights: folder of the networks; None for those that ship.
        device: where the networks of ``learned`` and ``hybrid`` are, such as ``cuda``; other samples come out there.
        settings: all about the networks' part, instead of ``second_stage``, ``device`` and the defaults; see `unshade.learned`.
        reflections: how a reflected environment is held: ``lights`` are a few values each; ``picture`` is a raster of 24,576
            values over a tree of what is beneath (`unshade.reflections`), where a picture shows one. ``max_values`` is of the tree of
            lights, which stays in the family; what is beneath has the released grammar's leaves, 37 values at most.
    Raises:
        PictureError: the picture cannot be used. TreeError: an argument is out of range. MissingExtraError: the
            ``paper`` objective without its weights. MissingWeightsError: ``learned`` or ``picture`` without theirs. UnshadeError: there is
            no such device.
    """
    if preset not in PRESETS:
        raise TreeError(f"unknown preset {preset!r}{did_you_mean(preset, PRESETS)}")
    if max_values is not None and max_values < 3:
        raise TreeError(f"max_values must be at least 3, the size of one colour, got {max_values}")
    if alternatives < 1:
        raise TreeError(f"alternatives must be at least 1, got {alternatives}")
    if search not in ("size", "depth"):
        raise TreeError(f"search must be size or depth, got {search!r}")
    if objective not in ("l2", "paper"):
        raise TreeError(f"objective must be l2 or paper, got {objective!r}")
    if method not in METHODS:
        raise TreeError(f"unknown method {method!r}{did_you_mean(method, METHODS)}")
    if second_stage not in ("size", "depth", "none"):
        raise TreeError(f"second_stage must be size, depth or none, got {second_stage!r}")
    if method != "search" and search != "size":
        raise TreeError(f"search='depth' is a method of its own; for {method} give second_stage='depth'")
    if method == "learned" and alternatives > 1:
        raise TreeError("alternatives come from the search; take method='search' or 'hybrid'")
    if objective == "paper" and "depth" not in (search, second_stage if method == "learned" else ""):
        raise TreeError("the paper's objective belongs to search='depth'; the search by size compares pixels")
    if reflections not in ("lights", "picture"):
        raise TreeError(f"reflections must be lights or picture, got {reflections!r}")
    if reflections == "picture" and search == "depth":
        raise TreeError("reflections='picture' belongs to search='size'; the paper's search by depth knows lights only")
    uncover = _uncovering(weights, seed) if reflections == "picture" else None
    if objective == "paper":
        from unshade.models import perceptual

        perceptual.weight_file()
    sphere = _sphere(image)
    chosen = PRESETS[preset]
    if max_values is not None:
        chosen = dataclasses.replace(chosen, effort=dataclasses.replace(chosen.effort, max_values=max_values))
    if search == "depth":
        return Decomposition(_by_depth(sphere, chosen, seed, objective), sphere, seed, preset)
    main = Search if method == "search" else _learned(sphere, method, seed, second_stage, objective, weights, device, settings)
    return Decomposition(_without_gradients(_by_size(sphere, chosen, seed, alternatives, main, uncover)), sphere, seed, preset)


def fit(
    image: SphereImage | torch.Tensor | Any | str | Path, tree: Tree, *, locked: Collection[str] = (), seed: int = 0, anew: bool = False
) -> Result:
    """Fit only the parameters of a tree to a picture; the structure stays, and so do ``locked`` addresses or names.

    Args:
        image: as `decompose` takes it.
        tree: its numbers are where the fit starts.
        locked: addresses, ``ADDRESS.parameter``, or names that keep their numbers.
        seed: of everything drawn at random.
        anew: for a structure whose numbers mean nothing: start also from numbers that are read off the picture. Without
            it each light stays near where it is.
    Raises:
        PictureError: the picture cannot be used. AddressError: a locked address does not exist.
    """
    sphere = _sphere(image)
    held = {_locked_address(tree.root, where) for where in locked}
    target = srgb_decode(sphere.image) if tree.blend_space == "linear" else sphere.image
    with threads(1):
        start = read_off(target, sphere.valid, tree.root, seed=seed, locked=held) if anew else tree.root
        fitted = fit_least_squares(target, sphere.valid, start, seed=seed, locked=held)
    trees = [dataclasses.replace(tree, root=root, exposure=sphere.exposure) for root in (fitted.root, tree.root)]
    member = max((Member(found, _psnr(sphere, found)) for found in trees), key=lambda found: found.psnr)
    return Result(member.tree, Family((member,), 0), member.psnr, seed, "fit")


def _locked_address(root: Node, where: str) -> str:
    """A full address for ``ADDRESS`` or ``ADDRESS.parameter``."""
    from unshade.errors import AddressError
    from unshade.nodes import KINDS, Leaf, find

    try:
        return find_address(root, where)
    except AddressError:
        head, _, parameter = where.rpartition(".")
        if not head:
            raise
        address = find_address(root, head)
        node = find(root, address)
        if not isinstance(node, Leaf):
            raise
        return f"{address}.{KINDS[node.kind].parameter(parameter).name}"


def _sphere(image: SphereImage | torch.Tensor | Any | str | Path) -> SphereImage:
    if isinstance(image, SphereImage):
        sphere = image
    elif isinstance(image, str | Path):
        sphere = read_sphere(image)
    else:
        sphere = sphere_from_array(image)
    if int(sphere.valid.sum()) < 16:
        raise PictureError(f"only {int(sphere.valid.sum())} pixels of the sphere count; at least 16 are needed, so ignore fewer")
    return sphere


def _psnr(sphere: SphereImage, tree: Tree | Node) -> float:
    rendered = render(tree, sphere_normals(sphere.size))
    return psnr(rendered, sphere.image, sphere.valid)


def _member(sphere: SphereImage, root: Node) -> Member:
    return Member(Tree(root, exposure=sphere.exposure), _psnr(sphere, root))


def _decibels(error: float) -> float:
    return -10.0 * math.log10(max(error, 1e-10))


def _without_gradients(work: Iterator[Step | Result]) -> Iterator[Step | Result]:
    """Take each step in inference mode, which is faster; the caller between steps is not in it."""
    while True:
        with torch.inference_mode():
            found = next(work, None)
        if found is None:
            return
        yield found


Begin: TypeAlias = "Callable[[Samples, Effort], Search | Learned | Hybrid]"
"""Starts the main search on a picture's pixels."""

Uncover: TypeAlias = "Callable[[SphereImage, Node], Iterator[Node | None]]"
"""From a tree of a picture to one with its environment as a raster, if it shows one; None after each piece of work."""

HELD = 48.0
"""dB from which on a tree holds a picture, whatever it reflects."""


def _learned(
    sphere: SphereImage,
    method: Literal["learned", "hybrid"],
    seed: int,
    second_stage: SecondStageName,
    objective: Literal["l2", "paper"],
    weights: str | Path | None,
    device: str,
    settings: Settings | None,
) -> Begin:
    """A method with networks; the search where the hybrid has none. Raises UnshadeError, MissingWeightsError, WeightsError."""
    from unshade import hybrid, learned
    from unshade.inference import Networks

    given = settings or learned.Settings(second_stage=second_stage, objective=objective, device=device)
    try:
        torch.empty(1, device=given.device)
    except (RuntimeError, AssertionError) as error:
        raise UnshadeError(f"device {given.device}: cannot be used here: {str(error).partition(chr(10))[0]}") from error
    given = dataclasses.replace(given, threads=given.threads or torch.get_num_threads())
    try:
        networks = Networks.load(weights, given.device)
    except MissingWeightsError as error:
        if method == "learned":
            raise
        return partial(hybrid.Unproposed, why=error.reason)
    main = learned.Learned if method == "learned" else hybrid.Hybrid
    return lambda samples, effort: main(sphere.image, sphere.valid, samples, effort, networks, given, seed)


def _uncovering(weights: str | Path | None, seed: int) -> Uncover:
    """Finds what is beneath a reflected environment. Raises MissingWeightsError, WeightsError."""
    from unshade import reflections

    return partial(reflections.uncover, network=reflections.load(weights), seed=seed)


def _by_size(
    sphere: SphereImage, preset: Preset, seed: int, alternatives: int, begin: Begin = Search, uncover: Uncover | None = None
) -> Iterator[Step | Result]:
    samples = samples_of(sphere, preset.fine, seed)
    share = preset.effort.max_values
    total = share * alternatives
    main = begin(samples, preset.effort)
    done, best, least = 0, None, math.inf
    for stage, found in main.run():
        error = error_of(samples.points, found.root)
        if best is None or error < least:
            best, least = found, error
        done = min(max(done, found.values // 2 if stage in ("start", "grow", "plain", "propose") else 3 * found.values // 4), share - 1)
        yield Step(Tree(best.root, exposure=sphere.exposure), _decibels(least), best.values, stage, done, total)
    chosen = _member(sphere, found.root)
    others: list[Member] = []
    for left_out in _left_out() if alternatives > 1 else ():
        done = share * (1 + len(others))
        for _, found in Search(samples, preset.effort, left_out).run():
            yield Step(chosen.tree, chosen.psnr, chosen.values, "alternatives", min(done + found.values // 2, total - 1), total)
        if outline(found.root) not in {outline(member.tree.root) for member in (chosen, *others)}:
            others.append(_member(sphere, found.root))
        if len(others) == alternatives - 1:
            break
    curve: list[Member] = []
    for candidate in main.family(preset.members):
        member = _member(sphere, candidate.root)
        if member.values < chosen.values and (curve[-1].psnr if curve else -math.inf) < member.psnr < chosen.psnr:
            curve.append(member)
    curve.append(chosen)
    uncovered = False
    if uncover is not None and chosen.psnr < HELD:
        mirrored = chosen
        for root in uncover(sphere, chosen.tree.root):
            yield Step(chosen.tree, chosen.psnr, chosen.values, "reflections", total - 1, total)
            mirrored = _member(sphere, root) if root is not None else chosen
        if mirrored.psnr > chosen.psnr:
            chosen, uncovered = mirrored, True
            curve.append(chosen)
    family = Family(tuple(curve), len(curve) - 1, tuple(others))
    yield Step(chosen.tree, chosen.psnr, chosen.values, "done", total, total)
    stages = getattr(main, "stages", None)
    told = stages.as_dict() | {"uncovered": uncovered} if stages else None
    yield Result(chosen.tree, family, chosen.psnr, seed, preset.name, told)


def _left_out() -> Iterator[frozenset[str]]:
    """Families of leaves to do without: a picture explained without masks, without two-tone shading, ... is explained otherwise."""
    for count in (1, 2, 3):
        yield from map(frozenset, itertools.combinations(("masks", "shades", "spots", "lights"), count))


def _by_depth(sphere: SphereImage, preset: Preset, seed: int, objective: Literal["l2", "paper"]) -> Iterator[Step | Result]:
    """The paper's second stage: structures in order of depth, BasinCMA, then the whole tree."""
    from unshade import search_depth
    from unshade.fit.basin_cma import fit_basin_cma
    from unshade.fit.gradient import fit_gradient

    best: Member | None = None
    members: list[Member] = []
    for progress in search_depth.search(
        sphere.image,
        sphere.valid,
        partial(fit_basin_cma, objective=objective, meta_steps=6, gradient_steps=10, final_steps=150),
        0.01,
        seed=seed,
        rank=partial(fit_gradient, size=20, steps=50, restarts=3),
        whole_tree=partial(fit_gradient, restarts=1, objective=objective),
        max_values=preset.max_values,
    ):
        member = _member(sphere, progress.root)
        if best is None or member.psnr > best.psnr:
            best = member
            members = [other for other in members if other.values < member.values] + [member]
        yield Step(best.tree, best.psnr, best.values, progress.stage, progress.done, progress.total)
    assert best is not None
    yield Result(best.tree, Family(tuple(members), len(members) - 1), best.psnr, seed, preset.name)
