"""Words and short numbers for the nodes of a tree, as the drawing and the report print them. Nothing here is lossless."""

from __future__ import annotations

import html
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence

import torch

from unshade.nodes import KINDS, Leaf, Node, Operator, Parameter, Raster, Role, Tree, tint, walk
from unshade.render import srgb_encode

_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_ARROWS = "→↗↑↖←↙↓↘"
FACING_ANGLE = math.radians(5.0)
"""A direction closer than this to the viewer has no arrow."""

SIGNS = {"multiply": "×", "screen": "screen", "mix": "mix"}
"""What stands between the children of an operator."""


def escape(text: str) -> str:
    """Text for HTML and XML, quotes included; a character that XML forbids becomes U+FFFD."""
    return html.escape(_NOT_XML.sub("\ufffd", text), quote=True)


def number(value: float) -> str:
    """Three significant digits without an exponent: ``0.0413``, ``1.5``, ``120``, ``4820``; infinity is ``∞``."""
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0.0 or abs(value) < 5e-5:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:.{min(digits, 4)}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return text.replace("-", "−")


def shown_color(color: Sequence[float], space: str = "srgb") -> str:
    """``#rrggbb`` as a screen shows a stored colour of a tree's blend space."""
    shown = torch.tensor(color, dtype=torch.float64)
    shown = srgb_encode(shown) if space == "linear" else shown
    return "#" + "".join(f"{round(255 * part):02x}" for part in shown.clamp(0.0, 1.0).tolist())


def direction(vector: Sequence[float]) -> str:
    """An arrow to where a direction points and its angle from the viewer: ``↖ 41°``."""
    x, y, z = vector
    tilt = math.atan2(math.hypot(x, y), z)
    arrow = "⊙" if min(tilt, math.pi - tilt) < FACING_ANGLE else _ARROWS[round(math.atan2(y, x) / (math.pi / 4)) % 8]
    return f"{arrow} {math.degrees(tilt):.0f}°"


def direction_words(vector: Sequence[float]) -> str:
    """The same for a screen reader: ``41 degrees left up``."""
    x, y, z = vector
    tilt = math.degrees(math.atan2(math.hypot(x, y), z))
    words = [word for word, part in (("left", -x), ("right", x), ("up", y), ("down", -y)) if part > 0.38 * math.hypot(x, y) and part > 0.05]
    return f"{tilt:.0f} degrees {' '.join(words) or 'from the viewer'}"


def kind_words(kind: str) -> str:
    """``toon_highlight`` as ``toon highlight``."""
    return kind.replace("_", " ")


def label(node: Node) -> str:
    """What a node is called: its name, else the name of a part of a tinted pair, else its kind."""
    pair = tint(node)
    parts = (node, *(pair[::-1] if pair else ()))
    return next((part.name for part in parts if part.name), kind_words(pair[1].kind if pair else node.kind))


def stored(leaf: Leaf) -> Iterator[tuple[Parameter, tuple[float, ...] | Raster]]:
    """The parameters of a leaf with their values."""
    return zip(KINDS[leaf.kind].parameters, leaf.values, strict=True)


def entries(parameter: Parameter, value: Sequence[float]) -> list[tuple[float, ...]]:
    """A parameter's value once a lobe: one entry for most kinds."""
    return [tuple(value[k : k + parameter.size]) for k in range(0, len(value), parameter.size)]


def key_values(leaf: Leaf, space: str = "srgb", lines: int = 3) -> list[str]:
    """The few values that tell a leaf from another of its kind, one a line."""
    if leaf.lobes > 1:
        return [f"{leaf.lobes} lights"]
    found = []
    for parameter, value in stored(leaf):
        if isinstance(value, Raster):
            found.append(f"{value.width} × {value.height} pixels")
        elif parameter.type == "direction":
            found.append(direction(value))
        elif parameter.type == "color":
            found.append(shown_color(value, space))
        elif parameter.type == "scalar":
            found.append(f"{kind_words(parameter.name)} {number(value[0])}")
    return found[:lines]


def outline(tree: Tree) -> str:
    """The leaves of a tree counted by kind, paint first: ``albedo, diffuse, 4 tinted highlights, tinted rim``."""
    counts: Counter[tuple[str, bool]] = Counter()
    for _, node in walk(tree.root):
        pair = folds(node)
        if pair:
            counts[pair[1].kind, True] += 1
            counts["albedo", False] -= 1
            counts[pair[1].kind, False] -= 1
        elif isinstance(node, Leaf):
            counts[node.kind, False] += 1
    place = {role: index for index, role in enumerate(Role)}
    words = []
    for (kind, tinted), count in sorted(counts.items(), key=lambda item: place[KINDS[item[0][0]].role]):
        if count > 0:
            word = f"{'tinted ' * tinted}{kind_words(kind)}{' mask' * (KINDS[kind].role is Role.MASK and not kind.endswith('mask'))}"
            words.append(word if count == 1 else f"{count} {_plural(word)}")
    return ", ".join(words)


def decibels(psnr: float) -> str:
    """``39.5 dB``; a render without an error has ``∞ dB``."""
    return f"{psnr:.1f} dB" if math.isfinite(psnr) else f"{number(psnr)} dB"


def _plural(word: str) -> str:
    return word if word.endswith("s") else f"{word}s"


def is_mask(node: Node) -> bool:
    """True for a leaf of a mask kind."""
    return isinstance(node, Leaf) and KINDS[node.kind].role is Role.MASK


def folds(node: Node) -> tuple[Leaf, Leaf] | None:
    """(albedo, light) where a person sees one tinted light: a highlight, rim or environment with its own albedo."""
    pair = tint(node) if isinstance(node, Operator) else None
    return pair if pair and KINDS[pair[1].kind].role in (Role.HIGHLIGHT, Role.RIM, Role.ENVIRONMENT) else None
