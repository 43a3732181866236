"""What every layer has to bear: batches of shapes, compilers, half precision, copies, workers, devices."""

import copy
import functools
import json
import shutil
import subprocess
import sys
from functools import partial

import pytest
import torch
import torch._dynamo.testing
from torch.utils.data import DataLoader

from torchlb import (
    Diffusion,
    DiffusionNet,
    GradientFeatures,
    ImplicitDiffusion,
    InputError,
    LaplaceBeltrami,
    PoissonBlock,
    PoissonFeatures,
    SpectralConv,
    diffusion_map,
    heat_flow,
    heat_kernel_signature,
    spectral_wavelets,
    wave_kernel_signature,
)
from torchlb.linalg.csr import Csr
from torchlb.nn.diffusion import LearnedTimes, raw_of_time
from torchlb.operator import systems
from torchlb.pde.solves import implicit_step, potential
from torchlb.surfaces import Circle, Ellipsoid, Sphere, Torus, UnitDisk

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++", "cl"))),
    reason="torch.compile needs a C++ compiler",
)
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
CHANNELS, K = 4, 24
SMALL = {"width": 8, "num_blocks": 2, "k": K}
LAYERS = {
    "spectral": lambda: Diffusion(CHANNELS, k=K),
    "rational": lambda: Diffusion(CHANNELS, method="rational"),
    "convolution": lambda: SpectralConv(CHANNELS, 3, k=K),
    "implicit": lambda: ImplicitDiffusion(CHANNELS, tolerance=1e-8),
    "gradients": lambda: GradientFeatures(CHANNELS),
    "poisson": lambda: PoissonFeatures(CHANNELS),
    "poisson block": lambda: PoissonBlock(CHANNELS),
    "poisson block, fields": lambda: PoissonBlock(CHANNELS, fields=True),
    "net": lambda: DiffusionNet(CHANNELS, 5, **SMALL),
    "implicit net": lambda: DiffusionNet(CHANNELS, 5, block="implicit", **SMALL),
    "poisson net": lambda: DiffusionNet(CHANNELS, 5, block="poisson", **SMALL),
    "tangent net": lambda: DiffusionNet(CHANNELS, 5, tangent=True, **SMALL),
    "classifier": lambda: DiffusionNet(CHANNELS, 5, outputs_at="global_mean", **SMALL),
}
every_layer = pytest.mark.parametrize("name", LAYERS)


def layer_of(name, dtype=torch.float32):
    """A layer with times that differ, in evaluation."""
    layer = LAYERS[name]().to(dtype).eval()
    for part in layer.modules():
        if isinstance(part, LearnedTimes):
            torch.nn.init.uniform_(part.raw_time, -0.02, 0.3)
    return layer


def shapes(dtype=torch.float32, count=8):
    """Eight operators of five kinds and sizes, one smaller than the basis, one of another unit of length; or fewer."""

    def cloud(points):
        return LaplaceBeltrami.from_points(points.to(dtype))

    def mesh(vertices, faces):
        return LaplaceBeltrami.from_mesh(vertices.to(dtype), faces)

    def cotangent(vertices, faces, unit=1):
        return LaplaceBeltrami.from_cotangent(unit * vertices.to(dtype), faces)

    builders = [
        lambda: cloud(Sphere().points(90)),
        lambda: cloud(Torus().points(150)),
        lambda: cloud(Torus().random_points(120)),
        lambda: mesh(*Sphere().mesh(100)),
        lambda: mesh(*Ellipsoid().mesh(100)),
        lambda: mesh(*Torus().mesh(100)),
        lambda: cotangent(*Sphere().mesh(110), 3),
        lambda: cotangent(*Sphere().mesh(20)),
    ]
    return [build() for build in builders[:count]]


@pytest.fixture(scope="module")
def eight():
    return shapes()


def features(lb, channels=CHANNELS):
    generator = torch.Generator().manual_seed(lb.num_points)
    return torch.randn(lb.num_points, channels, generator=generator).to(lb.stencil.values[0])


