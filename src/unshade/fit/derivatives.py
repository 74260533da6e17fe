"""Derivatives of the catalogue's formulas, for the second-order fit.

Each function takes the leaf's own ``value`` and ``facing`` (n.l), both (K, N) for K leaves at N pixels, the pixels'
``grazing`` (1 - n.v) and the leaf's scalars (K, 1); it returns the derivative by n.l and then by each scalar, (K, N).
A kind that is not listed here is differentiated by forward-mode automatic differentiation, so that a kind from outside
the package can be fitted too.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.autograd.forward_ad as forward_ad
import torch.nn.functional as F

from unshade.nodes import KINDS
from unshade.shading import SHARPEST_EDGE
from unshade.types import Params

Derivatives = tuple[torch.Tensor, ...]


def diffuse(value: torch.Tensor, facing: torch.Tensor, grazing: torch.Tensor, ambient: Params) -> Derivatives:
    """By n.l and ambient."""
    return (1.0 - ambient) * (facing > 0.0), 1.0 - facing.clamp(min=0.0)


def highlight(value: torch.Tensor, facing: torch.Tensor, grazing: torch.Tensor, sharpness: Params, amplitude: Params) -> Derivatives:
    """By n.l, sharpness and amplitude; 0 on a plateau."""
    open_value = value * (value < 1.0)
    return 2.0 * sharpness * open_value, 2.0 * (facing - 1.0) * open_value, open_value / amplitude.clamp(min=1e-6)


def rim(value: torch.Tensor, facing: torch.Tensor, grazing: torch.Tensor, exponent: Params) -> Derivatives:
    """By n.l and exponent."""
    return grazing**exponent * (facing > 0.0), value * grazing.log()


def _edge(facing: torch.Tensor, low: Params, width: Params) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """smoothstep(low, width, facing): its value, its slope, and the position t in the edge."""
    width = width.clamp(min=SHARPEST_EDGE)
    t = ((facing - low) / width).clamp(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / width, t


def toon_diffuse(
    value: torch.Tensor, facing: torch.Tensor, grazing: torch.Tensor, ambient: Params, threshold: Params, softness: Params
) -> Derivatives:
    """By n.l, ambient, threshold and softness."""
    step, slope, t = _edge(facing, threshold, softness)
    slope = (1.0 - ambient) * slope
    return slope, 1.0 - step, -slope, -slope * t


def toon_highlight(
    value: torch.Tensor, facing: torch.Tensor, grazing: torch.Tensor, radius: Params, brightness: Params, softness: Params
) -> Derivatives:
    """By n.l, radius, brightness and softness; the edge is in angles."""
    cosine = facing.clamp(-1.0 + 1e-7, 1.0 - 1e-7)
    step, slope, t = _edge(cosine.acos(), radius - 0.5 * softness, softness)
    slope = brightness * slope
    return slope / (1.0 - cosine.square()).sqrt(), slope, 1.0 - step, slope * (t - 0.5)


def threshold(value: torch.Tensor, facing: torch.Tensor, grazing: torch.Tensor, threshold: Params, softness: Params) -> Derivatives:
    """By n.l, threshold and softness."""
    _, slope, t = _edge(facing, threshold - 0.5 * softness, softness)
    return slope, -slope, slope * (0.5 - t)


def stripe(
    value: torch.Tensor, facing: torch.Tensor, grazing: torch.Tensor, center: Params, width: Params, softness: Params
) -> Derivatives:
    """By n.l, center, width and softness."""
    offset = facing - center
    _, slope, t = _edge(offset.abs(), 0.5 * (width - softness), softness)
    outward = slope * offset.sign()
    return -outward, outward, 0.5 * slope, slope * (t - 0.5)


ANALYTIC: dict[str, Callable[..., Derivatives]] = {
    function.__name__: function for function in (diffuse, highlight, rim, toon_diffuse, toon_highlight, threshold, stripe)
}


def environment(
    mirrored: torch.Tensor, value: torch.Tensor, direction: Params, sharpness: Params, color: Params, basis: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Derivatives of one environment leaf of L lobes by its directions' tangents, its sharpnesses and its colours.

    Args:
        mirrored: (3, N) mirror directions. value: (3, N) of the leaf. direction, color: (L, 3). sharpness: (L, 1).
        basis: (L, 2, 3) tangents of the directions.
    Returns:
        (L, 2, 3, N), (L, 3, N) and (L, N), the last the derivative of each channel by its own colour.
    """
    toward = F.normalize(direction, dim=-1) @ mirrored
    lobe = torch.exp(-2.0 * sharpness * (1.0 - toward))
    shown = (value < 1.0).to(value.dtype)
    colored = color[..., None] * lobe[:, None] * shown
    across = torch.matmul(basis, mirrored)
    return 2.0 * sharpness[..., None, None] * across[:, :, None] * colored[:, None], 2.0 * (toward - 1.0)[:, None] * colored, lobe


def forward_mode(kind: str, normals: torch.Tensor, parameters: list[torch.Tensor], tangents: list[torch.Tensor]) -> torch.Tensor:
    """Directional derivatives of leaves of a kind, by dual numbers.

    Args:
        normals: (3, 1, N). parameters: one (K, ...) a parameter. tangents: one (D, K, ...) a parameter.
    Returns:
        (D, K, C, N).
    """
    with torch.inference_mode(False), forward_ad.dual_level():  # dual numbers are lost in inference mode
        dual = [forward_ad.make_dual(p.expand_as(t).clone(), t.clone()) for p, t in zip(parameters, tangents, strict=True)]
        tangent = forward_ad.unpack_dual(KINDS[kind].formula(normals, *dual)).tangent
        shape = tangents[0].shape[:2]
    return tangent.expand(*shape, *tangent.shape[-3:])[..., 0, :]
