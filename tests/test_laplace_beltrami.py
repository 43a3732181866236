"""One contract for every operator, invariances at the level of rounding, and the accuracy that is promised."""

import copy
import functools
import io
import pickle
import threading
import warnings
from collections import namedtuple
from functools import cache

import igl
import jaxtyping
import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from torchlb import InputError, LaplaceBeltrami, Robin, collate, load_or_build
from torchlb.linalg.csr import tensors_of
from torchlb.operator.parts import BASIS
from torchlb.surfaces import (
    Circle,
    CliffordTorus,
    Ellipsoid,
    Sphere,
    Torus,
    UnitDisk,
    deserno_points,
    smooth_function,
    spherical_harmonic,
)

points_of = cache(lambda surface, n: surface.points(n))
mesh_of = cache(lambda surface, n: surface.mesh(n))


def polygon(n):
    index = torch.arange(n)
    return points_of(Circle(), n), torch.stack([index, (index + 1) % n], 1)


# (surface, builder); the surfaces and sizes are small, since every test runs on all of them.
BUILDERS = {
    "points": (
        Ellipsoid(),
        lambda: LaplaceBeltrami.from_points(points_of(Ellipsoid(), 300), order=2),
    ),
    "mesh": (Torus(), lambda: LaplaceBeltrami.from_mesh(*mesh_of(Torus(), 400), certify=True)),
    "cotangent": (Torus(), lambda: LaplaceBeltrami.from_cotangent(*mesh_of(Torus(), 400))),
    "polyharmonic": (
        Sphere(2.0),
        lambda: LaplaceBeltrami.from_points(points_of(Sphere(2.0), 300), weights="polyharmonic"),
    ),
    "normal": (
        Torus(),
        lambda: LaplaceBeltrami.from_points(
            points_of(Torus(), 400), projection="normal", normal_order=3
        ),
    ),
    "curve": (Circle(), lambda: LaplaceBeltrami.from_points(points_of(Circle(), 40), order=3)),
    "polyline": (Circle(), lambda: LaplaceBeltrami.from_mesh(*polygon(40), order=3)),
    "clifford": (
        CliffordTorus(),
        lambda: LaplaceBeltrami.from_points(points_of(CliffordTorus(), 400), dim=2),
    ),
}
built = cache(lambda name: BUILDERS[name][1]())


@pytest.fixture(params=BUILDERS)
def lb(request):
    return built(request.param)


@pytest.fixture(params=BUILDERS)
def pair(request):
    """The surface and an operator on it."""
    return BUILDERS[request.param][0], built(request.param)


def dense(lb):
    return lb.matrix.to_dense()


def relative(actual, expected):
    return float((actual - expected).norm() / expected.norm())


def same(actual, expected, tolerance=1e-12):
    """Equal up to a share of the largest entry."""
    assert actual.shape == expected.shape
    assert (actual - expected).abs().max() <= tolerance * expected.abs().max()


def random_like(lb, *shape):
    return torch.randn(*shape, dtype=lb.dtype)


# The contract


def test_constants_have_no_laplacian_and_no_gradient(lb):
    """L1 = 0 and G1 = 0 to rounding."""
    one = torch.ones(lb.num_points, dtype=torch.float64)
    assert lb(one).abs().max() <= 1e-13 * lb.stencil.values[0].abs().max()
    assert lb.gradient(one).abs().max() <= 1e-13 * lb.stencil.values[1:].abs().max()


def test_sizes_and_types(lb):
    surface_points, n = lb.points.shape
    assert lb.num_points == surface_points
    assert lb.frames.shape == (surface_points, n, lb.dim)
    assert lb.mass.shape == (surface_points,)
    assert lb.stencil.values[1:].shape == (lb.dim, len(lb.stencil.values[0]))
    assert lb.matrix.shape == (surface_points, surface_points)
    assert lb.matrix.layout == torch.sparse_csr
    assert lb.normals.shape == ((surface_points, n) if lb.dim == n - 1 else (0, n))
    assert {lb.dtype, lb.mass.dtype, lb.points.dtype, lb.frames.dtype} == {torch.float64}


