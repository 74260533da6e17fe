"""The report of a decomposition: one HTML file that opens offline, with every picture inside.

The page shows one tree of the family at a time. Each tree's part of the page, its *sheet*, stands in a `<template>`,
and choosing a point of the curve puts it in place; without a script the chosen tree is shown.
"""

from __future__ import annotations

import base64
import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

import torch

from unshade import labels
from unshade.drawing import STYLE, data_uri, tree_svg
from unshade.labels import escape, number
from unshade.nodes import Member, Tree
from unshade.render import part, render
from unshade.report_cards import cards
from unshade.report_chart import Point, chart
from unshade.serde import dumps, to_text
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals

if TYPE_CHECKING:
    from unshade.decompose import Result
    from unshade.pictures import SphereImage

BUDGET = 1_400_000
"""Characters of the page; a family that needs more has points that cannot be chosen."""

GAINS = (1, 2, 4, 8, 16, 32, 64)
"""How many times brighter the difference may be shown."""

FINE, COARSE = 160, 80
"""Pixels of a thumbnail of the chosen tree, and of the others."""

SLOTS = ("figures", "pictures", "about", "tree", "leaves", "parts", "text")


@dataclass(frozen=True)
class _Picture:
    """What every sheet is compared with."""

    image: torch.Tensor
    valid: torch.Tensor
    """(1, S, S) bool: the pixels that are not ignored."""
    scored: torch.Tensor
    """(1, S, S) bool: those of them that count."""
    gain: int

    def difference(self, rendered: torch.Tensor) -> torch.Tensor:
        """(4, S, S): the amplified absolute difference where it is scored, transparent where the input is ignored."""
        seen = self.valid | ~disc_mask(self.image.shape[-1])
        return torch.cat([(rendered - self.image).abs() * self.gain * self.scored, seen.to(rendered.dtype)])


def report_html(result: Result, sphere: SphereImage, source_name: str, figures: Mapping[str, Any]) -> str:
    """The whole page.

    Args:
        result: the chosen tree and its family.
        sphere: the picture that was decomposed.
        source_name: what to call the picture.
        figures: any of ``psnr``, ``ssim``, ``st_lpips``, ``values``, ``leaves``, ``seconds``, ``seed`` and ``preset``; None is left out.
            ``stages`` is a sentence: who made the tree.
    """
    family = result.family
    image = sphere.image.detach().float().cpu()
    size = image.shape[-1]
    rendered = render(result.tree, sphere_normals(size))
    scored = disc_mask(size, SCORED_RADIUS) & sphere.valid.cpu()
    picture = _Picture(image, sphere.valid.cpu(), scored, _gain((rendered - image).abs() * scored))

    keys = [f"tree-{index}" for index in range(len(family.members))]
    others = [f"other-{index}" for index in range(len(family.alternatives))]
    chosen = keys[family.chosen]
    members = dict(zip([*keys, *others], [*family.members, *family.alternatives], strict=True))
    members[chosen] = Member(result.tree, result.psnr)
    shown = {"seed": result.seed, "preset": result.preset, **figures}
    stages = shown.pop("stages", "")
    sheets = {chosen: _sheet(chosen, members[chosen], picture, "The chosen tree", shown, fine=True)}
    template = (resources.files("unshade") / "report_template.html").read_text(encoding="utf-8")
    stored = base64.b64encode(dumps(family).encode()).decode()
    shown_input = data_uri(image, "webp")
    room = BUDGET - len(template) - len(stored) - len(shown_input) - _length(sheets[chosen])
    for key in [*others, *(keys[index] for index in _by_interest(len(keys), family.chosen))]:
        sheet = _sheet(key, members[key], picture, _standing(key in others, members[key], result.tree), {})
        room -= _length(sheet) + len(_choice(key, members[key], False))
        if room < 0:
            break
        sheets[key] = sheet

    points = [Point(key, member.values, member.psnr, key in sheets, key == chosen, key in others) for key, member in members.items()]
    return _filled(
        template,
        {
            "title": escape(source_name),
            "stages": f'<p class="quiet stages">{escape(stages[0].upper() + stages[1:])}.</p>' if stages else "",
            "tree_style": STYLE,
            "chosen": chosen,
            "input": shown_input,
            "size": str(size),
            "chart": chart(points),
            "strip": "".join(_choice(key, members[key], key == chosen) for key in keys if key in sheets),
            "others": _others({key: members[key] for key in others if key in sheets}),
            "count": str(len(keys)),
            "family_state": "hidden" if len(members) == 1 else "",
            "templates": "".join(_template(key, sheet) for key, sheet in sheets.items() if key != chosen),
            "json": stored,
            "file_name": escape(re.sub(r"[^\w.-]+", "_", source_name).rpartition(".")[0] or "tree") + ".tree.json",
            **{f"slot_{slot}": sheets[chosen][slot] for slot in SLOTS},
        },
    )


