"""OpenRaster: the layers of `layers` as PNG files with a stack of blend modes, in a ZIP.

| tree | OpenRaster |
|---|---|
| node | layer or isolated stack of its name |
| multiply, screen | ``svg:multiply``, ``svg:screen`` over the first child |
| mix | right, and over it left with the mask as its transparency; with no layer masks, a left side of several nodes is one layer |
| leaf | PNG of 8 or 16 bits |
| sphere | transparency past the silhouette, in a last layer that cuts it out |

Source: the OpenRaster file layout and layer stack specifications, freedesktop.org.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from PIL import Image as PILImage

from unshade.export.layers import blended, disc, layered
from unshade.export.scene import Item, Picture
from unshade.files import write_whole
from unshade.nodes import Tree
from unshade.png import write_png
from unshade.render import render
from unshade.sphere import sphere_normals
from unshade.types import Image, Mask

THUMBNAIL = 256
"""Longest side of the format's small preview."""

EPOCH = (1980, 1, 1, 0, 0, 0)
"""The date of every file inside, so that the same tree gives the same bytes."""


def write_ora(tree: Tree, path: Path, size: int = 512, bits: int | str = 8) -> None:
    """A layered file of ``size`` x ``size`` pixels."""
    files: dict[str, bytes] = {}
    image = ElementTree.Element("image", version="0.0.3", w=str(size), h=str(size), xres="72", yres="72")
    outer = ElementTree.SubElement(image, "stack", name="root")
    _add(outer, layered(tree, size), files, int(bits), disc(size))
    whole = render(tree, sphere_normals(size))
    files["mergedimage.png"] = _png(whole, disc(size), int(bits))
    small = min(size, THUMBNAIL)
    files["Thumbnails/thumbnail.png"] = _png(render(tree, sphere_normals(small)), disc(small), 8)
    stored = io.BytesIO()
    with zipfile.ZipFile(stored, "w") as archive:
        # The type stands first and bare, so that it can be told from the first bytes.
        archive.writestr(zipfile.ZipInfo("mimetype", EPOCH), "image/openraster")
        archive.writestr(zipfile.ZipInfo("stack.xml", EPOCH), ElementTree.tostring(image, encoding="UTF-8", xml_declaration=True))
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, EPOCH), data)
    write_whole(path, stored.getvalue())


def _png(image: Image, alpha: Mask | None, bits: int) -> bytes:
    channels = (image if alpha is None else torch.cat([image, alpha])).clamp(0.0, 1.0).double().numpy()
    if bits == 16:
        return write_png(np.round(channels * 65535).astype(np.uint16))
    stored = io.BytesIO()
    PILImage.fromarray(np.round(np.moveaxis(channels, 0, -1) * 255).astype(np.uint8)).save(stored, format="PNG")
    return stored.getvalue()


def _add(stack: ElementTree.Element, item: Item, files: dict[str, bytes], bits: int, alpha: Mask | None = None) -> None:
    """Put an item on top of a stack; OpenRaster lists the topmost first."""
    mode = "svg:src-over" if item.mode == "normal" else f"svg:{item.mode}"
    about = {"name": item.label, "composite-op": mode, "opacity": "1.0", "visibility": "visible"}
    if item.mask is not None:
        alpha = blended(item.mask)[:1]
    if isinstance(item.content, tuple) and item.mask is None:
        inner = ElementTree.Element("stack", about | {"isolation": "isolate"})
        for part in item.content:
            _add(inner, part, files, bits)
        if alpha is not None:
            _add_cut(inner, alpha, files, bits)
        stack.insert(0, inner)
        return
    name = f"data/{len(files):03d}.png"
    files[name] = _png(item.content.pixels if isinstance(item.content, Picture) else blended(item), alpha, bits)
    stack.insert(0, ElementTree.Element("layer", about | {"src": name, "x": "0", "y": "0"}))


def _add_cut(stack: ElementTree.Element, alpha: Mask, files: dict[str, bytes], bits: int) -> None:
    """A layer that keeps what is below it where it is opaque itself."""
    name = f"data/{len(files):03d}.png"
    files[name] = _png(torch.ones(3, *alpha.shape[1:]), alpha, bits)
    about = {"name": "sphere", "composite-op": "svg:dst-in", "opacity": "1.0", "visibility": "visible", "src": name, "x": "0", "y": "0"}
    stack.insert(0, ElementTree.Element("layer", about))