def test_the_diagonal_is_stored_and_negative(lb):
    assert (dense(lb).diagonal() < 0).all()
    row = torch.arange(lb.num_points).repeat_interleave(lb.stencil.crow.diff())
    assert (lb.stencil.col == row).sum() == lb.num_points


def test_frames_and_normals_are_orthonormal_and_right_handed(lb):
    eye = torch.eye(lb.dim, dtype=torch.float64).expand(lb.num_points, -1, -1)
    torch.testing.assert_close(lb.frames.mT @ lb.frames, eye)
    if len(lb.normals):
        basis = torch.cat([lb.frames, lb.normals[..., None]], -1)
        torch.testing.assert_close(torch.linalg.det(basis), torch.ones(lb.num_points).double())


def test_normals_point_outward(pair):
    surface, lb = pair
    if len(lb.normals):
        assert ((lb.normals * surface.normals(lb.points)).sum(1) > 0.5).all()


def test_mass_is_positive_and_sums_to_the_area(pair):
    """To 3 % at these sizes."""
    surface, lb = pair
    assert (lb.mass > 0).all()
    assert abs(lb.mass.sum() / surface.area - 1) < 0.03


def test_forward_takes_three_layouts(lb):
    """(N,), (N, C) and (B, N, C) give the same columns."""
    f = random_like(lb, 2, lb.num_points, 3)
    result = lb(f)
    assert result.shape == f.shape
    same(lb(f[0]), result[0])
    same(lb(f[1, :, 2]), result[1, :, 2])
    assert lb(f[:, :, :0]).shape == (2, lb.num_points, 0)


def test_forward_is_the_matrix(lb):
    same(lb(torch.eye(lb.num_points, dtype=torch.float64)), dense(lb))


def test_shapes_of_the_gradient(lb):
    """Local (…, N, d, C), in space (…, N, n, C), the same in every layout; ∇f = E local."""
    num_points, n = lb.points.shape
    f = random_like(lb, 2, num_points, 3)
    local, space = lb.local_gradient(f), lb.gradient(f)
    assert local.shape == (2, num_points, lb.dim, 3)
    assert space.shape == (2, num_points, n, 3)
    same(lb.local_gradient(f[0]), local[0])
    same(lb.gradient(f[0]), space[0])
    same(lb.local_gradient(f[1, :, 2]), local[1, :, :, 2])
    same(lb.gradient(f[1, :, 2]), space[1, :, :, 2])
    same(lb.frames @ local[0], space[0])


def test_shapes_of_the_divergence_and_of_the_mean_curvature_normal(lb):
    num_points, n = lb.points.shape
    v = random_like(lb, num_points, n, 3)
    assert lb.divergence(v).shape == (num_points, 3)
    same(lb.divergence(v[..., 1]), lb.divergence(v)[:, 1])
    same(lb.divergence(torch.stack([v, 2 * v]))[1], 2 * lb.divergence(v))
    with pytest.raises(ValueError, match=rf"\(N, n\).* with N = {num_points}, n = {n}, got"):
        lb.divergence(v[1:])
    assert lb.mean_curvature_normal().shape == (num_points, n)
    same(lb.mean_curvature_normal(), lb(lb.points))


def test_forward_is_linear_and_differentiable_twice(lb):
    f = random_like(lb, lb.num_points, 1).requires_grad_()
    assert gradcheck(lb, (f,), fast_mode=True)
    assert gradgradcheck(lb, (f,), fast_mode=True)
    g = random_like(lb, lb.num_points, 1)
    (found,) = torch.autograd.grad((lb(f) * g).sum(), f)
    same(found, dense(lb).T @ g)


def test_products_with_the_transpose(lb):
    """Lᵀf in every layout, its derivative is L; lb @ f is lb(f)."""
    f, g = random_like(lb, 2, lb.num_points, 3), random_like(lb, lb.num_points)
    same(lb.stencil.product(0, f, transposed=True), dense(lb).T @ f)
    same(lb.stencil.product(0, g, transposed=True), dense(lb).T @ g)
    same(lb @ g, lb(g))
    g.requires_grad_()
    (found,) = torch.autograd.grad(lb.stencil.product(0, g, transposed=True).sum(), g)
    same(found, lb(torch.ones_like(g)), 1e-9)


