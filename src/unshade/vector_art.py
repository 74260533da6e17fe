"""One shape of an SVG: lift it off as pixels, and give it other pixels back in its place.

The drawing itself is drawn by resvg, an optional library. Only the shape or group asked for is drawn, whatever lies over it, with the
transforms of the groups around it; their opacity, masks and filters stay where they are and act again when it is given back.
"""

from __future__ import annotations

import base64
import copy
import io
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image as PILImage

from unshade.errors import MissingExtraError, PictureError, did_you_mean
from unshade.reflectance import Array

SVG = "http://www.w3.org/2000/svg"
XLINK = "http://www.w3.org/1999/xlink"
SIDE = 768
"""Pixels that the longer side of a shape is drawn with."""

LOOK = 1024
MOST = 6000
"""Longer side of the whole drawing, to find the shape and at most."""

DRAWN = {"g", "svg", "a", "path", "rect", "circle", "ellipse", "polygon", "polyline", "line", "text", "use", "image", "switch"}
KEPT_APART = ("opacity", "mask", "clip-path", "filter", "mix-blend-mode", "isolation")
LENGTH = re.compile(r"\s*([0-9.eE+-]+)\s*(px|pt|pc|mm|cm|in|)\s*")
UNITS = {"": 1.0, "px": 1.0, "pt": 4 / 3, "pc": 16.0, "mm": 96 / 25.4, "cm": 96 / 2.54, "in": 96.0}
TRANSFORM = re.compile(r"(\w+)\s*\(([^)]*)\)")


@dataclass(frozen=True)
class Shape:
    """A shape as pixels: ``rgb`` (H, W, 3) and ``alpha`` (H, W) in [0, 1], and where they lie in the drawing: x, y, width, height."""

    rgb: Array
    alpha: Array
    box: tuple[float, float, float, float]


