"""Shrink lat-long HDRIs to what the package ships: `python scripts/environments.py FOLDER`.

FOLDER holds NAME.exr for each environment of `src/unshade/hdri/sources.json`, which says where the files come from; those of
the npm package are modules with the EXR in base64. Each becomes 128 x 64 scene-linear numbers of half precision, scaled to a
mean of 1.
"""

import json
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import torch
from safetensors.torch import save

from unshade.environments import SOURCES, STORED
from unshade.files import write_whole

WIDTH, HEIGHT = 128, 64
BRIGHTEST = 2000.0


def read(path: Path) -> np.ndarray:
    """(H, W, 3) float64, NaN in blocks of 8 x 8 that the lossy codec spoiled: around a sun it rings, to coloured and negative light."""
    with OpenEXR.File(str(path)) as file:
        pixels = np.asarray(file.channels()["RGB"].pixels, dtype=np.float64)
    negative = (pixels < -np.abs(pixels).mean()).any(-1).reshape(pixels.shape[0] // 8, 8, pixels.shape[1] // 8, 8).any((1, 3))
    return np.where(negative.repeat(8, 0).repeat(8, 1)[..., None], np.nan, pixels.clip(0.0))


def shrink(pixels: np.ndarray) -> np.ndarray:
    """Averages over blocks, (3, HEIGHT, WIDTH). A spoiled pixel becomes the brightest of its row and column within 12 pixels."""
    brightest = pixels
    for axis in (1, 0):
        near = np.stack([np.roll(brightest, shift, axis) for shift in range(-12, 13)])
        brightest = np.fmax.reduce(near, axis=0)
    pixels = np.where(np.isnan(pixels), brightest, pixels)
    rows, columns = pixels.shape[0] // HEIGHT, pixels.shape[1] // WIDTH
    return pixels.reshape(HEIGHT, rows, WIDTH, columns, 3).mean((1, 3)).transpose(2, 0, 1)


def main() -> None:
    folder = Path(sys.argv[1])
    stored = {}
    for source in json.loads(SOURCES.read_text(encoding="utf-8"))["environments"]:
        pixels = shrink(read(folder / f"{source['name']}.exr"))
        weights = np.sin((np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi)[None, :, None]
        pixels = pixels / ((pixels * weights).sum() / (3 * WIDTH * weights.sum()))
        stored[source["name"]] = torch.from_numpy(pixels.clip(max=BRIGHTEST)).half().contiguous()
    write_whole(STORED, save(stored))
    print(f"{STORED}: {len(stored)} environments, {STORED.stat().st_size / 1024:.0f} KB")


if __name__ == "__main__":
    main()
