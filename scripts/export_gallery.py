"""Draw docs/export-gallery.md: one MatCap through every export, with the pictures that real programs made of the exported files.

``python scripts/export_gallery.py [TARGET ...]`` draws again what it can; the page and the figures beside it
(benchmarks/results/export_gallery.json) keep the last picture of a program that is not here. ``--check`` draws nothing and says
whether the page is fresh. Programs are found as the tests find them (docs/shaders.md), and driven by the same code.
"""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from unshade.errors import MissingExtraError
from unshade.export import TARGETS, ExportWarning, export
from unshade.export.css import STYLE
from unshade.export.program import program
from unshade.pictures import read_sphere
from unshade.serde import load
from unshade.sphere import SCORED_RADIUS, sphere_grid

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import renderers as of  # noqa: E402
from blender_pictures import blender_version, by_cycles, by_workbench  # noqa: E402
from chromium import Job, browser_or_skip, shaders  # noqa: E402
from godot_web import godot_pictures  # noqa: E402
from shader_pictures import by_three, by_wgpu, glsl_job, hlsl_job, wgpu_or_skip  # noqa: E402

PAGE, PICTURES = ROOT / "docs" / "export-gallery.md", ROOT / "docs" / "exports"
FIGURES = ROOT / "benchmarks" / "results" / "export_gallery.json"
MATCAP, TREE = ROOT / "examples" / "red_lacquer.png", ROOT / "tests" / "fixtures" / "balanced.json"
SIZE, GAP, AMPLIFIED = 144, 8, 32

Drawn = tuple[np.ndarray, str]
"""(S, S, 3) in [0, 1], and the program with its version."""


@dataclass(frozen=True)
class Drawing:
    """A program that draws the file of a target."""

    target: str
    program: str
    draw: Callable[[Path], Drawn]
    suffix: str = ""
    options: Mapping[str, int] = field(default_factory=dict)
    remark: str = ""

    @property
    def ending(self) -> str:
        return self.suffix or TARGETS[self.target].suffixes[0]

    @property
    def name(self) -> str:
        """Of its picture and its figures."""
        return re.sub(r"\W+", "-", f"{self.target} {self.program}".lower())


