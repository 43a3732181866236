"""−div(A∇u) + cu = λρu: exact solutions, derivatives in A, ρ and c, and what a medium may be."""

import copy
import io

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.spatial import Delaunay
from scipy.special import pro_cv

from noise import noise
from torchlb import (
    DerivativeError,
    DiffusionNet,
    ImplicitDiffusion,
    InputError,
    LaplaceBeltrami,
    PoissonFeatures,
    Robin,
    heat_flow,
    heat_kernel_signature,
    implicit_step,
    poisson_solve,
)
from torchlb.galerkin.forms import Forms
from torchlb.galerkin.medium import Field
from torchlb.surfaces import Ellipsoid, Sphere, Torus, UnitDisk

H = 1e-6


def build(kind, n=80):
    vertices, faces = (UnitDisk() if kind == "dirichlet" else Sphere()).mesh(n)
    if kind == "cotangent":
        return LaplaceBeltrami.from_cotangent(vertices, faces)
    order, condition = (
        (5, None) if kind == "order 5" else (3, kind if kind == "dirichlet" else None)
    )
    return LaplaceBeltrami.from_mesh(vertices, faces, order=order, condition=condition or "neumann")


KINDS = ["mesh", "order 5", "cotangent", "dirichlet"]
every_kind = pytest.mark.parametrize("kind", KINDS)


def test_the_elements_are_those_of_the_operator_on_a_thin_shape():
    """κ = 1 is the plain solve, where fits must not take points of the other side either."""
    lb = LaplaceBeltrami.from_mesh(*Ellipsoid((1.0, 1.0, 0.1)).mesh(500))
    one, x = torch.ones(500, dtype=torch.float64), lb.points[:, 0]
    torch.testing.assert_close(poisson_solve(lb, x, conductivity=one), poisson_solve(lb, x))


@every_kind
@pytest.mark.parametrize("at", ["vertices", "faces"])
def test_a_constant_conductivity_is_a_factor_of_time(kind, at):
    lb = build(kind, 300)
    f = torch.randn(300, 2, dtype=torch.float64)
    kappa = torch.full((300 if at == "vertices" else len(lb.faces),), 0.3, dtype=torch.float64)
    times = torch.tensor([0.1, 2.0], dtype=torch.float64)
    exact = {"tolerance": 1e-13}
    u = implicit_step(lb, f, times, conductivity=kappa, **exact)
    expected = implicit_step(lb, f, 0.3 * times, **exact)
    torch.testing.assert_close(u, expected, rtol=0, atol=1e-8)
    u = poisson_solve(lb, f, conductivity=kappa, **exact)
    torch.testing.assert_close(u, poisson_solve(lb, f, **exact) / 0.3, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("kind", "bound"), [("mesh", 2e-5), ("order 5", 1e-7), ("cotangent", 1e-2)]
)
def test_a_known_solution_on_the_sphere(kind, bound):
    """u = z, κ = e^{z}: div κ∇u = κ(−2z + 1 − z²); the prolonged logarithm keeps the order."""
    lb = build(kind, 1000)
    z = lb.points[:, 2]
    divergence = z.exp() * (1 - z.square() - 2 * z)
    u = implicit_step(lb, z - 0.5 * divergence, 0.5, conductivity=z.exp(), tolerance=1e-12)
    assert (u - z).norm() / z.norm() < bound
    u = poisson_solve(lb, -divergence, conductivity=z.exp(), tolerance=1e-12)
    assert (u - z).norm() / z.norm() < 3 * bound


@every_kind
def test_the_pair_is_symmetric_and_positive_in_every_medium(kind):
    """Rough over six decades; constants are in the kernel of K; linear elements are the cotangent's."""
    lb = build(kind)
    for count in (80, len(lb.faces)):
        kappa, rho = (3 * noise(2, count)).exp()
        root = noise(count, 3, 3, seed=1)
        for a in (kappa, root @ root.mT + 1e-3 * torch.eye(3, dtype=torch.float64)):
            medium = lb.with_medium(a, rho, rho)
            dense = medium.stiffness.to_dense()
            scale = dense.abs().max()
            assert (dense - dense.T).abs().max() <= 1e-12 * scale
            assert dense.sum(1).abs().max() <= 1e-12 * scale
            assert torch.linalg.eigvalsh(dense).min() >= -1e-10 * scale
        dense = medium.mass_matrix.to_dense()
        assert torch.linalg.eigvalsh(dense).min() > 0
        crow, col, values = medium.weak.pair
        whole = torch.sparse_csr_tensor(crow, col, values[0]).to_dense()
        added = whole - medium.stiffness.to_dense()
        assert torch.linalg.eigvalsh(added).min() >= -1e-10 * added.abs().max()


