"""Rendering, its gradients, its parameters, and what it must go on looking like.

Refresh the pictures of tests/golden with ``UNSHADE_REFRESH_GOLDEN=1 pytest tests/test_render.py`` and look at the change.
On a failure, tests/golden/failed holds expected, found and eight times their difference side by side.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as PILImage

from strategies import BUILT_IN, nodes, trees
from unshade.blend import BLENDS
from unshade.canonical import canonical, structure_key
from unshade.errors import TreeError
from unshade.nodes import KINDS, Kind, Leaf, Node, Parameter, Raster, Role, Tree, count_values, leaf, mix, multiply, register, screen
from unshade.parameters import Layout
from unshade.render import part, render, srgb_decode, srgb_encode
from unshade.serde import dumps, loads
from unshade.sphere import disc_mask, reflect, sphere_normals
from unshade.text import parse, to_text

GOLDEN = Path(__file__).parent / "golden"
NORMALS = sphere_normals(12, dtype=torch.float64)
SMOOTH = tuple(name for name in BUILT_IN if name not in ("image", "image_mask", "environment_map"))


# What every tree's picture is


@given(trees())
def test_renders_stay_in_range(tree: Tree) -> None:
    for normals in (NORMALS, NORMALS.float(), -NORMALS):
        picture = render(tree, normals)
        assert picture.shape == (3, 12, 12) and picture.dtype == normals.dtype
        assert picture.min() >= -1e-6 and picture.max() <= 1.0 + 1e-6


@given(trees(max_leaves=5))
def test_float32_is_near_float64(tree: Tree) -> None:
    """All but the few pixels that a hard edge or a sharp light falls on."""
    exact, rounded = render(tree, NORMALS), render(tree, NORMALS.float())
    assert (exact - rounded).abs().quantile(0.8) <= 2e-3


@given(nodes(max_leaves=5))
def test_a_batch_of_normals_equals_a_loop(node: Node) -> None:
    batch = torch.stack([NORMALS, NORMALS.flip(-1), -NORMALS])
    together = render(node, batch)
    alone = torch.stack([render(node, normals) for normals in batch])
    assert torch.allclose(together, alone, rtol=0, atol=1e-9)


@given(nodes(max_leaves=5), st.integers(0, 2**31))
def test_a_batch_of_parameters_equals_a_loop(node: Node, seed: int) -> None:
    layout = Layout.of(node)
    own = layout.pack(node)
    noise = torch.randn(3, layout.size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    batch = (own + 0.05 * noise).clamp(layout.lower, layout.upper)
    together = render(node, NORMALS, batch)
    alone = torch.stack([render(node, NORMALS, parameters) for parameters in batch])
    assert together.shape == (3, 3, 12, 12)
    assert torch.allclose(together, alone, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_leaf_broadcasts_normals_and_parameters(name: str) -> None:
    kind = KINDS[name]
    drawn = [torch.stack([_numbers(parameter, 10 * seed + k) for seed in range(2)]) for k, parameter in enumerate(kind.parameters)]
    many = [numbers[:, None] if kind.repeats else numbers for numbers in drawn]
    one = [numbers[0] for numbers in many]
    batch = torch.stack([NORMALS, NORMALS.flip(-1)])
    alone = kind.formula(NORMALS, *one)
    assert alone.shape == (kind.channels, 12, 12)
    for normals, parameters in ((NORMALS, many), (batch, one), (batch, many)):
        together = kind.formula(normals, *parameters)
        assert together.shape == (2, kind.channels, 12, 12)
        assert torch.allclose(together[0], alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", BUILT_IN)
@pytest.mark.parametrize("device", ["meta", "cuda"])
def test_every_leaf_follows_the_device_of_the_normals(device: str, name: str) -> None:
    """A formula with a number of its own on the CPU fails on ``meta``, which needs no hardware; CUDA shows the same picture."""
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    kind = KINDS[name]
    parameters = [_numbers(parameter, k) for k, parameter in enumerate(kind.parameters)]
    parameters = [numbers[None] if kind.repeats else numbers for numbers in parameters]
    for normals in (NORMALS, NORMALS.float()):
        shaded = kind.formula(normals.to(device), *(numbers.to(device, normals.dtype) for numbers in parameters))
        assert (shaded.device.type, shaded.dtype, shaded.shape) == (device, normals.dtype, (kind.channels, 12, 12))
        if device == "cuda":
            expected = kind.formula(normals, *(numbers.to(normals.dtype) for numbers in parameters))
            torch.testing.assert_close(shaded.cpu(), expected, rtol=0, atol=1e-5)


@given(nodes(max_leaves=4))
@settings(max_examples=15)
def test_one_set_of_parameters_for_each_picture(node: Node) -> None:
    batch = torch.stack([NORMALS, NORMALS.flip(-2)])
    parameters = Layout.of(node).pack(node).expand(2, -1)
    assert torch.allclose(render(node, batch, parameters), render(node, batch), rtol=0, atol=1e-9)


@given(trees(max_leaves=4), st.integers(0, 11), st.integers(0, 11))
@settings(max_examples=20)
def test_a_pixel_depends_on_its_own_normal_only(tree: Tree, y: int, x: int) -> None:
    one = render(tree, NORMALS[:, y : y + 1, x : x + 1])
    assert torch.allclose(one, render(tree, NORMALS)[:, y : y + 1, x : x + 1], rtol=0, atol=1e-9)


@given(nodes(max_leaves=6))
def test_pack_and_unpack_change_nothing(node: Node) -> None:
    layout = Layout.of(node)
    vector = layout.pack(node)
    assert vector.shape == (layout.size,) == layout.lower.shape == layout.free.shape
    assert layout.unpack(node, vector) == node
    assert torch.equal(layout.pack(layout.unpack(node, vector)), vector)


@given(nodes(max_leaves=6))
def test_the_free_numbers_are_the_counted_values(node: Node) -> None:
    """A direction is three numbers and two values; rasters are counted, but are no numbers of the vector."""
    layout = Layout.of(node)
    directions = sum(name == "direction" for name in layout.types) // 3
    rasters = sum(
        value.channels * value.height * value.width
        for _, found in Tree(node).walk()
        if isinstance(found, Leaf)
        for value in found.values
        if isinstance(value, Raster)
    )
    most = layout.size - directions + rasters
    assert most - int((~layout.free).sum()) <= count_values(node) <= most


def test_unpack_brings_numbers_into_range() -> None:
    node = leaf("highlight")
    layout = Layout.of(node)
    assert layout.unpack(node, torch.full((layout.size,), 1e9))["amplitude"] == (2.0,)  # type: ignore[index]


@given(nodes(max_leaves=5))
@settings(max_examples=15)
def test_gradients_are_finite(node: Node) -> None:
    parameters = Layout.of(node).pack(node).requires_grad_()
    picture = render(node, NORMALS, parameters)
    if picture.requires_grad:
        picture.sum().backward()
        assert parameters.grad is not None and torch.isfinite(parameters.grad).all()


def test_linear_light_is_encoded_at_the_end() -> None:
    root = parse("screen(albedo(#402010), highlight())").root
    assert torch.equal(render(Tree(root, "linear"), NORMALS), srgb_encode(render(root, NORMALS)))
    ramp = torch.linspace(0, 1, 1001, dtype=torch.float64)
    assert torch.allclose(srgb_decode(srgb_encode(ramp)), ramp, atol=1e-7)


# Conventions, by hand


def _pixel(node: Node, normal: tuple[float, float, float]) -> list[float]:
    direction = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    return render(node, direction.view(3, 1, 1))[:, 0, 0].tolist()


def test_formulas_at_chosen_normals() -> None:
    slanted = (0.0, 0.6, 0.8)
    d2 = 2 - 2 * 0.8
    cases = [
        (leaf("diffuse", direction=(0, 0, 1), ambient=0.2), slanted, 0.2 + 0.8 * 0.8),
        (leaf("diffuse", direction=(0, -1, 0), ambient=0.2), slanted, 0.2),
        (leaf("highlight", direction=(0, 0, 1), sharpness=3, amplitude=0.7), slanted, 0.7 * math.exp(-3 * d2)),
        (leaf("highlight", direction=slanted, sharpness=3, amplitude=1.5), slanted, 1.0),
        (leaf("rim", direction=(0, 1, 0), exponent=2), slanted, 0.2**2 * 0.6),
        (leaf("toon_diffuse", direction=(0, 0, 1), ambient=0.3, threshold=0.75, softness=0.1), slanted, 0.3 + 0.7 * 0.5),
        (leaf("toon_highlight", direction=(0, 0, 1), radius=math.acos(0.79), brightness=0.4), slanted, 0.4),
        (leaf("toon_highlight", direction=(0, 0, 1), radius=math.acos(0.81), brightness=0.4), slanted, 0.0),
        (leaf("environment", direction=(0, 0.96, 0.28), sharpness=9, color=(0.5,) * 3), slanted, 0.5),
    ]
    for node, normal, expected in cases:
        assert _pixel(node, normal) == pytest.approx([expected] * 3, abs=1e-6), node


def test_a_mask_of_1_shows_the_left() -> None:
    node = mix(leaf("albedo", color=(1, 0, 0)), leaf("albedo", color=(0, 0, 1)), leaf("threshold", direction=(1, 0, 0)))
    assert _pixel(node, (0.5, 0, 0.5)) == pytest.approx([1, 0, 0])
    assert _pixel(node, (-0.5, 0, 0.5)) == pytest.approx([0, 0, 1])


def test_axes() -> None:
    """Right is +x, up is +y, row 0 is the top."""
    for word, (rows, columns) in {"right": (slice(24, 40), slice(48, 60)), "up": (slice(4, 16), slice(24, 40))}.items():
        bright = render(parse(f"diffuse({word}, ambient=0)"), sphere_normals(64))
        assert bright[:, rows, columns].min() > 0.45
        assert bright.flip(-1, -2)[:, rows, columns].max() == 0.0


def test_a_picture_leaf_is_indexed_by_the_normal() -> None:
    pixels = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    node = leaf("image", pixels=Raster.from_array(pixels))
    inside = disc_mask(16, 1.0)[0]
    assert torch.allclose(render(node, sphere_normals(16))[:, inside], pixels[:, inside], atol=1e-4)


def test_an_environment_map_is_looked_up_along_the_mirror_direction() -> None:
    """Columns from -z over -x, +z (the centre) and +x back to -z; rows from +y down."""
    pixels = torch.zeros(3, 32, 64)
    directions = {"front": (0.0, 0.0, 1.0), "right": (1.0, 0.0, 0.0), "left": (-1.0, 0.0, 0.0), "up": (0.0, 1.0, 0.0)}
    pixels[:, 12:20, 28:36], pixels[0, 12:20, 44:52], pixels[1, 12:20, 12:20], pixels[2, :6, :] = 1.0, 1.0, 1.0, 1.0
    colors = {"front": [1, 1, 1], "right": [1, 0, 0], "left": [0, 1, 0], "up": [0, 0, 1]}
    node = leaf("environment_map", pixels=Raster.from_array(pixels))
    for name, (x, y, z) in directions.items():
        halfway = (x, y, z + 1.0)
        assert _pixel(node, halfway) == pytest.approx(colors[name], abs=1e-3), name
        normal = torch.nn.functional.normalize(torch.tensor(halfway), dim=0).view(3, 1, 1)
        assert torch.allclose(reflect(normal).flatten(), torch.tensor((x, y, z)), atol=1e-6)
    turned = node.set(rotation=(0, math.pi / 2, 0))
    assert _pixel(turned, (1.0, 0.0, 1.0)) == pytest.approx([1, 1, 1], abs=1e-3), "turning about +y takes the front to the right"


def test_parts_are_the_diffuse_and_the_lights() -> None:
    node = parse("screen(multiply(albedo(red), diffuse()), multiply(albedo(gold), highlight()), rim())").root
    assert structure_key(part(node, "diffuse")) == "multiply(albedo,diffuse)"
    assert structure_key(part(node, "specular")) == "screen(multiply(albedo,highlight),rim)"


# Gradients


def _numbers(parameter: Parameter, seed: int) -> torch.Tensor:
    """Numbers well inside a parameter's range, (1, n) or a small picture."""
    generator = torch.Generator().manual_seed(seed)
    if parameter.type == "raster":
        return torch.rand(parameter.channels, 4, 6, generator=generator, dtype=torch.float64)
    low, high = max(parameter.low, -1.0), min(parameter.high, 1.0)
    return low + (high - low) * (0.15 + 0.7 * torch.rand(parameter.size, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("name", BUILT_IN)
def test_gradcheck_of_every_leaf(name: str) -> None:
    kind = KINDS[name]
    normals = sphere_normals(5, dtype=torch.float64)[:, 1:4, 1:4]
    for seed in range(3):
        arguments = [_numbers(parameter, 10 * seed + k).requires_grad_() for k, parameter in enumerate(kind.parameters)]
        if kind.repeats:
            arguments = [torch.stack([argument, 0.5 * argument.roll(1)]).detach().requires_grad_() for argument in arguments]
        _soften(kind, arguments)
        torch.autograd.gradcheck(lambda *numbers: kind.formula(normals, *numbers), arguments)
        if name != "albedo":
            assert kind.formula(normals, *arguments).detach().std() > 1e-3, "the check looks at a constant"


def _soften(kind: Kind, arguments: list[torch.Tensor]) -> None:
    """Wide edges and lights, so that what is checked is not a constant 0 or 1."""
    for parameter, argument in zip(kind.parameters, arguments, strict=True):
        with torch.no_grad():
            if parameter.name == "softness":
                argument.fill_(2.2)
            if parameter.name in ("threshold", "center"):
                argument.mul_(0.2)


@pytest.mark.parametrize("name", [name for name in BUILT_IN if name not in ("albedo", "image", "image_mask")])
def test_gradcheck_of_normals(name: str) -> None:
    """Normals have gradients too, for meshes and normal maps; a mirror or a light is as steep as it is."""
    kind = KINDS[name]
    arguments = [_numbers(parameter, 3 + k) for k, parameter in enumerate(kind.parameters)]
    arguments = [argument[None] for argument in arguments] if kind.repeats else arguments
    _soften(kind, arguments)
    normals = sphere_normals(5, dtype=torch.float64)[:, 1:3, 1:3].clone().requires_grad_()
    torch.autograd.gradcheck(lambda n: kind.formula(n, *arguments), [normals])


def _layers(name: str) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.rand(2, 3, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(3 if name == "mix" else 4)]


@pytest.mark.parametrize("name", BLENDS)
def test_gradcheck_of_every_blend(name: str) -> None:
    torch.autograd.gradcheck(BLENDS[name].apply, _layers(name))
    torch.autograd.gradgradcheck(BLENDS[name].apply, _layers(name))


@pytest.mark.parametrize("name", BLENDS)
def test_gains_of_every_blend_are_its_derivatives(name: str) -> None:
    layers = _layers(name)
    derivatives = torch.autograd.grad(BLENDS[name].apply(*layers).sum(), layers)
    for gain, derivative in zip(BLENDS[name].gains(*layers), derivatives, strict=True):
        assert torch.allclose(torch.as_tensor(gain).expand_as(derivative), derivative, atol=1e-12)


@pytest.mark.parametrize("name", BLENDS)
def test_every_blend_is_affine_in_each_layer(name: str) -> None:
    layers = [layer.detach() for layer in _layers(name)]
    blend = BLENDS[name]
    for k, gain in enumerate(blend.gains(*layers)):
        moved = [layer + 0.3 * (index == k) for index, layer in enumerate(layers)]
        assert torch.allclose(blend.apply(*moved), blend.apply(*layers) + 0.3 * gain, atol=1e-12)


@pytest.mark.parametrize("name", BLENDS)
def test_the_identity_of_a_blend_changes_nothing(name: str) -> None:
    blend, layer = BLENDS[name], torch.tensor([0.0, 0.3, 1.0])
    if blend.identity is None:
        assert torch.equal(blend.apply(layer, layer, torch.tensor(0.4)), layer)
    else:
        assert torch.equal(blend.apply(layer, torch.full_like(layer, blend.identity)), layer)


@given(nodes(SMOOTH[:7], ("threshold", "stripe"), max_leaves=4))
@settings(max_examples=10)
def test_the_simplified_tree_renders_the_same(node: Node) -> None:
    assert torch.allclose(render(canonical(node), NORMALS), render(node, NORMALS), rtol=0, atol=1e-5)


# Kinds from outside


def velvet(normals: torch.Tensor, direction: torch.Tensor, width: torch.Tensor) -> torch.Tensor:
    """Bright where the surface turns away from a direction."""
    facing = (normals * direction[..., None, None]).sum(-3, keepdim=True)
    return torch.exp(-facing.square() / width[..., None, None].square())


@pytest.fixture
def velvet_kind() -> Iterator[Kind]:
    parameters = (
        Parameter("direction", "direction", "the axis of the band", -1.0, 1.0, (0.0, 1.0, 0.0)),
        Parameter("width", "scalar", "how wide the band is", 0.01, 4.0, (0.5,), logarithmic=True),
    )
    yield register(Kind("velvet", Role.HIGHLIGHT, velvet, parameters, "a band of sheen"))
    del KINDS["velvet"]


def test_a_kind_from_outside_works_from_end_to_end(velvet_kind: Kind) -> None:
    tree = parse("screen(albedo(#402020), multiply(albedo(gold), velvet(left, width=0.3)))")
    assert parse(to_text(tree)) == loads(dumps(tree)) == tree
    assert tree.values == 3 + 3 + 2 + 1
    assert structure_key(tree) == "screen(albedo,multiply(albedo,velvet))"
    layout = Layout.of(tree.root)
    assert layout.unpack(tree.root, layout.pack(tree.root)) == tree.root
    parameters = layout.pack(tree.root).requires_grad_()
    picture = render(tree, NORMALS, parameters)
    assert torch.allclose(picture, render(canonical(tree.root), NORMALS), atol=1e-9)
    (gradient,) = torch.autograd.grad(picture.sum(), parameters)
    assert gradient[-1] != 0
    assert structure_key(part(tree.root, "diffuse")) == "albedo"
    with pytest.raises(TreeError, match=r"velvet.width: must be in \[0.01, 4\]"):
        leaf("velvet", width=9)
    with pytest.raises(TreeError, match="did you mean 'velvet'"):
        parse("velvett()")


@pytest.mark.parametrize("name", ["albedo", "mix", "no name"])
def test_a_kind_with_a_bad_name_is_refused(name: str) -> None:
    with pytest.raises(TreeError):
        register(Kind(name, Role.PAINT, velvet, (), "nothing"))


# Golden pictures


def _ramp(channels: int, height: int, width: int) -> Raster:
    y, x = np.mgrid[0:height, 0:width]
    planes = [x / (width - 1), y / (height - 1), 0.5 + 0.5 * np.sin(3 * x) * np.cos(2 * y)]
    return Raster.from_array(np.stack(planes[:channels]))


GOLDEN_TREES: dict[str, Any] = {
    "albedo": "albedo(#cc2030)",
    "diffuse": "diffuse(left up front, ambient=0.2)",
    "highlight": "highlight((0.3, 0.4, 0.87), sharpness=20, amplitude=1.4)",
    "rim": "rim(right up, exponent=1.5)",
    "toon_diffuse": "toon_diffuse(left up front, ambient=0.4, threshold=0.2, softness=0.1)",
    "toon_highlight": "toon_highlight((0.3, 0.4, 0.87), radius=0.35, brightness=0.8, softness=0.2)",
    "environment": "environment(up, 8, #80a0ff; left, 30, #ffe0a0; right down, 3, #402010)",
    "environment_map": Tree(leaf("environment_map", pixels=_ramp(3, 8, 16), rotation=(0.2, 0.7, -0.1))),
    "image": Tree(leaf("image", pixels=_ramp(3, 9, 7))),
    "threshold": "mix(albedo(gold), albedo(navy), threshold(left up front, 0.4, softness=0.3))",
    "stripe": "mix(albedo(gold), albedo(navy), stripe((0.2, 1, 0.3), 0.1, 0.5, softness=0.1))",
    "image_mask": Tree(
        mix(leaf("albedo", color=(1, 0.8, 0)), leaf("albedo", color=(0, 0, 0.5)), leaf("image_mask", pixels=_ramp(1, 4, 4)))
    ),
    "realistic": "screen(multiply(mix(albedo(#d04020), albedo(#f0e0c0), stripe(up right, 0.3, 0.3)), diffuse(left up front, 0.25)),"
    " highlight((-0.3, 0.4, 0.87), 60, 1.2), multiply(albedo(#80a0ff), rim(right down, 2)))",
    "toon": "screen(multiply(albedo(#3070c0), toon_diffuse(left up front, 0.5, 0.1), toon_diffuse(up, 0.6, -0.2)),"
    " toon_highlight((-0.3, 0.4, 0.87), 0.2, 0.6))",
    "linear": "screen(multiply(albedo(#c08040), diffuse(right up front)), multiply(albedo(teal), highlight(left front, 12))) @linear",
}


def _golden_tree(name: str) -> Tree:
    written = GOLDEN_TREES[name]
    return written if isinstance(written, Tree) else parse(written)


@pytest.mark.parametrize("name", GOLDEN_TREES)
def test_golden(name: str) -> None:
    picture = render(_golden_tree(name), sphere_normals(64, dtype=torch.float64)) * disc_mask(64)
    found = (picture * 255).round().permute(1, 2, 0).to(torch.uint8).numpy()
    path, failed = GOLDEN / f"{name}.png", GOLDEN / "failed" / f"{name}.png"
    if os.environ.get("UNSHADE_REFRESH_GOLDEN"):
        PILImage.fromarray(found).save(path, optimize=True)
    with PILImage.open(path) as stored:
        expected = np.asarray(stored)
    difference = np.abs(found.astype(int) - expected.astype(int))
    if difference.max() > 1:
        failed.parent.mkdir(exist_ok=True)
        beside = np.concatenate([expected, found, (8 * difference).clip(0, 255).astype(np.uint8)], axis=1)
        PILImage.fromarray(beside).save(failed)
    else:
        failed.unlink(missing_ok=True)
    assert difference.max() <= 1, f"{name}: off by up to {difference.max()} in {int((difference > 1).any(-1).sum())} pixels; see {failed}"


def test_every_kind_has_a_golden_picture() -> None:
    assert set(BUILT_IN) <= set(GOLDEN_TREES) <= {path.stem for path in GOLDEN.glob("*.png")}


def test_a_wrong_picture_fails_and_its_difference_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("UNSHADE_REFRESH_GOLDEN", raising=False)
    monkeypatch.setattr(f"{__name__}.GOLDEN", tmp_path)
    PILImage.fromarray(np.zeros((64, 64, 3), np.uint8)).save(tmp_path / "albedo.png")
    with pytest.raises(AssertionError, match="albedo: off by up to"):
        test_golden("albedo")
    with PILImage.open(tmp_path / "failed" / "albedo.png") as kept:
        assert kept.size == (192, 64)


def test_golden_trees_are_lossless() -> None:
    for name in GOLDEN_TREES:
        tree = _golden_tree(name)
        assert parse(to_text(tree)) == loads(dumps(tree)) == tree
        assert json.loads(dumps(tree))["version"] == 1


def test_tints_and_operators_agree_in_every_order() -> None:
    a, b, c = leaf("albedo", color=(0.2, 0.5, 0.8)), leaf("diffuse"), leaf("rim")
    for operator in (multiply, screen):
        assert torch.allclose(render(operator(a, b, c), NORMALS), render(operator(c, operator(a, b)), NORMALS), atol=1e-12)
