"""A tree's pictures as PNG data."""

from __future__ import annotations

import base64
import binascii

import numpy as np

from unshade.errors import TreeError
from unshade.nodes import Raster
from unshade.png import PngError, read_png, write_png


def raster_to_png(raster: Raster) -> bytes:
    """A 16-bit PNG that holds the raster's numbers as they are. Raises TreeError for one that no PNG can hold."""
    pixels = np.frombuffer(raster.data, ">u2").reshape(raster.channels, raster.height, raster.width)
    try:
        return write_png(pixels.astype(np.uint16))
    except PngError as error:
        raise TreeError(str(error)) from None


def raster_from_png(data: bytes) -> Raster:
    """The raster of a PNG. Raises TreeError."""
    try:
        pixels = read_png(data)
    except PngError as error:
        raise TreeError(str(error)) from None
    channels, height, width = pixels.shape
    return Raster(channels, height, width, pixels.astype(">u2").tobytes())


def raster_to_base64(raster: Raster) -> str:
    """`raster_to_png` as text."""
    return base64.b64encode(raster_to_png(raster)).decode("ascii")


def raster_from_base64(text: str) -> Raster:
    """The inverse of `raster_to_base64`. Raises TreeError."""
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise TreeError("expected a PNG in base64") from None
    return raster_from_png(data)