def test_linear_elements_are_the_cotangents():
    lb = build("cotangent")
    forms = Forms.flat(lb.points, lb.faces, lb.mass)
    ones = forms.values(Field(torch.ones(80, dtype=torch.float64), False, True))
    pair = forms.matrix(ones, ones)
    for ours, theirs in ((pair.real, lb.stiffness), (pair.imag, lb.mass_matrix)):
        ours = torch.from_numpy(ours.toarray())
        torch.testing.assert_close(ours, theirs.to_dense().triu(), rtol=0, atol=1e-10)


def test_constant_media_scale_and_shift_the_spectrum():
    """(κλ + c)/ρ, of numbers, of fields at vertices and on faces, and of tensors κ1."""
    lb = build("mesh", 300)
    expected = (2 * lb.eigenbasis(12, tolerance=1e-11).eigenvalues + 3) / 5
    count = len(lb.faces)
    for shape in ((), (300,), (count,)):
        kappa, rho, c = (torch.full(shape, x, dtype=torch.float64) for x in (2.0, 5.0, 3.0))
        values = lb.with_medium(kappa, rho, c).eigenbasis(12, tolerance=1e-11).eigenvalues
        torch.testing.assert_close(values, expected, rtol=1e-9, atol=0)
    for n in (300, count):
        a = 2 * torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
        values = lb.with_medium(a, 5.0, 3.0).eigenbasis(12, tolerance=1e-11).eigenvalues
        torch.testing.assert_close(values, expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("source", ["mesh", "cloud"])
def test_a_density_by_a_moebius_map(source):
    """ρ = σ² of a Möbius map of the sphere: λ = l(l + 1)."""
    points, faces = Sphere().mesh(1000)
    lb = LaplaceBeltrami.from_mesh(points, faces)
    lb = lb if source == "mesh" else LaplaceBeltrami.from_points(points)
    a = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    density = ((1 - a @ a) / (points - a).square().sum(1)) ** 2
    values = lb.with_medium(density=density).eigenbasis(25).eigenvalues[1:]
    exact = torch.tensor([m * (m + 1.0) for m in range(1, 5) for _ in range(2 * m + 1)])
    assert (values / exact - 1).abs().max() < 1.2e-3


@pytest.mark.parametrize("source", ["mesh", "cloud"])
def test_a_potential_on_the_sphere(source):
    """c = γ²z²: characteristic values of the prolate spheroidal functions."""
    points, faces = Sphere().mesh(1000)
    lb = LaplaceBeltrami.from_mesh(points, faces)
    lb = lb if source == "mesh" else LaplaceBeltrami.from_points(points)
    values = lb.with_medium(potential=16 * points[:, 2] ** 2).eigenbasis(24).eigenvalues
    exact = [pro_cv(m, n, 4) for m in range(8) for n in range(m, m + 8) for _ in range(1 + (m > 0))]
    assert (values / torch.tensor(sorted(exact)[:24]) - 1).abs().max() < 1.2e-4


@pytest.mark.parametrize(("order", "bound"), [(3, 1e-2), (5, 2e-3)])
def test_a_tensor_on_the_square(order, bound):
    """diag(1, 4): λ = π²(i² + 4j²), in the plane, and with the plane turned and tilted in space."""
    axis = np.linspace(0, 1, 23)
    points = np.stack(np.meshgrid(axis, axis, [0.0], indexing="ij"), -1).reshape(-1, 3)
    faces = Delaunay(points[:, :2]).simplices
    turn = torch.linalg.qr(noise(3, 3)).Q
    lb = LaplaceBeltrami.from_mesh(torch.tensor(points) @ turn.T, faces, order=order)
    a = turn @ torch.diag(torch.tensor([1.0, 4.0, 7.0], dtype=torch.float64)) @ turn.T
    values = lb.with_medium(a.expand(len(points), 3, 3)).eigenbasis(25).eigenvalues[1:]
    exact = np.sort([np.pi**2 * (i * i + 4 * j * j) for i in range(20) for j in range(20)])[1:25]
    assert (values / torch.tensor(exact) - 1).abs().max() < bound


def test_media_on_curves_and_solids():
    """On the circle κ = 1/ρ leaves λ = m², in the variable ∫ρ; in a cube diag(1, 4, 9) is π²(i² + 4j² + 9k²)."""
    t = torch.arange(100, dtype=torch.float64) * torch.pi / 50
    points, ring = torch.stack([t.cos(), t.sin()], 1), torch.arange(100)
    edges, rho = torch.stack([ring, (ring + 1) % 100], 1), 1 + 0.5 * t.cos()
    mesh, cloud = LaplaceBeltrami.from_mesh(points, edges), LaplaceBeltrami.from_points(points)
    exact = torch.tensor([1, 1, 4, 4, 9, 9, 16, 16.0])
    for lb in (mesh, cloud):
        values = lb.with_medium(1 / rho, rho).eigenbasis(9).eigenvalues[1:]
        assert (values / exact - 1).abs().max() < 3e-5
    axis = np.linspace(0, 1, 9)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points += (
        0.01 * np.random.default_rng(0).normal(size=points.shape) * ((points > 0) & (points < 1))
    )
    lb = LaplaceBeltrami.from_mesh(points, Delaunay(points).simplices)
    a = torch.diag(torch.tensor([1.0, 4.0, 9.0], dtype=torch.float64)).expand(len(points), 3, 3)
    values = lb.with_medium(a).eigenbasis(7).eigenvalues[1:] / torch.pi**2
    assert (values / torch.tensor([1, 4, 4, 5, 8, 9.0]) - 1).abs().max() < 0.02


def halves(dim, side, **options):
    """A box, (0, 1)^d, with κ on the faces, 1 and 9 in its halves; points off the interface are moved at random."""
    axis = np.linspace(0, 1, side)
    points = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim)
    moved = (points > 0) & (points < 1) & (np.arange(dim) + abs(points[:, :1] - 0.5) > 1e-9)
    points += 0.15 / (side - 1) * noise(*points.shape).clamp(-1, 1).numpy() * moved
    step = np.arange(side - 1)
    faces = Delaunay(points).simplices if dim > 1 else np.column_stack([step, step + 1])
    kappa = np.where(points[faces][..., 0].mean(1) < 0.5, 1.0, 9.0)
    flat = np.pad(points, ((0, 0), (0, 3 - dim)))
    return LaplaceBeltrami.from_mesh(flat, faces, **options), torch.from_numpy(kappa)


