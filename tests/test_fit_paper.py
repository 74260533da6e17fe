"""The paper's fitters and its search by depth: they find what is there, keep what is locked, and repeat bit for bit."""

from __future__ import annotations

import itertools
from functools import partial

import pytest
import torch

from unshade import search_depth
from unshade.errors import AddressError
from unshade.fit.basin_cma import fit_basin_cma
from unshade.fit.coordinates import Coordinates
from unshade.fit.gradient import descend, fit_gradient
from unshade.fit.objective import Objective, shrink
from unshade.grammar import same_structure
from unshade.nodes import KINDS, Role, count_values, find, leaf, mix, multiply, screen
from unshade.render import render
from unshade.sphere import disc_mask, sphere_normals

SIZE = 48
MASK = disc_mask(SIZE, 0.97)
TRUE = screen(
    multiply(leaf("albedo", color=(0.8, 0.3, 0.2)), leaf("diffuse", direction=(0.5, 0.5, 0.7), ambient=0.3)),
    leaf("highlight", direction=(0.4, 0.5, 0.75), sharpness=40, amplitude=1.2),
)
BLANK = screen(multiply(leaf("albedo"), leaf("diffuse")), leaf("highlight"))


def picture(root, size=SIZE):
    return render(root, sphere_normals(size))


@pytest.fixture(scope="module")
def everything():
    """Every kind of leaf without a raster, under every operator."""
    leaves = [leaf(kind.name) for kind in KINDS.values() if all(p.type != "raster" for p in kind.parameters) and kind.role is not Role.MASK]
    tinted = multiply(leaf("albedo"), leaf("highlight", amplitude=1.0))
    return screen(mix(leaves[0], multiply(*leaves), leaf("threshold", softness=0.3)), tinted, mix(leaves[1], leaves[2], leaf("stripe")))


def test_coordinates_go_there_and_back(everything):
    coordinates = Coordinates.of(everything)
    numbers = coordinates.layout.pack(everything)
    points = coordinates.encode(numbers)
    inside = points[~coordinates.directions]
    assert inside.min() >= 0.0 and inside.max() <= 1.0
    torch.testing.assert_close(coordinates.decode(points), numbers, rtol=1e-12, atol=1e-12)
    assert coordinates.size == coordinates.layout.size - 1, "the tinted highlight's amplitude is not free"


def test_random_starts_are_in_range_and_differ(everything):
    coordinates = Coordinates.of(everything)
    starts = coordinates.random(torch.Generator().manual_seed(3), 16)
    assert starts.shape == (16, coordinates.size)
    torch.testing.assert_close(coordinates.constrain(starts), starts)
    assert (starts.std(0) > 1e-3).all()
    for start in starts[:4]:
        coordinates.tree(start)


@pytest.mark.parametrize(
    "fitter",
    [partial(fit_gradient, steps=5, restarts=2), partial(fit_basin_cma, objective="l2", meta_steps=1, gradient_steps=2, final_steps=3)],
)
def test_locked_numbers_keep_every_bit_and_others_move(fitter):
    locked = {"screen.0.multiply.0.albedo", "highlight", "screen.0.multiply.1.diffuse.ambient"}
    fitted = fitter(picture(TRUE), MASK, BLANK, seed=0, locked=locked).root
    assert find(fitted, "albedo") == find(BLANK, "albedo")
    assert find(fitted, "highlight") == find(BLANK, "highlight")
    assert find(fitted, "diffuse")["ambient"] == find(BLANK, "diffuse")["ambient"]
    assert find(fitted, "diffuse")["direction"] != find(BLANK, "diffuse")["direction"]


def test_a_tree_that_is_all_locked_comes_back():
    fitted = fit_gradient(picture(TRUE), MASK, BLANK, seed=0, locked={"screen"})
    assert fitted.root == BLANK and fitted.error > 0.1
    assert fit_basin_cma(picture(TRUE), MASK, BLANK, seed=0, locked={"screen"}, objective="l2") == fitted


@pytest.mark.parametrize("where", ["screen.7", "screen.0.multiply.1.diffuse.colour", "nothing"])
def test_a_locked_address_that_fits_nothing_is_an_error(where):
    with pytest.raises(AddressError):
        fit_gradient(picture(TRUE), MASK, BLANK, seed=0, locked={where}, steps=1)