@pytest.mark.usefixtures("unchecked")
@every_layer
def test_a_batch_of_eight_shapes_gives_what_they_give_one_by_one(eight, name):
    """To 2e-5 of the largest value, in float32 where diagonals are up to 1,600; gradients of the parameters too."""
    layer = layer_of(name)
    x = [features(lb) for lb in eight]
    alone = [layer(f, lb) for f, lb in zip(x, eight, strict=True)]
    expected = torch.stack(alone) if name == "classifier" else torch.cat(alone)
    batch = LaplaceBeltrami.batch(eight)
    together = layer(torch.cat(x), batch)
    assert (together - expected).abs().max() <= 2e-5 * expected.abs().max()
    parameters = list(layer.parameters())
    ours, theirs = (torch.autograd.grad(y.square().sum(), parameters) for y in (together, expected))
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4 * float(b.abs().max()))


SOLVING = {
    "implicit": lambda: ImplicitDiffusion(2, tolerance=1e-13),
    "implicit, linear": lambda: ImplicitDiffusion(2),
    "poisson": lambda: PoissonBlock(2, tolerance=1e-13),
    "poisson, linear": lambda: PoissonBlock(2),
    "poisson, fields": lambda: PoissonBlock(2, fields=True),
}


@pytest.mark.parametrize("name", SOLVING)
@pytest.mark.parametrize("kind", ["pair", "cotangent", "dirichlet"])
def test_layers_that_solve_pass_gradcheck(name, kind):
    """In x and in every parameter, learned times among them."""
    vertices, faces = Sphere().mesh(40) if kind != "dirichlet" else UnitDisk().mesh(40)
    lb = {
        "pair": lambda: LaplaceBeltrami.from_mesh(vertices, faces),
        "cotangent": lambda: LaplaceBeltrami.from_cotangent(vertices, faces),
        "dirichlet": lambda: LaplaceBeltrami.from_mesh(vertices, faces, condition="dirichlet"),
    }[kind]()
    torch.manual_seed(0)
    layer = SOLVING[name]().double().eval()
    if name.startswith("implicit"):
        torch.nn.init.uniform_(layer.raw_time, 0.05, 0.3)
    x = torch.randn(len(vertices), 2, dtype=torch.float64, requires_grad=True)
    names, values = zip(*layer.named_parameters(), strict=True)

    def run(x, *given):
        return torch.func.functional_call(layer, dict(zip(names, given, strict=True)), (x, lb))

    assert torch.autograd.gradcheck(run, (x, *values), fast_mode=True)


@pytest.mark.parametrize("name", SOLVING)
def test_a_batch_solves_with_the_factors_of_its_shapes(monkeypatch, name):
    """What they give one by one to 1e-10, and no system is made for the batch."""
    shapes = [
        LaplaceBeltrami.from_mesh(*surface.mesh(n))
        for surface, n in ((Sphere(), 60), (Torus(), 90))
    ]
    layer = SOLVING[name]().double().eval()
    x = [features(lb, 2) for lb in shapes]
    alone = torch.cat([layer(f, lb) for f, lb in zip(x, shapes, strict=True)])
    batch, made = LaplaceBeltrami.batch(shapes), []
    monkeypatch.setattr(systems.PairSystem, "__init__", lambda *_: made.append(1))
    torch.testing.assert_close(layer(torch.cat(x), batch), alone, rtol=1e-10, atol=1e-10)
    assert not made
    monkeypatch.undo()
    other = copy.deepcopy(batch)  # knows nothing of its shapes
    torch.testing.assert_close(layer(torch.cat(x), other), alone, rtol=1e-9, atol=1e-9)


