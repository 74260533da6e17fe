"""``python -m unshade``."""

from unshade.cli import main

if __name__ == "__main__":
    main()