def test_the_hessian_is_symmetric_and_its_trace_is_div_grad(lb):
    f = random_like(lb, lb.num_points, 2)
    found = lb.hessian(f)
    assert found.shape == (lb.num_points, lb.dim, lb.dim, 2)
    same(found, found.transpose(1, 2))
    same(lb.hessian(f[:, 1]), found[..., 1])
    same(torch.einsum("iaac->ic", found), lb.divergence(lb.gradient(f)))


def test_it_knows_its_shape_type_and_options(lb):
    assert lb.shape == lb.matrix.shape
    assert (lb.dtype, lb.device) == (torch.float64, torch.device("cpu"))
    assert lb.boundary is None


def test_gradient_and_divergence_are_differentiable(lb):
    f = random_like(lb, lb.num_points, 1).requires_grad_()
    v = random_like(lb, *lb.points.shape).requires_grad_()
    assert gradcheck(lb.gradient, (f,), fast_mode=True)
    assert gradcheck(lb.divergence, (v,), fast_mode=True)


def test_float32_is_the_rounded_operator(lb):
    single = copy.deepcopy(lb).float()
    assert single.stencil.crow.dtype == lb.stencil.crow.dtype
    f = smooth_function(lb.points)
    found = single(f.float())
    assert found.dtype == torch.float32
    bound = 1e-6 * (lb.matrix.to_dense().abs() @ f.abs()).max()
    assert (found.double() - lb(f)).abs().max() <= bound
    assert single.double().dtype == torch.float64


@pytest.mark.parametrize("way", ["deepcopy", "pickle", "state_dict", "save"])
def test_copies_are_equal(lb, way):
    if way == "deepcopy":
        other = copy.deepcopy(lb)
    elif way == "pickle":
        other = pickle.loads(pickle.dumps(lb))
    else:
        state = lb.state_dict()
        if way == "save":
            file = io.BytesIO()
            torch.save(state, file)
            file.seek(0)
            state = torch.load(file, weights_only=True)
        other = LaplaceBeltrami()
        other.load_state_dict(state)
    for name, buffer in lb.named_buffers():
        assert torch.equal(tensors_of(other)[name].nan_to_num(), buffer.nan_to_num()), name
    assert (other.source, other.options) == (lb.source, lb.options)
    assert other.certificate == lb.certificate
    assert repr(other) == repr(lb)
    assert str(other.report) == str(lb.report)
    f = random_like(lb, lb.num_points, 2).requires_grad_()
    assert torch.equal(other(f), lb(f))
    assert torch.equal(*(torch.autograd.grad(x(f).sum(), f)[0] for x in (other, lb)))


def test_a_whole_module_can_be_saved(lb):
    file = io.BytesIO()
    torch.save(lb, file)
    file.seek(0)
    assert torch.equal(torch.load(file, weights_only=True).stencil.values[0], lb.stencil.values[0])


def test_repr_says_what_it_is(lb):
    text = repr(lb)
    assert f"{lb.num_points} points" in text
    assert f"dim={lb.dim} in R^{lb.points.shape[1]}" in text
    assert lb.source in text
    assert f"{len(lb.stencil.col)} entries" in text


def test_an_operator_is_data_not_parameters(lb):
    assert list(lb.parameters()) == []
    assert not any(buffer.requires_grad for buffer in lb.buffers())


def test_empty():
    lb = LaplaceBeltrami()
    assert repr(lb) == "LaplaceBeltrami(empty)"
    assert lb.num_points == 0


# Batches, boundaries, positions


def assert_identical(actual, expected):
    for name, buffer in expected.named_buffers():
        assert torch.equal(tensors_of(actual)[name].nan_to_num(), buffer.nan_to_num()), name
    assert actual.get_extra_state() == expected.get_extra_state()


