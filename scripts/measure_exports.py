"""Measure the picture exports against `render` in the programs that show them, into benchmarks/results/export.json.

What docs/export.md says in numbers comes from here: `python scripts/measure_exports.py`, then `python scripts/export_page.py`.
A program that is not installed is left out. The trees are those of the tests: every fixture tree that works on encoded
values at 256 pixels, and one that `decompose` found in examples/red_lacquer.png (63 values) at 512 and 2048.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from unshade.export.css import STYLE, div
from unshade.export.ora import write_ora
from unshade.export.pdf import write_pdf
from unshade.export.psd import write_psd
from unshade.export.svg import svg
from unshade.serde import load

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from export_trees import SRGB, TREES  # noqa: E402
from renderers import (  # noqa: E402
    by_chromium,
    by_inkscape,
    by_pdfium,
    by_poppler,
    by_psd_tools,
    by_pyora,
    by_resvg,
    expected,
    psnr,
    rendered,
    scored,
)

RESULT = ROOT / "benchmarks" / "results" / "export.json"
SMALL, SIZES = 256, (512, 2048)


def vectors(folder: Path, browser: str | None) -> dict[str, dict[str, float]]:
    """For each program the lowest PSNR over the fixture trees, and the PSNR of the found tree at each size."""
    balanced = load(ROOT / "tests" / "fixtures" / "balanced.json")
    drawn = {name: svg(tree, SMALL) for name, tree in SRGB.items()}
    wanted = {name: expected(tree, SMALL) for name, tree in SRGB.items()}
    found: dict[str, dict[str, float]] = {"svg in resvg": {}, "pdf in PDFium": {}}
    found["svg in resvg"]["lowest"] = min(psnr(by_resvg(text, SMALL), wanted[name]) for name, text in drawn.items())
    worst = []
    for name, tree in SRGB.items():
        write_pdf(tree, folder / "tree.pdf")
        worst.append(psnr(by_pdfium(folder / "tree.pdf", SMALL), wanted[name]))
    found["pdf in PDFium"]["lowest"] = min(worst)
    (folder / "balanced.svg").write_text(svg(balanced), encoding="utf-8")
    write_pdf(balanced, folder / "balanced.pdf")
    if shutil.which("pdftoppm"):
        found["pdf in Poppler"] = {}
    for name, text in drawn.items():
        (folder / f"{name}.svg").write_text(text, encoding="utf-8")
    if shutil.which("inkscape"):
        shown = by_inkscape([folder / f"{name}.svg" for name in SRGB], SMALL)
        found["svg in Inkscape"] = {"lowest": min(psnr(one, wanted[name]) for one, name in zip(shown, SRGB, strict=True))}
    if browser:
        found |= {"svg in Chromium": {}, "css in Chromium": {}}
        for target, parts, head in (
            ("svg", [f'<img src="{name}.svg">' for name in SRGB], ""),
            ("css", [div(tree, SMALL) for tree in SRGB.values()], f"<style>{STYLE}</style>"),
        ):
            shown = by_chromium(browser, folder, parts, SMALL, head)
            found[f"{target} in Chromium"]["lowest"] = min(psnr(one, wanted[name]) for one, name in zip(shown, SRGB, strict=True))
    for size in SIZES:
        truth = rendered(balanced, size)
        pictures = {"svg in resvg": by_resvg(svg(balanced, size), size), "pdf in PDFium": by_pdfium(folder / "balanced.pdf", size)}
        if "pdf in Poppler" in found:
            pictures["pdf in Poppler"] = by_poppler(folder / "balanced.pdf", size)
        if "svg in Inkscape" in found:
            [pictures["svg in Inkscape"]] = by_inkscape([folder / "balanced.svg"], size)
        if browser:
            image = f'<img src="balanced.svg" width="{size}" height="{size}">'
            pictures["svg in Chromium"] = by_chromium(browser, folder, [image], size)[0]
            pictures["css in Chromium"] = by_chromium(browser, folder, [div(balanced, size)], size, f"<style>{STYLE}</style>")[0]
        for name, picture in pictures.items():
            found[name][str(size)] = psnr(picture, truth)
    for name in found:
        target = name.partition(" ")[0]
        kilobytes = len(div(balanced)) if target == "css" else (folder / f"balanced.{target}").stat().st_size
        found[name]["bytes"] = kilobytes
    return found


def layers(folder: Path) -> dict[str, float]:
    """For each layered format the greatest difference over the fixture trees, of 255."""
    found: dict[str, float] = {}
    for name, tree in {**SRGB, "balanced": load(ROOT / "tests" / "fixtures" / "balanced.json")}.items():
        truth, inside = rendered(tree, 128), scored(128)
        group = "balanced" if name == "balanced" else "fixtures"
        for bits in (8, 16):
            write_psd(tree, folder / "tree.psd", 128, bits)
            shown = by_psd_tools(folder / "tree.psd")[..., :3]
            key = f"psd {bits} bit in psd-tools, {group}"
            found[key] = max(found.get(key, 0.0), 255 * float(np.abs(shown - truth)[inside].max()))
        write_ora(tree, folder / "tree.ora", 128)
        shown = by_pyora(folder / "tree.ora")[..., :3]
        key = f"ora 8 bit in pyora, {group}"
        found[key] = max(found.get(key, 0.0), 255 * float(np.abs(shown - truth)[inside].max()))
    return found


def main() -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as folder:
        result = {"vectors": vectors(Path(folder), browser), "layers": layers(Path(folder)), "trees": len(SRGB), "of": len(TREES)}
    RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
