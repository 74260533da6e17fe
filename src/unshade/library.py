"""A page of parts: the paints, forms, lights and masks of many trees, to look through and to combine, offline in one file.

Each part is a picture of a sphere and the text that makes it. Choosing a paint, a form and lights shows what they make
together: the page lays their pictures over each other with the browser's multiply and screen, which is the tree's own
arithmetic, and writes the tree as text for the command line.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import resources

import torch

from unshade.components import Component, Lit, Over, Sides, light_component, take_apart
from unshade.drawing import data_uri
from unshade.errors import TreeError
from unshade.labels import escape, key_values, kind_words, outline
from unshade.nodes import KINDS, Leaf, Node, Operator, Role, Tree, count_values, tint, walk
from unshade.render import render
from unshade.sphere import sphere_normals
from unshade.text import to_text

THUMBNAIL = 96
"""Pixels of a part's picture."""

GROUPS = {
    "albedo": "Paint",
    "diffuse": "Form",
    "highlights": "Highlights",
    "rim": "Rims",
    "environment": "Environments",
    "mask": "Masks",
}
"""What the parts are sorted by, and how the page calls it."""


@dataclass(frozen=True)
class Entry:
    """One part of the page."""

    group: str
    text: str
    node: Node
    sources: tuple[str, ...]
    """``NAME: ADDRESS`` of every tree that has it."""


def parts(trees: Iterable[tuple[str, Tree]]) -> list[Entry]:
    """The parts of named trees, equal ones once, in the order of `GROUPS`, those of several leaves first.

    Raises TreeError for a tree that blends in linear light.
    """
    found: dict[tuple[str, str], Entry] = {}
    for name, tree in trees:
        if tree.blend_space != "srgb":
            raise TreeError(f"{name}: expected a tree that blends in srgb, as a browser does, got {tree.blend_space}")
        for group, address, node in _parts(tree):
            text = to_text(node) if group != "mask" else to_text(_shown_mask(node)).removeprefix(_MASK_HEAD).removesuffix(")")
            known = found.get((group, text))
            sources = (*(known.sources if known else ()), f"{name}: {address}")
            found[group, text] = Entry(group, text, node, sources)
    order = list(GROUPS)
    return sorted(found.values(), key=lambda entry: (order.index(entry.group), isinstance(entry.node, Leaf)))


_MASK_HEAD = "mix(albedo((1, 1, 1)), albedo((0, 0, 0)), "


def _shown_mask(mask: Node) -> Operator:
    assert isinstance(mask, Leaf)
    return Operator("mix", (Leaf("albedo", ((1.0,) * 3,)), Leaf("albedo", ((0.0,) * 3,))), mask)


def _parts(tree: Tree) -> Iterator[tuple[str, str, Node]]:
    """(group, address, node) of every leaf, a light together with its tint, and of paint that is mixed of several."""
    tinted = {
        f"{address}.{k}.{child.kind}" for address, node in walk(tree.root) if _is_tinted_light(node) for k, child in enumerate(_below(node))
    }
    for address, node in walk(tree.root):
        if address in tinted:
            continue
        if _is_tinted_light(node):
            component = light_component(node)
            yield (component or Component.DIFFUSE).value, address, node
        elif isinstance(node, Leaf):
            role = node.role
            group = {Role.PAINT: "albedo", Role.MASK: "mask", Role.HIGHLIGHT: "highlights"}.get(role, role.value)
            yield group, address, node
    yield from (("albedo", address, node) for address, node in _mixed_paints(take_apart(tree.root)))


def _below(node: Node) -> tuple[Node, ...]:
    return node.children if isinstance(node, Operator) else ()


def _is_tinted_light(node: Node) -> bool:
    pair = tint(node)
    return pair is not None and KINDS[pair[1].kind].role in (Role.HIGHLIGHT, Role.RIM, Role.ENVIRONMENT)


def _mixed_paints(lit: Lit) -> Iterator[tuple[str, Node]]:
    if isinstance(lit, Over):
        yield from _mixed_paints(lit.under)
    elif isinstance(lit, Sides):
        yield from (pair for side in (lit.left, lit.right) for pair in _mixed_paints(side))
    elif isinstance(lit.base, Sides):
        yield from _mixed_paints(lit.base)
    else:
        yield from ((part.address, part.node) for part in lit.base.paint if isinstance(part.node, Operator))


def library_html(trees: Iterable[tuple[str, Tree]], title: str = "Parts") -> str:
    """The page. Raises TreeError where there is no part, and for a tree that blends in linear light."""
    entries = parts(trees)
    if not entries:
        raise TreeError("a library needs at least one tree")
    sections = []
    number = 0
    for group, words in GROUPS.items():
        cards = []
        for entry in entries:
            if entry.group == group:
                cards.append(_card(entry, number))
                number += 1
        if cards:
            sections.append(
                f'<section id="{group}"><h2>{words} <small>{len(cards)}</small></h2><div class="cards">{"".join(cards)}</div></section>'
            )
    template = resources.files("unshade").joinpath("library_template.html").read_text(encoding="utf-8")
    kinds = sorted({leaf.kind for entry in entries for _, leaf in walk(entry.node) if isinstance(leaf, Leaf)})
    options = "".join(f"<option>{escape(kind)}</option>" for kind in kinds)
    filled = {"title": escape(title), "sections": "".join(sections), "kinds": options, "count": str(number), "size": str(THUMBNAIL)}
    for key, value in filled.items():
        template = template.replace(f"<!--{key}-->", value)
    return template


def _card(entry: Entry, number: int) -> str:
    node = _shown_mask(entry.node) if entry.group == "mask" else entry.node
    picture = render(node, sphere_normals(THUMBNAIL)).clamp(0.0, 1.0)
    grey = bool((picture[0] == picture[1]).all() and (picture[0] == picture[2]).all())
    kinds = " ".join(dict.fromkeys(leaf.kind for _, leaf in walk(entry.node) if isinstance(leaf, Leaf)))
    words = _words(entry.node)
    source = entry.sources[0] + (f" and {len(entry.sources) - 1} more" if len(entry.sources) > 1 else "")
    values = count_values(entry.node)
    image = data_uri(torch.as_tensor(picture[:1] if grey else picture))
    return (
        f'<button class="card" data-number="{number}" data-group="{entry.group}" data-kinds="{escape(kinds)}" '
        f'data-text="{escape(entry.text)}" data-words="{escape(" ".join((*entry.sources, kinds, words)))}" '
        f'title="{escape(entry.text[:300])}" aria-pressed="false">'
        f'<img src="{image}" width="{THUMBNAIL}" height="{THUMBNAIL}" alt="{escape(words)}">'
        f"<b>{escape(words)}</b><span>{escape(source)}</span><i>{values} values</i></button>"
    )


def _words(node: Node) -> str:
    """What a part is, in short: a single leaf with what tells it from others, several counted."""
    if isinstance(node, Operator):
        return outline(Tree(node))
    values = key_values(node, lines=1)
    return values[0] if node.kind == "albedo" else f"{kind_words(node.kind)}, {', '.join(values)}"


def as_json(entries: Iterable[Entry]) -> str:
    """The parts as JSON, for other programs."""
    return json.dumps(
        [{"group": e.group, "text": e.text, "values": count_values(e.node), "sources": list(e.sources)} for e in entries], indent=1
    )
