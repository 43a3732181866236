"""Media beside exact spectra and the cotangent's, as Markdown tables: python benchmarks/media.py [SHAPE.npz] [--quick]

−div(A∇u) + cu = λρu. Exact: a density of a Möbius map and a potential on the sphere, a tensor on the square; the worst
relative error of the first 24 nonzero eigenvalues, over the cotangent's in brackets. Cost: processor time of a thread.
Inverse: κ, the exponential of 20 waves, from 30 eigenvalues of −div(κ∇u) = λu on a limit surface of subdivision
(`control`, `faces0`). Data: the cotangent's eigenvalues on levels 3 and 4 (77k and 307k vertices), extrapolated. κ is
sought by LBFGS through the eigenvalues at level 1 (4.8k), with a ridge on the coefficients that falls step by step.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _common import versions
from scipy.spatial import Delaunay
from scipy.special import pro_cv
from torch import Tensor

from torchlb import LaplaceBeltrami
from torchlb.surfaces import Sphere, StarShaped, limit_surface

EIGENVALUES, AMPLITUDE = 30, 0.1
RIDGES = (1e-2, 1e-3, 1e-4, 1e-5)
METHODS = {
    "cotangent": LaplaceBeltrami.from_cotangent,
    "weak pair, p = 3": LaplaceBeltrami.from_mesh,
}


def moebius(count: int) -> tuple[Tensor, Tensor, dict[str, Tensor], list[float]]:
    """ρ = σ² of a Möbius map of the sphere: λ = l(l + 1)."""
    points, faces = Sphere().mesh(count)
    a = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    density = ((1 - a @ a) / (points - a).square().sum(1)).square()
    exact = [degree * (degree + 1.0) for degree in range(1, 6) for _ in range(2 * degree + 1)]
    return points, faces, {"density": density}, exact


def spheroidal(count: int) -> tuple[Tensor, Tensor, dict[str, Tensor], list[float]]:
    """c = 16z² on the sphere: characteristic values of the prolate spheroidal functions."""
    points, faces = Sphere().mesh(count)
    values = [
        float(pro_cv(m, n, 4))
        for m in range(8)
        for n in range(m, m + 8)
        for _ in range(1 + (m > 0))
    ]
    return points, faces, {"potential": 16 * points[:, 2].square()}, values


def rectangle(count: int) -> tuple[Tensor, Tensor, dict[str, Tensor], list[float]]:
    """A = diag(1, 4) on a perturbed grid of the unit square: λ = π²(i² + 4j²)."""
    side = round(count**0.5)
    axis = np.linspace(0, 1, side)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    noise = np.random.default_rng(0).uniform(-0.15, 0.15, grid.shape) / (side - 1)
    grid = grid + noise * ((grid > 0) & (grid < 1))
    points = torch.from_numpy(np.c_[grid, 0 * grid[:, 0]])
    tensor = torch.diag(torch.tensor([1.0, 4.0, 1.0], dtype=torch.float64))
    values = [np.pi**2 * (i * i + 4 * j * j) for i in range(20) for j in range(20) if i + j]
    faces = torch.from_numpy(Delaunay(grid).simplices)
    return points, faces, {"conductivity": tensor.expand(len(points), 3, 3)}, values


CASES = {
    "density of a Möbius map": (moebius, (1000, 4000)),
    "potential 16z²": (spheroidal, (1000, 4000)),
    "tensor diag(1, 4)": (rectangle, (529, 2025)),
}


def exact_spectra(quick: bool) -> None:
    """The table of cases whose eigenvalues are known."""
    print("| case | N | cotangent | mesh, p = 3 | mesh, p = 4 | cloud, p = 3 | cloud, p = 4 |")
    print("|:--|--:|--:|--:|--:|--:|--:|", flush=True)
    for name, (case, sizes) in CASES.items():
        for count in sizes[:1] if quick else sizes:
            points, faces, medium, values = case(count)
            exact = torch.tensor(sorted(values)[:24], dtype=torch.float64)
            operators = [LaplaceBeltrami.from_cotangent(points, faces)]
            orders = (3, 4)
            operators += [LaplaceBeltrami.from_mesh(points, faces, order=p) for p in orders]
            operators += [LaplaceBeltrami.from_points(points, order=p) for p in orders]
            errors = []
            for lb in operators:
                basis = lb.with_medium(**medium).eigenbasis(25, tolerance=1e-11)
                first = 0 if "potential" in medium else 1
                found = basis.eigenvalues[first : first + 24]
                errors.append(float((found / exact - 1).abs().max()))
            cells = [f"{error:.1e} ({error / errors[0]:.1g})" for error in errors]
            print(f"| {name} | {len(points)} | " + " | ".join(cells) + " |", flush=True)


def least(function: Callable[[], Any]) -> float:
    """Processor time of the quickest of three calls."""
    seconds = []
    for _ in range(3):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return min(seconds)


def cost(count: int) -> None:
    """The table of seconds, and of a build's."""
    points, faces = StarShaped().mesh(count)
    kappa = torch.sin(3 * points[:, 0]).exp()
    axis = points.new_tensor([0.6, 0.0, 0.8])
    tensor = kappa[:, None, None] * (torch.eye(3, dtype=points.dtype) + 3 * torch.outer(axis, axis))
    builds = {
        "cotangent": lambda: LaplaceBeltrami.from_cotangent(points, faces),
        "mesh, p = 3": lambda: LaplaceBeltrami.from_mesh(points, faces, progress=False),
        "cloud, p = 3": lambda: LaplaceBeltrami.from_points(points, progress=False),
    }
    print(f"Star-shaped surface, N = {len(points)}; seconds, over the build's in brackets.\n")
    print("| operator | build | first medium | density | conductivity | tensor | 31 pairs |")
    print("|:--|--:|--:|--:|--:|--:|--:|", flush=True)
    for name, build in builds.items():
        seconds = [least(build)]
        lb = build()
        start = time.process_time()
        medium = lb.with_medium(kappa)  # makes the elements, which the others share
        seconds.append(time.process_time() - start)
        seconds += [
            least(lambda lb=lb, given=given: lb.with_medium(**given))
            for given in ({"density": kappa}, {"conductivity": kappa}, {"conductivity": tensor})
        ]
        start = time.process_time()
        medium.eigenbasis(EIGENVALUES + 1)
        seconds.append(time.process_time() - start)
        cells = [f"{s:.2f} ({s / seconds[0]:.2f})" for s in seconds]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def waves(points: Tensor) -> Tensor:
    """(N, 20)."""
    random = torch.Generator().manual_seed(0)
    directions = 8 * torch.randn(3, 20, dtype=torch.float64, generator=random)
    return torch.cos(points @ directions + torch.arange(20))


