"""The 7-tuple keeps the promises of its docstring, and a DiffusionNet that knows nothing of torchlb runs on it."""

import inspect

import pytest
import torch
from torch import nn

import torchlb
from torchlb import LaplaceBeltrami
from torchlb.interop.diffusion_net import compute_operators, get_all_operators, get_operators
from torchlb.surfaces import Ellipsoid, Sphere, smooth_function

SPHERE, ELLIPSOID = Sphere().mesh(200), Ellipsoid().mesh(150)
CLOUD = (Sphere().points(200), torch.zeros(0, 3, dtype=torch.int64))
INPUTS = {
    "stencil": (SPHERE, {}),
    "stencil, as it is": (SPHERE, {"symmetric": False}),
    "cotangent": (SPHERE, {"operator": "cotangent"}),
    "cloud": (CLOUD, {}),
}
every_input = pytest.mark.parametrize(("shape", "options"), INPUTS.values(), ids=INPUTS.keys())


class LearnedTimeDiffusion(nn.Module):
    def __init__(self, width, method):
        super().__init__()
        self.method = method
        self.diffusion_time = nn.Parameter(torch.zeros(width))

    def forward(self, x, L, mass, evals, evecs):
        with torch.no_grad():
            self.diffusion_time.clamp_(min=1e-8)
        if self.method == "spectral":
            spectrum = evecs.transpose(-2, -1) @ (x * mass.unsqueeze(-1))
            decay = torch.exp(-evals.unsqueeze(-1) * self.diffusion_time)
            return evecs @ (decay * spectrum)
        system = self.diffusion_time[None, :, None, None] * L.to_dense().unsqueeze(1)
        system = system + torch.diag_embed(mass).unsqueeze(1)
        factor = torch.linalg.cholesky(system)
        right = (x * mass.unsqueeze(-1)).transpose(-2, -1).unsqueeze(-1)
        return torch.cholesky_solve(right, factor).squeeze(-1).transpose(-2, -1)


