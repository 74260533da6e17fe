"""Measure what editing a recovered tree is worth: edits, relighting, analogies and edit scripts on trees drawn by the sampler.

    python scripts/measure_editing.py [--fresh] [--trees 20] [--cases 20] [--seed 7000003]

Known trees are drawn, rendered to 8 bits and decomposed (balanced; kept in out/editing until --fresh). Then

- edit: one leaf of the known tree is changed, `replay` does the same to the recovered one, and the pictures are compared;
- relight: both trees are relit by 30 degrees in a random direction;
- analogy: AB is made from the known trees of A and B with code of its own here, and understood from the pictures;
- script: one edit script on 100 trees, timed.

Writes benchmarks/results/editing/*.json (those of another seed in a folder of their own), every case with its figure. Trees with an
environment are counted apart as well.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import math
import random
import time
from pathlib import Path
from typing import Any

import torch

from unshade import serde
from unshade.analogy import Seen, explain
from unshade.bench.report import machine, versions
from unshade.components import Component, is_paint
from unshade.decompose import decompose
from unshade.edit import remove, rename
from unshade.edit_script import EditScript
from unshade.errors import TreeError
from unshade.grammar import same_structure, sample
from unshade.metrics import psnr
from unshade.nodes import Leaf, Node, Operator, Tree
from unshade.pictures import SIZE, Disc, SphereImage
from unshade.relight import relight, turn, turn_of
from unshade.render import render
from unshade.replay import replay
from unshade.sphere import disc_mask, sphere_normals

ROOT = Path(__file__).resolve().parent.parent
KEPT, RESULTS = ROOT / "out" / "editing", ROOT / "benchmarks" / "results" / "editing"
NORMALS = sphere_normals(SIZE)
FIRST_SEED = 7_000_003
PAIRS = 36
DEGREES = 30.0
CEILING = 100.0

SCRIPT = """
[[edit]]
set = "highlight.sharpness*=2"
optional = true
[[edit]]
move_light = [30, 10]
[[edit]]
recolor = "#3366ff"
optional = true
[[edit]]
remove = "rim"
optional = true
"""


@dataclasses.dataclass(frozen=True)
class Known:
    """A tree that was drawn, its picture, and the tree recovered from it."""

    name: str
    truth: Tree
    image: torch.Tensor
    found: Tree

    @property
    def has_environment(self) -> bool:
        return any(node.kind == "environment" for _, node in self.truth.walk())

    @property
    def exact(self) -> bool:
        return bool(same_structure(self.found, self.truth))


def known_trees(count: int, fresh: bool, seed: int = FIRST_SEED) -> list[Known]:
    """Two of three realistic, one in three toon; half of the realistic ones may hold an environment."""
    KEPT.mkdir(parents=True, exist_ok=True)
    found = []
    for number in range(count):
        style = "toon" if number % 3 == 2 else "realistic"
        generator = torch.Generator().manual_seed(seed + number)
        truth = sample(generator, style, environment=None if style == "realistic" and number % 2 else False)
        image = (render(truth, NORMALS) * 255.0).round() / 255.0
        key = hashlib.sha256(str(truth).encode()).hexdigest()[:16]
        path = KEPT / f"{number:02d}-{key}.json"
        if fresh or not path.exists():
            half = SIZE / 2
            result = decompose(SphereImage(image, disc_mask(SIZE), Disc(half, half, half, 1.0))).result()
            serde.dump(result.tree, path)
            print(f"  {path.name}: {result.psnr:.1f} dB, {result.tree.values} values for {truth.values}", flush=True)
        found.append(Known(f"{style}-{number:02d}", truth, image, serde.load(path)))
    return found


def decibels(a: Tree, b: Tree) -> float:
    return round(min(psnr(render(a, NORMALS), render(b, NORMALS)), CEILING), 2)


def changes(tree: Tree, seed: int) -> list[tuple[str, Tree]]:
    """Every leaf of a tree with one change to it, in random order; only changes that show."""
    chance = random.Random(seed)
    found = []
    for address, node in tree.walk():
        if not isinstance(node, Leaf):
            continue
        angle = chance.uniform(0.0, math.tau)
        moved = lambda degrees=25.0, where=address, at=angle: turn(tree, turn_of(degrees * math.cos(at), degrees * math.sin(at)), [where])  # noqa: E731
        options: list[tuple[str, Tree]] = []
        if node.kind == "albedo":
            color = [chance.random() for _ in range(3)]
            options.append(("color", tree.replace(address, node.set(color=color))))
        elif node.kind == "environment":
            options.append(("turned", moved()))
        else:
            options.append(("turned", moved()))
            if node.kind in ("highlight", "toon_highlight", "rim"):
                options.append(("removed", remove(tree, address)))
            if node.kind == "highlight":
                options.append(("sharpness * 0.4", tree.replace(address, node.set(sharpness=node["sharpness"][0] * 0.4))))
            if node.kind == "toon_highlight":
                options.append(("radius * 1.4", tree.replace(address, node.set(radius=node["radius"][0] * 1.4))))
            if node.kind in ("diffuse", "toon_diffuse"):
                options.append(("ambient / 2", tree.replace(address, node.set(ambient=node["ambient"][0] * 0.5))))
        what, changed = chance.choice(options)
        if decibels(tree, changed) < 40.0:
            found.append((f"{address} {what}", changed))
    chance.shuffle(found)
    return found


def swapped(a: Tree, b: Tree, which: Component) -> Tree:
    """A with a component of B, for trees of the sampler: their parts stand at the root, in the released grammar's places."""
    kinds = {Component.HIGHLIGHTS: ("highlight", "toon_highlight"), Component.RIM: ("rim",), Component.ENVIRONMENT: ("environment",)}

    def parts(tree: Tree) -> tuple[list[Node], list[Node], dict[Component, list[Node]]]:
        children = tree.root.children if isinstance(tree.root, Operator) and tree.root.kind == "screen" else (tree.root,)
        base = next(child for child in children if isinstance(child, Operator))
        lights = {c: [child for child in children if child.kind in names] for c, names in kinds.items()}
        return [n for n in base.children if is_paint(n)], [n for n in base.children if not is_paint(n)], lights

    paint, form, lights = parts(a)
    their_paint, their_form, their_lights = parts(b)
    paint = their_paint if which is Component.ALBEDO else paint
    form = their_form if which is Component.DIFFUSE else form
    chosen = {c: (their_lights if c is which else lights)[c] for c in kinds}
    layers = [Operator("multiply", (*paint, *form)), *(light for nodes in chosen.values() for light in nodes)]
    return Tree(layers[0] if len(layers) == 1 else Operator("screen", tuple(layers)))


