"""Robin's condition κ∂_ν u + a u = 0 in all that an operator does, and conditions as classes."""

import itertools
import math
import pickle
from functools import cache

import numpy as np
import pytest
import torch
from scipy import optimize, special

from torchlb import (
    Diffusion,
    DiffusionNet,
    ImplicitDiffusion,
    InputError,
    LaplaceBeltrami,
    Robin,
    heat_flow,
    implicit_step,
    load_operator,
    load_or_build,
    operator_key,
    poisson_solve,
    save_operator,
)
from torchlb.cloud.voronoi import boundary_of_cloud
from torchlb.geometry.boundary import boundary_of_mesh
from torchlb.geometry.frames import mesh_frames
from torchlb.linalg.sparse import to_scipy
from torchlb.stencils.assemble import Stencils, assemble
from torchlb.stencils.conditions import Condition, condition_of, kind_of
from torchlb.stencils.options import Options
from torchlb.stencils.shape import mesh_shape
from torchlb.surfaces import Sphere, UnitDisk

A = 2.0


@cache
def of_disk(count, a=A):
    """Eigenvalues of the unit disk: k² of the roots of k J_m'(k) + a J_m(k), each twice for m > 0."""
    found, grid = [], np.linspace(0.05, 9, 2000)
    for m in range(8):

        def datum(k, m=m):
            return k * special.jvp(m, k) + a * special.jv(m, k)

        values = datum(grid)
        for i in np.flatnonzero(values[:-1] * values[1:] < 0):
            found += [optimize.brentq(datum, grid[i], grid[i + 1]) ** 2] * (2 if m else 1)
    return torch.tensor(sorted(found)[:count])


@cache
def of_interval(count, a=A):
    """Roots k of tan k = 2ak/(k² − a²): functions of [0, 1] are cos kx + (a/k) sin kx."""

    def datum(k):
        return (k**2 - a**2) * np.sin(k) - 2 * a * k * np.cos(k)

    grid = np.linspace(0.05, 4 * count, 400 * count)
    values = datum(grid)
    turns = np.flatnonzero(values[:-1] * values[1:] < 0)[:count]
    return torch.tensor([optimize.brentq(datum, grid[i], grid[i + 1]) for i in turns])


def on_interval(x, a=A):
    k = of_interval(1, a)[0]
    return torch.cos(k * x) + a / k * torch.sin(k * x)


def interval(count):
    x = torch.linspace(0, 1, count, dtype=torch.float64)
    number = torch.arange(count)
    return torch.stack([x, 0 * x], 1), torch.stack([number[:-1], number[1:]], 1)


def cube(count):
    """Six tetrahedra in each cell of a grid."""
    line = torch.linspace(0, 1, count, dtype=torch.float64)
    number = torch.arange(count**3).view(count, count, count)
    cells = []
    for axes in itertools.permutations(range(3)):
        starts = [[0, 0, 0]]
        for axis in axes:
            starts.append([s + (i == axis) for i, s in enumerate(starts[-1])])
        corners = [number[tuple(slice(s, count - 1 + s) for s in start)] for start in starts]
        cells.append(torch.stack([c.flatten() for c in corners], 1))
    return torch.cartesian_prod(line, line, line), torch.cat(cells)


def relative(found, exact):
    return float(((found - exact) / exact).abs().max())


def largest(x):
    return float(x.abs().max())


@cache
def disk(kind, n=2000, a=A):
    vertices, faces = UnitDisk().mesh(n)
    options = {"condition": Robin(a)}
    if kind == "cloud":
        return LaplaceBeltrami.from_points(vertices[:, :2], dim=2, boundary="detect", **options)
    return LaplaceBeltrami.from_mesh(vertices, faces, **options)