class SpatialGradientFeatures(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.A_re = nn.Linear(width, width, bias=False)
        self.A_im = nn.Linear(width, width, bias=False)

    def forward(self, vectors):
        x, y = vectors[..., 0], vectors[..., 1]
        real = self.A_re(x) - self.A_im(y)
        imaginary = self.A_re(y) + self.A_im(x)
        return torch.tanh(x * real + y * imaginary)


class MiniMLP(nn.Sequential):
    def __init__(self, sizes):
        super().__init__()
        for i in range(len(sizes) - 1):
            if i > 0:
                self.add_module(f"miniMLP_mlp_act_{i:03d}", nn.ReLU())
            self.add_module(f"miniMLP_mlp_layer_{i:03d}", nn.Linear(sizes[i], sizes[i + 1]))


class Block(nn.Module):
    def __init__(self, width, method):
        super().__init__()
        self.diffusion = LearnedTimeDiffusion(width, method)
        self.gradient_features = SpatialGradientFeatures(width)
        self.mlp = MiniMLP([3 * width, width, width, width])

    def forward(self, x, mass, L, evals, evecs, gradX, gradY):
        diffused = self.diffusion(x, L, mass, evals, evecs)
        parts = []
        for b in range(len(x)):  # a sparse matrix is not multiplied in batches
            parts.append(
                torch.stack([torch.mm(gradX[b], diffused[b]), torch.mm(gradY[b], diffused[b])], -1)
            )
        features = self.gradient_features(torch.stack(parts))
        return x + self.mlp(torch.cat([x, diffused, features], dim=-1))


class OriginalDiffusionNet(nn.Module):
    """From the public description: names of weights, arguments and steps are those of the original."""

    def __init__(self, C_in, C_out, C_width=8, N_block=2, diffusion_method="spectral"):
        super().__init__()
        self.first_lin = nn.Linear(C_in, C_width)
        self.last_lin = nn.Linear(C_width, C_out)
        self.blocks = [Block(C_width, diffusion_method) for _ in range(N_block)]
        for i, block in enumerate(self.blocks):
            self.add_module(f"block_{i}", block)

    def forward(self, x_in, mass, L=None, evals=None, evecs=None, gradX=None, gradY=None):
        operators = [part.unsqueeze(0) for part in (mass, L, evals, evecs, gradX, gradY)]
        x = self.first_lin(x_in.unsqueeze(0))
        for block in self.blocks:
            x = block(x, *operators)
        return self.last_lin(x).squeeze(0)


@every_input
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_shapes_types_and_promises(shape, options, dtype):
    verts, faces = shape[0].to(dtype), shape[1]
    frames, mass, L, evals, evecs, gradX, gradY = get_operators(verts, faces, k_eig=16, **options)
    size, tolerance = len(verts), 1e-5 if dtype == torch.float32 else 1e-9
    dense = {"frames": (frames, (size, 3, 3)), "mass": (mass, (size,))}
    dense |= {"evals": (evals, (16,)), "evecs": (evecs, (size, 16))}
    for name, (part, expected) in dense.items():
        assert (part.dtype, tuple(part.shape), part.layout) == (dtype, expected, torch.strided), (
            name
        )
    for part in (L, gradX, gradY):
        assert (part.dtype, tuple(part.shape)) == (dtype, (size, size))
        assert part.layout == torch.sparse_coo
        assert part.is_coalesced()
        rows = part.to_dense().sum(1).abs().max()
        assert rows < tolerance * part.to_dense().abs().max()
    torch.testing.assert_close(
        frames @ frames.mT, torch.eye(3, dtype=dtype).expand_as(frames), rtol=0, atol=1e-6
    )
    torch.testing.assert_close(torch.linalg.det(frames), mass.new_ones(size), rtol=0, atol=1e-5)
    assert mass.min() > 0
    weak = L.to_dense().double()
    symmetric = (weak + weak.T) / 2
    assert torch.linalg.eigvalsh(symmetric).min() > -tolerance * symmetric.abs().max() * 10
    if options.get("symmetric", True):
        torch.testing.assert_close(weak, weak.T, rtol=tolerance, atol=tolerance)
    assert (evals[0] == 0) & (evals >= 0).all() & (evals.diff() >= 0).all()
    identity = torch.eye(16, dtype=dtype)
    torch.testing.assert_close(evecs.T @ (mass[:, None] * evecs), identity, rtol=0, atol=tolerance)
    torch.testing.assert_close(evecs[:, 0], evecs[:1, 0].expand(size), rtol=tolerance, atol=0)


@every_input
def test_gradients_are_components_in_the_frames(shape, options):
    """∇(a·x) = a − (a·n)n, so that its components are a·X and a·Y; the normal points outwards on a mesh."""
    frames, _, _, _, _, gradX, gradY = get_operators(*shape, k_eig=0, **options)
    a = torch.tensor([0.3, -1.2, 0.7]).double()
    f = shape[0] @ a
    bound = 0.2 if options.get("operator") == "cotangent" else 0.02
    assert (torch.mv(gradX, f) - frames[:, 0] @ a).abs().max() < bound
    assert (torch.mv(gradY, f) - frames[:, 1] @ a).abs().max() < bound
    outwards = (frames[:, 2] * shape[0]).sum(1)
    assert outwards.abs().min() > 0.98
    if len(shape[1]):
        assert outwards.min() > 0


def test_the_gauge_of_the_frames_is_the_originals():
    """X is e₁ in the tangent plane, e₂ where the normal is within acos 0.9 of ±e₁."""
    frames = get_operators(*SPHERE, k_eig=0)[0]
    normal = frames[:, 2]
    steep = normal[:, 0].abs() >= 0.9
    assert steep.any()
    axis = torch.eye(3).double()[steep.long()]
    x = axis - (axis * normal).sum(1, keepdim=True) * normal
    torch.testing.assert_close(frames[:, 0], x / x.norm(dim=1, keepdim=True))


def test_the_accuracy_of_the_stencil_is_in_the_tuple():
    """L/mass of the stencil as it is, and evals, beside the cotangent's."""
    surface = Sphere()
    verts, faces = surface.mesh(600)
    f, exact = smooth_function(verts), surface.laplacian(smooth_function, verts)
    errors, spectra = [], []
    for options in ({"symmetric": False}, {"operator": "cotangent"}):
        _, mass, L, evals, *_ = get_operators(verts, faces, k_eig=9, **options)
        errors.append(float((torch.mv(L, f) / mass + exact).norm() / exact.norm()))
        spectra.append(float((evals - torch.tensor([0, 2, 2, 2, 6, 6, 6, 6, 6])).abs().max()))
    assert errors[0] < 1e-3 < errors[1]
    assert spectra[0] < 2e-3 < spectra[1] / 10


def test_signature_is_the_originals():
    def names(function):
        kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD,)
        return [p.name for p in inspect.signature(function).parameters.values() if p.kind in kinds]

    assert names(get_operators) == [
        "verts",
        "faces",
        "k_eig",
        "op_cache_dir",
        "normals",
        "overwrite_cache",
        "truncate_cache",
    ]
    assert inspect.signature(get_operators).parameters["k_eig"].default == 128
    assert names(compute_operators) == ["verts", "faces", "k_eig", "normals"]
    assert names(get_all_operators) == [
        "verts_list",
        "faces_list",
        "k_eig",
        "op_cache_dir",
        "normals",
    ]


def test_all_and_compute_are_the_same_as_one_by_one(tmp_path):
    shapes = [SPHERE, ELLIPSOID, CLOUD]
    verts, faces = [s[0] for s in shapes], [s[1] for s in shapes]
    single = [compute_operators(*shape, 5) for shape in shapes]
    for folder in (None, tmp_path, tmp_path):
        columns = get_all_operators(verts, faces, 5, folder)
        assert [len(column) for column in columns] == [3] * 7
        for i, parts in enumerate(single):
            for column, part in zip(columns, parts, strict=True):
                torch.testing.assert_close(column[i].to_dense(), part.to_dense())
    assert len(list(tmp_path.iterdir())) == 3
    with pytest.raises(ValueError, match="3 verts, but 1 faces"):
        get_all_operators(verts, faces[:1], 5)


