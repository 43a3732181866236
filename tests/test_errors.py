"""Every bad input is refused with what came, where, and what to do."""

import re
import warnings
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import Delaunay

import torchlb
from torchlb import LaplaceBeltrami, clean_mesh, clean_points
from torchlb.cloud.doubts import warn_of_near_duplicates
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.operator.checks import check_dimension, mended_faces
from torchlb.operator.cleaning import turned_faces
from torchlb.surfaces import CliffordTorus, Sphere

POINTS = Sphere().points(100)
VERTICES, FACES = Sphere().mesh(100)


def spoiled(index, value):
    points = POINTS.clone()
    points[index] = value
    return points


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (spoiled(17, float("nan")), "1 are NaN or infinite \\(17\\)"),
        (POINTS[0], "expected shape \\(N, n\\), got \\(3,\\)"),
        (torch.zeros(0, 3), "got none"),
        ("a file name", "expected an \\(N, n\\) tensor or array"),
        (POINTS > 0, "expected real numbers"),
        (spoiled(3, POINTS[5]), "such as 3, 5 .*remove duplicates"),
        (spoiled(3, POINTS[5] + 1e-14), "such as 3, 5 .*remove duplicates"),
        (POINTS.T, "shape \\(3, 100\\) is 3 points in R\\^100.*points.T"),
        (POINTS * 0 + 1, "all 100 share one place; remove duplicates"),
        (POINTS * 1e160, "extend over .*rescale"),
        (POINTS * 1e-160, "extend over .*rescale"),
        (POINTS[:3], "3 points are fewer than the 4 that a surface .*add points"),
    ],
)
def test_bad_points(points, message):
    with pytest.raises(ValueError, match=message):
        LaplaceBeltrami.from_points(points)


def test_a_mesh_in_the_place_of_points(unchecked):
    with pytest.raises(TypeError, match=r"points alone.*from_mesh\(vertices, faces\)"):
        LaplaceBeltrami.from_points(VERTICES, FACES)


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (FACES.double(), "expected integers.*vertices come first"),
        (FACES[:, 0], "expected shape \\(F, 3\\)"),
        (FACES[:0], "got none; use LaplaceBeltrami.from_points"),
        (FACES + 1, "outside 0 … 99.*subtract 1"),
        (FACES - 1, "outside 0 … 99"),
        (FACES[(FACES != 7).all(1)], "1 vertices \\(7\\) belong to no face.*clean_mesh"),
    ],
)
def test_bad_faces(faces, message):
    for build in (LaplaceBeltrami.from_mesh, LaplaceBeltrami.from_cotangent):
        with pytest.raises(ValueError, match=message):
            build(VERTICES, faces)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"projection": "orthogonal"}, "projection: expected one of"),
        ({"weights": "rbf"}, "weights: expected one of"),
        ({"order": 0}, "order: expected an integer ≥ 1"),
        ({"order": 2.5}, "order: expected an integer, got 2.5"),
        ({"order": "3"}, "order: expected an integer, got '3'"),
        ({"dim": 1.5}, "dim: expected an integer"),
        ({"normal_order": -1}, "normal_order"),
        ({"num_neighbors": 20.5}, "num_neighbors: expected an integer"),
        ({"num_neighbors": 101}, "num_neighbors: 101 are more than the 100 points"),
        ({"num_neighbors": 14}, "num_neighbors: order 3 in 2 dimensions has 15 polynomials"),
        ({"dim": 4}, "dim: expected 1 … 3"),
        ({"normals": POINTS[:50]}, "normals: expected the shape of points"),
        ({"normals": 0 * POINTS}, "normals: 100 are zero"),
    ],
)
def test_bad_options(options, message, unchecked):
    with pytest.raises(ValueError, match=message):
        LaplaceBeltrami.from_points(POINTS, **options)


def test_normals_are_for_hypersurfaces():
    points = CliffordTorus().points(100)
    with pytest.raises(ValueError, match="only hypersurfaces"):
        LaplaceBeltrami.from_points(points, dim=2, normals=points)


def test_cotangent_needs_triangles():
    with pytest.raises(ValueError, match="needs triangles"):
        LaplaceBeltrami.from_cotangent(VERTICES, FACES[:, :2])


def test_cotangent_needs_area():
    """A vertex in the middle of an edge, its only triangle flat: no area, or NaN."""
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [1, 1, 0]])
    with pytest.raises(ValueError, match=r"3 vertices \(1, 2, 3\) have no area"):
        LaplaceBeltrami.from_cotangent(vertices, torch.tensor([[0, 1, 2], [2, 1, 3]]))


