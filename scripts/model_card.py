"""Write docs/model-card.md from the weights that ship; ``--check`` only says whether it is up to date."""

from __future__ import annotations

import sys
from pathlib import Path

from unshade.model_card import page
from unshade.models.weights import BASELINE_FOLDER, FOLDER

PAGE = Path(__file__).resolve().parent.parent / "docs" / "model-card.md"


def main() -> None:
    card = page(FOLDER, BASELINE_FOLDER)
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(card, encoding="utf-8", newline="\n")
    elif not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != card:
        sys.exit("docs/model-card.md is out of date: run scripts/model_card.py")


if __name__ == "__main__":
    main()
