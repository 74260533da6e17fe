"""Curves of the experiments, drawn from their documents."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from unshade.errors import MissingExtraError
from unshade.experiments.damage import CLEAN, DAMAGES
from unshade.experiments.summaries import groups
from unshade.files import save_whole

Document = dict[str, Any]

WIDTH, HEIGHT = 3.2, 2.6
"""Of a panel, inches. Letters of 9 points are still read where GitHub shows three panels 900 pixels wide."""

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.constrained_layout.h_pad": 0.07,
}

COLORS = {
    "cnn": "#b0b0b0",
    "lstm": "#808080",
    "transformer": "#404040",
    "learned:alone": "#f2a65a",
    "learned": "#d1431f",
    "search:draft": "#8cc5e8",
    "search:balanced": "#2b7bba",
    "search:best": "#0b2f63",
    "hybrid:balanced": "#2c9a4b",
}
"""A hue a family, so that a method looks the same in every figure."""

FEWEST = 8
"""Pictures, with fewer of which a 10th percentile says nothing."""


def _panels(path: Path, count: int, fill: Callable[[list[Any]], None], columns: int = 3, width: float = WIDTH) -> None:
    """``count`` panels in rows, filled by ``fill``, under one legend for all. Raises MissingExtraError without matplotlib."""
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtraError("the curves need matplotlib: pip install 'unshade[bench]'") from error
    matplotlib.use("agg")
    from matplotlib import pyplot

    columns = min(columns, count)
    rows = -(-count // columns)
    with matplotlib.rc_context(STYLE):
        figure, axes = pyplot.subplots(rows, columns, figsize=(width * columns, HEIGHT * rows), squeeze=False)
        fill(list(axes.flat[:count]))
        named: dict[str, Any] = {}
        for panel in figure.axes:
            named |= {label: handle for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
        for panel in axes.flat[count:]:
            panel.set_axis_off()
        if count < axes.size:
            axes.flat[count].legend([*named.values()], [*named], loc="center")
        else:
            figure.legend([*named.values()], [*named], loc="outside upper center", ncols=min(len(named), 2 * columns), frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_whole(path, lambda file: figure.savefig(file, dpi=160, metadata={"Software": None}))
        pyplot.close(figure)


def _finish(panel: Any, title: str, across: str, up: str) -> None:
    panel.set_title(title)
    panel.set_xlabel(across)
    panel.set_ylabel(up)
    panel.grid(alpha=0.3)


def _color(method: str) -> str:
    """One of matplotlib's own for methods that the experiments do not ask by themselves."""
    return COLORS.get(method, f"C{sum(method.encode()) % 10}")


def _by_dataset(entries: Sequence[Document]) -> dict[str, list[Document]]:
    return {dataset: own for (dataset,), own in groups(entries, "dataset").items()}


def _pictures(dataset: str, count: int) -> str:
    return f"{dataset}, {count} picture{'s' if count > 1 else ''}"


def anytime(document: Document, path: Path) -> None:
    """PSNR of the best tree so far over the seconds of one core, a panel a set."""
    sets = _by_dataset([entry for entry in document["summary"] if entry["curve"]])

    def fill(panels: list[Any]) -> None:
        for panel, (dataset, own) in zip(panels, sets.items(), strict=True):
            for entry in own:
                _line(panel, entry["method"], entry["curve"])
            panel.set_xscale("log")
            panel.xaxis.set_major_formatter("{x:g}")
            _finish(panel, _pictures(dataset, own[0]["pictures"]), "seconds of one core", "median PSNR, dB")

    if sets:
        _panels(path, len(sets), fill)


def _line(panel: Any, method: str, points: Sequence[Document]) -> None:
    places, heights = [point["at"] for point in points], [point["median"] for point in points]
    panel.plot(places, heights, marker=".", color=_color(method), label=method)


