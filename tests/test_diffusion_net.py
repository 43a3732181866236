"""DiffusionNet: the original's formula with the original's weights, equivariance, outputs at every place."""

import re

import pytest
import torch

from torchlb import (
    DiffusionNet,
    DiffusionNetBlock,
    GradientFeatures,
    InputError,
    LaplaceBeltrami,
    heat_flow,
)
from torchlb.linalg.checks import check_choice
from torchlb.nn.diffusion_net import Block, Place
from torchlb.nn.pointwise import Dropout
from torchlb.surfaces import Circle, Sphere, Torus

WIDTH, HIDDEN, BLOCKS = 8, [12, 10], 2


@pytest.fixture(scope="module")
def mesh():
    vertices, faces = Torus().mesh(300)
    return LaplaceBeltrami.from_mesh(vertices, faces), faces


def original_weights(rotations=True, gradients=True):
    """Random weights under the published names of a network of `BLOCKS` blocks."""
    state = {}

    def linear(name, inputs, outputs, bias=True):
        state[f"{name}.weight"] = torch.randn(outputs, inputs).double() / inputs**0.5
        if bias:
            state[f"{name}.bias"] = torch.randn(outputs).double()

    linear("first_lin", 3, WIDTH)
    linear("last_lin", WIDTH, 5)
    for i in range(BLOCKS):
        block = f"block_{i}"
        state[f"{block}.diffusion.diffusion_time"] = torch.rand(WIDTH).double() - 0.2
        for name in ("A_re", "A_im") if rotations else ("A",):
            if gradients:
                linear(f"{block}.gradient_features.{name}", WIDTH, WIDTH, bias=False)
        sizes = [(3 if gradients else 2) * WIDTH, *HIDDEN, WIDTH]
        for j in range(len(sizes) - 1):
            linear(f"{block}.mlp.miniMLP_mlp_layer_{j:03d}", sizes[j], sizes[j + 1])
    return state


def original_formula(state, x, lb, k, rotations=True, gradients=True):
    """The network as its paper describes it, on plain tensors."""
    basis = lb.eigenbasis(k)
    phi, values, mass = basis.eigenvectors, basis.eigenvalues, lb.mass_matrix.to_dense()
    grad_x, grad_y = lb.local_gradient(torch.eye(lb.num_points).double()).unbind(1)
    h = x @ state["first_lin.weight"].T + state["first_lin.bias"]
    for i in range(BLOCKS):
        part = {
            key.split(".", 1)[1]: v for key, v in state.items() if key.startswith(f"block_{i}.")
        }
        time = part["diffusion.diffusion_time"].clamp(min=1e-8)
        spread = phi @ (torch.exp(-values[:, None] * time) * (phi.T @ (mass @ h)))
        features = [h, spread]
        if gradients:
            z = torch.complex(grad_x @ spread, grad_y @ spread)
            if rotations:
                a = torch.complex(
                    part["gradient_features.A_re.weight"], part["gradient_features.A_im.weight"]
                )
            else:
                a = part["gradient_features.A.weight"].to(z.dtype)
            features.append(torch.tanh((z.conj() * (z @ a.T)).real))
        y = torch.cat(features, dim=1)
        for j in range(len(HIDDEN) + 1):
            layer = f"mlp.miniMLP_mlp_layer_{j:03d}"
            y = (y if j == 0 else y.relu()) @ part[f"{layer}.weight"].T + part[f"{layer}.bias"]
        h = h + y
    return h @ state["last_lin.weight"].T + state["last_lin.bias"]


@pytest.mark.parametrize(("gradients", "rotations"), [(True, True), (True, False), (False, False)])
def test_original_weights_give_the_original_formula(mesh, gradients, rotations):
    lb, _ = mesh
    state = original_weights(rotations, gradients)
    net = DiffusionNet(
        3,
        5,
        width=WIDTH,
        num_blocks=BLOCKS,
        hidden=HIDDEN,
        gradient_features=gradients,
        rotations=rotations,
        method="spectral",
        k=40,
    )
    net = net.double().eval()
    net.load_original_state_dict(state)
    expected = original_formula(state, lb.points, lb, 40, rotations, gradients)
    torch.testing.assert_close(net(lb.points, lb), expected, rtol=1e-6, atol=1e-6)


