"""The table of targets: what a tree can be exported to, what gets lost on the way, and which program checked it.

Loads nothing heavy, so that the command line can read it. A target's own file does the writing; it is found by ``writer``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from unshade.errors import UnshadeError, did_you_mean

if TYPE_CHECKING:
    from unshade.nodes import Tree


@dataclass(frozen=True)
class Loss:
    """Something that a target cannot hold as it is, and what becomes of it."""

    cannot: str
    """``a raster leaf as vectors``; stands after "svg cannot hold"."""
    instead: str
    where: Callable[[Tree], list[str]]
    """The addresses of a tree's nodes that this happens to; none for a tree that loses nothing."""


@dataclass(frozen=True)
class Option:
    """A setting that some targets take."""

    name: str
    meaning: str
    type: Literal["integer", "file", "word", "text"]
    low: int = 0
    high: int = 0
    words: tuple[str, ...] = ()


OPTIONS = {
    option.name: option
    for option in (
        Option("size", "Width and height in pixels.", "integer", 1, 8192),
        Option("bits", "Bits a channel.", "word", words=("8", "16")),
        Option(
            "padding",
            "Pixels between the silhouette and the edge of the picture; blender-matcap takes Blender's own unless given.",
            "integer",
            0,
            4096,
        ),
        Option("shape", "An SVG with a closed path to be shaded in the sphere's place.", "file"),
        Option("region", "The id of the path, where the SVG has several.", "text"),
    )
}


@dataclass(frozen=True)
class Target:
    """Something to export to."""

    name: str
    suffixes: tuple[str, ...]
    summary: str
    writer: str
    """``module.function`` below `unshade.export`, called as ``function(tree, path, **options)``; what it returns, if anything, are
    further warnings, an iterable of sentences."""
    losses: tuple[Loss, ...] = ()
    checked_by: str = ""
    """The program that reads or runs the result in the tests."""
    options: tuple[str, ...] = ()
    needs: str = ""
    """The optional libraries that writing it takes, as one names them to pip."""
    short_of: str = ""
    """Of an experimental target: what was checked all the same, short of its own program."""

    @property
    def experimental(self) -> bool:
        """True where no program of the target's own world has checked it."""
        return not self.checked_by


def of_kinds(*kinds: str) -> Callable[[Tree], list[str]]:
    """The addresses of the leaves and masks of these kinds."""
    return lambda tree: [address for address, node in tree.walk() if node.kind in kinds]


def masked_groups(tree: Tree) -> list[str]:
    """The mixes whose left side, which takes the mask, is several nodes."""
    from unshade.nodes import Operator

    mixes = ((address, node) for address, node in tree.walk() if isinstance(node, Operator) and node.kind == "mix")
    return [address for address, node in mixes if isinstance(node.children[0], Operator)]


def linear(tree: Tree) -> list[str]:
    """The operators of a tree that works on linear light; a single leaf blends nothing."""
    return [address for address, node in tree.walk() if node.kind in ("multiply", "screen", "mix")] if tree.blend_space == "linear" else []


PICTURE = Loss("nodes", "the tree becomes one picture, as one asks for", lambda tree: [])
"""Of targets that are pictures: said in the table, not warned about."""

RASTERS = of_kinds("image", "image_mask", "environment_map")
EMBEDDED = Loss("a raster leaf as vectors", "it is embedded as a picture of 512 pixels", RASTERS)
ENCODED = Loss(
    "operators that work on linear light",
    "each leaf is encoded for itself and blended so: a multiply looks nearly the same, a screen or a soft mix lighter or darker",
    linear,
)
PIXELS = Loss("a leaf's parameters", "it becomes pixels; the tree is kept beside them and can be read back", lambda tree: [])
FLAT = Loss("a leaf's parameters", "it becomes pixels", lambda tree: [])
MERGED = Loss(
    "a mask over several nodes",
    "they become one layer with the mask as its transparency",
    masked_groups,
)
ADDED = Loss("nodes and a screen", "the tree becomes two layers whose sum in linear light is its picture", lambda tree: [])
BOUND = Loss("the picture of a leaf", "it becomes a texture to bind by hand, as PNG data in a comment at the end", RASTERS)
DARK = Loss("dark tones in the Compatibility renderer", "Godot's own conversion shows them up to 0.02 darker", lambda tree: [])
BESIDE = Loss("the picture of a leaf in a .mtlx", "it must stand beside it as a PNG; a .zip brings it along", lambda tree: [])
"""Said by the writer, which knows the suffix."""

