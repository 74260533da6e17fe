"""PDF: the same vector drawing as `svg`, in the terms of PDF 1.7.

| tree | PDF |
|---|---|
| node | isolated transparency group (a form), and an optional content group of its name, so that viewers list it as a layer |
| multiply, screen | children over the first with the blend mode ``Multiply`` or ``Screen`` |
| mix | right, and over it left with a soft mask of the mask's luminosity |
| albedo | a filled square, clipped with all else to the sphere or the shape |
| other parametric leaf | axial and radial shadings, clipped to paths |
| raster leaf | an image |
"""

from __future__ import annotations

import io
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unshade.errors import MissingExtraError
from unshade.export.scene import WHITE, Art, Color, Item, Picture, Plain, scene
from unshade.export.shape import Shape, read_shape
from unshade.export.svg import ramp_stops
from unshade.export.vectors import Beyond, Ellipse, Fill, Linear, Radial, Ramp, Stops
from unshade.files import write_whole
from unshade.nodes import Tree

if TYPE_CHECKING:
    import pikepdf

MODES = {"normal": "Normal", "multiply": "Multiply", "screen": "Screen", "color-dodge": "ColorDodge"}
BOX = (-1.1, -1.1, 1.1, 1.1)
ALL = "-1.1 -1.1 2.2 2.2 re"
OPERATORS = {"M": "m", "L": "l", "C": "c", "Z": "h"}
QUARTER = 4.0 / 3.0 * (math.sqrt(2.0) - 1.0)
"""How far a cubic curve's handles reach that draws a quarter of a circle."""


def write_pdf(tree: Tree, path: Path, size: int = 512, shape: Path | None = None, region: str | None = None) -> None:
    """One page with a sphere ``size`` points wide, or with a closed path of an SVG, in its place there.

    Raises MissingExtraError, PictureError for a shape that cannot be read.
    """
    try:
        import pikepdf
    except ImportError:
        raise MissingExtraError(f"{path}: PDF needs the pikepdf library; install it with: pip install 'unshade[export]'") from None
    found = None if shape is None else read_shape(shape, region)
    with pikepdf.new() as document:
        _Writer(document, pikepdf).page(tree, size, found)
        stored = io.BytesIO()
        document.save(stored, object_stream_mode=pikepdf.ObjectStreamMode.generate, compress_streams=True, deterministic_id=True)
    write_whole(path, stored.getvalue())


def _text(*numbers: float) -> str:
    return " ".join(f"{value:.5f}".rstrip("0").rstrip(".") if abs(value) >= 5e-6 else "0" for value in numbers)


