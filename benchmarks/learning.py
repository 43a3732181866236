"""The same DiffusionNet on different operators, as a Markdown table: python benchmarks/learning.py [--data PATH].

PATH is that of examples/train_segmentation.py (without it, its ellipsoids): two of three shapes train as meshes of
about `--train` vertices, `--points` unless given. The others test as meshes of `--points`, decimated by quadric error
instead of by edge length, with half and twice as many vertices, refined once to the limit of Loop's subdivision, as
clouds of as many points on the undecimated meshes, and as these with Gaussian noise of a tenth of √(area/N). Inputs are
x, y, z, every shape turned at random, also those that test. Weights, order and turns of a seed are the same for all
operators.

torchlb: `from_mesh`, and `from_points` on clouds. cotangent: `from_cotangent`; it has none for clouds, which get
torchlb's. original: what DiffusionNet's own code computes, written from its description: potpourri3d's cotangent
matrix and lumped mass on meshes, robust_laplacian on clouds, `eigsh` at 1e-8, gradients by least squares over the one
ring or 30 neighbours; its diffusion is the spectral one. Gradients are not rotated (`rotations=False`),
which a cloud without oriented normals asks for in either code. Implicit blocks solve by P1 elements, or with the weak
pair to `--tolerance`.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import igl
import numpy as np
import potpourri3d
import robust_laplacian
import torch
from _common import versions
from scipy import sparse
from scipy.sparse.linalg import eigsh
from scipy.spatial import KDTree
from torch import Tensor
from tqdm import tqdm

from torchlb import (
    DiffusionNet,
    Eigenbasis,
    ImplicitDiffusion,
    InputError,
    LaplaceBeltrami,
    heat_kernel_signature,
)
from torchlb.surfaces import limit_surface

sys.path.append(str(Path(__file__).parents[1] / "examples"))
from train_segmentation import decimated, evaluate, read, sampled, train_epoch

Shape = tuple[Tensor, Tensor | None, Tensor]  # vertices, faces (None for a cloud), labels
NEIGHBORS = 30


class Original:
    """DiffusionNet's own operators of one shape, with what a network asks of a `LaplaceBeltrami`."""

    dim, sizes = 2, ()

    def __init__(self, vertices: Tensor, faces: Tensor | None, k: int) -> None:
        points = vertices.numpy()
        if faces is None:
            weak, lumped = robust_laplacian.point_cloud_laplacian(points)
            mass = lumped.diagonal()
        else:
            weak = potpourri3d.cotan_laplacian(points, faces.numpy(), denom_eps=1e-10)
            mass = potpourri3d.vertex_areas(points, faces.numpy())
            mass = mass + 1e-8 * mass.mean()
        shifted = sparse.csc_matrix(weak + 1e-8 * sparse.identity(len(points)))
        values, vectors = eigsh(shifted, k, sparse.diags(mass), sigma=1e-8)
        self.points, self.num_points, self.mass = vertices.float(), len(points), tensor(mass)
        evecs = tensor(vectors)
        self.basis = Eigenbasis(
            tensor(values).clamp_min(0), evecs, self.mass, evecs * self.mass[:, None]
        )
        self.modes = self
        self.count = k
        gradients = tangent_gradients(points, None if faces is None else faces.numpy())
        self.stencil = Gradients(gradients)

    def to(self, device: str) -> Original:
        """Itself, on another device."""
        for name in ("points", "mass", "stencil"):
            setattr(self, name, getattr(self, name).to(device))
        parts = (self.basis.eigenvalues, self.basis.eigenvectors, self.mass, self.basis.left)
        self.basis = Eigenbasis(*(part.to(device) for part in parts))
        return self

    _has_weak_form = True  # its basis stands for a pair

    def eigenbasis(self, k: int) -> Eigenbasis:
        return self.basis.truncate(k)

    def has(self, k: int) -> bool:
        return k <= self.count

    def local_gradient(self, x: Tensor) -> Tensor:
        return torch.stack([torch.mm(values, x) for values in self.stencil], dim=1)


class Gradients(tuple[Tensor, ...]):
    """The sparse matrices of the two components."""

    def to(self, where: Any) -> Gradients:
        """The same of another type, or on another device."""
        return Gradients(matrix.to(where) for matrix in self)

    def product(self, channel: int, x: Tensor, *, dtype: torch.dtype) -> Tensor:
        """A component; the first channel of an operator's is Δ."""
        return torch.mm(self[channel - 1].to(dtype), x)


def tensor(array: Any) -> Tensor:
    return torch.tensor(np.ascontiguousarray(array), dtype=torch.float32)