@pytest.mark.parametrize("build", ["from_mesh", "from_cotangent"])
def test_triangles_without_area_are_no_surface(build):
    line = torch.linspace(0, 1, 5)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    faces = torch.arange(3)[:, None] + torch.arange(3)
    with pytest.raises(torchlb.InputError, match="none of the 3 triangles has an area"):
        getattr(LaplaceBeltrami, build)(line.double(), faces)


def test_coincident_vertices_of_a_mesh_are_named():
    """Two triangles that share an edge only in place, as in an STL file."""
    cut = torch.cat([VERTICES, VERTICES[FACES[0]]])
    faces = FACES.clone()
    faces[0] = torch.arange(100, 103)
    with pytest.warns(UserWarning, match="6 share a place with another .*clean_mesh"):
        LaplaceBeltrami.from_mesh(cut, faces)


def grid(size):
    """Points of the unit square, and its squares as faces of four corners."""
    steps = torch.linspace(0, 1, size, dtype=torch.float64)
    index = torch.arange(size**2).view(size, size)
    corners = (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    return torch.cartesian_prod(steps, steps), torch.stack(corners, -1).view(-1, 4)


@pytest.mark.parametrize(
    ("points", "dim", "remedy"),
    [
        (lambda: grid(12)[0], 2, "pass dim=2"),
        (lambda: torch.rand(200, 2), 2, "pass dim=2"),
        (lambda: CliffordTorus().points(200), 2, "pass dim=2"),
        (lambda: torch.cat([POINTS, POINTS, POINTS[:, :1]], 1).repeat_interleave(3, 0), 2, ":3"),
        (
            lambda: torch.cat([Sphere().points(300), torch.rand(300, 1)], 1),
            2,
            r"pass points\[:, :3\]",
        ),
    ],
    ids=["grid", "random square", "surface in R⁴", "normals", "random attribute"],
)
def test_a_dimension_other_than_n_minus_1_is_asked_for(points, dim, remedy):
    with pytest.raises(ValueError, match=f"like one of dimension {dim}.*{remedy}"):
        check_dimension(points().double(), None)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_a_hypersurface_needs_no_dim(n):
    """The unit sphere of R^n, at random points."""
    points = torch.nn.functional.normalize(torch.randn(600, n, dtype=torch.float64))
    assert check_dimension(points, None) == n - 1
    assert check_dimension(points, 1) == 1


@pytest.mark.parametrize("dtype", [torch.bool, torch.int8, torch.int64, torch.float32])
def test_features_of_any_type_are_not_rounded(dtype, unchecked):
    lb = LaplaceBeltrami.from_points(POINTS)
    f = (3 * POINTS[:, 0]).to(dtype)
    torch.testing.assert_close(lb(f), lb(f.double()))


def test_lists_are_no_features(unchecked):
    with pytest.raises(TypeError, match=r"torch.as_tensor\(f\) makes one"):
        LaplaceBeltrami.from_points(POINTS)(POINTS.tolist())


@pytest.mark.parametrize("shape", [(99,), (99, 2), (2, 99, 2), (1, 1, 100, 2)])
def test_forward_refuses_wrong_sizes(shape):
    lb = LaplaceBeltrami.from_points(POINTS)
    with pytest.raises((ValueError, RuntimeError), match="N = 100"):
        lb(torch.zeros(shape).double())


def test_clean_mesh_is_the_remedy_that_the_error_names():
    faces = FACES[(FACES != 7).all(1)]
    vertices, faces, kept = clean_mesh(VERTICES, faces)
    assert len(vertices) == 99
    assert 7 not in kept.tolist()
    assert torch.equal(vertices, VERTICES[kept])
    assert LaplaceBeltrami.from_mesh(vertices, faces).num_points == 99


def _twice(points, kind):
    generator = torch.Generator().manual_seed(0)
    shift = torch.randn(len(points), 3, generator=generator, dtype=points.dtype)
    if kind == "crowd":
        return torch.cat([points, points[300] + 1e-6 * shift[:40]])
    cap = points[:, 2] > 0.5
    apart = {"along": 1e-6 * shift, "off": 1e-3 * shift, "normal": 1e-4 * points}[kind]
    return torch.cat([points, (points + apart)[cap]])


@pytest.mark.parametrize("kind", ["along", "off", "normal", "crowd"])
@pytest.mark.parametrize("cloud", ["points", "random_points"])
def test_near_duplicates_are_told_and_the_remedy_brings_the_cloud_back(cloud, kind):
    points = getattr(Sphere(), cloud)(1000)
    doubled = _twice(points, kind)
    neighbors = nearest_neighbors(doubled, 24)
    with pytest.warns(UserWarning, match="far closer to another than to those around") as told:
        warn_of_near_duplicates(doubled, neighbors, 2)
    tolerance = float(re.findall(r"clean_points\(points, (.*)\)", str(told[0].message))[0])
    merged, kept = clean_points(doubled, tolerance)
    assert abs(len(merged) - 1000) <= 10  # at random, some of the thousand are as close
    torch.testing.assert_close(merged, doubled[kept])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_near_duplicates(merged, nearest_neighbors(merged, 24), 2)


@pytest.mark.parametrize("seed", range(3))
def test_points_that_chance_brings_together_are_no_near_duplicates(seed):
    """The closest two of N are at 1/√N of the spacing or so, also where the density changes by 1 : 50."""
    generator = np.random.default_rng(seed)
    points = Sphere().random_points(40000, seed=seed)
    weight = 50 ** ((points[:, 2].numpy() + 1) / 2)
    uneven = points[generator.choice(40000, 3000, replace=False, p=weight / weight.sum())]
    warnings.simplefilter("error")
    noisy = points[:3000] + 0.03 * torch.from_numpy(generator.standard_normal((3000, 3)))
    for cloud in (points[:3000], uneven, noisy, points[:40]):
        warn_of_near_duplicates(cloud, nearest_neighbors(cloud, min(24, len(cloud))), 2)


def test_a_cloud_scanned_twice_in_part_is_told():
    with pytest.warns(UserWarning, match="are far closer to another"):
        LaplaceBeltrami.from_points(_twice(Sphere().points(1000), "normal"))


def test_clean_points_is_the_remedy_that_the_error_names():
    doubled = torch.cat([POINTS, POINTS[:10], POINTS[5:10]])
    points, kept = clean_points(doubled)
    assert torch.equal(points, POINTS)
    assert kept.tolist() == list(range(100))


@pytest.mark.parametrize(
    ("faces", "message"), [(FACES.double(), "integers"), (FACES - 1, "outside 0 … 99")]
)
def test_cleaning_takes_what_the_operator_would(faces, message):
    with pytest.raises(ValueError, match=message):
        clean_mesh(VERTICES, faces)
    with pytest.raises(ValueError, match="1 are NaN or infinite \\(3\\)"):
        clean_points(spoiled(3, torch.nan))


def test_cotangents_of_a_triangle_without_area_are_refused():
    """A T-junction, closed by a triangle whose corners are on a line: its vertices have areas, from the others."""
    vertices = torch.tensor([[0.0, 0], [1, 0], [2, 0], [1, 1], [1, -1]], dtype=torch.float64)
    faces = torch.tensor([[0, 2, 3], [0, 1, 2], [0, 4, 1], [1, 4, 2]])
    with pytest.raises(ValueError, match=r"3 vertices \(0, 1, 2\) have no area.*from_mesh"):
        LaplaceBeltrami.from_cotangent(vertices, faces)


def test_quads_are_named_and_split():
    """A quad mesh of a curved square: an error, and its triangles after `clean_mesh`."""
    flat, quads = grid(9)
    points = torch.cat([flat, (flat**2).sum(1, keepdim=True)], 1)
    for faces in (quads, quads.int().tolist()):
        with pytest.raises(ValueError, match=r"look like quads.*clean_mesh"):
            LaplaceBeltrami.from_mesh(points, faces)
    vertices, faces, kept = clean_mesh(points, quads)
    assert (tuple(faces.shape), kept.tolist()) == ((128, 3), list(range(81)))
    sides = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    area = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1).sum() / 2
    assert float(area) == pytest.approx(1.8616, rel=0.01)  # ∫ (1 + 4x² + 4y²)^½