def test_implicit_diffusion_is_the_step_of_every_channel():
    """Times over four decades share factors and differ from a solve each by no more than the tolerance."""
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(300))
    layer = ImplicitDiffusion(9, tolerance=1e-10).double()
    times = torch.logspace(-4, 0.5, 9, dtype=torch.float64)
    layer.raw_time.data = raw_of_time(times)
    x = features(lb, 9)
    y = layer(x, lb)
    expected = torch.cat([implicit_step(lb, x[:, c : c + 1], float(times[c])) for c in range(9)], 1)
    torch.testing.assert_close(y, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("shape", ["torus", "disk", "Dirichlet disk"])
def test_implicit_diffusion_by_elements_is_the_step_of_their_pair(shape):
    """(M₁ + tK₁)⁻¹M₁x to 1e-3 of |x| for rough x and times over four decades, and constants exactly."""
    surface = Torus() if shape == "torus" else UnitDisk()
    condition = "dirichlet" if shape == "Dirichlet disk" else "neumann"
    lb = LaplaceBeltrami.from_mesh(*surface.mesh(300), condition=condition)
    times = torch.logspace(-3.5, 0.5, 9, dtype=torch.float64)
    layer, x = ImplicitDiffusion(9).double(), features(lb, 9)
    layer.raw_time.data = raw_of_time(times)
    stiffness, mass = (Csr(*lb.weak.linear_pair).tensor(i).to_dense() for i in (0, 1))
    free = torch.ones(lb.num_points).bool() if lb.fixed is None else ~lb.fixed
    y = layer(x, lb)
    assert not y[~free].any()
    for c, t in enumerate(times):
        left = (mass + t * stiffness)[free][:, free]
        expected = torch.linalg.solve(left, (mass @ x[:, c])[free])
        assert (y[free, c] - expected).norm() <= 1e-3 * x[:, c].norm()
    if condition == "neumann":
        one = torch.ones_like(x)
        torch.testing.assert_close(layer(one, lb), one, rtol=1e-9, atol=0)


@pytest.mark.parametrize("kind", ["mesh", "cotangent", "points"])
def test_the_potential_of_a_gradient_is_the_function(kind):
    """But for its mean, to the order of what solves; of a turned gradient it is zero."""
    vertices, faces = Ellipsoid().mesh(800)
    lb = {
        "mesh": lambda: LaplaceBeltrami.from_mesh(vertices, faces),
        "cotangent": lambda: LaplaceBeltrami.from_cotangent(vertices, faces),
        "points": lambda: LaplaceBeltrami.from_points(vertices),
    }[kind]()
    f = vertices[:, :1] * vertices[:, 1:2]
    f = f - (lb.mass @ f) / lb.mass.sum()
    gradient = lb.local_gradient(f)
    turned = torch.stack([-gradient[:, 1], gradient[:, 0]], 1)
    for tolerance, bound in (("P1", 0.03), (1e-10, 0.01)):
        bound = 0.1 if kind == "cotangent" else bound  # whose gradient is first order
        size = f.abs().max()
        assert (potential(lb, gradient, tolerance=tolerance) - f).abs().max() <= bound * size
        assert potential(lb, turned, tolerance=tolerance).abs().max() <= bound * size


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_linear_elements_solve_as_well_in_float32(unit):
    """Where K is singular, too, beside a much smaller component; in units whose squares leave the range of float32."""
    large, small = Torus().mesh(3000), Ellipsoid().mesh(500)
    vertices = torch.cat([large[0], 1e-3 * small[0] + 50.0])
    lb = LaplaceBeltrami.from_mesh(unit * vertices, torch.cat([large[1], small[1] + len(large[0])]))
    source = features(lb, 20) + vertices[:, :1]
    expected = potential(lb, None, source)
    single = potential(lb.float(), None, source.float())
    assert single.dtype == torch.float32
    for part in (slice(0, len(large[0])), slice(len(large[0]), None)):
        assert (single[part] - expected[part]).norm() < 1e-5 * expected[part].norm()


def test_a_batch_is_block_diagonal(eight):
    """Δ, gradient, Δx, mass and report of the shapes below each other; offsets, signatures."""
    for lb in eight:
        lb.eigenbasis(K)  # taken over; solved anew, those of equal eigenvalues could be turned
    batch = LaplaceBeltrami.batch(eight)
    assert batch.offsets == tuple(sum(lb.num_points for lb in eight[:i]) for i in range(9))
    x = [features(lb) for lb in eight]
    for apply in (
        lambda lb, f: lb(f),
        lambda lb, f: lb.gradient(f),
        lambda lb, _: lb.mean_curvature_normal(),
        lambda lb, _: lb.mass,
        lambda lb, _: lb.report.order,
        lambda lb, _: heat_kernel_signature(lb, k=K),
        lambda lb, _: wave_kernel_signature(lb, k=K),
        lambda lb, f: spectral_wavelets(lb, f, torch.tensor([0.1, 1.0]), k=K),
        lambda lb, _: diffusion_map(lb, 0.1, dim=3),
    ):
        expected = torch.cat([apply(lb, f) for lb, f in zip(eight, x, strict=True)])
        torch.testing.assert_close(apply(batch, torch.cat(x)), expected, rtol=1e-5, atol=1e-5)
    dense = batch.matrix.to_dense()
    torch.testing.assert_close(dense[:90, :90], eight[0].matrix.to_dense())
    assert (dense[:90, 90:] == 0).all()


def test_a_batch_takes_bases_over_solves_what_is_missing_and_is_stored():
    fresh = shapes(torch.float64, 3)
    for lb in fresh:
        lb.eigenbasis(K)
    ready, later = LaplaceBeltrami.batch(fresh), LaplaceBeltrami.batch(shapes(torch.float64, 3))
    assert ready.modes.left.shape[1] >= K
    assert later.modes.left.numel() == 0
    for field in ("eigenvalues", "eigenvectors", "left"):
        a, b = (getattr(lb.eigenbasis(K), field) for lb in (ready, later))
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)
    assert ready.eigenbasis(K).eigenvalues.shape == (3, K)
    again = LaplaceBeltrami()
    ready.eigenbasis(K, store=True)
    again.load_state_dict(ready.state_dict())
    assert again.offsets == ready.offsets
    f = torch.cat([features(lb) for lb in fresh])
    torch.testing.assert_close(heat_flow(again, f, 0.1, k=K), heat_flow(ready, f, 0.1, k=K))
    nested = LaplaceBeltrami.batch([LaplaceBeltrami.batch(fresh[:2]), fresh[2]])
    torch.testing.assert_close(heat_flow(nested, f, 0.1, k=K), heat_flow(ready, f, 0.1, k=K))


