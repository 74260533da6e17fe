"""Tree files: versioned JSON with rasters inside, lossless. `tree.schema.json`, beside this file, is their JSON Schema.

A document holds a tree, and may hold the family it was chosen from and alternatives to it::

    {"version": 1,
     "tree": {"blend_space": "srgb", "exposure": 1,
              "root": {"kind": "multiply", "children": [
                {"kind": "albedo", "parameters": {"color": [0.8, 0.1, 0.2]}},
                {"kind": "diffuse", "name": "key", "parameters": {"direction": [0, 0.6, 0.8], "ambient": 0.2}}]}},
     "family": {"chosen": 0, "members": [{"psnr": 31.5, "tree": ...}], "alternatives": []}}

A mix has two children and a ``mask``. A parameter of a leaf with lobes is a list with one entry a lobe. A raster is
``{"png": "<base64>"}``, 16 bits. A ``psnr`` of null is that of a perfect copy. Reading refuses what it does not know, and
what is too large before it is decoded, and says where in the document.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any, NoReturn

from unshade.blend import BLENDS
from unshade.errors import TreeError, TreeSyntaxError, did_you_mean
from unshade.files import write_whole
from unshade.grammar import check_size
from unshade.nodes import KINDS, Family, Kind, Leaf, Member, Node, Operator, Parameter, Raster, Role, Tree, Value, is_kind
from unshade.rasters import raster_from_base64, raster_to_base64
from unshade.text import number_text, parse, to_text
from unshade.tree_size import MAX_NODES, depth_limit

__all__ = ["VERSION", "dump", "dumps", "load", "load_family", "loads", "loads_family", "parse", "to_text"]

VERSION = 1

MAX_DOCUMENT_NODES = 20 * MAX_NODES
"""Most nodes in all the trees of one document; counted before anything is decoded."""

MAX_BYTES = 2**29
"""Largest file that is read."""

LINE = 160
"""A part of a document that fits a line of this length stands on one."""


def dumps(what: Tree | Family) -> str:
    """A tree, or a family with its chosen tree, as a JSON document. Raises TreeError for one too large to be read back."""
    document: dict[str, Any] = {"version": VERSION}
    if isinstance(what, Tree):
        document["tree"] = _tree_out(what)
    else:
        document["tree"] = _tree_out(what.tree)
        document["family"] = {
            "chosen": what.chosen,
            "members": [_member_out(member) for member in what.members],
            "alternatives": [_member_out(member) for member in what.alternatives],
        }
    return _written(document) + "\n"


def dump(what: Tree | Family, path: str | os.PathLike[str]) -> None:
    """Write `dumps` to a file, whole or not at all. Raises OutputError."""
    write_whole(path, dumps(what).encode("ascii"))


def loads(text: str) -> Tree:
    """The tree of a JSON document, or of the one-line text form. Raises TreeSyntaxError or TreeError."""
    if not text.lstrip("\ufeff \t\r\n").startswith(("{", "[")):
        return parse(text.lstrip("\ufeff"))
    return _tree_in(_document(text)["tree"], "tree")


def loads_family(text: str) -> Family:
    """The family of a JSON document. Raises TreeSyntaxError or TreeError, also where there is none."""
    document = _document(text)
    if "family" not in document:
        raise TreeError("expected a document with a family, got one tree")
    return _family_in(document["family"])


def load(path: str | os.PathLike[str]) -> Tree:
    """The tree of a file, JSON or text; of a family's file the chosen tree. Raises TreeSyntaxError or TreeError."""
    return loads(_read(path))


def load_family(path: str | os.PathLike[str]) -> Family:
    """The family of a JSON file. Raises TreeSyntaxError or TreeError, also where there is none."""
    return loads_family(_read(path))


def _read(path: str | os.PathLike[str]) -> str:
    try:
        size = os.path.getsize(path)
        if size > MAX_BYTES:
            raise TreeError(f"{path}: a tree file may have {MAX_BYTES} bytes at most, got {size}")
        return Path(path).read_bytes().decode("utf-8")
    except OSError as error:
        raise TreeError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise TreeSyntaxError(f"{path}: not a tree file (not UTF-8 text)") from None


# Writing


def _tree_out(tree: Tree) -> dict[str, Any]:
    check_size(tree.root)
    return {"blend_space": tree.blend_space, "exposure": float(tree.exposure), "root": _node_out(tree.root)}


def _member_out(member: Member) -> dict[str, Any]:
    if math.isnan(member.psnr) or member.psnr == -math.inf:
        raise TreeError(f"a member's psnr must be a number, got {member.psnr}")
    return {"psnr": None if member.psnr == math.inf else float(member.psnr), "tree": _tree_out(member.tree)}


