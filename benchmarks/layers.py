"""Speed of the layers, as Markdown tables: python benchmarks/layers.py [--quick] [--device cuda].

The sparse product forward and backward, beside torch's own on the same matrix and a copy of as many bytes; gradients
and a training step of DiffusionNet, beside the same on DiffusionNet's own operators and sparse format
(benchmarks/learning.py); the same step compiled, on shapes of five sizes; an epoch on eight shapes, one by one and in a
batch. The rows of a table are timed in turns, so that a busy machine slows all of them, and the median is printed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch._dynamo
from _common import versions
from learning import Original
from torch.nn.functional import cross_entropy

from torchlb import DiffusionNet, LaplaceBeltrami
from torchlb.surfaces import StarShaped

COMMUNICATION = {
    "spectral": {},
    "implicit": {"block": "implicit"},
    "Poisson": {"block": "poisson"},
    "tangent": {"tangent": True},
    "tangent, implicit": {"tangent": True, "block": "implicit"},
}
"""How the points of a network hear of each other."""


def medians(
    steps: dict[str, Callable[[], object]], repeats: int, device: str
) -> dict[str, list[float]]:
    """Seconds of each step, all of them once a round; two rounds to warm up are left out."""
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(repeats + 2):
        for name, step in steps.items():
            start = now(device)
            step()
            seconds[name].append(now(device) - start)
    return {name: column[2:] for name, column in seconds.items()}


def now(device: str) -> float:
    """Seconds, once a GPU has done what it was given; on the CPU those of the processor."""
    if not device.startswith("cuda"):
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def table(title: str, seconds: dict[str, list[float]], baseline: str) -> None:
    """Medians, and their ratios to the baseline's."""
    print(f"\n### {title}\n\n| | ms | of {baseline} |\n|:--|--:|--:|")
    base = np.median(seconds[baseline])
    for name, column in seconds.items():
        print(f"| {name} | {1e3 * np.median(column):.2f} | {np.median(column) / base:.2f} |")


def both_ways(
    multiply: Callable[[torch.Tensor], torch.Tensor], x: torch.Tensor
) -> Callable[[], torch.Tensor]:
    """A product and its derivative."""
    weights = torch.randn_like(multiply(x).detach())
    return lambda: torch.autograd.grad(multiply(x), x, weights)[0]


