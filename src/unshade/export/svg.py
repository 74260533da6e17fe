"""SVG: groups, gradients, paths, masks and blend modes; a parametric leaf holds no pixels.

| tree | SVG |
|---|---|
| node | ``<g id="ADDRESS">``, its name as ``inkscape:label`` and ``data-name`` |
| multiply, screen | isolated group; children over the first with ``mix-blend-mode`` |
| mix | right, and over it left in a luminance mask |
| albedo | a filled square, clipped with all else to the sphere or the shape |
| other parametric leaf | `vectors`: gradients and paths in a turned group |
| raster leaf | an embedded PNG |
"""

from __future__ import annotations

import base64
import io
import math
from pathlib import Path

import numpy as np
from PIL import Image as PILImage

from unshade.export.scene import WHITE, Art, Color, Item, Picture, Plain, scene
from unshade.export.shape import Shape, read_shape
from unshade.export.vectors import KNOTS, Beyond, Ellipse, Fill, Linear, Radial, Ramp, Stops, simplified
from unshade.files import write_whole
from unshade.labels import escape
from unshade.nodes import Tree
from unshade.types import Image

ALL = "M-1.1-1.1H1.1V1.1H-1.1z"
"""The path of what has no shape of its own: clipped to the disc at the root."""


def write_svg(tree: Tree, path: Path, size: int = 512, shape: Path | None = None, region: str | None = None) -> None:
    """An SVG of a sphere ``size`` units wide, or of a closed path of another SVG, in its place there."""
    write_whole(path, svg(tree, size, None if shape is None else read_shape(shape, region)).encode())


def svg(tree: Tree, size: int = 512, shape: Shape | None = None) -> str:
    """The document."""
    writer = _Writer()
    body = writer.item(scene(tree))
    if shape is None:
        half = number(size / 2)
        frame, box, where, clip = (
            f"0 0 {size} {size}",
            (float(size), float(size)),
            f"matrix({half} 0 0 -{half} {half} {half})",
            '<circle r="1"/>',
        )
        outer = ""
    else:
        a, b, c, d = (number(part) for part in (shape.rx, -shape.ry, shape.cx, shape.cy))
        frame, box, where = " ".join(map(number, shape.view)), shape.view[2:], f"matrix({a} 0 0 {b} {c} {d})"
        clip, outer = f'<path d="{shape.path}"/>', ' clip-path="url(#outline)"'
    inner = ' clip-path="url(#outline)"' if shape is None else ""
    drawn = f'<g transform="{where}"{inner} style="isolation:isolate">\n{body}</g>'
    if outer:
        drawn = f"<g{outer}>{drawn}</g>"
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" '
        f'viewBox="{frame}" width="{number(box[0])}" height="{number(box[1])}">\n'
        f'<defs><clipPath id="outline">{clip}</clipPath>{writer.definitions()}</defs>\n{drawn}\n</svg>\n'
    )


def svg_of(item: Item) -> str:
    """The bare document of one item on the square around the disc, for use in another format."""
    writer = _Writer()
    body = writer.item(Item(item.content))
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" viewBox="-1 -1 2 2">'
        f'<defs>{writer.definitions()}</defs><g transform="scale(1 -1)">{body}</g></svg>'
    )


def number(value: float, digits: int = 4) -> str:
    """The shortest text of a number: ``.5``, ``-2``."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".") if digits else f"{value:.0f}"
    if text in ("-0", ""):
        return "0"
    return text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text


def color_text(tint: Color, value: float = 1.0) -> str:
    """``#rrggbb`` or ``#rgb``."""
    text = "".join(f"{round(255 * min(max(value * part, 0.0), 1.0)):02x}" for part in tint)
    return f"#{text[::2]}" if text[::2] == text[1::2] else f"#{text}"


def picture_data(pixels: Image) -> str:
    """An 8-bit PNG as a data URL."""
    stored = io.BytesIO()
    PILImage.fromarray(np.round(np.moveaxis(pixels.numpy(), 0, -1) * 255).astype(np.uint8)).save(stored, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(stored.getvalue()).decode()}"


