"""The rules, the canonical form and the sampler."""

from __future__ import annotations

import math
import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from strategies import MASKS, leaves, nodes
from unshade.canonical import complement, constant
from unshade.errors import TreeError
from unshade.grammar import (
    PAPER,
    RELEASED,
    all_canonical_structures,
    canonical,
    problems,
    same_structure,
    sample,
    structure_key,
    validate,
)
from unshade.nodes import KINDS, Leaf, Node, Operator, Raster, Role, Tree, count_values, leaf, mix, multiply, replace, screen, walk
from unshade.render import render
from unshade.sampler import STYLES, VISIBLE, cut_radius, every_leaf_shows
from unshade.sphere import SCORED_RADIUS, disc_mask, sphere_normals
from unshade.text import parse

NORMALS = sphere_normals(16, dtype=torch.float64)
# The canonical form holds on any normals, also those that face away from the viewer.
EVERYWHERE = torch.cat([NORMALS, -NORMALS], dim=-1)


def root(text: str) -> Node:
    return parse(text).root


def difference(a: Node, b: Node) -> float:
    return float((render(a, EVERYWHERE) - render(b, EVERYWHERE)).abs().max())


# The canonical form


@given(nodes())
@settings(max_examples=80)
def test_canonical_renders_the_same(node: Node) -> None:
    assert difference(node, canonical(node)) <= 1e-5


@given(nodes(named=False))
@settings(max_examples=40)
def test_canonical_is_its_own_canonical_form(node: Node) -> None:
    once = canonical(node)
    twice = canonical(once)
    assert structure_key(twice) == structure_key(once)
    assert difference(once, twice) <= 1e-9


@given(nodes(), st.randoms(use_true_random=False))
@settings(max_examples=40)
def test_order_names_and_nesting_do_not_matter(node: Node, random: object) -> None:
    shuffled = _shuffled(node, random)
    assert difference(node, shuffled) <= 1e-5
    assert same_structure(node, shuffled)


def _shuffled(node: Node, random: object) -> Node:
    """The same picture written another way: children in another order and nested, mixes turned, a name."""
    if isinstance(node, Leaf):
        return Leaf(node.kind, node.values, "renamed")
    children = [_shuffled(child, random) for child in node.children]
    if node.mask is not None:
        turned = complement(node.mask)
        return mix(children[0], children[1], node.mask) if turned is None else mix(children[1], children[0], turned)
    random.shuffle(children)  # type: ignore[attr-defined]
    if len(children) > 2:
        children = [Operator(node.kind, tuple(children[:2])), *children[2:]]
    return Operator(node.kind, tuple(children))


@given(leaves(("threshold", "image_mask"), named=False))
def test_the_complement_of_a_mask_is_one_minus_it(mask: Leaf) -> None:
    turned = complement(mask)
    assert turned is not None
    white, black = leaf("albedo", color=(1, 1, 1)), leaf("albedo", color=(0, 0, 0))
    assert difference(mix(white, black, mask), mix(black, white, turned)) <= 1e-9


@given(leaves((*KINDS,)))
@settings(max_examples=80)
def test_a_leaf_that_is_called_constant_is(node: Leaf) -> None:
    color = constant(node)
    if color is not None:
        white, black = leaf("albedo", color=(1, 1, 1)), leaf("albedo", color=(0, 0, 0))
        shown = mix(white, black, node) if node.kind in MASKS else node
        assert (render(shown, EVERYWHERE) - torch.tensor(color, dtype=torch.float64).view(3, 1, 1)).abs().max() <= 1e-9