@functools.cache
def disk(condition="dirichlet"):
    return LaplaceBeltrami.from_mesh(
        *mesh_of(UnitDisk(), 150), order=2, condition=condition, certify=True
    )


@pytest.mark.parametrize("pairs", [False, True])
def test_unbatch_is_the_inverse_of_batch(pairs):
    """Every tensor, the certificate, options and eigenbasis of every shape, also of a batch of batches."""
    names = ("mesh", "cotangent") if pairs else ("points", "polyharmonic", "normal")
    shapes = [copy.deepcopy(built(name)) for name in names]
    shapes += [copy.deepcopy(disk())] if pairs else []
    for k, shape in enumerate(shapes, start=4):
        shape.eigenbasis(k)
    for found, expected in zip(LaplaceBeltrami.batch(shapes).unbatch(), shapes, strict=True):
        assert_identical(found, expected)
    for shape in shapes:
        shape._keep_basis(None, stored=False)
        for name in BASIS:
            setattr(shape.modes, name, shape.mass.new_zeros(0))
    nested = LaplaceBeltrami.batch([LaplaceBeltrami.batch(shapes[:2]), *shapes[2:]])
    for found, expected in zip(nested.unbatch(), shapes, strict=True):
        assert_identical(found, expected)
    with pytest.raises(ValueError, match="expected a batch"):
        shapes[0].unbatch()


def test_the_boundary_and_its_condition_are_known():
    """Also after a round trip, and in a batch, where a closed shape has none."""
    mask = UnitDisk().boundary_mask(mesh_of(UnitDisk(), 150)[0])
    other = LaplaceBeltrami()
    other.load_state_dict(disk().state_dict())
    for lb in (disk(), other, copy.deepcopy(disk()).float()):
        assert lb.condition == "dirichlet"
        assert torch.equal(lb.boundary, mask)
        assert "condition='dirichlet'" in repr(lb)
    assert disk("neumann").condition == "neumann"
    assert (disk(None).condition, disk(None).boundary) == (None, None)
    batch = LaplaceBeltrami.batch([built("mesh"), disk()])
    assert torch.equal(batch.boundary, torch.cat([torch.zeros(400, dtype=torch.bool), mask]))
    assert batch.condition is None  # not one for all


def test_a_condition_may_hold_on_a_part_of_the_boundary_of_a_mesh():
    vertices, faces = mesh_of(UnitDisk(), 150)
    whole = UnitDisk().boundary_mask(vertices)
    part = whole & (vertices[:, 0] > 0)
    build = functools.partial(LaplaceBeltrami.from_mesh, vertices, faces, order=2)
    assert torch.equal(build(boundary=part, condition="dirichlet").boundary, part)
    for all_of_it in (whole, "detect", None):
        lb = build(boundary=all_of_it, condition="dirichlet")
        assert torch.equal(lb.stencil.values[0], disk().stencil.values[0])
    with pytest.raises(ValueError, match="condition='dirichlet'"):
        build(boundary="dirichlet")