@pytest.mark.parametrize(
    ("dim", "side", "order", "bounds"),
    [
        (1, 41, 3, (4e-5, 4e-4)),
        (1, 41, 5, (4e-5, 7e-4)),
        (2, 33, 3, (1e-4, 4e-4)),
        (2, 33, 4, (1e-4, 2e-4)),
        (3, 13, 3, (1e-3, 3e-2)),
    ],
)
def test_a_conductivity_that_jumps(dim, side, order, bounds):
    """Modes along x: tan(s/2) + 3 tan(s/6) = 0, λ = s². Fits across the jump miss the first by 1 to 4 %."""
    lb, kappa = halves(dim, side, order=order)
    values = lb.with_medium(kappa).eigenbasis(20).eigenvalues
    for start, bound in zip((3.9, 9.4), bounds, strict=True):
        s = brentq(
            lambda s: np.sin(s / 2) * np.cos(s / 6) + 3 * np.sin(s / 6) * np.cos(s / 2),
            start,
            start + 0.1,
        )
        assert (values / s**2 - 1).abs().min() < bound


def slope(value, *fields):
    """The derivative in a direction of positive fields, by the chain rule and by a difference."""
    ways = [noise(*x.shape, seed=5) for x in fields]
    ways = [way if way.ndim == 1 else way + way.mT for way in ways]
    leaves = [x.clone().requires_grad_() for x in fields]
    grads = torch.autograd.grad(value(*leaves), leaves)
    ours = sum((g * way).sum() for g, way in zip(grads, ways, strict=True))
    ends = [value(*(x + s * H * way for x, way in zip(fields, ways, strict=True))) for s in (1, -1)]
    return float(ours), float((ends[0] - ends[1]) / (2 * H))


