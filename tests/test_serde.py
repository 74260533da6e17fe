"""Trees to JSON and text and back: lossless, strict, and clear about what is wrong and where."""

from __future__ import annotations

import base64
import io
import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as PILImage

import unshade.files
from strategies import families, rasters, trees
from unshade.errors import OutputError, TreeError, TreeSyntaxError
from unshade.nodes import KINDS, Kind, Leaf, Operator, Parameter, Raster, Role, Tree, leaf, multiply, register, screen
from unshade.png import PngError, read_png, write_png
from unshade.rasters import raster_from_png, raster_to_png
from unshade.schema import tree_schema
from unshade.serde import dump, dumps, load, load_family, loads, loads_family
from unshade.text import COLOR_WORDS, parse, to_text
from unshade.tree_size import MAX_DEPTH, MAX_NODES

SCHEMA_FILE = Path(sys.modules["unshade.serde"].__file__ or "").with_name("tree.schema.json")
EXAMPLE = "screen(multiply(albedo(#cc2030), diffuse(left up, ambient=0.2)), highlight((0.1, 0.2, 0.97), sharpness=40, amplitude=1))"


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    schema = json.loads(SCHEMA_FILE.read_text(encoding="ascii"))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def document(root: Any, **others: Any) -> str:
    return json.dumps({"version": 1, "tree": {"root": root}} | others)


ALBEDO = {"kind": "albedo", "parameters": {"color": [0.1, 0.2, 0.3]}}


# Lossless


@given(trees())
def test_text_is_lossless(tree: Tree) -> None:
    assert parse(to_text(tree)) == tree
    assert parse(str(tree)) == tree


@given(trees())
def test_json_is_lossless(tree: Tree) -> None:
    assert loads(dumps(tree)) == tree


@given(trees())
@settings(max_examples=15)
def test_json_fits_the_published_schema(validator: jsonschema.Draft202012Validator, tree: Tree) -> None:
    validator.validate(json.loads(dumps(tree)))


@given(families())
@settings(max_examples=15)
def test_a_family_is_lossless_and_fits_the_schema(validator: jsonschema.Draft202012Validator, family: Any) -> None:
    text = dumps(family)
    assert loads_family(text) == family
    assert loads(text) == family.tree
    validator.validate(json.loads(text))


def test_the_published_schema_is_fresh() -> None:
    """Refresh with UNSHADE_REFRESH_GOLDEN=1."""
    text = json.dumps(tree_schema(), indent=1) + "\n"
    if os.environ.get("UNSHADE_REFRESH_GOLDEN"):
        SCHEMA_FILE.write_bytes(text.encode("ascii"))
    assert SCHEMA_FILE.read_bytes().decode("ascii") == text


@pytest.mark.parametrize(
    "root",
    [
        {"kind": "heighlight", "parameters": {}},
        {"kind": "albedo", "parameters": {"color": [0.1, 0.2, 1.3]}},
        {"kind": "albedo", "parameters": {"color": [0.1, 0.2]}},
        {"kind": "albedo", "parameters": {"colour": [0.1, 0.2, 0.3]}},
        {"kind": "threshold", "parameters": {}},
        {"kind": "screen", "children": [ALBEDO]},
        {"kind": "mix", "children": [ALBEDO, ALBEDO]},
        {"kind": "mix", "children": [ALBEDO, ALBEDO], "mask": ALBEDO},
        {"kind": "image", "parameters": {}},
        "albedo",
    ],
)
def test_the_schema_refuses_what_the_reader_refuses(validator: jsonschema.Draft202012Validator, root: Any) -> None:
    text = document(root)
    assert not validator.is_valid(json.loads(text))
    with pytest.raises(TreeError):
        loads(text)


def test_a_document_is_readable(tmp_path: Path) -> None:
    dump(parse(EXAMPLE), tmp_path / "tree.json")
    lines = (tmp_path / "tree.json").read_text(encoding="ascii").splitlines()
    assert lines[0] == "{" and max(map(len, lines)) <= 165 and len(lines) < 22
    assert any('{"kind": "diffuse", "parameters": {"direction": [' in line for line in lines)


