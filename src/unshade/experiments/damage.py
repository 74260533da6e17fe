"""What happens to pictures on their way: compression, noise, blur, a disc found in the wrong place, few pixels."""

from __future__ import annotations

import io

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image as PILImage

from unshade.pictures import Disc, SphereImage
from unshade.sphere import disc_mask
from unshade.types import Image

DAMAGES: dict[str, tuple[int, ...]] = {
    "jpeg": (90, 50, 20),
    "noise": (2, 8, 20),
    "blur": (1, 2, 4),
    "shift": (2, 5, 10),
    "size": (32,),
}
"""Quality of a JPEG; deviation of noise in 1/255; deviation of a blur in pixels of 256, the black around the sphere included;
how far the disc is off in percent of the radius; width of the input in pixels."""

CLEAN = "clean"

ALL = (CLEAN, *(f"{kind}:{amount}" for kind, amounts in DAMAGES.items() for amount in amounts))


def damaged(sphere: SphereImage, damage: str, seed: int) -> SphereImage:
    """The sphere of a picture to which something has happened, 8 bits, as a reader would cut it out."""
    kind, _, amount = damage.partition(":")
    if kind == CLEAN:
        return sphere
    image = sphere.image * disc_mask(sphere.size)
    if kind == "jpeg":
        image = _jpeg(image, int(amount))
    elif kind == "noise":
        noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
        image = image + noise * (int(amount) / 255.0)
    elif kind == "blur":
        image = _blurred(image, float(amount))
    elif kind == "shift":
        image = _shifted(image, int(amount) / 100.0)
    elif kind == "size":
        image = F.adaptive_avg_pool2d(image, int(amount))
    image = (image.clamp(0.0, 1.0) * 255.0).round() / 255.0
    half = image.shape[-1] / 2.0
    return SphereImage(image, disc_mask(image.shape[-1]), Disc(half, half, half, 1.0), sphere.exposure)


def _jpeg(image: Image, quality: int) -> Image:
    file = io.BytesIO()
    PILImage.fromarray((image.permute(1, 2, 0).numpy() * 255.0).round().astype(np.uint8)).save(file, "JPEG", quality=quality)
    with PILImage.open(file) as picture:
        return torch.from_numpy(np.asarray(picture, dtype=np.float32) / 255.0).permute(2, 0, 1)


def _blurred(image: Image, deviation: float) -> Image:
    reach = int(4 * deviation)
    taps = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / deviation).square())
    taps = (taps / taps.sum()).expand(3, 1, 1, -1)
    across = F.conv2d(image[None], taps, padding=(0, reach), groups=3)
    return F.conv2d(across, taps.transpose(2, 3), padding=(reach, 0), groups=3)[0]


def _shifted(image: Image, share: float) -> Image:
    """The disc is looked for too far to the upper right, ``share`` of the radius away."""
    step = share / 2.0**0.5
    turn = torch.tensor([[[1.0, 0.0, step], [0.0, 1.0, -step]]])
    grid = F.affine_grid(turn, [1, *image.shape], align_corners=False)
    return F.grid_sample(image[None], grid, align_corners=False)[0]
