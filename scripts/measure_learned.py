"""Search, learned and hybrid side by side, at their own time and at equal time, and the seconds of the first stage's budgets on all cores.

    python scripts/measure_learned.py --weights run/weights --data DIR --count 20
    python scripts/measure_learned.py --part seconds      # with nothing else running

Both tables go into docs/learned.md, the rows behind them into benchmarks/results/learned.json.

Synthetic pictures are unseen trees of both styles. ``told`` rows replace the priors and the type network by the true children and types,
passed through the VQ-VAE: what the rest of the method would make of perfect proposals. They need no trained prior.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import statistics
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import torch

from unshade import synthesis
from unshade.bench.report import machine
from unshade.decompose import decompose
from unshade.inference import Inference, Networks
from unshade.learned import Settings
from unshade.models import weights
from unshade.models.prior import Priors
from unshade.models.vqvae import VQVAE, Codes
from unshade.nodes import KINDS, Node, Operator, Role, Tree, walk
from unshade.pictures import SphereImage, find_pictures, read_sphere, sphere_from_array
from unshade.presets import PRESETS
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals

ROOT = Path(__file__).resolve().parent.parent
PAGE, RESULTS = ROOT / "docs" / "learned.md", ROOT / "benchmarks" / "results" / "learned.json"
PARTS = ("table", "seconds")

DRAWS = (12,)
"""Budgets of nodes to draw for (`Inference.draws`) whose seconds are measured."""

TIMED = 10
"""Trees of each style that they are measured on."""

MORE = dataclasses.replace(PRESETS["balanced"].effort, beam=4, beam_moves=8, trials=8, rounds=4, sweeps=2, settle_steps=28)
"""A search with about the hybrid's time."""


class Told:
    """Priors and types that know the tree."""

    def __init__(self, networks: Networks, tree: Tree) -> None:
        size = networks.config.size
        masks = {kind.name for kind in KINDS.values() if kind.role is Role.MASK}
        self.nodes: list[Node] = [node for _, node in walk(tree.root) if node.kind not in masks]
        self.images = torch.stack([render(node, sphere_normals(size)) * disc_mask(size) for node in self.nodes])
        self.vqvae = networks.vqvae
        self.decoded = self.vqvae.decode(self.vqvae.encode(self.images))
        self.operator, self.mask = networks.heads.operator, networks.heads.mask

    def nearest(self, image: torch.Tensor) -> Node:
        return self.nodes[int((self.decoded - image).square().mean((1, 2, 3)).argmin())]

    def sample_children(self, vqvae: VQVAE, parent: Codes, samples: int, *_: Any) -> tuple[Codes, Codes]:
        sides: list[list[torch.Tensor]] = [[], []]
        for image in vqvae.decode(parent):
            node = self.nearest(image)
            children = (
                [self.images[self.nodes.index(child)] for child in node.children] if isinstance(node, Operator) else [image, image * 0]
            )
            for side, child in zip(sides, children, strict=True):
                side += [child] * samples
        left, right = (vqvae.encode(torch.stack(side)) for side in sides)
        return left, right

    def types(self, images: torch.Tensor) -> torch.Tensor:
        names = [self.nearest(image).kind.removesuffix("_map") for image in images]
        numbers = [synthesis.TYPES.index(name) if name in synthesis.TYPES else 0 for name in names]
        return torch.nn.functional.one_hot(torch.tensor(numbers), len(synthesis.TYPES)).float()


def unseen(seed: int, count: int) -> Iterator[tuple[str, SphereImage, Tree]]:
    """Trees of the test half, so many of each style, with their pictures."""
    for style in ("realistic", "toon"):
        for tree in islice(synthesis.trees(style, "test", seed=seed), count):  # type: ignore[arg-type]
            yield style, sphere_from_array((render(tree, sphere_normals(256)) * 255.0).round() / 255.0), tree