def results(x, t):
    """Functions of an operator whose values are differentiable in its medium, in exact arithmetic."""
    weight, tight = noise(len(x), 2, seed=7), {"tolerance": 1e-13}

    def basis(lb):
        return lb.eigenbasis(8, **tight)

    def spectral(lb):
        return basis(lb) and heat_flow(lb, x, t, method="spectral", k=8)

    def signature(lb):
        return basis(lb) and heat_kernel_signature(lb, t, k=8)

    return {
        "eigenvalues": lambda lb: basis(lb).eigenvalues.square().sum(),
        "vectors": lambda lb: (weight * spectral(lb)).sum(),
        "signature": lambda lb: (weight * signature(lb)).sum(),
        "step": lambda lb: (weight * implicit_step(lb, x, t, **tight)).sum(),
        "poisson": lambda lb: (weight * poisson_solve(lb, x, **tight)).sum(),
        "flow": lambda lb: (weight * heat_flow(lb, x, t, tolerance=1e-9)).sum(),
        "products": lambda lb: (
            weight * (lb.product("stiffness", x) + lb.product("mass", x))
        ).sum(),
    }


RESULTS = list(results(noise(1, 2), noise(2)))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", RESULTS)
def test_derivatives_in_the_medium(kind, name):
    """Of fields at the vertices, on the faces, and of tensors at both."""
    lb = build(kind, 40)
    value = results(noise(40, 2), torch.tensor([0.1, 0.3], dtype=torch.float64))[name]
    for count in (40,) if name == "flow" else (40, len(lb.faces)):
        kappa, rho, c = 0.5 + torch.rand(3, count, dtype=torch.float64)
        root = 0.3 * noise(count, 3, 3, seed=2)
        a = root @ root.mT + torch.eye(3, dtype=torch.float64)
        for fields in ((kappa, rho, c), (a, rho))[: 1 if name == "flow" else 2]:
            ours, theirs = slope(lambda *given: value(lb.with_medium(*given)), *fields)
            assert abs(ours - theirs) < 2e-5 * abs(theirs) + 1e-6, (count, ours, theirs)


@every_kind
@pytest.mark.parametrize("at", ["vertices", "faces"])
def test_derivatives_in_conductivity_data_and_time(kind, at):
    lb = build(kind, 40)
    count = 40 if at == "vertices" else len(lb.faces)
    kappa = torch.rand(count, dtype=torch.float64).add(0.5).requires_grad_()
    f = torch.randn(40, 2, dtype=torch.float64, requires_grad=True)
    t = torch.tensor([0.1, 0.3], dtype=torch.float64, requires_grad=True)
    data = {"boundary_values": 0.5} if kind == "dirichlet" else {}

    def step(kappa, f, t):
        return implicit_step(lb, f, t, conductivity=kappa, tolerance=1e-13, **data)

    def poisson(kappa, f):
        return poisson_solve(lb, f, conductivity=kappa, tolerance=1e-13, **data)

    assert torch.autograd.gradcheck(step, (kappa, f, t), fast_mode=True)
    assert torch.autograd.gradcheck(poisson, (kappa, f), fast_mode=True)


def test_tensors_that_are_multiples_of_one_have_derivatives():
    """Equal eigenvalues: the derivative in the direction of A itself is that of κ."""
    lb = build("mesh", 40)
    a = 2 * torch.eye(3, dtype=torch.float64).repeat(40, 1, 1)
    values = [lambda lb: lb.eigenbasis(6).eigenvalues.sum(), results(noise(40, 2), 0.1)["step"]]
    for value in values:
        leaf, kappa = a.clone().requires_grad_(), torch.full((40,), 2.0, dtype=torch.float64)
        kappa.requires_grad_()
        (tensor,) = torch.autograd.grad(value(lb.with_medium(leaf)), leaf)
        (number,) = torch.autograd.grad(value(lb.with_medium(kappa)), kappa)
        assert tensor.isfinite().all()
        torch.testing.assert_close(tensor.diagonal(dim1=1, dim2=2).sum(1), number)


