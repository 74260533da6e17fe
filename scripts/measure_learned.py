"""Search, learned and hybrid side by side, at their own time and at equal time; the table goes into docs/learned.md.

    python scripts/measure_learned.py --weights run/weights --data ../shared/data --count 20

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
from unshade.decompose import decompose
from unshade.inference import Networks
from unshade.models import weights
from unshade.models.prior import Priors
from unshade.models.vqvae import VQVAE, Codes
from unshade.nodes import KINDS, Node, Operator, Role, Tree, walk
from unshade.pictures import SphereImage, find_pictures, read_sphere, sphere_from_array
from unshade.presets import PRESETS
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals

PAGE = Path(__file__).parent.parent / "docs" / "learned.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"

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


def cases(args: argparse.Namespace) -> Iterator[tuple[str, SphereImage, Tree | None]]:
    for style in ("realistic", "toon"):
        for tree in islice(synthesis.trees(style, "test", seed=args.seed), args.count):
            yield style, sphere_from_array((render(tree, sphere_normals(256)) * 255.0).round() / 255.0), tree
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, default=weights.FOLDER)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--methods", default="search;search, more;learned told;hybrid told;learned;hybrid")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/learned.json"))
    args = parser.parse_args()
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
    lines = table(rows)
    print("\n".join(lines))
    cards = {
        name: weights.read_card(weights.file_of(name, args.weights)).get("steps") for name in weights.MODELS if full or name != "prior"
    }
    args.json.write_text(json.dumps({"steps": cards, "cores": os.cpu_count(), "rows": rows}, indent=1) + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    trained = ", ".join(f"{name} {steps} steps" for name, steps in cards.items())
    block = f"{BEGIN}\nNetworks: {trained}. Seed {args.seed}; one thread of a busy machine.\n\n" + "\n".join(lines) + f"\n{END}"
    PAGE.write_text(before + block + after, encoding="utf-8")


if __name__ == "__main__":
    main()
