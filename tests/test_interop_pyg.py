"""PyG's own Batch and DataLoader keep the operator right: a batch is the shapes one by one."""

import copy
import functools

import pytest
import torch
import torch_geometric.transforms as T
from torch_geometric.data import Batch, Data
from torch_geometric.loader import DataLoader
from torch_geometric.nn import MessagePassing

from torchlb import Diffusion, DiffusionNet, InputError, LaplaceBeltrami, implicit_step
from torchlb.interop.pyg import LaplaceBeltramiTransform, to_operator
from torchlb.surfaces import Circle, Ellipsoid, Sphere, Torus, UnitDisk

MESHES = [Sphere().mesh(120), Ellipsoid().mesh(90), Torus().mesh(150)]
SIZES = [120, 90, 150]


def data_of(vertices, faces=None, **more):
    return Data(pos=vertices, face=None if faces is None else faces.T.contiguous(), **more)


@functools.cache
def direct(i, dtype=torch.float64):
    """Operator of mesh i, without PyG."""
    vertices, faces = MESHES[i]
    return LaplaceBeltrami.from_mesh(vertices.to(dtype), faces, order=1)


DATA = [data_of(*mesh) for mesh in MESHES]


def assert_same(ours, theirs, channels=3):
    """The products with everything that is stored, forward and backward."""
    f = torch.randn(theirs.num_points, channels, dtype=theirs.dtype)
    results = []
    for lb in (ours, theirs):
        g = f.clone().requires_grad_()
        (lb(g) ** 2 + lb.divergence(lb.gradient(g))).sum().backward()
        results.append([lb(f), lb.gradient(f), lb.mass, lb.frames, lb.normals, lb.points, g.grad])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b)
    assert (ours.sizes, ours.offsets, ours.dim) == (theirs.sizes, theirs.offsets, theirs.dim)
    assert ours.certificate == theirs.certificate
    for name in ("crow", "col", "crow_t", "col_t", "order_t"):
        assert torch.equal(getattr(ours.stencil, name), getattr(theirs.stencil, name)), name


@pytest.mark.parametrize("operator", ["stencil", "cotangent"])
def test_one_shape(operator):
    data = LaplaceBeltramiTransform(operator=operator)(DATA[0])
    build = getattr(LaplaceBeltrami, "from_mesh" if operator == "stencil" else "from_cotangent")
    theirs = build(*MESHES[0])
    assert_same(to_operator(data), theirs)
    assert repr(to_operator(data)) == repr(theirs)
    assert "lb_info" not in DATA[0]  # the given data is left alone


@pytest.mark.parametrize("float_type", [torch.float32, torch.float64])
def test_a_batch_is_the_shapes_one_by_one(float_type):
    transform = LaplaceBeltramiTransform(order=1)
    meshes = [(vertices.to(float_type), faces) for vertices, faces in MESHES]
    batch = Batch.from_data_list([transform(data_of(*mesh)) for mesh in meshes])
    single = [direct(i, float_type) for i in range(3)]
    lb = to_operator(batch)
    assert_same(lb, LaplaceBeltrami.batch(single))
    f = torch.randn(sum(SIZES), 2, dtype=float_type)
    torch.testing.assert_close(
        lb(f), torch.cat([one(g) for one, g in zip(single, f.split(SIZES), strict=True)])
    )
    for back, one in zip(batch.to_data_list(), single, strict=True):  # and apart again
        assert_same(to_operator(back), one)


@pytest.mark.parametrize("num_workers", [0, 1])
def test_pygs_loader(num_workers):
    """Shuffled batches, in this process and in a worker of the loader, with faces and labels beside the operator."""
    transform = LaplaceBeltramiTransform(order=1)
    shapes = []
    for i, data in enumerate(DATA):
        data.y = torch.tensor([i])
        shapes.append(transform(data))
    loader = DataLoader(shapes, batch_size=2, shuffle=True, num_workers=num_workers)
    seen = []
    for batch in loader:
        chosen = batch.y.tolist()
        single = [direct(i) for i in chosen]
        assert_same(to_operator(batch), LaplaceBeltrami.batch(single))
        assert int(batch.face.max()) == batch.num_nodes - 1
        seen += chosen
    assert sorted(seen) == [0, 1, 2]


@pytest.mark.parametrize("k", [6, 100])  # more than the smallest shape has points, too
def test_eigenbases_come_along(k, monkeypatch):
    transform = LaplaceBeltramiTransform(order=1, k=k)
    shapes = [transform(data) for data in DATA]
    single = [copy.deepcopy(direct(i)) for i in range(3)]
    for one in single:
        one.eigenbasis(k)
    batch, theirs = Batch.from_data_list(shapes), LaplaceBeltrami.batch(single)
    monkeypatch.setattr(
        "torchlb.operator.pair_methods.pencil_eigenbasis", None
    )  # nothing is solved
    lb = to_operator(batch)
    ours, expected = lb.eigenbasis(k), theirs.eigenbasis(k)
    torch.testing.assert_close(ours.eigenvalues, expected.eigenvalues)
    torch.testing.assert_close(ours.eigenvectors, expected.eigenvectors)
    one = to_operator(shapes[1]).eigenbasis(k)
    torch.testing.assert_close(one.eigenvectors, single[1].eigenbasis(k).eigenvectors)
    torch.testing.assert_close(lb.eigenbasis(k).left, theirs.eigenbasis(k).left)


