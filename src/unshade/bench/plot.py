"""PSNR over values, a panel a data set: families as lines, fixed structures as points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from unshade.errors import MissingExtraError
from unshade.files import save_whole


def curves(documents: Sequence[dict[str, Any]], folder: Path) -> None:
    """Write ``curve.png`` and ``curve.svg``. Raises MissingExtraError without matplotlib."""
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtraError("the curve needs matplotlib: pip install 'unshade[bench]'") from error
    matplotlib.use("agg")
    from matplotlib import pyplot

    datasets = list(dict.fromkeys(document["dataset"] for document in documents))
    if not datasets:
        return
    columns = min(3, len(datasets))
    rows = -(-len(datasets) // columns)
    # Without a fixed salt and with a date, the same results would give another file each time.
    with matplotlib.rc_context({"svg.hashsalt": "unshade", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = pyplot.subplots(rows, columns, figsize=(4.2 * columns, 3.2 * rows), squeeze=False, layout="constrained")
        for panel in axes.flat[len(datasets) :]:
            panel.set_visible(False)
        for panel, dataset in zip(axes.flat, datasets, strict=False):
            _panel(panel, dataset, [document for document in documents if document["dataset"] == dataset])
        save_whole(folder / "curve.png", lambda file: figure.savefig(file, dpi=120, metadata={"Software": None}))
        save_whole(folder / "curve.svg", lambda file: figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None}))
        pyplot.close(figure)


def _panel(panel: Any, dataset: str, documents: Sequence[dict[str, Any]]) -> None:
    for index, document in enumerate(documents):
        color, found, line = f"C{index % 10}", document["summary"], document["curve"]
        label = f"{document['method']} ({found['pictures']})"
        if line:
            sizes = [point["values"] for point in line]
            panel.plot(sizes, [point["median"] for point in line], color=color, label=label)
            panel.plot(sizes, [point["p10"] for point in line], color=color, linestyle=":", linewidth=1)
        else:
            size = found["values"]["median"]
            panel.plot([size], [found["psnr"]["median"]], "o", color=color, label=label)
            panel.plot([size], [found["psnr"]["p10"]], "o", color=color, markerfacecolor="none")
    panel.set_title(f"{dataset}: method (pictures)")
    panel.set_xlabel("values of the tree")
    panel.set_ylabel("PSNR, dB: median (dotted, hollow: 10th percentile)", fontsize=7)
    panel.set_xlim(left=0)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=7)