def test_a_quad_that_repeats_a_corner_is_a_triangle():
    _, faces, _ = clean_mesh(torch.eye(4), torch.tensor([[0, 1, 2, 3], [0, 1, 2, 2]]))
    assert sorted(faces.sort(1).values.tolist()) == [[0, 1, 2], [0, 2, 3]]


def test_tetrahedra_stay_what_they_are():
    points = torch.rand(60, 3, dtype=torch.float64)
    simplices = torch.from_numpy(Delaunay(points).simplices.astype(np.int64))
    thin = points * torch.tensor([1, 1, 0.02])
    for vertices in (points, thin):
        assert torch.equal(mended_faces(vertices, simplices), simplices)
        assert torch.equal(clean_mesh(vertices, simplices)[1], simplices)


@pytest.mark.parametrize("copies", [FACES[:20], FACES, FACES.flip(1)], ids=["20", "all", "turned"])
def test_a_face_counts_once(copies):
    """The operator of a mesh with doubled faces is that of the mesh, and the warning counts them."""
    plain = LaplaceBeltrami.from_mesh(VERTICES, FACES, order=1)
    doubled = torch.cat([FACES, copies])
    for build, expected in (
        (lambda f: LaplaceBeltrami.from_mesh(VERTICES, f, order=1), plain),
        (
            lambda f: LaplaceBeltrami.from_cotangent(VERTICES, f),
            LaplaceBeltrami.from_cotangent(VERTICES, FACES),
        ),
    ):
        with pytest.warns(UserWarning, match=f"{len(copies)} have the corners of an earlier one"):
            lb = build(doubled)
        assert torch.equal(lb.stencil.values[0], expected.stencil.values[0])
        assert torch.equal(lb.mass, expected.mass)
    assert torch.equal(clean_mesh(VERTICES, doubled)[1], FACES)


