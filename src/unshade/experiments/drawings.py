"""Balls as people draw them in vector programs: flat shapes and gradients, no shading formula. What the grammar cannot say exactly."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image as PILImage
from PIL import ImageDraw, ImageFilter

from unshade.pictures import SIZE
from unshade.types import Image

SUPERSAMPLED = 4
EDGE = SIZE * SUPERSAMPLED

Color = tuple[int, int, int]
Canvas = PILImage.Image


def _oval(
    canvas: Canvas, center: tuple[float, float], radii: tuple[float, float], color: Color, opacity: float = 1.0, soft: float = 0.0
) -> Canvas:
    """A flat oval over the canvas; places and radii in units of the ball's radius, y up, ``soft`` a blur of its edge."""
    shape = PILImage.new("L", canvas.size, 0)
    (x, y), (across, up), half = center, radii, EDGE / 2
    box = (half * (1 + x - across), half * (1 - y - up), half * (1 + x + across), half * (1 - y + up))
    ImageDraw.Draw(shape).ellipse(box, fill=round(255 * opacity))
    if soft:
        shape = shape.filter(ImageFilter.GaussianBlur(soft * half))
    return PILImage.composite(PILImage.new("RGB", canvas.size, color), canvas, shape)


def _radial(center: tuple[float, float], stops: list[tuple[float, Color]]) -> Canvas:
    """A radial gradient, stops by distance in units of the ball's radius."""
    steps = (np.arange(EDGE) + 0.5) / EDGE * 2.0 - 1.0
    distance = np.hypot(steps[None, :] - center[0], steps[:, None] + center[1])
    places, colors = [place for place, _ in stops], np.array([color for _, color in stops], dtype=np.float64)
    channels: list[NDArray[np.float64]] = [np.interp(distance, places, colors[:, k]) for k in range(3)]
    return PILImage.fromarray(np.stack(channels, axis=-1).round().astype(np.uint8))


def cel() -> Canvas:
    """Three flat tones, an oval light, a drawn outline."""
    canvas = PILImage.new("RGB", (EDGE, EDGE), (30, 24, 40))
    canvas = _oval(canvas, (0, 0), (0.95, 0.95), (120, 40, 60))
    canvas = _oval(canvas, (-0.12, 0.14), (0.76, 0.76), (214, 72, 84))
    canvas = _oval(canvas, (-0.2, 0.24), (0.5, 0.5), (240, 118, 110))
    return _oval(canvas, (-0.36, 0.44), (0.16, 0.11), (255, 246, 236))


def button() -> Canvas:
    """A glossy button: radial gradient, white gloss over the upper half, glow from below."""
    canvas = _radial((0, -0.4), [(0.0, (120, 210, 255)), (0.8, (20, 96, 200)), (1.4, (6, 30, 90))])
    canvas = _oval(canvas, (0, 0.46), (0.72, 0.44), (255, 255, 255), 0.5)
    return _oval(canvas, (0, -0.72), (0.5, 0.18), (190, 240, 255), 0.6, 0.06)


def pearl() -> Canvas:
    """Gradients only: an off-centre ball, a soft light, a coloured reflex."""
    canvas = _radial((-0.3, 0.35), [(0.0, (255, 250, 240)), (0.35, (232, 214, 206)), (0.9, (150, 120, 130)), (1.5, (52, 36, 56))])
    canvas = _oval(canvas, (0.45, -0.55), (0.3, 0.22), (255, 190, 150), 0.55, 0.09)
    return _oval(canvas, (-0.34, 0.42), (0.14, 0.14), (255, 255, 255), 0.95, 0.03)


def planet() -> Canvas:
    """Two bands of paint below one soft shadow."""
    canvas = PILImage.new("RGB", (EDGE, EDGE), (226, 170, 96))
    pen = ImageDraw.Draw(canvas)
    for low, high, color in ((0.18, 0.4, (172, 100, 60)), (-0.5, -0.22, (196, 126, 74))):
        pen.rectangle((0, EDGE / 2 * (1 - high), EDGE, EDGE / 2 * (1 - low)), fill=color)
    shadow = PILImage.new("L", canvas.size, 190)
    ImageDraw.Draw(shadow).ellipse((-0.25 * EDGE, -0.3 * EDGE, 0.8 * EDGE, 0.75 * EDGE), fill=0)
    shadow = shadow.filter(ImageFilter.GaussianBlur(0.07 * EDGE))
    return PILImage.composite(PILImage.new("RGB", canvas.size, (24, 20, 54)), canvas, shadow)


DRAWINGS = {"cel": cel, "button": button, "pearl": pearl, "planet": planet}


def drawing(name: str) -> Image:
    """One of `DRAWINGS` as a square, (3, 256, 256) in 8 bits; its sphere is the inscribed disc."""
    small = DRAWINGS[name]().resize((SIZE, SIZE), PILImage.Resampling.BOX)
    return torch.from_numpy(np.asarray(small, dtype=np.float32) / 255.0).permute(2, 0, 1).contiguous()