@pytest.mark.parametrize(
    ("written", "color"),
    [
        ("threshold(up, -1.1, 0.2)", (1.0, 1.0, 1.0)),
        ("threshold(up, -1.09, 0.2)", None),
        ("threshold(up, 1.1, 0.2)", (0.0, 0.0, 0.0)),
        ("threshold(up, 1.09, 0.2)", None),
        ("toon_diffuse(up, 0.3, -1.1, 0.1)", (1.0, 1.0, 1.0)),
        ("toon_diffuse(up, 0.3, -1.09, 0.1)", None),
        ("toon_diffuse(up, 0.3, 1, 0.1)", (0.3, 0.3, 0.3)),
        ("toon_diffuse(up, 0.3, 0.99, 0.1)", None),
        ("toon_highlight(radius=0)", (0.0, 0.0, 0.0)),
        ("toon_highlight(radius=0, softness=0.1)", None),
    ],
)
def test_where_an_edge_leaves_the_sphere_a_leaf_is_constant(written: str, color: tuple[float, ...] | None) -> None:
    if written.startswith("threshold"):
        written = f"mix(albedo(white), albedo(black), {written})"
    node = root(written)
    found = node.mask if isinstance(node, Operator) else node
    assert found is not None and constant(found) == color


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("screen(highlight(), screen(rim(), highlight()))", "screen(highlight,highlight,rim)"),
        ("multiply(diffuse(), multiply(albedo(red), diffuse()))", "multiply(albedo,diffuse,diffuse)"),
        ("multiply(albedo(red), albedo(grey))", "albedo"),
        ("screen(albedo(red), albedo(grey), rim())", "screen(albedo,rim)"),
        ("multiply(albedo(white), diffuse())", "diffuse"),
        ("screen(albedo(black), diffuse())", "diffuse"),
        ("multiply(albedo(black), diffuse())", "albedo"),
        ("screen(albedo(white), diffuse())", "albedo"),
        ("multiply(albedo(grey), highlight())", "highlight"),
        ("multiply(albedo(grey), highlight(amplitude=1.2))", "multiply(albedo,highlight)"),
        ("multiply(albedo(red), highlight(amplitude=0.3))", "multiply(albedo,highlight)"),
        ("multiply(albedo(grey), diffuse())", "multiply(albedo,diffuse)"),
        ("multiply(albedo(grey), diffuse(), toon_highlight(brightness=0.3))", "multiply(diffuse,toon_highlight)"),
        ("screen(diffuse(), highlight(amplitude=0))", "diffuse"),
        ("screen(rim(), multiply(albedo(red), diffuse(ambient=1)))", "screen(albedo,rim)"),
        ("multiply(albedo(red), environment(up, 20, grey; left, 20, grey))", "multiply(albedo,environment[2 lobes])"),
        ("multiply(albedo(red), environment(up, 20, grey; left, 20, #101010))", "environment[2 lobes]"),
        ("multiply(diffuse(), mix(albedo(red), albedo(blue), stripe()))", "mix(multiply(albedo,diffuse),multiply(albedo,diffuse),stripe)"),
        ("mix(highlight(), albedo(red), threshold())", "mix(albedo,highlight,threshold)"),
        ("mix(highlight(), albedo(red), stripe())", "mix(highlight,albedo,stripe)"),
        ("mix(albedo(red), albedo(red), stripe())", "albedo"),
        ("mix(albedo(red), diffuse(), threshold(up, 1.1))", "diffuse"),
        ("mix(albedo(red), diffuse(), threshold(up, -1.1))", "albedo"),
    ],
)
def test_structure(written: str, expected: str) -> None:
    assert structure_key(root(written)) == expected
    assert difference(root(written), canonical(root(written))) <= 1e-9


def test_an_amplitude_and_a_tint_are_one_number() -> None:
    one = root("multiply(albedo(#ff8000), highlight(up, 40, 0.5))")
    other = root("multiply(albedo((0.5, 0.25098039215686274, 0)), highlight(up, 40, 1))")
    assert canonical(one) == canonical(other)
    assert canonical(root("multiply(albedo((0.5, 0.5, 0.5)), highlight(up, 40, 0.5))")) == root("highlight(up, 40, 0.25)")


def test_canonical_never_makes_a_tree_of_one_paint_larger() -> None:
    generator = torch.Generator().manual_seed(5)
    for _ in range(10):
        tree = sample(generator, environment=None)
        if not any(node.kind == "mix" for _, node in walk(tree.root)):
            assert count_values(canonical(tree.root)) == tree.values


def test_distinct_masks_are_distributed_in_one_order() -> None:
    first, second = "mix(albedo(red), albedo(blue), threshold(up))", "mix(albedo(gold), diffuse(), stripe(left))"
    assert canonical(root(f"multiply({first}, {second}, rim())")) == canonical(root(f"multiply(rim(), {second}, {first})"))


def test_a_canonical_form_that_would_explode_is_refused() -> None:
    one = mix(leaf("albedo", color=(1, 0, 0)), leaf("diffuse"), leaf("stripe"))
    with pytest.raises(TreeError, match="canonical form has more than"):
        canonical(multiply(*[one] * 20))


def test_canonical_of_a_tree_too_deep_is_refused() -> None:
    deep: Node = leaf("diffuse")
    for _ in range(5000):
        deep = screen(leaf("rim"), deep)
    with pytest.raises(TreeError, match="nested too deep"):
        canonical(deep)


def test_lobes_and_raster_sizes_belong_to_the_structure() -> None:
    assert not same_structure(root("environment(up)"), root("environment(up; left)"))
    small, wide = (Raster(3, 1, width, bytes(range(6 * width))) for width in (2, 3))
    assert not same_structure(leaf("image", pixels=small), leaf("image", pixels=wide))


