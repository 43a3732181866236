"""What is computed on a device stays there, and is what the CPU computes: one contract for both."""

import copy

import pytest
import torch
from scipy import sparse

from pretended import Pretended, PretendedDevice, held, registered
from torchlb import (
    LaplaceBeltrami,
    Robin,
    TorchlbWarning,
    geodesic_distance,
    heat_flow,
    heat_kernel_signature,
    hodge_decomposition,
    implicit_step,
    logarithmic_map,
    parallel_transport,
    poisson_solve,
    vector_heat_flow,
)
from torchlb.galerkin.device import product
from torchlb.linalg.factor import Factor
from torchlb.linalg.sparse import from_scipy
from torchlb.surfaces import CliffordTorus, Ellipsoid, SpaceCurve, UnitDisk

cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
other = pytest.mark.skipif(not registered(), reason="this torch has no devices of Python's")


@pytest.fixture(
    params=["cpu", pytest.param("pretended", marks=other), pytest.param("cuda", marks=cuda)]
)
def device(request, monkeypatch, unchecked):
    """The name of a device, of which "pretended" has factors of the CPU."""
    if request.param != "pretended":
        yield request.param
        return
    solve = Factor.solve

    def solved(self, b):
        return Pretended(solve(self, held(b))) if isinstance(b, Pretended) else solve(self, b)

    monkeypatch.setattr(Factor, "solve", solved)
    with PretendedDevice(), torch.autograd.set_multithreading_enabled(False):
        yield "pretended"


CALLS = {
    "eigenvalues": lambda lb, f: lb.eigenbasis(12).eigenvalues,
    "filter": lambda lb, f: lb.eigenbasis(12).from_basis(lb.eigenbasis(12).to_basis(f)),
    "signature": lambda lb, f: heat_kernel_signature(lb, torch.tensor([0.1, 1.0], device=f.device)),
    "heat_flow": lambda lb, f: heat_flow(lb, f, torch.tensor([1e-3, 1e-2], device=f.device)),
    "implicit_step": lambda lb, f: implicit_step(lb, f, 0.05),
    "poisson_solve": lambda lb, f: poisson_solve(lb, lb(f)),
    "gradient": lambda lb, f: lb.gradient(f),
    "divergence": lambda lb, f: lb.divergence(lb.gradient(f)),
    "hessian": lambda lb, f: lb.hessian(f),
    "matrix": lambda lb, f: lb.matrix @ f,
    "products": lambda lb, f: lb.inner(f, f) + lb.integral(f),
    "mean curvature": lambda lb, f: lb.mean_curvature_normal(),
    "moved": lambda lb, f: lb.at(1.01 * lb.points).eigenbasis(5).eigenvalues,
    "medium": lambda lb, f: (
        lb.with_medium(conductivity=f[:, 0], potential=f[:, 1]).eigenbasis(5).eigenvalues
    ),
    "geodesic_distance": lambda lb, f: geodesic_distance(lb, 0),
    "logarithmic_map": lambda lb, f: logarithmic_map(lb, 0),
    "transport": lambda lb, f: parallel_transport(lb, 0, lb.frames[0, :, 0]),
    "transport by heat": lambda lb, f: parallel_transport(lb, 0, lb.frames[0, :, 0], method="heat"),
    "vector_heat_flow": lambda lb, f: vector_heat_flow(lb, lb.gradient(f[:, 0]), 0.01),
    "hodge_decomposition": lambda lb, f: hodge_decomposition(lb, lb.gradient(f[:, 0])).gradient,
    "field of eigenvalues": lambda lb, f: lb.connection.eigenbasis(4).eigenvalues,
}

DISK = UnitDisk().mesh(300)


def annulus(sections):
    """Of triangles that all have a side on its boundary."""
    angle = 2 * torch.pi * torch.arange(sections).double() / sections
    ring = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    one = torch.arange(sections)
    two = one.roll(-1)
    inner = torch.stack([one, two, one + sections], 1)
    outer = torch.stack([two, two + sections, one + sections], 1)
    return torch.cat([0.5 * ring, ring]), torch.cat([inner, outer])


def shaken_grid(size):
    axes = torch.meshgrid(*[torch.linspace(0, 1, size).double()] * 3, indexing="ij")
    return torch.stack(axes, -1).view(-1, 3) + 0.01 * torch.randn(size**3, 3).double()


MOVED = {
    "closed": lambda: LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(300)),
    "along normals": lambda: LaplaceBeltrami.from_mesh(
        *Ellipsoid().mesh(300), projection="normal", weights="polyharmonic"
    ),
    "Robin": lambda: LaplaceBeltrami.from_mesh(*DISK, condition=Robin(1 + DISK[0][:, 0].square())),
    "Dirichlet": lambda: LaplaceBeltrami.from_mesh(*DISK, condition="dirichlet"),
    "coarse": lambda: LaplaceBeltrami.from_mesh(*annulus(24)),
    "cloud": lambda: LaplaceBeltrami.from_points(Ellipsoid().points(300)),
    "curve": lambda: LaplaceBeltrami.from_points(SpaceCurve().points(80), dim=1),
    "solid": lambda: LaplaceBeltrami.from_points(shaken_grid(4), dim=3),
    "in R⁴": lambda: LaplaceBeltrami.from_mesh(*CliffordTorus().mesh(300)),
}
OF_ONE = {"moved", "hodge_decomposition"}
BESIDE = {"eigenvalues", "implicit_step", "poisson_solve", "gradient", "hodge_decomposition"}
"""What a boundary changes."""