@pytest.mark.parametrize("kind", ["mesh", "cloud"])
def test_eigenpairs_solves_flow_and_rows_of_the_disk_agree(kind):
    """−Δu = 1 has u = (1 − r²)/4 + 1/(2a); J₀(√λ r) is multiplied by 1/(1 + λt), e^{−λt} and −λ."""
    lb, exact, t = disk(kind), of_disk(10), 0.1
    values = lb.eigenbasis(10).eigenvalues
    assert largest(values[:3] - torch.tensor([2.55823776, 7.47815663, 7.47815663])) < 1e-5
    assert relative(values, exact) < 1e-5
    r = lb.points.norm(dim=1)
    assert largest(poisson_solve(lb, torch.ones_like(r)) - (1 - r**2) / 4 - 1 / (2 * A)) < 1e-6
    f = torch.special.bessel_j0(exact[0].sqrt() * r)
    assert largest(implicit_step(lb, f, t) - f / (1 + exact[0] * t)) < 3e-6
    for method in ("spectral", "rational"):
        flow = heat_flow(lb, f, t, method=method, k=64)
        assert largest(flow - torch.exp(-exact[0] * t) * f) < 3e-5, method
    assert largest(lb(f) + exact[0] * f) < 1e-4


@pytest.mark.parametrize("of_points", [False, True])
def test_an_interval(of_points):
    points, segments = interval(100)
    x, ends, k = points[:, 0], torch.zeros(100, dtype=torch.bool), of_interval(6)
    ends[[0, -1]] = True
    if of_points:
        lb = LaplaceBeltrami.from_points(points, dim=1, boundary=ends, condition=Robin(A))
    else:
        lb = LaplaceBeltrami.from_mesh(points, segments, condition=Robin(A))
    f, t = on_interval(x), 0.1
    assert relative(lb.eigenbasis(6).eigenvalues, k**2) < 1e-6
    assert largest(poisson_solve(lb, 0 * x + 1) - x * (1 - x) / 2 - 1 / (2 * A)) < 1e-10
    assert largest(implicit_step(lb, f, t) - f / (1 + k[0] ** 2 * t)) < 1e-7
    assert largest(heat_flow(lb, f, t) - torch.exp(-(k[0] ** 2) * t) * f) < 1e-6
    assert largest(lb(f) + k[0] ** 2 * f) < 1e-4


def test_a_cube_of_tetrahedra_whose_edges_and_corners_lose_through_several_faces():
    """Eigenfunctions are products; along an edge ∂_ν f = −√2 a f, ν the mean of two normals."""
    points, cells = cube(8)
    lb = LaplaceBeltrami.from_mesh(points, cells, condition=Robin(A))
    k = of_interval(3)
    exact = torch.cartesian_prod(k, k, k).square().sum(1).sort().values[:4]
    assert relative(lb.eigenbasis(4).eigenvalues, exact) < 1e-3
    f = on_interval(points).prod(1)
    f, t = f / f.max(), 0.1
    assert largest(implicit_step(lb, f, t) - f / (1 + exact[0] * t)) < 2e-3
    assert largest(heat_flow(lb, f, t) - torch.exp(-exact[0] * t) * f) < 2e-3
    assert largest(lb(f) + exact[0] * f) < 0.05


def test_what_is_added_to_the_stiffness():
    """aB for one a, and √(a_i a_j) B_ij ≥ 0 for any, beside a K with K1 = 0; there is none for a = 0."""
    lb = disk("mesh", 700)
    crow, col, values = lb.weak.crow, lb.weak.col, lb.weak.values
    torch.testing.assert_close(values[3], A * values[2], rtol=1e-15, atol=0)
    assert largest(lb.stiffness @ torch.ones(700, dtype=torch.float64)) < 1e-12
    assert torch.equal(lb.weak.pair[2][0], values[0] + values[3])
    vertices, faces = UnitDisk().mesh(700)
    rough = torch.where(torch.arange(700) % 3 == 0, 0.0, 100 * torch.rand(700))
    values = LaplaceBeltrami.from_mesh(vertices, faces, condition=Robin(rough)).weak.values
    added = to_scipy(crow, col, values[3], (700, 700)).toarray()
    assert np.linalg.eigvalsh(added).min() > -1e-12
    assert np.array_equal(added, added.T)
    none = LaplaceBeltrami.from_mesh(vertices, faces, condition=Robin(0.0))
    free = LaplaceBeltrami.from_mesh(vertices, faces)
    assert not none.weak.losing(none.fixed).any()
    assert torch.equal(none.stencil.values, free.stencil.values)
    assert torch.equal(none.eigenbasis(5).eigenvalues, free.eigenbasis(5).eigenvalues)


