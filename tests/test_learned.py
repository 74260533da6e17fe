"""The learned methods: the node pool and its criterion, leaves from decoded pictures, and decomposing with networks.

Networks of the size `tiny` know nothing, which is enough for the mechanics. An oracle, which draws the true children of a known
tree, stands in for trained priors where the rest is to be judged.
"""

from __future__ import annotations

import dataclasses
import json
import weakref
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from lit_spheres import PAINTED, SIMPLE, picture
from unshade import batch, crew, decoded, inference, learned, search_depth, second_stage, synthesis
from unshade.cli import run as run_command
from unshade.criterion import Terms
from unshade.decompose import Result, decompose, fit
from unshade.errors import MissingWeightsError, TreeError, UnshadeError
from unshade.grammar import same_structure
from unshade.inference import Inference, Networks, Part, Pool, Round, infer
from unshade.models import weights
from unshade.models.config import find
from unshade.models.vqvae import Codes
from unshade.node_image import node_image
from unshade.nodes import Leaf, Node, Operator, Tree, leaf, walk
from unshade.parameters import Layout
from unshade.pictures import write_picture
from unshade.proposals import arranged
from unshade.render import evaluate
from unshade.sphere import disc_mask, sphere_normals
from unshade.types import Image

SIZE = 32
SETTINGS = Inference(samples=3, stop=10.0, depth=2, hidden=0.0)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of untrained weights."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(3)
    for name, make in weights.MODELS.items():
        model = make(find("tiny"))
        if name == "vqvae":
            model.train()(torch.rand(8, 3, 16, 16))  # fills the codebooks
        weights.save(weights.file_of(name, folder), name, model, find("tiny"), {})
    return folder


@pytest.fixture(scope="module")
def networks(tiny: Path) -> Networks:
    return Networks.load(tiny)


def pools(networks: Networks, settings: Inference, seed: int = 0) -> list[Round]:
    return list(infer(node_image(picture(SIMPLE), disc_mask(96), 16), networks, settings, seed))


def test_a_pool_ends_with_every_node_decomposed_a_leaf_or_left_over(networks: Networks) -> None:
    rounds = pools(networks, SETTINGS)
    assert rounds[-1].done and 1 <= len(rounds) <= SETTINGS.depth
    (pool,) = rounds[-1].pools
    assert pool.parts[0].state == "split"
    linked = [child for part in pool.parts for child in part.children or ()]
    assert sorted(linked) == list(range(1, len(pool.parts)))
    for part in pool.parts:
        assert part.state in ("leaf", "split", "left over") and part.depth <= SETTINGS.depth
        assert (part.state == "split") == (part.operator is not None) == (part.children is not None)
        assert (part.mask is not None) == (part.operator == "mix")
        if part.state == "leaf":
            assert part.kind != "operator"
        if part.depth == SETTINGS.depth:
            assert part.state != "split"


def test_the_same_seed_draws_the_same_pools(networks: Networks) -> None:
    def pictures(seed: int) -> torch.Tensor:
        return torch.stack([part.image for part in pools(networks, SETTINGS, seed)[-1].pools[0].parts])

    assert torch.equal(pictures(4), pictures(4))
    other = pictures(5)
    assert other.shape != pictures(4).shape or not torch.equal(other, pictures(4))


def test_a_node_whose_every_sample_is_bad_is_left_over(networks: Networks) -> None:
    (pool,) = pools(networks, dataclasses.replace(SETTINGS, stop=-1.0))[-1].pools
    (root,) = pool.parts
    assert root.state == "left over" and root.terms is not None and root.terms.select > -1.0
    assert pool.left_over == [0] and root.cause == "loss"


