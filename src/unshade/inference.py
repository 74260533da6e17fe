"""Recursive amortised inference: the paper's first stage, from a picture down to pictures of leaves (Geng et al. 2023, section 3.3).

A *pool* holds node pictures and how they are linked. All nodes of a pool that are neither leaves nor decomposed are drawn
for at once, T samples each, as one batch: first child, second child, operator f, its mask g, types h. The sample with the least

    L_select = L_recon + alpha L_sim + beta L_blank + gamma L_white

decomposes its node; a node whose every sample is worse than tau is left over, for a second stage to look at, and so is one
below the depth limit. Where the paper's text has slips, or says less than a program must, we deviate:

- It leaves a node over where ``min L_select < tau``. A high loss is a failure, so it is ``>``.
- ``L_sim``, ``L_blank`` and ``L_white`` take the distances of both children in one sum, so that one child which is blank, or the
  parent once more, escapes. Here the worse child counts.
- They take the logarithm of a distance that can be 0, and reward a child for being far from blank without end, so that a small
  highlight, nearly blank, can never win. Here the distance is cut to [`LEAST`, `SEEN`] and divided by `SEEN`: a child that is
  visibly different costs nothing, one that is not costs up to ``log(SEEN / LEAST)``.
- Blank and white are looked for in *encodings*, where 0 and 1 mean nothing of the kind. Here they are looked for in the pictures.
- A child that is to be decomposed further is what its sibling leaves of the parent (`remainders`), encoded anew. Decoded children are
  blurred and their children more so; this way every level has the picture's own edges. L_recon then tells whether the completed
  children, as they come out of their codes, still give the parent, and the other terms look at the completed children themselves.
  That says little about which of many samples is right, since what one child lacks the other has: so among them L_recon of the
  children as they were drawn counts too, half. It has no part in what tau is asked of.
- A part that hardly shows in the picture is one colour, and what shows most is drawn for first.
- A black or a white child is of no use under multiply and screen, but is a paint like any other under a mix.
- Distances are root mean squares inside the disc, so that alpha, beta, gamma and tau do not depend on the size of the pictures.
- g's mask is used as soft as it comes, because our Toon trees hold ramps; the paper's masks are 0 or 1.
- All open nodes of a pool are one batch, not one node after the other. `Inference.trees` pools are kept side by side (the paper
  keeps one), ordered by the sum of what their samples were ordered by, tau for each node left over.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Literal, cast

import torch

from unshade.criterion import Terms, criterion
from unshade.models import weights
from unshade.models.config import Config
from unshade.models.heads import Heads
from unshade.models.prior import Priors
from unshade.models.vqvae import VQVAE, Codes
from unshade.remainders import completed, contrast, gains
from unshade.synthesis import OPERATORS, TYPES
from unshade.threads import at_once
from unshade.types import Image, Mask

OF_A_JOB = 8
"""Masks that a thread asks g for at once."""


@dataclass(frozen=True)
class Inference:
    """How the first stage works; the numbers are ours, the paper gives none."""

    samples: int = 10
    """T, drawn of each node."""
    temperature: float = 0.7
    """Of the priors: under 1 likely codes become likelier."""
    depth: int = 5
    """Levels of operators; a node that is not a leaf below them is left over."""
    nodes: int = 16
    """Most nodes of a pool that are decomposed, more than any tree of the released grammar has; the rest is left over."""
    draws: int = 12
    """Most nodes that are drawn for over all pools, those first that show most; what is open then is left over."""
    similar: float = 0.02
    """alpha"""
    blank: float = 0.02
    """beta"""
    white: float = 0.02
    """gamma"""
    drawn: float = 0.5
    """Weight of L_recon of the children as they were decoded, where samples are ordered; of no use without `remainders`."""
    stop: float = 0.08
    """tau, on the scale of L_recon: 0.08 is 22 dB."""
    trees: int = 3
    """Pools kept side by side; the paper keeps one."""
    choices: int = 3
    """Decompositions of a node that pools may differ in."""
    remainders: bool = True
    """Give a child that is to be decomposed what its sibling leaves of the parent (`remainders`), not what was decoded for it alone."""
    hidden: float = 0.01
    """A part that changes the picture by less than this, root mean square, against one colour is one colour."""
    seen_first: bool = True
    """Draw for those first that show most, not in the order of the pools."""


Cause = Literal["loss", "depth", "nodes", "draws"]
"""Why a node is left over: its best sample is over tau, or it would be one more than `Inference` allows of levels, nodes or draws."""


@dataclass(frozen=True)
class Networks:
    """The trained networks, all of one size and one codebook, in evaluation mode."""

    vqvae: VQVAE
    priors: Priors
    heads: Heads
    config: Config

    @staticmethod
    def load(folder: str | os.PathLike[str] | None = None, device: torch.device | str = "cpu") -> Networks:
        """Those that ship, or those of a folder.

        Raises:
            MissingWeightsError: a file is not there. WeightsError: one is damaged, or they do not belong together.
        """
        files = [weights.file_of(name, folder) for name in weights.MODELS]
        return _loaded(Path(folder or weights.FOLDER), tuple(_age(path) for path in files), str(device))

    @property
    def device(self) -> torch.device:
        """Where they are."""
        return next(self.vqvae.parameters()).device


def _age(path: Path) -> int:
    return path.stat().st_mtime_ns if path.is_file() else 0


@lru_cache(maxsize=2)
def _loaded(folder: Path, ages: tuple[int, ...], device: str) -> Networks:
    """Read once as long as the files stay the same."""
    vqvae, priors, heads = (weights.load(name, folder, device) for name in ("vqvae", "prior", "heads"))
    for other, name in ((priors, "prior"), (heads, "heads")):
        alike = weights.same_codes(vqvae.config, other.config) if name == "prior" else vqvae.config.size == other.config.size
        if not alike:
            raise weights.WeightsError(f"{weights.file_of(name, folder)}: made for other images or codes than vqvae.safetensors beside it")
    # Convolutions take a third less time where the channels of a pixel lie side by side.
    models = [found.model.to(memory_format=torch.channels_last) for found in (vqvae, priors, heads)]  # type: ignore[call-overload]
    return Networks(cast(VQVAE, models[0]), cast(Priors, models[1]), cast(Heads, models[2]), vqvae.config)


@dataclass(frozen=True, eq=False)
class Part:
    """A node of a pool."""

    image: Image
    """(3, S, S)."""
    codes: Codes
    """Of the image, a batch of one."""
    kind: str
    """What h takes it for, one of `TYPES`."""
    state: Literal["open", "leaf", "split", "left over"]
    depth: int
    """Operators above it."""
    terms: Terms | None = None
    """Of its best sample, also where that was not good enough."""
    operator: str | None = None
    children: tuple[int, int] | None = None
    """Places in the pool, of a part that is split."""
    mask: Mask | None = None
    """(1, S, S), of a mix."""
    cause: Cause | None = None
    """Of a part that is left over."""
    gain: Image | None = None
    """(3, S, S), how much of it shows in the picture; None is all of it."""

    @cached_property
    def shown(self) -> float:
        """`remainders.contrast` in the picture."""
        return float(contrast(self.image, torch.ones_like(self.image) if self.gain is None else self.gain))

    def cpu(self) -> Part:
        """Its picture and gain on the CPU, where fits are."""
        return dataclasses.replace(self, image=self.image.cpu(), gain=None if self.gain is None else self.gain.cpu())


@dataclass(frozen=True, eq=False)
class Pool:
    """Nodes and their links; the first is the root."""

    parts: tuple[Part, ...]

    @property
    def open(self) -> list[int]:
        """Places of the parts that are neither leaves nor decomposed."""
        return [place for place, part in enumerate(self.parts) if part.state == "open"]

    @property
    def left_over(self) -> list[int]:
        """Places of the parts that a second stage has to look at."""
        return [place for place, part in enumerate(self.parts) if part.state == "left over"]

    def way(self, place: int) -> list[tuple[int, int]]:
        """From the root down to a part: the places of (a node, its child on the way)."""
        above = {child: number for number, part in enumerate(self.parts) for child in part.children or ()}
        found: list[tuple[int, int]] = []
        while place:
            found.append((above[place], place))
            place = above[place]
        return found[::-1]

    def loss(self, stop: float) -> float:
        """Sum of `Terms.rank` over its nodes, ``stop`` for each that is left over; smaller trees lose less."""
        split = [part.terms.rank for part in self.parts if part.state == "split" and part.terms]
        return sum(split) + stop * len(self.left_over)


@dataclass(frozen=True, eq=False)
class _Split:
    """One way to decompose a node."""

    terms: Terms
    operator: str
    mask: Mask | None
    children: tuple[Part, Part]


@dataclass(frozen=True)
class Round:
    """The pools after a round, best first, and the nodes that were drawn for so far, over all pools."""

    pools: tuple[Pool, ...]
    drawn: int

    @property
    def done(self) -> bool:
        """Nothing is open any more."""
        return not any(pool.open for pool in self.pools)


def infer(image: Image, networks: Networks, settings: Inference, seed: int) -> Iterator[Round]:
    """Decompose a picture from the top down; a round is one level of all pools.

    Args:
        image: (3, S, S) from `node_image`.
        seed: of all samples. The same seed gives the same pools on the same machine.
    """
    generator = torch.Generator(networks.device).manual_seed(seed)
    with torch.no_grad():
        (codes,) = at_once([partial(networks.vqvae.encode, image[None].to(networks.device))], networks.device)
    # Its type is not asked: a picture that is one leaf has a blank child however it is split, so it is left over.
    pools: tuple[Pool, ...] = (Pool((Part(image.to(networks.device), codes, "operator", "open", 0),)),)
    drawn = 0
    while any(pool.open for pool in pools):
        # Pools share their upper parts, which are drawn for once.
        parts = list({id(pool.parts[place]): pool.parts[place] for pool in pools for place in pool.open}.values())
        if settings.seen_first:
            parts.sort(key=lambda part: -part.shown)
        parts = parts[: settings.draws - drawn]
        if not parts:
            yield Round(tuple(_left_over(pool, pool.open, "draws") for pool in pools), drawn)
            return
        chosen = {id(part) for part in parts}
        pools = tuple(_left_over(pool, [place for place in pool.open if id(pool.parts[place]) not in chosen], "draws") for pool in pools)
        with torch.no_grad():
            found = _splits(parts, networks, settings, generator)
        splits = {id(part): ways for part, ways in zip(parts, found, strict=True)}
        drawn += len(parts)
        grown = [variant for pool in pools for variant in _grown(pool, splits, settings)]
        best = sorted(grown, key=lambda pool: pool.loss(settings.stop))[: settings.trees]
        pools = tuple(_limited(pool, settings.nodes) for pool in best)
        yield Round(pools, drawn)


def _limited(pool: Pool, most: int) -> Pool:
    """The pool with open parts left over that are too many."""
    room = most - sum(part.state == "split" for part in pool.parts)
    return _left_over(pool, pool.open[max(room, 0) :], "nodes")


def _left_over(pool: Pool, places: Sequence[int], cause: Cause) -> Pool:
    """The pool with some parts left over."""
    over = set(places)
    if not over:
        return pool
    parts = (dataclasses.replace(part, state="left over", cause=cause) if k in over else part for k, part in enumerate(pool.parts))
    return Pool(tuple(parts))


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Pairs of children of several parts, those of one part in a row."""

    images: tuple[Image, Image]
    """(B, 3, S, S) each, completed unless `Inference` says otherwise."""
    codes: tuple[Codes, Codes]
    operators: list[str]
    masks: list[Mask | None]
    kinds: list[tuple[str, str]]
    terms: list[Terms]


