"""The rules that trees follow, and what is asked of a tree beyond what its nodes check themselves.

Two grammars are written here as data. `PAPER` is table 1 of Geng et al. 2023, which allows any nesting and is what every
tree here may use. `RELEASED` is the narrower grammar of the authors' data sampler (see `unshade.sampler`). A rule is a
symbol and what may stand for it: another symbol, a leaf kind, or an operator with its operands.
"""

from __future__ import annotations

from typing import TypeAlias

from unshade.canonical import canonical, same_structure, structure_key
from unshade.errors import TreeError
from unshade.nodes import Node, Operator, Tree, walk
from unshade.sampler import RELEASED, all_canonical_structures, sample
from unshade.tree_size import MAX_NODES, depth_limit

__all__ = [
    "PAPER",
    "RELEASED",
    "all_canonical_structures",
    "canonical",
    "check_size",
    "problems",
    "same_structure",
    "sample",
    "structure_key",
    "validate",
]

Rules: TypeAlias = "dict[str, tuple[str | tuple[str, ...], ...]]"

PAPER: Rules = {
    "Tree": (
        ("mix", "Tree", "Tree", "Mask"),
        ("multiply", "Tree", "Tree"),
        ("screen", "Tree", "Tree"),
        "albedo",
        "diffuse",
        "environment_map",
        "highlight",
    ),
    "Mask": ("image_mask",),
}
"""Geng et al. 2023, table 1. Our other kinds stand where their role allows: masks in a mix, all else as a Tree."""


def check_size(root: Node) -> None:
    """Raise TreeError for more than `MAX_NODES` nodes or nesting deeper than `depth_limit`. Never recurses."""
    stack = [(1, root)]
    limit, count = depth_limit(), 0
    while stack:
        depth, node = stack.pop()
        count += 1
        if count > MAX_NODES:
            raise TreeError(f"a tree may have {MAX_NODES} nodes at most")
        if depth > limit:
            raise TreeError(f"nested too deep: {limit} levels at most")
        if isinstance(node, Operator):
            count += node.mask is not None
            stack += [(depth + 1, child) for child in node.children]


def problems(tree: Tree | Node) -> list[TreeError]:
    """All that is wrong with a tree, each with its address; empty for a good one.

    A node checks its own kind, parameters and operands when it is made, so what is left is what only a whole tree
    shows: its size, and names by which no single node can be found.
    """
    root = tree.root if isinstance(tree, Tree) else tree
    try:
        check_size(root)
    except TreeError as error:
        return [error]
    found = []
    nodes = dict(walk(root))
    seen: dict[str, str] = {}
    for address, node in nodes.items():
        if node.name is None:
            continue
        if not node.name.strip():
            found.append(TreeError("a name needs a visible letter", address))
        elif node.name in nodes and node.name != address:
            found.append(TreeError(f"the name {node.name!r} is the address of another node", address))
        elif node.name in seen:
            found.append(TreeError(f"the name {node.name!r} is taken by {seen[node.name]}", address))
        seen.setdefault(node.name, address)
    return found


def validate(tree: Tree | Node) -> None:
    """Raise TreeError, with the address, for the first of a tree's `problems`."""
    for problem in problems(tree):
        raise problem