def test_the_cache_hits_where_the_original_missed(tmp_path, monkeypatch):
    """float64 positions, int32 faces, fewer pairs: one file. Normals and options: another."""
    verts, faces = SPHERE[0] / 3, SPHERE[1]
    first = get_operators(verts, faces, 8, tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr("torchlb.io.cache.build_operator", None)
        again = get_operators(verts, faces.int(), 8, tmp_path)
        fewer = get_operators(verts, faces, k_eig=4, op_cache_dir=str(tmp_path))
    for ours, theirs in zip(first, again, strict=True):
        assert torch.equal(ours.to_dense(), theirs.to_dense())
    assert torch.equal(fewer[4], first[4][:, :4])
    assert len(list(tmp_path.iterdir())) == 1
    [file] = tmp_path.iterdir()
    before = file.stat().st_mtime_ns
    get_operators(verts, faces, 8, tmp_path, overwrite_cache=True)
    assert file.stat().st_mtime_ns > before
    get_operators(verts, faces, 8, tmp_path, operator="cotangent")
    get_operators(*CLOUD, 8, tmp_path, normals=CLOUD[0])
    turned = get_operators(*CLOUD, 8, tmp_path, normals=-CLOUD[0])
    assert len(list(tmp_path.iterdir())) == 4
    assert (turned[0][:, 2] * CLOUD[0]).sum(1).max() < 0


def test_given_normals_orient_a_mesh():
    frames, *_, gradY = get_operators(*SPHERE, 0, normals=-SPHERE[0])
    assert (frames[:, 2] * SPHERE[0]).sum(1).max() < 0
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(200).double())
    a = torch.tensor([0.3, -1.2, 0.7]).double()
    assert (torch.mv(gradY, SPHERE[0] @ a) - frames[:, 1] @ a).abs().max() < 0.02


def test_what_broke_the_original():
    """k_eig ≥ V, few points, faces=None, vertices that require a gradient: they work. NaN: a clear error."""
    verts, faces = Sphere().mesh(25)
    verts = verts.float().requires_grad_()
    frames, _, _, evals, evecs, *_ = get_operators(verts, faces, k_eig=128, order=1)
    assert (tuple(evals.shape), tuple(evecs.shape)) == ((25,), (25, 25))
    assert not frames.requires_grad
    assert len(get_operators(verts, None, k_eig=4, order=1)[3]) == 4
    none = get_operators(verts, faces, k_eig=0, order=1)
    assert (tuple(none[3].shape), tuple(none[4].shape)) == ((0,), (25, 0))
    with pytest.raises(ValueError, match="NaN"):
        get_operators(verts * float("nan"), faces)
    with pytest.raises(ValueError, match=r"verts: expected shape \(V, 3\), got \(25, 2\)"):
        get_operators(verts[:, :2], faces)


@pytest.mark.parametrize("method", ["spectral", "implicit_dense"])
@pytest.mark.parametrize("name", ["stencil", "cotangent", "cloud"])
def test_an_unmodified_diffusionnet_trains_on_the_tuple(name, method):
    """Ten steps towards the height; the loss falls to less than half."""
    (verts, faces), options = INPUTS[name]
    verts = verts.float()
    _, mass, L, evals, evecs, gradX, gradY = get_operators(verts, faces, k_eig=32, **options)
    net = OriginalDiffusionNet(3, 1, diffusion_method=method)
    optimizer = torch.optim.Adam(net.parameters(), lr=0.01)
    losses = []
    for _ in range(10):
        optimizer.zero_grad()
        y = net(verts, mass, L=L, evals=evals, evecs=evecs, gradX=gradX, gradY=gradY)
        loss = (y[:, 0] - verts[:, 2]).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize("shape", [SPHERE, ELLIPSOID], ids=["sphere", "ellipsoid"])
def test_the_network_on_the_tuple_is_torchlbs_own_on_the_operator(shape):
    """Same weights, spectral diffusion: the same outputs, gradient features and their handedness included.

    But for the mass, which has to be diagonal in the tuple.
    """
    verts, faces = shape
    original = OriginalDiffusionNet(3, 4).double()
    for block in original.blocks:
        nn.init.uniform_(block.diffusion.diffusion_time, 0.01, 0.3)
    _, mass, L, evals, evecs, gradX, gradY = get_operators(verts, faces, k_eig=20)
    ours = torchlb.DiffusionNet(
        3, 4, width=8, num_blocks=2, method="spectral", dropout=False, k=20
    ).double()
    ours.load_original_state_dict(original.state_dict())
    y = original(verts, mass, L, evals, evecs, gradX, gradY)
    torch.testing.assert_close(
        ours(verts, LaplaceBeltrami.from_mesh(verts, faces)), y, rtol=1e-6, atol=5e-5
    )
