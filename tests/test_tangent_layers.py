"""Layers on tangent fields: independent of frames and motions, differentiable, on batches, in float32."""

import copy

import pytest
import torch

from torchlb import (
    DiffusionNet,
    InputError,
    LaplaceBeltrami,
    TangentBlock,
    TangentDiffusion,
    heat_flow,
    implicit_step,
)
from torchlb.nn.diffusion import ImplicitDiffusion
from torchlb.nn.gradient_features import TangentMap
from torchlb.nn.tangent import _divergence_and_curl
from torchlb.surfaces import Circle, Ellipsoid, Sphere, StarShaped, Torus, UnitDisk

ALL = 10_000  # of the eigenpairs, so that the spectral method does not depend on where a basis ends
METHODS = ("implicit", "spectral")


def exact(layer, seed=0):
    """The layer in float64 and evaluation, with times that differ, and exact solves."""
    torch.manual_seed(seed)
    for part in layer.double().eval().modules():
        if hasattr(part, "raw_time"):
            torch.nn.init.uniform_(part.raw_time, 0.02, 0.3)
        if isinstance(part, ImplicitDiffusion):
            part.tolerance = 1e-13
    return layer


def data(lb, channels=3, seed=0):
    """Functions and fields in the frames."""
    random = torch.Generator().manual_seed(seed)
    x = torch.randn(lb.num_points, channels, generator=random, dtype=torch.float64)
    u = torch.randn(lb.num_points, lb.dim, channels, generator=random, dtype=torch.float64)
    return x, u


def with_turned_frames(lb):
    """The operator with every frame turned in its plane, and the turns (N, d, d): E' = E R."""
    other, random = copy.deepcopy(lb), torch.Generator().manual_seed(1)
    angle = 2 * torch.pi * torch.rand(lb.num_points, generator=random, dtype=torch.float64)
    rows = [torch.stack([angle.cos(), -angle.sin()], 1), torch.stack([angle.sin(), angle.cos()], 1)]
    turn = torch.stack(rows, 1)
    other.frames = lb.frames @ turn
    values = lb.stencil.values.clone()
    values[1:] = torch.einsum("eab,ae->be", turn[lb.stencil.row], values[1:])
    other.stencil.values = values
    return other, turn


@pytest.fixture(scope="module")
def sphere():
    return LaplaceBeltrami.from_mesh(*Sphere().mesh(60))


@pytest.fixture(scope="module")
def star():
    return LaplaceBeltrami.from_mesh(*StarShaped().mesh(120))


@pytest.fixture(scope="module")
def disk():
    return LaplaceBeltrami.from_mesh(*UnitDisk().mesh(60))


@pytest.mark.parametrize("method", METHODS)
def test_diffusion_is_that_of_the_connection_by_channel(star, method):
    """Of the components by `implicit_step` and `heat_flow`, each channel for its own time."""
    layer = TangentDiffusion(3, method=method, k=ALL, init_time=0.5)
    torch.testing.assert_close(layer.diffusion.time, torch.full((3,), 0.5))
    layer, (_, u) = exact(layer), data(star)
    for c, t in enumerate(layer.diffusion.time.tolist()):
        column = u[..., c].flatten()
        if method == "implicit":
            expected = implicit_step(star.connection, column, t, tolerance=1e-13)
        else:
            expected = heat_flow(star.connection, column, t, tolerance=1e-10)
        torch.testing.assert_close(layer(u, star)[..., c].flatten(), expected, rtol=1e-7, atol=1e-7)


def test_derivatives_in_the_frames_are_divergence_and_curl(star):
    """Those of `lb.divergence` and `lb.curl` on the space vectors, to 1e-12 of the largest."""
    _, u = data(star)
    vectors = star.connection.vectors(u.flatten(0, 1))
    expected = star.divergence(vectors), star.curl(vectors)
    for found, value in zip(_divergence_and_curl(u, star), expected, strict=True):
        assert (found - value).abs().max() <= 1e-12 * value.abs().max()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("rotations", [True, False])