def test_a_batch_asks_for_the_pairs_that_one_of_its_shapes_lacks():
    """Bases of 40 and of 10 pairs are one of 10; asked for more the short shape is solved, and keeps it."""
    long, short = (LaplaceBeltrami.from_mesh(*s.mesh(100)) for s in (Sphere(), Torus()))
    long.eigenbasis(40), short.eigenbasis(10)
    batch, f = LaplaceBeltrami.batch([long, short]), torch.randn(200, 2, dtype=torch.float64)
    assert batch.modes.count == 10
    for k in (10, 30):
        alone = [
            heat_flow(lb, g, 0.1, method="spectral", k=k)
            for lb, g in zip((long, short), f.split(100), strict=True)
        ]
        flowed = heat_flow(batch, f, 0.1, method="spectral", k=k)
        torch.testing.assert_close(flowed, torch.cat(alone), rtol=1e-6, atol=1e-6)
    assert (long.modes.count, short.modes.count, batch.modes.count) == (40, 30, 30)


def test_a_batch_does_not_follow_what_becomes_of_its_shapes():
    """A state that is loaded into a shape afterwards, or a cast, leaves the batch's solves as they were."""
    shapes = [LaplaceBeltrami.from_mesh(*s.mesh(60)) for s in (Sphere(), Torus())]
    batch, f = LaplaceBeltrami.batch(shapes), torch.randn(120, 1, dtype=torch.float64)
    expected = implicit_step(batch, f, 0.1)
    vertices, faces = Sphere().mesh(60)
    with pytest.warns(UserWarning, match="is replaced by one on 60 others"):
        shapes[0].load_state_dict(LaplaceBeltrami.from_mesh(2 * vertices, faces).state_dict())
    torch.testing.assert_close(implicit_step(batch, f, 0.1), expected, rtol=1e-9, atol=1e-9)


def test_shapes_that_do_not_go_together_are_refused():
    sphere = LaplaceBeltrami.from_points(Sphere().points(60))
    with pytest.raises(ValueError, match="got no shapes"):
        LaplaceBeltrami.batch([])
    with pytest.raises(ValueError, match="shape 1 is of dimension 1"):
        LaplaceBeltrami.batch([sphere, LaplaceBeltrami.from_points(Circle().points(60))])
    with pytest.raises(ValueError, match="one dimension, floating type and device"):
        LaplaceBeltrami.batch([sphere, LaplaceBeltrami.from_points(Sphere().points(60).float())])


def with_one_block(name):
    """A layer to compile: more blocks take longer, and are of the same operations."""
    layer = layer_of(name)
    if isinstance(layer, DiffusionNet):
        del layer.blocks[1:]
    return layer


