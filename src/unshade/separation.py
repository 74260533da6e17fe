"""What a picture is beneath the environment that it reflects: a tree fitted to how the picture bends, not to how bright it is.

A picture I that reflects an environment E is ``screen(N, E)``, so ``1 - I = (1 - N) (1 - E)`` and

    log(1 - E) = log(1 - I) - log(1 - N).

Of E is known that it is nowhere negative and that over a few pixels it hardly bends, but at its own edges. So the tree of N is
fitted until the second differences of the right side are as small as they can be, robustly (Cauchy 1853): edges, kinks and lights
of N must go, edges of E may stay. Two paints under one E fix both; one paint alone does not, so N also stays near to what
a network takes it for (`models.reflection`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import torch
import torch.nn.functional as F

from unshade.atoms import dictionary_of, directions
from unshade.fit.model import Model
from unshade.fit.pixels import Pixels
from unshade.fit.plan import Limits
from unshade.moves import add_light
from unshade.nodes import Leaf, Node, Operator, count_values, find, replace, walk
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.types import Image, Mask

LIMITS: Limits = {
    "highlight.sharpness": (25.0, 120.0),
    "highlight.amplitude": (0.9, 1.6),
    "exponent": (0.95, 1.05),
    "ambient": (0.1, 0.6),
}
"""Ranges of the released grammar, a little wider: what else a highlight could be, a reflection is."""

MOST_HIGHLIGHTS, MOST_RIMS = 3, 1
"""Of the released grammar."""

REACH = (1, 3)
"""Pixels between the three places of a second difference."""

PLACES = 1500
"""Middles of differences, half of them where the picture bends most."""

DARKEST = 0.03
"""Where less than this is missing to white, nothing is known of what is below."""

NOISE = 1.2e-3
"""Deviation of a pixel that is rounded to 8 bits."""

NEGATIVE = 3.0e-3
"""Square of a log(1 - E) over 0 that counts as much as a residual of one deviation."""

TIE, TIE_WIDTH = 0.3, 0.08
"""Weight of the network's picture beside the bends, and the error that it is expected to have."""

PRICE = 60.0
"""What a stored value must save, in bends."""

EXCESS = 2000.0
"""What a light more than the released grammar has must save, in the same."""

SIDES = 24
"""Directions that a form is tried from."""

BRIGHT = 1.1
"""Amplitude of a highlight before it is fitted."""

TRIED = 4
"""Highlights that are tried by a fit; rims half as many."""


@dataclass(frozen=True)
class Separated:
    """A tree of N and what it costs, its values included."""

    root: Node
    cost: float


