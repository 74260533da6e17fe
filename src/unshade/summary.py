"""What `info` and `diff` tell: the facts of a tree, and of two trees side by side, as JSON and as lines."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from typing import Any

from unshade import metrics
from unshade.difference import changes, outline
from unshade.nodes import Family, Member, Node, Tree, steps, walk
from unshade.render import render
from unshade.serde import to_text
from unshade.sphere import sphere_normals


def summary(tree: Tree, family: Family | None) -> dict[str, Any]:
    """The facts of a tree and of its family, ready for JSON. A tree of its own has no ``psnr``: it knows no picture."""
    members = family.members if family else ()
    return {
        "values": tree.values,
        "leaves": tree.leaves,
        "nodes": sum(1 for _ in walk(tree.root)),
        "depth": depth(tree.root),
        "kinds": dict(sorted(Counter(node.kind for _, node in walk(tree.root)).items())),
        "names": {address: node.name for address, node in walk(tree.root) if node.name},
        "structure": outline(tree.root),
        "blend_space": tree.blend_space,
        "exposure": tree.exposure,
        "text": to_text(tree),
        "psnr": _psnr(family.members[family.chosen]) if family else None,
        "family": [_member(member, family is not None and index == family.chosen) for index, member in enumerate(members)],
        "alternatives": [_member(member, False) for member in (family.alternatives if family else ())],
    }


def _member(member: Member, chosen: bool) -> dict[str, Any]:
    found = {"values": member.values, "leaves": member.tree.leaves, "psnr": _psnr(member), "structure": outline(member.tree.root)}
    return found | ({"chosen": True} if chosen else {})


def _psnr(member: Member) -> float | None:
    """None where it is infinite, which JSON does not know."""
    return round(member.psnr, 4) if math.isfinite(member.psnr) else None


def depth(root: Node) -> int:
    """Nodes on the longest way down; 1 for a single leaf."""
    return 1 + max((depth(child) for _, child in steps(root)), default=0)


def summary_lines(found: dict[str, Any]) -> list[str]:
    """`summary` for a person."""
    lines = [
        f"values       {found['values']}",
        f"leaves       {found['leaves']}",
        f"nodes        {found['nodes']}",
        f"depth        {found['depth']}",
        f"blend space  {found['blend_space']}",
        f"exposure     {found['exposure']:g}",
        f"kinds        {', '.join(f'{count} {kind}' for kind, count in found['kinds'].items())}",
        f"structure    {found['structure']}",
    ]
    lines += [f"name         {address} is {name!r}" for address, name in found["names"].items()]
    for title, members in (("family", found["family"]), ("alternatives", found["alternatives"])):
        if len(members) > 1 or (title == "alternatives" and members):
            lines += [f"{title} (values, PSNR, leaves):"]
            lines += [
                f"  {m['values']:4d}  {_decibels(m['psnr'])}  {m['leaves']:3d}{'  chosen' if m.get('chosen') else ''}" for m in members
            ]
    return lines


def _decibels(psnr: float | None) -> str:
    return "     exact" if psnr is None else f"{psnr:7.2f} dB"


def comparison(first: Tree, second: Tree, size: int = 256) -> dict[str, Any]:
    """What differs between two trees, ready for JSON; ``psnr`` is null where the pictures are equal."""
    normals = sphere_normals(size)
    pictures = render(first, normals), render(second, normals)
    found = [dataclasses.asdict(change) for change in changes(first.root, second.root)]
    for field in ("blend_space", "exposure"):
        before, after = getattr(first, field), getattr(second, field)
        if before != after:
            found.append({"what": "changed", "address": "", "parameter": field, "before": str(before), "after": str(after)})
    psnr = metrics.psnr(*pictures)
    return {
        "same": not found,
        "distance": metrics.tree_distance(first, second),
        "psnr": psnr if math.isfinite(psnr) and not bool((pictures[0] == pictures[1]).all()) else None,
        "values": [first.values, second.values],
        "leaves": [first.leaves, second.leaves],
        "changes": found,
    }


def comparison_lines(found: dict[str, Any]) -> list[str]:
    """`comparison` for a person."""
    sign = {"removed": "-", "added": "+", "changed": "~"}
    lines = []
    for change in found["changes"]:
        where = ".".join(part for part in (change["address"], change["parameter"]) if part)
        if change["what"] == "changed":
            lines.append(f"~ {where}: {change['before'] or 'none'} -> {change['after'] or 'none'}")
        else:
            lines.append(f"{sign[change['what']]} {where}: {change['before'] or change['after']}")
    psnr = "the same picture" if found["psnr"] is None else f"{found['psnr']:.2f} dB between the pictures"
    (before, after), (fewer, more) = found["values"], found["leaves"]
    lines.append("the same tree" if found["same"] else f"{len(found['changes'])} differences")
    lines.append(f"tree distance {found['distance']:.4g}, {psnr}, values {before} -> {after}, leaves {fewer} -> {more}")
    return lines
