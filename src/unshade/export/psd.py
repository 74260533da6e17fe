"""Photoshop files: a pixel layer a leaf, a group an operator, and the tree itself in the file's metadata.

| tree | PSD |
|---|---|
| node | layer or group of its name, its place in the tree as the layer's number |
| multiply, screen | group in mode normal, so isolated; children over the first in mode multiply or screen |
| mix | right, and over it left with a layer mask |
| leaf | pixel layer of 8 or 16 bits |
| sphere | layer mask of the root |

`read_psd` gives the tree back: what was stored, less the layers that were hidden or deleted, with the colours of albedo
layers and the names as they are now. Anything else that was painted cannot be read back into a tree.
"""

from __future__ import annotations

import dataclasses
import html
import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image as PILImage

from unshade.errors import MissingExtraError, TreeError
from unshade.export.layers import disc, layered
from unshade.export.scene import Item, Picture
from unshade.files import write_whole
from unshade.nodes import Leaf, Node, Operator, Tree, walk
from unshade.render import render, srgb_decode
from unshade.serde import dumps, loads
from unshade.sphere import sphere_normals
from unshade.types import Image

if TYPE_CHECKING:
    from psd_tools import PSDImage

METADATA = 1060
"""The image resource that holds XMP."""

NAMESPACE = "https://unshade.invalid/tree/1/"


def _library(path: Path) -> Any:
    try:
        import psd_tools
    except ImportError:
        raise MissingExtraError(f"{path}: PSD needs the psd-tools library; install it with: pip install 'unshade[export]'") from None
    return psd_tools


def write_psd(tree: Tree, path: Path, size: int = 512, bits: int | str = 8) -> None:
    """A layered file of ``size`` x ``size`` pixels. Raises MissingExtraError."""
    library, depth = _library(path), int(bits)
    document: PSDImage = library.PSDImage.new("RGB", (size, size), depth=depth)
    numbers = {address: number for number, (address, _) in enumerate(walk(tree.root), start=1)}
    writer = _Writer(library, document, numbers)
    root = writer.add(document, layered(tree, size))
    _mask(root, disc(size))
    document._update_record()
    record = document._record  # the library's own image of the file, where the merged picture and the metadata are
    from psd_tools.psd.image_resources import ImageResource

    record.image_resources[METADATA] = ImageResource(key=METADATA, data=_xmp(tree))
    merged = (render(tree, sphere_normals(size)) * disc(size)).clamp(0.0, 1.0).double().numpy()
    kind = np.uint8 if depth == 8 else np.dtype(">u2")
    record.image_data.set_data([np.round(plane * (2**depth - 1)).astype(kind).tobytes() for plane in merged], record.header)
    stored = io.BytesIO()
    record.write(stored)
    write_whole(path, stored.getvalue())


class _Writer:
    def __init__(self, library: Any, document: Any, numbers: dict[str, int]) -> None:
        self.modes = library.constants.BlendMode
        self.tag = library.constants.Tag.LAYER_ID
        self.document, self.numbers = document, numbers

    def add(self, parent: Any, item: Item) -> Any:
        """The layer of an item, on top of its parent."""
        if isinstance(item.content, Picture):
            pixels = np.moveaxis(item.content.pixels.clamp(0.0, 1.0).numpy(), 0, -1)
            layer = parent.create_pixel_layer_from_array(np.ascontiguousarray(pixels), name=item.label)
        else:
            assert isinstance(item.content, tuple)
            layer = parent.create_group(name=item.label)
            for part in item.content:
                self.add(layer, part)
        layer.blend_mode = {"normal": self.modes.NORMAL, "multiply": self.modes.MULTIPLY, "screen": self.modes.SCREEN}[item.mode]
        layer.tagged_blocks.set_data(self.tag, self.numbers[item.address])
        if item.mask is not None:
            assert isinstance(item.mask.content, Picture)
            _mask(layer, item.mask.content.pixels)
        return layer


def _mask(layer: Any, mask: Image) -> None:
    """Give a layer a mask, of 8 bits of precision also in a file of 16."""
    if layer.is_group():
        # psd-tools 1.26 makes a group and its end share one list of channels, to which a mask would be added twice.
        layer._channels = type(layer._channels)(list(layer._channels))
    gray = np.round(mask[0].clamp(0.0, 1.0).double().numpy() * 255).astype(np.uint8)
    layer.create_mask(PILImage.fromarray(gray), top=0, left=0)


def _xmp(tree: Tree) -> bytes:
    """The tree as one property of an XMP packet."""
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:unshade="{NAMESPACE}">'
        f"<unshade:tree>{html.escape(dumps(tree))}</unshade:tree></rdf:Description>"
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


def read_psd(path: str | Path) -> Tree:
    """The tree of a file that `write_psd` wrote and somebody edited.

    Raises TreeError where the file is none of those, or no node is left visible; MissingExtraError.
    """
    path = Path(path)
    library = _library(path)
    try:
        document = library.PSDImage.open(path)
    except (OSError, ValueError, AssertionError, KeyError) as error:
        raise TreeError(
            f"{path}: not a PSD that can be read ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
        ) from None
    data = document.image_resources.get_data(METADATA)
    found = re.search(r"<unshade:tree>(.*?)</unshade:tree>", data.decode("utf-8", "replace") if isinstance(data, bytes) else "", re.DOTALL)
    if not found:
        raise TreeError(f"{path}: no tree in it; only a PSD that unshade wrote can be read back")
    tree = loads(html.unescape(found[1]))
    layers = {layer.layer_id: layer for layer in document.descendants()}
    left = _edited(tree.root, tree.root.kind, {address: layers.get(n) for n, (address, _) in enumerate(walk(tree.root), start=1)}, tree)
    if left is None:
        raise TreeError(f"{path}: no layer of the tree is left visible")
    return dataclasses.replace(tree, root=left)


def _edited(node: Node, address: str, layers: dict[str, Any], tree: Tree) -> Node | None:
    """A node as its layer is now; None for one that is hidden or gone."""
    layer = layers[address]
    if layer is None or not layer.visible:
        return None
    name = node.name if layer.name == (node.name or node.kind) else str(layer.name)
    if isinstance(node, Leaf):
        if node.kind == "albedo":
            node = _recolored(node, layer, tree)
        return dataclasses.replace(node, name=name)
    children = [_edited(child, f"{address}.{k}.{child.kind}", layers, tree) for k, child in enumerate(node.children)]
    kept = tuple(child for child in children if child is not None)
    if len(kept) < 2:
        return kept[0] if kept else None
    return Operator(node.kind, kept, node.mask, name)


def _recolored(leaf: Leaf, layer: Any, tree: Tree) -> Leaf:
    """The colour of an albedo's layer, where it is not the stored one to the layer's rounding."""
    pixels = layer.numpy("color")
    stored = Tree(leaf, tree.blend_space)
    was = render(stored, sphere_normals(1))[:, 0, 0].double().numpy()
    now = np.median(pixels.reshape(-1, pixels.shape[-1]), axis=0).astype(np.float64)
    if np.abs(now - was).max() <= 1.01 / 255:
        return leaf
    import torch

    color = torch.from_numpy(now.clip(0.0, 1.0))
    return leaf.set(color=tuple((srgb_decode(color) if tree.blend_space == "linear" else color).tolist()))
