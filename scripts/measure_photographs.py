"""Measure what extract and apply are worth on photos with a known answer: known trees on exact normals, with texture and shadow.

    python scripts/measure_photographs.py [--size 384] [--keep-extract]

- extract: the MatCap of each photo against the picture of the tree that it was made with, PSNR in dB inside the disc of radius
  0.97, of the directions that were seen and of all; and of the plain mean over the pixels of a direction, which is what the
  robust reading must beat.
- apply: the tree of the MatCap (balanced) is edited, and put back on the photo; against the photo of the known tree, edited.
  The same with the known tree in the place of the recovered one says what of the error is `apply`'s own.
- inflate: the angle between the guessed and the true normals of a disc, and of the pebble.

Writes benchmarks/results/photographs/photographs.json.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from unshade.apply import apply_to_photo
from unshade.assignment import read_color
from unshade.bench.report import machine, versions
from unshade.decompose import decompose
from unshade.extract import Extraction, from_normal_map
from unshade.inflate import inflate
from unshade.metrics import psnr
from unshade.nodes import Tree
from unshade.picture_output import write_picture
from unshade.pictures import Disc, SphereImage
from unshade.recolor import recolor
from unshade.relight import relight
from unshade.render import render
from unshade.sphere import disc_mask, sphere_grid, sphere_normals

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
import photo_scenes as scenes  # noqa: E402

DISC = disc_mask(256, 0.97)
EDITS = {"recolour": lambda tree: recolor(tree, read_color("#3070c0")), "light 25 degrees": lambda tree: relight(tree, 20.0, 15.0)}


def extracted(folder: Path, tree: Tree, shape: str, fault: str, size: int, even: bool) -> tuple[Extraction, torch.Tensor]:
    normals, mask = scenes.OBJECTS[shape](size)
    image = scenes.photo(tree, normals, mask, fault)
    write_picture(folder / "photo.png", image)
    write_picture(folder / "normals.png", normals * 0.5 + 0.5, mask, bits=16)
    return from_normal_map(folder / "photo.png", folder / "normals.png", even=even), image


def decibels(image: torch.Tensor, truth: torch.Tensor, where: torch.Tensor) -> float:
    return round(min(float(psnr(image.float(), truth.float(), where)), 99.0), 2)


def measure_extract(size: int) -> list[dict[str, Any]]:
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for shape in scenes.OBJECTS:
            for kind in scenes.TREES:
                tree = scenes.tree_of(kind)
                truth = render(tree, sphere_normals(256))
                for fault in scenes.FAULTS:
                    begin = time.process_time()
                    found, _ = extracted(Path(name), tree, shape, fault, size, True)
                    seconds = time.process_time() - begin
                    plain, _ = extracted(Path(name), tree, shape, fault, size, False)
                    seen = DISC & (found.coverage >= 0.5)
                    rows.append(
                        {
                            "object": shape,
                            "tree": kind,
                            "fault": fault,
                            "seen": round(found.seen, 3),
                            "psnr_seen": decibels(found.image, truth, seen),
                            "psnr": decibels(found.image, truth, DISC),
                            "psnr_seen_plain": decibels(plain.image, truth, seen),
                            "cpu_seconds": round(seconds, 2),
                        }
                    )
                    print(rows[-1], flush=True)
    return rows


def measure_apply(size: int) -> list[dict[str, Any]]:
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for kind in scenes.TREES:
            for fault in ("clean", "patch", "stripes and shadow"):
                tree = scenes.tree_of(kind)
                rows += edited(*extracted(Path(name), tree, "knot", fault, size, True), tree, kind, fault, size)
    return rows


def edited(found: Extraction, image: torch.Tensor, tree: Tree, kind: str, fault: str, size: int) -> list[dict[str, Any]]:
    sphere = SphereImage(found.image, (found.coverage >= 0.5) & disc_mask(256), Disc(128.0, 128.0, 128.0))
    recovered = decompose(sphere).result().tree
    normals, mask = scenes.OBJECTS["knot"](size)
    rows = []
    for name, edit in EDITS.items():
        if name != "recolour" and "shadow" in fault:
            continue  # a cast shadow would move as well
        truth = scenes.photo(edit(tree), normals, mask, fault)
        row: dict[str, Any] = {"tree": kind, "fault": fault, "edit": name}
        for detail in ("ratio", "residual"):
            result = apply_to_photo(edit(recovered), recovered, image.float(), normals.float(), mask, detail)  # type: ignore[arg-type]
            row[detail] = decibels(result, truth, mask > 0.5)
        known = apply_to_photo(edit(tree), tree, image.float(), normals.float(), mask)
        row["ratio, known tree"] = decibels(known, truth, mask > 0.5)
        row["photo itself"] = decibels(image, truth, mask > 0.5)
        rows.append(row)
        print(row, flush=True)
    return rows


def measure_inflate(size: int) -> dict[str, Any]:
    grid = sphere_grid(size, dtype=torch.float64) / 0.9
    radius = grid.square().sum(0).sqrt()
    sphere = torch.cat([grid, (1.0 - radius.square()).clamp(min=0.0).sqrt()[None]])
    found: dict[str, Any] = {}
    normals, mask = scenes.pebble(size)
    for name, truth, inside in (("disc", sphere, (radius < 0.98)[None]), ("pebble", normals, mask > 0.5)):
        outline = ((1.0 - radius) * 0.45 * size + 0.5).clamp(0.0, 1.0) if name == "disc" else mask[0]
        angle = torch.rad2deg((inflate(outline) * truth).sum(0).clamp(-1.0, 1.0).acos())[inside[0]]
        found[name] = {"mean_degrees": round(float(angle.mean()), 2), "median_degrees": round(float(angle.median()), 2)}
    return found


def summed(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean dB of each object and fault."""
    table: dict[str, Any] = {}
    for shape in scenes.OBJECTS:
        for fault in scenes.FAULTS:
            own = [row for row in rows if row["object"] == shape and row["fault"] == fault]
            table[f"{shape}, {fault}"] = {
                key: round(float(np.mean([row[key] for row in own])), 1) for key in ("psnr_seen", "psnr_seen_plain", "psnr")
            } | {"worst": min(row["psnr_seen"] for row in own)}
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=384)
    parser.add_argument("--keep-extract", action="store_true", help="measure apply again, extract not")
    given = parser.parse_args()
    torch.set_num_threads(1)
    path = ROOT / "benchmarks" / "results" / "photographs" / "photographs.json"
    kept = json.loads(path.read_text(encoding="utf-8"))["extract_cases"] if given.keep_extract else None
    rows, edits = kept or measure_extract(given.size), measure_apply(given.size)
    document = {
        "machine": machine(),
        "versions": versions(),
        "size": given.size,
        "summary": summed(rows),
        "apply": {
            f"{name}, {fault}": {
                key: round(math.fsum(row[key] for row in own) / len(own), 1)
                for key in ("ratio", "residual", "ratio, known tree", "photo itself")
            }
            for name in EDITS
            for fault in scenes.FAULTS
            if (own := [row for row in edits if row["edit"] == name and row["fault"] == fault])
        },
        "inflate": measure_inflate(given.size),
        "extract_cases": rows,
        "apply_cases": edits,
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({key: document[key] for key in ("summary", "apply", "inflate")}, indent=1))


if __name__ == "__main__":
    main()