class Separation:
    """The objective of one picture.

    Args:
        image: (3, H, H) in [0, 1]. valid: (1, H, H). plain: (3, H, H), what a network takes for N. seed: of the places.
    """

    def __init__(self, image: Image, valid: Mask, plain: Image, seed: int) -> None:
        size, left = image.shape[-1], (1.0 - image.double()).clamp(min=0.5 / 255.0)
        known = (valid & disc_mask(size, SCORED_RADIUS, image.device))[0] & (left.amin(0) > DARKEST)
        self.places, index = _differences(left.log(), known, seed)
        self.index, chance = index
        flat = [picture.double().flatten(1)[:, self.places] for picture in (image, left, plain)]
        normals = sphere_normals(size, dtype=torch.float64).flatten(1)[:, self.places].contiguous()
        count = len(self.places)
        self.pixels = Pixels(normals, flat[0], torch.full((count,), 1.0 / max(count, 1), dtype=torch.float64))
        self.log, self.plain = flat[1].log(), flat[2]
        variance = (NOISE / flat[1]).square()
        first, middle, last = (variance[:, self.index[:, k]] for k in range(3))
        bends = self._bends(self.log).abs().flatten()
        usual = float(bends.median()) if len(bends) else 0.0
        self.variance = first + 4.0 * middle + last + min(max(usual, 1e-4), 0.02) ** 2
        self.weight = (1.0 / chance) / (1.0 / chance).mean()
        self.tie = TIE * len(self.index) / max(count, 1)

    def _bends(self, values: torch.Tensor) -> torch.Tensor:
        """Second differences of (*, P), (*, T)."""
        first, middle, last = (values[..., self.index[:, k]] for k in range(3))
        return first - 2.0 * middle + last

    def _residuals(self, found: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Of N at the places (3 or 1, P): bends of log(1 - E), how much of that is over 0, and how far N is from the network's."""
        found = found.expand(3, -1)
        log = self.log - (1.0 - found).clamp(min=1e-3).log()
        return self._bends(log), log.clamp(min=0.0), (found - self.plain) / TIE_WIDTH

    def of(self, found: torch.Tensor) -> float:
        """What N at the places costs, without its tree."""
        bends, over, away = self._residuals(found)
        bent = (torch.log1p(bends.square() / self.variance) * self.weight).sum()
        return float(bent + over.square().sum() / NEGATIVE + self.tie * torch.log1p(away.square()).sum())

    def price(self, root: Node) -> float:
        """What the size of a tree costs."""
        kinds = [node.kind for _, node in walk(root)]
        excess = max(0, kinds.count("highlight") - MOST_HIGHLIGHTS) + max(0, kinds.count("rim") - MOST_RIMS)
        return PRICE * count_values(root) + EXCESS * excess

    def fit(self, root: Node, steps: int, tolerance: float = 1e-4) -> Separated:
        """Fit the numbers of a tree by Levenberg-Marquardt on reweighted squares; hard edges stay where they are."""
        model = Model(root, self.pixels, limits=LIMITS)
        vector = model.start()
        values = model.evaluate(vector)
        cost, damping = self.of(model.compose(values)), 1e-2
        for _ in range(steps if model.free else 0):
            hessian, gradient = self._normal_equations(model, vector, values)
            for _ in range(5):
                damped = hessian + torch.diag(hessian.diagonal().clamp(min=1e-6) * damping + 1e-8)
                moved = model.move(vector, -torch.linalg.solve(damped, gradient))
                moved_values = model.evaluate(moved)
                moved_cost = self.of(model.compose(moved_values))
                if moved_cost < cost:
                    break
                damping *= 8.0
            else:
                break
            decrease = (cost - moved_cost) / abs(cost)
            vector, values, cost, damping = moved, moved_values, moved_cost, max(0.2 * damping, 1e-6)
            if decrease < tolerance:
                break
        return Separated(model.layout.unpack(root, vector), cost + self.price(root))

    def _normal_equations(self, model: Model, vector: torch.Tensor, values: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """(F, F) and (F,), numbers at their bounds held."""
        found = model.compose(values).expand(3, -1)
        bends, over, away = self._residuals(found)
        jacobian = model.jacobian(vector, values)
        slope = jacobian / (1.0 - found).clamp(min=1e-3)
        rows = []
        for sloped, residual, share in (
            (self._bends(slope), bends, self.weight / (self.variance + bends.square())),
            (slope, over, (over > 0.0) / NEGATIVE),
            (jacobian / TIE_WIDTH, away, self.tie / (1.0 + away.square())),
        ):
            root = share.sqrt()
            rows.append(((sloped * root).flatten(1), (residual * root).flatten()))
        scale = model.scale(vector)
        hessian = torch.stack([sloped @ sloped.T for sloped, _ in rows]).sum(0) * scale[:, None] * scale
        gradient = torch.stack([sloped @ residual for sloped, residual in rows]).sum(0) * scale
        alive = (~model.held(vector, gradient)).double()
        return hessian * alive[:, None] * alive, gradient * alive

    def prune(self, current: Separated) -> Separated:
        """The tree without the lights that do not pay. Its paints and its form are certain."""
        while True:
            quick = sorted((self.fit(root, 3) for root in _without_lights(current.root)), key=_cost)
            better = min((self.fit(option.root, 10) for option in quick[:3]), key=_cost, default=current)
            if better.cost >= current.cost:
                return current
            current = better

    def turn(self, current: Separated) -> Separated:
        """The tree with its form from another side, where that pays."""
        address = next((where for where, node in walk(current.root) if node.kind == "diffuse"), None)
        form = find(current.root, address) if address is not None else None
        if address is None or not isinstance(form, Leaf):
            return current
        turned = (replace(current.root, address, form.set(direction=side)) for side in directions(SIDES, -0.1).tolist())
        quick = sorted((self.fit(root, 3) for root in turned), key=_cost)
        return min([current, *(self.fit(option.root, 15) for option in quick[:2])], key=_cost)

    def grow(self, current: Separated, known: Sequence[Leaf] = ()) -> Separated:
        """The tree with more highlights and a rim, those ``known`` or of the dictionary, as long as they pay."""
        while True:
            kinds = [node.kind for _, node in walk(current.root)]
            tried: list[Leaf] = []
            if kinds.count("highlight") < MOST_HIGHLIGHTS:
                tried += self._best(current.root, [*self._of_kind(known, "highlight"), *self._atoms("plain_lights")], TRIED)
            if kinds.count("rim") < MOST_RIMS:
                tried += self._best(current.root, [*self._of_kind(known, "rim"), *self._atoms("plain_rims")], TRIED // 2)
            better = min((self.fit(add_light(current.root, light), 12) for light in tried), key=_cost, default=current)
            if better.cost >= current.cost:
                return current
            current = better

    def _of_kind(self, lights: Sequence[Leaf], kind: str) -> list[tuple[Leaf, torch.Tensor]]:
        """Those of a kind with their pictures at the places."""
        models = [(light, Model(light, self.pixels)) for light in lights if light.kind == kind]
        return [(light, model.compose(model.evaluate(model.layout.pack(light)))) for light, model in models]

    def _atoms(self, family: str) -> list[tuple[Leaf, torch.Tensor]]:
        """The lights of a family with their pictures at the places, as bright as the released grammar draws them."""
        atoms = dictionary_of(Pixels(self.pixels.normals.float(), self.pixels.target, self.pixels.weight))[family]
        if family == "plain_rims":
            return list(zip(atoms.leaves, atoms.pictures, strict=True))
        bright = (leaf.set(amplitude=BRIGHT) for leaf in atoms.leaves)
        return list(zip(bright, (BRIGHT * atoms.pictures).clamp(max=1.0), strict=True))

    def _best(self, root: Node, lights: list[tuple[Leaf, torch.Tensor]], most: int) -> list[Leaf]:
        """The lights that would lower the cost most as they are."""
        model = Model(root, self.pixels)
        left = 1.0 - model.compose(model.evaluate(model.layout.pack(root)))
        costs = [self.of(1.0 - left * (1.0 - picture)) for _, picture in lights]
        return [lights[k][0] for k in sorted(range(len(lights)), key=costs.__getitem__)[:most]]


_cost = attrgetter("cost")


def _without_lights(root: Node) -> list[Node]:
    """Every tree with one light less."""
    if not isinstance(root, Operator) or root.kind != "screen":
        return []
    lights = [(k, child) for k, child in enumerate(root.children) if isinstance(child, Leaf)]
    return [replace(root, f"{root.kind}.{k}.{child.kind}", None) for k, child in lights]


def _differences(log: Image, known: torch.Tensor, seed: int) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """Places (P,) in a flattened (3, H, H) picture; three of them a second difference (T, 3), and the chance of each to be chosen (T,)."""
    size, reach = log.shape[-1], max(REACH)
    inner = known.clone()
    inner[:reach], inner[-reach:], inner[:, :reach], inner[:, -reach:] = False, False, False, False
    middles = inner.nonzero()
    along = log[:, :, 2:] - 2.0 * log[:, :, 1:-1] + log[:, :, :-2]
    down = log[:, 2:] - 2.0 * log[:, 1:-1] + log[:, :-2]
    rough = (F.pad(along.abs(), (1, 1)) + F.pad(down.abs(), (0, 0, 1, 1))).amax(0)[inner].clamp(max=0.05)
    chance = (PLACES * (0.5 / max(len(middles), 1) + 0.5 * rough / rough.sum().clamp(min=1e-9))).clamp(max=1.0)
    chosen = torch.rand(len(middles), generator=torch.Generator().manual_seed(seed), dtype=torch.float64) < chance
    middles, chance = middles[chosen], chance[chosen]
    triples, chances = [], []
    for step in REACH:
        for arm in (torch.tensor([0, step]), torch.tensor([step, 0])):
            triple = torch.stack([middles + arm, middles, middles - arm], 1)
            usable = known[triple[..., 0], triple[..., 1]].all(1)
            triples.append((triple[..., 0] * size + triple[..., 1])[usable])
            chances.append(chance[usable])
    places, index = torch.cat(triples).unique(return_inverse=True)
    return places, (index, torch.cat(chances))