def size(document: Document, path: Path) -> None:
    """PSNR over the values of the tree as far as anything changes, a panel a set."""
    sets = _by_dataset([entry for entry in document["size"] if entry["sizes"]])
    counts = {(entry["dataset"], entry["method"]): entry["pictures"] for entry in document["summary"] if entry["damage"] == CLEAN}

    def fill(panels: list[Any]) -> None:
        for panel, (dataset, own) in zip(panels, sets.items(), strict=True):
            end = max(_settled(entry["sizes"]) for entry in own)
            for entry in own:
                points = [point for point in entry["sizes"] if point["at"] <= end]
                _line(panel, entry["method"], points)
                if counts[dataset, entry["method"]] >= FEWEST:
                    worst = [point["p10"] for point in points]
                    panel.plot([point["at"] for point in points], worst, color=_color(entry["method"]), linestyle=":", linewidth=1)
            if any(counts[dataset, entry["method"]] >= FEWEST for entry in own):
                panel.plot([], [], color="black", linestyle=":", linewidth=1, label="10th percentile")
            _finish(panel, _pictures(dataset, counts[dataset, own[0]["method"]]), "values of the tree", "median PSNR, dB")

    if sets:
        _panels(path, len(sets), fill)


def _settled(points: Sequence[Document]) -> float:
    """Where a curve reaches what it ends with."""
    last = (points[-1]["median"], points[-1]["p10"])
    return next(point["at"] for point in points if (point["median"], point["p10"]) == last)


AMOUNTS = {
    "jpeg": ("JPEG", "quality"),
    "noise": ("noise", "deviation, 1/255"),
    "blur": ("blur", "deviation, pixels of 256"),
    "shift": ("disc found in the wrong place", "percent of the radius"),
    "size": ("few pixels", "width of the input, pixels"),
}
"""What a damage is called, and what its amounts are."""


def robustness(document: Document, path: Path) -> None:
    """PSNR against the clean picture, a panel a damage, sets together as the mean of their medians."""
    found: dict[tuple[str, str], list[float]] = {}
    for entry in document["summary"]:
        found.setdefault((entry["method"], entry["damage"]), []).append(entry["psnr"]["median"])
    means = {key: sum(values) / len(values) for key, values in found.items()}
    methods = list(dict.fromkeys(method for method, _ in means))

    def fill(panels: list[Any]) -> None:
        for panel, (kind, amounts) in zip(panels, DAMAGES.items(), strict=True):
            names = [CLEAN, *(f"{kind}:{amount}" for amount in amounts)]
            for method in methods:
                line = [means.get((method, name)) for name in names]
                if None not in line:
                    panel.plot(range(len(names)), line, marker=".", color=_color(method), label=method)
            panel.set_xticks(range(len(names)), ["clean", *map(str, amounts)])
            title, across = AMOUNTS[kind]
            _finish(panel, title, across, "PSNR, dB")

    if means:
        _panels(path, len(DAMAGES), fill)


UNSEEN = {
    "psnr": "PSNR, dB",
    "child_psnr": "PSNR of children, dB",
    "tree_psnr": "PSNR of trees, dB",
    "type": "share of types right",
    "first_top": "nats (less is better)",
}
"""What is drawn of unseen nodes beside the loss: the first of these that a log has."""


def learning(folder: Path, path: Path) -> bool:
    """Losses of every model whose log is in a folder, and a figure of unseen nodes; False where there is none."""
    logs = sorted(folder.glob("*.jsonl"))
    if not logs:
        return False

    def fill(panels: list[Any]) -> None:
        for panel, log in zip(panels, logs, strict=True):
            lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
            told = [line for line in lines if line["split"] == "train"]
            losses = [line["loss"] for line in told]
            panel.plot([line["step"] / 1000 for line in told], losses, color="#999999", linewidth=1, label="loss (left)")
            panel.set_yscale("log")
            panel.set_yticks(*_plain_ticks(min(losses), max(losses)))
            panel.minorticks_off()
            _finish(panel, log.stem, "thousand steps", "loss")
            unseen = [line for line in lines if line["split"] == "test"]
            figure = next((name for name in UNSEEN if unseen and f"realistic_{name}" in unseen[0]), None)
            if figure is not None:
                beside = panel.twinx()
                beside.spines["right"].set_visible(True)
                for style, color in (("realistic", "#2b7bba"), ("toon", "#d1431f")):
                    heights = [line[f"{style}_{figure}"] for line in unseen]
                    beside.plot([line["step"] / 1000 for line in unseen], heights, color=color, label=f"{style}, unseen nodes (right)")
                beside.set_ylabel(UNSEEN[figure])

    _panels(path, len(logs), fill, columns=2, width=1.5 * WIDTH)
    return True


def _plain_ticks(low: float, high: float) -> tuple[list[float], list[str]]:
    """Four places of a logarithmic axis, and their numbers without powers of ten."""
    names = [f"{low * (high / low) ** (step / 3):.2g}" for step in range(4)]
    return [float(name) for name in names], names
