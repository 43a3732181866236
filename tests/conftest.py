"""What every test gets: fixed random numbers, float32 as the default type, pictures without a screen."""

import os

import pytest
import torch

os.environ.setdefault("MPLBACKEND", "Agg")


@pytest.fixture(autouse=True)
def seed():
    """Fix torch's generator, and see that no test changes the default type: float64 is asked for by name."""
    torch.manual_seed(0)
    yield
    assert torch.get_default_dtype() == torch.float32
