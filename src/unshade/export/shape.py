"""A closed path of an SVG to be shaded as if it were a sphere: the sphere's picture is stretched over it.

The smallest ellipse around the path that has the proportions of its bounding box takes the place of the disc, so that every
point of the path has a normal; a circle gets exactly the sphere's.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unshade.errors import MissingExtraError, PictureError, did_you_mean


@dataclass(frozen=True)
class Shape:
    """A closed path, +y down, and the ellipse that stands for the sphere."""

    path: str
    """SVG path data in absolute moves, lines and cubic curves."""
    cx: float
    cy: float
    rx: float
    ry: float
    view: tuple[float, float, float, float]
    """x, y, width and height of the document in pixels, in which the path is written."""


def read_shape(path: Path, region: str | None = None) -> Shape:
    """The element ``region`` of an SVG file, or its only shape.

    Raises PictureError where there is no such element, several to choose from, or its path is not closed; MissingExtraError.
    """
    try:
        import svgelements
    except ImportError:
        raise MissingExtraError(f"{path}: shapes need the svgelements library; install it with: pip install 'unshade[export]'") from None
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            document = svgelements.SVG.parse(io.StringIO(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise PictureError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, ValueError, SyntaxError) as error:
        raise PictureError(f"{path}: not an SVG that can be read ({str(error).splitlines()[0]})") from None
    shapes = [element for element in document.elements() if isinstance(element, svgelements.Shape) and len(svgelements.Path(element))]
    if region is not None:
        named = [element for element in shapes if element.id == region]
        if not named:
            raise PictureError(f"{path}: no shape with the id {region!r}{did_you_mean(region, [e.id for e in shapes if e.id])}")
        shapes = named
    if len(shapes) != 1:
        ids = ", ".join(str(element.id) for element in shapes[:6])
        raise PictureError(f"{path}: expected one shape, got {len(shapes)}" + (f"; say which with a region: {ids}" if shapes else ""))
    view = (0.0, 0.0, float(document.width), float(document.height))
    return _fitted(path, svgelements.Path(shapes[0]).reify(), svgelements, view)


def _fitted(file: Path, path: Any, library: Any, view: tuple[float, float, float, float]) -> Shape:
    for part in (library.Path(subpath) for subpath in path.as_subpaths()):
        first, last = part.first_point, part.current_point
        if not isinstance(part[-1], library.Close) and abs(first - last) > 1e-3 * max(view[2:]):
            ends = f"{last.x:g},{last.y:g} and began at {first.x:g},{first.y:g}"
            raise PictureError(f"{file}: expected a closed path, got one that ends at {ends}")
    path.approximate_arcs_with_cubics()
    places = []
    for segment in path:
        if not isinstance(segment, library.Move) and segment.start is not None and segment.end is not None:
            places += [segment.point(t) for t in np.linspace(0.0, 1.0, 17)]
    x, y = (np.array([getattr(place, axis) for place in places], dtype=np.float64) for axis in "xy")
    rx, ry = float(np.ptp(x)) / 2, float(np.ptp(y)) / 2
    if min(rx, ry) <= 0.0:
        raise PictureError(f"{file}: expected a path with an inside, got one {2 * rx:g} wide and {2 * ry:g} high")
    cx, cy = float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2
    reach = max(1.0, float(np.hypot((x - cx) / rx, (y - cy) / ry).max()))
    return Shape(path.d(relative=False), cx, cy, rx * reach, ry * reach, view)
