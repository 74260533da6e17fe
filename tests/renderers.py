"""Pictures that other programs make of vector and layered files, and what `render` would make of their tree."""

from __future__ import annotations

import io
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from unshade.nodes import Tree
from unshade.render import render
from unshade.sphere import SCORED_RADIUS, sphere_grid, sphere_normals

COLUMNS = 8

STARTS = 3
"""Krita beside a busy X server may end, with no error, before it has written."""


def expected(tree: Tree, size: int) -> np.ndarray:
    """(size, size, 3) of `render`, each pixel the mean of 4 x 4, since other programs antialias a hard edge."""
    fine = render(tree, sphere_normals(4 * size))
    return torch.nn.functional.avg_pool2d(fine[None], 4)[0].permute(1, 2, 0).double().numpy()


def rendered(tree: Tree, size: int) -> np.ndarray:
    """(size, size, 3) of `render` itself."""
    return render(tree, sphere_normals(size)).permute(1, 2, 0).double().numpy()


def scored(size: int) -> np.ndarray:
    """(size, size), true where pictures are compared."""
    inside: np.ndarray = (sphere_grid(size).square().sum(0) <= SCORED_RADIUS**2).numpy()
    return inside


def psnr(picture: np.ndarray, wanted: np.ndarray) -> float:
    """In dB inside the scored disc; pictures in [0, 1]."""
    difference = (picture - wanted)[scored(len(wanted))]
    return float(-10.0 * np.log10(max(float((difference**2).mean()), 1e-12)))


def decoded(data: bytes | Path) -> np.ndarray:
    """(H, W, 3) in [0, 1] of a picture file."""
    return np.asarray(Image.open(io.BytesIO(data) if isinstance(data, bytes) else data).convert("RGB")) / 255.0


def by_resvg(svg: str, size: int) -> np.ndarray:
    """What resvg makes of an SVG."""
    resvg = pytest.importorskip("resvg_py", reason="needs resvg-py")
    return decoded(bytes(resvg.svg_to_bytes(svg_string=svg, width=size, height=size)))


def by_pdfium(path: Path, size: int) -> np.ndarray:
    """What PDFium makes of a page."""
    pdfium = pytest.importorskip("pypdfium2", reason="needs pypdfium2")
    with pdfium.PdfDocument(path) as document:
        page = document[0]
        return np.asarray(page.render(scale=size / page.get_width()).to_pil().convert("RGB")) / 255.0


def by_poppler(path: Path, size: int) -> np.ndarray:
    """What Poppler makes of a page 512 points wide."""
    if shutil.which("pdftoppm") is None:
        pytest.skip("needs Poppler (apt-get install poppler-utils)")
    done = subprocess.run(["pdftoppm", "-png", "-r", str(72 * size / 512), str(path)], capture_output=True, check=True, timeout=120)
    return decoded(done.stdout)[:size, :size]


def by_psd_tools(path: Path) -> np.ndarray:
    """(H, W, 4): what psd-tools makes of the layers of a PSD, not the picture that is stored beside them."""
    psd_tools = pytest.importorskip("psd_tools", reason="needs psd-tools")
    from psd_tools.composite import composite

    color, _, alpha = composite(psd_tools.PSDImage.open(path), force=True, color=0.0)
    return np.concatenate([color, alpha], axis=-1)


def by_pyora(path: Path) -> np.ndarray:
    """(H, W, 4): what pyora makes of the layers of an OpenRaster file."""
    pyora = pytest.importorskip("pyora", reason="needs pyora")
    return np.asarray(pyora.Renderer(pyora.Project.load(str(path))).render()) / 255.0


def by_krita(path: Path) -> np.ndarray:
    """(H, W, 4): what Krita makes of a file."""
    if not (shutil.which("krita") and shutil.which("xvfb-run")):
        pytest.skip("needs Krita and Xvfb (apt-get install krita xvfb xauth)")
    picture = path.with_suffix(".krita.png")
    command = ["xvfb-run", "-a", "krita", "--export", "--export-filename", str(picture), str(path)]
    for _ in range(STARTS):
        done = subprocess.run(command, env={**os.environ, "HOME": str(path.parent)}, capture_output=True, timeout=200, check=False)
        if picture.is_file():
            return np.asarray(Image.open(picture).convert("RGBA")) / 255.0
    raise AssertionError(f"Krita wrote nothing in {STARTS} starts, and ended with {done.returncode}: {done.stderr.decode()[-2000:]}")


def by_inkscape(paths: Sequence[Path], size: int) -> list[np.ndarray]:
    """What Inkscape exports of SVG files."""
    if shutil.which("inkscape") is None:
        pytest.skip("needs Inkscape (apt-get install inkscape)")
    edges = [f"--export-width={size}", f"--export-height={size}", "--export-area-page"]
    command = ["inkscape", "--export-type=png", *edges, *map(str, paths)]
    subprocess.run(command, env={**os.environ, "HOME": str(paths[0].parent)}, capture_output=True, timeout=240, check=True)
    return [decoded(path.with_suffix(".png")) for path in paths]


def by_chromium(browser: str, folder: Path, parts: Sequence[str], size: int, head: str = "") -> list[np.ndarray]:
    """What Chromium shows of pieces of HTML, each in a square of ``size`` pixels; all on one page."""
    columns = min(COLUMNS, len(parts))
    width, height = columns * size, -(-len(parts) // columns) * size
    cells = "".join(
        f'<section style="left:{k % columns * size}px;top:{k // columns * size}px">{part}</section>' for k, part in enumerate(parts)
    )
    style = f"*{{margin:0}}section{{position:absolute;width:{size}px;height:{size}px;overflow:hidden}}img{{display:block}}"
    page, picture = folder / "page.html", folder / "page.png"
    page.write_text(f"<!doctype html><meta charset=utf-8><style>{style}</style>{head}{cells}", encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--hide-scrollbars", "--force-device-scale-factor=1", "--force-color-profile=srgb"]
    flags += ["--disable-gpu", f"--window-size={width},{height}", f"--screenshot={picture}", f"--user-data-dir={folder / 'profile'}"]
    subprocess.run([browser, *flags, page.as_uri()], capture_output=True, timeout=240, check=True)
    shown = decoded(picture)
    return [shown[k // columns * size :, k % columns * size :][:size, :size] for k in range(len(parts))]
