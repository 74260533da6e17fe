"""What two pictures tell about the part that differs, without their trees.

Lights are screened, so what two pictures share on top cancels in ``(1 - first) / (1 - second)``. Where AB is A with one component
of B, its ratio to A holds the environment of neither, and that to B that of both, or the other way round if an environment was moved.
A reflected photograph is more than a tree of a few lights can hold, so this is where trees mislead and pictures do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from unshade.components import Component
from unshade.pictures import SIZE
from unshade.sphere import SCORED_RADIUS, disc_mask
from unshade.types import Image, Mask

STEP = 8
"""Pixels over which roughness is looked at: wider than an edge, narrower than what a rough coat blurs an environment by."""

SATURATED = 0.97
"""Where a picture is brighter, nothing is known of what is below."""

ROUNDING = 12.0**-0.5 / 255.0
"""Deviation that 8 bits make."""

GREY = 1.8
"""Most difference of the channels, in deviations of rounding, of what white lights leave."""

COLORED = 40.0
"""From here on another paint or form is at work: an environment colours a ratio less."""

CHANGED = 0.01
"""Least change that is one."""

LEAST = 0.002
"""Least share of the ball that counts."""

TOGETHER = 0.98
"""Least share of the ball on which another form changes all channels one way."""

COMPACT = 0.36
"""Most of the ball that highlights change; a rim changes more."""

CLEAN = 1.6
"""Most grain of a ratio of renderings; the median of rounded numbers is 1 to 1.5."""

ROUGH = 0.005
"""Least roughness in which an environment is seen; rounding to 8 bits makes about as much in bright places."""

ROUGHER = 0.43
"""How many times as rough as AB over B must AB over A be? Edges and highlights, which are in the former then, make it rougher."""

ROUGHER_GRAINY = 1.2
"""The same of pictures with grain, which is rough in both."""

SLACK = 0.002
"""Added to both before they are compared."""


def thinned(image: torch.Tensor) -> torch.Tensor:
    """Every other pixel of each row and column."""
    return image[..., 1::2, 1::2]


@dataclass(frozen=True)
class Ratio:
    """The logarithm of ``(1 - first) / (1 - second)`` at every other pixel, (3, H, W), 0 outside of ``inside``, (1, H, W)."""

    log: Image
    inside: Mask
    noise: Image
    """Deviation of ``log`` if both pictures are rounded to 8 bits."""

    @staticmethod
    def of(first: Image, second: Image, valid: Mask) -> Ratio:
        """Of two pictures (3, 256, 256) in [0, 1] where both are known."""
        inside = valid & disc_mask(SIZE, SCORED_RADIUS) & (torch.maximum(first, second).amax(0, keepdim=True) < SATURATED)
        left = [(1.0 - thinned(picture)).clamp(min=1.0 - SATURATED) for picture in (first, second)]
        noise = ROUNDING * (left[0] ** -2 + left[1] ** -2).sqrt()
        return Ratio((left[0].log() - left[1].log()) * thinned(inside), thinned(inside), noise)

    @property
    def roughness(self) -> float:
        """Median size of the second differences along rows and columns, `STEP` pixels apart."""
        return _quantile(self._bends(STEP // 2, self.log), 0.5)

    @property
    def grain(self) -> float:
        """Median size of those of neighbours, 1 for smooth shading that is rounded to 8 bits."""
        return _quantile(self._bends(1, self.log / self.noise), 0.5) / (0.6745 * 6.0**0.5)

    def _bends(self, step: int, values: Image) -> torch.Tensor:
        """Sizes of second differences where all three places are inside, (N,)."""
        sizes = []
        for axis in (1, 2):
            length = values.shape[axis] - 2 * step
            low, middle, high = (values.narrow(axis, start, length) for start in (0, step, 2 * step))
            seen = torch.stack([self.inside.narrow(axis, start, length) for start in (0, step, 2 * step)]).all(0)
            sizes.append((low - 2.0 * middle + high).abs()[seen.expand(3, -1, -1)])
        return torch.cat(sizes)

    @property
    def color(self) -> float:
        """How far apart the channels are, in deviations of rounding: the upper quartile."""
        apart = (self.log[:2] - self.log[1:]).abs() / (self.noise[:2].square() + self.noise[1:].square()).sqrt()
        return _quantile(apart[self.inside.expand(2, -1, -1)], 0.75)

    @property
    def changed(self) -> float:
        """Share of the pixels where it is not 1."""
        return _share(self.log.abs().mean(0, keepdim=True)[self.inside] > CHANGED)

    @property
    def together(self) -> float:
        """Share of the pixels in which no channel becomes brighter while another becomes darker."""
        least = 3.0 * self.noise + CHANGED
        apart = (self.log > least).any(0, keepdim=True) & (self.log < -least).any(0, keepdim=True)
        return 1.0 - _share(apart[self.inside])

    @property
    def same(self) -> float:
        """Share of the pixels in which no channel changes."""
        return _share((self.log.abs() <= 3.0 * self.noise + CHANGED).all(0, keepdim=True)[self.inside])


def moved(a: Image, b: Image, ab: Image, valid: Mask) -> Component | None:
    """The component of B that AB has and A has not, as far as pictures tell; None where they are alike, grey, or too grainy.

    White lights leave a grey ratio, highlights on a part of the ball. A reflected environment makes AB over A rough and AB over B
    smooth but for edges. Another form brightens and darkens all channels of the old paint together, and somewhere leaves them
    as they were; another paint does not.

    Args:
        a, b, ab: (3, 256, 256) in [0, 1]. valid: (1, 256, 256), pixels that count in all of them.
    """
    own, other = Ratio.of(ab, a, valid), Ratio.of(ab, b, valid)
    color = own.color
    if own.changed < LEAST or Ratio.of(a, torch.zeros_like(a), valid).color < GREY:
        return None
    if color < GREY:
        return Component.RIM if own.changed > COMPACT else Component.HIGHLIGHTS
    is_clean = own.grain < CLEAN
    is_rougher = own.roughness + SLACK > (ROUGHER if is_clean else ROUGHER_GRAINY) * (other.roughness + SLACK)
    if color < COLORED and own.roughness > ROUGH and is_rougher:
        return Component.ENVIRONMENT
    if not is_clean:
        return None
    return Component.DIFFUSE if own.together > TOGETHER and own.same > LEAST else Component.ALBEDO


def _quantile(numbers: torch.Tensor, share: float) -> float:
    return float(numbers.kthvalue(max(1, math.ceil(share * len(numbers)))).values) if len(numbers) else 0.0


def _share(chosen: torch.Tensor) -> float:
    return float(chosen.double().mean()) if len(chosen) else 0.0