def test_a_picture_of_one_colour_is_an_albedo() -> None:
    plain = Raster.from_array(torch.tensor([0.2, 0.4, 0.6]).view(3, 1, 1).expand(3, 4, 5))
    assert structure_key(leaf("image", pixels=plain)) == "albedo"
    assert canonical(leaf("environment_map", pixels=plain)) == canonical(leaf("image", pixels=plain))
    white = leaf("image_mask", pixels=Raster(1, 2, 1, b"\xff" * 4))
    assert canonical(mix(leaf("diffuse"), leaf("rim"), white)) == leaf("diffuse")


def test_numbers_do_not_belong_to_the_structure() -> None:
    assert same_structure(parse("screen(albedo(red), highlight(up, 40))"), root("screen(highlight(left, 9), albedo(#123456))"))


# Validation


def test_a_good_tree_has_no_problems() -> None:
    tree = parse('screen(multiply(albedo(red, name="paint"), diffuse(name="key")), highlight())')
    assert problems(tree) == []
    validate(tree)


@pytest.mark.parametrize(
    ("text", "address", "message"),
    [
        ('screen(albedo(name="a"), rim(name="a"))', "screen.1.rim", "'a' is taken by screen.0.albedo"),
        ('screen(albedo(), rim(name=" "))', "screen.1.rim", "visible letter"),
        ('screen(albedo(name="screen.1.rim"), rim())', "screen.0.albedo", "address of another node"),
        ('mix(albedo(name="a"), rim(), stripe(name="a"))', "mix.mask", "'a' is taken"),
    ],
)
def test_problems_come_with_an_address(text: str, address: str, message: str) -> None:
    with pytest.raises(TreeError, match=message) as caught:
        validate(parse(text))
    assert caught.value.address == address


def test_a_tree_too_large_or_too_deep_is_not_valid() -> None:
    deep: Node = leaf("albedo")
    for _ in range(20_000):
        deep = screen(leaf("albedo"), deep)
    with pytest.raises(TreeError, match="nested too deep"):
        validate(deep)
    with pytest.raises(TreeError, match="nodes at most"):
        validate(screen(*[leaf("albedo")] * 30_000))


def test_the_paper_s_grammar_names_known_kinds() -> None:
    symbols = set(PAPER)
    for product in [product for products in PAPER.values() for product in products]:
        parts = (product,) if isinstance(product, str) else product
        assert all(part in symbols or part in KINDS or part in ("multiply", "screen", "mix") for part in parts)


# The sampler


def test_the_released_grammar_has_24_trees_and_96_with_rim_and_environment() -> None:
    assert len(set(all_canonical_structures())) == len(all_canonical_structures()) == 24
    assert len(set(all_canonical_structures(environment=None, rim=None))) == 96
    for style in STYLES:
        assert len(all_canonical_structures(style)) == 12
        assert len(all_canonical_structures(style, rim=True)) == 12
    assert all(symbol in RELEASED for symbol in ("S", "N", "M", "L", "D", "B", "B1", "H", "H1"))


@pytest.mark.parametrize("style", STYLES)
def test_samples_follow_the_grammar_and_its_ranges(style: str) -> None:
    generator = torch.Generator().manual_seed(1)
    known = set(all_canonical_structures(style, environment=None, rim=None))
    seen = set()
    for _ in range(60):
        tree = sample(generator, style, environment=None, lobes=1)
        validate(tree)
        seen.add(structure_key(tree))
        for _, node in tree.walk():
            if isinstance(node, Leaf):
                _check_ranges(node)
    assert seen <= known and len(seen) > 25


def _check_ranges(node: Leaf) -> None:
    ranges = {
        "diffuse": {"ambient": (0.2, 0.5)},
        "highlight": {"sharpness": (30, 100), "amplitude": (1, 1.5)},
        "toon_diffuse": {"ambient": (0.2, 0.7), "threshold": (-0.2, 0.2), "softness": (0.1, 0.1)},
        "toon_highlight": {"brightness": (0.2, 0.7), "radius": (0, 0.27), "softness": (0, 0)},
        "rim": {"exponent": (1, 1)},
        "threshold": {"softness": (0, 0)},
        "stripe": {"softness": (0, 0)},
    }
    for name, (low, high) in ranges.get(node.kind, {}).items():
        assert low <= node[name][0] <= high, (node.kind, name)  # type: ignore[operator, index]
    if node.role not in (Role.PAINT, Role.ENVIRONMENT):
        assert node["direction"][2] >= 0, "lights are on the side that the viewer sees"  # type: ignore[index, operator]