@pytest.mark.usefixtures("unchecked")
def test_points_and_medium_together():
    """Gradients in both of one result; `at` keeps the medium."""
    lb = LaplaceBeltrami.from_mesh(
        Ellipsoid().mesh(60)[0] + 0.01 * noise(60, 3), Ellipsoid().mesh(60)[1]
    )
    kappa, way = 0.5 + torch.rand(60, dtype=torch.float64), noise(60, 3, seed=3)
    t = torch.tensor([0.1, 0.3], dtype=torch.float64)
    for name, value in results(noise(60, 2), t).items():

        def along(s, kappa, value=value):
            moved = lb.with_medium(kappa, potential=kappa).at(lb.points + s[0] * way)
            return value(moved)

        ours, theirs = slope(along, torch.zeros(1, dtype=torch.float64), kappa)
        assert abs(ours - theirs) < 1e-4 * abs(theirs) + 1e-6, (name, ours, theirs)


def test_a_layer_of_one_cell():
    """Which has no vertex of its own; two slow modes, of halves that hardly exchange, and a fast layer."""
    lb, _ = halves(2, 33)
    place = lb.points[lb.faces][..., 0].mean(1)
    layer = (place > 0.5) & (place < 0.5 + 1 / 32)
    fast = lb.with_medium(torch.where(layer, 1e3, 1.0).double()).eigenbasis(4).eigenvalues
    slow = lb.with_medium(torch.where(layer, 1e-3, 1.0).double()).eigenbasis(4).eigenvalues
    width = 1 / 32
    expected = brentq(lambda s: s * np.tan(s / 2 - s * width / 2) - 2e-3 / width, 1e-3, 1.0) ** 2
    assert abs(slow[1] / expected - 1) < 0.1
    assert abs(fast[1] / np.pi**2 - 1) < 0.1


def test_the_part_of_a_tensor_across_the_surface_does_not_jump():
    lb, _ = halves(2, 17)
    across = torch.rand(len(lb.faces)).double().mul(7).exp()
    tensors = torch.diag_embed(torch.stack([across**0, across**0, across], 1))
    expected = lb.with_medium(density=1.0).stiffness.to_dense()
    torch.testing.assert_close(lb.with_medium(tensors).stiffness.to_dense(), expected)


@pytest.mark.parametrize("order", [3, 4])
def test_a_condition_stays_after_a_medium_that_jumps(order):
    """In a solid, with a potential."""
    lb, kappa = halves(3, 5, order=order, condition=Robin(2.0))
    again = lb.with_medium(kappa, potential=1.0).with_medium(potential=2.0)
    torch.testing.assert_close(again.weak.values, lb.with_medium(potential=2.0).weak.values)
    assert abs(float(lb.with_medium(kappa).weak.values[3].sum()) - 12) < 1e-6


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("order", [3, 5])
@pytest.mark.parametrize("condition", ["neumann", Robin(2.0)])
def test_derivatives_where_a_conductivity_jumps(order, condition):
    """In points and medium, of functions and tangent fields; tensors κ1 jump as κ does, and so does a batch."""
    lb, kappa = halves(2, 9, order=order, condition=condition)
    bump = 0.05 * torch.sin(3 * lb.points[:, :1]) * torch.tensor([[0.0, 0.0, 1.0]]).double()
    lb, way = lb.at(lb.points + bump), noise(*lb.points.shape, seed=3)
    there = lb.with_medium(kappa)
    smooth = kappa.clamp_max(2.0)
    with torch.no_grad():
        mass, expected = (x.mass_matrix.to_dense() for x in (lb.with_medium(smooth), lb))
        torch.testing.assert_close(mass, expected)
        assert not torch.allclose(there.mass_matrix.to_dense(), mass)
        tensors = lb.with_medium(kappa[:, None, None] * torch.eye(3, dtype=torch.float64))
        again = there.with_medium(smooth).with_medium(kappa)
        batch = LaplaceBeltrami.batch([lb, lb]).with_medium(torch.cat([kappa, smooth]))
        for same in (tensors, again, batch.unbatch()[0]):
            torch.testing.assert_close(same.weak.values, there.weak.values)
    values = results(noise(81, 2), torch.tensor([0.1, 0.3], dtype=torch.float64))
    for name in ("eigenvalues", "step", "products"):

        def along(s, kappa, value=values[name]):
            return value(lb.at(lb.points + s[0] * way).with_medium(kappa))

        ours, theirs = slope(along, torch.zeros(1, dtype=torch.float64), kappa)
        assert abs(ours - theirs) < 1e-4 * abs(theirs) + 1e-6, (name, ours, theirs)

    def fields(kappa):
        return lb.with_medium(kappa).connection.eigenbasis(6, tolerance=1e-12).eigenvalues.sum()

    ours, theirs = slope(fields, kappa)
    assert abs(ours - theirs) < 1e-5 * abs(theirs), (ours, theirs)


