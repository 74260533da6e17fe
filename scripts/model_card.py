"""Write the cards of the weights: docs/model-card.md of all, and one of those that ship beside them, in the package.

``--check`` only says whether both are up to date.
"""

from __future__ import annotations

import sys
from pathlib import Path

from unshade.model_card import CARD, page
from unshade.models.weights import BASELINE_FOLDER, FOLDER

PAGE = Path(__file__).resolve().parent.parent / "docs" / "model-card.md"


def main() -> None:
    for path, card in ((PAGE, page(FOLDER, BASELINE_FOLDER)), (FOLDER / CARD, page(FOLDER))):
        if "--check" not in sys.argv[1:]:
            path.write_text(card, encoding="utf-8", newline="\n")
        elif not path.is_file() or path.read_text(encoding="utf-8") != card:
            sys.exit(f"{path} is out of date: run scripts/model_card.py")


if __name__ == "__main__":
    main()