def test_load_reads_text_files_too(tmp_path: Path) -> None:
    path = tmp_path / "red.tree"
    path.write_bytes(b"\xef\xbb\xbfscreen(\r\n  albedo(red),\r\n  highlight()\r\n)\r\n")
    assert load(path) == parse("screen(albedo(#f00), highlight())")


def test_an_edited_document_may_leave_out_what_has_a_default() -> None:
    tree = loads(document({"kind": "diffuse", "parameters": {"direction": [0, 3, 4]}}))
    assert tree == Tree(leaf("diffuse", direction=(0, 3, 4)))
    assert tree.root["direction"] == (0.0, 0.6, 0.8)  # type: ignore[index]


def test_a_family_s_file_gives_tree_and_family(tmp_path: Path) -> None:
    from unshade.nodes import Family, Member

    small, large = Tree(leaf("albedo")), parse(EXAMPLE)
    family = Family((Member(small, 20.0), Member(large, float("inf"))), 1, (Member(small, 19.5),))
    dump(family, tmp_path / "tree.json")
    assert load(tmp_path / "tree.json") == large
    assert load_family(tmp_path / "tree.json") == family
    with pytest.raises(TreeError, match="family"):
        loads_family(dumps(small))


# Rasters


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@given(st.data())
@settings(max_examples=8)
def test_png_keeps_every_bit(channels: int, data: st.DataObject) -> None:
    raster = data.draw(rasters(channels))
    assert raster_from_png(raster_to_png(raster)) == raster