def test_a_batch_in_a_medium_is_its_shapes_in_theirs():
    """Fields of the batch are split, results joined, and gradients reach the fields of each shape."""
    shapes = [build("mesh", 40), build("mesh", 60)]
    batch, sizes = LaplaceBeltrami.batch(shapes), [40, 60]
    f, kappa = noise(100, 2), (0.5 * noise(100)).exp().requires_grad_()
    on_faces = (0.5 * noise(len(batch.faces))).exp()
    together = batch.with_medium(kappa, on_faces, 0.5)
    faces = on_faces.split([len(shape.faces) for shape in shapes])
    parts = zip(shapes, kappa.split(sizes), faces, strict=True)
    alone = [shape.with_medium(k, r, 0.5) for shape, k, r in parts]
    t = torch.tensor([0.1, 0.3], dtype=torch.float64)
    for name, run in {
        "step": lambda lb, f: implicit_step(lb, f, t, tolerance=1e-12),
        "poisson": lambda lb, f: poisson_solve(lb, f, tolerance=1e-12),
        "flow": lambda lb, f: heat_flow(lb, f, t, tolerance=1e-8),
        "spectral": lambda lb, f: heat_flow(lb, f, t, method="spectral", k=6),
        "product": lambda lb, f: lb.product("stiffness", f),
    }.items():
        one, two = (
            run(together, f),
            torch.cat([run(*x) for x in zip(alone, f.split(sizes), strict=True)]),
        )
        torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-7, msg=name)
        grads = [torch.autograd.grad(x.square().sum(), kappa)[0] for x in (one, two)]
        torch.testing.assert_close(*grads, rtol=1e-4, atol=1e-6, msg=name)
    with pytest.raises(DerivativeError, match="does not know the shapes"):
        implicit_step(together.float(), f.float(), 0.1)
    with pytest.raises(InputError, match="one of each vertex or face of the shapes"):
        batch.with_medium(kappa[1:])


def test_batches_of_batches_reach_the_fields_of_their_shapes():
    """By eigenvalues and a solve; where the shapes of an inner batch are not known, that is an error."""
    one, two = build("mesh", 40), build("mesh", 60)
    kappa, f = (0.5 * noise(40)).exp().requires_grad_(), noise(140, 2)
    alone, inner = one.with_medium(kappa), LaplaceBeltrami.batch([one.with_medium(kappa), two])
    outer = LaplaceBeltrami.batch([inner, one])
    for value in (
        lambda lb: implicit_step(lb, f[: lb.num_points], 0.1, tolerance=1e-12)[:40].square().sum(),
        lambda lb: lb.eigenbasis(5, tolerance=1e-11).eigenvalues.view(-1)[:5].sum(),
    ):
        grads = [torch.autograd.grad(value(lb), kappa)[0] for lb in (outer, alone)]
        assert grads[1].abs().max() > 0
        torch.testing.assert_close(*grads, rtol=1e-5, atol=1e-8)
    with pytest.raises(DerivativeError, match="does not know the shapes"):
        LaplaceBeltrami.batch([inner.float(), one.float()])


