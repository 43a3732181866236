"""No public call returns a gradient of zero in silence: it has one in points and medium, or raises."""

import inspect

import pytest
import torch

import torchlb
from torchlb import DerivativeError, LaplaceBeltrami
from torchlb.surfaces import Hemisphere

N = 60
VERTICES, FACES = Hemisphere().mesh(N)
X = torch.randn(N, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
OTHERS = {
    "sources": [0, 1],
    "time": 0.1,
    "t": 0.1,
    "f": X,
    "g": X.flip(0),
    "vectors": VERTICES[:2].flip(0),
    "fwhm": 0.3,
    "scales": [0.1],
    "k": 8,
    "v": torch.stack([X, X, X], 1),
    "name": "mass",
}


class OnFields(torch.nn.Module):
    """A layer on tangent fields, of the gradients of x."""

    def __init__(self, layer):
        super().__init__()
        self.layer = layer

    def forward(self, x, lb):
        u = lb.local_gradient(x)
        if isinstance(self.layer, torchlb.TangentDiffusion):
            return lb.connection.vectors(self.layer(u, lb).flatten(0, 1))
        y, u = self.layer(x, u, lb)
        return torch.cat([y, lb.connection.vectors(u.flatten(0, 1)).flatten(1)], 1)


LAYERS = {
    "Diffusion": lambda: torchlb.Diffusion(2, k=8, method="spectral"),
    "DiffusionNet": lambda: torchlb.DiffusionNet(2, 3, width=4, num_blocks=1, k=8),
    "DiffusionNetBlock": lambda: torchlb.DiffusionNetBlock(2, k=8),
    "GradientFeatures": lambda: torchlb.GradientFeatures(2),
    "ImplicitDiffusion": lambda: torchlb.ImplicitDiffusion(2, tolerance=1e-10),
    "PoissonBlock": lambda: torchlb.PoissonBlock(2),
    "PoissonFeatures": lambda: torchlb.PoissonFeatures(2),
    "TangentBlock": lambda: OnFields(torchlb.TangentBlock(2, k=8)),
    "TangentDiffusion": lambda: OnFields(torchlb.TangentDiffusion(2)),
    "SpectralConv": lambda: torchlb.SpectralConv(2, 2, k=8),
}
OF_DATA = {"save_operator", "to_scipy", "unbatch", "check_points", "at", "with_medium"}
"""What returns no tensors, or operators."""
OF_THE_SHAPE = {
    "curvatures",
    "divergence",
    "frames",
    "gradient",
    "hessian",
    "local_gradient",
    "mass",
}
OF_THE_SHAPE |= {"matrix", "mean_curvature_normal", "normals", "points", "forward", "laplacian"}
OF_THE_SHAPE |= {"geodesic_distance", "GradientFeatures", "curl", "integral"}
OF_THE_SHAPE |= {"hodge_decomposition", "logarithmic_map"}
"""What no medium has a part in."""


def arguments(function):
    """Values for the parameters without a default, and for k; None if there is one that is not known here."""
    given = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if name in ("self", "lb") or parameter.kind in (
            parameter.VAR_KEYWORD,
            parameter.VAR_POSITIONAL,
        ):
            continue
        if parameter.default is parameter.empty or name == "k":
            given[name] = OTHERS[name]
    return given


def calls():
    """Every public call with an operator, by name."""
    found = {}
    for name in torchlb.__all__:
        function = getattr(torchlb, name)
        if inspect.isfunction(function) and "lb" in inspect.signature(function).parameters:
            found[name] = lambda lb, function=function: function(lb, **arguments(function))
        elif name in LAYERS:
            found[name] = lambda lb, name=name: LAYERS[name]().double()(X, lb)
    for name, member in inspect.getmembers(LaplaceBeltrami):
        if name.startswith("_") or (hasattr(torch.nn.Module, name) and name != "forward"):
            continue
        if isinstance(member, property):
            found[name] = lambda lb, name=name: getattr(lb, name)
        elif inspect.isfunction(member):
            found[name] = lambda lb, name=name, m=member: getattr(lb, name)(**arguments(m))
    for name in ("points", "mass", "frames", "normals"):
        found[name] = lambda lb, name=name: getattr(lb, name)
    return {name: call for name, call in found.items() if name not in OF_DATA}


def tensors(result):
    """The real tensors of a result; a sparse one times a function."""
    if isinstance(result, torch.Tensor):
        dense = result @ X if result.layout == torch.sparse_csr else result
        return [dense] if dense.is_floating_point() else []
    if isinstance(result, torchlb.Eigenbasis):
        return [result.eigenvalues, result.eigenvectors, result.left]
    if isinstance(result, torchlb.Curvatures):
        names = "k1", "k2", "mean", "gaussian", "curvedness", "shape_index", "directions"
        return [getattr(result, name) for name in names]
    if isinstance(result, torchlb.Connection):
        return [*tensors(result.eigenbasis(8)), result.product("stiffness", torch.cat([X, X]))]
    if isinstance(result, torchlb.HodgeParts):
        return list(vars(result).values())
    if isinstance(result, (list, tuple)):
        return [t for part in result for t in tensors(part)]
    return []


def is_told(value, variable):
    """Whether the gradient is finite and not zero, or an error."""
    weight = torch.arange(1.0, value.numel() + 1).view(value.shape).to(value)
    try:
        result = (weight * value).square().sum()
        (g,) = torch.autograd.grad(result, variable, allow_unused=True, retain_graph=True)
    except DerivativeError:
        return True
    except RuntimeError:  # it does not require a gradient
        return False
    return g is not None and bool(g.isfinite().all()) and bool((g != 0).any())


@pytest.fixture(scope="module")
def lb():
    return LaplaceBeltrami.from_mesh(VERTICES, FACES)


@pytest.mark.parametrize("name", calls())
def test_no_call_has_a_gradient_of_zero_in_silence(name, lb):
    x, kappa = VERTICES.clone().requires_grad_(), VERTICES[:, 0].exp().requires_grad_()
    moved = lb.at(x)
    for value in tensors(calls()[name](moved)):
        assert is_told(value, x), name
    if name not in OF_THE_SHAPE:
        for value in tensors(calls()[name](lb.with_medium(kappa, kappa, kappa))):
            assert is_told(value, kappa), name


def test_every_layer_is_called():
    """A new layer is missing in LAYERS, or a new parameter in OTHERS, until it is added."""
    layers = [n for n in torchlb.__all__ if inspect.isclass(getattr(torchlb, n))]
    layers = [n for n in layers if issubclass(getattr(torchlb, n), torch.nn.Module)]
    assert set(layers) - {"LaplaceBeltrami", "Connection"} == set(LAYERS)
    assert len(calls()) > 40


@pytest.mark.parametrize("name", LAYERS)
def test_layers_have_the_derivative_of_differences(name, lb):
    """In the points, in a direction; what is not differentiable there says so."""
    torch.manual_seed(0)
    layer, way = LAYERS[name]().double().eval(), torch.randn(N, 3, dtype=torch.float64)
    base = VERTICES + 0.01 * torch.randn(N, 3, dtype=torch.float64)

    def value(points):
        moved = lb.at(points)
        moved.eigenbasis(8, tolerance=1e-12)
        return layer(X, moved).square().sum()

    x = base.clone().requires_grad_()
    try:
        (g,) = torch.autograd.grad(value(x), x)
    except DerivativeError:
        assert name in ("PoissonBlock", "PoissonFeatures")  # P1 solutions
        return
    ends = [float(value(base + s * 1e-6 * way)) for s in (1, -1)]
    assert float((g * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3, abs=1e-6)