def test_published_layout_of_the_default_network():
    """4 blocks of width 128: 40 tensors."""
    net = DiffusionNet(16, 8)
    assert len(net.state_dict()) == 40
    with pytest.raises(ValueError, match=r"missing \['block_0.diffusion.diffusion_time'"):
        net.load_original_state_dict({})
    state = original_weights()
    small = DiffusionNet(3, 5, width=WIDTH, num_blocks=BLOCKS, hidden=HIDDEN)
    with pytest.raises(ValueError, match=re.escape("unexpected ['more']")):
        small.load_original_state_dict({**state, "more": torch.zeros(1)})
    state["last_lin.bias"] = torch.zeros(6)
    with pytest.raises(ValueError, match=re.escape("last_lin.bias: expected shape (5,), got (6,)")):
        small.load_original_state_dict(state)


def test_gradient_features_do_not_depend_on_the_frames(mesh):
    """Every tangent frame turned by an angle of its own: the same features."""
    lb, _ = mesh
    turned = LaplaceBeltrami.from_mesh(*Torus().mesh(300))
    angle = torch.rand(300).double() * 6
    entry = torch.repeat_interleave(angle, lb.stencil.crow.diff())
    g = lb.stencil.values[1:]
    turned.stencil.values[1:] = torch.stack(
        [entry.cos() * g[0] + entry.sin() * g[1], -entry.sin() * g[0] + entry.cos() * g[1]]
    )
    layer, x = GradientFeatures(6).double(), torch.randn(300, 6).double()
    torch.testing.assert_close(layer(x, turned), layer(x, lb))


def test_network_of_intrinsic_features_does_not_see_rigid_motions():
    points = Torus().random_points(300)
    rotation = torch.linalg.qr(torch.randn(3, 3).double())[0]
    rotation *= rotation.det()
    net = DiffusionNet(2, 3, width=WIDTH, k=30).double().eval()
    x = torch.randn(300, 2).double()
    first = LaplaceBeltrami.from_points(points)
    second = LaplaceBeltrami.from_points(points @ rotation.T + 1)
    torch.testing.assert_close(net(x, first), net(x, second), rtol=1e-7, atol=1e-7)


def test_outputs_at_every_place(mesh):
    """Means of the corners; Σ π y / Σ π."""
    lb, faces = mesh
    edges = faces[:, :2]
    nets = {
        place: DiffusionNet(3, 5, width=WIDTH, outputs_at=place, k=30).double().eval()
        for place in ("vertices", "faces", "edges", "global_mean")
    }
    for net in nets.values():
        net.load_state_dict(nets["vertices"].state_dict())
    x = torch.randn(2, 300, 3).double()
    y = nets["vertices"](x, lb)
    assert y.shape == (2, 300, 5)
    torch.testing.assert_close(nets["faces"](x, lb, faces), y[:, faces].mean(2))
    torch.testing.assert_close(nets["edges"](x, lb, edges=edges), y[:, edges].mean(2))
    mean = torch.einsum("n,bnc->bc", lb.mass, y) / lb.mass.sum()
    torch.testing.assert_close(nets["global_mean"](x, lb), mean)
    torch.testing.assert_close(nets["global_mean"](x[0], lb), mean[0])
    with pytest.raises(InputError, match="needs faces, got None"):
        nets["faces"](x, lb)
    with pytest.raises(InputError, match="expected indices from 0 to 299, got 300"):
        nets["faces"](x, lb, faces + 1)


