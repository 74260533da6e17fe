"""The leaves of a tree as cards of the report: picture, name, address, role and every value."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from unshade import labels
from unshade.drawing import data_uri
from unshade.labels import escape, number
from unshade.nodes import KINDS, Leaf, Node, Parameter, Raster, Tree, carried_amplitude, walk


def cards(tree: Tree, key: str) -> Iterator[str]:
    """One card a leaf; a light with its own albedo shares one.

    Args:
        key: the prefix of the drawn tree's symbols, whose pictures the cards show too.
    """
    hidden: set[int] = set()
    for index, (address, node) in enumerate(walk(tree.root)):
        pair = labels.folds(node)
        if pair:
            hidden |= {index + 1, index + 2}
            yield _card(tree, f"{key}-{index}", address, node, pair[1], pair[0])
        elif isinstance(node, Leaf) and index not in hidden:
            yield _card(tree, f"{key}-{index}", address, node, node)


def _card(tree: Tree, place: str, address: str, node: Node, leaf: Leaf, tint: Leaf | None = None) -> str:
    """A leaf with its picture, name, address, role and every value.

    Args:
        place: id of the symbol with the node's picture in the drawn tree.
        node: the leaf, or the multiply of a tinted light.
    """
    rows = [_row("tint", _swatch(labels.shown_color(tint["color"], tree.blend_space)))] if tint else []
    carried = KINDS[leaf.kind].amplitude if carried_amplitude(node) else None
    shown = [(parameter, value) for parameter, value in labels.stored(leaf) if parameter.name != carried]
    rows += (
        _lights(leaf, tree.blend_space)
        if leaf.lobes > 1
        else [_row(p.name, _value(p, value, tree.blend_space), p.meaning) for p, value in shown]
    )
    name = labels.label(node)
    kind = labels.kind_words(leaf.kind)
    said = f"tinted {kind}" if tint else kind
    return (
        f'<li class="card" data-address="{escape(address)}">'
        f'<svg class="portrait" viewBox="0 0 1 1" aria-hidden="true"><use href="#{place}"/></svg>'
        f"<div><h3>{escape(name)}{f' <small>{escape(said)}</small>' if name != said else ''}</h3>"
        f'<p class="about"><span class="role role-{leaf.role.value}">{leaf.role.value}</span> <code>{escape(address)}</code></p>'
        f"<dl>{''.join(rows)}</dl></div></li>\n"
    )


def _row(name: str, value: str, meaning: str = "") -> str:
    about = f' title="{escape(meaning)}"' if meaning else ""
    return f"<div><dt{about}>{escape(labels.kind_words(name))}</dt><dd>{value}</dd></div>"


def _value(parameter: Parameter, value: Sequence[float] | Raster, space: str) -> str:
    """A parameter's value as a picture and in words."""
    if isinstance(value, Raster):
        stored = value.channels * value.height * value.width
        picture = data_uri(value.tensor(), "webp-lossy")
        size = f'width="{value.width}" height="{value.height}"'
        return f'<img class="raster" src="{picture}" alt="" {size}> <span>{value.width} × {value.height}, {stored} values</span>'
    if parameter.type == "color":
        return _swatch(labels.shown_color(value, space))
    if parameter.type == "direction":
        return f"{_dial([(tuple(value), '')])}<span>{labels.direction(value)}</span>"
    if parameter.type == "rotation":
        return f"<span>{', '.join(number(part) for part in value)} {escape(parameter.unit)}</span>"
    return _bar(parameter, value[0])


def _bar(parameter: Parameter, value: float) -> str:
    """A number on the bar of its range."""
    low, high = parameter.low, parameter.high
    if parameter.logarithmic:
        share = math.log(value / low) / math.log(high / low)
    else:
        share = (value - low) / (high - low) if high > low else 0.0
    said = f"{number(low)} to {number(high)}{', logarithmic' if parameter.logarithmic else ''}"
    return (
        f'<span class="bar" title="{said}" style="--at:{100 * min(max(share, 0.0), 1.0):.1f}%"></span>'
        f'<span class="number" title="{value!r}">{number(value)}</span>'
    )


def _swatch(color: str) -> str:
    return f'<span class="swatch" style="--color:{color}"></span><code>{color}</code>'


def _dial(lights: Sequence[tuple[tuple[float, ...], str]]) -> str:
    """Directions as dots on a small sphere seen from the front; a hollow dot is on its far side."""
    dots = []
    for (x, y, z), color in lights:
        fill = f' style="--color:{color}"' if color else ""
        dots.append(f'<circle class="{"near" if z >= 0 else "far"}" cx="{19 + 16 * x:.1f}" cy="{19 - 16 * y:.1f}" r="3"{fill}/>')
    words = "; ".join(labels.direction_words(vector) for vector, _ in lights)
    return (
        f'<svg class="dial" viewBox="0 0 38 38" width="38" height="38" role="img" aria-label="{words}"><title>{words}</title>'
        f'<circle class="globe" cx="19" cy="19" r="16"/><path class="axes" d="M3 19H35M19 3V35"/>{"".join(dots)}</svg>'
    )


def _lights(leaf: Leaf, space: str) -> list[str]:
    """The lobes of an environment: all on one sphere, then each with its numbers."""
    stored = {parameter.name: labels.entries(parameter, value) for parameter, value in labels.stored(leaf) if not isinstance(value, Raster)}
    parameters = {parameter.name: parameter for parameter in KINDS[leaf.kind].parameters}
    directions = next((stored[name] for name in stored if parameters[name].type == "direction"), [])
    colors = next((stored[name] for name in stored if parameters[name].type == "color"), [(1.0, 1.0, 1.0)] * leaf.lobes)
    rows = [
        _row(f"{leaf.lobes} lights", _dial([(at, labels.shown_color(color, space)) for at, color in zip(directions, colors, strict=False)]))
    ]
    for index in range(leaf.lobes):
        words = []
        for name, entries in stored.items():
            entry = entries[index]
            kind = parameters[name].type
            shown = (
                labels.direction(entry)
                if kind == "direction"
                else _swatch(labels.shown_color(entry, space))
                if kind == "color"
                else f"{name} {number(entry[0])}"
            )
            words.append(f"<span>{shown}</span>")
        rows.append(_row(f"light {index + 1}", "".join(words)))
    return rows
