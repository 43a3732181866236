"""What is computed on a device stays there, and is what the CPU computes: one contract for both."""

import copy

import pytest
import torch

from torchlb import (
    LaplaceBeltrami,
    Robin,
    heat_flow,
    heat_kernel_signature,
    implicit_step,
    poisson_solve,
)
from torchlb.surfaces import Ellipsoid, UnitDisk

cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
every_device = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=cuda)])

CALLS = {
    "eigenvalues": lambda lb, f: lb.eigenbasis(12).eigenvalues,
    "filter": lambda lb, f: lb.eigenbasis(12).from_basis(lb.eigenbasis(12).to_basis(f)),
    "signature": lambda lb, f: heat_kernel_signature(lb, torch.tensor([0.1, 1.0], device=f.device)),
    "heat_flow": lambda lb, f: heat_flow(lb, f, torch.tensor([0.01, 0.1], device=f.device)),
    "implicit_step": lambda lb, f: implicit_step(lb, f, 0.05),
    "poisson_solve": lambda lb, f: poisson_solve(lb, lb(f)),
    "gradient": lambda lb, f: lb.gradient(f),
    "field of eigenvalues": lambda lb, f: lb.connection.eigenbasis(4).eigenvalues,
}


@pytest.fixture(scope="module")
def shapes():
    """A closed surface, one with a boundary, and both in a batch."""
    one = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(900))
    other = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(700), condition=Robin(1.0))
    return {"closed": one, "open": other, "batch": LaplaceBeltrami.batch([one, one])}


@every_device
@pytest.mark.parametrize("shape", ["closed", "open", "batch"])
@pytest.mark.parametrize("name", CALLS)
def test_results_are_on_the_device_and_those_of_the_cpu(shapes, device, shape, name):
    if name == "field of eigenvalues" and shape != "closed" and device == "cpu":
        pytest.skip("slow, and the same")
    lb = shapes[shape]
    f = lb.points[:, :2].exp()
    expected = CALLS[name](lb, f)
    found = CALLS[name](copy.deepcopy(lb).to(device), f.to(device))
    assert found.device.type == device
    torch.testing.assert_close(found.cpu(), expected, rtol=1e-9, atol=1e-9)


@every_device
def test_gradients_of_eigenpairs_are_on_the_device(device):
    """Those of eigenvalues and of a projector in a medium; λ is of degree one in the conductivity: ⟨∂λ/∂κ, κ⟩ = λ."""
    lb = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(800)).to(device)
    kappa = (1 + lb.points[:, 0].square()).requires_grad_()
    basis = lb.with_medium(conductivity=kappa).eigenbasis(6, tolerance=1e-11)
    value = basis.eigenvalues[5]
    (slope,) = torch.autograd.grad(value, kappa, retain_graph=True)
    assert slope.device.type == device
    torch.testing.assert_close(slope @ kappa.detach(), value.detach(), rtol=1e-6, atol=0)
    f = lb.points[:, :1]
    (slope,) = torch.autograd.grad(basis.from_basis(basis.to_basis(f)).sum(), kappa)
    assert slope.device.type == device
    assert slope.isfinite().all()
    assert (slope != 0).any()
