"""Second-order fitting: exact derivatives for every kind, parameters found again, hard edges placed, pixels weighted rightly."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import torch

from unshade.decompose import fit
from unshade.errors import AddressError
from unshade.fit.least_squares import error_of, fit_least_squares, fit_pixels, place_edges, sharpen
from unshade.fit.model import Model, soften
from unshade.fit.pixels import Pixels
from unshade.fit.plan import Plan, is_hard
from unshade.grammar import same_structure
from unshade.metrics import psnr
from unshade.nodes import KINDS, Kind, Leaf, Node, Parameter, Raster, Role, Tree, find, leaf, mix, multiply, register, replace, screen, walk
from unshade.pictures import SphereImage
from unshade.render import render
from unshade.shading import facing
from unshade.sphere import disc_mask, sphere_normals
from unshade.sphere_finder import Disc

SIZE = 96


def picture(root: Node | Tree, size: int = SIZE, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return render(root, sphere_normals(size, dtype=dtype))


def sphere(image: torch.Tensor) -> SphereImage:
    half = image.shape[-1] / 2
    return SphereImage(image, disc_mask(image.shape[-1]), Disc(half, half, half, 1.0))


def pixels_of(root: Node, size: int = SIZE, dtype: torch.dtype = torch.float32) -> Pixels:
    return Pixels.of(picture(root, size, dtype))


def same_direction(found: Node, true: Node) -> float:
    """Angle between two leaves' directions in degrees."""
    cosine = sum(a * b for a, b in zip(found["direction"], true["direction"], strict=True))
    return math.degrees(math.acos(max(min(cosine, 1.0), -1.0)))


GENERATOR = torch.Generator().manual_seed(7)
RASTER = Raster.from_array(torch.rand(3, 4, 6, generator=GENERATOR, dtype=torch.float64))
GREY = Raster.from_array(torch.rand(1, 4, 6, generator=GENERATOR, dtype=torch.float64))
LEAVES = {
    "albedo": leaf("albedo", color=(0.7, 0.3, 0.2)),
    "diffuse": leaf("diffuse", direction=(0.5, 0.4, 0.7), ambient=0.25),
    "highlight": leaf("highlight", direction=(0.3, 0.5, 0.8), sharpness=9.0, amplitude=0.8),
    "plateau": leaf("highlight", direction=(-0.3, 0.5, 0.8), sharpness=6.0, amplitude=1.6),
    "rim": leaf("rim", direction=(-0.6, 0.5, 0.3), exponent=1.7),
    "toon_diffuse": leaf("toon_diffuse", direction=(0.2, 0.8, 0.5), ambient=0.3, threshold=-0.1, softness=0.4),
    "toon_highlight": leaf("toon_highlight", direction=(0.1, 0.6, 0.8), radius=0.5, brightness=0.7, softness=0.3),
    "environment": leaf(
        "environment",
        direction=(0.2, 0.5, 0.8, -0.7, 0.2, 0.1, 0.6, -0.4, -0.5),
        sharpness=(3.0, 8.0, 1.0),
        color=(0.6, 0.5, 0.2, 0.1, 0.7, 0.4, 0.5, 0.1, 0.6),
    ),
    "environment_map": leaf("environment_map", pixels=RASTER, rotation=(0.3, 0.8, -0.2)),
    "image": leaf("image", pixels=RASTER),
}
MASKS = {
    "threshold": leaf("threshold", direction=(0.5, -0.3, 0.6), threshold=0.2, softness=0.5),
    "stripe": leaf("stripe", direction=(-0.2, 0.9, 0.3), center=0.1, width=0.6, softness=0.3),
    "image_mask": leaf("image_mask", pixels=GREY),
}
A, B = leaf("albedo", color=(0.9, 0.6, 0.3)), leaf("albedo", color=(0.1, 0.3, 0.5))
FORM = leaf("diffuse", direction=(-0.3, 0.6, 0.7), ambient=0.4)
FREE = {"albedo": 3, "diffuse": 3, "highlight": 4, "rim": 3, "toon_diffuse": 5, "toon_highlight": 5, "environment": 18}
FREE |= {"environment_map": 3, "image": 0, "threshold": 4, "stripe": 5, "image_mask": 0, "plateau": 4}


