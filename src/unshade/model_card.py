"""The page about trained weights, from what stands in their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from unshade.files import write_whole
from unshade.models import weights

TITLES = {
    "vqvae": "VQ-VAE-2: node images to codes and back",
    "prior": "Priors: the codes of children",
    "heads": "Heads: operator (f), mask (g) and type (h)",
    "reflection": "Reflection: a picture to its environment and the picture without",
}

BASELINES = {
    "cnn": "CNN baseline: one step at once",
    "lstm": "LSTM baseline: trees in tokens",
    "transformer": "Transformer baseline: trees in tokens",
}
"""Described where they lie beside the others."""

MEANINGS = {
    "psnr": "PSNR of decoded node images, dB",
    "psnr_worst_tenth": "PSNR that nine nodes in ten reach, dB",
    "psnr_parents": "PSNR of parents alone, dB",
    "top_codes_used": "top codes used at all",
    "top_perplexity": "perplexity of the top codes",
    "bottom_codes_used": "bottom codes used at all",
    "bottom_perplexity": "perplexity of the bottom codes",
    "first_top": "top codes of the first child, nats a code",
    "first_bottom": "bottom codes of the first child, nats a code",
    "second_top": "top codes of the second child, nats a code",
    "second_bottom": "bottom codes of the second child, nats a code",
    "operator": "operators right",
    "type": "types of children right",
    "type_balanced": "types of children right, mean over the types",
    "mask_iou": "mask IoU",
    "mix_psnr": "PSNR of the parent mixed by the mask, dB",
    "operator_decoded": "operators right, children decoded from codes",
    "type_decoded": "types of children right, children decoded from codes",
    "type_balanced_decoded": "the same, mean over the types",
    "mask_iou_decoded": "mask IoU, children decoded from codes",
    "mix_psnr_decoded": "PSNR of the parent mixed by the mask, children decoded from codes, dB",
    "environment_psnr": "PSNR of environments, dB",
    "plain_psnr": "PSNR of pictures without their environment, dB",
    "untouched_psnr": "PSNR of pictures that have none, dB",
    "child_psnr": "PSNR of the children foretold, dB",
    "nats": "nats a token, against softened targets",
    "kinds_right": "kinds right, given all tokens before",
    "structure": "trees with all kinds right",
    "tree_psnr": "PSNR of the trees written, dB",
}
STYLES = ("realistic", "toon")

CARD = "model-card.md"
"""Name of the page, beside the weights."""

SHIPPED = """\
The weights that ship with `unshade`, written by `unshade train all`. The learned method reads all but `reflection`, which tells a search
what a picture reflects. This page is made from what stands in the files (`scripts/model_card.py`). Safetensors, parameters in half
precision; how they were trained stands in `docs/training.md` of the repository. The baselines, which nothing but the experiments reads
(`docs/experiments.md`), are not in the package; they lie in `benchmarks/weights` of the repository.
"""

OF_A_RUN = """\
The weights of one run of `unshade train`, which lie beside this page; `unshade decompose --weights` takes the folder. The learned
method reads `vqvae`, `prior` and `heads`; `reflection` tells a search what a picture reflects. This page is made from what stands in
the files. Safetensors, parameters in half precision.
"""

DISTRIBUTION = """\
Made for node images of shade trees: synthetic shaded spheres of the released grammar and wider ones, black outside the disc. Figures
are of nodes from the test half of the data, whose colours, directions, masks and environment maps occur in no training tree. Photographs
of real spheres are another distribution, and nothing here says how well it goes there.
"""


def page(*folders: Path, origin: str = SHIPPED) -> str:
    """The card of all weights in some folders, as Markdown. Raises MissingWeightsError, WeightsError."""
    sections = [(name, folder) for folder in folders for name in TITLES | BASELINES if weights.file_of(name, folder).is_file()]
    return f"# Model card\n\n{origin}\n{DISTRIBUTION}" + "".join(_section(name, folder) for name, folder in sections)


def write_card(folder: Path) -> Path:
    """Put the page about a run beside its weights. Raises OutputError."""
    path = folder / CARD
    write_whole(path, page(folder, origin=OF_A_RUN).encode())
    return path


def _section(name: str, folder: Path) -> str:
    path = weights.file_of(name, folder)
    card = weights.read_card(path)
    finished = "" if card["steps"] >= card["of"] else f" of {card['of']:,}: not finished"
    made = f"{card['hours']:.1f} hours on {card['hardware']}, precision {card['precision']}, PyTorch {card['torch']}"
    lines = [
        f"## {(TITLES | BASELINES)[name]}",
        "",
        f"`{path.name}`, {path.stat().st_size / 2**20:.1f} MiB, configuration `{card['config']}`.",
        "",
        f"- Data: {card['data']}; {card['examples']:,} examples.",
        f"- Training: {card['steps']:,} steps{finished}, {made}.",
        "",
        *_table(card["figures"]),
    ]
    return "\n" + "\n".join(lines) + "\n"


def _table(figures: dict[str, Any]) -> list[str]:
    """A row a figure, a column a style."""
    rows = [
        f"| {MEANINGS[key]} | {' | '.join(_number(figures.get(f'{style}_{key}')) for style in STYLES)} |"
        for key in MEANINGS
        if _has(figures, key)
    ]
    return ["| unseen nodes | realistic | toon |", "|---|---|---|", *rows]


def _has(figures: dict[str, Any], key: str) -> bool:
    return any(f"{style}_{key}" in figures for style in STYLES)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