def test_pillow_reads_the_png() -> None:
    pixels = np.arange(65536, dtype=np.uint16).reshape(1, 256, 256)
    found = np.asarray(PILImage.open(io.BytesIO(write_png(pixels))))
    assert (found == pixels[0]).all()
    color = np.stack([pixels[0], pixels[0] // 2, 65535 - pixels[0]])
    found = np.asarray(PILImage.open(io.BytesIO(write_png(color))).convert("RGB"))
    assert np.abs(found.transpose(2, 0, 1) - color / 257.0).max() <= 1.0


def test_png_of_8_bits_from_elsewhere_is_widened() -> None:
    """Pillow chooses among all five row filters."""
    y, x = np.mgrid[0:40, 0:37]
    pixels = np.stack([x * 6, y * 6, (x * y) % 251], axis=-1).astype(np.uint8)
    file = io.BytesIO()
    PILImage.fromarray(pixels).save(file, "PNG")
    assert (read_png(file.getvalue()) == pixels.transpose(2, 0, 1) * np.uint16(257)).all()


def test_png_row_filters_of_the_standard() -> None:
    """One row a filter, written after RFC 2083, section 6, byte by byte."""
    rng = np.random.default_rng(0)
    rows = rng.integers(0, 256, (5, 6 * 4), dtype=np.uint8).astype(int)

    def paeth(a: int, b: int, c: int) -> int:
        pa, pb, pc = abs(b - c), abs(a - c), abs(a + b - 2 * c)
        return a if pa <= pb and pa <= pc else b if pb <= pc else c

    filtered = b""
    for kind in range(5):
        above = rows[kind - 1] if kind else [0] * 24
        line = []
        for x in range(24):
            a, b, c = (rows[kind][x - 6] if x >= 6 else 0), above[x], (above[x - 6] if x >= 6 else 0)
            line.append((rows[kind][x] - (0, a, b, (a + b) // 2, paeth(a, b, c))[kind]) % 256)
        filtered += bytes([kind, *line])
    data = _png(struct.pack(">IIBBBBB", 4, 5, 16, 2, 0, 0, 0), zlib.compress(filtered))
    expected = rows.astype(np.uint8).view(">u2").reshape(5, 4, 3).transpose(2, 0, 1)
    assert (read_png(data) == expected).all()


def _png(header: bytes, packed: bytes) -> bytes:
    chunks = [(b"IHDR", header), (b"IDAT", packed), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)


def test_bad_png_is_refused() -> None:
    good = write_png(np.zeros((3, 4, 4), np.uint16))
    huge = _png(struct.pack(">IIBBBBB", 40_000, 40_000, 16, 2, 0, 0, 0), zlib.compress(b""))
    palette = _png(struct.pack(">IIBBBBB", 1, 1, 8, 3, 0, 0, 0), zlib.compress(b"\0\0"))
    for data, message in [
        (b"", "expected PNG"),
        (b"GIF89a", "expected PNG"),
        (good[:40], "truncated"),
        (good[:-20], "truncated"),
        (good[:50] + bytes([good[50] ^ 1]) + good[51:], "damaged"),
        (huge, "40000 x 40000"),
        (palette, "palette"),
    ]:
        with pytest.raises(PngError, match=message):
            read_png(data)


# Refused


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"version": 1, "tree": {"root": {"kind"', "not JSON, or truncated"),
        ("[1]", "expected a JSON object"),
        (json.dumps({"version": 1, "tree": {"root": ALBEDO, "exposure": "2"}}), "tree.exposure: expected a number, got a string"),
        (json.dumps({"version": 1, "tree": {"root": ALBEDO, "blend_space": ["srgb"]}}), "tree.blend_space: expected srgb or linear"),
        (json.dumps({"version": 1, "tree": [ALBEDO]}), "tree: expected an object, got a list"),
        ('{"tree": {}}', "version: expected 1, got none"),
        ('{"version": "1", "tree": {}}', "version: expected 1, got '1'"),
        ('{"version": true, "tree": {}}', "version: expected 1"),
        ('{"version": 1.5, "tree": {}}', "version: expected 1"),
        ('{"version": 1e999, "tree": {}}', "version: expected 1"),
        ('{"version": 2, "tree": {}}', "version 2, later than 1"),
        ('{"version": 1, "version": 1}', "'version' stands twice"),
        ('{"version": 1}', "'tree' is missing"),
        ('{"version": 1, "tree": {}, "famly": {}}', "'famly'; did you mean 'family'"),
        (document({"kind": "heighlight", "parameters": {}}), "tree.root: unknown kind 'heighlight'; did you mean 'highlight'"),
        (document({"parameters": {}}), "tree.root: 'kind' is missing"),
        (document({"kind": 3}), "'kind' must be a string"),
        (document({"kind": "albedo"}), "'parameters' is missing"),
        (document({"kind": "albedo", "parameters": {"color": [0, 0, 2]}}), r"albedo.color: must be in \[0, 1\], got 0, 0, 2"),
        (document({"kind": "albedo", "parameters": {"color": [0, 0, True]}}), "expected a number, got true or false"),
        (document({"kind": "albedo", "parameters": {"color": [0, 0, "a"]}}), "expected a number, got a string"),
        (document({"kind": "albedo", "parameters": {"color": 0.5}}), "expected a list, got a number"),
        (document({"kind": "albedo", "parameters": {"colr": [0, 0, 0]}}), "'colr'; did you mean 'color'"),
        (document({"kind": "diffuse", "parameters": {"direction": [0, 0, 0]}}), "a direction cannot be zero"),
        (document({"kind": "diffuse", "parameters": {}, "name": 3}), "name: expected a string"),
        (document({"kind": "threshold", "parameters": {}}), "only a mask"),
        (document({"kind": "screen", "children": [ALBEDO]}), "screen: needs two or more children"),
        (document({"kind": "screen", "children": [ALBEDO, {"kind": "stripe", "parameters": {}}]}), "a mask .stripe. cannot be a child"),
        (document({"kind": "screen", "children": [ALBEDO, {"kind": "x"}]}), "tree.root.1: unknown kind 'x'"),
        (document({"kind": "mix", "children": [ALBEDO, ALBEDO], "mask": ALBEDO}), "mix: needs a mask"),
        (document({"kind": "screen", "children": [ALBEDO, ALBEDO], "mask": ALBEDO}), "unknown key 'mask'"),
        (document({"kind": "image", "parameters": {"pixels": {"png": "?"}}}), "expected a PNG in base64"),
        (document({"kind": "image", "parameters": {"pixels": [1]}}), "expected an object, got a list"),
        (
            document({"kind": "environment", "parameters": {"direction": [[0, 0, 1]], "sharpness": 3, "color": [[0, 0, 0]]}}),
            "expected a list",
        ),
        (
            document({"kind": "environment", "parameters": {"direction": [[0, 0, 1]] * 2, "sharpness": [3], "color": [[0, 0, 0]]}}),
            "as many",
        ),
        ('{"version": 1, "tree": {"root": {"kind": "albedo", "parameters": {"color": [0, 0, NaN]}}}}', "finite, got NaN"),
        ('{"version": 1, "tree": {"root": {"kind": "albedo", "parameters": {"color": [0, 0, -Infinity]}}}}', "finite, got -Infinity"),
        ('{"version": 1, "tree": {"root": {"kind": "albedo", "parameters": {"color": [0, 0, 1e999]}}}}', "finite"),
        (f'{{"version": 1, "tree": {{"root": {{"kind": "albedo", "parameters": {{"color": [0, 0, {"9" * 5000}]}}}}}}}}', "finite"),
        (
            '{"version": 1, "tree": {"exposure": -1, "root": {"kind": "albedo", "parameters": {"color": [0, 0, 0]}}}}',
            "exposure must be a pos",
        ),
        (
            '{"version": 1, "tree": {"blend_space": "lab", "root": {"kind": "albedo", "parameters": {"color": [0, 0, 0]}}}}',
            "srgb or linear",
        ),
    ],
)
def test_bad_json_is_refused_with_the_reason(text: str, message: str) -> None:
    with pytest.raises(TreeError, match=message):
        loads(text)


@pytest.mark.parametrize(
    ("family", "message"),
    [
        ({"chosen": 1, "members": [{"psnr": 3, "tree": {"root": ALBEDO}}]}, "family.chosen: expected the number of one of the 1 members"),
        ({"chosen": 0, "members": []}, "family.chosen"),
        ({"chosen": 0, "members": [{"psnr": "3", "tree": {"root": ALBEDO}}]}, "family.members.0.psnr"),
        ({"chosen": 0, "members": [{"tree": {"root": ALBEDO}}]}, "family.members.0: 'psnr' is missing"),
        ({"chosen": 0, "members": [{"psnr": 3, "tree": {"root": {"kind": "albedoo"}}}]}, "family.members.0.tree.root: unknown kind"),
    ],
)
def test_bad_families_are_refused(family: Any, message: str) -> None:
    with pytest.raises(TreeError, match=message):
        loads_family(document(ALBEDO, family=family))


@given(trees(max_leaves=3), st.data())
def test_truncated_json_is_refused(tree: Tree, data: st.DataObject) -> None:
    text = dumps(tree).rstrip()
    with pytest.raises(TreeSyntaxError):
        loads(text[: data.draw(st.integers(1, len(text) - 1))])


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=5),
        lambda below: st.lists(below) | st.dictionaries(st.text(max_size=5), below),
    )
)
def test_any_other_json_is_refused_without_a_crash(value: Any) -> None:
    for text in (json.dumps(value), document(value), document({"kind": "screen", "children": [ALBEDO, value]})):
        with pytest.raises(TreeError):
            loads(text)


def test_a_million_nodes_are_refused_before_they_are_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    one = json.dumps(ALBEDO)
    monkeypatch.setattr(json, "loads", lambda *_, **__: pytest.fail("the document was decoded"))
    with pytest.raises(TreeSyntaxError, match="nodes at most"):
        loads('{"version": 1, "tree": {"root": {"kind": "screen", "children": [' + ", ".join([one] * 1_000_000) + "]}}}")


def test_a_million_nodes_of_text_are_refused() -> None:
    with pytest.raises(TreeSyntaxError, match="nodes at most"):
        parse("screen(" + "albedo()," * 1_000_000 + ")")


def test_too_many_nodes_are_refused_both_ways() -> None:
    tree = Tree(Operator("screen", (leaf("albedo"),) * MAX_NODES))
    for write in (dumps, to_text):
        with pytest.raises(TreeError, match="nodes at most"):
            write(tree)
    with pytest.raises(TreeSyntaxError, match="nodes at most"):
        loads(document({"kind": "screen", "children": [ALBEDO] * MAX_NODES}))


def nested_json(depth: int) -> str:
    one = json.dumps(ALBEDO)
    return '{"version": 1, "tree": {"root": ' + f'{{"kind": "screen", "children": [{one}, ' * depth + one + "]}" * depth + "}}"


def nested_text(depth: int) -> str:
    return "screen(albedo(), " * depth + "albedo()" + ")" * depth


@pytest.mark.parametrize("depth", [MAX_DEPTH, 10_000, 100_000])
def test_deep_nesting_is_refused(depth: int) -> None:
    with pytest.raises(TreeSyntaxError, match="nested too deep"):
        loads(nested_json(depth))
    with pytest.raises(TreeSyntaxError, match="nested too deep"):
        parse(nested_text(depth))
    with pytest.raises(TreeSyntaxError):
        loads("[" * depth)
    with pytest.raises(TreeSyntaxError):
        parse("(" * depth)


def test_nesting_up_to_the_limit_is_read_and_written() -> None:
    tree = loads(nested_json(MAX_DEPTH - 1))
    assert dumps(parse(to_text(tree))) == dumps(tree)


def test_a_tree_too_deep_to_be_read_back_is_not_written() -> None:
    node = leaf("albedo")
    for _ in range(5000):
        node = screen(leaf("albedo"), node)  # type: ignore[assignment]
    for write in (dumps, to_text):
        with pytest.raises(TreeError, match="nested too deep"):
            write(Tree(node))


# Files


@pytest.mark.parametrize("data", [b"\xff\xfe\x00", b"", b"\x89PNG\r\n\x1a\n"])
def test_a_file_that_is_no_tree_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "tree.json").write_bytes(data)
    with pytest.raises(TreeSyntaxError):
        load(tmp_path / "tree.json")


def test_a_file_that_cannot_be_read_is_a_tree_error(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.json"):
        with pytest.raises(TreeError, match="cannot read"):
            load(path)


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "tree.json"
    dump(parse(EXAMPLE), path)
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for step in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(unshade.files.os, step, full)
            with pytest.raises(OutputError, match="No space left"):
                dump(Tree(leaf("albedo")), path)
        assert path.read_bytes() == before
        assert os.listdir(tmp_path) == ["tree.json"]

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(unshade.files.os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        dump(Tree(leaf("albedo")), path)
    assert os.listdir(tmp_path) == ["tree.json"] and path.read_bytes() == before


def test_an_output_that_cannot_be_written_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    for path in (tmp_path, tmp_path / "none" / "tree.json", tmp_path / "file" / "tree.json"):
        with pytest.raises(OutputError, match="cannot write"):
            dump(Tree(leaf("albedo")), path)
    assert os.listdir(tmp_path) == ["file"]


# Text


def test_sugar() -> None:
    tree = parse(EXAMPLE)
    albedo = leaf("albedo", color=(0xCC / 255, 0x20 / 255, 0x30 / 255))
    expected = screen(
        multiply(albedo, leaf("diffuse", direction=(-1, 1, 0), ambient=0.2)),
        leaf("highlight", direction=(0.1, 0.2, 0.97), sharpness=40, amplitude=1),
    )
    assert to_text(tree) == to_text(Tree(expected))
    assert tree.root.children[0].children[0] == albedo  # type: ignore[union-attr]


@pytest.mark.parametrize("word", COLOR_WORDS)
def test_colour_words_are_the_browser_s(word: str) -> None:
    from PIL import ImageColor

    assert parse(f"albedo({word})") == parse("albedo({})".format("#{:02x}{:02x}{:02x}".format(*ImageColor.getrgb(word))))


@pytest.mark.parametrize(
    ("one", "same"),
    [
        ("albedo(#f80)", "albedo(#ff8800)"),
        ("highlight((0, 0, 1), 40, 0.5)", "highlight(amplitude=.5, sharpness=4e1, direction=front)"),
        ("diffuse()", "diffuse((0, 0, 1), ambient=0.2)"),
        ("diffuse(up left front)", "diffuse((-1, 1, 1))"),
        ("diffuse(up up right)", "diffuse((1, 2, 0))"),
        ("mix(albedo(red), albedo(blue), threshold(up))", "mix(albedo(red), mask=threshold(up), albedo(blue))"),
        ("\n screen ( albedo ( red ) ,\n\thighlight ( ) )\n", "screen(albedo(red), highlight())"),
        ("albedo(red) @linear exposure=2", "albedo(red)@linear exposure = 2.0"),
        ("albedo(red) @srgb", "albedo(red)"),
        ("environment(up, 20, white; left, color=red)", "environment((0, 1, 0), 20, #fff; (-1, 0, 0), sharpness=10, color=#f00)"),
        (r'albedo(red, name="k\u00e9y")', 'albedo(name="kéy", red)'),
    ],
)
def test_two_ways_to_write_the_same(one: str, same: str) -> None:
    assert parse(one) == parse(same)


def test_what_is_written() -> None:
    tree = parse('mix(albedo(#ff0000, name="a \\"b\\""), environment(up, 20; left, 5), threshold(right)) @linear exposure=2.5')
    assert to_text(tree) == (
        'mix(albedo((1, 0, 0), name="a \\"b\\""), '
        "environment((0, 1, 0), sharpness=20, color=(0.5, 0.5, 0.5); (-1, 0, 0), sharpness=5, color=(0.5, 0.5, 0.5)), "
        "threshold((1, 0, 0), threshold=0, softness=0)) @linear exposure=2.5"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("|", "expected a node"),
        ("|42", "expected a node"),
        ("|heighlight()", "did you mean 'highlight'"),
        ("screen(albedo(red), |higlight())", "did you mean 'highlight'"),
        ("albedo|", "expected '\\('"),
        ("albedo(red|", "expected ',' or '\\)'"),
        ("albedo(red) |albedo(red)", "expected the end"),
        ("albedo(|rde)", "unknown colour 'rde'; did you mean 'red'"),
        ("albedo(|#12345)", "#rgb or #rrggbb"),
        ("albedo(|#12345g)", "#rgb or #rrggbb"),
        ("albedo(|0.5)", "expected '\\('"),
        ("albedo(|(0.5, 0.5))", "expected 3 numbers, got 2"),
        ("albedo((0.5, |red, 1))", "expected a number, got 'red'"),
        ("albedo(|(0.5, 0.5, 1.5))", "must be in \\[0, 1\\]"),
        ("albedo(|(0.5, 0.5, 1e999))", "finite"),
        ("diffuse(|left right)", "cancel out"),
        ("diffuse(left |upp)", "unknown direction 'upp'; did you mean 'up'"),
        ("diffuse(|(0, 0, 0))", "cannot be zero"),
        ("diffuse(left, |ambiant=0.2)", "did you mean 'ambient'"),
        ("diffuse(left, ambient=|nan)", "expected a number, got 'nan'"),
        ("diffuse(left, ambient=|1.2)", "diffuse.ambient: must be in"),
        ("diffuse(left, ambient=0.1, |ambient=0.2)", "already"),
        ("diffuse(left, 0.1, |0.2)", "takes 2 values"),
        ("diffuse(ambient=0.1, |left)", "needs its name"),
        ("diffuse(left |0.1)", "expected ',' or '\\)'"),
        ("diffuse(left|; right)", "takes no ';'"),
        ("environment(up, 20; left, |1e9)", "environment.sharpness: must be in"),
        ("screen(albedo(red)|)", "two or more"),
        ("screen(albedo(red), |threshold(up))", "cannot be a child"),
        ("screen(albedo(red), |mask=threshold(up))", "takes nodes and a name"),
        ("|threshold(up)", "only a mask"),
        ("mix(albedo(red), albedo(blue)|)", "needs a mask"),
        ("mix(albedo(red), albedo(blue), |albedo(red))", "needs a mask"),
        ("mix(albedo(red), |stripe(), albedo(red))", "cannot be a child"),
        ('albedo(red, name="a", |name="b")', "one name"),
        ("albedo(red, name=|key)", "in double quotes"),
        ('albedo(red, name=|"key)', "no end"),
        ('albedo(red, name=|"\\q")', "escape"),
        ("albedo(red) @|lab", "srgb or linear"),
        ("albedo(red) exposure=|-2", "positive"),
        ("albedo(red|%)", "unexpected character '%'"),
        ("|image()", "needs pixels"),
        ('image(|"AAAA")', "expected PNG"),
        ('image(|"A")', "base64"),
        ("screen(albedo(red),\n  |heighlight())", "did you mean 'highlight'"),
    ],
)
def test_errors_point_at_the_column(text: str, message: str) -> None:
    column = text.index("|") + 1
    with pytest.raises(TreeSyntaxError, match=message) as caught:
        parse(text.replace("|", "", 1))
    assert caught.value.column == column
    shown = str(caught.value).splitlines()
    assert shown[-1].strip() == "^" and len(shown) == 3


@given(st.text(alphabet='abcdeilmnorstux(),;=@#"\\ .-0123456789', max_size=40))
def test_any_other_text_is_refused_without_a_crash(text: str) -> None:
    with pytest.raises(TreeSyntaxError):
        parse(text)


def test_a_cut_text_points_at_its_end() -> None:
    for end in range(1, len(EXAMPLE)):
        with pytest.raises(TreeSyntaxError) as caught:
            parse(EXAMPLE[:end])
        assert 1 <= caught.value.column <= end + 1


def test_a_raster_in_text_is_a_png() -> None:
    raster = Raster.from_array(np.linspace(0, 1, 12).reshape(3, 2, 2))
    text = to_text(Tree(leaf("image", pixels=raster)))
    assert (read_png(base64.b64decode(text.split('"')[1])).astype(">u2").tobytes()) == raster.data


def test_kinds_from_outside_are_read_and_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unshade.nodes.KINDS", KINDS)
    scale = Parameter("scale", "scalar", "strength", 0.0, 1.0, (1.0,))
    register(Kind("fog", Role.PAINT, lambda normals, scale: normals[..., 2:3, :, :] * scale[..., None, None], (scale,), "fades"))
    register(Kind("glass", Role.ENVIRONMENT, lambda normals: normals[..., 2:3, :, :], (), "nothing to set"))
    try:
        tree = Tree(screen(leaf("fog", scale=0.3), leaf("glass", name="window")))
        assert to_text(tree) == 'screen(fog(0.3), glass(name="window"))'
        assert parse(to_text(tree)) == loads(dumps(tree)) == tree
        jsonschema.validate(json.loads(dumps(tree)), tree_schema())
    finally:
        del KINDS["fog"], KINDS["glass"]


def test_loading_keeps_leaf_values_as_floats() -> None:
    tree = loads(document({"kind": "highlight", "parameters": {"direction": [0, 0, 1], "sharpness": 40, "amplitude": 1}}))
    assert isinstance(tree.root, Leaf) and all(type(number) is float for value in tree.root.values for number in value)


def test_the_command_line_knows_the_kinds_of_installed_packages(tmp_path: Path) -> None:
    module = """
from unshade.nodes import Kind, Parameter, Role, register
from unshade.shading import facing
def glow(normals, direction):
    return facing(normals, direction).clamp(min=0.0) ** 4
register(Kind("glow", Role.HIGHLIGHT, glow, (Parameter("direction", "direction", "where", -1.0, 1.0, (0.0, 0.0, 1.0)),), "a glow"))
"""
    (tmp_path / "glowing.py").write_text(module, encoding="utf-8")
    (tmp_path / "glowing-1.dist-info").mkdir()
    (tmp_path / "glowing-1.dist-info" / "METADATA").write_text("Name: glowing\nVersion: 1\n", encoding="utf-8")
    announced = tmp_path / "glowing-1.dist-info" / "entry_points.txt"
    announced.write_text("[unshade.kinds]\nglow = glowing\n", encoding="utf-8")
    tree = tmp_path / "tree.txt"
    tree.write_text("screen(albedo(#336699), glow(up))", encoding="utf-8")

    def shown() -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        command = [sys.executable, "-m", "unshade", "info", str(tree)]
        return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)

    done = shown()
    assert done.returncode == 0, done.stderr
    assert "glow" in done.stdout
    (tmp_path / "glowing.py").write_text("raise RuntimeError('no licence')\n", encoding="utf-8")
    broken = shown()
    assert broken.returncode == 4
    assert "glowing" in broken.stderr and "no licence" in broken.stderr and "Traceback" not in broken.stderr
    announced.unlink()
    assert "unknown kind 'glow'" in shown().stderr