def _drawn(parts: Sequence[Part], networks: Networks, settings: Inference, generator: torch.Generator) -> _Drawn:
    """Draw for several parts as one batch, and judge what comes."""
    vqvae, heads = networks.vqvae, networks.heads
    given = _stacked([part.codes for part in parts])
    codes = networks.priors.sample_children(vqvae, given, settings.samples, generator, settings.temperature)
    parents = torch.stack([part.image for part in parts]).repeat_interleave(settings.samples, 0)
    images = first = _decoded(vqvae, codes)
    judged = [partial(heads.operator, parents, *images), *(partial(heads.types, child) for child in images)]
    numbers, *types = (logits.argmax(1) for logits in at_once(judged, parents.device))
    operators = [OPERATORS[number] for number in numbers.tolist()]
    masks = _masks(heads, parents, images, numbers == OPERATORS.index("mix"))
    known = [mask if operator == "mix" else None for operator, mask in zip(operators, masks, strict=True)]
    left, right = ([TYPES[number] for number in side.tolist()] for side in types)
    kinds = list(zip(left, right, strict=True))
    if settings.remainders:
        pairs = [completed(*row) for row in zip(parents, operators, zip(*images, strict=True), known, kinds, strict=True)]
        images = torch.stack([pair[0] for pair in pairs]), torch.stack([pair[1] for pair in pairs])
        left_codes, right_codes = at_once([partial(vqvae.encode, side) for side in images], parents.device)
        codes = left_codes, right_codes
        through, same = _decoded(vqvae, codes), parents
    else:
        (told,) = at_once([partial(vqvae.decode, given)], parents.device)
        through, same = images, told.repeat_interleave(settings.samples, 0)
    weigh = (settings.similar, settings.blank, settings.white, settings.drawn if settings.remainders else 0.0)
    terms = criterion(parents, same, first, through, images, numbers, masks, weigh)
    return _Drawn(images, codes, operators, known, kinds, terms)