def test_a_varies_along_the_boundary_at_the_order_of_one_a():
    """u = e^x cos y is harmonic: ∂_ν u + a u = g."""
    errors = []
    for n in (350, 1400):
        vertices, faces = UnitDisk().mesh(n)
        x, y = vertices[:, 0], vertices[:, 1]
        a, u = 2 + torch.sin(3 * x) * y, torch.exp(x) * torch.cos(y)
        slope = x * u - y * torch.exp(x) * torch.sin(y)
        lb = LaplaceBeltrami.from_mesh(vertices, faces, condition=Robin(a))
        errors.append(largest(poisson_solve(lb, 0 * x, flux=slope + a * u) - u))
    assert errors[1] < 5e-6
    assert errors[0] / errors[1] > 4


def test_values_of_a_belong_to_the_points_in_whichever_order_they_are_given():
    vertices, faces = UnitDisk().mesh(300)
    order = torch.randperm(300)
    a, f = vertices[:, 0] + 2, vertices[:, 1].exp()
    one = LaplaceBeltrami.from_mesh(vertices, faces, condition=Robin(a))
    other = LaplaceBeltrami.from_mesh(
        vertices[order], order.argsort()[faces], condition=Robin(a[order].tolist())
    )
    torch.testing.assert_close(one(f)[order], other(f[order]), rtol=1e-9, atol=1e-9)
    u = poisson_solve(one, f)
    torch.testing.assert_close(u[order], poisson_solve(other, f[order]), rtol=1e-9, atol=1e-9)


def test_on_a_part_of_the_boundary():
    """The right end of an interval alone: the left one stays free, −u″ = 1 has u = (1 − x²)/2 + 1/a."""
    points, segments = interval(60)
    x, right = points[:, 0], torch.arange(60) == 59
    lb = LaplaceBeltrami.from_mesh(points, segments, condition=Robin(A), boundary=right)
    u = (1 - x**2) / 2 + 1 / A  # u'(0) = 0
    assert largest(poisson_solve(lb, 0 * x + 1) - u) < 1e-9
    assert torch.equal(lb.weak.losing(lb.fixed), right)


@pytest.mark.parametrize(("a", "bound"), [(1e-6, 1e-6), (1e6, 1e-4)])
def test_from_neumann_to_dirichlet(a, bound):
    """λ_0 = 2a, the length of the rim over the area, for small a; Dirichlet's eigenvalues for large ones."""
    lb = disk("mesh", 1000, a)
    values = lb.eigenbasis(6).eigenvalues
    exact = UnitDisk().eigenvalues(6, condition="dirichlet" if a > 1 else "neumann")
    assert relative(values[1:], exact[1:]) < bound * 20
    first = exact[0] if a > 1 else torch.tensor(2 * a, dtype=torch.float64)
    assert relative(values[0], first) < bound
    u = poisson_solve(lb, torch.ones(1000, dtype=torch.float64))
    assert largest(u - (1 - lb.points.norm(dim=1) ** 2) / 4 - 1 / (2 * a)) < 1e-5 / min(a, 1)


def test_low_order_rows_lose_through_their_share_of_the_boundary():
    """All of them, in the place of stencils: first eigenvalues to some percent, and none would be without."""
    vertices, faces = UnitDisk().mesh(700)
    options = Options(1, condition=Robin(A))
    shape = mesh_shape(vertices, faces, options, progress=False)
    assert float(shape.boundary.sizes.sum()) == pytest.approx(2 * math.pi, rel=1e-2)
    stencils = Stencils(shape, options)
    every = torch.arange(700)
    rows = stencils.rows(every, torch.full_like(every, len(stencils.candidates)))
    assert (rows.order == 0).all()
    matrix = to_scipy(rows.crow, rows.col, rows.laplacian, (700, 700)).toarray()
    values = np.sort(np.linalg.eigvals(-matrix).real)[:3]
    assert relative(torch.from_numpy(values), of_disk(3)) < 0.05