@pytest.fixture(scope="module")
def shapes():
    """A closed surface, one with a boundary, and both in a batch."""
    one = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(400))
    other = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(300), condition=Robin(1.0))
    return {"closed": one, "open": other, "batch": LaplaceBeltrami.batch([one, one])}


@pytest.mark.parametrize("shape", ["closed", "open", "batch"])
@pytest.mark.parametrize("name", CALLS)
def test_results_are_on_the_device_and_those_of_the_cpu(shapes, device, shape, name):
    if shape == "batch" and name in OF_ONE:
        pytest.skip("for one shape")
    if device == "pretended" and shape != "batch" and name not in (OF_ONE, BESIDE)[shape == "open"]:
        pytest.skip("slow, and in the batch")
    lb = shapes[shape]
    f = lb.points[:, :2].exp()
    found = CALLS[name](copy.deepcopy(lb).to(device), f.to(device))
    assert found.device.type == device
    expected = CALLS[name](lb, f)
    torch.testing.assert_close(found.cpu(), expected, rtol=1e-9, atol=1e-9, equal_nan=True)


def test_gradients_of_eigenpairs_are_on_the_device(device):
    """Those of eigenvalues and of a projector in a medium; λ is of degree one in the conductivity: ⟨∂λ/∂κ, κ⟩ = λ."""
    lb = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(400)).to(device)
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


@pytest.mark.parametrize("kind", ["closed", "Robin"])
def test_derivatives_where_a_conductivity_jumps_are_computed_on_the_device(device, kind):
    """In the points, with a conductivity on the faces."""
    built = MOVED[kind]()
    right = built.points[built.faces][..., 0].mean(1) > 0

    def computed(lb):
        points = lb.points.detach().requires_grad_()
        moved = lb.at(points).with_medium(torch.where(right, 9.0, 1.0).double().to(lb.device))
        values = moved.eigenbasis(5, tolerance=1e-11).eigenvalues
        return values, *torch.autograd.grad(values.sum(), points)

    for found, expected in zip(
        computed(copy.deepcopy(built).to(device)), computed(built), strict=True
    ):
        assert found.device.type == device
        torch.testing.assert_close(found.cpu(), expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("terms", [8, 64, 10**8])
def test_products_of_sparse_matrices_in_parts(monkeypatch, terms):
    monkeypatch.setattr("torchlb.galerkin.device.BYTES", terms // 8)
    a, b = (sparse.random_array(shape, density=0.1, rng=0) for shape in ((30, 20), (20, 10)))
    one, two = ((*x[:2], x[2][:, None]) for x in map(from_scipy, (a, b)))
    crow, col, values = product(one, two, 10)
    found = sparse.csr_array((values[:, 0], col, crow), shape=(30, 10))
    assert abs(found - a @ b).max() < 1e-15


@pytest.mark.parametrize("kind", MOVED)
@pytest.mark.filterwarnings("ignore:.*low-order rows")
def test_an_operator_at_other_points_is_made_where_they_are(device, kind):
    """With its derivatives; ten digits are left after two of them in a fit along normals."""
    if device == "cpu":
        pytest.skip("tested elsewhere")
    built = MOVED[kind]()
    points = 1.02 * built.points + 1e-3 * (3 * built.points).sin()

    def computed(lb):
        moved = lb.at(points.to(lb.device).requires_grad_())
        f = moved.points.detach()[:, 0].exp()
        values = moved.eigenbasis(5).eigenvalues
        loss = values.sum() + ((moved(f) * moved.mass).square().sum() + moved.gradient(f).norm())
        return moved, torch.autograd.grad(loss, moved.points)[0]

    (expected, slope), (found, other) = computed(built), computed(copy.deepcopy(built).to(device))
    assert found.device.type == other.device.type == device
    torch.testing.assert_close(other.cpu(), slope, rtol=1e-6, atol=1e-8 * float(slope.abs().max()))
    tensors = dict(found.named_buffers())
    for name, tensor in expected.named_buffers():
        if not name.startswith("modes"):  # eigenvectors, up to their sign
            scale = float(tensor.double().abs().nan_to_num().max()) if tensor.numel() else 0.0
            close = {"rtol": 1e-9, "atol": 1e-9 * scale, "equal_nan": True}
            torch.testing.assert_close(tensors[name].cpu(), tensor, **close)


def test_points_that_moved_too_far_are_told_on_a_device(device):
    lb = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(300))
    points = lb.points.clone()
    points[::7] *= 1.3
    with pytest.warns(TorchlbWarning, match="moved too far"):
        copy.deepcopy(lb).to(device).at(points.to(device))


def test_rows_are_differentiated_where_the_points_are(device):
    """Also after the operator was moved."""
    lb = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(300))
    points = lb.points.clone().requires_grad_()
    moved = lb.at(points).to(device)
    (g,) = torch.autograd.grad(moved(lb.points.to(device)).square().sum(), points)
    assert g.device.type == "cpu"
    assert (g != 0).any()