def test_what_a_medium_leaves_and_what_travels():
    """Rows, mass and the operator itself are untouched; copies, states, types and files keep the medium."""
    lb = build("mesh", 80)
    kappa, f = noise(80).exp(), noise(80, 2)
    medium = lb.with_medium(kappa, potential=kappa)
    before = lb.eigenbasis(5).eigenvalues
    torch.testing.assert_close(medium(f), lb(f))
    assert medium.mass is lb.mass
    assert not torch.allclose(medium.eigenbasis(5).eigenvalues, before)
    torch.testing.assert_close(medium.with_medium(1.0).eigenbasis(5).eigenvalues, before)
    single = medium.float()
    assert single.weak.values.dtype == torch.float32
    assert lb.weak.values.dtype == lb.stencil.values.dtype == torch.float64
    medium = lb.with_medium(kappa, potential=kappa)
    file = io.BytesIO()
    torch.save(medium, file)
    file.seek(0)
    loaded = LaplaceBeltrami()
    loaded.load_state_dict(medium.state_dict())
    expected = medium.eigenbasis(5).eigenvalues
    moved = medium.at(2 * lb.points).eigenbasis(5).eigenvalues
    for other in (copy.deepcopy(medium), loaded, torch.load(file)):
        torch.testing.assert_close(other.eigenbasis(5).eigenvalues, expected)
        torch.testing.assert_close(other.at(2 * lb.points).eigenbasis(5).eigenvalues, moved)
    (split,) = copy.deepcopy(LaplaceBeltrami.batch([medium])).unbatch()
    torch.testing.assert_close(split.eigenbasis(5).eigenvalues, expected)
    with pytest.raises(InputError, match="medium of this operator is not known"):
        split.at(lb.points)
    with pytest.raises(InputError, match="the shape is closed"):
        medium.product("boundary_mass", f)


def test_a_network_learns_its_medium(unchecked):
    """Every layer by eigenpairs or solves passes gradients on to κ; P1 solutions say that they do not."""
    lb = LaplaceBeltrami.from_mesh(Sphere().mesh(80)[0].float(), Sphere().mesh(80)[1])
    torch.manual_seed(0)
    log_kappa = torch.zeros(80, requires_grad=True)
    for block in ("diffusion", "implicit"):
        net = DiffusionNet(3, 2, width=4, num_blocks=1, block=block, k=8)
        net.blocks[0].diffusion.tolerance = 1e-5
        net(lb.points, lb.with_medium(log_kappa.exp())).square().sum().backward()
        assert log_kappa.grad.isfinite().all()
        assert log_kappa.grad.abs().max() > 0
    with pytest.raises(DerivativeError, match="P1"):
        ImplicitDiffusion(3)(lb.points, lb.with_medium(log_kappa.exp())).sum().backward()


