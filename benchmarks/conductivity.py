"""A conductivity learned on real smooth shapes: python benchmarks/conductivity.py SHAPE.npz ... [--quick]

A shape has the control mesh of a limit surface of subdivision: `control`, `faces0`. u − t div(κ∇u) = f, t = 0.02, for
eight Gaussian sources; κ is the exponential of 20 waves. Data: the cotangent's solutions on levels 3 and 4 (77k and
307k vertices), extrapolated. κ is found by LBFGS through the solves, from the values at the vertices of levels 1 and 2
(4.8k, 19k). Printed are relative errors of u for the true κ and of κ, over the cotangent's in brackets.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from _common import versions
from torch import Tensor

from torchlb import LaplaceBeltrami, implicit_step
from torchlb.surfaces import limit_surface

TIME = 0.02
METHODS = {
    "cotangent": LaplaceBeltrami.from_cotangent,
    "weak pair, p = 3": LaplaceBeltrami.from_mesh,
}


def waves(points: Tensor) -> Tensor:
    """(N, 20)."""
    random = torch.Generator().manual_seed(0)
    directions = 8 * torch.randn(3, 20, dtype=torch.float64, generator=random)
    return torch.cos(points @ directions + torch.arange(20))


def learned(lb: LaplaceBeltrami, f: Tensor, seen: Tensor, functions: Tensor) -> tuple[Tensor, int]:
    """κ, and how many solves forward and backward it took."""
    coefficients = torch.zeros(20, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS(
        [coefficients],
        max_iter=300,
        max_eval=400,
        tolerance_grad=1e-10,
        tolerance_change=1e-15,
        line_search_fn="strong_wolfe",
    )
    count = 0

    def misfit() -> Tensor:
        nonlocal count
        count += 1
        optimizer.zero_grad()
        u = implicit_step(lb, f, TIME, conductivity=(functions @ coefficients).exp())
        loss = (u - seen).square().mean() / seen.square().mean()
        loss.backward()
        return loss

    optimizer.step(misfit)
    return (functions @ coefficients.detach()).exp(), count


def show(path: Path, quick: bool) -> None:
    shape = dict(np.load(path))
    control = torch.from_numpy(shape["control"].astype(float))
    points, meshes = limit_surface(control, torch.from_numpy(shape["faces0"].astype(np.int64)), 4)
    random = torch.Generator().manual_seed(1)
    centers = points[torch.randperm(len(control), generator=random)[:8]]
    f = (-50 * (points[:, None] - centers).square().sum(2)).exp()
    functions = waves(points)
    truth = (functions @ (0.2 * torch.randn(20, dtype=torch.float64, generator=random))).exp()
    data = []
    for faces in meshes[3:]:
        n = int(faces.max()) + 1
        lb = LaplaceBeltrami.from_cotangent(points[:n], faces)
        data.append(implicit_step(lb, f[:n], TIME, conductivity=truth[:n], tolerance=1e-11))
    fine = data[1][: len(data[0])]
    fine = fine + (fine - data[0]) / 3
    for faces in meshes[1:2] if quick else meshes[1:3]:
        n = int(faces.max()) + 1
        first: list[float] = []
        for method, build in METHODS.items():
            start = time.perf_counter()
            lb = build(points[:n], faces)
            u = implicit_step(lb, f[:n], TIME, conductivity=truth[:n])
            kappa, count = learned(lb, f[:n], fine[:n], functions[:n])
            seconds = time.perf_counter() - start
            off = lb.mass @ (kappa - truth[:n]).square() / (lb.mass @ truth[:n].square())
            figures = [float((u - fine[:n]).norm() / fine[:n].norm()), float(off.sqrt())]
            first = first or figures
            cells = [f"{a:.1e} ({a / b:.2f})" for a, b in zip(figures, first, strict=True)]
            row = [path.stem, str(n), method, *cells, str(count), f"{seconds:.0f}"]
            print("| " + " | ".join(row) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("shapes", nargs="+", type=Path, help="files of limit shapes")
    parser.add_argument("--quick", action="store_true", help="the 4.8k meshes alone")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("\n".join(versions()), end="\n\n")
    print("| shape | N | operator | u for the true κ | κ | evaluations | s |")
    print("|:--|--:|:--|--:|--:|--:|--:|", flush=True)
    for path in options.shapes:
        show(path, options.quick)


if __name__ == "__main__":
    main()