def _masks(heads: Heads, parents: Image, images: tuple[Image, Image], asked: torch.Tensor) -> Mask:
    """(B, 1, S, S), 0 where it is not asked for: three quarters of the time of all three heads is g's."""
    masks = torch.zeros_like(parents[:, :1])
    if asked.any():
        rows = zip(*(side[asked].split(OF_A_JOB) for side in (parents, *images)), strict=True)
        masks[asked] = torch.sigmoid(torch.cat(at_once([partial(heads.mask, *row) for row in rows], parents.device)))
    return masks


def _decoded(vqvae: VQVAE, codes: tuple[Codes, Codes]) -> tuple[Image, Image]:
    left, right = at_once([partial(vqvae.decode, side) for side in codes], codes[0].top.device)
    return left, right


def _splits(parts: Sequence[Part], networks: Networks, settings: Inference, generator: torch.Generator) -> list[list[_Split]]:
    """For each part its decompositions, best first, no two of one kind."""
    drawn, found = _drawn(parts, networks, settings, generator), []
    for number, part in enumerate(parts):
        rows = range(number * settings.samples, (number + 1) * settings.samples)
        best: dict[tuple[str, ...], int] = {}
        # One that tau would refuse comes last, however well it was drawn.
        for row in sorted(rows, key=lambda row: (drawn.terms[row].select > settings.stop, drawn.terms[row].rank, row)):
            best.setdefault((drawn.operators[row], *drawn.kinds[row]), row)
        found.append([_split_of(part, drawn, row, settings) for row in list(best.values())[: settings.choices]])
    return found