def test_a_toon_highlight_is_a_highlight_cut_at_a_threshold() -> None:
    radius = cut_radius(0.7, 40.0, 0.3)
    assert 0.7 * math.exp(-40.0 * (2 - 2 * math.cos(radius))) == pytest.approx(0.3)
    assert cut_radius(0.5, 40.0, 0.5) == cut_radius(0.4, 40.0, 0.5) == 0.0


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("environment", [False, True])
def test_taking_any_leaf_away_changes_the_picture(style: str, environment: bool) -> None:
    """By rendering the whole tree without the leaf, at another size than the sampler looks at."""
    generator = torch.Generator().manual_seed(2)
    size = 128
    inside = disc_mask(size, SCORED_RADIUS)[0]
    normals = sphere_normals(size, dtype=torch.float64)
    for _ in range(6):
        tree = sample(generator, style, environment)
        whole = render(tree, normals)[:, inside]
        for address, node in tree.walk():
            if isinstance(node, Leaf) and node.role is not Role.MASK:
                without = _without(tree.root, address)
                change = (render(without, normals)[:, inside] - whole).square().mean().sqrt()
                assert change >= 0.85 * VISIBLE, address


def _without(node: Node, address: str) -> Node:
    """A leaf taken away: white under a multiply, black under a screen, the other side under a mix."""
    parent = address.rpartition(".")[0].rpartition(".")[0]
    kind = parent.rpartition(".")[2]
    if kind == "mix":
        return replace(node, address, None)
    return replace(node, address, leaf("albedo", color=(1, 1, 1) if kind == "multiply" else (0, 0, 0)))


@pytest.mark.parametrize(
    ("text", "shows"),
    [
        ("screen(multiply(albedo(red), diffuse(left)), highlight(up front))", True),
        ("screen(multiply(albedo(red), diffuse(left)), highlight(back))", False),
        ("screen(multiply(albedo(white), diffuse(left)), highlight(up front))", False),
        ("screen(mix(albedo(red), albedo(#fe0000), stripe(up)), highlight(up front))", False),
        ("screen(mix(albedo(red), albedo(blue), threshold(back, 0.1)), highlight(up front))", False),
        ("multiply(albedo(#030303), screen(diffuse(left), highlight(up front)))", False),
        ("multiply(albedo(#f0f0a0), screen(diffuse(left), highlight(up front)))", True),
        ("screen(albedo(#202020), environment(up, 5, grey; left, 5, grey))", True),
        ("screen(albedo(#202020), environment(up, 5, grey; left, 5, black))", False),
    ],
)
def test_a_leaf_shows_or_not(text: str, shows: bool) -> None:
    assert every_leaf_shows(root(text)) is shows


def test_the_same_seed_gives_the_same_tree() -> None:
    first, again, other = (sample(torch.Generator().manual_seed(seed), "toon") for seed in (3, 3, 4))
    assert first == again != other


def test_a_given_environment_is_used() -> None:
    generator = torch.Generator().manual_seed(0)
    panorama = Raster.from_array(torch.rand(3, 4, 8, generator=generator))
    tree = sample(generator, environment=panorama)
    (found,) = [node for _, node in tree.walk() if node.kind == "environment_map"]
    assert isinstance(found, Leaf) and found["pixels"] == panorama


def test_a_black_environment_never_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unshade.sampler.ATTEMPTS", 20)
    with pytest.raises(TreeError, match="is the environment black"):
        sample(torch.Generator(), environment=Raster(3, 1, 1, bytes(6)))


def test_an_unknown_style_is_refused() -> None:
    with pytest.raises(TreeError, match="did you mean 'realistic'"):
        sample(torch.Generator(), "realist")


def test_a_sample_takes_under_50_ms() -> None:
    """Processor time, so that a busy machine does not matter."""
    generator = torch.Generator().manual_seed(0)
    sample(generator, environment=None)
    start = time.process_time()
    for style in STYLES:
        for _ in range(10):
            sample(generator, style, environment=None)
    assert (time.process_time() - start) / 20 < 0.05


def test_rims_and_environments_are_as_asked() -> None:
    generator = torch.Generator().manual_seed(0)
    for rim in (True, False):
        for environment in (True, False):
            tree = sample(generator, environment=environment, rim=rim, lobes=2)
            kinds = [node.kind for _, node in tree.walk()]
            assert ("rim" in kinds, "environment" in kinds) == (rim, environment)
            assert isinstance(tree, Tree)