def tangent_gradients(points: np.ndarray, faces: np.ndarray | None) -> list[Tensor]:
    """The two components of the gradient: (EᵀE + 1e-5)⁻¹Eᵀ(f_j − f_i), E the edges in the tangent plane."""
    n = len(points)
    if faces is None:
        tails = KDTree(points).query(points, NEIGHBORS + 1)[1][:, 1:]
        near = points[tails] - points[tails].mean(1, keepdims=True)
        normals = np.linalg.svd(near, full_matrices=False)[2][:, 2]
        heads, tails = np.repeat(np.arange(n), NEIGHBORS), tails.ravel()
    else:
        normals = igl.per_vertex_normals(points, faces)
        ring = sparse.csr_array(igl.adjacency_matrix(faces))
        heads, tails = ring.nonzero()
    axis = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = axis - (axis * normals).sum(1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normals, first)], axis=1)  # (N, 2, 3)
    edges = np.einsum("eij,ej->ei", frames[heads], points[tails] - points[heads])
    normal_matrix = np.tile(1e-5 * np.eye(2), (n, 1, 1))
    np.add.at(normal_matrix, heads, edges[:, :, None] * edges[:, None, :])
    weights = np.linalg.solve(normal_matrix[heads], edges[..., None])[..., 0]
    index = torch.tensor(np.stack([np.append(heads, heads), np.append(tails, heads)]))
    return [
        torch.sparse_coo_tensor(index, tensor(np.append(w, -w)), (n, n)).coalesce()
        for w in weights.T
    ]


def build(kind: str, shape: Shape, k: int) -> Any:
    vertices, faces, _ = shape
    if kind == "original":
        return Original(vertices, faces, k)
    if faces is None:
        lb = LaplaceBeltrami.from_points(vertices, progress=False)
    elif kind == "cotangent":
        lb = LaplaceBeltrami.from_cotangent(vertices, faces)
    else:
        lb = LaplaceBeltrami.from_mesh(vertices, faces, progress=False)
    lb.eigenbasis(k)
    return lb.float()


def by_quadrics(vertices: Tensor, faces: Tensor, labels: Tensor, size: int) -> Shape:
    """A mesh of about `size` vertices, dense where it is curved and with slivers where it is not."""
    if len(vertices) <= size:
        return vertices, faces, labels
    coarse, triangles, _, origin = igl.qslim(vertices.numpy(), faces.numpy(), 2 * size)
    if len(coarse) == 0:
        return vertices, faces, labels
    return torch.tensor(coarse), torch.tensor(triangles), labels[torch.tensor(origin)]


def refined(vertices: Tensor, faces: Tensor, labels: Tensor, size: int) -> Shape:
    """The decimated mesh on its smooth limit, with four times as many vertices; each with the nearest old label."""
    vertices, faces, labels = decimated(vertices, faces, labels, size)
    try:
        points, meshes = limit_surface(vertices, faces, 1)
    except InputError:  # open, or a pinch that decimation left
        return vertices, faces, labels
    return points, meshes[1], labels[KDTree(vertices.numpy()).query(points.numpy())[1]]


def noisy(vertices: Tensor, faces: Tensor, labels: Tensor, size: int, seed: int) -> Shape:
    """A cloud whose points are off by a tenth of the spacing."""
    points, _, found = sampled(vertices, faces, labels, size, seed=seed)
    spacing = float(igl.doublearea(vertices.numpy(), faces.numpy()).sum() / 2 / len(points)) ** 0.5
    random = torch.Generator().manual_seed(seed)
    noise = torch.randn(points.shape, dtype=points.dtype, generator=random)
    return points + 0.1 * spacing * noise, None, found


class OnSignatures(torch.nn.Module):
    """A network whose features are heat kernel signatures, at 16 times from 0.01 to 1, in place of coordinates."""

    def __init__(self, net: torch.nn.Module, k: int) -> None:
        super().__init__()
        self.net, self.k, self.times = net, k, torch.logspace(-2, 0, 16)

    def forward(self, _: Tensor, lb: LaplaceBeltrami) -> Tensor:
        return self.net(heat_kernel_signature(lb, self.times, k=self.k).float(), lb)