class _Writer:
    """Writes items; gathers the masks that several share. Gradients stand in the group that uses them."""

    def __init__(self) -> None:
        self.ramps: set[Ramp] = set()
        self.gradients = 0

    def definitions(self) -> str:
        """The masks of the strips."""
        return "".join(self.ramp(ramp) for ramp in sorted(self.ramps, key=_ramp_name))

    def ramp(self, ramp: Ramp) -> str:
        name = _ramp_name(ramp)
        stops = "".join(f'<stop offset="{number(t)}" stop-color="{color_text(WHITE, v)}"/>' for t, v in ramp_stops(ramp))
        return (
            f'\n<radialGradient id="g{name}" gradientUnits="userSpaceOnUse" cx="0" cy="0" r="1">{stops}</radialGradient>'
            f'<mask id="{name}" maskUnits="userSpaceOnUse" x="-1.1" y="-1.1" width="2.2" height="2.2">'
            f'<path d="{ALL}" fill="url(#g{name})"/></mask>'
        )

    def item(self, item: Item, mode: str | None = None) -> str:
        """One item as a group."""
        style = [f"mix-blend-mode:{mode or item.mode}"] if (mode or item.mode) != "normal" else []
        content, transform = item.content, ""
        if isinstance(content, tuple):
            style += ["isolation:isolate"] if not style else []
            body = "\n" + "".join(self.item(part) for part in content)
        elif isinstance(content, Plain):
            body = f'<path fill="{color_text(content.color)}" d="{ALL}"/>'
        elif isinstance(content, Picture):
            data = picture_data(content.pixels)
            body = f'<image x="-1" y="-1" width="2" height="2" preserveAspectRatio="none" transform="scale(1 -1)" xlink:href="{data}"/>'
        else:
            if any(fill.multiply for fill in content.drawing) and not style:
                style.append("isolation:isolate")
            transform = f' transform="rotate({number(math.degrees(content.angle), 3)})"' if content.angle else ""
            body = self.art(content)
        names = f' id="{escape(item.address)}"' if item.address else ""
        if item.label:
            names += f' inkscape:label="{escape(item.label)}"' + (f' data-name="{escape(item.label)}"' if item.address else "")
        opacity = f' opacity="{number(item.opacity)}"' if item.opacity < 1.0 else ""
        styled = f' style="{";".join(style)}"' if style else ""
        if item.mask is None:
            return f"<g{names}{opacity}{transform}{styled}>{body}</g>\n"
        name = f"mask-{escape(item.mask.address)}"
        return (
            f'<mask id="{name}" maskUnits="userSpaceOnUse" x="-1.1" y="-1.1" width="2.2" height="2.2">{self.item(item.mask)}</mask>'
            f'<g mask="url(#{name})"><g{names}{transform}{styled}>{body}</g></g>\n'
        )

    def art(self, art: Art) -> str:
        """The fills of a leaf with their gradients before them."""
        written: list[str] = []
        templates: dict[Stops, str] = {}
        for fill in art.drawing:
            paint = self.paint(fill, art.tint, templates, written)
            mask = ""
            if fill.ramp is not None:
                self.ramps.add(fill.ramp)
                mask = f' mask="url(#{_ramp_name(fill.ramp)})"'
            blend = ' style="mix-blend-mode:multiply"' if fill.multiply else ""
            written.append(f'<path fill="{paint}" d="{outline(fill)}"{mask}{blend}/>')
        return "".join(written)

    def paint(self, fill: Fill, tint: Color, templates: dict[Stops, str], written: list[str]) -> str:
        paint = fill.paint
        if not isinstance(paint, Linear | Radial):
            return color_text(tint, paint.value)
        self.gradients += 1
        name = f"p{self.gradients}"
        stops = "".join(f'<stop offset="{number(t)}" stop-color="{color_text(tint, v)}"/>' for t, v in paint.stops)
        if isinstance(paint, Radial):
            stretch = f' gradientTransform="scale(1 {number(paint.aspect)})"' if paint.aspect != 1.0 else ""
            written.append(
                f'<radialGradient id="{name}" gradientUnits="userSpaceOnUse" cx="{number(paint.center)}" cy="0" r="{number(paint.radius)}" '
                f'fx="{number(paint.focus)}" fy="0"{stretch}>{stops}</radialGradient>'
            )
            return f"url(#{name})"
        ends = f'x1="{number(paint.start)}" x2="{number(paint.end)}"'
        if paint.stops in templates:
            written.append(f'<linearGradient id="{name}" {ends} xlink:href="#{templates[paint.stops]}"/>')
        else:
            templates[paint.stops] = name
            written.append(f'<linearGradient id="{name}" gradientUnits="userSpaceOnUse" {ends} y1="0" y2="0">{stops}</linearGradient>')
        return f"url(#{name})"


def _ramp_name(ramp: Ramp) -> str:
    return f"z{round(ramp.clear * KNOTS)}-{round(ramp.full * KNOTS)}"


def ramp_stops(ramp: Ramp) -> list[tuple[float, float]]:
    """A ramp as a radial gradient: radius and brightness."""
    low, high = math.sqrt(1.0 - ramp.clear**2), math.sqrt(1.0 - ramp.full**2)
    return simplified(lambda r: (ramp.clear - np.sqrt(np.clip(1.0 - r * r, 0.0, 1.0))) / (ramp.clear - ramp.full), low, high, 0.006)


def outline(fill: Fill) -> str:
    """The path of a fill's shape."""
    if fill.shape is None:
        return ALL
    ellipse = fill.shape if isinstance(fill.shape, Ellipse) else fill.shape.ellipse
    rx, ry = number(ellipse.rx), number(ellipse.ry)
    if isinstance(fill.shape, Ellipse):
        left, width = number(ellipse.center - ellipse.rx), number(2 * ellipse.rx)
        return f"M{left} 0a{rx} {ry} 0 1 0 {width} 0a{rx} {ry} 0 1 0-{width} 0z"
    return " ".join(_beyond(fill.shape, rx, ry))


def _beyond(shape: Beyond, rx: str, ry: str) -> list[str]:
    """Along the line from one end at the silhouette to the other, then round the light's side outside of the disc."""
    u = min(max(shape.tangent, -1.0), 1.0)
    v = math.sqrt(1.0 - u * u)
    long = int(shape.ellipse.center < u)
    x, y = number(u), number(v)
    return [f"M{x} {y}A{rx} {ry} 0 {long} 1 {x} -{y}L{number(2 * u)} -{number(2 * v)}", f"3-3 3 3 {number(2 * u)} {number(2 * v)}z"]