def test_faces_of_a_batch_are_moved_by_its_offsets():
    """Output s of the batch is that of shape s; faces as they were, of either order of sizes, are refused."""
    meshes = [Torus().mesh(60), Sphere().mesh(100)]
    net = DiffusionNet(3, 5, width=WIDTH, outputs_at="faces", k=20).double().eval()
    for pair in (meshes, meshes[::-1]):
        shapes = [LaplaceBeltrami.from_cotangent(*mesh) for mesh in pair]
        batch, x = LaplaceBeltrami.batch(shapes), torch.cat([lb.points for lb in shapes])
        faces = [f for _, f in pair]
        moved = torch.cat([f + start for f, start in zip(faces, batch.offsets, strict=False)])
        alone = [net(lb.points, lb, f) for lb, f in zip(shapes, faces, strict=True)]
        torch.testing.assert_close(net(x, batch, moved), torch.cat(alone), rtol=1e-5, atol=1e-5)
        with pytest.raises(InputError, match=r"have to be moved by lb.offsets\[s\]"):
            net(x, batch, torch.cat(faces))


def test_block_is_its_formula(mesh):
    """x + MLP(x, e^{tΔ}x)."""
    lb, _ = mesh
    block = DiffusionNetBlock(4, hidden=[6], dropout=False, gradient_features=False, k=30).double()
    x = torch.randn(300, 4).double()
    diffused = heat_flow(lb, x, block.diffusion.time, method="spectral", k=30)
    torch.testing.assert_close(block(x, lb), x + block.mlp(torch.cat([x, diffused], dim=1)))


def test_dropout_is_there_while_training_only(mesh):
    lb, _ = mesh
    net = DiffusionNet(3, 5, width=WIDTH, k=30).double()
    assert not torch.equal(net(lb.points, lb), net(lb.points, lb))
    net.eval()
    assert torch.equal(net(lb.points, lb), net(lb.points, lb))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_dropout_keeps_half_and_doubles_it(dtype):
    """Each value by a coin of its own, those of a seed again, the same ones in the gradient; any other share too."""
    dropout, x = Dropout(0.5), torch.ones(150, 77, dtype=dtype, requires_grad=True)
    torch.manual_seed(0)
    y = dropout(x)
    assert y.dtype == dtype
    assert set(y.unique().tolist()) == {0.0, 2.0}
    for axis in (0, 1):  # five standard deviations
        share = (y > 0).double().mean(axis)
        assert (share - 0.5).abs().max() < 2.5 / y.shape[axis] ** 0.5
    assert torch.equal(torch.autograd.grad(y.sum(), x)[0], y)
    assert not torch.equal(dropout(x), y)
    torch.manual_seed(0)
    assert torch.equal(dropout(x), y)
    dropout.p = 0.9
    assert (dropout(x) > 0).double().mean() < 0.15
    assert dropout.eval()(x) is x
    assert Dropout(0.5)(x[:0]).shape == (0, 77)


def test_a_curve_has_gradient_features_without_rotations():
    lb = LaplaceBeltrami.from_points(Circle().points(60))
    net = DiffusionNet(2, 3, width=WIDTH, rotations=False, k=20).double()
    assert net(lb.points, lb).shape == (60, 3)
    with pytest.raises(ValueError, match="rotations need a surface, got dim=1"):
        DiffusionNet(2, 3, width=WIDTH, k=20).double()(lb.points, lb)


def test_arguments_that_are_none():
    with pytest.raises(InputError, match="outputs_at: expected one of"):
        check_choice("outputs_at", "volumes", Place)
    with pytest.raises(InputError, match="block: expected one of"):
        check_choice("block", "heat", Block)
    with pytest.raises(InputError, match="expected 3 channels"):
        DiffusionNet(3, 5)(
            torch.zeros(100, 2), LaplaceBeltrami.from_points(Sphere().points(100).float())
        )


def test_it_learns_where_the_poles_are():
    """Sign of z on the sphere from xyz: every step lowers the loss to a tenth in the end."""
    lb = LaplaceBeltrami.from_points(Sphere().points(200).float())
    net = DiffusionNet(3, 2, width=WIDTH, num_blocks=2, dropout=False, k=20)
    labels = (lb.points[:, 2] > 0).long()
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-3)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = torch.nn.functional.cross_entropy(net(lb.points, lb), labels)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.2 * losses[0]
