"""The networks: shapes, codebooks, priors drawn with and without a cache, and weights in files."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import pytest
import torch

from unshade.errors import MissingWeightsError
from unshade.models import heads, pixelsnail, sampling, weights
from unshade.models.config import CONFIGS, Config, ConfigError, find
from unshade.models.pixelsnail import PixelSNAIL
from unshade.models.prior import Priors, Tables, repeat
from unshade.models.vqvae import VQVAE, Codebook, codebook_use
from unshade.render import render
from unshade.sphere import sphere_normals
from unshade.text import parse
from unshade.threads import threads

TINY = find("tiny")
DRAWN = dataclasses.replace(TINY, prior=dataclasses.replace(TINY.prior, blocks=2, layers=2, dropout=0.0))


def made_vqvae() -> VQVAE:
    """Codebooks as after a first batch."""
    vqvae = VQVAE(TINY).train()
    with torch.no_grad():
        vqvae(torch.rand(8, 3, TINY.size, TINY.size))
    return vqvae.eval().requires_grad_(False)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(1)


@pytest.mark.parametrize("name", CONFIGS)
def test_configurations_survive_json(name: str) -> None:
    assert Config.from_json(find(name).to_json()) == find(name)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"name": "x"}', json.dumps({**json.loads(TINY.to_json()), "vqvae": {"wide": 1}})])
def test_a_wrong_configuration_is_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match="configuration") as caught:
        Config.from_json(text)
    assert "\n" not in str(caught.value)


def test_an_unknown_configuration_gets_a_hint() -> None:
    with pytest.raises(ConfigError, match="did you mean 'small'"):
        find("smal")


def test_the_paper_configuration_is_the_papers() -> None:
    paper = find("paper")
    assert (paper.size, paper.top, paper.bottom, paper.vqvae.codes, paper.prior.channels) == (256, 8, 32, 2048, 256)


def test_vqvae_shapes_and_range() -> None:
    vqvae = made_vqvae()
    images = torch.rand(2, 3, 16, 16)
    codes = vqvae.encode(images)
    assert codes.top.shape == (2, TINY.top, TINY.top)
    assert codes.bottom.shape == (2, TINY.bottom, TINY.bottom)
    decoded = vqvae.decode(codes)
    assert decoded.shape == images.shape
    assert 0.0 <= float(decoded.min()) <= float(decoded.max()) <= 1.0
    assert float((decoded * (1.0 - vqvae.disc)).abs().max()) == 0.0
    # What passes gradients through the codebook, `x + (entry - x)`, is the entry up to its rounding.
    assert torch.allclose(vqvae.decode(vqvae.codes(codes.top, codes.bottom)), decoded, atol=1e-6)
    with pytest.raises(ValueError, match=r"expected \(B, 3, 16, 16\)"):
        vqvae.encode(images[:, :, :8])


def test_the_first_batch_fills_the_codebook() -> None:
    book = Codebook(16, 4, decay=0.9).train()
    _, numbers, _ = book(torch.randn(4, 4, 8, 8))
    assert codebook_use(numbers, 16).used > 8


def test_dead_codes_are_revived() -> None:
    book = Codebook(16, 4, decay=0.9).train()
    book(torch.randn(4, 4, 8, 8))
    with torch.no_grad():
        # Half of the codebook is thrown far away, where nothing draws it.
        book.entries[8:] = 100.0
        book.sums[8:] = 100.0 * book.uses[8:, None]
    used = []
    for _ in range(60):
        _, numbers, _ = book(torch.randn(4, 4, 8, 8))
        used.append(codebook_use(numbers, 16).used)
    assert used[0] <= 8
    assert used[-1] >= 15
    assert float(book.entries.abs().max()) < 10.0


def test_evaluation_leaves_the_codebook_alone() -> None:
    vqvae = made_vqvae()
    before = {key: value.clone() for key, value in vqvae.state_dict().items()}
    vqvae(torch.rand(2, 3, 16, 16))
    assert all(torch.equal(value, before[key]) for key, value in vqvae.state_dict().items())


def test_codebook_use_counts() -> None:
    use = codebook_use(torch.tensor([[0, 1], [2, 3]]), 8)
    assert use.used == 4
    assert use.perplexity == pytest.approx(4.0)


def test_a_logit_sees_only_codes_before_it() -> None:
    """And all of them: changing one code changes the logits of every later position, and of no other."""
    net = PixelSNAIL(4, 16, 8, DRAWN.prior).double().eval()
    entries, condition = torch.randn(16, 8).double(), torch.randn(1, 16, 4, 4).double()
    numbers = torch.randint(16, (1, 4, 4))
    before = net(numbers, entries, condition).flatten(2)
    for position in (0, 5, 11):
        changed = numbers.clone()
        changed.view(-1)[position] = (changed.view(-1)[position] + 1) % 16
        differs = (net(changed, entries, condition).flatten(2) - before).abs().amax((0, 1)) > 1e-12
        assert differs.tolist() == [k > position for k in range(16)]


@pytest.mark.parametrize(("temperature", "at_once"), [(1.0, 128), (1.0, 4), (0.5, 128), (0.0, 128)])
def test_sampling_with_the_cache_draws_the_same_codes(temperature: float, at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixelsnail, "AT_ONCE", at_once)
    vqvae, priors = made_vqvae(), Priors(DRAWN).eval()
    parent = vqvae.encode(torch.rand(2, 3, 16, 16))
    drawn = [priors.sample_children(vqvae, parent, 3, torch.Generator().manual_seed(5), temperature, cached) for cached in (True, False)]
    for fast, slow in zip(*drawn, strict=True):
        assert fast.top.shape == (6, TINY.top, TINY.top)
        assert torch.equal(fast.top, slow.top)
        assert torch.equal(fast.bottom, slow.bottom)
    if temperature == 1.0:
        assert drawn[0][0].bottom.unique().numel() > 4


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="PyTorch has no TorchScript for this Python")
def test_codes_are_drawn_without_the_interpreter() -> None:
    assert isinstance(sampling.compiled(), torch.jit.ScriptFunction)


def test_where_there_is_no_torchscript_codes_are_drawn_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise RuntimeError("TorchScript is gone")

    monkeypatch.setattr(torch.jit, "script", refused)
    assert sampling.compiled.__wrapped__() is sampling.draw


@pytest.mark.parametrize("heads", [1, 16])
def test_the_cache_holds_heads_of_all_channels_and_of_one(heads: int) -> None:
    net = PixelSNAIL(4, 16, 8, dataclasses.replace(DRAWN.prior, heads=heads)).double().eval()
    entries, condition = torch.randn(16, 8).double(), torch.randn(3, 16, 4, 4).double()
    fast, slow = (draw(entries, condition, torch.Generator().manual_seed(7)) for draw in (net.sample, net.sample_uncached))
    assert torch.equal(fast, slow)


@pytest.mark.parametrize("count", [1, 9, 13])
def test_threads_share_the_maps_and_draw_the_same_codes(count: int) -> None:
    """In TorchScript and, as on a GPU, without it."""
    net = PixelSNAIL(4, 16, 8, DRAWN.prior).double().eval()
    entries, condition = torch.randn(16, 8).double(), torch.randn(count, 16, 4, 4).double()

    def drawn(shared: int) -> torch.Tensor:
        with threads(shared):
            found = net.sample(entries, condition, torch.Generator().manual_seed(7))
            assert torch.get_num_threads() == shared
        return found

    alone = drawn(1)
    assert alone.shape == (count, 4, 4) and alone.unique().numel() > 4
    assert torch.equal(alone, drawn(2)) and torch.equal(alone, drawn(3))
    chances = pixelsnail._chances(condition, 16, torch.Generator().manual_seed(7))[0]
    with torch.no_grad():
        assert torch.equal(alone.flatten(1), sampling.draw(net.begun(condition, entries), entries, chances, 1.0))


@pytest.mark.skipif(not weights.available(), reason="no weights ship with this checkout")
@pytest.mark.parametrize(("level", "samples"), [("top", 2), pytest.param("bottom", 1, marks=pytest.mark.slow)])
def test_the_shipped_prior_draws_the_same_codes_with_the_cache(level: str, samples: int) -> None:
    """In float64: in float32 the rounding of sums in another order decides a draw now and then."""
    vqvae, prior = weights.load("vqvae").model, weights.load("prior").model.double()
    assert isinstance(vqvae, VQVAE) and isinstance(prior, Priors)
    ball = parse("screen(multiply(albedo(#c04030), diffuse(left up front, 0.3)), highlight(right up front, 40, 1.2))")
    encoded = vqvae.encode(render(ball, sphere_normals(64))[None])
    parent, tables = vqvae.double().codes(encoded.top, encoded.bottom), Tables.of(vqvae)
    condition = prior.first._coarse([parent], tables)
    if level == "bottom":
        condition = prior.first._fine([parent], condition, parent.top, tables)
    net, entries = getattr(prior.first, level), getattr(tables, level)
    fast, slow = (
        draw(entries, condition.repeat_interleave(samples, 0), torch.Generator().manual_seed(3))
        for draw in (net.sample, net.sample_uncached)
    )
    assert fast.shape == (samples, net.size, net.size)
    assert torch.equal(fast, slow)
    assert fast.unique().numel() > 8


def test_codes_are_drawn_as_often_as_they_are_likely() -> None:
    likely = torch.tensor([0.0, 0.5, 0.0, 0.3, 0.2, 0.0])
    chances = torch.rand(20_000, 1, generator=torch.Generator().manual_seed(1))
    drawn = sampling.pick(likely.log().expand(20_000, -1), chances, 1.0)
    assert torch.allclose(drawn.bincount(minlength=6) / 20_000, likely, atol=0.02)
    assert set(drawn.tolist()) == {1, 3, 4}
    sharper = sampling.pick(likely.log().expand(20_000, -1), chances, 0.5)
    assert torch.allclose(sharper.bincount(minlength=6) / 20_000, likely.square() / likely.square().sum(), atol=0.02)


def test_samples_of_one_parent_stand_in_a_row() -> None:
    codes = made_vqvae().encode(torch.rand(2, 3, 16, 16))
    assert torch.equal(repeat(codes, 3).top[3:], codes.top[1:].expand(3, -1, -1))


def test_heads_are_as_wide_as_the_data() -> None:
    from unshade.synthesis import OPERATORS, TYPES

    assert (len(OPERATORS), len(TYPES)) == (heads.OPERATORS, heads.TYPES)
    net, image = heads.Heads(TINY), torch.rand(2, 3, 16, 16)
    assert net.operator(image, image, image).shape == (2, len(OPERATORS))
    assert net.mask(image, image, image).shape == (2, 1, 16, 16)
    assert net.types(image).shape == (2, len(TYPES))


def test_weights_come_back(tmp_path: Path) -> None:
    vqvae = made_vqvae()
    weights.save(weights.file_of("vqvae", tmp_path), "vqvae", vqvae, TINY, {"steps": 3})
    loaded = weights.load("vqvae", tmp_path)
    assert loaded.config == TINY
    assert loaded.card == {"steps": 3}
    assert not loaded.model.training
    assert isinstance(loaded.model, VQVAE)
    assert torch.equal(loaded.model.top_codebook.entries, vqvae.top_codebook.entries)
    images = torch.rand(2, 3, 16, 16)
    assert float((loaded.model.decode(loaded.model.encode(images)) - vqvae.decode(vqvae.encode(images))).abs().mean()) < 0.05


def test_missing_weights_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(MissingWeightsError, match=r"vqvae\.safetensors.*unshade train") as caught:
        weights.load("vqvae", tmp_path)
    assert caught.value.exit_code == 6
    assert str(caught.value) == f"{caught.value.reason} (`unshade decompose --method search` needs none)"
    assert not weights.available(tmp_path)
    with pytest.raises(weights.WeightsError, match="did you mean 'heads'"):
        weights.load("head", tmp_path)


@pytest.mark.parametrize("damage", ["cut", "header", "empty", "text", "model", "shape", "config", "folder"])
def test_damaged_weights_are_one_line(damage: str, tmp_path: Path) -> None:
    path = weights.file_of("vqvae", tmp_path)
    weights.save(path, "vqvae", VQVAE(TINY), TINY, {})
    data = path.read_bytes()
    if damage == "model":
        weights.save(path, "heads", heads.Heads(TINY), TINY, {})
    elif damage == "shape":
        weights.save(path, "vqvae", VQVAE(TINY), dataclasses.replace(TINY, vqvae=dataclasses.replace(TINY.vqvae, channels=32)), {})
    elif damage == "folder":
        path.unlink()
        path.mkdir()
    else:
        broken = {"cut": data[:-10], "header": data[:40], "empty": b"", "text": b"weights", "config": data.replace(b"vqvae", b"vqvqe")}
        path.write_bytes(broken[damage])
    with pytest.raises((weights.WeightsError, MissingWeightsError), match=r"vqvae\.safetensors") as caught:
        weights.load("vqvae", tmp_path)
    assert "\n" not in str(caught.value)