@dataclass(frozen=True)
class Drawing:
    """A parsed SVG and its user space: x, y, width, height."""

    path: Path
    root: ET.Element
    view: tuple[float, float, float, float]

    @staticmethod
    def read(path: str | Path) -> Drawing:
        """Raises PictureError for anything but an SVG with a size."""
        path = Path(path)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise PictureError(f"{path}: no such file") from None
        except OSError as error:
            raise PictureError(f"{path}: cannot be read ({error.strerror or error})") from None
        try:
            root = ET.fromstring(data)
        except ET.ParseError as error:
            raise PictureError(f"{path}: expected an SVG, got something that is no XML ({error})") from None
        if root.tag != f"{{{SVG}}}svg":
            raise PictureError(f"{path}: expected an SVG, got <{root.tag.rpartition('}')[2]}>")
        return Drawing(path, root, _view(path, root))

    @property
    def ids(self) -> list[str]:
        """Of what is drawn, not of what is only defined."""
        return [name for name, chain in self._chains().items() if _is_drawn(chain)]

    def lift(self, region: str) -> Shape:
        """Draw one shape or group alone. Raises PictureError, MissingExtraError."""
        chain = self._chain(region)
        alone = self._alone(chain)
        small = self._draw(alone, LOOK)
        box = _bounds(small[..., 3])
        if box is None:
            raise PictureError(f"{self.path}: #{region} draws nothing that can be seen inside the drawing")
        part = max(box[2] - box[0], box[3] - box[1]) / max(small.shape[:2])
        large = self._draw(alone, min(MOST, math.ceil(SIDE / part)))
        box = _bounds(large[..., 3])
        assert box is not None
        left, top, right, bottom = box
        pixels = large[top:bottom, left:right]
        scale = self.view[2] / large.shape[1], self.view[3] / large.shape[0]
        place = (self.view[0] + left * scale[0], self.view[1] + top * scale[1], (right - left) * scale[0], (bottom - top) * scale[1])
        return Shape(pixels[..., :3], pixels[..., 3], place)

    def give_back(self, region: str, shape: Shape) -> str:
        """The drawing's text with a shape's pixels in the place of the shape, under its id and in its order."""
        root = copy.deepcopy(self.root)
        chain = Drawing(self.path, root, self.view)._chain(region)
        target, parent = chain[-1], chain[-2]
        inverse = np.linalg.inv(_matrix(self.path, chain[1:-1]))
        x, y, width, height = shape.box
        group = ET.Element(f"{{{SVG}}}g", {"id": region, "transform": _written(inverse)})
        pixels = np.concatenate([shape.rgb, shape.alpha[..., None]], axis=-1)
        buffer = io.BytesIO()
        PILImage.fromarray(np.round(pixels.clip(0, 1) * 255).astype(np.uint8)).save(buffer, "PNG", optimize=True)
        href = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
        numbers = {"x": x, "y": y, "width": width, "height": height}
        attributes = {name: f"{number:.6g}" for name, number in numbers.items()}
        ET.SubElement(group, f"{{{SVG}}}image", {**attributes, f"{{{XLINK}}}href": href, "preserveAspectRatio": "none"})
        group.tail = target.tail
        parent[list(parent).index(target)] = group
        return _text(root)

    def _chains(self) -> dict[str, list[ET.Element]]:
        """For every id the elements from the root to its own."""
        found: dict[str, list[ET.Element]] = {}
        stack = [[self.root]]
        while stack:
            chain = stack.pop()
            name = chain[-1].get("id")
            if name is not None:
                found.setdefault(name, chain)
            stack += [[*chain, child] for child in reversed(list(chain[-1]))]
        return found

    def _chain(self, region: str) -> list[ET.Element]:
        chains = self._chains()
        drawn = {name: chain for name, chain in chains.items() if _is_drawn(chain)}
        if region not in drawn:
            reason = "is only defined, not drawn" if region in chains else "is not there"
            known = did_you_mean(region, drawn) if drawn else "; nothing that is drawn has an id"
            raise PictureError(f"{self.path}: the region #{region} {reason}{known}")
        if len(drawn[region]) < 2:
            raise PictureError(f"{self.path}: #{region} is the whole drawing; expected a shape or a group in it")
        return drawn[region]

    def _alone(self, chain: list[ET.Element]) -> ET.Element:
        """A copy in which only the last of the chain is drawn."""

        def kept(element: ET.Element) -> ET.Element | None:
            if element is chain[-1] or _name(element) not in DRAWN:
                return copy.deepcopy(element)
            if not any(element is link for link in chain):
                return None
            result = ET.Element(element.tag, {key: value for key, value in element.attrib.items() if key not in KEPT_APART})
            if "style" in result.attrib:
                parts = (part for part in result.attrib["style"].split(";") if part.partition(":")[0].strip() not in KEPT_APART)
                result.set("style", ";".join(parts))
            result.extend(child for own in element if (child := kept(own)) is not None)
            return result

        root = kept(self.root)
        assert root is not None
        x, y, width, height = self.view
        root.attrib.pop("preserveAspectRatio", None)
        root.attrib.update({"viewBox": f"{x} {y} {width} {height}", "width": str(width), "height": str(height)})
        # What the shape refers to by id stays, though it is not drawn: <use> of a shape elsewhere.
        drawn = {element.get("id") for element in root.iter()}
        wanted = {ref for element in root.iter() for key, value in element.attrib.items() for ref in _references(key, value)} - drawn
        definitions = ET.SubElement(root, f"{{{SVG}}}defs")
        definitions.extend(copy.deepcopy(element) for element in self.root.iter() if element.get("id") in wanted)
        return root

    def _draw(self, root: ET.Element, side: int) -> Array:
        """(H, W, 4) in [0, 1], the longer side of the drawing ``side`` pixels."""
        try:
            import resvg_py
        except ImportError:
            raise MissingExtraError(f"{self.path}: SVG needs the resvg library; install it with: pip install 'unshade[svg]'") from None
        zoom = side / max(self.view[2:])
        width, height = (max(1, round(length * zoom)) for length in self.view[2:])
        try:
            wordless = not any(_name(element) == "text" for element in root.iter())
            data = resvg_py.svg_to_bytes(
                svg_string=_text(root),
                width=width,
                height=height,
                resources_dir=str(self.path.parent.resolve()),
                skip_system_fonts=wordless,  # reading them takes seconds
            )
        except ValueError as error:
            raise PictureError(f"{self.path}: cannot be drawn ({str(error).splitlines()[0]})") from None
        with PILImage.open(io.BytesIO(bytes(data))) as image:
            return np.asarray(image.convert("RGBA"), dtype=np.float64) / 255.0


