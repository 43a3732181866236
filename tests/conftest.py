"""What every test gets: fixed random numbers, float32 as the default type, one thread, pictures without a screen."""

import functools
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


@functools.cache
def points_or_mesh(method, surface, n, seed):
    """What a method of surfaces returns."""
    return method(surface, n, seed)


@pytest.fixture(scope="module", autouse=True)
def surfaces_once():
    """Points and meshes of surfaces are computed once for all tests, of which each gets a copy."""
    from torchlb.surfaces.base import Surface  # not before the checks of types are there

    def copied(name):
        method = getattr(Surface, name)

        def call(self, n, seed=0):
            found = points_or_mesh(method, self, n, seed)
            return found.clone() if name != "mesh" else tuple(part.clone() for part in found)

        return functools.wraps(method)(call)

    with pytest.MonkeyPatch.context() as patch:
        for name in ("points", "random_points", "mesh"):
            patch.setattr(Surface, name, copied(name))
        yield


@pytest.fixture
def unchecked(monkeypatch):
    """Without the tests' own checks of types: as a user calls it.

    Also for long computations, since a check takes longer than many of the functions in the loops of a solver, which
    shorter tests call with the same types.
    """
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