def compiled_and_not(name, operators):
    """Outputs and gradients in x of the compiled layer and of the layer itself."""
    torch._dynamo.reset()
    layer = with_one_block(name)
    lb = LaplaceBeltrami.batch(operators) if len(operators) > 1 else operators[0]
    x = features(lb).requires_grad_()
    results = []
    expected = layer(x, lb)  # solves what is solved once
    for y in (torch.compile(layer, fullgraph=True)(x, lb), expected):
        results.append((y, torch.autograd.grad(y.square().sum(), x)[0]))
    return results


@functools.cache
def operators_of_sizes(count):
    """Operators of as many sizes, with eigenpairs."""
    meshes = [Sphere().mesh(60 + 12 * i) for i in range(count)]
    operators = [LaplaceBeltrami.from_mesh(v.float(), f, order=1) for v, f in meshes]
    for lb in operators:
        lb.eigenbasis(K)
    return operators


def graphs_of_sizes(name, batched):
    """Number of graphs for seven shapes, or batches of two, of seven sizes; all outputs are the layer's own."""
    torch._dynamo.reset()
    layer = with_one_block(name)
    backend = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
    compiled = torch.compile(layer, backend=backend, fullgraph=True)
    operators = operators_of_sizes(7)
    for i, alone in enumerate(operators):
        lb = LaplaceBeltrami.batch([alone, operators[i - 1]]) if batched else alone
        x = features(lb)
        torch.testing.assert_close(compiled(x, lb), layer(x, lb), rtol=1e-3, atol=1e-4)
    return backend.frame_count


def graphs_of_steps():
    """Number of graphs compiled for training steps on five sizes, with dropout, by the options of docs/training.md."""
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    net = with_one_block("net").train()
    compiled = torch.compile(net, backend="aot_eager", fullgraph=True, dynamic=True)
    for lb in operators_of_sizes(5):
        compiled(features(lb), lb).square().mean().backward()
        assert all(p.grad is not None and p.grad.any() for p in net.parameters())
    return torch._dynamo.utils.counters["stats"]["unique_graphs"]


def run_apart(*arguments):
    """Run this file as a program: Dynamo cannot trace the types that the test run checks at every call."""
    command = [sys.executable, __file__, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@needs_compiler
@pytest.mark.slow
def test_compiled_without_graph_breaks_it_gives_the_same():
    """A classifier of a batch and a convolution on one shape, with their gradients."""
    run_apart("compiled")


@pytest.mark.slow
def test_few_graphs_are_enough():
    """`fullgraph=True` for what docs/conventions.md promises: products of the operator, layers that consist of them.

    At most four graphs for seven sizes: the first, that of any size, and two for other sizes of the basis. One with
    dynamic sizes takes all training steps.
    """
    graphs = json.loads(run_apart("graphs"))
    assert graphs.pop("steps") == 1
    assert len(graphs) == 4
    assert max(graphs.values()) <= 4, graphs


def compiled_as_one_graph():
    """Check what docs/conventions.md promises of `fullgraph=True` against what is not compiled."""
    vertices, faces = Sphere().mesh(110)
    lb = LaplaceBeltrami.from_mesh(vertices.float(), faces, order=1)
    lb.eigenbasis(K)
    x = features(lb)
    names = ["spectral", "convolution", "gradients", "net"]
    functions = [partial(with_one_block(name), lb=lb) for name in names]
    functions += [lb, lb.gradient, lambda f: lb.divergence(lb.gradient(f[:, 0]))]
    functions += [lambda f: lb.eigenbasis(K).from_basis(lb.eigenbasis(K).to_basis(f))]
    for function in functions:
        torch._dynamo.reset()
        compiled = torch.compile(lambda f, g=function: g(f), backend="eager", fullgraph=True)
        torch.testing.assert_close(compiled(x), function(x), rtol=1e-3, atol=1e-4)


@every_layer
def test_autocast_to_bfloat16_stays_close(eight, name):
    """Diffusion itself is computed in float32: exact. The pointwise networks around it are not."""
    layer, lb = layer_of(name), eight[1]
    x = features(lb)
    expected = layer(x, lb)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = layer(x, lb)
        half = layer(x.bfloat16(), lb)
    exact = name in ("spectral", "rational", "convolution", "implicit")
    scale = float(expected.detach().abs().max())
    assert (y.float() - expected).abs().max() <= (1e-6 if exact else 0.2) * scale
    assert (half.float() - expected).abs().max() <= 0.2 * scale
    assert not exact or half.dtype == torch.bfloat16
    half.float().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in layer.parameters())


