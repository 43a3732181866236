"""Cost and accuracy of derivatives in the points, a Markdown table: python benchmarks/shape_derivatives.py [MESH ...]

Σ log λ_1 … log λ_40, forward and backward, beside a build with 41 eigenpairs alone; processor time of one thread, the
least of three. The gradient times the points is −80 exactly, since λ falls as the size squared; force and torque are
zero, over the gradient's norm. The last column is a difference quotient in a random smooth direction of `lb.at`, at
tolerance 1e-11, relative. Without a mesh: star-shaped surfaces.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from _common import peak, versions
from torch import Tensor

from torchlb import LaplaceBeltrami, read_shape
from torchlb.surfaces import StarShaped

STEP = 1e-6


def logarithms(lb: LaplaceBeltrami) -> Tensor:
    return lb.eigenbasis(41, tolerance=1e-11).eigenvalues[1:].log().sum()


def least(function: Callable[[], Any]) -> tuple[float, Any]:
    """Processor time of three calls, and what the last one gives."""
    seconds, result = [], None
    for _ in range(3):
        start = time.process_time()
        result = function()
        seconds.append(time.process_time() - start)
    return min(seconds), result


def row(name: str, vertices: Tensor, faces: Tensor) -> str:
    def gradient() -> Tensor:
        x = vertices.clone().requires_grad_()
        lb = LaplaceBeltrami.from_mesh(x, faces, progress=False)
        return torch.autograd.grad(lb.eigenbasis(41).eigenvalues[1:].log().sum(), x)[0]

    alone, _ = least(
        lambda: LaplaceBeltrami.from_mesh(vertices, faces, progress=False).eigenbasis(41)
    )
    both, _ = least(gradient)
    lb = LaplaceBeltrami.from_mesh(vertices, faces, progress=False)
    size = vertices.std()
    way = size * torch.sin(vertices.roll(1, 1) * 3 / size)
    ahead, behind = (logarithms(lb.at(vertices + s * STEP * way)) for s in (1, -1))
    x = vertices.clone().requires_grad_()
    (exact,) = torch.autograd.grad(logarithms(lb.at(x)), x)
    quotient = (ahead - behind) / (2 * STEP)
    missed = abs(float(quotient / (exact * way).sum() - 1))
    scaling = abs(float((exact * vertices).sum() + 80))
    force = exact.sum(0).abs().max() / exact.norm()
    torque = torch.linalg.cross(vertices, exact).sum(0).abs().max() / exact.norm()
    cells = [name, len(vertices), f"{alone:.2f}", f"{both:.2f}", f"{both / alone:.2f}"]
    cells += [
        f"{peak() / 1024:.1f}",
        f"{scaling:.0e}",
        f"{max(force, torque):.0e}",
        f"{missed:.0e}",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    torch.set_num_threads(1)
    print(*versions(), sep="\n\n", end="\n\n")
    print(
        "| shape | N | build and pairs, s | with gradient, s | ratio | GiB | g·x + 80 | force, torque | quotient |"
    )
    print("|:--|--:|--:|--:|--:|--:|--:|--:|--:|")
    if len(sys.argv) == 1:
        for count in (1000, 4000, 13_000):
            print(row("StarShaped", *StarShaped().mesh(count)), flush=True)
    for path in sys.argv[1:]:
        vertices, faces = read_shape(path)
        assert faces is not None, f"{path} has no faces"
        print(row(path, vertices.double(), faces), flush=True)


if __name__ == "__main__":
    main()