def test_gradient_finds_the_true_numbers():
    fitted = fit_gradient(picture(TRUE), MASK, BLANK, seed=0, steps=250, restarts=4)
    assert fitted.error < 0.003
    assert find(fitted.root, "albedo")["color"] == pytest.approx((0.8, 0.3, 0.2), abs=0.01)
    assert list(fitted.history) == sorted(fitted.history, reverse=True)


def test_rows_of_a_batch_do_not_influence_one_another():
    objective, coordinates = Objective(picture(TRUE), MASK), Coordinates.of(BLANK)
    starts = coordinates.random(torch.Generator().manual_seed(0), 3).float()
    together, errors, _ = descend(objective, coordinates, starts, 10)
    for row in range(3):
        alone, error, _ = descend(objective, coordinates, starts[row : row + 1], 10)
        torch.testing.assert_close(alone[0], together[row], rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(error[0], errors[row], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    "fitter", [partial(fit_gradient, steps=8), partial(fit_basin_cma, objective="l2", meta_steps=2, gradient_steps=3, final_steps=3)]
)
def test_the_same_seed_repeats_bit_for_bit(fitter):
    first = fitter(picture(TRUE), MASK, BLANK, seed=5)
    torch.manual_seed(99)
    assert fitter(picture(TRUE), MASK, BLANK, seed=5) == first


def test_basin_cma_leaves_the_basin_that_one_descent_stays_in():
    """A sharp spot that is not seen from where it starts: its gradient says nothing of where it should be."""
    seen = multiply(leaf("albedo", color=(0.9, 0.6, 0.3)), leaf("highlight", direction=(0.7, 0.4, 0.6), sharpness=150, amplitude=1.0))
    start = multiply(leaf("albedo", color=(0.5, 0.5, 0.5)), leaf("highlight", direction=(-0.8, -0.5, 0.3), sharpness=60, amplitude=1.0))
    stuck = fit_gradient(picture(seen), MASK, start, seed=0, steps=160, restarts=1)
    found = fit_basin_cma(picture(seen), MASK, start, seed=0, objective="l2", meta_steps=8, gradient_steps=12, final_steps=160)
    assert found.error < 0.5 * stuck.error
    assert list(found.history) == sorted(found.history, reverse=True)


@pytest.mark.parametrize("arguments", [{"meta_steps": -1}, {"population": 1}, {"finalists": 0}])
def test_basin_cma_refuses_impossible_steps(arguments):
    with pytest.raises(ValueError, match="fit_basin_cma"):
        fit_basin_cma(picture(TRUE), MASK, BLANK, seed=0, objective="l2", **arguments)


def features(images):
    """Two layers that stand for a network."""
    return [torch.nn.functional.avg_pool2d(images, 2), images.diff(dim=-1)]


def test_the_objective_is_nothing_for_the_picture_itself_and_grows_with_the_distance():
    target = picture(TRUE)
    for objective in (Objective(target, MASK), Objective(target, MASK, "paper", features=features)):
        near = render(BLANK, objective.normals)[None]
        same = render(TRUE, objective.normals)[None]
        losses = objective(torch.cat([same, 0.5 * (same + near), near]))
        assert losses[0] < 1e-4
        assert losses[0] < losses[1] < losses[2]


def test_the_features_add_to_the_pixels():
    target = picture(TRUE)
    pixels, paper = Objective(target, MASK), Objective(target, MASK, "paper", features=features)
    plain = pixels(render(BLANK, pixels.normals)[None])
    assert plain < paper(render(BLANK, paper.normals)[None]) < plain + 0.5


def test_the_objective_does_not_depend_on_the_resolution_nor_on_what_is_masked():
    errors = []
    for size in (64, 128):
        target, mask = picture(TRUE, size), disc_mask(size, 0.97)
        target = target.masked_fill(~mask, 0.7)
        objective = Objective(target, mask)
        errors.append(float(objective(render(BLANK, objective.normals)[None])))
    assert errors[0] == pytest.approx(errors[1], rel=0.03)
    hole = disc_mask(SIZE, 0.97) & (sphere_normals(SIZE)[:1] < 0)
    objective = Objective(torch.where(hole, picture(TRUE), torch.ones(3, SIZE, SIZE)), hole)
    assert objective(render(TRUE, objective.normals)[None]) < 1e-5


def test_shrinking_averages_only_what_counts():
    image = torch.zeros(3, 4, 4)
    image[:, 0, 0] = 1.0
    mask = torch.ones(1, 4, 4, dtype=torch.bool)
    mask[:, 0, 1] = False
    mask[:, 2:, 2:] = False
    small, counted = shrink(image, mask, 2)
    assert small[0, 0, 0] == pytest.approx(1 / 3)
    assert counted[0].tolist() == [[True, True], [True, False]]


@pytest.mark.parametrize("arguments", [{"name": "l1"}, {"mask": torch.zeros(1, SIZE, SIZE)}, {"mask": torch.ones(1, 9, 9)}])
def test_an_objective_that_cannot_be_is_refused(arguments):
    with pytest.raises(ValueError, match="objective"):
        Objective(**{"target": picture(TRUE), "mask": MASK} | arguments)


def levels(depth):
    made = search_depth.Levels()
    return [made.next() for _ in range(depth)]


def test_structures_come_in_order_of_depth_and_once():
    first, second, third = levels(3)
    assert first == sorted([(kind,) for kind in search_depth.LEAVES], key=lambda s: (search_depth.size(s), str(s)))
    assert ("multiply", ("albedo",), ("diffuse",)) in second
    assert ("screen", ("highlight",), ("multiply", ("albedo",), ("diffuse",))) in third
    found = [*first, *second, *third]
    assert len(set(found)) == len(found)
    assert all(search_depth.canonical(structure) == structure for structure in found)


def test_no_two_small_structures_are_the_same_to_the_grammar():
    first, second = levels(2)
    trees = []
    for index, structure in enumerate([*first, *second]):
        coordinates = Coordinates.of(search_depth.as_tree(structure))
        trees.append(coordinates.tree(coordinates.random(torch.Generator().manual_seed(index), 1)[0]))
    for a, b in itertools.combinations(trees, 2):
        assert not same_structure(a, b), f"{a} and {b}"


def test_sizes_are_the_counted_values():
    for structure in itertools.chain(*levels(2), levels(3)[2][:200]):
        assert search_depth.size(structure) == count_values(search_depth.as_tree(structure))


def test_a_common_factor_stands_outside_a_mix():
    body, other = ("multiply", ("albedo",), ("diffuse",)), ("multiply", ("diffuse",), ("rim",))
    assert not search_depth.distinct(search_depth.canonical(("mix", body, other)))
    assert search_depth.distinct(("mix", body, ("multiply", ("albedo",), ("rim",))))


quick = partial(fit_gradient, size=24, steps=80, restarts=3)


def test_search_stops_at_the_first_depth_that_fits():
    target = picture(TRUE.children[0])
    steps = list(
        search_depth.search(
            target, MASK, quick, 0.01, 4, rank=partial(quick, steps=25), whole_tree=partial(fit_gradient, restarts=1, steps=60)
        )
    )
    assert [step.stage for step in steps][-1] == "whole tree"
    assert {step.stage for step in steps} <= {"depth 1", "depth 2", "whole tree"}
    assert [step.error for step in steps] == sorted((step.error for step in steps), reverse=True)
    assert all(0 < step.done <= step.total for step in steps)
    assert same_structure(steps[-1].root, TRUE.children[0])


def test_search_stays_under_a_size_and_a_budget():
    calls = []

    def fitter(target, mask, root, *, seed):
        calls.append(root)
        return quick(target, mask, root, seed=seed, steps=2, restarts=1)

    list(
        search_depth.search(picture(TRUE), MASK, fitter, 0.0, 3, budget=search_depth.Budget(ranked=30, fitted=4, extended=2), max_values=9)
    )
    assert len(calls) == 12
    assert max(count_values(root) for root in calls) <= 9


def test_too_many_structures_are_refused_before_they_are_made():
    made = search_depth.Levels()
    for _ in range(3):
        made.next()
    with pytest.raises(ValueError, match="extended"):
        made.next()