def cases(args: argparse.Namespace) -> Iterator[tuple[str, SphereImage, Tree | None]]:
    yield from unseen(args.seed, args.count)
    for name in ("pbr", "wild"):
        folder = args.data / name if args.data else None
        paths = [p for p in find_pictures([folder]) if "." not in p.stem] if folder and folder.is_dir() else []
        count = max(args.count // 2, 1)
        for k in range(min(count, len(paths))):
            yield name, read_sphere(paths[(2 * k + 1) * len(paths) // (2 * count)]), None


def measured(method: str, sphere: SphereImage, tree: Tree | None, networks: Networks, full: bool) -> dict[str, Any] | None:
    """None where the method does not apply."""
    told = method.endswith(" told")
    if (told and tree is None) or (method.startswith(("learned", "hybrid")) and not told and not full):
        return None
    if told:
        assert tree is not None
        oracle: Any = Told(networks, tree)
        networks = dataclasses.replace(networks, priors=oracle, heads=oracle)
    Networks.load = staticmethod(lambda *_: networks)  # type: ignore[method-assign]
    preset = "more" if method == "search, more" else "balanced"
    begin = time.process_time()
    result = decompose(sphere, preset=preset, method=method.split(",")[0].split()[0]).result()  # type: ignore[arg-type]
    found = {"psnr": result.psnr, "values": result.tree.values, "seconds": time.process_time() - begin}
    return found | ({"share": result.stages["second_stage_share"], "stages": result.stages["seconds"]} if result.stages else {})


def table(rows: dict[str, dict[str, list[dict[str, Any]]]]) -> list[str]:
    lines = [
        "| pictures | method | PSNR, dB: median / mean / worst tenth | values | CPU seconds | second stage |",
        "|---|---|---|---|---|---|",
    ]
    for dataset, methods in rows.items():
        for method, found in methods.items():
            psnr, share = sorted(row["psnr"] for row in found), [row["share"] for row in found if "share" in row]
            figures = f"{statistics.median(psnr):.1f} / {statistics.fmean(psnr):.1f} / {psnr[len(psnr) // 10]:.1f}"
            values = statistics.median(row["values"] for row in found)
            seconds = statistics.fmean(row["seconds"] for row in found)
            left = f"{statistics.fmean(share):.0%}" if share and method.startswith("learned") else ""
            lines.append(f"| {dataset}, {len(found)} | {method} | {figures} | {values:.0f} | {seconds:.1f} | {left} |")
    return lines


def compared(args: argparse.Namespace) -> dict[str, Any]:
    """Every method on every picture, on one thread."""
    torch.set_num_threads(1)
    PRESETS["more"] = dataclasses.replace(PRESETS["balanced"], name="more", effort=MORE)
    vqvae, heads = weights.load("vqvae", args.weights), weights.load("heads", args.weights)
    full = weights.available(args.weights)
    priors = weights.load("prior", args.weights).model if full else Priors(vqvae.config).eval()
    networks = Networks(vqvae.model, priors, heads.model, vqvae.config)  # type: ignore[arg-type]
    rows: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for number, (dataset, sphere, tree) in enumerate(cases(args)):
        for method in args.methods.split(";"):
            row = measured(method, sphere, tree, networks, full)
            if row is not None:
                rows.setdefault(dataset, {}).setdefault(method, []).append(row)
                print(number, dataset, method, {key: value for key, value in row.items() if key != "stages"}, flush=True)
    cards = {
        name: weights.read_card(weights.file_of(name, args.weights)).get("steps") for name in weights.MODELS if full or name != "prior"
    }
    return {"steps": cards, "seed": args.seed, "draws": Inference().draws, "rows": rows}


def told(found: dict[str, Any]) -> str:
    trained = ", ".join(f"{name} {steps} steps" for name, steps in found["steps"].items())
    how = f"Seed {found['seed']}; `learned` draws for {found['draws']} nodes at most; one thread of a busy machine."
    return f"Networks: {trained}. {how}\n\n" + "\n".join(table(found["rows"]))


def timed(args: argparse.Namespace) -> dict[str, Any]:
    """``learned`` with each budget, on all cores."""
    torch.set_num_threads(os.cpu_count() or 1)
    rows = []
    for number, (style, sphere, _) in enumerate(unseen(args.seed, TIMED)):
        for draws in DRAWS:
            begin = time.perf_counter()
            result = decompose(sphere, method="learned", settings=Settings(Inference(draws=draws)), weights=args.weights).result()
            seconds = time.perf_counter() - begin
            assert result.stages is not None
            row = {"tree": number, "style": style, "draws": draws, "seconds": round(seconds, 2), "psnr": round(result.psnr, 2)}
            rows.append(row | {"drawn": result.stages["drawn_nodes"], "stages": result.stages["seconds"]})
            print({key: value for key, value in rows[-1].items() if key != "stages"}, flush=True)
    return {"seed": args.seed, "machine": machine(), "rows": rows}


def budgets(found: dict[str, Any]) -> str:
    lines = [
        f"{2 * TIMED} unseen trees, seed {found['seed']}; wall seconds on {found['machine']['cores']} cores with nothing else running.",
        "",
        "| `Inference.draws` | seconds: least / median / most | in 20 seconds | of them drawing, median | PSNR, dB: median / mean |",
        "|---|---|---|---|---|",
    ]
    for draws in DRAWS:
        rows = [row for row in found["rows"] if row["draws"] == draws]
        seconds, psnr = sorted(row["seconds"] for row in rows), [row["psnr"] for row in rows]
        drawing = statistics.median(row["stages"]["first stage"] for row in rows)
        spread = f"{seconds[0]:.1f} / {statistics.median(seconds):.1f} / {seconds[-1]:.1f}"
        quick = f"{sum(number <= 20.0 for number in seconds)} of {len(rows)}"
        lines.append(f"| {draws} | {spread} | {quick} | {drawing:.1f} | {statistics.median(psnr):.1f} / {statistics.fmean(psnr):.1f} |")
    return "\n".join(lines)


def placed(page: str, part: str, text: str) -> str:
    """The page with a table in its place."""
    begin, end = f"<!-- {part}: begin -->", f"<!-- {part}: end -->"
    return page.split(begin)[0] + f"{begin}\n{text}\n{end}" + page.split(end)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=PARTS, help="one of the tables; both when not given")
    parser.add_argument("--weights", type=Path, default=weights.FOLDER)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--methods", default="search;search, more;learned told;hybrid told;learned;hybrid")
    args = parser.parse_args()
    results = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {}
    page = PAGE.read_text(encoding="utf-8")
    # The seconds first: the other part puts its own networks in the place of those that ship.
    if args.part in (None, "seconds"):
        results["seconds"] = timed(args)
        page = placed(page, "seconds", budgets(results["seconds"]))
    if args.part in (None, "table"):
        results["table"] = compared(args)
        page = placed(page, "table", told(results["table"]))
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