@pytest.mark.parametrize("method", ["rational", "spectral"])
def test_layers_train_on_a_batch(method):
    batch = Batch.from_data_list([LaplaceBeltramiTransform(order=1, k=9)(d) for d in DATA])
    lb = to_operator(batch).float()
    net = DiffusionNet(3, 4, width=8, num_blocks=1, method=method, k=9)
    net(batch.pos.float(), lb).square().mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())
    f = torch.randn(batch.num_nodes, 2)
    layer = Diffusion(2, method=method, k=9)  # no eigenspace is cut
    apart = [layer(g, copy.deepcopy(direct(i)).float()) for i, g in enumerate(f.split(SIZES))]
    torch.testing.assert_close(layer(f, lb), torch.cat(apart), rtol=1e-3, atol=1e-4)


def test_messages_along_the_keys_are_the_laplacian():
    """Σ_j Δ_ij f_j by PyG's own message passing."""

    class Weighted(MessagePassing):
        def forward(self, x, edge_index, weight):
            return self.propagate(edge_index, x=x, weight=weight)

        def message(self, x_j, weight):
            return weight[:, None] * x_j

    batch = Batch.from_data_list([LaplaceBeltramiTransform(order=1)(d) for d in DATA])
    f = torch.randn(batch.num_nodes, 2).double()
    messages = Weighted(aggr="sum")(f, batch.lb_stencil_index, batch.lb_stencil_values[:, 0])
    torch.testing.assert_close(messages, to_operator(batch)(f), rtol=1e-9, atol=1e-7)


def test_clouds_their_normals_and_curves():
    points = Sphere().points(100)
    plain = LaplaceBeltramiTransform(order=1)
    assert_same(to_operator(plain(data_of(points))), LaplaceBeltrami.from_points(points, order=1))
    data = data_of(points, norm=-points)
    assert (to_operator(plain(data)).normals * points).sum(1).max() < 0
    other = data_of(points, normal=points)
    assert (to_operator(LaplaceBeltramiTransform(normals="normal")(other)).normals * points).sum(
        1
    ).min() > 0
    ignored = LaplaceBeltramiTransform(order=1, normals=None)(data)
    assert_same(to_operator(ignored), LaplaceBeltrami.from_points(points, order=1))
    assert (to_operator(plain(data)).curvatures().mean < 0).all()
    older = plain(data)
    del older["lb_shape_operators"]
    with pytest.raises(InputError, match="earlier version"):
        to_operator(older).curvatures()
    curves = [data_of(Circle().points(n)) for n in (20, 30)]
    lb = to_operator(Batch.from_data_list([plain(curve) for curve in curves]))
    assert (lb.dim, lb.sizes) == (1, (20, 30))


@pytest.mark.filterwarnings("ignore:condition='dirichlet' holds nowhere")
def test_closed_and_open_shapes_in_either_order():
    options = {"order": 1, "condition": "dirichlet"}
    meshes = [Sphere().mesh(40), UnitDisk().mesh(40)]
    shapes = [LaplaceBeltramiTransform(**options)(data_of(*mesh)) for mesh in meshes]
    lbs = [to_operator(data) for data in shapes]
    assert lbs[0].boundary is None
    f = torch.ones(80, dtype=torch.float64)
    for order in (slice(None), slice(None, None, -1)):
        lb, theirs = (
            to_operator(Batch.from_data_list(shapes[order])),
            LaplaceBeltrami.batch(lbs[order]),
        )
        assert torch.equal(lb.boundary, theirs.boundary)
        torch.testing.assert_close(implicit_step(lb, f, 0.1), implicit_step(theirs, f, 0.1))


def test_a_batch_has_faces_and_pairs_as_its_shapes_have_them():
    """Of a mesh and a cloud without either; the stencils then do the work of all."""
    mesh = LaplaceBeltramiTransform(order=1)(data_of(*MESHES[0]))
    del mesh.face
    cloud = LaplaceBeltramiTransform(order=1, weak_form=False)(data_of(Sphere().points(50)))
    for order in ([mesh, cloud], [cloud, mesh]):
        lb = to_operator(Batch.from_data_list(order))
        assert not lb._has_weak_form
        assert len(lb.faces) == sum(len(to_operator(data).faces) for data in order)


def test_in_a_compose_and_from_a_cache(tmp_path):
    transform = T.Compose([T.Center(), LaplaceBeltramiTransform(order=1, cache=tmp_path, k=4)])
    first, again = transform(DATA[0]), transform(DATA[0])
    assert len(list(tmp_path.iterdir())) == 1
    assert torch.equal(first.lb_basis, again.lb_basis)
    assert_same(to_operator(again), to_operator(first))
    assert "order=1" in repr(transform)


