"""Measure what cached sampling saves: children of one node drawn with the cache and without, which must be the same.

Run: ``python scripts/measure_sampling.py --config small --samples 8``. With trained weights in ``--weights DIR`` the codes are those
of the trained priors; the time does not depend on it. ``--pairs 24`` draws pairs of whole children instead, with the weights that ship or
those of the folder.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from unshade.inference import Networks
from unshade.models import weights
from unshade.models.config import CONFIGS, Config, find
from unshade.models.pixelsnail import PixelSNAIL
from unshade.render import render
from unshade.serde import parse
from unshade.sphere import sphere_normals


def measure(net: PixelSNAIL, config: Config, samples: int, device: torch.device) -> tuple[float, float, bool]:
    """Seconds with the cache and without, and whether both drew the same codes."""
    entries = torch.randn(config.vqvae.codes, config.vqvae.code_channels, device=device)
    condition = torch.randn(1, config.prior.condition_channels, net.size, net.size, device=device).expand(samples, -1, -1, -1)
    seconds, drawn = [], []
    for draw in (*[net.sample] * 5, net.sample_uncached):
        began = time.perf_counter()
        drawn.append(draw(entries, condition, torch.Generator(device).manual_seed(0)).cpu())
        seconds.append(time.perf_counter() - began)
    # TorchScript gets faster in its first runs.
    return seconds[-2], seconds[-1], bool(torch.equal(drawn[-2], drawn[-1]))


def measure_pairs(samples: int, folder: Path | None, device: torch.device, double: bool) -> tuple[float, float, int]:
    """Seconds with the cache and without for pairs of children of one node, a shaded ball, and how many pairs are the same."""
    networks = Networks.load(folder, device)
    ball = parse("screen(multiply(albedo(#c04030), diffuse(left up front, 0.3)), highlight(right up front, 40, 1.2))")
    seconds, drawn = [], []
    with torch.no_grad():
        parent = networks.vqvae.encode(render(ball, sphere_normals(networks.config.size))[None].to(device))
        if double:
            networks.priors.double()
            parent = networks.vqvae.double().codes(parent.top, parent.bottom)
        for cached in (*[True] * 3, False):
            began = time.perf_counter()
            pair = networks.priors.sample_children(networks.vqvae, parent, samples, torch.Generator(device).manual_seed(0), 1.0, cached)
            drawn.append(torch.cat([numbers.flatten(1).cpu() for codes in pair for numbers in (codes.top, codes.bottom)], 1))
            seconds.append(time.perf_counter() - began)
    return seconds[-2], seconds[-1], int((drawn[-2] == drawn[-1]).all(1).sum())


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--config", choices=list(CONFIGS), default="small")
    options.add_argument("--samples", type=int, nargs="+", default=[1, 8, 32])
    options.add_argument("--weights", type=Path)
    options.add_argument("--pairs", type=int)
    options.add_argument("--double", action="store_true", help="pairs in float64, where rounding decides no draw")
    options.add_argument("--threads", type=int, default=1)
    given = options.parse_args()
    torch.set_num_threads(given.threads)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if given.pairs:
        fast, slow, alike = measure_pairs(given.pairs, given.weights, device, given.double)
        print(f"{given.pairs} pairs: {fast:.2f} s with the cache, {slow:.1f} s without, {slow / fast:.0f} times; {alike} pairs the same")
        return
    torch.manual_seed(0)
    config = find(given.config)
    priors = weights.load("prior", given.weights).model if given.weights else weights.MODELS["prior"](config)
    priors = priors.to(device).eval()
    print("| codes | samples | with the cache, s | without, s | times faster | same codes |")
    print("|---|---|---|---|---|---|")
    for samples in given.samples:
        for level in ("top", "bottom"):
            net = getattr(priors.first, level)
            fast, slow, same = measure(net, config, samples, device)
            codes, agree = f"{level}, {net.size} x {net.size}", "yes" if same else "no"
            print(f"| {codes} | {samples} | {fast:.3f} | {slow:.2f} | {slow / fast:.1f} | {agree} |")


if __name__ == "__main__":
    main()