def _node_out(node: Node) -> dict[str, Any]:
    written: dict[str, Any] = {"kind": node.kind}
    if node.name is not None:
        written["name"] = node.name
    if isinstance(node, Leaf):
        kind = KINDS[node.kind]
        pairs = zip(kind.parameters, node.values, strict=True)
        written["parameters"] = {parameter.name: _value_out(kind, parameter, value) for parameter, value in pairs}
    else:
        written["children"] = [_node_out(child) for child in node.children]
        if node.mask is not None:
            written["mask"] = _node_out(node.mask)
    return written


def _value_out(kind: Kind, parameter: Parameter, value: Value) -> Any:
    if isinstance(value, Raster):
        return {"png": raster_to_base64(value)}
    if parameter.type == "scalar":
        return list(value) if kind.repeats else value[0]
    lobes = [list(value[k : k + parameter.size]) for k in range(0, len(value), parameter.size)]
    return lobes if kind.repeats else lobes[0]


def _written(value: Any, indent: str = "") -> str:
    """JSON text in which what fits a line stands on one."""
    if isinstance(value, float):
        return number_text(value)
    if not isinstance(value, dict | list):
        return json.dumps(value, allow_nan=False)
    inner = indent + " "
    labels = [f"{json.dumps(key)}: " for key in value] if isinstance(value, dict) else [""] * len(value)
    parts: list[str] = []
    for label, entry in zip(labels, value.values() if isinstance(value, dict) else value, strict=True):
        parts.append(label + _written(entry, inner))  # a comprehension would take a second frame a level
    first, last = "{}" if isinstance(value, dict) else "[]"
    if sum(map(len, parts)) + 2 * len(parts) + len(indent) <= LINE and not any("\n" in part for part in parts):
        return f"{first}{', '.join(parts)}{last}"
    return f"{first}\n{inner}" + f",\n{inner}".join(parts) + f"\n{indent}{last}"


# Reading


def _document(text: str) -> dict[str, Any]:
    """Parse and check the outermost level."""
    if text.count('"kind"') > MAX_DOCUMENT_NODES:
        raise TreeSyntaxError(f"a document may have {MAX_DOCUMENT_NODES} nodes at most")
    try:
        document = json.loads(text.lstrip("\ufeff"), parse_constant=_not_finite, parse_int=float, object_pairs_hook=_without_duplicates)
    except json.JSONDecodeError as error:
        raise TreeSyntaxError(f"not JSON, or truncated: {error.msg} in line {error.lineno}, column {error.colno}") from None
    except RecursionError:
        raise TreeSyntaxError(f"nested too deep: {depth_limit()} levels at most") from None
    if not isinstance(document, dict):
        raise TreeSyntaxError(f"expected a JSON object with a version and a tree, got {_type(document)}")
    version = document.get("version")
    if not isinstance(version, float) or not version.is_integer() or version < 1:
        raise TreeSyntaxError(f"version: expected {VERSION}, got {_shown(version) if 'version' in document else 'none'}")
    if version > VERSION:
        raise TreeSyntaxError(
            f"version: this file has version {version:g}, later than {VERSION}, the last one known here; a newer unshade reads it"
        )
    _keys(document, "", required=("version", "tree"), optional=("family",))
    return document


def _not_finite(word: str) -> NoReturn:
    raise TreeSyntaxError(f"numbers must be finite, got {word}")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise TreeSyntaxError(f"the key {key[:40]!r} stands twice in one object")
        found[key] = value
    return found


def _type(value: Any) -> str:
    names = {dict: "an object", list: "a list", str: "a string", float: "a number", bool: "true or false", type(None): "null"}
    return names[type(value)]


def _shown(value: Any) -> str:
    text = "null" if value is None else f"{value:g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def _fault(where: str, message: str) -> NoReturn:
    raise TreeSyntaxError(f"{where}: {message}" if where else message)


def _keys(value: Any, where: str, required: Collection[str], optional: Collection[str] = ()) -> dict[str, Any]:
    """Check that a value is an object with these keys and no other."""
    if not isinstance(value, dict):
        _fault(where, f"expected an object, got {_type(value)}")
    known = [*required, *optional]
    for key in value:
        if key not in known:
            _fault(where, f"unknown key {key[:40]!r}{did_you_mean(key, known)}")
    for key in required:
        if key not in value:
            _fault(where, f"{key!r} is missing")
    return value


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        _fault(where, f"expected a list, got {_type(value)}")
    return value


def _tree_in(value: Any, where: str) -> Tree:
    given = _keys(value, where, ("root",), ("blend_space", "exposure"))
    space, exposure = given.get("blend_space", "srgb"), given.get("exposure", 1.0)
    if not isinstance(exposure, float):
        _fault(f"{where}.exposure", f"expected a number, got {_type(exposure)}")
    if not isinstance(space, str):
        _fault(f"{where}.blend_space", f"expected srgb or linear, got {_type(space)}")
    root = _Reader().node(given["root"], f"{where}.root", 1)
    if isinstance(root, Leaf) and KINDS[root.kind].role is Role.MASK:
        _fault(f"{where}.root", f"a tree cannot be only a mask ({root.kind})")
    try:
        return Tree(root, space, exposure)  # type: ignore[arg-type]
    except TreeError as error:
        _fault(where, str(error))


