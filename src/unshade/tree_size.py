"""How large a tree may be: checked before any pass that recurses."""

from __future__ import annotations

import sys
from functools import lru_cache

MAX_DEPTH = 200
"""Deepest nesting a tree may have. Recursion stays well inside Python's own limit."""

MAX_NODES = 20_000
"""Most nodes a tree may have."""


@lru_cache(maxsize=1)
def depth_limit() -> int:
    """The nesting a recursive pass may use: `MAX_DEPTH`, or less where Python's own limit is low."""
    return min(MAX_DEPTH, sys.getrecursionlimit() // 4)