@pytest.mark.parametrize("shape", ["star", "disk"])
def test_turned_frames_turn_fields_and_leave_functions(request, shape, rotations, method):
    """x' = x and u' = Rᵀu to 1e-10, on a closed surface and one with boundary."""
    lb = request.getfixturevalue(shape)
    other, turn = with_turned_frames(lb)
    block = exact(TangentBlock(3, rotations=rotations, method=method, k=ALL))
    x, u = data(lb)
    first, second = block(x, u, lb)
    again, turned = block(x, turn.mT @ u, other)
    assert (again - first).abs().max() <= 1e-10 * first.abs().max()
    assert (turn @ turned - second).abs().max() <= 1e-10 * second.abs().max()


def test_without_rotations_the_side_of_the_surface_does_not_count(star):
    """A reflection of every frame is one of the components; with rotations it is not."""
    other = copy.deepcopy(star)
    flip = torch.tensor([1.0, -1.0], dtype=torch.float64)
    other.frames = star.frames * flip
    other.stencil.values = star.stencil.values * torch.tensor([[1.0], [1.0], [-1.0]]).double()
    x, u = data(star)
    for rotations in (False, True):
        block = exact(TangentBlock(3, rotations=rotations, method="implicit"))
        first, second = block(x, u, star)
        again, flipped = block(x, flip[:, None] * u, other)
        off = (again - first).abs().max() + (flip[:, None] * flipped - second).abs().max()
        assert (off > 0.1) if rotations else (off < 1e-10)


@pytest.mark.parametrize("block", ["diffusion", "implicit"])
def test_a_motion_of_the_shape_moves_the_fields_of_a_network(block):
    """v(Rp + t) = R v(p) for inputs that do not see the motion; exact to 1e-8, since neighbours are found anew."""
    vertices, faces = StarShaped().mesh(120)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.manual_seed(0)))
    turn = turn[0] * turn[0].det()
    net = DiffusionNet(
        2, 4, width=6, num_blocks=2, block=block, k=ALL, tangent=True, outputs_at="tangent"
    )
    net, results = exact(net), []
    for points in (vertices, vertices @ turn.T + 1):
        lb = LaplaceBeltrami.from_mesh(points, faces)
        results.append(net(vertices[:, :2].exp(), lb))
    expected = torch.einsum("ab,ibc->iac", turn, results[0])
    assert expected.shape == (len(vertices), 3, 4)
    assert (results[1] - expected).abs().max() <= 1e-8 * expected.abs().max()
    assert (lb.normals[:, :, None] * results[1]).sum(1).abs().max() <= 1e-12


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["closed", "dirichlet"])
def test_a_block_passes_gradcheck(sphere, kind, method):
    """In x, u and every parameter, learned times among them."""
    lb = sphere
    if kind == "dirichlet":
        lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(40), condition="dirichlet")
    block = exact(TangentBlock(2, hidden=[3], method=method, k=ALL))
    for part in block.modules():  # smooth, for differences
        for name, child in part.named_children():
            if isinstance(child, torch.nn.ReLU):
                setattr(part, name, torch.nn.Tanh())
    names, values = zip(*block.named_parameters(), strict=True)
    x, u = (each.requires_grad_() for each in data(lb, 2))

    def run(x, u, *given):
        return torch.func.functional_call(block, dict(zip(names, given, strict=True)), (x, u, lb))

    assert torch.autograd.gradcheck(run, (x, u, *values), fast_mode=True)


@pytest.mark.parametrize("method", METHODS)
def test_tangent_diffusion_and_maps_pass_gradcheck(sphere, method):
    """In u and every parameter."""
    _, u = data(sphere, 2)
    layer = exact(TangentDiffusion(2, method=method, k=ALL))
    torch.testing.assert_close(layer(torch.zeros_like(u), sphere), torch.zeros_like(u))
    time = layer.diffusion.raw_time

    def diffused(u, time):
        given = {"diffusion.raw_time": time}
        return torch.func.functional_call(layer, given, (u, sphere))

    assert torch.autograd.gradcheck(diffused, (u.requires_grad_(), time), fast_mode=True)
    found = TangentMap(2, 3).double()
    assert torch.autograd.gradcheck(found.mapped, u)
    assert found.mapped(u).shape == (sphere.num_points, 2, 3)