def _name(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def _is_drawn(chain: list[ET.Element]) -> bool:
    return all(_name(element) in DRAWN for element in chain)


def _references(key: str, value: str) -> list[str]:
    if key.rpartition("}")[2] == "href" and value.startswith("#"):
        return [value[1:]]
    return re.findall(r"url\(\s*['\"]?#([^'\")\s]+)", value)


def _text(root: ET.Element) -> str:
    ET.register_namespace("", SVG)
    ET.register_namespace("xlink", XLINK)
    return ET.tostring(root, encoding="unicode")


def _view(path: Path, root: ET.Element) -> tuple[float, float, float, float]:
    numbers = re.split(r"[\s,]+", root.get("viewBox", "").strip())
    try:
        if len(numbers) == 4:
            x, y, width, height = map(float, numbers)
        else:
            lengths = [LENGTH.fullmatch(root.get(side, "")) for side in ("width", "height")]
            x, y = 0.0, 0.0
            width, height = (float(found[1]) * UNITS[found[2]] if found else 0.0 for found in lengths)
    except ValueError:
        width = height = 0.0
    if not (0 < width < 1e7 and 0 < height < 1e7):
        raise PictureError(f"{path}: expected an SVG with a viewBox, or with a width and height")
    return x, y, width, height


def _bounds(alpha: Array) -> tuple[int, int, int, int] | None:
    """Left, top, right, bottom of what can be seen."""
    rows, columns = np.flatnonzero((alpha > 0.004).any(1)), np.flatnonzero((alpha > 0.004).any(0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1) if len(rows) else None


def _matrix(path: Path, chain: list[ET.Element]) -> Array:
    """(3, 3) product of the transforms of a chain of groups."""
    total = np.eye(3)
    for element in chain:
        for word, text in TRANSFORM.findall(element.get("transform", "")):
            try:
                numbers = [float(part) for part in re.split(r"[\s,]+", text.strip()) if part]
                total = total @ _one_matrix(word, numbers)
            except (ValueError, IndexError, KeyError):
                raise PictureError(f"{path}: the transform {word}({text}) cannot be read") from None
    if abs(np.linalg.det(total)) < 1e-12:
        raise PictureError(f"{path}: the groups around the region shrink it to nothing")
    return total


def _one_matrix(word: str, n: list[float]) -> Array:
    if word == "matrix":
        a, b, c, d, e, f = n
    elif word == "translate":
        a, b, c, d, e, f = 1.0, 0.0, 0.0, 1.0, n[0], n[1] if len(n) > 1 else 0.0
    elif word == "scale":
        a, b, c, d, e, f = n[0], 0.0, 0.0, n[1] if len(n) > 1 else n[0], 0.0, 0.0
    elif word == "rotate":
        cosine, sine = math.cos(math.radians(n[0])), math.sin(math.radians(n[0]))
        x, y = (n[1], n[2]) if len(n) > 2 else (0.0, 0.0)
        a, b, c, d, e, f = cosine, sine, -sine, cosine, x - cosine * x + sine * y, y - sine * x - cosine * y
    elif word in ("skewX", "skewY"):
        slope = math.tan(math.radians(n[0]))
        a, b, c, d, e, f = 1.0, slope if word == "skewY" else 0.0, slope if word == "skewX" else 0.0, 1.0, 0.0, 0.0
    else:
        raise KeyError(word)
    return np.array([[a, c, e], [b, d, f], [0.0, 0.0, 1.0]])


def _written(matrix: Array) -> str:
    return "matrix(" + " ".join(f"{matrix[row, column]:.9g}" for column in range(3) for row in range(2)) + ")"