def endless(networks: Networks) -> Networks:
    """Networks that take every child for an operator."""

    def forever(*images: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.one_hot(torch.zeros(len(images[-1]), dtype=torch.int64), 8).float()

    heads: Any = SimpleNamespace(operator=networks.heads.operator, mask=networks.heads.mask, types=forever)
    return dataclasses.replace(networks, heads=heads)


def test_the_second_stage_takes_up_a_third_pool_only_while_few_nodes_are_left_over() -> None:
    def left_over(*images: torch.Tensor) -> Pool:
        # Pools that share a node hold parts of their own with one image.
        return Pool(tuple(Part(image, cast(Codes, None), "operator", "left over", 1) for image in images))

    nodes = [torch.zeros(1) for _ in range(learned.SECOND_NODES + 1)]
    first, second = left_over(*nodes[:-2]), left_over(*nodes[1:-1])
    assert learned.taken_up([first, second, first]) == [first, second, first], "six, some of them in all"
    assert learned.taken_up([first, second, left_over(nodes[-1]), first]) == [first, second]
    large = left_over(*nodes)
    assert learned.taken_up([large, second, first]) == [large, second], "two always"


def test_a_pool_has_a_largest_size(networks: Networks) -> None:
    (pool,) = pools(endless(networks), dataclasses.replace(SETTINGS, depth=9, nodes=5))[-1].pools
    assert [part.state for part in pool.parts].count("split") == 5 and len(pool.left_over) == 6
    assert {pool.parts[place].cause for place in pool.left_over} == {"nodes"}
    (least,) = pools(endless(networks), dataclasses.replace(SETTINGS, depth=9, nodes=0))[-1].pools
    assert [part.state for part in least.parts] == ["split", "left over", "left over"], "the root alone is always drawn for"


def test_what_is_left_over_says_why(networks: Networks) -> None:
    (deep,) = pools(endless(networks), dataclasses.replace(SETTINGS, depth=1))[-1].pools
    (drawn,) = pools(endless(networks), dataclasses.replace(SETTINGS, depth=9, draws=1))[-1].pools
    for pool, cause in ((deep, "depth"), (drawn, "draws")):
        assert pool.left_over == [1, 2] and {part.cause for part in pool.parts} == {None, cause}
        stages = learned.Stages("learned")
        stages.chosen(pool)
        assert stages.left_over == {"loss": 0, "depth": 0, "nodes": 0, "draws": 0, cause: 2} and stages.second_stage_nodes == 2
        assert stages.nodes == 3 and stages.as_dict()["left_over"] == stages.left_over


@pytest.mark.parametrize(("trees", "draws"), [(1, 4), (3, 7), (2, 1)])
def test_no_more_nodes_are_drawn_for_than_allowed(networks: Networks, trees: int, draws: int) -> None:
    last = pools(endless(networks), dataclasses.replace(SETTINGS, depth=9, trees=trees, draws=draws))[-1]
    assert last.drawn == draws and last.done
    best = last.pools[0]
    assert 1 <= [part.state for part in best.parts].count("split") <= draws and best.left_over


def test_what_hardly_shows_is_one_colour_and_is_not_drawn_for(networks: Networks) -> None:
    every = pools(endless(networks), dataclasses.replace(SETTINGS, depth=3))[-1]
    none = pools(endless(networks), dataclasses.replace(SETTINGS, depth=3, hidden=10.0))[-1]
    assert every.drawn > none.drawn == 1
    assert [(part.state, part.kind) for part in none.pools[0].parts[1:]] == [("leaf", "albedo")] * 2


@pytest.mark.parametrize("seen_first", [True, False])
def test_what_shows_most_is_drawn_for_first_or_what_comes_first(networks: Networks, seen_first: bool) -> None:
    settings = dataclasses.replace(SETTINGS, depth=9, trees=1, draws=2, seen_first=seen_first)
    found = [pools(endless(networks), settings, seed)[-1].pools[0].parts[1:3] for seed in range(6)]
    assert all(sorted(part.cause or "" for part in pair) == ["", "draws"] for pair in found)
    drawn_for = [[part.state for part in pair].index("split") for pair in found]
    showing = [int(pair[1].shown > pair[0].shown) for pair in found]
    assert drawn_for == (showing if seen_first else [0] * 6) and 1 in showing


def test_samples_are_ordered_by_what_was_drawn_and_those_that_tau_refuses_come_last(
    networks: Networks, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = dataclasses.replace(SETTINGS, samples=8, stop=0.05, choices=8)
    made = [
        Terms(0.0, 0.0, 0.0, 0.0, 0.0, select, rank)
        for select, rank in zip([0.09, 0.03, 0.02, 0.04] * 2, [0.1, 0.3, 0.2, 0.4] * 2, strict=True)
    ]
    monkeypatch.setattr(inference, "criterion", lambda *_: made)
    networks = dataclasses.replace(networks, heads=_changing(networks))
    image = node_image(picture(SIMPLE), disc_mask(96), 16)
    part = Part(image, networks.vqvae.encode(image[None]), "operator", "open", 0)
    (ways,) = inference._splits([part], networks, settings, torch.Generator().manual_seed(0))
    kinds = [(way.operator, *(child.kind for child in way.children)) for way in ways]
    assert len(set(kinds)) == len(kinds) > 2
    order = [(way.terms.select > 0.05, way.terms.rank) for way in ways]
    assert order == sorted(order) and ways[0].terms.rank == 0.2
    # The first is what the node is split into, though another has the least rank.
    grown = inference._grown(Pool((part,)), {id(part): ways}, dataclasses.replace(settings, trees=1))
    assert grown[0].parts[0].state == "split"


def _changing(networks: Networks) -> Any:
    """Heads that say something else of every picture."""

    def decided(classes: int) -> Any:
        return lambda *images: torch.nn.functional.one_hot((images[-1].mean((1, 2, 3)) * 1e6).long() % classes, classes).float()

    return SimpleNamespace(operator=decided(3), mask=networks.heads.mask, types=decided(8))


def test_masks_are_asked_for_where_there_is_a_mix(networks: Networks) -> None:
    images = [torch.rand(5, 3, 16, 16) for _ in range(3)]
    asked = torch.tensor([True, False, False, True, False])
    with torch.no_grad():
        found, all_of_them = inference._masks(networks.heads, images[0], (images[1], images[2]), asked), networks.heads.mask(*images)
    assert torch.allclose(found[asked], torch.sigmoid(all_of_them)[asked], atol=1e-5) and found[asked].min() > 0.0
    assert not found[~asked].any()


def test_several_pools_differ_and_the_best_comes_first(networks: Networks) -> None:
    networks = dataclasses.replace(networks, heads=_changing(networks))
    settings = dataclasses.replace(SETTINGS, samples=12, trees=3)
    found = pools(networks, settings)[-1].pools
    assert 1 < len(found) <= 3
    losses = [pool.loss(settings.stop) for pool in found]
    assert losses == sorted(losses)
    assert len({tuple((part.kind, part.operator) for part in pool.parts) for pool in found}) == len(found)


@pytest.mark.parametrize("size", [16, 64, 200])
def test_a_node_image_fills_in_what_does_not_count(size: int) -> None:
    image = torch.full((3, 96, 96), 0.5)
    valid = disc_mask(96) & (sphere_normals(96)[:1] > -0.3)
    image = torch.where(valid, image, torch.ones(()))
    found = node_image(image, valid, size)
    disc = disc_mask(size)[0]
    assert found.shape == (3, size, size) and (found[:, ~disc] == 0.0).all()
    assert torch.allclose(found[:, disc], torch.tensor(0.5), atol=1e-4)


def test_a_node_image_is_the_picture_made_small() -> None:
    found, true = node_image(picture(SIMPLE, 256), disc_mask(256), 64), picture(SIMPLE, 64) * disc_mask(64)
    assert float((found - true).square().mean().sqrt()) < 0.01


LEAVES = [
    leaf("albedo", color=(0.2, 0.5, 0.7)),
    leaf("diffuse", direction=(0.3, 0.5, 0.8), ambient=0.3),
    leaf("highlight", direction=(0.3, 0.5, 0.8), sharpness=60.0, amplitude=1.3),
    leaf("toon_diffuse", direction=(-0.3, 0.5, 0.8), ambient=0.4, threshold=0.1, softness=0.1),
    leaf("toon_highlight", direction=(-0.3, 0.5, 0.8), radius=0.25, brightness=0.6),
    leaf("rim", direction=(-0.3, 0.5, 0.1), exponent=2.0),
    leaf("environment", direction=(0.3, 0.5, 0.8, -0.6, 0.3, 0.1), sharpness=(10.0, 3.0), color=(1.0, 0.5, 0.5, 0.3, 0.3, 0.8)),
]


@pytest.mark.parametrize("true", LEAVES, ids=lambda entry: entry.kind)
def test_a_leaf_is_found_in_a_noisy_picture(true: Leaf) -> None:
    disc = disc_mask(64)
    noise = 0.03 * torch.randn(3, 64, 64, generator=torch.Generator().manual_seed(1))
    found = decoded.leaf_of(true.kind, ((picture(true, 64) + noise) * disc).clamp(0.0, 1.0))
    assert found.kind == true.kind
    error = (picture(found, 64) - picture(true, 64))[:, disc[0]].square().mean().sqrt()
    assert float(error) < (0.05 if "toon" in true.kind else 0.02)


@pytest.mark.parametrize(
    "true",
    [
        leaf("threshold", direction=(0.3, 0.5, 0.4), threshold=0.1),
        leaf("threshold", direction=(0.3, 0.5, 0.4), threshold=0.1, softness=1.0),
        leaf("stripe", direction=(0.8, 0.5, 0.4), center=0.2, width=0.3),
    ],
    ids=["edge", "ramp", "stripe"],
)
def test_a_mask_is_found(true: Leaf) -> None:
    def drawn(mask: Leaf) -> torch.Tensor:
        layout = Layout.of(mask)
        return evaluate(mask, sphere_normals(64), layout.pack(mask).float(), layout) * disc_mask(64)

    found = decoded.mask_of(drawn(true))
    assert found.kind == true.kind
    assert float((drawn(found) - drawn(true)).abs().mean()) < 0.03


def test_an_arranged_tree_looks_the_same_and_is_flat() -> None:
    from itertools import islice

    for tree in islice(synthesis.trees("both", "train", seed=5), 12):
        found = arranged(tree.root)
        assert torch.allclose(picture(found, 32), picture(tree.root, 32), atol=2e-5)
        for _, node in walk(found):
            if isinstance(node, Operator) and node.kind != "mix":
                assert all(child.kind != node.kind for child in node.children)


class Oracle:
    """Draws the true children of the operators of a tree, from codes that are the pictures themselves."""

    size = 64

    def __init__(self, root: Node) -> None:
        self.nodes = [node for _, node in walk(root)]
        self.images = [picture(node, self.size) * disc_mask(self.size) if not _is_mask(node) else None for node in self.nodes]
        self.config = SimpleNamespace(size=self.size)
        self.vqvae = self.priors = self.heads = self
        self.device = torch.device("cpu")

    def nearest(self, image: torch.Tensor) -> Node:
        known = [(float((image - other).square().mean()), k) for k, other in enumerate(self.images) if other is not None]
        return self.nodes[min(known)[1]]

    def encode(self, images: torch.Tensor) -> Codes:
        return Codes(images, images, images, images)

    def decode(self, codes: Codes) -> torch.Tensor:
        return codes.top

    def sample_children(self, _vqvae: Any, given: Codes, samples: int, *_: Any) -> tuple[Codes, Codes]:
        found = [self.nearest(image) for image in given.top for _ in range(samples)]
        sides = ([self.images[self.nodes.index(node.children[k])] for node in found] for k in (0, 1))  # type: ignore[union-attr]
        left, right = (torch.stack(side) for side in sides)  # type: ignore[arg-type]
        return self.encode(left), self.encode(right)

    def operator(self, parents: torch.Tensor, *_: Any) -> torch.Tensor:
        numbers = [synthesis.OPERATORS.index(self.nearest(parent).kind) for parent in parents]
        return torch.nn.functional.one_hot(torch.tensor(numbers), 3).float()

    def mask(self, parents: torch.Tensor, *_: Any) -> torch.Tensor:
        found = []
        for parent in parents:
            node = self.nearest(parent)
            assert isinstance(node, Operator)
            mask = node.mask or leaf("threshold")
            layout = Layout.of(mask)
            found.append(evaluate(mask, sphere_normals(self.size), layout.pack(mask).float(), layout)[:1])
        return torch.stack(found) * 40.0 - 20.0

    def types(self, images: torch.Tensor) -> torch.Tensor:
        kinds = [self.nearest(image) for image in images]
        numbers = [0 if isinstance(node, Operator) else synthesis.TYPES.index(node.kind) for node in kinds]
        return torch.nn.functional.one_hot(torch.tensor(numbers), len(synthesis.TYPES)).float()


def _is_mask(node: Node) -> bool:
    return isinstance(node, Leaf) and node.kind in ("threshold", "stripe")


def decomposed(root: Node, monkeypatch: pytest.MonkeyPatch, **options: Any) -> Result:
    oracle: Any = Oracle(root)
    monkeypatch.setattr(Networks, "load", lambda *_: oracle)
    options = {"settings": learned.Settings(Inference(samples=2)), **options}
    return decompose((picture(root, 256) * 255.0).round() / 255.0, **options).result()


@pytest.mark.parametrize("root", [SIMPLE, PAINTED], ids=["realistic", "toon"])
def test_with_right_proposals_the_tree_comes_out_to_its_rounding(root: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    found = decomposed(root, monkeypatch, method="learned")
    assert found.psnr > 50.0 and same_structure(found.tree, Tree(root))
    assert found.stages is not None
    assert found.stages["second_stage_share"] == 0.0 and found.stages["second_stage_fits"] == 0
    assert found.stages["nodes"] == sum(isinstance(node, Operator) for _, node in walk(root))
    assert {"first stage", "leaves", "whole tree"} <= set(found.stages["seconds"])
    sizes = [member.values for member in found.family.members]
    assert sizes == sorted(sizes) and len(sizes) > 2


def test_the_ablation_takes_parts_away(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = decomposed(SIMPLE, monkeypatch, method="learned")
    plain = decomposed(SIMPLE, monkeypatch, method="learned", settings=learned.Settings(Inference(samples=1), overall=False))
    none = decomposed(
        SIMPLE, monkeypatch, method="learned", settings=learned.Settings(Inference(samples=1, stop=-1.0), second_stage="none")
    )
    assert none.psnr < plain.psnr < whole.psnr
    assert none.tree.leaves == 1 and none.stages is not None and none.stages["second_stage_share"] == 1.0
    assert none.stages["second_stage"] == "none" and none.stages["left_over"] == {"loss": 1, "depth": 0, "nodes": 0, "draws": 0}


@pytest.fixture
def pair(networks: Networks, monkeypatch: pytest.MonkeyPatch) -> tuple[Pool, Pool]:
    """Two pools in the place of what is drawn, each of a root with two parts that are left over, one of them in both."""
    rounds = [pools(endless(networks), dataclasses.replace(SETTINGS, draws=1, trees=1), seed)[-1] for seed in (0, 1)]
    (first,), (second,) = (found.pools for found in rounds)
    place = second.left_over[0]
    parts = list(second.parts)
    parts[place] = dataclasses.replace(first.parts[first.left_over[0]], cause="loss")
    drawn = Round((first, Pool(tuple(parts))), 2)
    monkeypatch.setattr(learned, "infer", lambda *_: iter([drawn]))
    return first, drawn.pools[1]


def test_what_several_pools_leave_over_is_decomposed_once(pair: tuple[Pool, Pool], tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Image] = []
    decompose_ = second_stage.SecondStage.decompose

    def noted(self: second_stage.SecondStage, part: Part) -> second_stage.Found:
        asked.append(part.image)
        return decompose_(self, part)

    monkeypatch.setattr(second_stage.SecondStage, "decompose", noted)
    decompose(picture(SIMPLE), method="learned", weights=tiny, preset="draft", settings=learned.Settings(threads=1)).result()
    assert [len(pool.left_over) for pool in pair] == [2, 2]
    assert len(asked) == 3 == len({id(image) for image in asked})


@pytest.mark.parametrize(
    ("method", "second", "side_by_side"), [("learned", "size", [3, 2, 2]), ("learned", "none", [2, 2]), ("hybrid", "size", [2, 2])]
)
def test_copies_of_the_process_change_no_tree(
    method: Any, second: Any, side_by_side: list[int], pair: tuple[Pool, Pool], tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask = crew.side_by_side
    results = []
    for workers in (1, 2):
        asked: list[int] = []

        def noted(jobs: Any, count: int, asked: list[int] = asked, workers: int = workers) -> Any:
            asked.append(len(jobs))
            assert count == workers
            return ask(jobs, count)

        monkeypatch.setattr(crew, "side_by_side", noted)
        settings = learned.Settings(second_stage=second, threads=workers)
        results.append(decompose(picture(PAINTED), method=method, weights=tiny, preset="draft", settings=settings).result())
        assert asked == side_by_side
    one, two = results
    assert one.tree == two.tree and one.family == two.family and one.stages is not None and two.stages is not None
    assert {**one.stages, "seconds": 0} == {**two.stages, "seconds": 0} and one.stages["seconds"].keys() == two.stages["seconds"].keys()
    assert second == "none" or method == "hybrid" or one.stages["second_stage_fits"] > 3


def test_looking_at_a_node_in_its_place_mends_what_was_decoded_badly(monkeypatch: pytest.MonkeyPatch) -> None:
    class Blurred(Oracle):
        def __init__(self, root: Node) -> None:
            super().__init__(root)
            body = self.nodes.index(root.children[0])  # type: ignore[union-attr]
            pale = 0.6 * self.images[body] + 0.2 * disc_mask(self.size)  # type: ignore[operator]
            self.images[body] = torch.nn.functional.avg_pool2d(pale[None], 9, 1, 4)[0]

    oracle: Any = Blurred(PAINTED)
    monkeypatch.setattr(Networks, "load", lambda *_: oracle)
    only = Inference(samples=1, depth=1, stop=10.0, trees=1, remainders=False)
    found = [
        decompose(
            picture(PAINTED), method="learned", preset="balanced", settings=learned.Settings(only, in_place=in_place, overall=False)
        ).result()
        for in_place in (False, True)
    ]
    assert all(result.stages is not None and result.stages["second_stage_nodes"] == 1 for result in found)
    assert found[1].psnr > found[0].psnr + 5.0


def test_a_hybrid_stops_where_a_proposal_is_right(monkeypatch: pytest.MonkeyPatch) -> None:
    found = decomposed(SIMPLE, monkeypatch, method="hybrid")
    assert found.psnr > 50.0 and same_structure(found.tree, Tree(SIMPLE))
    assert found.stages is not None and found.stages["method"] == "hybrid" and found.stages["tree_of"] == "networks"


def test_a_hybrid_that_was_proposed_nothing_says_that_the_tree_is_the_searchs(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = learned.Settings(Inference(samples=1, stop=-1.0))
    found = decomposed(SIMPLE, monkeypatch, method="hybrid", preset="draft", settings=nothing)
    assert found.stages is not None and found.stages["tree_of"] == "search"
    assert batch.stages_words(found.stages) == "the search's own tree; the networks found nothing"


DRAFT: dict[str, Any] = {"preset": "draft", "settings": learned.Settings(SETTINGS)}


@pytest.mark.parametrize("method", ["learned", "hybrid"])
def test_untrained_networks_still_give_a_tree(method: Any, tiny: Path) -> None:
    results = [decompose(picture(SIMPLE), method=method, weights=tiny, seed=2, **DRAFT).result() for _ in range(2)]
    assert results[0].tree == results[1].tree and results[0].family == results[1].family
    assert results[0].tree.values <= 30
    stages = results[0].stages
    assert stages is not None and 0.0 <= stages["second_stage_share"] <= 1.0 and stages["samples"] == 3 * stages["drawn_nodes"] > 0
    json.dumps(stages)


def test_a_hybrid_is_never_worse_than_a_search(tiny: Path) -> None:
    alone = decompose(picture(SIMPLE), preset="draft").result()
    assert decompose(picture(SIMPLE), method="hybrid", weights=tiny, **DRAFT).result().psnr >= alone.psnr - 0.5


def test_a_learned_decomposition_can_be_cancelled(tiny: Path) -> None:
    work = decompose(picture(SIMPLE), method="learned", weights=tiny, **DRAFT)
    stages = [next(work).stage, next(work).stage]
    held = weakref.ref(work._work)
    work.cancel()
    assert held() is None, "what it is at, copies of the process among it, ends at once"
    assert stages == ["start", "propose"] and work.result().tree.leaves >= 1


def test_the_largest_size_is_kept(tiny: Path) -> None:
    found = decompose(picture(PAINTED), method="learned", weights=tiny, max_values=9, **DRAFT).result()
    assert found.tree.values <= 9


@pytest.mark.slow
@pytest.mark.parametrize(("stop", "left_over"), [(-1.0, 1), (10.0, 2)], ids=["of the picture", "of two nodes, side by side"])
def test_the_papers_second_stage(stop: float, left_over: int, networks: Networks, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(second_stage, "NODE_BUDGET", search_depth.Budget(ranked=4, fitted=1, extended=1))
    monkeypatch.setattr(Networks, "load", lambda *_: endless(networks))
    settings = learned.Settings(dataclasses.replace(SETTINGS, stop=stop, draws=1, trees=1), second_stage="depth", threads=2)
    found = decompose(picture(SIMPLE, 64), method="learned", settings=settings, preset="draft").result()
    assert found.stages is not None and found.stages["second_stage_nodes"] == left_over
    assert found.stages["second_stage_fits"] >= 5 * left_over and found.tree.leaves >= 1


def test_without_weights_learned_says_so_and_the_rest_goes_on(tmp_path: Path) -> None:
    with pytest.raises(MissingWeightsError, match="unshade train all"):
        decompose(picture(SIMPLE), method="learned", weights=tmp_path)
    alone = decompose(picture(SIMPLE), preset="draft").result()
    instead = decompose(picture(SIMPLE), preset="draft", method="hybrid", weights=tmp_path).result()
    assert instead.tree == alone.tree and alone.stages is None
    assert instead.stages is not None and instead.stages["method"] == "search" and "no such weights" in instead.stages["why"]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("prior", r"unshade train all \(`unshade decompose --method search` needs none\)"),
        ("reflection", r"unshade train reflection \(`unshade decompose --reflections lights` needs none\)"),
        ("lstm", "unshade train baseline lstm$"),
    ],
)
def test_missing_weights_say_how_to_train_them_and_what_needs_none(name: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(MissingWeightsError, match=says):
        weights.load(name, tmp_path)


def test_weights_that_do_not_belong_together_are_refused(tiny: Path, tmp_path: Path) -> None:
    for name in weights.MODELS:
        weights.file_of(name, tmp_path).write_bytes(weights.file_of(name, tiny).read_bytes())
    larger = dataclasses.replace(find("tiny"), size=32)
    weights.save(weights.file_of("heads", tmp_path), "heads", weights.MODELS["heads"](larger), larger, {})
    with pytest.raises(weights.WeightsError, match=r"heads\.safetensors: made for other images"):
        Networks.load(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "learnt"}, "did you mean 'learned'"),
        ({"method": "learned", "second_stage": "deep"}, "second_stage must be"),
        ({"method": "learned", "search": "depth"}, "second_stage='depth'"),
        ({"method": "learned", "alternatives": 2}, "alternatives come from the search"),
        ({"method": "hybrid", "objective": "paper"}, "paper's objective"),
    ],
)
def test_arguments_that_do_not_fit(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TreeError, match=message):
        decompose(picture(SIMPLE), **options)


def test_the_command_reports_the_stages(tiny: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_picture(tmp_path / "ball.png", picture(SIMPLE), disc_mask(96).float())
    words = ["decompose", str(tmp_path / "ball.png"), "--preset", "draft", "--json", "-o", str(tmp_path / "out"), "--method"]
    assert run_command([*words, "learned", "--weights", str(tiny), "--second-stage", "none"]) == 0
    out, err = capfd.readouterr()
    first = json.loads(out)
    assert first["stages"]["method"] == "learned" and set(first["stages"]["seconds"]) >= {"first stage", "leaves"}
    said = batch.stages_words(first["stages"])
    assert said.startswith("left over") and f"{said}\n" in err
    page = (tmp_path / "out" / "ball" / "report.html").read_text(encoding="utf-8")
    assert f"{said[0].upper()}{said[1:]}.</p>" in page
    # Done before with the same networks, and not with others.
    assert run_command([*words, "learned", "--weights", str(tiny), "--second-stage", "none"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out) == first and f"{said}\n" in err
    words += ["learned"]
    assert run_command([*words, "--weights", str(tmp_path)]) == 6
    assert "no such weights" in capfd.readouterr().err
    words[-1] = "hybrid"
    assert run_command([*words, "--weights", str(tmp_path)]) == 0
    assert "decomposed by search alone" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        ({"method": "learned", "second_stage_nodes": 3}, "second stage: 3 of 8 nodes"),
        ({"method": "learned", "second_stage_nodes": 0, "second_stage": "depth"}, "second stage: 0 of 8 nodes"),
        ({"method": "learned", "second_stage_nodes": 8}, "second stage: the whole picture, the networks found nothing"),
        ({"method": "learned", "second_stage_nodes": 3, "second_stage": "none"}, "left over: 3 of 8 nodes, one colour each"),
        (
            {"method": "learned", "second_stage_nodes": 8, "second_stage": "none"},
            "left over: the whole picture, the networks found nothing",
        ),
        (
            {"method": "hybrid", "second_stage_nodes": 3, "tree_of": "networks"},
            "networks proposed the tree, 5 of 8 nodes; the search finished it",
        ),
        (
            {"method": "hybrid", "second_stage_nodes": 3, "tree_of": "search"},
            "the search's own tree; those that networks proposed are not better",
        ),
        ({"method": "search", "second_stage_nodes": 0, "why": "none"}, "decomposed by search alone, since none"),
    ],
)
def test_who_made_a_tree_in_words(stages: dict[str, Any], words: str) -> None:
    assert batch.stages_words({"why": "", "nodes": 8} | stages) == words
    assert batch.stages_words(None) == ""


@pytest.mark.skipif(not weights.available(), reason="no weights ship with this checkout")
@pytest.mark.parametrize("style", ["realistic", "toon"])
def test_the_shipped_networks_decompose(style: Any) -> None:
    tree = next(islice(synthesis.trees(style, "test", seed=7), 1, None))
    image = (picture(tree.root, 256) * 255.0).round() / 255.0
    found = decompose(image, method="learned").result()
    assert found.stages is not None and found.stages["second_stage_share"] < 1.0
    one_colour = fit(image, Tree(leaf("albedo")))
    assert found.psnr > one_colour.psnr + 6.0


def test_a_device_that_is_not_there() -> None:
    for method in ("learned", "hybrid"):
        with pytest.raises(UnshadeError, match="device warp:9: cannot be used here"):
            decompose(torch.full((3, 64, 64), 0.5), method=method, device="warp:9")