def said(*command: str) -> str:
    """The version that a program prints."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return re.findall(r"\d+(?:\.\d+)+", done.stdout + done.stderr)[0]


def rows(picture: np.ndarray) -> np.ndarray:
    """(3, S, S) to (S, S, 3)."""
    return np.moveaxis(picture, 0, -1)


def chromium() -> str:
    return f"Chromium {said(browser_or_skip(), '--version')}"


def by_page(path: Path) -> Drawn:
    """An SVG as an image of a page, a div as a part of it."""
    if path.suffix == ".svg":
        part, head = f'<img src="{path.name}" width="{SIZE}" height="{SIZE}">', ""
    else:
        part, head = path.read_text(encoding="utf-8").partition("</style>")[2], f"<style>{STYLE}</style>"
    return of.by_chromium(browser_or_skip(), path.parent, [part], SIZE, head)[0], chromium()


def by_shader(path: Path, job: Job, maker: str = "") -> Drawn:
    return rows(shaders(browser_or_skip(), path.parent, {"tree": job}, SIZE)["tree"]), f"{maker}{chromium()}"


def by_resvg(path: Path) -> Drawn:
    picture = of.by_resvg(path.read_text(encoding="utf-8"), SIZE)
    import resvg_py

    return picture, f"resvg {resvg_py.__resvg_version__}"


def by_inkscape(path: Path) -> Drawn:
    [picture] = of.by_inkscape([path], SIZE)
    return picture, f"Inkscape {said('inkscape', '--version')}"


def by_pdfium(path: Path) -> Drawn:
    picture = of.by_pdfium(path, SIZE)
    import pypdfium2

    return picture, f"PDFium {pypdfium2.PDFIUM_INFO.build}"


def by_poppler(path: Path) -> Drawn:
    return of.by_poppler(path, SIZE), f"Poppler {said('pdftoppm', '-v')}"


def by_psd_tools(path: Path) -> Drawn:
    return of.by_psd_tools(path)[..., :3], f"psd-tools {version('psd-tools')}"


def by_pyora(path: Path) -> Drawn:
    return of.by_pyora(path)[..., :3], f"pyora {version('pyora')}"


def by_krita(path: Path) -> Drawn:
    return of.by_krita(path)[..., :3], f"Krita {said('xvfb-run', '-a', 'krita', '--version')}"


def by_matcap(path: Path) -> Drawn:
    return rows(by_workbench(path.parent, SIZE)[path.stem]), f"{blender_version()}, Workbench"


def by_render(path: Path) -> Drawn:
    return rows(by_cycles(path.parent, SIZE)[path.stem]), f"{blender_version()}, Cycles"


def by_naga(path: Path) -> Drawn:
    device = wgpu_or_skip()
    return rows(by_wgpu(device, program(load(TREE)), SIZE)[:3]), f"wgpu {version('wgpu')}, naga, {device.adapter.info['device']}"


def by_module(path: Path) -> Drawn:
    return rows(by_three(browser_or_skip(), path.parent, [path.stem], SIZE)[path.stem]), chromium()


def by_glsl(path: Path) -> Drawn:
    return by_shader(path, glsl_job(program(load(TREE))))


def by_hlsl(path: Path) -> Drawn:
    return by_shader(
        path, hlsl_job(program(load(TREE)), path.parent, SIZE, gamma=False), f"glslang {said('glslangValidator', '--version')}, "
    )


def by_materialx(path: Path) -> Drawn:
    pytest.importorskip("MaterialX", reason="needs MaterialX (pip install MaterialX)")
    from materialx_glsl import job

    return by_shader(path, job(path.read_text(encoding="utf-8"), program(load(TREE))), f"MaterialX {version('MaterialX')}, ")


def by_godot(path: Path) -> Drawn:
    texts = {"tree": path.read_text(encoding="utf-8")}
    drawn = godot_pictures(browser_or_skip(), path.parent, texts, {"tree": {}}, SIZE)["tree"]
    return rows(drawn.picture), f"Godot {drawn.version}"


SQUARE = {"size": 500, "padding": 2}
"""Blender leaves 0.4 % of a MatCap on each side."""
PIXELS = {"size": SIZE}
CORNERS = "shadings are sampled at the corners of pixels, half a pixel away"

DRAWINGS = (
    Drawing("png", "Blender", by_matcap, options=SQUARE, remark="as a MatCap on a mesh"),
    Drawing("svg", "Chromium", by_page),
    Drawing("svg", "resvg", by_resvg),
    Drawing("svg", "Inkscape", by_inkscape),
    Drawing("pdf", "PDFium", by_pdfium, remark=CORNERS),
    Drawing("pdf", "Poppler", by_poppler, remark=CORNERS),
    Drawing("css", "Chromium", by_page, options=PIXELS),
    Drawing("psd", "psd-tools", by_psd_tools, options=PIXELS),
    Drawing("ora", "Krita", by_krita, options=PIXELS),
    Drawing("ora", "pyora", by_pyora, options=PIXELS),
    Drawing("exr", "Blender", by_matcap, options=SQUARE, remark="as a MatCap on a mesh"),
    Drawing("blender-matcap", "Blender", by_matcap, remark="as a MatCap on a mesh, its layers added"),
    Drawing("glsl", "Chromium", by_glsl),
    Drawing("wgsl", "wgpu", by_naga),
    Drawing("three", "Chromium", by_module, ".js"),
    Drawing("godot", "Godot", by_godot, remark="Compatibility; its own conversion darkens dark tones"),
    Drawing("unity", "glslang", by_hlsl, remark="its HLSL, then SPIRV-Cross; not Unity itself"),
    Drawing("blender", "Blender", by_render, ".blend", remark="the file as Blender saved it"),
    Drawing("materialx", "MaterialX", by_materialx, remark="the GLSL that MaterialX generates"),
)

HEAD = """# Gallery: a MatCap in other programs

<!-- Generated by scripts/export_gallery.py. Do not edit. -->

`decompose` found a tree of {values} values in a MatCap that an artist painted ([`examples/red_lacquer.png`](../examples/README.md)):
the MatCap, and the tree as `render` draws it, {psnr:.1f} dB away.

![The MatCap and its tree](exports/matcap.png)

The tree was exported to every target, and the programs named below drew the files. Left of each pair is the picture that the program
made, {size} pixels wide, cut out at the silhouette; right its difference from `render` in the channel where it is largest,
{amplified} times. Decibels are inside 0.97 of the radius. [export.md](export.md) and [shaders.md](shaders.md) say what each target is
and what it cannot hold, and give the lowest figures of all the trees of the tests.

