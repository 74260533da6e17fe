"""Environments beyond the real ones: made up, and the real ones altered.

The training half has a dozen real environments. A network that is to tell reflections apart learns those by heart; what it should learn
is what surroundings look like at all: a sky over a ground, windows, lamps and suns, and detail of every size between them.
"""

from __future__ import annotations

import math
import random
from itertools import permutations

import torch
from safetensors.torch import load_file

from unshade.environments import EXPOSURES, SHARPNESSES, STORED, directions, names, versions_of
from unshade.types import Image

HEIGHT, WIDTH = 64, 128

MADE_SHARE = 0.65
"""Of the environments, those that are made up; the others are real ones of the training half."""

CHANNELS = tuple(permutations(range(3)))


def panoramas(seed: int) -> Image:
    """As many versions as `environments.panoramas` has for the training half, in the same order, each time of other environments."""
    choices, generator = random.Random(seed), torch.Generator().manual_seed(seed)
    stored = load_file(STORED)
    real = [stored[name].float() for name in names("train")]
    chosen = [made_up(choices, generator) if choices.random() < MADE_SHARE else light for light in real]
    lights = torch.stack([altered(light, real, choices, generator) for light in chosen])
    sharpnesses = [None if sharpness is None else sharpness * math.exp(choices.uniform(-0.5, 0.5)) for sharpness in SHARPNESSES]
    exposures = [exposure * math.exp(choices.uniform(-0.25, 0.25)) for exposure in EXPOSURES]
    return versions_of(lights, exposures, sharpnesses)


def altered(light: Image, others: list[Image], choices: random.Random, generator: torch.Generator) -> Image:
    """An environment (3, 64, 128) turned, recoloured, joined with another, with more or less contrast; of mean 1."""
    if choices.random() < 0.5:
        light = light.flip(-1)
    if choices.random() < 0.2:
        light = light[list(choices.choice(CHANNELS))]
    if choices.random() < 0.15:
        light = light.flip(-2)
    if choices.random() < 0.3:
        light = _joined(light, choices.choice(others).roll(choices.randrange(WIDTH), -1), choices)
    if choices.random() < 0.5:
        light = light * _color(0.35, generator)
    light = light / light.mean()
    if choices.random() < 0.5:
        light = light ** choices.uniform(0.7, 1.25)
    return light / light.mean()


def _joined(light: Image, other: Image, choices: random.Random) -> Image:
    """Two environments over each other, or one above the horizon and one below."""
    other = other / other.mean() * light.mean()
    if choices.random() < 0.5:
        share = choices.random()
        return share * light + (1.0 - share) * other
    below = torch.linspace(-1.0, 1.0, HEIGHT)[:, None] > choices.uniform(-0.4, 0.4)
    return torch.where(below, light, other)


def made_up(choices: random.Random, generator: torch.Generator) -> Image:
    """An environment that is nowhere, (3, 64, 128) scene-linear of mean 1: detail, a sky and a ground, windows and lamps, suns."""
    around = directions(HEIGHT)[0].T.unflatten(1, (HEIGHT, WIDTH))
    latitude, longitude = around[1].asin(), torch.atan2(around[0], around[2])
    falloff = choices.uniform(0.8, 2.0)
    light = torch.exp(choices.uniform(0.2, 1.3) * _noise(falloff, generator)).expand(3, -1, -1)
    colored = choices.choice((0.0, 0.0, 0.1, 0.3))
    light = light * torch.exp(colored * torch.stack([_noise(falloff, generator) for _ in range(3)])) * _color(0.12, generator)

    horizon = choices.uniform(-0.3, 0.3) + 0.08 * _noise(1.8, generator)
    above = torch.sigmoid((latitude - horizon) / choices.choice((0.02, 0.1, 0.4)))
    sky, ground = _color(0.2, generator) * choices.uniform(0.5, 4.0), _color(0.2, generator) * choices.uniform(0.2, 1.5)
    light = light * (above * sky + (1.0 - above) * ground)

    for _ in range(choices.randrange(7)):
        up, aside = choices.uniform(-0.6, 1.3), choices.uniform(-math.pi, math.pi)
        half_width, half_height = choices.uniform(0.05, 0.7), choices.uniform(0.05, 0.6)
        edge = choices.choice((0.01, 0.05))
        apart = ((longitude - aside + math.pi) % math.tau - math.pi).abs()
        window = torch.sigmoid((half_width - apart) / edge) * torch.sigmoid((half_height - (latitude - up).abs()) / edge)
        shown = math.exp(choices.uniform(-2.0, 3.5)) * _color(0.2, generator)
        light = light * (1.0 - window) + window * shown * (light if choices.random() < 0.5 else 1.0)

    for _ in range(choices.randrange(4)):
        toward = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
        if choices.random() < 0.8:
            toward[1] = toward[1].abs()
        sharpness = math.exp(choices.uniform(0.0, 6.5))
        brightness = math.exp(choices.uniform(0.0, 2.0)) * sharpness**0.35 * _color(0.25, generator)
        light = light + brightness * torch.exp(-2.0 * sharpness * (1.0 - (around * toward[:, None, None]).sum(0)))
    return light / light.mean()


def _noise(falloff: float, generator: torch.Generator) -> torch.Tensor:
    """(64, 128) of mean 0 and deviation 1 without a seam at the sides; amplitudes fall with the frequency's power ``-falloff``."""
    # Twice as high as is kept: the picture need not go on from its last row to its first.
    across, down = torch.fft.rfftfreq(WIDTH) * WIDTH, torch.fft.fftfreq(2 * HEIGHT) * 2 * HEIGHT
    frequency = (across.square() + down[:, None].square()).sqrt().clamp(min=1.0)
    real, imaginary = (torch.randn(frequency.shape, generator=generator) for _ in range(2))
    noise = torch.fft.irfft2(torch.complex(real, imaginary) / frequency**falloff, (2 * HEIGHT, WIDTH))[:HEIGHT]
    return (noise - noise.mean()) / noise.std()


def _color(spread: float, generator: torch.Generator) -> torch.Tensor:
    """A factor for each channel, (3, 1, 1), around 1."""
    return torch.exp(spread * torch.randn(3, 1, 1, generator=generator))