class _Writer:
    """Turns items into forms of one document."""

    def __init__(self, document: pikepdf.Pdf, library: Any) -> None:
        self.document, self.library = document, library
        self.ramps: dict[Ramp, Any] = {}
        self.functions: dict[tuple[Stops, Color], Any] = {}
        self.layers: list[Any] = []

    def page(self, tree: Tree, size: int, shape: Shape | None) -> None:
        """The one page."""
        pike = self.library
        if shape is None:
            width = height = float(size)
            clip, frame = f"{_ellipse(size / 2, size / 2, size / 2, size / 2)} W n", _text(size / 2, 0, 0, size / 2, size / 2, size / 2)
        else:
            x, y, width, height = shape.view
            flip = f"1 0 0 -1 {_text(-x, y + height)} cm"
            clip, frame = f"{flip} {_path(shape.path)} W* n", _text(shape.rx, 0, 0, -shape.ry, shape.cx, shape.cy)
        form, order = self.form(scene(tree))
        page = self.document.add_blank_page(page_size=(width, height))
        page.Contents = self.document.make_stream(f"q {clip} {frame} cm /X Do Q".encode())
        page.Resources = pike.Dictionary(XObject=pike.Dictionary(X=form))
        page.Group = pike.Dictionary(S=pike.Name.Transparency, CS=pike.Name.DeviceRGB, I=True)
        names = pike.Dictionary(OCGs=pike.Array(self.layers), D=pike.Dictionary(Order=order, ON=pike.Array(self.layers)))
        self.document.Root.OCProperties = names

    def form(self, item: Item) -> tuple[Any, Any]:
        """The form of an item's content, and the layers in it for the viewer's list."""
        parts: list[str] = []
        resources: dict[str, dict[str, Any]] = {"XObject": {}, "ExtGState": {}, "Shading": {}, "Properties": {}}
        order: list[Any] = []
        content = item.content
        if isinstance(content, tuple):
            for k, child in enumerate(content):
                form, below = self.form(child)
                resources["XObject"][f"/X{k}"] = form
                resources["ExtGState"][f"/G{k}"] = self.state(child)
                parts.append(f"q /G{k} gs /X{k} Do Q")
                order += below
        elif isinstance(content, Plain):
            parts.append(f"{_text(*content.color)} rg {ALL} f")
        elif isinstance(content, Picture):
            resources["XObject"]["/I"] = self.image(content)
            parts.append("q 2 0 0 2 -1 -1 cm /I Do Q")
        else:
            self.art(content, parts, resources)
        if item.label:
            layer = self.document.make_indirect(self.library.Dictionary(Type=self.library.Name.OCG, Name=item.label))
            self.layers.append(layer)
            resources["Properties"]["/L"] = layer
            parts = ["/OC /L BDC", *parts, "EMC"]
            order = [layer, self.library.Array(order)] if order else [layer]
        return self.stream(parts, resources), self.library.Array(order) if not item.label else order

    def stream(self, parts: list[str], resources: dict[str, dict[str, Any]]) -> Any:
        pike = self.library
        form = self.document.make_stream("\n".join(parts).encode())
        form.Type, form.Subtype, form.BBox = pike.Name.XObject, pike.Name.Form, pike.Array(BOX)
        form.Group = pike.Dictionary(S=pike.Name.Transparency, CS=pike.Name.DeviceRGB, I=True, K=False)
        form.Resources = pike.Dictionary({f"/{name}": pike.Dictionary(found) for name, found in resources.items() if found})
        return form

    def state(self, item: Item) -> Any:
        """How an item is blended with what is below it."""
        pike = self.library
        state = pike.Dictionary(BM=pike.Name(f"/{MODES[item.mode]}"), ca=item.opacity, CA=item.opacity)
        if item.mask is not None:
            form, _ = self.form(Item(item.mask.content))
            state.SMask = pike.Dictionary(S=pike.Name.Luminosity, G=form)
        return state

    def art(self, art: Art, parts: list[str], resources: dict[str, dict[str, Any]]) -> None:
        cosine, sine = math.cos(art.angle), math.sin(art.angle)
        parts.append(f"{_text(cosine, sine, -sine, cosine, 0, 0)} cm")
        for k, fill in enumerate(art.drawing):
            parts.append("q")
            if fill.ramp is not None:
                name = f"/R{round(1000 * fill.ramp.clear)}-{round(1000 * fill.ramp.full)}"
                resources["ExtGState"][name] = self.ramp(fill.ramp)
                parts.append(f"{name} gs")
            if fill.multiply:
                resources["ExtGState"]["/M"] = self.library.Dictionary(BM=self.library.Name.Multiply)
                parts.append("/M gs")
            parts.append(self.fill(fill, art.tint, f"/S{k}", resources["Shading"]))
            parts.append("Q")

    def fill(self, fill: Fill, tint: Color, name: str, shadings: dict[str, Any]) -> str:
        paint, outline = fill.paint, _outline(fill)
        if not isinstance(paint, Linear | Radial):
            return f"{_text(*(paint.value * part for part in tint))} rg {outline} f"
        shadings[name] = self.shading(paint, tint)
        stretch = f"1 0 0 {_text(paint.aspect)} 0 0 cm " if isinstance(paint, Radial) and paint.aspect != 1.0 else ""
        return f"{outline} W n {stretch}{name} sh"

    def shading(self, paint: Linear | Radial, tint: Color) -> Any:
        pike = self.library
        axial = isinstance(paint, Linear)
        ends = (paint.start, 0, paint.end, 0) if isinstance(paint, Linear) else (paint.focus, 0, 0, paint.center, 0, paint.radius)
        return pike.Dictionary(
            ShadingType=2 if axial else 3,
            ColorSpace=pike.Name.DeviceRGB,
            Coords=pike.Array([round(float(value), 5) for value in ends]),
            Function=self.function(paint.stops, tint),
            Extend=pike.Array([True, True]),
        )

    def function(self, stops: Stops, tint: Color) -> Any:
        """Straight lines from stop to stop; the first and the last are continued to 0 and 1."""
        if (stops, tint) in self.functions:
            return self.functions[stops, tint]
        pike = self.library
        points = [(0.0, stops[0][1])] * (stops[0][0] > 0.0) + list(stops) + [(1.0, stops[-1][1])] * (stops[-1][0] < 1.0)
        colors = [pike.Array([round(value * part, 5) for part in tint]) for _, value in points]
        pieces = [
            pike.Dictionary(FunctionType=2, Domain=pike.Array([0, 1]), C0=first, C1=second, N=1) for first, second in pairwise(colors)
        ]
        bounds = pike.Array([round(offset, 6) for offset, _ in points[1:-1]])
        encode = pike.Array([0, 1] * len(pieces))
        made = pike.Dictionary(FunctionType=3, Domain=pike.Array([0, 1]), Functions=pike.Array(pieces), Bounds=bounds, Encode=encode)
        self.functions[stops, tint] = self.document.make_indirect(made if len(pieces) > 1 else pieces[0])
        return self.functions[stops, tint]

    def ramp(self, ramp: Ramp) -> Any:
        """The soft mask of a strip."""
        if ramp not in self.ramps:
            pike = self.library
            shading = self.shading(Radial(0.0, 1.0, 1.0, 0.0, tuple(ramp_stops(ramp))), WHITE)
            form = self.stream([f"{ALL} W n /S sh"], {"Shading": {"/S": shading}})
            state = pike.Dictionary(SMask=pike.Dictionary(S=pike.Name.Luminosity, G=form))
            self.ramps[ramp] = self.document.make_indirect(state)
        return self.ramps[ramp]

    def image(self, picture: Picture) -> Any:
        pike = self.library
        pixels = np.round(np.moveaxis(picture.pixels.numpy(), 0, -1) * 255).astype(np.uint8)
        stream = self.document.make_stream(pixels.tobytes())
        stream.Type, stream.Subtype = pike.Name.XObject, pike.Name.Image
        stream.Height, stream.Width = pixels.shape[:2]
        stream.BitsPerComponent = 8
        stream.ColorSpace, stream.Interpolate = pike.Name.DeviceRGB, True
        return stream