def check_jacobian(model: Model, least: float = 0.0) -> None:
    """Columns equal central differences along `Model.move`, which is what the fit steps along."""
    vector = model.layout.pack(model.root)
    values = model.evaluate(vector)
    found = model.jacobian(vector, values) * model.scale(vector)[:, None, None]
    assert found.shape == (model.free, 3, model.pixels.count)
    width = 1e-6
    for column in range(model.free):
        step = torch.zeros(model.free, dtype=torch.float64)
        step[column] = width
        after, before = (model.compose(model.evaluate(model.move(vector, sign * step))) for sign in (1.0, -1.0))
        expected = ((after - before) / (2.0 * width)).expand(3, -1)
        # a pixel that stands on the border of a clamp within the width of the difference is no test of either
        off = (found[column] - expected).abs() > 1e-5
        assert off.sum() <= 3, f"column {column} ({model.layout.names[int(model.number[column])]}) differs at {int(off.sum())} places"
        assert expected.abs().max() > least, f"column {column} moves nothing, so it tests nothing"


@pytest.mark.parametrize("name", [*LEAVES, *MASKS])
def test_the_jacobian_is_the_derivative(name: str) -> None:
    if name in MASKS:
        root = multiply(mix(A, B, MASKS[name]), FORM)
        rest = 9
    else:
        root = screen(multiply(A, FORM, LEAVES["diffuse"]), LEAVES[name])
        rest = 9
    model = Model(root, pixels_of(root, 24, torch.float64))
    assert model.free == rest + FREE[name]
    check_jacobian(model, least=1e-4)


def test_the_jacobian_of_everything_under_every_operator() -> None:
    tinted = multiply(leaf("albedo", color=(0.5, 0.2, 0.1)), leaf("highlight", direction=(0, 0.3, 1), sharpness=5.0, amplitude=1.0))
    root = mix(
        screen(multiply(mix(A, B, MASKS["stripe"]), FORM, LEAVES["diffuse"], LEAVES["toon_diffuse"]), tinted, LEAVES["rim"]),
        screen(LEAVES["environment"], multiply(LEAVES["image"], LEAVES["highlight"]), LEAVES["toon_highlight"]),
        MASKS["threshold"],
    )
    model = Model(root, pixels_of(root, 24, torch.float64))
    torch.testing.assert_close(
        model.compose(model.evaluate(model.layout.pack(root))), model.pixels.target, rtol=0, atol=1e-12, msg="compose is not the render"
    )
    amplitude = next(k for k, name in enumerate(model.layout.names) if name.endswith("1.highlight.amplitude") and "screen.1" in name)
    assert amplitude not in model.number.tolist(), "a tinted highlight's amplitude is carried by its albedo"
    check_jacobian(model)


@pytest.fixture
def wave() -> Iterator[Kind]:
    """A kind from outside the package, with one parameter on a logarithmic scale."""
    kind = Kind(
        "wave_for_tests",
        Role.DIFFUSE,
        lambda normals, direction, pitch: 0.5 + 0.4 * torch.sin(pitch[..., None, None] * facing(normals, direction)),
        (
            Parameter("direction", "direction", "across the waves", -1.0, 1.0, (0.0, 0.0, 1.0)),
            Parameter("pitch", "scalar", "waves a unit", 0.5, 50.0, (3.0,), logarithmic=True),
        ),
        "waves",
    )
    register(kind)
    yield kind
    del KINDS[kind.name]