| target | file | drawn by | picture, difference | PSNR |
|---|---|---|---|---|
"""


def disc(size: int, radius: float) -> np.ndarray:
    """(S, S) of the coverage of a disc, antialiased."""
    inside = sphere_grid(4 * size).square().sum(0) <= radius**2
    return torch.nn.functional.avg_pool2d(inside[None].double(), 4)[0].numpy()


def pair(left: np.ndarray, right: np.ndarray, radius: float) -> Image.Image:
    """Two pictures (S, S, 3 or 1) of spheres side by side on transparency, the right one cut out at another radius."""
    sheet = np.zeros((SIZE, 2 * SIZE + GAP, 4))
    for shown, edge, start in ((left, 1.0, 0), (right, radius, SIZE + GAP)):
        alpha = disc(SIZE, edge)[..., None]
        sheet[:, start : start + SIZE] = np.concatenate([np.clip(shown, 0.0, 1.0) * (alpha > 0.0) * np.ones(3), alpha], axis=-1)
    return Image.fromarray((255.0 * sheet).round().astype(np.uint8))


def draw(drawing: Drawing, truth: np.ndarray) -> dict[str, Any]:
    """Export, draw, keep the picture; its figures, or what is missing for them."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", ExportWarning)
        try:
            path = export(load(TREE), Path(folder, f"ball{drawing.ending}"), drawing.target, **drawing.options)
            size = path.stat().st_size
            picture, program_name = drawing.draw(path)
        except (pytest.skip.Exception, MissingExtraError) as missing:
            return {"missing": str(missing)}
    steps = np.abs((255.0 * picture).round() - (255.0 * truth).round()).max(axis=-1, keepdims=True) / 255.0
    pair(picture, AMPLIFIED * steps, SCORED_RADIUS).save(PICTURES / f"{drawing.name}.png", optimize=True)
    return {"program": program_name, "psnr": round(of.psnr(picture, truth), 2), "bytes": size}


def line(drawing: Drawing, found: Mapping[str, Any] | None) -> str:
    """One line of the table."""
    target = TARGETS[drawing.target]
    name = f"`{target.name}`{', experimental' if target.experimental else ''}"
    if found is None or "missing" in found:
        return f"| {name} | `{drawing.ending}` | {drawing.program} | not drawn: {found['missing'] if found else 'not tried'} | |"
    options = " ".join(f"--{option} {value}" for option, value in drawing.options.items())
    made = f"`{drawing.ending}`, {found['bytes'] / 1000:.0f} KB{options and f', `{options}`'}"
    by = f"{found['program']}{drawing.remark and f': {drawing.remark}'}"
    picture = f"![{target.name} in {drawing.program}](exports/{drawing.name}.png)"
    return f"| {name} | {made} | {by} | {picture} | {found['psnr']:.1f} dB |"


def page(figures: Mapping[str, Any]) -> str:
    """The whole page."""
    head = HEAD.format(values=load(TREE).values, psnr=figures["matcap"], size=SIZE, amplified=AMPLIFIED)
    return head + "\n".join(line(drawing, figures["drawn"].get(drawing.name)) for drawing in DRAWINGS) + "\n"


def kept() -> dict[str, Any]:
    """The committed figures, if they are of this tree."""
    tree = hashlib.sha256(TREE.read_bytes()).hexdigest()[:16]
    found = json.loads(FIGURES.read_text(encoding="utf-8")) if FIGURES.is_file() else {}
    return found if found.get("tree") == tree else {"tree": tree, "matcap": 0.0, "drawn": {}}


def main() -> None:
    figures, words = kept(), sys.argv[1:]
    if words == ["--check"]:
        if not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != page(figures):
            sys.exit("docs/export-gallery.md is out of date: run scripts/export_gallery.py")
        return
    torch.set_num_threads(1)
    PICTURES.mkdir(exist_ok=True)
    truth = of.rendered(load(TREE), SIZE)
    matcap = read_sphere(MATCAP, size=SIZE).image
    pair(rows(matcap.double().numpy()), truth, 1.0).save(PICTURES / "matcap.png", optimize=True)
    figures["matcap"] = round(of.psnr(rows(matcap.double().numpy()), truth), 2)
    for drawing in DRAWINGS:
        if not words or drawing.target in words:
            found, before = draw(drawing, truth), figures["drawn"].get(drawing.name, {})
            figures["drawn"][drawing.name] = before if "missing" in found and "psnr" in before else found  # the last picture stays
            print(drawing.name, found)
    written = page(figures)
    for path in PICTURES.iterdir():
        if f"(exports/{path.name})" not in written:
            path.unlink()
    FIGURES.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(written, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
