"""The six experiments: what each measures, and the document that it leaves."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from unshade.bench.datasets import Case
from unshade.bench.measures import quantile
from unshade.bench.options import default_data
from unshade.components import Component
from unshade.experiments import damage, methods
from unshade.experiments.jobs import Job, Measure, Row
from unshade.experiments.options import ABLATION, SAMPLED, Options
from unshade.experiments.subjects import POOLS, STYLES, find_cases
from unshade.experiments.summaries import best_within, figures, groups, public, rounded, spread
from unshade.experiments.understanding import Question, truths
from unshade.metrics import psnr
from unshade.models.config import BASELINES
from unshade.nodes import Tree
from unshade.render import render
from unshade.sphere import sphere_normals

SETS = (*STYLES, "pbr", "wild")
SHOWN_SETS = ("layered", "pbr", "drawings")

PAPERS = "learned:overall"
"""The paper's method and nothing of ours, which stands beside it in the table of decomposition."""

ANALOGIES = 300
"""Of each component."""

POOL = 40
"""Known trees of each style, which the analogies draw from."""

PLAIN = "all, no environment map"
"""Analogies of four trees that reflect nothing: a parametric tree shows a reflected photo as a few lights at most."""

CHANGED = 35.0
"""An analogy is only asked where the component changes both pictures by more than this, dB."""

PERCEPTUAL = 20
"""Analogies of each component that st_lpips, about a second each, is taken of."""

FEW = 8
"""Pictures of each set where many versions or moments of each are measured."""

SECONDS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0)
SIZES = (8, 16, 24, 32, 48, 64, 96, 128, 160)


@dataclass
class Context:
    """What a part needs: options, the methods that can run, and who measures."""

    options: Options
    methods: Sequence[str]
    measure: Measure
    perceptual: bool
    skipped: dict[str, str] = field(default_factory=dict)

    def cases(self, dataset: str, usual: int) -> list[Case]:
        """Of a set; an absent one is noted."""
        data = self.options.data or default_data()
        found = find_cases(dataset, data, self.options.count(usual))
        if not found:
            self.skipped[dataset] = f"no folder {dataset} with pictures in {data.name or data}; --data says where else"
        return found

    @property
    def reflecting(self) -> list[str]:
        """The default with reflected environments as pictures, where its weights are."""
        found = [f"{method}{methods.REFLECTIONS}" for method in self.methods if method == "search:balanced"]
        return [method for method in found if methods.missing(method, self.options.weights) is None]

    def job(self, kind: Any, case: Case, method: str, **more: Any) -> Job:
        """One job with this run's seed and weights."""
        folder = self.options.weights
        return Job(kind, case, method, self.options.seed, folder, methods.digest(method, folder), **more)


Document = dict[str, Any]


def decomposition(context: Context) -> tuple[Document, list[Row]]:
    """Experiment 1: every method on both styles and on real spheres."""
    used = [entry for method in context.methods for entry in ((PAPERS, method) if method == "learned" else (method,))]
    used += [*(f"{method}{methods.FIT}" for method in context.methods if method in BASELINES), *context.reflecting]
    jobs = [
        context.job("tree", case, method, perceptual=context.perceptual)
        for dataset in SETS
        for case in context.cases(dataset, SAMPLED if dataset in STYLES else 1_000)
        for method in used
    ]
    rows = context.measure(jobs)
    tables = [
        {"dataset": dataset, "method": method, **figures(own)} for (dataset, method), own in groups(rows, "dataset", "method").items()
    ]
    released = [
        {"dataset": dataset, "method": method, **figures(own)}
        for (dataset, method, plain), own in groups([row for row in rows if "released" in row], "dataset", "method", "released").items()
        if plain
    ]
    return {"summary": tables, "released": released, "rows": public(rows)}, rows


def ablation(context: Context) -> tuple[Document, list[Row]]:
    """Experiment 3: the paper's method without its parts, then with one more each time."""
    used = [method for method in ABLATION if "learned" in context.methods]
    jobs = [
        context.job("tree", case, method, perceptual=context.perceptual)
        for dataset in (*STYLES, "pbr")
        for case in (context.cases(dataset, 3 * FEW) if used else [])
        for method in used
    ]
    rows = context.measure(jobs)
    tables = [
        {"dataset": dataset, "method": method, **figures(own)} for (dataset, method), own in groups(rows, "dataset", "method").items()
    ]
    return {"summary": tables, "settings": methods.described(), "rows": public(rows)}, rows


def questions(component: Component, count: int, size: int, seed: int) -> list[Question]:
    """Analogies of one component, of one style each, drawn from the pools until the component shows."""
    chance = random.Random(f"{component.value} {seed}")
    # No drawing of the released grammar reflects an environment.
    styles = POOLS[:1] if component is Component.ENVIRONMENT else POOLS
    found: list[Question] = []
    attempts = 0
    while len(found) < count and attempts < 200 * count:
        attempts += 1
        numbers = chance.sample(range(size), 4)
        question = Question(styles[len(found) % len(styles)], component.value, (numbers[0], numbers[1], numbers[2], numbers[3]))
        a, _, p, _, ab, answer = truths(question, seed)
        if _apart(a, ab) < CHANGED and _apart(p, answer) < CHANGED:
            found.append(question)
    return found


def _apart(a: Tree, b: Tree) -> float:
    normals = sphere_normals(48)
    return psnr(render(a, normals), render(b, normals))