def _filled(template: str, values: Mapping[str, str]) -> str:
    """Replace every ``{{name}}`` in one pass, so that what is put in is never searched again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: values[found[1]], template)


def _by_interest(count: int, chosen: int) -> list[int]:
    """The other trees of a family: the neighbours of the chosen one, the ends, then ever finer steps between them."""
    wanted = [chosen - 1, chosen + 1, 0, count - 1]
    step = 1 << count.bit_length()
    while step > 1:
        step //= 2
        wanted += range(step, count, step)
    return [index for index in dict.fromkeys(wanted) if 0 <= index < count and index != chosen]


def _length(sheet: Mapping[str, str]) -> int:
    return sum(len(part) for part in sheet.values())


def _gain(difference: torch.Tensor) -> int:
    """The largest gain that keeps all but the worst half per cent of the pixels in range."""
    worst = float(torch.quantile(difference.amax(0).flatten(), 0.995))
    return max((gain for gain in GAINS if gain * worst <= 1.0), default=1)


def _words(member: Member) -> str:
    return f"{member.values} values, {labels.decibels(member.psnr)}"


def _standing(other: bool, member: Member, chosen: Tree) -> str:
    """What a tree is beside the chosen one."""
    if other:
        return "Another explanation"
    return (
        "A simpler tree"
        if member.values < chosen.values
        else "A larger tree"
        if member.values > chosen.values
        else "A tree of the same size"
    )


def _sheet(key: str, member: Member, picture: _Picture, standing: str, figures: Mapping[str, Any], fine: bool = False) -> dict[str, str]:
    """Everything on the page that belongs to one tree."""
    tree, size = member.tree, picture.image.shape[-1]
    rendered = render(tree, sphere_normals(size))
    shown = {
        "psnr": member.psnr,
        "values": tree.values,
        "leaves": tree.leaves,
        **{name: value for name, value in figures.items() if value is not None},
    }
    encoding = "webp" if fine else "webp-lossy"
    drawn = tree_svg(
        tree,
        title=f"Shade tree of {_words(member)}: {labels.outline(tree)}",
        thumbnail=FINE if fine else COARSE,
        encoding="webp-lossy",
        quality=88 if fine else 80,
        prefix=key,
        standalone=False,
    )
    return {
        "figures": _figures(shown),
        "pictures": _figure(
            "Render",
            f"the tree’s {tree.values} values",
            data_uri(rendered, encoding),
            f"Render of the tree, {_words(member)}",
            size,
            "render",
        )
        + _figure(
            "Difference",
            f"absolute, {picture.gain} × brighter" if picture.gain > 1 else "absolute",
            data_uri(picture.difference(rendered), "webp-lossy"),
            f"Absolute difference between input and render, {picture.gain} times brighter",
            size,
            "difference",
        ),
        "about": f'<h3>{standing}</h3><p>{escape(_words(member))}</p><p class="quiet">{escape(labels.outline(tree))}</p>',
        "tree": drawn,
        "leaves": "".join(cards(tree, key)),
        "parts": _parts(tree, 192 if fine else 128),
        "text": escape(to_text(tree)),
    }


def _figures(figures: Mapping[str, Any]) -> str:
    """The numbers below the title, in a fixed order; names that are not known here come last as they are."""
    known = {
        "psnr": ("PSNR", " dB"),
        "ssim": ("SSIM", ""),
        "st_lpips": ("ST-LPIPS", ""),
        "values": ("values", ""),
        "leaves": ("leaves", ""),
        "seconds": ("seconds", ""),
        "preset": ("preset", ""),
        "seed": ("seed", ""),
    }
    parts = []
    for name in [*known, *(name for name in figures if name not in known)]:
        if name in figures:
            value = figures[name]
            words, unit = known.get(name, (labels.kind_words(name), ""))
            text = (
                value
                if isinstance(value, str)
                else str(value)
                if isinstance(value, int)
                else labels.decibels(value).split()[0]
                if name == "psnr"
                else number(value)
            )
            parts.append(f"<div><dt>{escape(words)}</dt><dd>{escape(text)}<small>{unit}</small></dd></div>")
    return "".join(parts)


def _figure(title: str, words: str, uri: str, alt: str, size: int, name: str) -> str:
    return (
        f'<figure data-picture="{name}"><img class="disc" src="{uri}" width="{size}" height="{size}" alt="{escape(alt)}">'
        f"<figcaption><b>{escape(title)}</b> <span>{escape(words)}</span></figcaption></figure>"
    )


def _parts(tree: Tree, size: int) -> str:
    """The diffuse and the specular part, as `render.part` tells them apart."""
    about = {
        "diffuse": ("Diffuse part", "paint and form, every light black"),
        "specular": ("Specular part", "highlights, rims and reflections alone"),
    }
    parts = []
    for which, (title, words) in about.items():
        rendered = render(dataclasses.replace(tree, root=part(tree.root, which)), sphere_normals(size))
        parts.append(_figure(title, words, data_uri(rendered, "webp-lossy"), f"{title}: {words}", size, which))
    return "".join(parts)


def _choice(key: str, member: Member, chosen: bool) -> str:
    """A button of the strip of renders."""
    small = render(member.tree, sphere_normals(64))
    state = f'aria-pressed="{"true" if chosen else "false"}" title="{escape(labels.outline(member.tree))}"'
    return (
        f'<button type="button" class="choice" data-show="{key}" {state}>'
        f'<img class="disc" src="{data_uri(small, "webp-lossy", 80)}" width="64" height="64" alt="">'
        f'<span class="amount">{member.values}<span class="unseen"> values</span></span>'
        f'<span class="quality">{labels.decibels(member.psnr)}</span></button>'
    )


def _others(members: Mapping[str, Member]) -> str:
    """Trees of the chosen size with another structure."""
    if not members:
        return ""
    cards = "".join(
        f"<li>{_choice(key, member, False)}<p>{escape(labels.outline(member.tree))}</p></li>" for key, member in members.items()
    )
    words = "Trees of about the same size with another structure."
    return f'<div class="others"><h3>Other explanations</h3><p class="quiet">{words}</p><ul>{cards}</ul></div>'


def _template(key: str, sheet: Mapping[str, str]) -> str:
    slots = "".join(f'<div data-slot="{slot}">{sheet[slot]}</div>' for slot in SLOTS)
    return f'<template data-sheet="{key}">{slots}</template>\n'