def test_a_conductivity_is_heard():
    """κ = e^{cz} from 15 eigenvalues."""
    lb = build("mesh", 300)
    z = lb.points[:, 2]
    seen = lb.with_medium((0.7 * z).exp()).eigenbasis(15).eigenvalues[1:]
    c = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([c], line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        values = lb.with_medium((c * z).exp()).eigenbasis(15).eigenvalues[1:]
        misfit = (values / seen).log().square().sum()
        misfit.backward()
        return misfit

    optimizer.step(loss)
    assert abs(c.item() - 0.7) < 1e-4


def test_what_cannot_be_a_medium_is_refused():
    lb, one = build("mesh"), torch.ones(80, dtype=torch.float64)
    tensor = torch.eye(3, dtype=torch.float64).repeat(80, 1, 1)
    skew = tensor + torch.tensor([[0, 0.1, 0], [0, 0, 0], [0, 0, 0]])
    tangential = lb.frames @ lb.frames.mT
    for given, message in (
        ({"conductivity": one[1:]}, "one of each vertex"),
        ({"conductivity": 0 * one}, "finite, positive"),
        ({"conductivity": skew}, "symmetric, positive"),
        ({"conductivity": -tensor}, "symmetric, positive"),
        ({"conductivity": tangential}, "at 80 of 80 .* of tangent directions alone need"),
        ({"conductivity": tensor[:, :2, :2]}, "symmetric space tensors"),
        ({"density": tensor}, "one of each vertex"),
        ({"density": torch.nan * one}, "finite, positive"),
        ({"potential": -one}, "nonnegative .* λ \\+ μ"),
        ({}, "got none"),
    ):
        with pytest.raises(InputError, match=message):
            lb.with_medium(**given)
    bare = LaplaceBeltrami.from_mesh(*Torus().mesh(80), weak_form=False)
    with pytest.raises(InputError, match="weak pair"):
        bare.with_medium(conductivity=2.0)


def test_as_many_vertices_as_faces_are_vertices():
    """κ = e^x on a grid of 12 points in 12 triangles, linear elements: the mean of its prolongation on each."""
    x, y = (
        t.flatten() for t in torch.meshgrid(torch.arange(3.0), torch.arange(4.0), indexing="ij")
    )
    corner = torch.arange(8).view(2, 4)[:, :3].flatten()[:, None]
    faces = torch.cat([corner + torch.tensor([0, 4, 5]), corner + torch.tensor([0, 5, 1])])
    lb = LaplaceBeltrami.from_cotangent(torch.stack([x, y, 0 * x], 1).double(), faces)
    assert lb.num_points == len(faces) == 12
    forms = Forms.flat(lb.points, faces, lb.mass)
    values = forms.values(Field(x.double().exp(), False, True))
    expected = torch.where(x[faces].sum(1) % 3 == 2, 2.0, 2 * (np.e - 2)) * x[faces].amin(1).exp()
    torch.testing.assert_close(values[0][:, 0], expected.double(), rtol=1e-3, atol=0)
    upper = torch.from_numpy(forms.matrix(values).real.toarray())
    ours = lb.with_medium(x.exp()).stiffness.to_dense().triu()
    torch.testing.assert_close(ours, upper)


def test_a_conductivity_is_learned():
    """κ = e^{c z} from one observed step, by gradient descent on c."""
    lb = build("mesh", 300)
    z = lb.points[:, 2]
    f = torch.stack([z, lb.points[:, 0]], 1)
    seen = implicit_step(lb, f, 0.5, conductivity=(0.7 * z).exp())
    c = torch.zeros((), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([c], line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        misfit = (implicit_step(lb, f, 0.5, conductivity=(c * z).exp()) - seen).square().sum()
        misfit.backward()
        return misfit

    optimizer.step(loss)
    assert abs(c.item() - 0.7) < 1e-4


def test_a_cloud_conducts_as_its_surface_does():
    """κ = e^z at the points of a sphere, once as a cloud and once as the mesh through it: 1e-3 at 600 points."""
    points = Sphere().points(600)
    cloud = LaplaceBeltrami.from_points(points)
    mesh = LaplaceBeltrami.from_mesh(points, cloud.faces)
    x, z = points[:, 0], points[:, 2]
    for step in (implicit_step, lambda lb, f, t, **k: poisson_solve(lb, f, **k)):
        one, two = (step(lb, x, 0.3, conductivity=z.exp()) for lb in (cloud, mesh))
        assert (one - two).norm() < 1e-3 * two.norm()


def test_the_conductivity_of_a_solve_keeps_the_rest_of_the_medium():
    """On the sphere −2Δu + 3u = 4z for z has u = 4z/7; sources of layers have the density, too."""
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(300))
    z, medium = lb.points[:, 2], lb.with_medium(density=4.0, potential=3.0)
    u = poisson_solve(medium, z, conductivity=2.0 * torch.ones_like(z))
    torch.testing.assert_close(u, 4 * z / 7, rtol=0, atol=1e-3)
    step = implicit_step(medium, z, 0.5, conductivity=2.0 * torch.ones_like(z))
    torch.testing.assert_close(step, 8 * z / 15, rtol=0, atol=1e-3)
    dense, layer = lb.with_medium(density=4.0), PoissonFeatures(1, tolerance=1e-9).double()
    torch.testing.assert_close(
        layer(z[:, None], dense), 4 * layer(z[:, None], lb), rtol=0, atol=1e-3
    )