def test_a_kind_from_outside_is_differentiated_and_fitted(wave: Kind) -> None:
    true = multiply(A, leaf(wave.name, direction=(0.3, 0.2, 0.9), pitch=4.0), leaf(wave.name, direction=(0.8, -0.2, 0.3), pitch=2.0))
    check_jacobian(Model(true, pixels_of(true, 24, torch.float64)), least=1e-3)
    start = true
    for where, turned in (("multiply.1", (0.35, 0.1, 0.9)), ("multiply.2", (0.7, -0.3, 0.4))):
        start = replace(start, where, find(start, where).set(direction=turned, pitch=2.9))
    fitted = fit_pixels(pixels_of(true), start, tolerance=1e-8)
    assert fitted.error < 1e-8
    assert find(fitted.root, "multiply.1")["pitch"][0] == pytest.approx(4.0, rel=1e-2)


def test_kinds_with_nothing_to_set_and_with_a_picture_a_lobe_are_fitted_too(monkeypatch: pytest.MonkeyPatch) -> None:
    glass = Kind("glass_for_tests", Role.ENVIRONMENT, lambda normals: 0.3 * normals[..., 2:3, :, :].clamp(min=0.0), (), "nothing to set")
    pixels = Parameter("pixels", "raster", "what is seen")
    strength = Parameter("strength", "scalar", "how bright", 0.0, 1.0, (0.5,))

    def shown(normals: torch.Tensor, strength: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        return (pixels.mean((-1, -2), keepdim=True) * strength.sum(-2)[..., None, None] * torch.ones_like(normals[..., 2:3, :, :])).clamp(
            max=1.0
        )

    slides = Kind("slides_for_tests", Role.ENVIRONMENT, shown, (strength, pixels), "strengths of a picture", channels=3, repeats=True)
    for kind in (glass, slides):
        monkeypatch.setitem(KINDS, kind.name, kind)
    window, seen = leaf("glass_for_tests"), leaf("slides_for_tests", pixels=RASTER, strength=(0.2, 0.3))
    for root in (multiply(A, FORM), multiply(leaf("albedo", color=(0.2, 0.6, 0.4)), FORM)):
        true = screen(root, window, window, seen)
        start = replace(true, "screen.0.multiply.0.albedo", leaf("albedo", color=(0.5, 0.5, 0.5)))
        assert fit_pixels(pixels_of(true), start).error < 1e-9
    assert fit_pixels(pixels_of(multiply(A, FORM)), window).root == window


def test_trees_that_differ_in_numbers_alone_share_a_plan() -> None:
    def plan(edge: float, color: float = 0.5, locked: tuple[str, ...] = (), limits: tuple[float, float] = (0.0, 1.0)) -> Plan:
        mask = leaf("threshold", direction=(0, 0.5, 1), threshold=0.1, softness=edge)
        return Plan.of(mix(leaf("albedo", color=(color, 0.1, 0.2)), B, mask), locked, {"color": limits})

    assert plan(0.1) is plan(0.2, color=0.7)
    assert plan(0.0).free == plan(0.1).free - 4, "a hard edge stays where it is"
    assert plan(0.1, locked=("mix.1",)).free == plan(0.1).free - 3
    assert plan(0.1, limits=(0.2, 0.8)).low.max() == 0.2


def test_locked_and_limited_numbers_stay() -> None:
    true = screen(multiply(A, LEAVES["diffuse"]), LEAVES["highlight"])
    pixels = pixels_of(true, 24, torch.float64)
    all_free = Model(true, pixels)
    held = Model(true, pixels, locked=("screen.0.multiply.0.albedo", "screen.1.highlight.sharpness"))
    names = [held.layout.names[number] for number in held.number.tolist()]
    assert held.free == all_free.free - 4
    assert not any(name.startswith("screen.0.multiply.0.albedo") or name.endswith("sharpness") for name in names)
    assert Model(true, pixels, locked=("screen.0.multiply",)).free == 4, "a locked subtree holds all leaves below it"
    check_jacobian(held)

    start = replace(true, "screen.1", LEAVES["highlight"].set(sharpness=14.0))
    limited = fit_pixels(pixels, start, limits={"sharpness": (12.0, 20.0)}).root
    assert find(limited, "screen.1")["sharpness"][0] == pytest.approx(12.0), "the true 9 is outside, so the fit ends at the border"
    assert find(fit_pixels(pixels, true, limits={"sharpness": (12.0, 20.0)}).root, "screen.1")["sharpness"][0] >= 12.0 - 1e-9


def test_parameters_are_found_again() -> None:
    true = screen(
        multiply(mix(A, B, MASKS["threshold"]), LEAVES["diffuse"]),
        LEAVES["highlight"],
        multiply(leaf("albedo", color=(0.2, 0.4, 0.6)), leaf("rim", direction=(-0.6, 0.5, 0.3), exponent=1.7)),
    )
    generator = torch.Generator().manual_seed(1)
    start = true
    for address, node in walk(true):
        if not isinstance(node, Leaf):
            continue
        moved = []
        for parameter, value in zip(KINDS[node.kind].parameters, node.values, strict=True):
            shift = (2.0 * torch.rand(len(value), generator=generator) - 1.0).tolist()
            reach = 0.25 if parameter.type == "direction" else 0.1
            near = [v * math.exp(0.5 * s) if parameter.logarithmic else v + reach * s for v, s in zip(value, shift, strict=True)]
            moved.append(near if parameter.type == "direction" else [min(max(v, parameter.low), parameter.high) for v in near])
        start = replace(start, address, Leaf(node.kind, tuple(moved)))
    pixels = pixels_of(true)
    assert error_of(pixels, start) > 1e-3, "the start is too near to show anything"
    fitted = fit_pixels(pixels, start, steps=60, tolerance=1e-9)
    assert fitted.error < 1e-8
    assert fitted.error == pytest.approx(error_of(pixels, fitted.root), rel=1e-2, abs=1e-11)
    assert list(fitted.history) == sorted(fitted.history, reverse=True)
    for address, node in walk(true):
        if node.kind in ("diffuse", "highlight", "rim", "threshold"):
            assert same_direction(find(fitted.root, address), node) < 0.5, address
    assert find(fitted.root, "screen.1")["sharpness"][0] == pytest.approx(9.0, rel=1e-2)
    torch.testing.assert_close(picture(fitted.root), picture(true), rtol=0, atol=2e-3)


EDGED = multiply(mix(A, B, leaf("threshold", direction=(0.4, 0.5, 0.75), threshold=0.2, softness=0.0)), FORM)


def test_a_hard_edge_stays_put_in_a_fit() -> None:
    pixels = pixels_of(EDGED)
    mask = find(EDGED, "multiply.0.mix.mask")
    toward = pixels.normals.double().T @ torch.tensor(mask["direction"], dtype=torch.float64)
    at = float(toward[(toward - 0.26).abs().argmin()]) - 5e-5
    start = replace(EDGED, "multiply.0.mix.mask", mask.set(threshold=at))  # a pixel in the middle of the step, where it has a slope
    start = replace(start, "multiply.0.mix.0", leaf("albedo", color=(0.5, 0.5, 0.5)))
    fitted = fit_pixels(pixels, start).root
    assert find(fitted, "multiply.0.mix.mask") == find(start, "multiply.0.mix.mask")
    torch.testing.assert_close(find(fitted, "multiply.0.mix.0")["color"], A["color"], rtol=0, atol=0.05)
    assert [address for address, node in walk(soften(start, 0.1)) if isinstance(node, Leaf) and is_hard(node)] == []


def test_sharpening_places_a_hard_edge() -> None:
    pixels = Pixels.important(picture(EDGED, 128), None, 4000, 0)
    start = replace(EDGED, "multiply.0.mix.mask", find(EDGED, "multiply.0.mix.mask").set(threshold=0.26, direction=(0.45, 0.45, 0.75)))
    stuck = fit_pixels(pixels, start)
    fitted = sharpen(pixels, start)
    mask = find(fitted.root, "multiply.0.mix.mask")
    assert mask["softness"] == (0.0,)
    assert mask["threshold"][0] == pytest.approx(0.2, abs=6e-3)
    assert same_direction(mask, find(EDGED, "multiply.0.mix.mask")) < 0.4
    assert fitted.error < 0.05 * stuck.error
    assert fitted.error < 5e-6, "placed to the pixel; the soft fit alone gets to 8e-6"
    assert psnr(picture(fitted.root, 128), picture(EDGED, 128)) > 40.0


def test_a_soft_edge_is_not_made_hard() -> None:
    true = replace(EDGED, "multiply.0.mix.mask", find(EDGED, "multiply.0.mix.mask").set(softness=0.3))
    fitted = sharpen(pixels_of(true), replace(true, "multiply.0.mix.mask", find(true, "multiply.0.mix.mask").set(softness=0.1)))
    assert find(fitted.root, "multiply.0.mix.mask")["softness"][0] == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize(
    "edged",
    [
        EDGED,
        multiply(mix(A, B, leaf("stripe", direction=(0.4, 0.5, 0.75), center=0.3, width=0.4, softness=0.0)), FORM),
        screen(multiply(B, FORM), leaf("toon_highlight", direction=(0.3, 0.4, 0.8), radius=0.4, brightness=0.8, softness=0.0)),
    ],
    ids=["threshold", "stripe", "toon_highlight"],
)
def test_placing_edges_finds_a_fraction_of_a_pixel(edged: Node) -> None:
    """A pixel of this picture is 0.016 wide; the edge starts 0.006 off."""
    where, node = next((a, n) for a, n in walk(edged) if n.kind in ("threshold", "stripe", "toon_highlight"))
    name = {"threshold": "threshold", "stripe": "center", "toon_highlight": "radius"}[node.kind]
    pixels = Pixels.of(picture(edged, 128))
    off = replace(edged, where, node.set(**{name: node[name][0] + 0.006}))
    before = error_of(pixels, off)
    placed = place_edges(pixels, off)
    assert before > 0.0
    assert error_of(pixels, placed) < 0.25 * before
    assert find(placed, where)["softness"] == (0.0,)
    assert placed == place_edges(pixels, off), "the search is seeded"


@pytest.mark.parametrize("sigma", [0.02, 0.06])
def test_noise_does_not_lead_astray(sigma: float) -> None:
    """10 numbers are told by thousands of pixels, so the fit is much nearer to the truth than the picture is."""
    true = screen(multiply(A, LEAVES["diffuse"]), LEAVES["highlight"])
    clean = picture(true)
    generator = torch.Generator().manual_seed(2)
    noisy = (clean + sigma * torch.randn(clean.shape, generator=generator)).clamp(0.0, 1.0)
    start = screen(multiply(leaf("albedo"), leaf("diffuse")), leaf("highlight", direction=(0.2, 0.4, 0.9), sharpness=5.0))
    fitted = fit_least_squares(noisy, disc_mask(SIZE), start)
    assert psnr(picture(fitted.root), clean) > psnr(noisy, clean) + 12.0


def test_texture_does_not_lead_astray() -> None:
    true = multiply(A, LEAVES["diffuse"])
    clean = picture(true)
    x = torch.arange(SIZE, dtype=torch.float32)
    checks = (((x[None] // 4 + x[:, None] // 4) % 2) * 2.0 - 1.0) * 0.06
    fitted = fit_least_squares((clean + checks).clamp(0.0, 1.0), disc_mask(SIZE), multiply(leaf("albedo"), leaf("diffuse")))
    assert psnr(picture(fitted.root), clean) > 38.0


def test_what_is_locked_is_kept_bit_for_bit() -> None:
    true = screen(multiply(A, LEAVES["diffuse"]), LEAVES["highlight"])
    start = Tree(
        screen(
            multiply(leaf("albedo", "paint", color=(0.1, 0.7, 1 / 3)), leaf("diffuse", direction=(0.1, 0.2, 0.9), ambient=0.7)),
            leaf("highlight", direction=(0.1, 0.2, 0.9), sharpness=17.123, amplitude=0.3),
        )
    )
    found = fit(sphere(picture(true)), start, locked=["paint", "screen.0.multiply.1.diffuse.ambient", "screen.1.sharpness"])
    for where, parameter in (("paint", "color"), ("diffuse", "ambient"), ("highlight", "sharpness")):
        assert found.tree.find(where)[parameter] == start.find(where)[parameter], where
    assert found.tree.find("diffuse")["direction"] != start.find("diffuse")["direction"]
    assert found.tree.find("highlight")["amplitude"] != start.find("highlight")["amplitude"]
    assert found.psnr > psnr(picture(start), picture(true))
    assert same_structure(found.tree, start)
    assert found.tree.find("paint").name == "paint"

    everything = fit(sphere(picture(true)), start, locked=["screen"])
    assert everything.tree.root == start.root


@pytest.mark.parametrize("softness", [0.0, 0.005])
def test_a_locked_edge_is_kept_bit_for_bit(softness: float) -> None:
    mask = leaf("threshold", "edge", direction=(0.4, 0.5, 0.7), threshold=0.31, softness=softness)
    other = leaf("stripe", "band", direction=(0.0, 1.0, 0.1), center=0.2, width=0.3)
    start = Tree(multiply(mix(mix(A, B, other), B, mask), leaf("diffuse")))
    found = fit(sphere(picture(EDGED)), start, locked=["edge", "band.softness"])
    assert found.tree.find("edge") == mask
    assert found.tree.find("band")["softness"] == (0.0,)
    assert found.tree.find("diffuse") != start.find("diffuse")


def test_a_fit_never_makes_a_tree_worse() -> None:
    true = Tree(EDGED)
    found = fit(sphere(picture(true)), true)
    assert found.psnr == math.inf
    assert found.tree.root == true.root


@pytest.mark.parametrize("space", ["srgb", "linear"])
def test_the_figure_of_a_fit_is_that_of_its_tree(space: str) -> None:
    true = Tree(screen(multiply(A, LEAVES["diffuse"]), LEAVES["highlight"]), space)  # type: ignore[arg-type]
    start = Tree(screen(multiply(leaf("albedo"), leaf("diffuse")), leaf("highlight", direction=(0.2, 0.4, 0.9), sharpness=5.0)), space)  # type: ignore[arg-type]
    found = fit(sphere(picture(true)), start)
    assert found.tree.blend_space == space
    assert found.psnr == pytest.approx(psnr(picture(found.tree), picture(true)), abs=1e-6)
    assert found.psnr > 45.0


def test_locking_what_is_not_there() -> None:
    tree = Tree(multiply(leaf("albedo"), leaf("diffuse")))
    with pytest.raises(AddressError, match="no node"):
        fit(sphere(picture(tree)), tree, locked=["highlight"])
    with pytest.raises(AddressError, match=r"diffuse has no parameter 'ambiant'; did you mean 'ambient'"):
        fit(sphere(picture(tree)), tree, locked=["multiply.1.diffuse.ambiant"])


# Pixels


@pytest.fixture
def half_ignored() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A picture, the same with the ignored left half painted white, and the mask of what counts."""
    image = 0.8 * picture(EDGED, 64)
    valid = torch.ones(1, 64, 64, dtype=torch.bool)
    valid[:, :, :32] = False
    return image, torch.where(valid, image, torch.ones(())), valid


@pytest.mark.parametrize("take", [lambda i, v: Pixels.of(i, v), lambda i, v: Pixels.of(i, v, 20), lambda i, v: Pixels.points(i, v, 300, 0)])
def test_ignored_pixels_do_not_count(half_ignored: tuple[torch.Tensor, ...], take) -> None:  # type: ignore[no-untyped-def]
    image, painted, valid = half_ignored
    pixels, same = take(image, valid), take(painted, valid)
    torch.testing.assert_close(pixels.target, same.target)
    torch.testing.assert_close(pixels.normals, same.normals)
    assert float(pixels.weight.sum()) == pytest.approx(1.0, abs=1e-5)
    assert pixels.normals[0].min() > 0.0, "the left half is ignored"
    torch.testing.assert_close(pixels.normals.norm(dim=0), torch.ones(pixels.count))


def test_ignored_pixels_are_not_important(half_ignored: tuple[torch.Tensor, ...]) -> None:
    _, painted, valid = half_ignored
    pixels = Pixels.important(painted, valid, 500, 0)
    assert pixels.target.max() <= 0.8
    assert pixels.normals[0].min() > 0.0
    assert float(pixels.weight.sum()) == pytest.approx(1.0, abs=1e-5)


def test_all_pixels_are_the_scored_disc() -> None:
    image = picture(EDGED, 64)
    pixels = Pixels.of(image)
    inside = disc_mask(64, 0.97)[0]
    assert pixels.count == int(inside.sum())
    torch.testing.assert_close(pixels.target, image[:, inside])
    assert pixels.weight.min() == pixels.weight.max()
    target = torch.zeros_like(image)
    flat = Pixels.of(target)
    root = leaf("albedo", color=(0.1, 0.1, 0.1))
    assert error_of(flat, root) == pytest.approx(0.01, rel=1e-5), "mean squared error, channels averaged"


def test_averages_keep_the_mean() -> None:
    image = picture(EDGED, 64)
    fine, coarse = Pixels.of(image), Pixels.of(image, None, 16)
    assert coarse.count < 16 * 16
    torch.testing.assert_close((coarse.target * coarse.weight).sum(1), (fine.target * fine.weight).sum(1), rtol=0, atol=4e-3)


def test_points_are_the_same_for_every_picture() -> None:
    one, two = (Pixels.points(image, None, 200, 5) for image in (picture(EDGED, 64), picture(A, 64)))
    assert one.count == 200
    assert torch.equal(one.normals, two.normals)
    assert not torch.equal(one.normals, Pixels.points(picture(EDGED, 64), None, 200, 6).normals)
    assert Pixels.points(picture(EDGED, 64), None, 10**6, 0).count == int(disc_mask(64, 0.97).sum())


def test_important_pixels_lie_on_edges_and_are_unbiased() -> None:
    image = picture(mix(A, B, leaf("threshold", direction=(0.4, 0.5, 0.75), threshold=0.2)), 96)
    full = Pixels.of(image)
    mean = (full.target * full.weight).sum(1)
    drawn = [Pixels.important(image, None, 600, seed) for seed in range(30)]
    assert all(abs(pixels.count - 600) < 80 for pixels in drawn)
    estimates = torch.stack([(pixels.target * pixels.weight).sum(1) for pixels in drawn])
    plain = torch.stack([pixels.target.mean(1) for pixels in drawn])
    error = (estimates.mean(0) - mean).abs().max()
    assert error < 3.0 * float(estimates.std(0).max()) / math.sqrt(30) + 1e-3
    facing_mask = torch.nn.functional.normalize(torch.tensor([0.4, 0.5, 0.75]), dim=0)
    near = [(pixels.normals * facing_mask[:, None]).sum(0).sub(0.2).abs() < 0.03 for pixels in drawn]
    share = float(torch.stack([edge.float().mean() for edge in near]).mean())
    all_near = ((full.normals * facing_mask[:, None]).sum(0) - 0.2).abs() < 0.03
    assert share > 4.0 * float(all_near.float().mean()), "most are drawn where the picture changes"
    assert (plain.mean(0) - mean).abs().max() > 3.0 * error, "without the weights the mean is another"