def _split_of(part: Part, drawn: _Drawn, row: int, settings: Inference) -> _Split:
    operator, mask = drawn.operators[row], drawn.masks[row]
    images = [side[row] for side in drawn.images]
    shares = gains(operator, images, mask)
    left, right = (
        _child(part, image, share, kind, _one(codes, row), settings)
        for image, share, kind, codes in zip(images, shares, drawn.kinds[row], drawn.codes, strict=True)
    )
    return _Split(drawn.terms[row], operator, mask, (left, right))


def _child(parent: Part, image: Image, share: Image, kind: str, codes: Codes, settings: Inference) -> Part:
    gain, depth = share if parent.gain is None else share * parent.gain, parent.depth + 1
    if kind != "operator":
        return Part(image, codes, kind, "leaf", depth, gain=gain)
    if float(contrast(image, gain)) < settings.hidden:
        return Part(image, codes, "albedo", "leaf", depth, gain=gain)
    part = Part(image, codes, kind, "open", depth, gain=gain)
    return dataclasses.replace(part, state="left over", cause="depth") if depth >= settings.depth else part


def _grown(pool: Pool, splits: dict[int, list[_Split]], settings: Inference) -> list[Pool]:
    """The pool with every open part split in the best way or left over, and where several pools are kept, with one part split otherwise."""
    places = pool.open
    if not places:
        return [pool]
    ways = {place: splits[id(pool.parts[place])] for place in places}
    best = dict.fromkeys(places, 0)
    plans = [best]
    if settings.trees > 1:
        plans += [best | {place: k} for place in places for k in range(1, len(ways[place])) if ways[place][k].terms.select <= settings.stop]
    return [_split(pool, {place: ways[place][k] for place, k in plan.items()}, settings.stop) for plan in plans]


def _split(pool: Pool, ways: dict[int, _Split], stop: float) -> Pool:
    parts = list(pool.parts)
    for place, way in ways.items():
        if way.terms.select > stop:
            parts[place] = dataclasses.replace(parts[place], state="left over", terms=way.terms, cause="loss")
            continue
        parts[place] = dataclasses.replace(
            parts[place], state="split", terms=way.terms, operator=way.operator, mask=way.mask, children=(len(parts), len(parts) + 1)
        )
        parts += way.children
    return Pool(tuple(parts))


def _one(codes: Codes, row: int) -> Codes:
    keep = slice(row, row + 1)
    return Codes(codes.top[keep], codes.bottom[keep], codes.top_features[keep], codes.bottom_features[keep])


def _stacked(codes: Sequence[Codes]) -> Codes:
    names = ("top", "bottom", "top_features", "bottom_features")
    return Codes(*(torch.cat([getattr(part, name) for part in codes]) for name in names))