def _ellipse(cx: float, cy: float, rx: float, ry: float) -> str:
    turns = ((1, 0), (0, 1), (-1, 0), (0, -1), (1, 0))
    parts = [f"{_text(cx + rx, cy)} m"]
    for (a, b), (c, d) in pairwise(turns):
        handles = (a + QUARTER * c, b + QUARTER * d, c + QUARTER * a, d + QUARTER * b, c, d)
        parts.append(f"{_text(*((cx + rx * h if k % 2 == 0 else cy + ry * h) for k, h in enumerate(handles)))} c")
    return " ".join([*parts, "h"])


def _outline(fill: Fill) -> str:
    if fill.shape is None:
        return ALL
    if isinstance(fill.shape, Ellipse):
        return _ellipse(fill.shape.center, 0.0, fill.shape.rx, fill.shape.ry)
    return _beyond(fill.shape)


def _beyond(shape: Beyond) -> str:
    """As `svg` has it, the arc in eight cubic curves."""
    ellipse, u = shape.ellipse, min(max(shape.tangent, -1.0), 1.0)
    v = math.sqrt(1.0 - u * u)
    first = math.atan2(v / ellipse.ry, (u - ellipse.center) / ellipse.rx)
    turns = np.linspace(first, 2.0 * math.pi - first, 9)
    reach = 4.0 / 3.0 * math.tan((turns[1] - turns[0]) / 4.0)
    parts = [f"{_text(u, v)} m"]
    for a, b in pairwise(turns):
        handles = [(math.cos(a) - reach * math.sin(a), math.sin(a) + reach * math.cos(a))]
        handles += [(math.cos(b) + reach * math.sin(b), math.sin(b) - reach * math.cos(b)), (math.cos(b), math.sin(b))]
        parts.append(f"{' '.join(_text(ellipse.center + ellipse.rx * x, ellipse.ry * y) for x, y in handles)} c")
    around = ((2 * u, -2 * v), (3, -3), (3, 3), (2 * u, 2 * v))
    return " ".join([*parts, *(f"{_text(x, y)} l" for x, y in around), "h"])


def _path(data: str) -> str:
    """SVG path data in absolute moves, lines and curves as PDF operators; a quadratic curve as the cubic that it is."""
    here, parts = (0.0, 0.0), []
    for letter, text in re.findall(r"([MLCQZ])([^MLCQZ]*)", data):
        numbers = [float(number) for number in re.findall(r"[-+.\deE]+", text)]
        if letter == "Q":
            (x1, y1, x, y), letter = numbers, "C"
            numbers = [(here[0] + 2 * x1) / 3, (here[1] + 2 * y1) / 3, (x + 2 * x1) / 3, (y + 2 * y1) / 3, x, y]
        parts.append(f"{_text(*numbers)} {OPERATORS[letter]}".strip())
        here = (numbers[-2], numbers[-1]) if numbers else here
    return " ".join(parts)
