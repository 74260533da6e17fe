"""The JSON Schema of tree files, made from the table of kinds so that it cannot say anything else.

What it cannot say is left to `unshade.serde`: that a direction is not zero, that all parameters of an environment have
one entry a lobe, how large and how deep a tree may be.
"""

from __future__ import annotations

from typing import Any

from unshade.blend import BLENDS
from unshade.nodes import KINDS, Kind, Parameter, Role
from unshade.serde import VERSION


def tree_schema() -> dict[str, Any]:
    """The schema (draft 2020-12) for all kinds known now, those registered from outside included."""
    paint = [name for name, kind in KINDS.items() if kind.role is not Role.MASK]
    masks = [name for name, kind in KINDS.items() if kind.role is Role.MASK]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:unshade:tree:{VERSION}",
        "title": "Shade tree",
        "description": "A shade tree, or the family of trees of one picture, as unshade writes it.",
        **_object(
            {"version": {"const": VERSION}, "tree": _ref("tree"), "family": _ref("family")},
            optional=("family",),
        ),
        "$defs": {
            "tree": {
                "description": "Operators work on display-encoded values (srgb) or on linear light, which is encoded at the end.",
                **_object(
                    {
                        "blend_space": {"enum": ["srgb", "linear"], "default": "srgb"},
                        "exposure": {
                            "description": "factor that scene-linear input was multiplied by",
                            "type": "number",
                            "exclusiveMinimum": 0,
                            "default": 1,
                        },
                        "root": _ref("node"),
                    },
                    optional=("blend_space", "exposure"),
                ),
            },
            "family": {
                "description": "Trees of one picture, simplest first; which one was chosen; other explanations of its size.",
                **_object(
                    {
                        "chosen": {"type": "integer", "minimum": 0},
                        "members": {"type": "array", "minItems": 1, "items": _ref("member")},
                        "alternatives": {"type": "array", "items": _ref("member")},
                    },
                    optional=("alternatives",),
                ),
            },
            "member": _object(
                {
                    "psnr": {"description": "dB inside the scored disc; null for a perfect copy", "type": ["number", "null"]},
                    "tree": _ref("tree"),
                }
            ),
            "node": {"oneOf": [_ref(name) for name in (*BLENDS, *paint)]},
            "mask": {"oneOf": [_ref(name) for name in masks]},
            "name": {"description": "finds the node as its address does; unlike any other in the tree", "type": "string"},
            "raster": _object(
                {
                    "png": {
                        "description": "a PNG, 16 bits a channel",
                        "type": "string",
                        "contentEncoding": "base64",
                        "contentMediaType": "image/png",
                    }
                }
            ),
            **{name: _operator(name) for name in BLENDS},
            **{name: _leaf(kind) for name, kind in KINDS.items()},
        },
    }


def _ref(name: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{name}"}


def _object(properties: dict[str, Any], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    required = [name for name in properties if name not in optional]
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def _operator(name: str) -> dict[str, Any]:
    children: dict[str, Any] = {"type": "array", "items": _ref("node"), "minItems": 2}
    properties = {"kind": {"const": name}, "name": _ref("name"), "children": children}
    if name == "mix":
        children["maxItems"] = 2
        properties["mask"] = _ref("mask")
    return {"description": BLENDS[name].summary, **_object(properties, optional=("name",))}


def _leaf(kind: Kind) -> dict[str, Any]:
    parameters = {parameter.name: _parameter(kind, parameter) for parameter in kind.parameters}
    with_default = tuple(parameter.name for parameter in kind.parameters if parameter.default is not None)
    properties = {"kind": {"const": kind.name}, "name": _ref("name"), "parameters": _object(parameters, optional=with_default)}
    return {"description": kind.summary, **_object(properties, optional=("name",))}


def _parameter(kind: Kind, parameter: Parameter) -> dict[str, Any]:
    meaning = f"{parameter.meaning} ({parameter.unit})" if parameter.unit else parameter.meaning
    if parameter.type == "raster":
        return {"description": f"{meaning}; {parameter.channels} channels", **_ref("raster")}
    number: dict[str, Any] = {"type": "number"}
    if parameter.type != "direction":
        number |= {"minimum": parameter.low, "maximum": parameter.high}
    one = number if parameter.type == "scalar" else {"type": "array", "items": number, "minItems": 3, "maxItems": 3}
    default = list(parameter.default or ())
    start: Any = default[0] if parameter.type == "scalar" and default else default
    if kind.repeats:
        one, start = {"type": "array", "items": one, "minItems": 1}, [start]
    return {"description": meaning, **one, **({"default": start} if default else {})}
