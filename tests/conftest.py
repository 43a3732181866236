"""What every test gets: fixed random numbers, float32 as the default type, one thread, pictures without a screen."""

import os

import jaxtyping
import pytest
import torch

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the programs that tests start
torch.set_num_threads(
    1
)  # small products: on a busy machine two threads wait for each other, 5 to 15 times longer


@pytest.fixture(autouse=True)
def seed():
    """Fix torch's generator, and see that no test changes the default type: float64 is asked for by name."""
    torch.manual_seed(0)
    yield
    assert torch.get_default_dtype() == torch.float32


@pytest.fixture
def unchecked(monkeypatch):
    """Without the tests' own checks of types: as a user calls it."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
