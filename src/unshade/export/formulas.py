"""The leaf formulas of `unshade.shading`, once, in the words that Python and shading languages share.

`SOURCE` is Python, and every expression in it is also one of GLSL, WGSL and HLSL but for the names of types and a few
functions. So the text targets print it with a table of words (`shader_text`), and the node targets run it with values that
build nodes instead of computing (`blender`, `materialx`).

``n`` is a unit normal, +x right, +y up, +z to the viewer. Places in a picture are (u to the right, v downwards, 0), its
texels' size (1 / width, 1 / height, 0).
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

SOURCE = '''
def facing(n: vec3, direction: vec3) -> float:
    """The cosine between a normal and a direction."""
    return dot(n, normalize(direction))

def edge(low: float, width: float, x: float) -> float:
    """A smooth step from 0 at low to 1 at low + width."""
    t: float = clamp((x - low) / max(width, 0.0001), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)

def spot(n: vec3, direction: vec3, sharpness: float) -> float:
    """A spherical Gaussian."""
    return exp(-2.0 * sharpness * (1.0 - facing(n, direction)))

def mirrored(n: vec3) -> vec3:
    """The mirror direction of the viewer."""
    return 2.0 * n.z * n - vec3(0.0, 0.0, 1.0)

def turned(v: vec3, rotation: vec3) -> vec3:
    """A vector turned by an axis-angle vector in radians."""
    angle: float = max(length(rotation), 0.000001)
    axis: vec3 = rotation / angle
    return v * cos(angle) + cross(axis, v) * sin(angle) + axis * (dot(axis, v) * (1.0 - cos(angle)))

def diffuse(n: vec3, direction: vec3, ambient: float) -> float:
    """Lambert shading."""
    return ambient + (1.0 - ambient) * max(facing(n, direction), 0.0)

def highlight(n: vec3, direction: vec3, sharpness: float, amplitude: float) -> float:
    """A spot of light."""
    return clamp(amplitude * spot(n, direction, sharpness), 0.0, 1.0)

def rim(n: vec3, direction: vec3, exponent: float) -> float:
    """Light grazing the silhouette."""
    return pow(clamp(1.0 - n.z, 0.000001, 1.0), exponent) * max(facing(n, direction), 0.0)

def toon_diffuse(n: vec3, direction: vec3, ambient: float, threshold: float, softness: float) -> float:
    """Two-tone shading."""
    return ambient + (1.0 - ambient) * edge(threshold, softness, facing(n, direction))

def toon_highlight(n: vec3, direction: vec3, radius: float, brightness: float, softness: float) -> float:
    """A spot with an edge; radius and softness are angles in radians."""
    angle: float = acos(clamp(facing(n, direction), -1.0, 1.0))
    return brightness * (1.0 - edge(radius - 0.5 * softness, softness, angle))

def threshold(n: vec3, direction: vec3, middle: float, softness: float) -> float:
    """Mask: one side of a circle."""
    return edge(middle - 0.5 * softness, softness, facing(n, direction))

def stripe(n: vec3, direction: vec3, center: float, width: float, softness: float) -> float:
    """Mask: a band."""
    return 1.0 - edge(0.5 * width - 0.5 * softness, softness, abs(facing(n, direction) - center))

def picture_place(n: vec3, texel: vec3) -> vec3:
    """Where a picture of the sphere shows a normal, half a texel inside its border."""
    u: float = clamp(0.5 + 0.5 * n.x, 0.5 * texel.x, 1.0 - 0.5 * texel.x)
    v: float = clamp(0.5 - 0.5 * n.y, 0.5 * texel.y, 1.0 - 0.5 * texel.y)
    return vec3(u, v, 0.0)

def environment_place(n: vec3, rotation: vec3, texel: vec3) -> vec3:
    """Where a lat-long picture shows the mirror direction: +y up, +z at the centre, u wraps."""
    r: vec3 = turned(mirrored(n), -rotation)
    u: float = 0.5 + atan2(r.x, r.z) / 6.283185307179586
    v: float = clamp(acos(clamp(r.y, -1.0, 1.0)) / 3.141592653589793, 0.5 * texel.y, 1.0 - 0.5 * texel.y)
    return vec3(u, v, 0.0)

def screen(a: vec3, b: vec3) -> vec3:
    """Lightens: black changes nothing."""
    return a + b - a * b

def encode(x: float) -> float:
    """Linear light to sRGB, one channel."""
    return mix(12.92 * x, 1.055 * pow(max(x, 0.0031308), 0.4166666666666667) - 0.055, step(0.0031308, x))

def decode(x: float) -> float:
    """sRGB to linear light, one channel."""
    return mix(x / 12.92, pow((max(x, 0.04045) + 0.055) / 1.055, 2.4), step(0.04045, x))

def encode_color(c: vec3) -> vec3:
    """Linear light to sRGB."""
    return vec3(encode(c.x), encode(c.y), encode(c.z))

def decode_color(c: vec3) -> vec3:
    """sRGB to linear light."""
    return vec3(decode(c.x), decode(c.y), decode(c.z))

def seen(n: vec3, v: vec3) -> vec3:
    """A normal as it is seen along a ray, v towards the eye, so that silhouettes are right in perspective too."""
    right: vec3 = normalize(vec3(v.z, 0.0, -v.x))
    return vec3(dot(n, right), dot(n, cross(v, right)), dot(n, v))
'''

BUILT_IN = frozenset("dot normalize cross length clamp max min abs exp pow cos sin acos atan2 mix step vec3 sample".split())
"""What every target brings itself. ``sample(picture, place)`` looks a picture up, bilinear."""


@dataclass(frozen=True)
class Function:
    """A function of `SOURCE`, or the one made for a tree, taken apart."""

    name: str
    parameters: tuple[tuple[str, str], ...]
    """(name, type), the type ``float`` or ``vec3``."""
    result: str
    summary: str
    statements: tuple[tuple[str, str, ast.expr], ...]
    """(name, type, value) of each line but the last."""
    value: ast.expr
    source: str

    @property
    def calls(self) -> tuple[str, ...]:
        """The functions of `SOURCE` that it calls, in order."""
        return called([*(value for _, _, value in self.statements), self.value])


def called(expressions: Iterable[ast.expr]) -> tuple[str, ...]:
    """The names of all functions that these expressions call, but those that every target has."""
    found = [
        node.func.id
        for expression in expressions
        for node in ast.walk(expression)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id not in BUILT_IN
    ]
    return tuple(dict.fromkeys(found))


def expression(text: str) -> ast.expr:
    """One expression of the language."""
    return ast.parse(text, mode="eval").body


@cache
def functions() -> dict[str, Function]:
    """Every function of `SOURCE` by name, in its order: none calls one below it."""
    found = {}
    for node in ast.parse(SOURCE).body:
        assert isinstance(node, ast.FunctionDef) and node.returns is not None
        *lines, last = node.body[1:]
        assert isinstance(last, ast.Return) and last.value is not None
        statements = []
        for line in lines:
            assert isinstance(line, ast.AnnAssign) and line.value is not None
            statements.append((ast.unparse(line.target), ast.unparse(line.annotation), line.value))
        parameters = tuple((entry.arg, ast.unparse(entry.annotation)) for entry in node.args.args if entry.annotation is not None)
        found[node.name] = Function(
            node.name,
            parameters,
            ast.unparse(node.returns),
            ast.get_docstring(node) or "",
            tuple(statements),
            last.value,
            ast.get_source_segment(SOURCE, node) or "",
        )
    return found


def needed(names: Iterable[str]) -> tuple[Function, ...]:
    """These functions and all that they call, callers last."""
    known = functions()
    wanted: set[str] = set()
    pending = list(names)
    while pending:
        name = pending.pop()
        if name not in wanted:
            wanted.add(name)
            pending.extend(known[name].calls)
    return tuple(function for name, function in known.items() if name in wanted)
