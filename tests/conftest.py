"""What every test stands on: one thread, deterministic kernels, warnings as errors (pyproject.toml), repeatable Hypothesis."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
import torch

from chromium import browser_or_skip

ROOT = Path(__file__).resolve().parent.parent

torch.set_num_threads(1)
torch.use_deterministic_algorithms(True)
hypothesis.settings.register_profile(
    "repeatable",
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=30,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def examples() -> Path:
    """The folder of example pictures."""
    return ROOT / "examples"


@pytest.fixture
def generator() -> torch.Generator:
    """A seeded source of randomness."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def browser() -> str:
    """Path of a Chromium; the test is skipped where there is none."""
    return browser_or_skip()


@pytest.fixture(autouse=True)
def _leaves_torch_as_it_was() -> Iterator[None]:
    """A test that changes torch's global state would make the result of its neighbours depend on their order."""
    before = torch.get_default_dtype()
    state = torch.random.get_rng_state()
    yield
    assert torch.get_default_dtype() == before, "the test changed torch's default dtype"
    torch.random.set_rng_state(state)