def test_sizes_of_boundaries():
    points, cells = cube(6)
    sizes = boundary_of_mesh(points, cells, 2).at(points, mesh_frames(points, cells)).sizes
    assert float(sizes.sum()) == pytest.approx(6)
    ball = torch.randn(4000, 3, dtype=torch.float64)
    ball *= (torch.rand(4000, 1, dtype=torch.float64) ** (1 / 3) * 0.95) / ball.norm(
        dim=1, keepdim=True
    )
    sphere = Sphere().points(800)
    rim = torch.arange(4800) >= 4000
    frames = torch.eye(3, dtype=torch.float64).expand(4800, 3, 3).contiguous()
    both = torch.cat([ball, sphere])
    sizes = boundary_of_cloud(both, rim, 3, 2).at(both, frames).sizes
    assert float(sizes.sum()) == pytest.approx(4 * math.pi, rel=0.03)
    assert not sizes[~rim].any()


def test_a_conductivity():
    """κ∂_ν u + a u = 0: −2Δu = 1 has u = (1 − r²)/8 + 1/(2a); and the derivative in κ is that of a difference."""
    lb = disk("mesh", 700)
    r, one = lb.points.norm(dim=1), torch.ones(700, dtype=torch.float64)
    for kappa in (2 * one, 2 * torch.ones(len(lb.faces), dtype=torch.float64)):
        u = poisson_solve(lb, one, conductivity=kappa)
        assert largest(u - (1 - r**2) / 8 - 1 / (2 * A)) < 1e-5
    x = lb.points[:, 0]
    kappa, way = (1 + 0.2 * x).requires_grad_(), torch.sin(3 * x)
    loss = poisson_solve(lb, one, conductivity=kappa).square().sum()
    (slope,) = torch.autograd.grad(loss, kappa)
    h = 1e-5
    sides = [
        poisson_solve(lb, one, conductivity=(kappa + s * h * way).detach()).square().sum()
        for s in (1, -1)
    ]
    assert relative(slope @ way, (sides[0] - sides[1]) / (2 * h)) < 1e-5


def test_data_at_the_boundary():
    """κ∂_ν u + a u = g of u = x² − y² + x, at r = 1 with ∂_ν u = 2(x² − y²) + x; there are no values to give."""
    lb = disk("mesh", 1000)
    x, y = lb.points[:, 0], lb.points[:, 1]
    u, slope = x**2 - y**2 + x, 2 * (x**2 - y**2) + x
    found = poisson_solve(lb, 0 * x, flux=slope + A * u)
    assert largest(found - u) < 1e-5
    step = implicit_step(lb, u, 0.3, flux=slope + A * u)  # (1 − tΔ)u = u
    assert largest(step - u) < 1e-5
    with pytest.raises(InputError, match="no Dirichlet condition"):
        poisson_solve(lb, 0 * x, boundary_values=1.0)


@pytest.mark.usefixtures("unchecked")
def test_gradients_in_f_and_t():
    lb = disk("mesh", 300)
    f = torch.randn(300, 2, dtype=torch.float64, requires_grad=True)
    t = torch.tensor([0.1, 0.3], dtype=torch.float64, requires_grad=True)
    for function in (implicit_step, heat_flow):
        options = {} if function is implicit_step else {"tolerance": 1e-11}
        loss = function(lb, f, t, **options).square().sum()
        slopes = torch.autograd.grad(loss, (f, t))
        h = 1e-5
        for place, slope in enumerate(slopes):
            way = torch.randn_like(slope)
            ends = []
            for side in (1, -1):
                moved = [f.detach(), t.detach()]
                moved[place] = moved[place] + side * h * way
                ends.append(function(lb, *moved, **options).square().sum())
            assert relative((slope * way).sum(), (ends[0] - ends[1]) / (2 * h)) < 1e-5


def shapes():
    """Robin's, a closed one, Dirichlet's, Neumann's, and Robin's with an a of each point."""
    vertices, faces = UnitDisk().mesh(200)
    of_disk = LaplaceBeltrami.from_mesh
    return [
        of_disk(vertices, faces, condition=Robin(A)),
        LaplaceBeltrami.from_mesh(*Sphere().mesh(150)),
        of_disk(vertices, faces, condition="dirichlet"),
        of_disk(vertices, faces),
        of_disk(vertices, faces, condition=Robin(vertices[:, 0] + 3)),
    ]


def everything(lb, f):
    yield poisson_solve(lb, f)
    yield implicit_step(lb, f, 0.2)
    yield heat_flow(lb, f, 0.2)
    yield lb(f)


