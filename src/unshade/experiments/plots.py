"""Curves of the experiments, drawn from their documents."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from unshade.errors import MissingExtraError
from unshade.experiments.damage import CLEAN, DAMAGES

Document = dict[str, Any]

WIDTH, HEIGHT = 4.2, 3.1


def _panels(path: Path, count: int, fill: Callable[[Any], None]) -> None:
    """``count`` panels in rows of three, filled by ``fill(axes)``. Raises MissingExtraError without matplotlib."""
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtraError("the curves need matplotlib: pip install 'unshade[bench]'") from error
    matplotlib.use("agg")
    from matplotlib import pyplot

    columns = min(3, count)
    rows = -(-count // columns)
    figure, axes = pyplot.subplots(rows, columns, figsize=(WIDTH * columns, HEIGHT * rows), squeeze=False, layout="constrained")
    with matplotlib.rc_context({"font.size": 9}):
        for panel in axes.flat[count:]:
            panel.set_visible(False)
        fill(list(axes.flat[:count]))
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, metadata={"Software": None})
        pyplot.close(figure)


def _finish(panel: Any, title: str, across: str, up: str) -> None:
    panel.set_title(title, fontsize=9)
    panel.set_xlabel(across, fontsize=8)
    panel.set_ylabel(up, fontsize=8)
    panel.grid(alpha=0.3)
    if panel.get_legend_handles_labels()[0]:
        panel.legend(fontsize=7)


def _datasets(entries: Sequence[Document]) -> list[str]:
    return list(dict.fromkeys(entry["dataset"] for entry in entries))


def anytime(document: Document, path: Path) -> None:
    """PSNR of the best tree so far over the seconds of one core, a panel a set."""
    entries = [entry for entry in document["summary"] if entry["curve"]]

    def fill(panels: list[Any]) -> None:
        for panel, dataset in zip(panels, _datasets(entries), strict=True):
            for entry in entries:
                if entry["dataset"] == dataset:
                    line = entry["curve"]
                    panel.plot([point["at"] for point in line], [point["median"] for point in line], marker=".", label=entry["method"])
            panel.set_xscale("log")
            _finish(panel, f"{dataset}", "seconds of one core", "median PSNR, dB")

    if entries:
        _panels(path, len(_datasets(entries)), fill)


def size(document: Document, path: Path) -> None:
    """PSNR over the values of the tree, a panel a set."""
    entries = [entry for entry in document["size"] if entry["sizes"]]

    def fill(panels: list[Any]) -> None:
        for panel, dataset in zip(panels, _datasets(entries), strict=True):
            for k, entry in enumerate(entry for entry in entries if entry["dataset"] == dataset):
                places = [point["at"] for point in entry["sizes"]]
                panel.plot(places, [point["median"] for point in entry["sizes"]], color=f"C{k}", marker=".", label=entry["method"])
                panel.plot(places, [point["p10"] for point in entry["sizes"]], color=f"C{k}", linestyle=":", linewidth=1)
            _finish(panel, dataset, "values of the tree", "median PSNR, dB (dotted: 10th percentile)")

    if entries:
        _panels(path, len(_datasets(entries)), fill)


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
                    panel.plot(range(len(names)), line, marker="o", markersize=3, label=method)
            panel.set_xticks(range(len(names)), ["clean", *map(str, amounts)])
            _finish(panel, kind, {"jpeg": "quality", "size": "pixels"}.get(kind, "amount"), "PSNR, dB")

    if means:
        _panels(path, len(DAMAGES), fill)


UNSEEN = {
    "psnr": "PSNR, dB",
    "child_psnr": "PSNR of children, dB",
    "tree_psnr": "PSNR of trees, dB",
    "type": "types right",
    "first_top": "nats",
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
            panel.plot([line["step"] for line in told], [line["loss"] for line in told], linewidth=1)
            panel.set_yscale("log")
            _finish(panel, log.stem, "step", "loss")
            unseen = [line for line in lines if line["split"] == "test"]
            figure = next((name for name in UNSEEN if unseen and f"realistic_{name}" in unseen[0]), None)
            if figure is not None:
                beside = panel.twinx()
                for k, style in enumerate(("realistic", "toon"), 1):
                    beside.plot(
                        [line["step"] for line in unseen], [line[f"{style}_{figure}"] for line in unseen], color=f"C{k}", label=style
                    )
                beside.set_ylabel(f"unseen nodes: {UNSEEN[figure]}", fontsize=8)
                beside.legend(fontsize=7, loc="center right")

    _panels(path, len(logs), fill)
    return True