def test_faces_are_wound_alike():
    """With 30 of 196 triangles turned round the normals are those of the mesh, and a warning counts them."""
    turned = torch.zeros(len(FACES), dtype=torch.bool)
    turned[torch.randperm(len(FACES))[:30]] = True
    mixed = torch.where(turned[:, None], FACES.flip(1), FACES)
    assert torch.equal(turned_faces(mixed), turned)
    with pytest.warns(UserWarning, match="30 are wound against their neighbours"):
        lb = LaplaceBeltrami.from_mesh(VERTICES, mixed, order=1)
    assert torch.equal(lb.normals, LaplaceBeltrami.from_mesh(VERTICES, FACES, order=1).normals)
    assert torch.equal(clean_mesh(VERTICES, mixed)[1], FACES)


def test_one_side_is_left_alone():
    """A Möbius band of 20 squares cannot be wound alike; a sphere beside it can."""
    i = 2 * torch.arange(20)
    band = torch.stack([i, i + 1, i + 2, i + 2, i + 1, i + 3], 1).view(-1, 3)
    band = torch.where(band >= 40, 81 - band, band)
    assert not turned_faces(band).any()
    mixed = torch.cat([band, FACES + 40, FACES[:1].flip(1) + 40])[: len(band) + len(FACES)]
    mixed[-1] = mixed[-1].flip(0)
    assert turned_faces(mixed).nonzero().tolist() == [[len(mixed) - 1]]


def test_any_byte_order_and_stride():
    """Faces of FreeSurfer are big-endian."""
    vertices, faces = VERTICES.numpy().astype(">f8"), FACES.numpy().astype(">i4")
    lb = LaplaceBeltrami.from_mesh(vertices[:, ::-1][:, ::-1], faces, order=1)
    assert torch.equal(
        lb.stencil.values[0], LaplaceBeltrami.from_mesh(VERTICES, FACES, order=1).stencil.values[0]
    )
    assert torch.equal(clean_mesh(vertices, faces)[1], FACES.int())


def test_rounding_far_from_zero_is_named():
    far = (POINTS + 1e5).float()
    with pytest.warns(UserWarning, match="float32 has steps of 0.012.*centre"):
        LaplaceBeltrami.from_points(far, order=1)


def test_numpy_arrays_and_int32_faces_are_welcome():
    lb = LaplaceBeltrami.from_mesh(VERTICES.numpy(), FACES.numpy().astype(np.int32))
    assert torch.equal(
        lb.stencil.values[0], LaplaceBeltrami.from_mesh(VERTICES, FACES).stencil.values[0]
    )


def test_a_creased_mesh_falls_below_its_order_and_says_why():
    """A box has no tangent plane at its edges: every row is valid all the same, and the report names the reasons."""
    box = trimesh.creation.box().subdivide().subdivide().subdivide()
    lb = LaplaceBeltrami.from_mesh(
        np.array(box.vertices), np.array(box.faces), order=3, certify=True
    )
    report = lb.report
    assert sum(report.order_counts.values()) == len(box.vertices)
    assert 0 < report.order_counts[3] < len(box.vertices)
    assert sum(report.reason_counts.values()) == int((report.order < 3).sum())
    assert "why below the requested order" in str(report)
    matrix = lb.matrix.to_dense()
    assert matrix.isfinite().all()
    assert (matrix.diagonal() < 0).all()
    assert lb.certificate.holds