def test_dirichlet_on_a_cloud_needs_a_boundary(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # which knows the choices, too
    with pytest.raises(ValueError, match="pass a mask of them"):
        LaplaceBeltrami.from_points(points_of(Sphere(), 100), order=1, condition="dirichlet")
    with pytest.raises(
        ValueError, match=r"condition: expected 'neumann', 'dirichlet', .*, got 'robin'"
    ):
        LaplaceBeltrami.from_points(points_of(Sphere(), 100), order=1, condition="robin")


def test_an_operator_knows_its_points():
    """To float32 rounding; scaled, turned, moved or fewer ones are refused."""
    lb, points = built("points"), points_of(Ellipsoid(), 300)
    for same_points in (points, points.float(), points + 1e-8):
        lb.check_points(same_points)
    copy.deepcopy(lb).float().check_points(points)
    for stale in (2 * points, points.roll(1, 1), points + 0.01, points[:200], points[:, :2]):
        with pytest.raises(ValueError, match="build it again"):
            lb.check_points(stale)


def test_a_state_of_other_points_is_not_taken_in_silence():
    """Of another number of them or of as many in other places: a warning, and then it is the other operator."""
    model = torch.nn.ModuleDict({"lb": copy.deepcopy(built("points"))})
    model.load_state_dict(model.state_dict())
    for name, message in (("polyharmonic", "one on 300 others"), ("mesh", "one on 400 others")):
        with pytest.warns(UserWarning, match=f"operator on 300 points is replaced by {message}"):
            model.load_state_dict(torch.nn.ModuleDict({"lb": built(name)}).state_dict())
    assert model["lb"].num_points == 400


def test_collate_joins_operators_features_and_faces():
    """Rows of every point below each other, faces moved by the offsets, the rest as torch does."""
    shapes = [(built("mesh"), *mesh_of(Torus(), 400)), (disk(), *mesh_of(UnitDisk(), 150))]
    samples = [
        {"lb": lb, "x": x, "faces": faces, "label": i} for i, (lb, x, faces) in enumerate(shapes)
    ]
    batch = collate(samples)
    assert batch["lb"].sizes == (400, 150)
    assert torch.equal(batch["x"], torch.cat([x for _, x, _ in shapes]))
    assert torch.equal(batch["faces"], torch.cat([shapes[0][2], shapes[1][2] + 400]))
    assert batch["label"].tolist() == [0, 1]
    lb, x, y = collate([(lb, x, torch.ones(4)) for lb, x, _ in shapes])
    assert lb(x).shape == (550, 3)
    assert y.shape == (2, 4)
    with pytest.raises(ValueError, match="collate: expected samples"):
        collate([(1, 2), (3, 4)])
    for samples in ([{"lb": lb, "x": x}, {"lb": lb}], [(lb, x), (lb,)], [(lb, x), {"lb": lb}]):
        with pytest.raises(InputError, match="collate: expected tuples, or dicts with the same"):
            collate(samples)


def test_collate_knows_rows_of_faces_and_edges_and_names_the_key_that_it_cannot_join():
    Sample = namedtuple("Sample", "lb faces labels edges lengths")
    shapes = [(built("mesh"), mesh_of(Torus(), 400)[1]), (disk(), mesh_of(UnitDisk(), 150)[1])]
    samples = [Sample(lb, faces, faces[:, 0], faces[:9, :2], torch.ones(9)) for lb, faces in shapes]
    batch = collate(samples)
    assert isinstance(batch, Sample)
    assert torch.equal(batch.labels, torch.cat([faces[:, 0] for _, faces in shapes]))
    assert torch.equal(batch.edges, torch.cat([shapes[0][1][:9, :2], shapes[1][1][:9, :2] + 400]))
    assert torch.equal(batch.lengths, torch.ones(18))
    samples[1] = samples[1]._replace(lengths=torch.ones(8))
    with pytest.raises(InputError, match="collate: 'lengths' has neither a row for each point"):
        collate(samples)


# Input


def test_positions_that_require_gradients_are_told_once_a_build(tmp_path):
    """∂/∂v Σ Δ_ij v_j is Δᵀ1 alone: the operator is a constant, and the warning says so; f may require gradients."""
    vertices, faces = Sphere().mesh(60)
    vertices.requires_grad_()
    builds = {
        "vertices": [
            lambda v: LaplaceBeltrami.from_cotangent(v, faces),
            lambda v: load_or_build(v, faces, cache=tmp_path, order=1),
            lambda v: load_or_build(v, faces, cache=tmp_path, order=1),  # out of the cache
        ],
    }
    for name, calls in builds.items():
        for build in calls:
            with pytest.warns(
                UserWarning, match=rf"{name}: they require .* pass {name}\.detach"
            ) as told:
                lb = build(vertices)
            assert sum("require gradients" in str(warning.message) for warning in told) == 1
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.filterwarnings("ignore", "Sparse")
                build(vertices.detach())
                with torch.no_grad():
                    build(vertices)
            (gradient,) = torch.autograd.grad(lb(vertices).sum(), vertices)
            ones = torch.ones(60, 3, dtype=torch.float64)
            torch.testing.assert_close(gradient, torch.from_numpy(lb.to_scipy().T @ ones.numpy()))


def test_a_constructor_with_arguments_names_the_builders():
    with pytest.raises(TypeError, match=r"from_mesh\(vertices, faces\)"):
        LaplaceBeltrami(*Sphere().mesh(60))


def test_arrays_lists_and_integers_are_points():
    points = points_of(Sphere(), 100)
    expected = LaplaceBeltrami.from_points(points, order=1)
    for given in (points.numpy(), points.clone().requires_grad_()):
        same(LaplaceBeltrami.from_points(given, order=1).stencil.values, expected.stencil.values)
    listed = LaplaceBeltrami.from_points(points.tolist(), order=1)
    assert listed.dtype == torch.get_default_dtype()
    rounded = LaplaceBeltrami.from_points((points * 1000).round().int(), order=1)
    assert rounded.dtype == torch.get_default_dtype()
    single = LaplaceBeltrami.from_points(points.float(), order=1)
    assert single.dtype == torch.float32


@pytest.mark.parametrize("surface", [Torus(), Ellipsoid(), Circle()])
def test_given_normals_with_random_signs_are_those_without(surface):
    """Neighbours agree, all face out as they do without, and the operator is that of the exact normals."""
    points = points_of(surface, 300)
    exact = surface.normals(points)
    sign = torch.where(torch.rand(300, generator=torch.manual_seed(1)) < 0.5, -1.0, 1.0)[:, None]
    with pytest.warns(UserWarning, match="signs at 300 points contradict"):
        lb = LaplaceBeltrami.from_points(points, normals=exact * sign, order=2)
    assert ((lb.normals * exact).sum(1) > 0.9).all()
    given = -exact
    given[[7, 8, 100]] *= -1
    with pytest.warns(UserWarning, match=r"3 face the other way .* \(7, 8, 100\) and are turned"):
        inward = LaplaceBeltrami.from_points(points, normals=given, order=2)
    assert ((inward.normals * exact).sum(1) < -0.9).all()
    same(lb.mass, inward.mass)


def test_given_normals_decide_the_orientation():
    points = points_of(Sphere(), 200)
    lb = LaplaceBeltrami.from_points(points, order=1, normals=-3 * points)
    assert ((lb.normals * points).sum(1) < 0).all()


def test_initial_frames_are_kept_at_normal_order_zero():
    points = points_of(Sphere(), 300)
    lb = LaplaceBeltrami.from_points(points, normal_order=0, normals=points)
    same(lb.normals, points)
    assert (lb.report.normal_order == 0).all()


def test_num_neighbors_is_the_size_of_every_stencil():
    lb = LaplaceBeltrami.from_points(points_of(Sphere(), 300), num_neighbors=33)
    assert (lb.report.num_neighbors == 33).all()
    assert (lb.stencil.crow.diff() == 33).all()


# Invariances


def invariant_cases():
    points, (vertices, faces) = points_of(Ellipsoid(), 400), mesh_of(Torus(), 400)
    yield points, lambda x: LaplaceBeltrami.from_points(x)
    yield points, lambda x: LaplaceBeltrami.from_points(x, projection="normal", order=2)
    yield points, lambda x: LaplaceBeltrami.from_points(x, weights="polyharmonic")
    yield vertices, lambda x: LaplaceBeltrami.from_mesh(x, faces, order=2)
    yield vertices, lambda x: LaplaceBeltrami.from_cotangent(x, faces)
    four = points_of(CliffordTorus(), 400)
    yield four, lambda x: LaplaceBeltrami.from_points(x, dim=2, order=1)


INVARIANT = ["points", "normal", "polyharmonic", "mesh", "cotangent", "clifford"]


@pytest.fixture(params=range(len(INVARIANT)), ids=INVARIANT)
def case(request):
    return list(invariant_cases())[request.param]


def tolerance_of(lb):
    """The saddle system of the splines has a condition of about 1e7 at these sizes."""
    return 1e-6 if lb.options.get("weights") == "polyharmonic" else 1e-9


def test_rigid_motions_leave_the_matrix_and_turn_the_gradient(case):
    """L(Rx + t) = L(x), ∇ → R∇, mass as it was."""
    points, build = case
    turn = torch.linalg.qr(torch.randn(points.shape[1], points.shape[1]).double())[0]
    one, other = build(points), build(points @ turn.T + torch.randn(points.shape[1]).double())
    same(dense(other), dense(one), tolerance_of(one))
    same(other.mass, one.mass, tolerance_of(one))
    f = smooth_function(points)
    same(other.gradient(f), one.gradient(f) @ turn.T, tolerance_of(one))


@pytest.mark.parametrize("scale", [1e-3, 1e3, 2.0**-50, 2.0**50])
def test_scaling(case, scale):
    """x → s x: Δ scales by s⁻², ∇ by s⁻¹, mass by s², Δx by s⁻¹."""
    points, build = case
    one, other = build(points), build(scale * points)
    same(dense(other) * scale**2, dense(one), tolerance_of(one))
    f = smooth_function(points)
    same(other.gradient(f) * scale, one.gradient(f), tolerance_of(one))
    same(other.mass / scale**2, one.mass, tolerance_of(one))
    bend = one.mean_curvature_normal()
    same(other.mean_curvature_normal() * scale, bend, 100 * tolerance_of(one))


def test_permuted_points_permute_the_matrix(case):
    points, build = case
    if "faces" in build.__code__.co_freevars:
        pytest.skip("faces are permuted in a test of their own")
    order = torch.randperm(len(points))
    one, other = build(points), build(points[order])
    same(dense(other), dense(one)[order][:, order], tolerance_of(one))
    same(other.mass, one.mass[order], tolerance_of(one))


@pytest.mark.parametrize("build", [LaplaceBeltrami.from_mesh, LaplaceBeltrami.from_cotangent])
def test_order_of_vertices_faces_and_corners_is_irrelevant(build):
    vertices, faces = mesh_of(Torus(), 400)
    order = torch.randperm(400)
    place = order.argsort()
    shuffled = place[faces][torch.randperm(len(faces))].roll(1, dims=1)
    one, other = build(vertices, faces), build(vertices[order], shuffled)
    same(dense(other), dense(one)[order][:, order], 1e-9)
    same(other.mass, one.mass[order], 1e-9)


def test_orientation_of_the_faces_is_irrelevant_but_for_the_normals():
    vertices, faces = mesh_of(Torus(), 400)
    one = LaplaceBeltrami.from_mesh(vertices, faces)
    other = LaplaceBeltrami.from_mesh(vertices, faces[:, [1, 0, 2]])
    same(dense(other), dense(one), 1e-9)
    same(other.normals, -one.normals, 1e-9)


# Accuracy


def test_from_cotangent_is_libigl():
    """M⁻¹C with igl.cotmatrix and the Voronoi mass, entry by entry."""
    vertices, faces = mesh_of(Torus(), 400)
    lb = built("cotangent")
    points, corners = vertices.numpy(), faces.numpy()
    mass = igl.massmatrix(points, corners, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    np.testing.assert_array_equal(lb.mass.numpy(), mass)
    expected = igl.cotmatrix(points, corners).toarray() / mass[:, None]
    np.testing.assert_allclose(dense(lb).numpy(), expected, rtol=1e-14, atol=0)


@pytest.mark.parametrize("surface", [Ellipsoid(), Torus()], ids=["ellipsoid", "torus"])
def test_gradient_divergence_and_mean_curvature(surface):
    """Against the exact ones at N = 2000, p = 3: 5e-4 for ∇f, 1e-2 for div ∇f and Δx (relative l2)."""
    points = points_of(surface, 2000)
    lb = LaplaceBeltrami.from_points(points, order=3)
    exact = surface.gradient(smooth_function, points)
    assert relative(lb.gradient(smooth_function(points)), exact) <= 5e-4
    assert relative(lb.divergence(exact), surface.laplacian(smooth_function, points)) <= 1e-2
    bend = surface.mean_curvature_normal(points)
    assert relative(lb.mean_curvature_normal(), bend) <= 1e-2


@pytest.mark.parametrize("name", ["points", "mesh", "polyharmonic", "curve", "clifford"])
def test_divergence_of_the_position_is_the_dimension(name):
    """Σ_c E_c·∂_c x = d exactly for straight projection, whose coordinates are linear in x.

    Low-order rows fit first derivatives, and are left out.
    """
    lb = built(name)
    fitted = lb.report.order > 0
    assert fitted.double().mean() > 0.9
    expected = torch.full((int(fitted.sum()),), float(lb.dim), dtype=torch.float64)
    same(lb.divergence(lb.points)[fitted], expected, 1e-8)


def test_hessian_on_the_sphere():
    """∇²z = −z g, to 1e-4 at N = 2000, p = 3."""
    points = points_of(Sphere(), 2000)
    lb = LaplaceBeltrami.from_points(points, order=3)
    exact = -points[:, 2, None, None] * torch.eye(2)
    assert (lb.hessian(points[:, 2]) - exact).abs().max() <= 1e-4


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("projection", "order", "bound"),
    [("tangent", 3, 5.2e-5), ("tangent", 5, 6.7e-7), ("normal", 3, 4e-4), ("normal", 5, 2.4e-5)],
)
def test_accuracy_on_the_sphere(projection, order, bound):
    """Relative l2 error of Δf on 4070 quasi-uniform points."""
    points = points_of(Sphere(), 4070)
    lb = LaplaceBeltrami.from_points(points, order=order, projection=projection)
    exact = Sphere().laplacian(smooth_function, points)
    assert relative(lb(smooth_function(points)), exact) <= bound


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("projection", "order", "bound"),
    [("tangent", 3, 6e-5), ("tangent", 5, 2e-7), ("normal", 5, 2e-5)],
)
def test_accuracy_on_the_nodes_of_deserno(projection, order, bound):
    """Relative l2 error of Δ Y_5^4 = −30 Y_5^4 on 8038 points."""
    points = deserno_points(8000)
    harmonic = spherical_harmonic(5, 4)(points)
    lb = LaplaceBeltrami.from_points(points, order=order, projection=projection)
    assert relative(lb(harmonic), -30 * harmonic) <= bound


