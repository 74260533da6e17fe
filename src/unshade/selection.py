"""Which nodes an edit is about: addresses, short addresses, names, and one of several by its number.

An address, a name and a kind mean what they mean everywhere (`nodes.find_address`), and one thing more: where an edit may
change several nodes at once, a word that fits several stands for all of them. The rules, the first that fits:

1. an address in full, with or without its last kind, is that node alone;
2. a name is every node of that name;
3. the end of an address, such as ``multiply.0`` or ``highlight``, or a kind, is every node it fits;
4. ``:n`` after any of these is one of them, counted from 0 in the order of ``unshade show``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from unshade.errors import AddressError, did_you_mean
from unshade.nodes import KINDS, Leaf, Node, find, tint, walk

NUMBERED = re.compile(r"(?P<word>.+):(?P<number>[0-9]+)")


def select(root: Node, where: str) -> list[str]:
    """The addresses of the nodes that ``where`` stands for, at least one, in the order of `nodes.walk`. Raises AddressError."""
    known = dict(walk(root))
    found = _fitting(known, where)
    numbered = NUMBERED.fullmatch(where)
    if not found and numbered:
        several = _fitting(known, numbered["word"])
        number = int(numbered["number"])
        if several and number >= len(several):
            raise AddressError(f"{numbered['word']!r} fits {len(several)} of the nodes, counted from 0, so there is no :{number}")
        found = several[number : number + 1]
    if not found:
        word = numbered["word"] if numbered else where
        raise AddressError(f"no node {word!r}{_suggestion(known, word)}")
    return found


def select_one(root: Node, where: str) -> str:
    """The address of the only node that ``where`` stands for. Raises AddressError, also where there are several."""
    found = select(root, where)
    if len(found) > 1:
        raise AddressError(f"{where!r} fits several nodes: {', '.join(found[:6])}; {where}:0 is the first")
    return found[0]


def select_all(root: Node, wheres: Iterable[str]) -> list[str]:
    """What any of several words stand for, each address once, in the order of `nodes.walk`. Raises AddressError."""
    found = {address for where in wheres for address in select(root, where)}
    return [address for address, _ in walk(root) if address in found]


def holders(root: Node, where: str, parameter: str) -> list[tuple[str, Leaf]]:
    """The leaves that ``where.parameter`` stands for, each with its address.

    A light with a colour, ``multiply(albedo, light)``, holds the parameters of both. Of several nodes those that lack
    the parameter are left alone; AddressError is raised where all do.
    """
    selected = select(root, where)
    found: dict[str, Leaf] = {}
    seen: list[str] = []
    for address in selected:
        node = find(root, address)
        parts = [(address, node)]
        if tint(node) and not isinstance(node, Leaf):
            parts = [(f"{address}.{k}.{child.kind}", child) for k, child in enumerate(node.children)]
        for place, part in parts:
            seen += [part.kind] if part.kind not in seen else []
            if isinstance(part, Leaf) and any(entry.name == parameter for entry in KINDS[part.kind].parameters):
                found[place] = part
    if not found:
        names = [entry.name for kind in seen if kind in KINDS for entry in KINDS[kind].parameters]
        hint = did_you_mean(parameter, dict.fromkeys(names)) if names else "; an operator has none, its leaves do"
        kinds = f" ({', '.join(seen)})" if seen != [where] else ""
        raise AddressError(f"{where}{kinds} has no parameter {parameter!r}{hint}")
    return list(found.items())


def _fitting(known: dict[str, Node], word: str) -> list[str]:
    bare = word.rpartition(".")[2].isdigit()
    places = {address: address.rpartition(".")[0] if bare else address for address in known}
    alone = [address for address, place in places.items() if word in (address, place)]
    named = [address for address, node in known.items() if node.name == word]
    ends = [address for address, place in places.items() if f".{place}".endswith(f".{word}") or known[address].kind == word]
    return (alone or named or ends) if word else []


def _suggestion(known: dict[str, Node], word: str) -> str:
    """The nearest address, name or kind; where none is near, the kinds and names, as addresses would make a long list."""
    words = [*dict.fromkeys(node.kind for node in known.values()), *dict.fromkeys(node.name for node in known.values() if node.name)]
    ends = [".".join(address.split(".")[-2:]) for address in known]
    near = did_you_mean(word, [*words, *ends, *known])
    return near if "did you mean" in near else did_you_mean(word, words)