@pytest.mark.parametrize("build", ["from_mesh", "from_points"])
@pytest.mark.parametrize("name", ["tetrahedron", "box", "icosahedron"])
def test_small_shapes_have_low_order_rows(name, build):
    """Fewer points than polynomials of order 3: eigenvalues 0 < λ_1, …, the triple 2 of the icosahedron 38 % larger.

    That is what flat triangles, whose corners no plane is near, have with their full mass.
    """
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    mesh = {
        "tetrahedron": trimesh.Trimesh(corners).convex_hull,
        "box": trimesh.creation.box(),
        "icosahedron": trimesh.creation.icosahedron(),
    }[name]
    arrays = np.array(mesh.vertices), np.array(mesh.faces)
    lb = getattr(LaplaceBeltrami, build)(*arrays[: 1 + (build == "from_mesh")], certify=True)
    assert lb.certificate.holds
    assert lb.report.order_counts[0] == len(arrays[0])
    values = lb.eigenbasis(4).eigenvalues
    assert abs(values[0]) < 1e-9
    assert values[1] > 0.1
    if name == "icosahedron":
        assert (values[1:] / 2 - 1).abs().max() < 0.4


def test_few_points_elsewhere_name_an_order():
    """Of a surface in R⁴, which has no such rows."""
    points = CliffordTorus().points(100)[:12]
    with pytest.raises(ValueError, match=r"12 points are fewer than the 15 .*lower `order` to 2"):
        LaplaceBeltrami.from_points(points, dim=2)


def test_public_names():
    assert set(torchlb.__all__) <= set(dir(torchlb))


def test_features_in_the_place_of_operators_are_named(unchecked):
    """So are lists of shapes, for which there are batches."""
    lb, f = LaplaceBeltrami.from_cotangent(VERTICES, FACES).float(), VERTICES.float()
    net = torchlb.DiffusionNet(3, 2, k=8)
    for features, operator in ((lb, f), ([f], [lb]), (f, f.numpy())):
        with pytest.raises(TypeError, match=r"functions take \(lb, f\), layers \(x, lb\).*batch"):
            net(features, operator)
    for shapes in (lb, [lb, 1], [f]):
        with pytest.raises(TypeError, match="sequence of operators"):
            LaplaceBeltrami.batch(shapes)