def test_sets(whole: list[Any], size: int, names: list[str]) -> dict[str, list[Shape]]:
    makers: dict[str, Callable[..., Any]] = {
        "meshes": lambda i, s: decimated(*s, size),
        "by quadrics": lambda i, s: by_quadrics(*s, size),
        "half": lambda i, s: decimated(*s, size // 2),
        "twice": lambda i, s: decimated(*s, 2 * size),
        "refined": lambda i, s: refined(*s, size),
        "clouds": lambda i, s: sampled(*s, size, seed=i),
        "noisy clouds": lambda i, s: noisy(*s, size, seed=i),
    }
    return {name: [makers[name](i, s) for i, s in enumerate(whole)] for name in names or makers}


def precompute(kind: str, sets: dict[str, list[Shape]], k: int) -> tuple[dict[str, list[Any]], str]:
    """Operators and labels of all sets, and the mean seconds of a mesh and of a cloud."""
    found: dict[str, list[Any]] = {}
    seconds: dict[bool, list[float]] = {False: [], True: []}
    for name, shapes in sets.items():
        found[name] = []
        for shape in tqdm(shapes, f"{kind}, {name}", leave=False):
            start = time.perf_counter()
            found[name].append((build(kind, shape, k), shape[2]))
            seconds[shape[1] is None].append(time.perf_counter() - start)
    return found, " / ".join(f"{np.mean(seconds[cloud]):.2f}" for cloud in (False, True))


def run(
    layer: str, data: dict[str, list[Any]], classes: int, seed: int, options: argparse.Namespace
) -> tuple[dict[str, float], float]:
    """Accuracies on the test sets of one training, and the median seconds of an epoch."""
    torch.manual_seed(seed)
    net: torch.nn.Module = DiffusionNet(
        16 if options.signatures else 3,
        classes,
        width=options.width,
        num_blocks=options.blocks,
        rotations=False,
        block=layer if layer in ("implicit", "poisson") else "diffusion",
        method="spectral" if layer in ("implicit", "poisson") else layer,
        k=options.k,
    )
    for part in net.modules():
        if isinstance(part, ImplicitDiffusion):
            part.tolerance = options.tolerance
    if options.signatures:
        net = OnSignatures(net, options.k)
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.epochs)
    seconds = []
    for epoch in tqdm(range(options.epochs), f"{layer}, seed {seed}", leave=False):
        start = time.perf_counter()
        train_epoch(net, optimizer, data["train"], 1000 * (seed + 1) + epoch)
        schedule.step()
        seconds.append(time.perf_counter() - start)
    accuracies = {name: evaluate(net, test)[0] for name, test in data.items() if name != "train"}
    return accuracies, float(np.median(seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--quick", action="store_true", help="few points and epochs: does it run?")
    parser.add_argument("--points", type=int, default=1500)
    parser.add_argument("--train", type=int, help="vertices to train on (default: --points)")
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--k", type=int, default=64)
    parser.add_argument("--width", type=int, default=32)
    parser.add_argument("--blocks", type=int, default=3)
    parser.add_argument("--tolerance", type=float, help="of implicit blocks (default: P1 elements)")
    parser.add_argument("--operators", nargs="+", default=["torchlb", "cotangent", "original"])
    parser.add_argument(
        "--layers",
        nargs="+",
        default=["spectral", "implicit", "poisson"],
        help="blocks, or methods of diffusion; on the original's operators spectral alone",
    )
    parser.add_argument("--sets", nargs="+", default=[], help="test sets (default: all)")
    parser.add_argument("--signatures", action="store_true", help="instead of coordinates")
    options = parser.parse_args()
    if options.quick:
        options.points, options.epochs, options.k, options.width = 300, 3, 24, 16
    torch.set_num_threads(1)
    shapes = read(options.data)
    size = options.train or options.points
    sets = {"train": [decimated(*s, size) for i, s in enumerate(shapes) if i % 3 < 2]}
    sets |= test_sets(shapes[2::3], options.points, options.sets)
    classes = int(max(labels.max() for _, _, labels in shapes)) + 1
    peers = ("potpourri3d", "robust_laplacian")
    print("# Learning\n", *versions(), sep="\n")
    print(
        "With", ", ".join(f"{name} {importlib.metadata.version(name)}" for name in peers), end="."
    )
    print(
        f"\n\n{len(sets['train'])} shapes train, {len(shapes[2::3])} test; {options.points} points, to train {size}, "
        f"{classes} labels, {options.epochs} epochs of Adam (3e-3, cosine), width={options.width}, "
        f"num_blocks={options.blocks}, k={options.k}; accuracy in % of the points, mean ± deviation of "
        f"{options.seeds} seeds; one thread.\n"
    )
    columns = ["operators", "layers", *list(sets)[1:], "s an epoch"]
    columns += ["s to precompute, a mesh / cloud"]
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns), flush=True)
    for kind in options.operators:
        data, cost = precompute(kind, sets, options.k)
        for layer in options.layers if kind != "original" else ["spectral"]:
            runs = [run(layer, data, classes, seed, options) for seed in range(options.seeds)]
            cells = [kind, layer]
            for name in list(sets)[1:]:
                values = [100 * accuracies[name] for accuracies, _ in runs]
                cells.append(f"{np.mean(values):.1f} ± {np.std(values):.1f}")
            cells += [f"{np.median([s for _, s in runs]):.2f}", cost]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