@pytest.mark.parametrize("method", METHODS)
def test_batches_of_shapes_and_of_inputs_give_what_they_give_one_by_one(star, sphere, method):
    """(N, d, C) on a batch of operators, and (B, N, d, C) on one surface."""
    block = exact(TangentBlock(3, method=method, k=ALL))
    shapes = [star, sphere]
    inputs = [data(lb) for lb in shapes]
    alone = [block(*each, lb) for each, lb in zip(inputs, shapes, strict=True)]
    together = block(
        *(torch.cat(each) for each in zip(*inputs, strict=True)), LaplaceBeltrami.batch(shapes)
    )
    stacked = block(*(torch.stack([each, 2 * each]) for each in inputs[0]), star)
    twice = block(2 * inputs[0][0], 2 * inputs[0][1], star)
    for i in (0, 1):
        expected = torch.cat([each[i] for each in alone])
        torch.testing.assert_close(together[i], expected, rtol=1e-8, atol=1e-8)
        expected = torch.stack([alone[0][i], twice[i]])
        torch.testing.assert_close(stacked[i], expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("block", ["diffusion", "implicit"])
def test_float32_and_autocast_stay_close(star, block):
    """To 1e-3 in float32, on an operator of either type; to a fifth in bfloat16, whose rounding is 0.4 %."""
    net = DiffusionNet(3, 2, width=6, num_blocks=2, block=block, k=30, tangent=True)
    net = exact(net)
    for part in net.modules():
        if isinstance(part, ImplicitDiffusion):
            part.tolerance = None
    expected = net(star.points, star)
    net, x = net.float(), star.points.float()
    for lb in (star, copy.deepcopy(star).float()):
        y = net(x, lb)
        assert y.dtype == torch.float32
        assert (y - expected).abs().max() <= 1e-3 * expected.abs().max()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = net(x, star)
    assert (y.float() - expected).abs().max() <= 0.2 * expected.abs().max()


@pytest.mark.parametrize("place", ["vertices", "global_mean", "faces", "tangent"])
def test_every_parameter_of_a_network_has_a_gradient(star, place):
    """Training in parallel needs that; and a state goes to another network, which then gives the same."""
    options = {"width": 4, "num_blocks": 2, "k": 20, "outputs_at": place, "tangent": True}
    net, other = (DiffusionNet(3, 2, **options).double().eval() for _ in range(2))
    faces = star.faces if place == "faces" else None
    y = net(star.points, star, faces)
    y.square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())
    other.load_state_dict(net.state_dict())
    torch.testing.assert_close(other(star.points, star, faces), y)
    assert net.load_state_dict(copy.deepcopy(net).state_dict())


def test_curves_and_clouds_have_fields_too():
    """Without rotations in dimension 1; in float64 on a cloud."""
    circle = LaplaceBeltrami.from_points(Circle().points(40))
    cloud = LaplaceBeltrami.from_points(Torus().points(150))
    for lb in (circle, cloud):
        options = {"width": 4, "num_blocks": 1, "k": 12, "rotations": False}
        net = DiffusionNet(lb.points.shape[1], 2, tangent=True, outputs_at="tangent", **options)
        y = net.double()(lb.points, lb)
        assert y.shape == (lb.num_points, lb.points.shape[1], 2)
        assert y.isfinite().all()


def test_what_does_not_fit_is_refused(star):
    x, u = data(star)
    layer, block = TangentDiffusion(3).double(), TangentBlock(3, method="implicit").double()
    for wrong in (u[1:], u[:, :1], u[None, None]):
        with pytest.raises(InputError, match=r"u: expected fields in the frames, \(N, d, C\)"):
            layer(wrong, star)
    with pytest.raises(InputError, match=r"with N = 120, d = 2, got"):
        block(x, u[:, :1], star)
    with pytest.raises(InputError, match="expected 3 channels"):
        layer(u[..., :2], star)
    with pytest.raises(InputError, match="expected features of the type of the layer's parameters"):
        block(x, u.float(), star)
    circle = LaplaceBeltrami.from_points(Circle().points(40))
    with pytest.raises(InputError, match="rotations need a surface, got dim=1"):
        block(*data(circle), circle)
    for options in (
        {"outputs_at": "tangent"},
        {"tangent": True, "block": "poisson"},
        {"tangent": True, "gradient_features": False},
    ):
        with pytest.raises(InputError, match="tangent fields: expected tangent=True"):
            DiffusionNet(3, 2, **options)
    flat = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(60), weak_form=False)
    with pytest.raises(InputError, match="no weak pair"):
        layer(data(flat)[1], flat)
