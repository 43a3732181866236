"""A task for tangent fields, as a Markdown table: python benchmarks/tangent_learning.py [--data PATH] [--quick].

Networks predict the direction of the larger principal curvature, up to its sign, on shapes that are turned at random in
training and in the test. PATH is that of examples/train_segmentation.py (without it, its ellipsoids); two of three
shapes train, as meshes of about `--points` vertices. The target is made of the shape operator by the whole mesh, its
mean over the vertices nearest to each of the smaller mesh, smoothed by an implicit step of `SMOOTHING`. A point counts
by its area, and by (κ₁ − κ₂)²/(κ₁² + κ₂²), which is zero where there is no direction.

All networks have logarithms of heat kernel signatures as inputs. Those that predict space vectors, of which the
tangential part counts, have x, y, z, too. One of them sees upright shapes only, in training and in the test.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _common import versions
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import cosine_similarity
from tqdm import tqdm

from torchlb import DiffusionNet, LaplaceBeltrami, heat_kernel_signature, implicit_step

sys.path.append(str(Path(__file__).parents[1] / "examples"))
from train_segmentation import decimated, read, turn

SMOOTHING = 0.003
TIMES = torch.logspace(-2, 0, 8, dtype=torch.float64)
KINDS = {
    "tangent, fields": {"tangent": True, "outputs_at": "tangent"},
    "scalar, the gradient of a function": {},
    "scalar, space vectors": {},
    "scalar, space vectors, upright": {},
}


class Shape(NamedTuple):
    lb: LaplaceBeltrami
    inputs: Tensor  # (N, 8)
    target: Tensor  # (N, 3)
    weight: Tensor  # (N,), of sum 1


def shape_of(vertices: Tensor, faces: Tensor, labels: Tensor, size: int, k: int) -> Shape:
    fine = LaplaceBeltrami.from_mesh(vertices, faces, weak_form=False, progress=False)
    tensors = fine.frames @ fine.curvatures().shape_operator @ fine.frames.mT
    coarse, triangles, _ = decimated(vertices, faces, labels, size)
    nearest = torch.tensor(KDTree(coarse.numpy()).query(vertices.numpy())[1])
    area = coarse.new_zeros(len(coarse)).index_add(0, nearest, fine.mass).clamp_min(1e-12)
    weighted = fine.mass[:, None] * tensors.flatten(1)
    mean = coarse.new_zeros(len(coarse), 9).index_add(0, nearest, weighted) / area[:, None]
    lb = LaplaceBeltrami.from_mesh(coarse, triangles, progress=False)
    smooth = implicit_step(lb, mean, SMOOTHING).unflatten(1, (3, 3))
    curvatures, directions = torch.linalg.eigh(lb.frames.mT @ smooth @ lb.frames)
    target = (lb.frames @ directions)[:, :, 1]
    distinct = curvatures.diff(dim=1)[:, 0].square() / curvatures.square().sum(1)
    weight = distinct * lb.mass
    inputs = heat_kernel_signature(lb, TIMES, k=k).log()
    lb.eigenbasis(k)
    lb = lb.float()  # the eigenfields follow the type
    lb.connection.eigenbasis(k)
    parts = (inputs - inputs.mean(0), target, weight / weight.sum())
    return Shape(lb, *(part.float() for part in parts))


class Predictor(torch.nn.Module):
    """A network of a kind, and the tangent field that it predicts on a shape which is turned."""

    def __init__(self, kind: str, width: int, blocks: int, k: int) -> None:
        super().__init__()
        self.kind, self.of_space = kind, "space vectors" in kind
        channels = (len(TIMES) + 3, 3) if self.of_space else (len(TIMES), 1)
        options = {"width": width, "num_blocks": blocks, "k": k, "dropout": False}
        self.net = DiffusionNet(*channels, **options, **KINDS[kind])

    def forward(self, shape: Shape, rotation: Tensor) -> Tensor:
        if not self.of_space:  # of inputs that do not see a rotation
            result = self.net(shape.inputs, shape.lb)
            return (result if "fields" in self.kind else shape.lb.gradient(result))[..., 0]
        if "upright" in self.kind:
            rotation = torch.eye(3)
        turned = shape.lb.points @ rotation
        v = self.net(torch.cat([shape.inputs, turned], 1), shape.lb) @ rotation.T
        normals = shape.lb.normals
        return v - (v * normals).sum(1, keepdim=True) * normals


def cosines(predictor: Predictor, shape: Shape) -> Tensor:
    return cosine_similarity(predictor(shape, turn()), shape.target, dim=1, eps=1e-12)


def run(kind: str, shapes: list[Shape], seed: int, options: argparse.Namespace) -> dict[str, float]:
    """Mean angles to the target on training and test shapes, and the median seconds of an epoch."""
    torch.manual_seed(seed)
    predictor = Predictor(kind, options.width, options.blocks, options.k)
    optimizer = torch.optim.Adam(predictor.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.epochs)
    sets = {"train": [s for i, s in enumerate(shapes) if i % 3 < 2], "test": shapes[2::3]}
    seconds = []
    for _ in tqdm(range(options.epochs), f"{kind}, seed {seed}", leave=False):
        start = time.perf_counter()
        for i in torch.randperm(len(sets["train"])).tolist():
            shape = sets["train"][i]
            optimizer.zero_grad()
            (shape.weight * (1 - cosines(predictor, shape).square())).sum().backward()
            optimizer.step()
        schedule.step()
        seconds.append(time.perf_counter() - start)
    found = {"seconds": float(np.median(seconds))}
    found["parameters"] = sum(p.numel() for p in predictor.parameters())
    with torch.no_grad():
        for name, part in sets.items():
            angles = [
                s.weight @ cosines(predictor, s).abs().clamp_max(1).acos().rad2deg() for s in part
            ]
            found[name] = float(torch.stack(angles).mean())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--quick", action="store_true", help="few points and epochs: does it run?")
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--k", type=int, default=64)
    parser.add_argument("--width", type=int, default=32)
    parser.add_argument("--blocks", type=int, default=3)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    options = parser.parse_args()
    if options.quick:
        options.points, options.epochs, options.k, options.width, options.seeds = 200, 2, 16, 8, 2
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", message=".*low-order rows")
    whole = tqdm(read(options.data), "operators", leave=False)
    shapes = [shape_of(*each, options.points, options.k) for each in whole]
    train = sum(i % 3 < 2 for i in range(len(shapes)))
    print("# Tangent fields\n", *versions(), sep="\n")
    print(
        f"\n{train} shapes train, {len(shapes) - train} test; {options.points} points, {options.epochs} epochs of Adam "
        f"(3e-3, cosine), width={options.width}, num_blocks={options.blocks}, k={options.k}; mean angle in degrees, "
        f"mean ± deviation of {options.seeds} seeds; 45 is chance; one thread.\n"
    )
    columns = ["network", "test", "training", "test, seed by seed", "parameters", "s an epoch"]
    print("| " + " | ".join(columns) + " |\n|:--|" + "--:|" * (len(columns) - 1), flush=True)
    for kind in options.kinds:
        runs = [run(kind, shapes, seed, options) for seed in range(options.seeds)]
        cells = [kind]
        for name in ("test", "train"):
            angles = [each[name] for each in runs]
            cells.append(f"{np.mean(angles):.1f} ± {np.std(angles):.1f}")
        cells.append(", ".join(f"{each['test']:.1f}" for each in runs))
        cells.append(f"{runs[0]['parameters']:,}")
        cells.append(f"{np.median([each['seconds'] for each in runs]):.2f}")
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