@pytest.mark.usefixtures("unchecked")
def test_a_batch_of_shapes_with_all_conditions():
    """As each alone: by the shapes, by the batch as a whole, and after `unbatch`."""
    parts = shapes()
    batch = LaplaceBeltrami.batch(parts)
    f = [torch.randn(lb.num_points, 2, dtype=torch.float64) for lb in parts]
    alone = [torch.cat(x) for x in zip(*map(list, map(everything, parts, f)), strict=True)]
    copied = pickle.loads(pickle.dumps(batch))  # which knows nothing of the shapes
    for lb in (batch, copied):
        for found, exact in zip(everything(lb, torch.cat(f)), alone, strict=True):
            torch.testing.assert_close(found, exact, rtol=1e-4, atol=1e-4 * largest(exact))
        values = lb.eigenbasis(8).eigenvalues
        for own, part in zip(values, parts, strict=True):
            torch.testing.assert_close(own, part.eigenbasis(8).eigenvalues, rtol=1e-6, atol=1e-9)
    for part, again in zip(parts, batch.unbatch(), strict=True):
        assert again.condition == part.condition
        assert torch.equal(again.weak.values, part.weak.values)
        assert torch.equal(again.weak.linear.values, part.weak.linear.values)


@pytest.mark.parametrize("number", [0, 4])
def test_files_states_types_and_caches(number, tmp_path):
    lb = shapes()[number]
    f = torch.randn(200, dtype=torch.float64)
    save_operator(lb, tmp_path / "one.npz")
    empty = LaplaceBeltrami()
    empty.load_state_dict(lb.state_dict())
    for other in (load_operator(tmp_path / "one.npz"), empty, pickle.loads(pickle.dumps(lb))):
        assert other.condition == lb.condition
        assert isinstance(other.condition, Robin)
        for found, exact in zip(everything(other, f), everything(lb, f), strict=True):
            torch.testing.assert_close(found, exact, rtol=1e-9, atol=1e-9)
    single = lb.float()
    assert largest(poisson_solve(single, f.float()) - poisson_solve(empty, f)) < 1e-3
    vertices, faces = UnitDisk().mesh(200)
    keys = {
        operator_key(vertices, faces, condition=condition)
        for condition in (
            "neumann",
            "dirichlet",
            Robin(2),
            Robin(2.0),
            Robin(3),
            Robin([2.0] * 200),
        )
    }
    assert len(keys) == 5
    options = {"condition": empty.condition, "cache": tmp_path}
    first, again = (load_or_build(vertices, faces, **options) for _ in range(2))
    assert torch.equal(first.weak.values, again.weak.values)
    assert "condition=Robin(" in repr(again)


def test_layers():
    lb, t = disk("mesh", 700), 0.1
    exact = of_disk(1)[0]
    f = torch.special.bessel_j0(exact.sqrt() * lb.points.norm(dim=1))[:, None]
    for method in ("spectral", "rational"):
        layer = Diffusion(1, method=method, k=32, init_time=t).double()
        assert largest(layer(f, lb) - torch.exp(-exact * t) * f) < 1e-3
    layer = ImplicitDiffusion(1, init_time=t, tolerance=1e-6).double()
    assert largest(layer(f, lb) - f / (1 + exact * t)) < 1e-4
    parts = [lb, LaplaceBeltrami.from_mesh(*Sphere().mesh(150))]
    batch = LaplaceBeltrami.batch(parts)
    for block in ("diffusion", "implicit", "poisson"):
        net = DiffusionNet(3, 2, width=8, num_blocks=1, block=block, k=16).double().eval()
        alone = torch.cat([net(part.points, part) for part in parts])
        whole = net(batch.points, batch)
        torch.testing.assert_close(whole, alone, rtol=1e-4, atol=1e-5)
        whole.sum().backward()


def test_data_of_pyg():
    pyg = pytest.importorskip("torchlb.interop.pyg")
    from torch_geometric.data import Batch, Data

    transform = pyg.LaplaceBeltramiTransform(condition=Robin(A))
    meshes = [UnitDisk().mesh(200), Sphere().mesh(150)]
    data = [transform(Data(pos=v, face=f.T)) for v, f in meshes]
    lb = pyg.to_operator(Batch.from_data_list(data))
    f = torch.randn(350, dtype=torch.float64)
    parts = [LaplaceBeltrami.from_mesh(v, w, condition=Robin(A)) for v, w in meshes]
    alone = torch.cat(
        [poisson_solve(p, x) for p, x in zip(parts, f.split([200, 150]), strict=True)]
    )
    torch.testing.assert_close(poisson_solve(lb, f), alone, rtol=1e-6, atol=1e-6)