@pytest.mark.parametrize("scale", [1e-3, 1e3])
@pytest.mark.parametrize("name", ["poisson", "classifier"])
def test_autocast_to_float16_bears_areas_beyond_its_range(name, scale):
    """Of millimetres in metres, and the reverse; the mean over masses, the potential of sources."""
    vertices, faces = Sphere().mesh(60)
    lb = LaplaceBeltrami.from_cotangent(scale * vertices.float(), faces)
    layer, x = layer_of(name), features(lb)
    expected = layer(x, lb)
    with torch.autocast("cpu", dtype=torch.float16):
        y = layer(x, lb)
    assert name == "classifier" or y.dtype == torch.float32
    assert (y.float() - expected).abs().max() <= 1e-2 * expected.abs().max()


@pytest.mark.parametrize("block", ["diffusion", "implicit", "poisson"])
def test_under_autocast_gradients_are_of_features_that_were_not_rounded(eight, block):
    layer, lb, seen = DiffusionNet(CHANNELS, 5, block=block, **SMALL), eight[3], []
    for module in layer.modules():
        if isinstance(module, GradientFeatures):
            module.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].dtype))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        layer(features(lb), lb)
    assert seen == 2 * [torch.float32]


def test_gradient_features_compute_in_the_type_of_the_layer():
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(100))
    layer, x = layer_of("gradients"), features(lb).float()
    assert torch.equal(layer(x, lb), layer(x, copy.deepcopy(lb).float()))


@pytest.fixture(scope="module")
def torus_by_type():
    """Operators built of the same points in float64 and in float32."""
    points = Torus().points(150)
    return LaplaceBeltrami.from_points(points), LaplaceBeltrami.from_points(points.float())


@every_layer
def test_float32_is_close_to_float64(torus_by_type, name):
    double, single = torus_by_type
    layer = layer_of(name, torch.float64)
    expected = layer(features(double), double)
    y = copy.deepcopy(layer).float()(features(double).float(), single)
    assert y.dtype == torch.float32
    assert (y - expected).abs().max() <= 1e-3 * expected.abs().max()


@pytest.fixture(scope="module")
def torus_mesh():
    return LaplaceBeltrami.from_mesh(*Torus().mesh(100))


@every_layer
def test_one_rule_of_types(torus_mesh, name):
    """The parameters' type is that of x, which the result has; the operator may have any. Else an error names both."""
    double = torus_mesh
    layer, x = layer_of(name), features(double).float()
    y = layer(x, double)
    assert y.dtype == torch.float32
    single = copy.deepcopy(double).float()
    torch.testing.assert_close(y, layer(x, single), rtol=1e-3, atol=1e-4)
    double_layer = copy.deepcopy(layer).double()
    assert double_layer(x.double(), single).dtype == torch.float64
    for wrong, features_of_other in ((layer, x.double()), (double_layer, x), (layer, x.bfloat16())):
        with pytest.raises(
            InputError, match=r"type of the layer's parameters, torch.float\d\d, got"
        ):
            wrong(features_of_other, double)


@pytest.mark.parametrize("name", ["spectral", "convolution", "net"])
def test_a_stored_basis_that_is_too_short_is_named(name):
    lb = LaplaceBeltrami.from_cotangent(*Sphere().mesh(60))
    held = lb.float().eigenbasis(8).eigenvectors.shape[1]
    with pytest.warns(UserWarning, match=f"basis of {held} pairs, a layer asks for k = {K}"):
        layer_of(name)(features(lb), lb)


@every_layer
def test_copies_averages_and_states(eight, name):
    """deepcopy of layer and operator, an exponential moving average, a strict state_dict."""
    layer, lb = layer_of(name), eight[1]
    x = features(lb)
    expected = layer(x, lb)
    torch.testing.assert_close(copy.deepcopy(layer)(x, copy.deepcopy(lb)), expected)
    average = torch.optim.swa_utils.AveragedModel(layer)
    average.update_parameters(layer)
    torch.testing.assert_close(average(x, lb), expected)
    other = LAYERS[name]().eval()
    other.load_state_dict(layer.state_dict())
    torch.testing.assert_close(other(x, lb), expected)


def collate(items):
    operators, inputs = zip(*items, strict=True)
    return LaplaceBeltrami.batch(operators), torch.cat(inputs)