def analogy(context: Context) -> tuple[Document, list[Row]]:
    """Experiment 2: A is to AB as P is to what?"""
    seed, count = context.options.seed, context.options.count(ANALOGIES)
    size = POOL if context.options.limit is None else min(POOL, 4 + 2 * count)
    asked = [question for component in Component for question in questions(component, count, size, seed)]
    used = {(question.dataset, number) for question in asked for number in question.numbers}
    cases = [case for dataset in POOLS for case in find_cases(dataset, default_data(), size) if (dataset, case.number) in used]
    tried = [*context.methods, *context.reflecting]
    pictures = context.measure([context.job("tree", case, method) for method in tried for case in cases])
    trees = {(row["method"], row["dataset"], int(row["name"])): row["tree"] for row in pictures}
    jobs = []
    for method in tried:
        places: dict[str, int] = {}
        for question in asked:
            place = places[question.component] = places.get(question.component, -1) + 1
            given = [trees.get((method, question.dataset, number)) for number in question.numbers]
            if None in given:
                continue  # one of its pictures failed, which has been told
            full = dataclasses.replace(question, found=tuple(tree for tree in given if tree is not None))
            case = Case("analogy", f"{question.component}-{place:03d}-{'-'.join(map(str, question.numbers))}")
            jobs.append(context.job("analogy", case, method, perceptual=context.perceptual and place < PERCEPTUAL, question=full))
    rows = context.measure(jobs)
    tables = [
        {"method": method, "component": component, **_judged(own)}
        for (method, component), own in groups(rows, "method", "component").items()
    ]
    tables += [{"method": method, "component": "all", **_judged(own)} for (method,), own in groups(rows, "method").items()]
    plain = [row for row in rows if not row["with_environment"]]
    tables += [{"method": method, "component": PLAIN, **_judged(own)} for (method,), own in groups(plain, "method").items()]
    about = [
        {"method": method, "dataset": dataset, **figures(own)} for (method, dataset), own in groups(pictures, "method", "dataset").items()
    ]
    return {"summary": tables, "pool": about, "cases": public(rows)}, [*pictures, *rows]


def _judged(rows: Sequence[Row]) -> Row:
    found = {"right": rounded(sum(row["right"] for row in rows) / len(rows))}
    found["right_by_trees"] = rounded(sum(row["by_trees"] == row["component"] for row in rows) / len(rows))
    for name in ("psnr", "ssim", "st_lpips"):
        numbers = [row[name] for row in rows if row.get(name) is not None]
        if numbers:
            found[name] = spread(numbers)
    return found | {"faults": sum("fault" in row for row in rows)}


def robustness(context: Context) -> tuple[Document, list[Row]]:
    """Experiment 4: quality over size, and what is left of it when pictures suffer. Scored against the clean picture."""
    used = [method for method in context.methods if method not in ("search:draft", "search:best", "learned:alone")] or list(context.methods)
    jobs = [
        context.job("tree", case, method, damage=what)
        for dataset in (*STYLES, "pbr")
        for case in context.cases(dataset, FEW)
        for method in used
        for what in damage.ALL
    ]
    rows = context.measure(jobs)
    tables = [
        {"dataset": dataset, "method": method, "damage": what, **figures(own)}
        for (dataset, method, what), own in groups(rows, "dataset", "method", "damage").items()
    ]
    families = groups([row for row in rows if row["curve"] and row["damage"] == damage.CLEAN], "dataset", "method")
    sizes = [{"dataset": dataset, "method": method, "sizes": _over(own, "curve", SIZES)} for (dataset, method), own in families.items()]
    lines = [{**public([row])[0], "damage": row["damage"]} for row in rows]
    return {"summary": tables, "size": sizes, "rows": lines}, rows


def _over(rows: Sequence[Row], curve: str, limits: Sequence[float]) -> list[dict[str, float]]:
    """Median of the best so far at some limits, where every picture has something."""
    found = []
    for limit in limits:
        best = [best_within(row[curve], limit) for row in rows]
        known = [entry for entry in best if entry is not None]
        if len(known) == len(best):
            found.append({"at": limit, "median": rounded(quantile(known, 0.5)), "p10": rounded(quantile(known, 0.1))})
    return found


def anytime(context: Context) -> tuple[Document, list[Row]]:
    """Experiment 4: the best tree so far over time, of methods that improve theirs."""
    used = [method for method in context.methods if method not in BASELINES]
    jobs = [
        context.job("time", case, method)
        for dataset in (*STYLES, "pbr")
        for case in (context.cases(dataset, FEW) if used else [])
        for method in used
    ]
    rows = context.measure(jobs)
    tables = [
        {
            "dataset": dataset,
            "method": method,
            "pictures": len(own),
            "seconds": spread([row["cpu_seconds"] for row in own]),
            "psnr": spread([row["psnr"] for row in own]),
            "curve": _over(own, "anytime", SECONDS),
        }
        for (dataset, method), own in groups(rows, "dataset", "method").items()
    ]
    return {"summary": tables, "rows": public(rows)}, rows


def wild(context: Context) -> tuple[Document, list[Row]]:
    """Experiment 4: artists' MatCaps, real spheres and drawings, shown."""
    used = [method for method in context.methods if methods.name_of(method).kind in ("learned", "hybrid")]
    used += [method for method in ("search:balanced", "search:best") if method in context.methods]
    used = used or list(context.methods)
    jobs = [
        context.job("tree", case, method, perceptual=context.perceptual)
        for dataset in (*SHOWN_SETS, "wild")
        for case in context.cases(dataset, 12)
        for method in used
    ]
    rows = context.measure(jobs)
    tables = [
        {"dataset": dataset, "method": method, **figures(own)} for (dataset, method), own in groups(rows, "dataset", "method").items()
    ]
    return {"summary": tables, "rows": public(rows)}, rows


PARTS: dict[str, Callable[[Context], tuple[Document, list[Row]]]] = {
    "decomposition": decomposition,
    "analogy": analogy,
    "ablation": ablation,
    "robustness": robustness,
    "anytime": anytime,
    "wild": wild,
}