def test_the_keys_survive_a_file(tmp_path):
    data = LaplaceBeltramiTransform(order=1, k=4)(DATA[0])
    torch.save(data, tmp_path / "data.pt")
    back = torch.load(tmp_path / "data.pt", weights_only=False)
    assert_same(to_operator(back), to_operator(data))


@pytest.mark.parametrize("key", ["norm", "normal"])
def test_the_normals_that_pyg_writes_are_used(key):
    points = Sphere().points(100)
    lb = to_operator(LaplaceBeltramiTransform(order=1)(data_of(points, **{key: -points})))
    assert (lb.normals * points).sum(1).max() < 0


@pytest.mark.parametrize(
    "change",
    [T.RandomScale((2, 2)), T.RandomRotate((30, 30), axis=2), T.RandomJitter(0.01)],
    ids=["scaled", "turned", "moved"],
)
def test_an_operator_of_other_points_is_refused(change):
    """One of three shapes is enough; a translation, which changes no derivative, is none."""
    shapes = [LaplaceBeltramiTransform(order=1)(data) for data in DATA]
    to_operator(Batch.from_data_list([T.Center()(data) for data in shapes]))
    shapes[1] = change(copy.copy(shapes[1]))
    with pytest.raises(ValueError, match=r"moved by up to .* apply it last"):
        to_operator(Batch.from_data_list(shapes))
    with pytest.raises(ValueError, match=r"pos: .* apply it last"):
        to_operator(shapes[1])


@pytest.mark.parametrize("float_type", [torch.float32, torch.float64])
@pytest.mark.parametrize("faces", [True, False])
def test_nodes_in_another_order_are_refused(faces, float_type):
    """Transforms permute nodes, not matrices: all points by PyG's own, two of them by hand, two shapes of a batch."""
    vertices, corners = MESHES[1]
    plain = data_of(vertices.to(float_type), corners if faces else None)
    data = LaplaceBeltramiTransform(order=1)(plain)
    count = data.num_nodes
    swap = torch.arange(count)
    swap[[17, 18]] = swap[[18, 17]]
    turned = [T.FixedPoints(count, replace=False)(copy.copy(data))]
    turned += [data.subgraph(swap), data.subgraph(torch.arange(count).roll(1))]
    for changed in turned:
        with pytest.raises(
            ValueError, match=r"pos: .* points .* in another order .* apply it last"
        ):
            to_operator(changed)
        with pytest.raises(ValueError, match="in another order"):
            to_operator(Batch.from_data_list([data, changed]))
    other = LaplaceBeltramiTransform(order=1)(data_of(2 * plain.pos, corners if faces else None))
    batch = Batch.from_data_list([data, other])
    order = torch.arange(2 * count).roll(count)
    for key in ("pos", "lb_pos", "lb_nodes", "lb_mass"):
        batch[key] = batch[key][order]
    with pytest.raises(ValueError, match="in another order"):
        to_operator(batch)
    for key in ("pos", "lb_pos", "lb_nodes", "lb_mass"):
        batch[key] = batch[key][order]
    to_operator(batch)  # as it was
    shapes = [copy.copy(data) for _ in range(2)]
    shapes[0].pos = shapes[0].pos.to(torch.float64)
    shapes[1].pos = shapes[1].pos.to(torch.float32) + 3
    assert [to_operator(shape).num_points for shape in shapes] == [count, count]


def test_edges_without_faces_are_named():
    data = T.FaceToEdge()(copy.copy(DATA[0]))
    with pytest.warns(UserWarning, match="edges but no face.*remove_faces=False"):
        LaplaceBeltramiTransform(order=1)(data)


def test_a_bad_shape_can_be_skipped():
    points = Sphere().points(100)
    transform = LaplaceBeltramiTransform(order=1, on_error="skip")
    with pytest.warns(UserWarning, match="stays without an operator: points: 10 points share"):
        done = [transform(data_of(p)) for p in (torch.cat([points, points[:5]]), points)]
    assert ["lb_info" in data for data in done] == [False, True]


def test_errors():
    transform = LaplaceBeltramiTransform(order=1)
    with pytest.raises(ValueError, match="expected data with pos"):
        transform(Data(x=torch.ones(3, 1)))
    with pytest.raises(ValueError, match="went through LaplaceBeltramiTransform"):
        to_operator(DATA[0])
    data = transform(DATA[0])
    with pytest.raises(ValueError, match="PyG's Data do not carry it"):
        _ = to_operator(data).report
    data.pos = data.pos[:50]
    with pytest.raises(ValueError, match="50 points, but an operator of 120"):
        to_operator(data)
    with pytest.raises(TypeError, match="no option degree"):
        LaplaceBeltramiTransform(degree=2)(DATA[0])


def test_positions_that_require_gradients_are_told():
    data = LaplaceBeltramiTransform(order=1, k=4)(DATA[0])
    data.pos = data.pos.clone().requires_grad_()
    with pytest.warns(UserWarning, match="pos: they require gradients"):
        lb = to_operator(data)
    assert not lb.points.requires_grad
    assert not lb.eigenbasis(4).eigenvalues.requires_grad