TARGETS = {
    target.name: target
    for target in (
        Target(
            "png",
            (".png",),
            "a MatCap picture, continued past the silhouette",
            "matcap.write_png",
            (PICTURE,),
            "Pillow and Blender 5.0",
            ("size", "bits", "padding"),
        ),
        Target(
            "svg",
            (".svg",),
            "vector art: gradients, paths, masks and blend modes in groups named as the nodes",
            "svg.write_svg",
            (EMBEDDED, ENCODED),
            "Chromium, resvg and Inkscape 1.2",
            ("size", "shape", "region"),
            needs="svgelements (for a shape)",
        ),
        Target(
            "pdf",
            (".pdf",),
            "vector art: shadings, soft masks and blend modes in layers named as the nodes",
            "pdf.write_pdf",
            (EMBEDDED, ENCODED),
            "PDFium and Poppler",
            ("size", "shape", "region"),
            needs="pikepdf; svgelements (for a shape)",
        ),
        Target(
            "css",
            (".html",),
            "a div in gradients, masks and blend modes",
            "css.write_css",
            (EMBEDDED, ENCODED),
            "Chromium",
            ("size",),
        ),
        Target(
            "psd",
            (".psd",),
            "layers and groups with blend modes and masks, named as the nodes; can be read back",
            "psd.write_psd",
            (PIXELS, ENCODED),
            "psd-tools and PhotoshopAPI",
            ("size", "bits"),
            needs="psd-tools",
        ),
        Target(
            "ora",
            (".ora",),
            "OpenRaster layers and blend modes, named as the nodes",
            "ora.write_ora",
            (FLAT, MERGED, ENCODED),
            "Krita 5.1 and pyora",
            ("size", "bits"),
        ),
        Target(
            "exr",
            (".exr",),
            "a MatCap in linear light, continued past the silhouette",
            "matcap.write_exr",
            (PICTURE,),
            "OpenEXR and Blender 5.0",
            ("size", "padding"),
            needs="OpenEXR",
        ),
        Target(
            "blender-matcap",
            (".exr",),
            "Blender's MatCap: layers diffuse and specular",
            "matcap.write_blender_matcap",
            (ADDED,),
            "Blender 5.0",
            ("size", "padding"),
            needs="OpenEXR",
        ),
        Target("glsl", (".glsl",), "a function of the normal, parameters as uniforms", "glsl.write", (BOUND,), "Chromium and glslang"),
        Target("wgsl", (".wgsl",), "a function of the normal and a structure of parameters", "wgsl.write", (BOUND,), "naga (wgpu)"),
        Target(
            "three",
            (".html", ".js"),
            "a page that runs offline with a control for every parameter; a module",
            "three.write",
            (),
            "Chromium",
        ),
        Target(
            "godot", (".gdshader",), "a spatial shader, parameters in the inspector", "godot.write", (BOUND, DARK), "Godot 4.6 (web build)"
        ),
        Target(
            "unity",
            (".shader",),
            "ShaderLab with HLSL, parameters in the inspector",
            "unity.write",
            (BOUND,),
            short_of="glslang compiles its HLSL and Chromium renders that; Unity has not opened it",
        ),
        Target(
            "blender",
            (".py", ".blend"),
            "a node group driven by normals, a ranged socket for every parameter",
            "blender.write",
            (),
            "Blender 5.0, Cycles on the CPU",
            needs="Blender or bpy (for a .blend)",
        ),
        Target(
            "materialx",
            (".mtlx", ".zip"),
            "a node graph with an interface, the formulas as node definitions",
            "materialx.write",
            (BESIDE,),
            "MaterialX 1.39 and Chromium",
        ),
    )
}


def target_of(name: str) -> Target:
    """The target of this name. Raises UnshadeError with the nearest known word."""
    if name not in TARGETS:
        raise UnshadeError(f"unknown target {name!r}{did_you_mean(name, TARGETS)}")
    return TARGETS[name]