def test_it_holds_nowhere_on_a_closed_shape():
    with pytest.warns(UserWarning, match=r"condition=Robin\(2.0\) holds nowhere"):
        lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(150), condition=Robin(A))
    assert lb.eigenbasis(2).eigenvalues[0] == 0
    with pytest.raises(InputError, match=r"boundary: condition=Robin\(2.0\) holds at boundary"):
        LaplaceBeltrami.from_points(UnitDisk().points(300), condition=Robin(A))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (-1.0, "expected finite a ≥ 0, got -1"),
        (math.nan, "expected finite a ≥ 0, got nan"),
        (math.inf, "expected finite a ≥ 0, got inf"),
        ([1.0, -2.0, 3.0], r"got -2 at 1 points \(1\)"),
        ("much", "expected a number, or one of each point, got 'much'"),
        (None, "expected a number, or one of each point, got None"),
        (torch.ones(3, 2), r"\(N,\), got \(3, 2\)"),
    ],
)
def test_a_that_is_none_is_refused(bad, message):
    with pytest.raises(InputError, match=message):
        Robin(bad)


def test_conditions_that_are_not_known_are_refused_by_name(unchecked):
    vertices, faces = UnitDisk().mesh(200)
    for bad in ("robin", "mixed", 2.0, {"mixed": 1.0}, Robin):
        with pytest.raises(InputError, match="condition: "):
            LaplaceBeltrami.from_mesh(vertices, faces, condition=bad)
    with pytest.raises(InputError, match=r"'neumann', 'dirichlet', Robin\(…\).* got 'robin'"):
        condition_of("robin")
    with pytest.raises(InputError, match="expected one a, or one of each of 200 points, got 3"):
        LaplaceBeltrami.from_mesh(vertices, faces, condition=Robin([1.0, 2.0, 3.0]))
    assert condition_of(Robin([1.0, 2.0]).plain) == Robin([1.0, 2.0])
    with pytest.raises(InputError, match="'skin' is none; a class of yours has to be imported"):
        kind_of({"skin": 1.0})


def test_another_condition_is_one_class(monkeypatch, tmp_path):
    """A skin of thickness h and conductivity c around the shape, with f = 0 outside: ∂_ν f + (c/h) f = 0."""
    monkeypatch.setattr(Condition, "known", dict(Condition.known))

    class Skin(Condition):
        """Of one thickness."""

        name = "skin"
        conserves = False

        def __init__(self, data):
            self.data = data
            self.share = data["c"] / data["h"]

    vertices, faces = UnitDisk().mesh(700)
    skin = Skin({"c": 0.2, "h": 0.1})
    lb = LaplaceBeltrami.from_mesh(vertices, faces, condition=skin)
    save_operator(lb, tmp_path / "skin.npz")
    again = load_operator(tmp_path / "skin.npz")
    assert isinstance(again.condition, Skin)
    for other in (lb, again):
        assert relative(other.eigenbasis(6).eigenvalues, of_disk(6)) < 1e-3
        u = poisson_solve(other, torch.ones(700, dtype=torch.float64))
        assert largest(u - (1 - vertices.norm(dim=1) ** 2) / 4 - 1 / (2 * A)) < 1e-4
    options = Options(3, condition=skin)
    shape = mesh_shape(vertices, faces, options, progress=False)
    assert (assemble(Stencils(shape, options), progress=False).order == 3).double().mean() > 0.95


def test_where_the_boundary_has_no_measure_it_is_refused():
    """Else it would hold as Neumann's, in silence."""
    grid = np.stack(np.meshgrid(*3 * [np.linspace(0.0, 1.0, 7)], indexing="ij"), -1).reshape(-1, 3)
    points = np.c_[grid, grid[:, 0] ** 2]
    mask = torch.from_numpy(((grid < 1e-9) | (grid > 1 - 1e-9)).any(1))
    with pytest.raises(InputError, match="has no measure"):
        LaplaceBeltrami.from_points(points, dim=3, boundary=mask, condition=Robin(2.0))