def measure_edits(known: list[Known]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    queues = [changes(one.truth, number) for number, one in enumerate(known)]
    turn_by_turn = [(k, pair) for round_ in range(PAIRS) for k, queue in enumerate(queues) for pair in queue[round_ : round_ + 1]]
    for k, (what, changed) in turn_by_turn[:PAIRS]:
        one = known[k]
        fault = None
        try:
            again = replay(one.truth, changed, one.found)
        except TreeError as error:  # counted as if nothing had been edited
            again, fault = one.found, str(error)
        rows.append(
            {
                "tree": one.name,
                "edit": what,
                "psnr": decibels(again, changed),
                "before": decibels(one.found, one.truth),
                "unedited": decibels(one.found, changed),
                **({"failed": fault} if fault else {}),
            }
        )
    return rows


def measure_relighting(known: list[Known]) -> list[dict[str, Any]]:
    rows = []
    chance = random.Random(1)
    for one in known:
        for _ in range(2):
            angle = chance.uniform(0.0, math.tau)
            right, up = DEGREES * math.cos(angle), DEGREES * math.sin(angle)
            pair = relight(one.found, right, up), relight(one.truth, right, up)
            rows.append(
                {
                    "tree": one.name,
                    "right": round(right, 1),
                    "up": round(up, 1),
                    "psnr": decibels(*pair),
                    "before": decibels(one.found, one.truth),
                }
            )
    return rows


def measure_analogies(known: list[Known], cases: int) -> list[dict[str, Any]]:
    rows = []
    chance = random.Random(2)
    plain = [one for one in known if not one.has_environment]
    for which in Component:
        made = 0
        while made < cases:
            # Every other case without an environment in sight, except where it is what moves.
            pool = known if made % 2 or which is Component.ENVIRONMENT else plain
            a, b, p, q = chance.sample(pool, 4)
            truth = swapped(a.truth, b.truth, which)
            answer = swapped(p.truth, q.truth, which)
            if decibels(truth, a.truth) > 35.0 or decibels(answer, p.truth) > 35.0:
                continue  # nothing to understand, or nothing to do
            made += 1
            ab = (render(truth, NORMALS) * 255.0).round() / 255.0
            seen = (Seen(one.image, disc_mask(SIZE), one.found) for one in (a, b))
            explained = explain(*seen, ab, disc_mask(SIZE))
            got, done = explained.component, explained.apply(q.found, p.found)
            rows.append(
                {
                    "component": which.value,
                    "cases": [one.name for one in (a, b, p, q)],
                    "understood": got.value if got else None,
                    "right": got is which,
                    "psnr": decibels(done, answer),
                    "environment": any(one.has_environment for one in (a, b, p, q)),
                }
            )
    return rows


def measure_script(known: list[Known]) -> dict[str, Any]:
    script = EditScript.parse(SCRIPT)
    trees = [rename(known[k % len(known)].found, known[k % len(known)].found.root.kind, None) for k in range(100)]
    begin, begin_cpu = time.perf_counter(), time.process_time()
    for tree in trees:
        script.apply(tree)
    return {"trees": 100, "seconds": round(time.perf_counter() - begin, 3), "cpu_seconds": round(time.process_time() - begin_cpu, 3)}


def spread(numbers: list[float], target: float) -> dict[str, float]:
    ordered = sorted(numbers)
    return {
        "count": len(ordered),
        "mean": round(sum(ordered) / len(ordered), 2),
        "median": ordered[len(ordered) // 2],
        "worst tenth": ordered[len(ordered) // 10],
        f"share >= {target:g} dB": round(sum(number >= target for number in ordered) / len(ordered), 3),
    }


def summed(rows: list[dict[str, Any]], target: float, hard: set[str]) -> dict[str, Any]:
    """All rows, and apart from those of trees with an environment."""
    plain = [row["psnr"] for row in rows if row["tree"] not in hard]
    return {"all": spread([row["psnr"] for row in rows], target), "without environment": spread(plain, target)}


def _judged(rows: list[dict[str, Any]]) -> dict[str, float]:
    return {"right": round(sum(row["right"] for row in rows) / len(rows), 3), **spread([row["psnr"] for row in rows], 40.0)}


def write(folder: Path, name: str, document: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(
        json.dumps({"machine": machine(), "versions": versions(), **document}, indent=1) + "\n", encoding="utf-8"
    )
    print(name, json.dumps(document["summary"]), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fresh", action="store_true", help="decompose again")
    parser.add_argument("--trees", type=int, default=20)
    parser.add_argument("--cases", type=int, default=20, help="analogies a component")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the trees that are drawn")
    given = parser.parse_args()
    torch.set_num_threads(1)
    known = known_trees(given.trees, given.fresh, given.seed)
    folder = RESULTS if given.seed == FIRST_SEED else RESULTS / f"seed-{given.seed}"
    hard = {one.name for one in known if one.has_environment}
    about = [
        {
            "tree": one.name,
            "psnr": decibels(one.found, one.truth),
            "values": [one.truth.values, one.found.values],
            "exact": one.exact,
            "environment": one.has_environment,
        }
        for one in known
    ]
    edits = measure_edits(known)
    write(folder, "edits", {"summary": summed(edits, 38.0, hard), "trees": about, "cases": edits})
    lit = measure_relighting(known)
    write(folder, "relight", {"summary": summed(lit, 36.0, hard), "cases": lit})
    rows = measure_analogies(known, given.cases)
    summary = {}
    for which in [None, *Component]:
        own = [row for row in rows if which is None or row["component"] == which.value]
        summary[which.value if which else "all"] = _judged(own)
        if any(not row["environment"] for row in own):
            summary[f"{which.value if which else 'all'}, without environment"] = _judged([row for row in own if not row["environment"]])
    write(folder, "analogy", {"summary": summary, "cases": rows})
    write(folder, "script", {"summary": measure_script(known)})


if __name__ == "__main__":
    main()