def spectrum(lb: LaplaceBeltrami, kappa: Tensor, tolerance: float = 1e-8) -> Tensor:
    """The first 30 nonzero eigenvalues of −div(κ∇u) = λu."""
    medium = lb.with_medium(conductivity=kappa)
    return medium.eigenbasis(EIGENVALUES + 1, tolerance=tolerance).eigenvalues[1:]


def fitted(misfit: Callable[[Tensor], Tensor], start: Tensor, ridge: float) -> tuple[Tensor, int]:
    """Coefficients with the least |misfit|² + ridge |coefficients|², and how many values and gradients it took.

    LBFGS in the scalar product of Gauss and Newton at the start needs a sixth of the steps that it needs without.
    """
    count = 0
    jacobian = torch.autograd.functional.jacobian(misfit, start)
    ridges = ridge**0.5 * torch.eye(len(start), dtype=start.dtype)
    scale = torch.linalg.qr(torch.cat([jacobian, ridges])).R.inverse()
    step = torch.zeros_like(start).requires_grad_()
    optimizer = torch.optim.LBFGS(
        [step],
        max_iter=40,
        tolerance_grad=1e-6,
        tolerance_change=1e-9,
        line_search_fn="strong_wolfe",
    )

    def loss() -> Tensor:
        nonlocal count
        count += 1
        optimizer.zero_grad()
        coefficients = start + scale @ step
        value = misfit(coefficients).square().sum() + ridge * coefficients.square().sum()
        value.backward()
        return value

    optimizer.step(loss)
    return start + scale @ step.detach(), count


def learned(lb: LaplaceBeltrami, seen: Tensor, functions: Tensor) -> tuple[list[Tensor], int]:
    """κ for each ridge, which starts from that of the one before, and how many spectra forward and backward it took."""

    def misfit(coefficients: Tensor) -> Tensor:
        return (spectrum(lb, (functions @ coefficients).exp()) / seen).log()

    coefficients, found, total = torch.zeros(functions.shape[1], dtype=functions.dtype), [], 0
    for ridge in RIDGES:
        coefficients, count = fitted(misfit, coefficients, ridge)
        found.append((functions @ coefficients).exp())
        total += count
    return found, total


def inverse(path: Path, quick: bool) -> None:
    """Rows of one shape: the median error of eigenvalues for the true κ, and the errors of κ."""
    shape = dict(np.load(path))
    control = torch.from_numpy(shape["control"].astype(float))
    faces0 = torch.from_numpy(shape["faces0"].astype(np.int64))
    points, meshes = limit_surface(control, faces0, 3 if quick else 4)
    functions = waves(points)
    random = torch.Generator().manual_seed(1)
    truth = functions @ (AMPLITUDE * torch.randn(20, dtype=torch.float64, generator=random))
    truth = truth.exp()
    data = []
    for faces in meshes[-2:]:
        n = int(faces.max()) + 1
        lb = LaplaceBeltrami.from_cotangent(points[:n], faces)
        data.append(spectrum(lb, truth[:n], 1e-10))
    seen = data[1] + (data[1] - data[0]) / 3
    faces = meshes[1]
    n = int(faces.max()) + 1
    truth, functions = truth[:n], functions[:n]
    first: list[float] = []
    for method, build in METHODS.items():
        start = time.perf_counter()
        lb = build(points[:n], faces)

        def off(kappa: Tensor, lb: LaplaceBeltrami = lb) -> float:
            return float((lb.mass @ (kappa - truth).square() / (lb.mass @ truth.square())).sqrt())

        found, count = learned(lb, seen, functions)
        seconds = time.perf_counter() - start
        figures = [float((spectrum(lb, truth) / seen - 1).abs().median()), *map(off, found)]
        first = first or figures
        cells = [f"{a:.1e} ({a / b:.2f})" for a, b in zip(figures, first, strict=True)]
        at_one = f"{off(torch.ones_like(truth)):.1e}"
        row = [path.stem, method, cells[0], at_one, *cells[1:], str(count), f"{seconds:.0f}"]
        print("| " + " | ".join(row) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("shapes", nargs="*", type=Path, help="files of limit shapes")
    parser.add_argument(
        "--quick", action="store_true", help="small meshes, and data of levels 2 and 3"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("\n".join(versions()), end="\n\n")
    exact_spectra(options.quick)
    print()
    cost(2000 if options.quick else 13_000)
    if options.shapes:
        ridges = " | ".join(f"ridge {ridge:.0e}" for ridge in RIDGES)
        print(f"\n| shape | operator | λ for the true κ | κ = 1 | {ridges} | evaluations | s |")
        print("|:--|:--|" + "--:|" * (len(RIDGES) + 4), flush=True)
    for path in options.shapes:
        inverse(path, options.quick)


if __name__ == "__main__":
    main()