def _member_in(value: Any, where: str) -> Member:
    given = _keys(value, where, ("psnr", "tree"))
    psnr = math.inf if given["psnr"] is None else given["psnr"]
    if not isinstance(psnr, float) or (given["psnr"] is not None and not math.isfinite(psnr)):
        _fault(f"{where}.psnr", f"expected a finite number or null, got {_shown(given['psnr'])}")
    return Member(_tree_in(given["tree"], f"{where}.tree"), psnr)


def _family_in(value: Any) -> Family:
    given = _keys(value, "family", ("chosen", "members"), ("alternatives",))
    members = [_member_in(entry, f"family.members.{k}") for k, entry in enumerate(_list(given["members"], "family.members"))]
    others = _list(given.get("alternatives", []), "family.alternatives")
    alternatives = [_member_in(entry, f"family.alternatives.{k}") for k, entry in enumerate(others)]
    chosen = given["chosen"]
    if not isinstance(chosen, float) or chosen not in range(len(members)):
        _fault("family.chosen", f"expected the number of one of the {len(members)} members, counted from 0, got {_shown(chosen)}")
    return Family(tuple(members), int(chosen), tuple(alternatives))


class _Reader:
    """Reads the nodes of one tree, and counts them."""

    def __init__(self) -> None:
        self.nodes = 0

    def node(self, value: Any, where: str, depth: int) -> Node:
        if depth > depth_limit():
            _fault("tree", f"nested too deep: {depth_limit()} levels at most")
        self.nodes += 1
        if self.nodes > MAX_NODES:
            _fault("tree", f"a tree may have {MAX_NODES} nodes at most")
        if not isinstance(value, dict):
            _fault(where, f"expected a node, an object with a kind, got {_type(value)}")
        kind = value.get("kind")
        if not isinstance(kind, str):
            _fault(where, "'kind' is missing" if kind is None else f"'kind' must be a string, got {_type(kind)}")
        if kind not in BLENDS and not is_kind(kind):
            _fault(where, f"unknown kind {kind[:40]!r}{did_you_mean(kind, [*KINDS, *BLENDS])}")
        try:
            return self.operator(kind, value, where, depth) if kind in BLENDS else self.leaf(KINDS[kind], value, where)
        except TreeSyntaxError:
            raise
        except TreeError as error:
            _fault(where, str(error))

    def operator(self, kind: str, value: dict[str, Any], where: str, depth: int) -> Operator:
        given = _keys(value, where, ("kind", "children", "mask") if kind == "mix" else ("kind", "children"), ("name",))
        entries = _list(given["children"], f"{where}.children")
        children: list[Node] = []
        for k, entry in enumerate(entries):
            children.append(self.node(entry, f"{where}.{k}", depth + 1))  # a comprehension would take a third frame a level
        mask = self.node(given["mask"], f"{where}.mask", depth + 1) if kind == "mix" else None
        return Operator(kind, tuple(children), mask, _name_in(given, where))  # type: ignore[arg-type]

    def leaf(self, kind: Kind, value: dict[str, Any], where: str) -> Leaf:
        given = _keys(value, where, ("kind", "parameters"), ("name",))
        needed = [parameter.name for parameter in kind.parameters if parameter.default is None]
        optional = [parameter.name for parameter in kind.parameters if parameter.default is not None]
        parameters = _keys(given["parameters"], f"{where}.parameters", needed, optional)
        values: list[Value] = []
        for parameter in kind.parameters:
            if parameter.name in parameters:
                values.append(_value_in(kind, parameter, parameters[parameter.name], f"{where}.{parameter.name}"))
            else:
                assert parameter.default is not None
                values.append(parameter.default)
        return Leaf(kind.name, tuple(values), _name_in(given, where))


def _name_in(given: dict[str, Any], where: str) -> str | None:
    name = given.get("name")
    if name is not None and not isinstance(name, str):
        _fault(f"{where}.name", f"expected a string, got {_type(name)}")
    return name


def _value_in(kind: Kind, parameter: Parameter, value: Any, where: str) -> Value:
    if parameter.type == "raster":
        png = _keys(value, where, ("png",))["png"]
        if not isinstance(png, str):
            _fault(where, f"expected a PNG as a base64 string, got {_type(png)}")
        return raster_from_base64(png)
    entries = _list(value, where) if kind.repeats else [value]
    numbers: list[float] = []
    for entry in entries:
        lobe = [entry] if parameter.type == "scalar" else _list(entry, where)
        for number in lobe:
            if not isinstance(number, float):
                _fault(where, f"expected a number, got {_type(number)}")
        if len(lobe) != parameter.size:
            _fault(where, f"expected {parameter.size} numbers, got {len(lobe)}")
        numbers += lobe
    return tuple(numbers)
