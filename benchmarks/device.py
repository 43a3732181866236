"""Seconds of solves where the tensors are: python benchmarks/device.py [--device cuda] [--sizes N ...]

A star-shaped surface, order 3: eigenpairs, a flow, a step, a Poisson problem, tangent eigenfields, the operator at
other points, and the derivative of eigenvalues in them. Each is measured on the CPU, with one thread and with all, and
on the device; the medians of the runs after a first one, factors and bases made anew each time. The last column has the
largest difference of the results from the CPU's, relative to their largest entry. Without a device the columns of the
CPU stand alone.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from collections.abc import Callable

import torch
from _common import versions

from torchlb import LaplaceBeltrami, heat_flow, implicit_step, poisson_solve
from torchlb.surfaces import StarShaped

RUNS = 3


def of_points(lb: LaplaceBeltrami) -> torch.Tensor:
    points = lb.points.detach().clone().requires_grad_()
    values = lb.at(points).eigenbasis(40).eigenvalues[1:]
    return torch.autograd.grad(values.log().sum(), points)[0]


def moved(lb: LaplaceBeltrami) -> torch.Tensor:
    there = lb.at(1.01 * lb.points)
    return torch.cat([there.weak.values.flatten(), there.stencil.values.flatten()])


TASKS: dict[str, Callable[[LaplaceBeltrami, torch.Tensor], torch.Tensor]] = {
    "128 eigenpairs": lambda lb, f: lb.eigenbasis(128).eigenvalues[1:],
    "heat_flow, 64 channels": lambda lb, f: heat_flow(lb, f, 0.1),
    "implicit_step, 64 channels": lambda lb, f: implicit_step(lb, f, 0.1),
    "poisson_solve, 64 channels": lambda lb, f: poisson_solve(
        lb, f - lb.integral(f) / lb.mass.sum()
    ),
    "16 tangent eigenfields": lambda lb, f: lb.connection.eigenbasis(16).eigenvalues,
    "lb.at": lambda lb, f: moved(lb),
    "derivative of 39 eigenvalues": lambda lb, f: of_points(lb),
}


def measured(task: Callable[..., torch.Tensor], lb: LaplaceBeltrami) -> tuple[float, torch.Tensor]:
    """The median of the seconds, and the result on the CPU."""
    generator = torch.Generator().manual_seed(0)
    f = torch.randn(lb.num_points, 64, generator=generator, dtype=torch.float64)
    seconds, result = [], f
    for _ in range(RUNS + 1):
        fresh = copy.deepcopy(lb)  # without factors and bases
        own = f.to(lb.device)
        start = time.perf_counter()
        result = task(fresh, own).cpu()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:]), result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--sizes", type=int, nargs="*", default=[10_000])
    arguments = parser.parse_args()
    print(*versions(), sep="\n\n", end="\n\n")
    threads, there = torch.get_num_threads(), arguments.device != "cpu"
    name = torch.cuda.get_device_name(arguments.device) if there else ""
    print(f"| vertices | | one thread | {threads} threads | {name} | times | difference |")
    print("|--:|:--|--:|--:|--:|--:|--:|")
    for size in arguments.sizes:
        lb = LaplaceBeltrami.from_mesh(*StarShaped().mesh(size))
        for task, call in TASKS.items():
            torch.set_num_threads(1)
            alone, expected = measured(call, lb)
            torch.set_num_threads(threads)
            row = [f"{size:,}", task, f"{alone:.2f} s", f"{measured(call, lb)[0]:.2f} s"]
            if there:
                seconds, found = measured(call, copy.deepcopy(lb).to(arguments.device))
                error = float((found - expected).abs().max() / expected.abs().max())
                row += [f"{seconds:.2f} s", f"{alone / seconds:.1f}", f"{error:.0e}"]
            print("|", " | ".join(row + ["–"] * (7 - len(row))), "|", flush=True)


if __name__ == "__main__":
    main()