class Shapes(torch.utils.data.Dataset):
    def __init__(self, operators):
        self.operators = operators

    def __len__(self):
        return len(self.operators)

    def __getitem__(self, index):
        return self.operators[index], features(self.operators[index])


@pytest.mark.parametrize("workers", [0, 2])
def test_data_loader_with_workers(eight, workers):
    """Operators with their bases travel to the main process, batched by the workers."""
    for lb in eight[:6]:
        lb.eigenbasis(K)
    layer = layer_of("net")
    loader = DataLoader(Shapes(eight[:6]), batch_size=3, num_workers=workers, collate_fn=collate)
    sizes = []
    for batch, x in loader:
        assert batch.modes.left.shape[1] >= K
        assert layer(x, batch).isfinite().all()
        sizes += batch.sizes
    assert sizes == [lb.num_points for lb in eight[:6]]


@needs_cuda
@every_layer
def test_on_cuda_it_gives_the_same(eight, name):
    layer = layer_of(name)
    for lb in (eight[1], LaplaceBeltrami.batch(eight)):
        x = features(lb)
        expected = layer(x, lb)
        there = copy.deepcopy(layer).cuda()
        y = there(x.cuda().requires_grad_(), copy.deepcopy(lb).cuda())
        y.sum().backward()
        torch.testing.assert_close(y.cpu(), expected, rtol=1e-3, atol=1e-4)
        assert all(p.grad.isfinite().all() for p in there.parameters())


def test_a_basis_found_without_gradients_serves_a_training():
    """What is solved, and what is built, under `inference_mode` are tensors like any other."""
    vertices, faces = Sphere().mesh(200)
    x = vertices.float()
    net = DiffusionNet(3, 2, width=8, num_blocks=1, k=12)
    lb = LaplaceBeltrami.from_mesh(x, faces)
    with torch.inference_mode():
        net(x, lb)
        inside = LaplaceBeltrami.from_mesh(x + 0, faces + 0)
        batch = LaplaceBeltrami.batch([inside, inside])
    net(x, lb).sum().backward()
    net(x, inside).sum().backward()
    net(torch.cat([x, x]), batch).sum().backward()


def test_operators_keep_their_own_points():
    vertices, faces = Sphere().mesh(200)
    given = vertices.double().clone()
    built = [LaplaceBeltrami.from_mesh(given, faces), LaplaceBeltrami.from_cotangent(given, faces)]
    given.mul_(2)
    for lb in built:
        torch.testing.assert_close(lb.points, vertices.double())


@pytest.mark.parametrize(("place", "corners"), [("faces", 3), ("edges", 2)])
def test_faces_in_the_layout_of_pyg_are_refused(place, corners):
    vertices, faces = Sphere().mesh(200)
    net = DiffusionNet(3, 2, width=8, num_blocks=1, k=12, outputs_at=place)
    lb = LaplaceBeltrami.from_cotangent(vertices.float(), faces)
    net(vertices.float(), lb, **{place: faces[:, :corners]})
    with pytest.raises(InputError, match="PyG has the transpose"):
        net(vertices.float(), lb, **{place: faces[:, :corners].T})


def test_wavelets_of_one_function():
    lb = LaplaceBeltrami.from_cotangent(*Sphere().mesh(200))
    scales = torch.tensor([0.1, 1.0])
    f = lb.points[:, 2]
    single = spectral_wavelets(lb, f, scales, k=20)
    assert single.shape == (200, 3)
    assert torch.equal(single, spectral_wavelets(lb, f[:, None], scales, k=20)[..., 0])


if __name__ == "__main__" and sys.argv[1] == "compiled":
    three = shapes(count=3)
    for name, operators in (("classifier", three), ("convolution", three[1:2])):
        compiled, plain = compiled_and_not(name, operators)
        torch.testing.assert_close(compiled, plain, rtol=1e-3, atol=1e-4)
elif __name__ == "__main__" and sys.argv[1] == "graphs":
    compiled_as_one_graph()
    kinds = [
        ("net", False),
        ("spectral", False),
        ("convolution", True),
        ("classifier", True),
    ]
    graphs = {name: graphs_of_sizes(name, batched) for name, batched in kinds}
    print(json.dumps(graphs | {"steps": graphs_of_steps()}))
