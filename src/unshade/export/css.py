"""CSS: a ``div`` that looks like the tree, in gradients, masks and blend modes; no picture, no script.

| tree | CSS |
|---|---|
| node | ``div`` with its address as ``data-node`` |
| multiply, screen | isolated ``div``; children over the first with ``mix-blend-mode`` |
| mix | right, and over it left with a luminance mask, the drawing of `svg` in a URL |
| albedo | ``background`` |
| other parametric leaf | the drawing of `vectors`: linear gradients, faded by masks; radial gradients; ``clip-path`` |
| raster leaf | an embedded PNG |

CSS has no radial gradient with a focus, so that a band is drawn as a few rings whose centres move.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from urllib.parse import quote

from unshade.export.scene import Color, Item, Picture, Plain, scene
from unshade.export.svg import color_text, number, picture_data, ramp_stops, svg_of
from unshade.export.vectors import Beyond, Ellipse, Fill, Linear, Radial, Stops
from unshade.files import write_whole
from unshade.labels import escape
from unshade.nodes import Tree

RINGS = 10
"""Gradients that a band is drawn with."""

CORNERS = 72
"""Of the polygon that a line of equal brightness is clipped with."""

STYLE = ".shade,.shade div{position:absolute;inset:0}.shade{position:relative;border-radius:50%;overflow:hidden;isolation:isolate}"


def write_css(tree: Tree, path: Path, size: int = 512) -> None:
    """An HTML page with the ``div``, ``size`` pixels wide; it may be copied from there and given any other width."""
    page = f"<!doctype html>\n<meta charset=utf-8>\n<title>unshade</title>\n<style>{STYLE}</style>\n{div(tree, size)}\n"
    write_whole(path, page.encode())


def div(tree: Tree, size: int = 512) -> str:
    """The element; needs `STYLE`."""
    return f'<div class="shade" style="width:{size}px;height:{size}px">\n{_item(scene(tree))}</div>'


def _item(item: Item) -> str:
    style, inner = [], ""
    if item.mode != "normal":
        style.append(f"mix-blend-mode:{item.mode}")
    if item.opacity < 1.0:
        style.append(f"opacity:{number(item.opacity)}")
    content = item.content
    if isinstance(content, tuple):
        style.append("isolation:isolate")
        inner = "\n" + "".join(_item(part) for part in content)
    elif isinstance(content, Plain):
        style.append(f"background:{color_text(content.color)}")
    elif isinstance(content, Picture):
        style.append(f"background:url({picture_data(content.pixels)})0/100% 100%")
    else:
        style += ["isolation:isolate"] * any(fill.multiply for fill in content.drawing)
        style += [f"transform:rotate({number(-math.degrees(content.angle), 3)}deg)"] * (content.angle != 0.0)
        inner = "".join(_fill(fill, content.tint) for fill in content.drawing)
    if item.mask is not None:
        drawn = quote(svg_of(item.mask), safe=" /:=;,()!*+$@?")
        style.append(f'mask:url("data:image/svg+xml,{drawn}")0/100% 100% luminance')
    name = f' data-node="{escape(item.address)}"' if item.address else ""
    styled = f" style='{';'.join(style)}'" if style else ""
    return f"<div{name}{styled}>{inner}</div>\n"


def _fill(fill: Fill, tint: Color) -> str:
    style = [f"background:{_background(fill, tint)}"]
    if fill.ramp is not None:
        stops = ",".join(f"#000000{_alpha(value)} {_percent(radius)}" for radius, value in ramp_stops(fill.ramp))
        style.append(f"mask:radial-gradient(circle closest-side,{stops})")
    if fill.multiply:
        style.append("mix-blend-mode:multiply")
    if isinstance(fill.shape, Ellipse):
        style.append(f"clip-path:ellipse({_half(fill.shape.rx)} {_half(fill.shape.ry)} at {_place(fill.shape.center)} 50%)")
    elif isinstance(fill.shape, Beyond):
        style.append(f"clip-path:polygon({_corners(fill.shape)})")
    return f"<div style='{';'.join(style)}'></div>"


def _percent(share: float) -> str:
    return f"{number(100 * share, 2)}%"


def _place(u: float) -> str:
    """A place on the u axis, from -1 to 1, across the box."""
    return _percent((u + 1) / 2)


def _half(length: float) -> str:
    return _percent(length / 2)


def _alpha(value: float) -> str:
    return f"{round(255 * min(max(value, 0.0), 1.0)):02x}"


def _background(fill: Fill, tint: Color) -> str:
    paint = fill.paint
    if isinstance(paint, Linear):
        return f"linear-gradient(90deg,{_written(paint.stops, tint, (paint.start + 1) / 2, (paint.end - paint.start) / 2)})"
    if not isinstance(paint, Radial):
        return color_text(tint, paint.value)
    if paint.focus == paint.center:
        return _ring(paint, tint, 1.0, paint.stops)
    # From the inside out, the topmost first: each ring is a gradient around its own centre, and ends at the next.
    inner = paint.stops[0][0]
    outer = [inner + (1.0 - inner) * (k + 1) / RINGS for k in range(RINGS)]
    return ",".join(_ring(paint, tint, share, paint.stops, cut=share < 1.0) for share in outer)


def _ring(paint: Radial, tint: Color, share: float, stops: Stops, cut: bool = False) -> str:
    """The gradient's ellipse at an offset, filled with what lies within; transparent outside where it is ``cut``."""
    rx, ry = paint.radius * share, paint.radius * share * paint.aspect
    center = paint.focus + share * (paint.center - paint.focus)
    within = [(offset, value) for offset, value in stops if offset < share]
    edge = _value(stops, share)
    shown = _written((*((offset / share, value) for offset, value in within), (1.0, edge)), tint, 0.0, 1.0)
    end = ",#0000 100%" if cut else ""
    return f"radial-gradient({_half(rx)} {_half(ry)} at {_place(center)} 50%,{shown}{end})"


def _value(stops: Stops, offset: float) -> float:
    for (low, first), (high, second) in pairwise(stops):
        if low <= offset <= high:
            return first + (second - first) * (offset - low) / max(high - low, 1e-9)
    return stops[-1][1]


def _written(stops: Stops, tint: Color, start: float, length: float) -> str:
    written = [f"{color_text(tint, value)} {_percent(start + length * offset)}" for offset, value in stops]
    return ",".join(written if len(written) > 1 else written * 2)


def _corners(shape: Beyond) -> str:
    """The outline of `svg` as a polygon, in percent of the box."""
    ellipse, u = shape.ellipse, min(max(shape.tangent, -1.0), 1.0)
    v = math.sqrt(1.0 - u * u)
    first = math.atan2(v / ellipse.ry, (u - ellipse.center) / ellipse.rx)
    turns = [first + (2.0 * math.pi - 2.0 * first) * k / CORNERS for k in range(CORNERS + 1)]
    places = [(ellipse.center + ellipse.rx * math.cos(turn), ellipse.ry * math.sin(turn)) for turn in turns]
    places += [(2 * u, -2 * v), (3.0, -3.0), (3.0, 3.0), (2 * u, 2 * v)]
    return ",".join(f"{_place(x)} {_percent((1 - y) / 2)}" for x, y in places)