SWAPPED = {
    "heat_flow": lambda lb, v, path: torchlb.heat_flow(v, lb, 0.1),
    "heat_flow, time": lambda lb, v, path: torchlb.heat_flow(lb, 0.1, v),
    "smooth": lambda lb, v, path: torchlb.smooth(lb, 0.1, v),
    "implicit_step": lambda lb, v, path: torchlb.implicit_step(v, lb, 0.1),
    "poisson_solve": lambda lb, v, path: torchlb.poisson_solve(v, lb),
    "geodesic_distance": lambda lb, v, path: torchlb.geodesic_distance(0, lb),
    "vector_heat_flow": lambda lb, v, path: torchlb.vector_heat_flow(v, lb, 0.1),
    "parallel_transport": lambda lb, v, path: torchlb.parallel_transport(0, lb, v[0]),
    "parallel_transport, sources": lambda lb, v, path: torchlb.parallel_transport(lb, v[0], 0),
    "parallel_transport, list": lambda lb, v, path: torchlb.parallel_transport(lb, 0, [1.0, 0, 0]),
    "logarithmic_map": lambda lb, v, path: torchlb.logarithmic_map(0, lb),
    "hodge_decomposition": lambda lb, v, path: torchlb.hodge_decomposition(v, lb),
    "hodge_decomposition, list": lambda lb, v, path: torchlb.hodge_decomposition(lb, [1.0]),
    "components": lambda lb, v, path: lb.connection.components(lb),
    "vectors": lambda lb, v, path: lb.connection.vectors(v),
    "signature": lambda lb, v, path: torchlb.heat_kernel_signature(v, lb),
    "diffusion_distance": lambda lb, v, path: torchlb.diffusion_distance(0, lb, 0.1),
    "product": lambda lb, v, path: lb.product(v, "mass"),
    "to_scipy": lambda lb, v, path: lb.to_scipy(v),
    "eigenbasis": lambda lb, v, path: lb.eigenbasis(v),
    "weak_matrices": lambda lb, v, path: torchlb.interop.conventions.weak_matrices("igl", lb),
    "from_mesh": lambda lb, v, path: LaplaceBeltrami.from_mesh(FACES, VERTICES),
    "clean_mesh": lambda lb, v, path: torchlb.clean_mesh(FACES, VERTICES),
    "submesh": lambda lb, v, path: torchlb.submesh(FACES, VERTICES, VERTICES[:, 0] > 0),
    "submesh, mask": lambda lb, v, path: torchlb.submesh(VERTICES, VERTICES[:, 0] > 0, FACES),
    "submesh, operator": lambda lb, v, path: torchlb.submesh(lb, FACES, VERTICES[:, 0] > 0),
    "collate": lambda lb, v, path: torchlb.collate(lb),
    "write_shape": lambda lb, v, path: torchlb.write_shape(VERTICES, path, FACES),
    "write_shape, faces": lambda lb, v, path: torchlb.write_shape(path, FACES, VERTICES),
    "read_shape": lambda lb, v, path: torchlb.read_shape(VERTICES),
    "save_operator": lambda lb, v, path: torchlb.save_operator(path, lb),
    "load_operator": lambda lb, v, path: torchlb.load_operator(lb),
    "precompute_operators": lambda lb, v, path: torchlb.precompute_operators(path, [VERTICES]),
    "plot_surface": lambda lb, v, path: torchlb.plot.plot_surface(VERTICES, v, FACES),
    "plot_surface, operator": lambda lb, v, path: torchlb.plot.plot_surface(lb, FACES, v[:, 0]),
    "plot_vectors": lambda lb, v, path: torchlb.plot.plot_vectors(VERTICES, v, FACES),
    "to_trimesh": lambda lb, v, path: torchlb.interop.trimesh.to_trimesh(VERTICES),
    "to_operator": lambda lb, v, path: torchlb.interop.pyg.to_operator(lb),
    "tangent layer": lambda lb, v, path: torchlb.TangentDiffusion(3)(lb, v),
}


@cache
def first_order():
    return LaplaceBeltrami.from_mesh(VERTICES, FACES, order=1)


@pytest.mark.parametrize("name", SWAPPED)
def test_a_wrong_order_of_arguments_is_an_error_of_input(unchecked, tmp_path, name):
    """It says in some lines what was expected, and prints no tensors."""
    lb = first_order()
    with pytest.raises(torchlb.InputError, match="expected") as told:
        SWAPPED[name](lb, VERTICES, tmp_path / "a.npz")
    assert len(str(told.value)) < 400


def test_errors_and_warnings_have_one_base_each():
    names = [getattr(torchlb, name) for name in torchlb.__all__]
    kinds = [kind for kind in names if isinstance(kind, type) and issubclass(kind, Exception)]
    for kind in kinds:
        base = torchlb.TorchlbWarning if issubclass(kind, Warning) else torchlb.TorchlbError
        assert issubclass(kind, base)


def test_arrays_are_welcome_as_times_and_scales(unchecked):
    lb, values = LaplaceBeltrami.from_cotangent(VERTICES, FACES), np.array([0.1, 0.2])
    for signature in (torchlb.heat_kernel_signature, torchlb.wave_kernel_signature):
        found, expected = (signature(lb, v, k=9) for v in (values, torch.from_numpy(values)))
        assert torch.equal(found, expected)
    wavelets = [
        torchlb.spectral_wavelets(lb, VERTICES, v, k=9) for v in (values, torch.from_numpy(values))
    ]
    assert torch.equal(*wavelets)


def test_a_condition_that_holds_nowhere_is_named():
    with pytest.warns(UserWarning, match=r"dirichlet.*nowhere.*leave the condition out"):
        LaplaceBeltrami.from_mesh(VERTICES, FACES, condition="dirichlet")


def test_a_shape_that_single_precision_cannot_hold_has_no_eigenbasis():
    lb = LaplaceBeltrami.from_cotangent(1e-25 * VERTICES, FACES)
    assert lb.eigenbasis(4).eigenvalues[1] > 1e49
    with pytest.raises(torchlb.EigenbasisError, match="scaled, or kept in float64"):
        LaplaceBeltrami.from_cotangent(1e-25 * VERTICES, FACES).float().eigenbasis(4)