def test_small_shapes_take_one_thread_and_leave_the_number_as_it_was(monkeypatch):
    """Of torch's, which spreads products that are not worth it; also where the build raises."""
    seen, product = [], torch.linalg.pinv
    monkeypatch.setattr(
        torch.linalg,
        "pinv",
        lambda *a, **b: (seen.append(torch.get_num_threads()), product(*a, **b))[1],
    )
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        LaplaceBeltrami.from_mesh(*Sphere().mesh(100)).eigenbasis(5)
        assert torch.get_num_threads() == 2
        assert set(seen) == {1}
    finally:
        torch.set_num_threads(before)


@pytest.fixture
def two_threads():
    """Torch with two threads, as a user has them."""
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


def robin():
    return LaplaceBeltrami.from_mesh(*mesh_of(UnitDisk(), 200), condition=Robin(2.0))


@pytest.mark.parametrize("kind", [*BUILDERS, "robin"])
def test_with_two_threads_operators_are_those_of_one(kind, two_threads):
    """The weak pair is computed beside the stencils then."""
    build = robin if kind == "robin" else BUILDERS[kind][1]
    found = build().state_dict()
    torch.set_num_threads(1)
    expected = build().state_dict()
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(found[name], value, rtol=0, atol=0, equal_nan=True)


def test_an_error_beside_the_stencils_is_raised(two_threads, monkeypatch):
    """Of the weak pair, computed in a thread of its own."""
    threads = []

    def fail(*_):
        threads.append(threading.current_thread())
        raise InputError("of the pair")

    monkeypatch.setattr("torchlb.operator.build.mesh_pair", fail)
    with pytest.raises(InputError, match="of the pair"):
        LaplaceBeltrami.from_mesh(*Sphere().mesh(100))
    assert threads != [threading.main_thread()]
