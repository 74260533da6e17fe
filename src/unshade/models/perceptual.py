"""Shift-tolerant perceptual features: VGG16 and AlexNet with blurred pooling, their weights read from an installed wheel.

The weight files lie in the wheel ``stlpips-pytorch`` 0.0.2 (Ghildyal and Liu, "Shift-tolerant Perceptual Similarity
Metric", ECCV 2022). Its code is never imported; the layers are written here from the papers and the files' shapes.
"""

from __future__ import annotations

import importlib.util
import pickle
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from unshade.errors import MissingExtraError, did_you_mean
from unshade.types import Image

Net: TypeAlias = Literal["vgg", "alex"]

MIN_SIDE = {"vgg": 32, "alex": 32}
"""Smallest pictures that the pooling leaves something of."""


@dataclass(frozen=True)
class _Convolution:
    """A convolution, a ReLU after it; ``blurs`` puts the blurred subsampling between the two."""

    key: str
    padding: int
    blurs: bool = False


_Pool: TypeAlias = int
"""The window of a max pooling at stride 1 that a blurred subsampling follows."""

_LAYERS: dict[str, tuple[tuple[_Convolution | _Pool, ...], ...]] = {
    "vgg": (
        (_Convolution("net.slice1.0", 1), _Convolution("net.slice1.2", 1)),
        (2, _Convolution("net.slice2.6", 1), _Convolution("net.slice2.8", 1)),
        (2, _Convolution("net.slice3.12", 1), _Convolution("net.slice3.14", 1), _Convolution("net.slice3.16", 1)),
        (2, _Convolution("net.slice4.20", 1), _Convolution("net.slice4.22", 1), _Convolution("net.slice4.24", 1)),
        (2, _Convolution("net.slice5.28", 1), _Convolution("net.slice5.30", 1), _Convolution("net.slice5.32", 1)),
    ),
    "alex": (
        (_Convolution("net.slice1.0", 2, blurs=True),),
        (3, _Convolution("net.slice2.5", 2)),
        (3, _Convolution("net.slice3.9", 1)),
        (_Convolution("net.slice4.11", 1),),
        (_Convolution("net.slice5.13", 1),),
    ),
}
"""Five stages a net; a feature map is taken at the end of each."""


def weight_file(net: Net = "vgg") -> Path:
    """Where the weights of a net lie. Raises MissingExtraError; imports nothing."""
    if net not in _LAYERS:
        raise ValueError(f"unknown net {net!r}{did_you_mean(net, _LAYERS)}")
    found = importlib.util.find_spec("stlpips_pytorch")
    folders = list(found.submodule_search_locations or []) if found else []
    for folder in folders:
        path = Path(folder) / "weights" / "vST0.0" / f"{net}_shift_tolerant.pth"
        if path.is_file():
            return path
    raise MissingExtraError(
        "perceptual figures need the weight files of stlpips-pytorch 0.0.2; install them with: pip install 'unshade[perceptual]'"
    )


@lru_cache(maxsize=4)
def _weights(net: Net, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    path = weight_file(net)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise MissingExtraError(
            f"{path}: the weight file is damaged ({type(error).__name__}); install stlpips-pytorch 0.0.2 again"
        ) from None
    wanted = [
        f"{layer.key}.{part}" for stage in _LAYERS[net] for layer in stage if isinstance(layer, _Convolution) for part in ("weight", "bias")
    ]
    wanted += ["scaling_layer.shift", "scaling_layer.scale", *(f"lin{k}.model.1.weight" for k in range(5))]
    missing = [key for key in wanted if key not in state]
    if missing:
        raise MissingExtraError(f"{path}: expected the weights of stlpips-pytorch 0.0.2, missing {missing[0]}")
    return {key: state[key].to(device, dtype) for key in wanted}


def _blurred(maps: Tensor) -> Tensor:
    """Every second pixel of the maps after a binomial 3 x 3 blur, two pixels of reflection around them (Zhang 2019)."""
    taps = maps.new_tensor([0.25, 0.5, 0.25])
    kernel = (taps[:, None] * taps).expand(maps.shape[1], 1, 3, 3)
    return F.conv2d(F.pad(maps, (2, 2, 2, 2), mode="reflect"), kernel, stride=2, groups=maps.shape[1])


def features(images: Image, net: Net = "vgg") -> list[Tensor]:
    """The feature maps of a net's five stages, differentiable in the images.

    Args:
        images: (B, 3, H, W) display-encoded in [0, 1], at least 32 x 32.
        net: ``vgg`` or ``alex``.
    Returns:
        five tensors (B, C, h, w).
    Raises:
        MissingExtraError: the weights are not installed. ValueError: another shape.
    """
    if images.ndim != 4 or images.shape[1] != 3 or min(images.shape[-2:]) < MIN_SIDE.get(net, 1):
        raise ValueError(f"features: expected (B, 3, H, W) images of at least 32 x 32 pixels, got {tuple(images.shape)}")
    weights = _weights(net, images.device, images.dtype)
    maps = (2.0 * images - 1.0 - weights["scaling_layer.shift"]) / weights["scaling_layer.scale"]
    taken = []
    for stage in _LAYERS[net]:
        for layer in stage:
            if isinstance(layer, _Convolution):
                maps = F.conv2d(maps, weights[f"{layer.key}.weight"], weights[f"{layer.key}.bias"], padding=layer.padding)
                maps = F.relu(_blurred(maps) if layer.blurs else maps)
            else:
                maps = _blurred(F.max_pool2d(maps, kernel_size=layer, stride=1))
        taken.append(maps)
    return taken


def vgg_features(images: Image) -> list[Tensor]:
    """`features` of VGG16: (B, 3, H, W) in [0, 1] to five (B, C, h, w)."""
    return features(images, "vgg")


def distance(a: Image, b: Image, net: Net = "vgg") -> Tensor:
    """Shift-tolerant LPIPS of pairs of images, 0 for equal ones, differentiable.

    Args:
        a, b: (B, 3, H, W) in [0, 1].
    Returns:
        (B,) from 0 up.
    Source: Ghildyal and Liu 2022; the form is that of Zhang et al. 2018, equation 1.
    """
    weights = _weights(net, a.device, a.dtype)
    total = a.new_zeros(a.shape[0])
    for k, (first, second) in enumerate(zip(features(a, net), features(b, net), strict=True)):
        difference = (_normalised(first) - _normalised(second)).square()
        total = total + F.conv2d(difference, weights[f"lin{k}.model.1.weight"]).mean(dim=(1, 2, 3))
    return total


def _normalised(maps: Tensor) -> Tensor:
    """Unit length across the channels."""
    # The constant under the root keeps the gradient finite where all channels are 0.
    return maps / ((maps.square().sum(1, keepdim=True) + 1e-20).sqrt() + 1e-10)