def product(lb: LaplaceBeltrami, channels: int, repeats: int, device: str) -> None:
    """The last row copies what is read and written at least: matrix, features and result, both ways."""
    x = torch.randn(lb.num_points, channels, device=device, requires_grad=True)
    csr, coo = lb.matrix, lb.matrix.to_sparse_coo().coalesce()
    products = {"torchlb": lb, "torch CSR": lambda x: csr @ x, "torch COO": lambda x: coo @ x}
    steps = {}
    for name, multiply in products.items():
        torch.manual_seed(0)
        steps[name] = both_ways(multiply, x)
    reference = steps["torch COO"]()
    for name, step in steps.items():
        worst = ((step() - reference).abs().max() / reference.abs().max()).item()
        if worst > 1e-5:
            raise ArithmeticError(f"{name}: gradient off by {worst:.1e}")
    matrix = (csr.crow_indices(), csr.col_indices(), csr.values())
    moved = 2 * sum(t.nbytes for t in matrix) + 4 * x.nbytes
    source = torch.empty(moved // 2, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    steps["copy"] = lambda: target.copy_(source)
    title = f"Sparse product, forward and backward, N = {lb.num_points:,}, C = {channels}, "
    title += f"{lb.stencil.col.numel() / lb.num_points:.0f} entries a row"
    table(title, medians(steps, repeats, device), "torch CSR")


def gradients(shape: dict[str, Any], channels: int, repeats: int, device: str) -> None:
    x = torch.randn(shape["original"].num_points, channels, device=device, requires_grad=True)
    steps = {name: both_ways(lb.local_gradient, x) for name, lb in shape.items()}
    title = f"Gradients, forward and backward, N = {len(x):,}, C = {channels}"
    table(title, medians(steps, repeats, device), "original")


def training_step(shape: dict[str, object], width: int, k: int, repeats: int, device: str) -> None:
    """`shape`: operators by name, (of which "original" only has the spectral diffusion)."""
    steps = {}
    for kind, lb in shape.items():
        for name in COMMUNICATION if kind != "original" else ("spectral",):
            steps[f"{kind}, {name}"] = step_of(lb, name, width, k, device)
    title = f"Training step of 4 blocks, width = {width}, k = {k}"
    table(title, medians(steps, repeats, device), "original, spectral")


def step_of(
    lb: object, name: str, width: int, k: int, device: str, net: Any = None
) -> Callable[[], None]:
    if net is None:
        torch.manual_seed(0)
        net = DiffusionNet(3, 8, width=width, k=k, **COMMUNICATION[name]).to(device)
    optimizer = torch.optim.Adam(net.parameters())
    points = lb.points.to(device)  # type: ignore[attr-defined]
    labels = (points[:, 0] > 0).long()

    def step() -> None:
        optimizer.zero_grad()
        cross_entropy(net(points, lb), labels).backward()  # type: ignore[arg-type]
        optimizer.step()

    return step


def compiled(points: int, width: int, k: int, repeats: int, device: str) -> None:
    """Steps of one network on five sizes, spectral; with CUDA graphs, too, where there are any."""
    options: dict[str, dict[str, Any]] = {"dynamic=True": {"dynamic": True}}
    if device.startswith("cuda"):
        options["reduce-overhead"] = {"dynamic": True, "mode": "reduce-overhead"}
    print(f"\n### Compiled training step of 4 blocks, width = {width}, k = {k}\n")
    print(
        "| points | options | eager, ms | compiled, ms | of eager | first step, s | graphs so far |"
    )
    print("|--:|:--|" + "--:|" * 5)
    meshes = [StarShaped().mesh(round(share * points)) for share in (0.1, 0.2, 0.3, 0.5, 1.0)]
    shapes = [LaplaceBeltrami.from_mesh(*mesh) for mesh in meshes]
    for lb in shapes:
        lb.eigenbasis(k)
        lb.float().to(device)
    for name, chosen in options.items():
        torch._dynamo.reset()
        torch._dynamo.utils.counters.clear()
        net = torch.compile(DiffusionNet(3, 8, width=width, k=k).to(device), **chosen)
        for lb in shapes:
            eager = step_of(lb, "spectral", width, k, device)
            step, start = step_of(lb, "spectral", width, k, device, net), time.perf_counter()
            step()
            first = time.perf_counter() - start
            columns = medians({"eager": eager, name: step}, repeats, device).values()
            before, after = (1e3 * np.median(column) for column in columns)
            cells = [f"{lb.num_points:,}", name, f"{before:.1f}", f"{after:.1f}"]
            cells += [f"{after / before:.2f}", f"{first:.0f}"]
            cells += [str(torch._dynamo.utils.counters["stats"]["unique_graphs"])]
            print("| " + " | ".join(cells) + " |", flush=True)


def epoch(shapes: list[LaplaceBeltrami], width: int, k: int, repeats: int, device: str) -> None:
    """A training step for each shape, against a single step for all of them."""
    batch = LaplaceBeltrami.batch(shapes)
    for method in ("spectral", "implicit", "Poisson"):
        alone = [step_of(lb, method, width, k, device) for lb in shapes]
        steps = {
            "one by one, 8 steps": lambda alone=alone: [step() for step in alone],
            "batch, 1 step": step_of(batch, method, width, k, device),
        }
        sizes = [lb.num_points for lb in shapes]
        title = f"Epoch of 8 shapes of {min(sizes):,} to {max(sizes):,} points, {method}"
        table(title, medians(steps, repeats, device), "one by one, 8 steps")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small, few repeats: does it run?")
    parser.add_argument("--points", type=int, default=10000)
    parser.add_argument("--channels", type=int, default=64)
    parser.add_argument("--k", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--copies", type=int, default=1, help="in a batch, for one more product")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    if options.quick:
        options.points, options.channels, options.k, options.repeats = 500, 8, 24, 3
    torch.set_num_threads(1)
    print("# Layers\n", *versions(), sep="\n")
    where = options.device
    if where.startswith("cuda"):
        where = torch.cuda.get_device_name(where)
    print(f"\nOn {where}, one thread; float32; on the CPU processor time.")
    vertices, faces = StarShaped().mesh(options.points)
    stencil = LaplaceBeltrami.from_mesh(vertices, faces)
    cotangent = LaplaceBeltrami.from_cotangent(vertices, faces)
    original = Original(vertices, faces, options.k)
    for lb in (stencil, cotangent):
        lb.eigenbasis(options.k)
        lb.float().to(options.device)
    original.to(options.device)
    product(stencil, options.channels, options.repeats, options.device)
    if options.copies > 1:
        many = LaplaceBeltrami.batch([stencil] * options.copies)
        product(many, options.channels, options.repeats, options.device)
        del many
    shape = {"torchlb": stencil, "cotangent": cotangent, "original": original}
    gradients(shape, options.channels, options.repeats, options.device)
    training_step(shape, options.channels, options.k, options.repeats, options.device)
    compiled(options.points, options.channels, options.k, options.repeats, options.device)
    for smallest, largest in ((700, 2000), (3000, 6000)):
        scale = options.points / 10000
        shapes = [
            LaplaceBeltrami.from_mesh(*StarShaped().mesh(int(scale * n)))
            for n in np.linspace(smallest, largest, 8)
        ]
        for lb in shapes:
            lb.eigenbasis(options.k)
            lb.float().to(options.device)
        epoch(shapes, options.channels, options.k, options.repeats, options.device)


if __name__ == "__main__":
    main()
