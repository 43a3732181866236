"""Accuracy of Δf against exact answers, as Markdown tables: python benchmarks/accuracy.py [--quick] [--table NAME].

Errors are printed as l2 / max: the relative l2 error over the points, and the largest error over the largest |Δf|.
A slope is the least-squares fit of log error against log h over the three finest sizes, h = N^(-1/d), so an operator
of order p is expected to show p. Stencils have no certificate unless a table says otherwise: on quasi-uniform
points it mostly holds as they are. Peers that are not installed are left out, with a note.
"""

from __future__ import annotations

import argparse
import functools
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from _common import installed, versions
from scipy import sparse
from tqdm import tqdm

from torchlb import LaplaceBeltrami, surfaces
from torchlb.geometry.frames import PROJECTIONS
from torchlb.surfaces import smooth_function

FOUR = {
    "Sphere": surfaces.Sphere(),
    "Ellipsoid": surfaces.Ellipsoid(),
    "Torus": surfaces.Torus(),
    "StarShaped": surfaces.StarShaped(),
}
OTHERS = {  # of other dimensions or codimensions, and how many fewer points they take
    "CliffordTorus": (surfaces.CliffordTorus(), 1),
    "ThreeSphere": (surfaces.ThreeSphere(), 4),
    "Circle": (surfaces.Circle(), 16),
    "SpaceCurve": (surfaces.SpaceCurve(), 16),
}
PCDIFF_NEIGHBORS = 30
COMPADRE_EPSILON = 1.9  # multiplier of the radius that holds the least number of neighbours
EVENLY, AT_RANDOM = "quasi-uniform", "random"


class Error(NamedTuple):
    """Of Δf: relative l2, and largest over the largest |Δf|."""

    l2: float
    max: float

    def __str__(self) -> str:
        return f"{self.l2:.2e} / {self.max:.2e}"


class Result(NamedTuple):
    """What a method made of Δf, its neighbours a point, and the share of points at full order."""

    error: Error
    neighbors: float
    full: float
    seconds: float


class Case(NamedTuple):
    """Nodes with an exact answer; faces where a mesh is wanted."""

    points: torch.Tensor
    faces: torch.Tensor | None
    values: torch.Tensor
    exact: torch.Tensor


Apply = Callable[[Case], tuple[Any, float, float]]  # Δf, neighbours, share at full order


def case_of(surface: surfaces.Surface, points: torch.Tensor, mesh: bool = False) -> Case:
    """The smooth function on the nodes of a surface."""
    faces = surface.triangulate(points) if mesh else None
    exact = surface.laplacian(smooth_function, points)
    return Case(points, faces, smooth_function(points), exact)


def deserno_case(n: int) -> Case:
    """Y_5^4 on Deserno's sphere, with the convex hull as its mesh."""
    points = surfaces.deserno_points(n)
    values = surfaces.spherical_harmonic(5, 4)(points)
    return Case(points, surfaces.Sphere().triangulate(points), values, -30 * values)


def error_of(found: torch.Tensor, exact: torch.Tensor) -> Error:
    """Both errors of Δf."""
    wrong = found - exact
    return Error(
        (wrong.norm() / exact.norm()).item(), (wrong.abs().max() / exact.abs().max()).item()
    )


def measure(apply: Apply, case: Case) -> Result:
    """Run a method on a case."""
    start = time.perf_counter()
    found, neighbors, full = apply(case)
    seconds = time.perf_counter() - start
    return Result(error_of(torch.as_tensor(found), case.exact), neighbors, full, seconds)


def mean(results: Sequence[Result]) -> Result:
    """Mean over seeds; seconds are added up."""
    columns = list(zip(*results, strict=True))
    error = Error(*(sum(e) / len(e) for e in zip(*columns[0], strict=True)))
    neighbors, full = (sum(column) / len(column) for column in columns[1:3])
    return Result(error, neighbors, full, sum(columns[3]))


def slopes(sizes: Sequence[int], errors: Sequence[Error], dim: int) -> Error:
    """Orders of convergence of both errors over the three finest sizes; NaN for a single size."""
    if len(sizes) < 2:
        return Error(float("nan"), float("nan"))
    log_h = -np.log(sizes[-3:]) / dim
    return Error(*np.polyfit(log_h, np.log(errors[-3:]), 1)[0])


# Methods


def ours(order: int, projection: str = "tangent", mesh: bool = False, **options: Any) -> Apply:
    """torchlb with the given options, on the cloud or on the mesh."""
    options = {"progress": False, **options}

    def apply(case: Case) -> tuple[Any, float, float]:
        build = LaplaceBeltrami.from_mesh if mesh else LaplaceBeltrami.from_points
        where = (case.points, case.faces) if mesh else (case.points,)
        lb = build(*where, order=order, projection=projection, **options)
        full = (lb.report.order == order).double().mean().item()
        return lb(case.values), lb.report.num_neighbors.double().mean().item(), full

    return apply


def _weak(stiffness: Any, mass: Any, case: Case) -> tuple[Any, float, float]:
    """−M⁻¹ K f of a positive semidefinite K and a diagonal M."""
    stiffness = sparse.csr_array(stiffness)
    found = -(stiffness @ case.values.numpy()) / mass.diagonal()
    return found, stiffness.nnz / len(case.points), 1.0


def cotangent(case: Case) -> tuple[Any, float, float]:
    import igl

    vertices, faces = case.points.numpy(), case.faces.numpy()
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI)
    return _weak(-igl.cotmatrix(vertices, faces), mass, case)


def robust_mesh(case: Case) -> tuple[Any, float, float]:
    import robust_laplacian

    matrices = robust_laplacian.mesh_laplacian(case.points.numpy(), case.faces.numpy())
    return _weak(*matrices, case)


def robust_cloud(case: Case) -> tuple[Any, float, float]:
    import robust_laplacian

    return _weak(*robust_laplacian.point_cloud_laplacian(case.points.numpy()), case)


def pcdiff_cloud(case: Case) -> tuple[Any, float, float]:
    import pcdiff

    points = case.points.numpy()
    edges = np.stack(pcdiff.knn_graph(points, PCDIFF_NEIGHBORS))
    basis = pcdiff.estimate_basis(points, edges)
    grad, div = pcdiff.build_grad_div(points, *basis, edges)
    found = -pcdiff.laplacian(case.values.numpy()[:, None], grad, div)[:, 0]
    return found, PCDIFF_NEIGHBORS, 1.0


@functools.cache
def _kokkos() -> Any:
    """Compadre's runtime; it has to outlive everything that uses it."""
    os.environ.setdefault("OMP_PROC_BIND", "false")
    import pycompadre

    return pycompadre.KokkosParser(["--kokkos-num-threads=1"], False)


def compadre(degree: int) -> Apply:
    """Generalised moving least squares of a polynomial degree on estimated tangent planes."""

    def apply(case: Case) -> tuple[Any, float, float]:
        helper, operation = compadre_operator(case.points.numpy(), degree)
        total = helper.getNeighborLists().getTotalNeighborsOverAllLists()
        return helper.applyStencil(case.values.numpy(), operation), total / len(case.points), 1.0

    return apply


def compadre_operator(points: np.ndarray, degree: int) -> tuple[Any, Any]:
    """A `ParticleHelper` with the stencils, and the operation that they are of."""
    _kokkos()
    import pycompadre

    gmls = pycompadre.GMLS(degree, 3, "QR", "MANIFOLD", "NO_CONSTRAINT", degree)
    gmls.setWeightingType("power")
    gmls.setWeightingParameter(2)
    helper = pycompadre.ParticleHelper(gmls)
    helper.generateKDTree(points)
    helper.generateNeighborListsFromKNNSearchAndSet(points, degree, 2, COMPADRE_EPSILON)
    operation = pycompadre.TargetOperation.LaplacianOfScalarPointEvaluation
    gmls.addTargets(operation)
    gmls.generateAlphas(1, False)
    return helper, operation


def peers() -> dict[str, Apply]:
    """The methods of the packages that are here."""
    methods = {
        "libigl cotangent, Voronoi mass (mesh)": ("libigl", cotangent),
        "robust_laplacian (mesh)": ("robust_laplacian", robust_mesh),
        "robust_laplacian (cloud)": ("robust_laplacian", robust_cloud),
        f"pcdiff, {PCDIFF_NEIGHBORS} neighbours": ("pcdiff", pcdiff_cloud),
    }
    for degree in range(2, 7):
        name = f"pycompadre, degree {degree} (p={degree - 1})"
        methods[name] = ("pycompadre", compadre(degree))
    return {name: apply for name, (package, apply) in methods.items() if installed(package)}


# Tables


def show(header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A Markdown table: text to the left, numbers to the right."""
    rows = [[str(cell) for cell in row] for row in rows]
    sides = [":--" if text else "--:" for text in _texts(rows, len(header))]
    print("", f"| {' | '.join(header)} |", f"|{'|'.join(sides)}|", sep="\n")
    for row in rows:
        print(f"| {' | '.join(row)} |")
    print(flush=True)


def _texts(rows: Sequence[Sequence[str]], count: int) -> list[bool]:
    first = rows[0] if rows else [""] * count
    return [not any(c.isdigit() for c in cell) or "," in cell for cell in first]


def bar(jobs: Sequence[Any], name: str) -> Iterable[Any]:
    return tqdm(jobs, desc=name, file=sys.stderr)


def verdict(label: str, misses: Sequence[str]) -> None:
    """One line on whether everything held, and what did not."""
    print(f"{label}: {'all' if not misses else 'all but ' + '; '.join(misses)}.", flush=True)


def converge(
    clouds: dict[int, list[Case]], surface: surfaces.Surface, apply: Apply
) -> tuple[list[object], Error]:
    """Cells of a row of a convergence table, and its slopes."""
    results = [mean([measure(apply, case) for case in cases]) for cases in clouds.values()]
    rate = slopes(list(clouds), [result.error for result in results], surface.dim)
    cells: list[object] = [result.error for result in results]
    cells += [f"{rate.l2:.2f}", f"{rate.max:.2f}", f"{100 * results[-1].full:.1f}"]
    return [*cells, f"{sum(result.seconds for result in results):.0f}"], rate


def sweep(
    name: str,
    shapes: dict[str, tuple[surfaces.Surface, Sequence[int]]],
    variants: Sequence[tuple[str, int]],
    seeds: int,
    slack: float,
) -> None:
    """Orders of convergence: one row a shape, projection and order."""
    if seeds > 1:
        print(f"\nMeans over {seeds} clouds of each size.")
    random = name == AT_RANDOM
    rows, misses = [], []
    for label, (surface, sizes) in shapes.items():
        draw = surface.random_points if random else surface.points
        clouds = {n: [case_of(surface, draw(n, seed)) for seed in range(seeds)] for n in sizes}
        apart: dict[str, Any] = {"dim": surface.dim}
        for projection, order in bar(variants, f"orders, {label}, {name}"):
            cells, rate = converge(clouds, surface, ours(order, projection, **apart))
            rows.append([label, projection, order, *cells])
            for norm, slope in rate._asdict().items():
                if slope < order - slack:
                    misses.append(f"{label} {projection} p={order} {norm} {slope:.2f}")
    shown = [f"N={n}" for n in next(iter(shapes.values()))[1]]
    ends = ["slope l2", "slope max", "% at order p", "s"]
    show(["surface", "projection", "p", *shown, *ends], rows)
    verdict(f"Slopes of at least p - {slack}", misses)


def orders(asked: argparse.Namespace) -> None:
    """Orders of convergence of Δf on quasi-uniform points of surfaces in R³, estimated frames."""
    shapes = {name: (FOUR[name], even_sizes(asked)) for name in asked.surfaces}
    variants = [(way, p) for way in asked.projections for p in asked.p]
    sweep(EVENLY, shapes, variants, asked.seeds, 0.3)


def orders_random(asked: argparse.Namespace) -> None:
    """The same on independent points, uniform in area."""
    sizes = asked.sizes or ((500, 1000, 2000) if asked.quick else (2000, 4000, 8000))
    shapes = {name: (FOUR[name], sizes) for name in asked.surfaces}
    sweep(AT_RANDOM, shapes, [("tangent", p) for p in asked.p], asked.seeds, 0.5)
    certified(sizes[-2])


def orders_dimensions(asked: argparse.Namespace) -> None:
    """The same on quasi-uniform points of manifolds of other dimensions and codimensions."""
    sizes = even_sizes(asked)
    variants = [(way, p) for way in asked.projections for p in (1, 3)]
    for fewer in sorted({fewer for _, fewer in OTHERS.values()}):
        few = [n // fewer for n in sizes]
        shapes = {k: (shape, few) for k, (shape, share) in OTHERS.items() if share == fewer}
        sweep(EVENLY, shapes, variants, asked.seeds, 0.3)


def even_sizes(asked: argparse.Namespace) -> Sequence[int]:
    """Numbers of points of a convergence table."""
    return asked.sizes or ((500, 1000, 2000) if asked.quick else (2000, 4000, 8000, 16000))


def certified(n: int) -> None:
    """What the certificate costs in accuracy on random points."""
    print(f"\nThe same with the certificate, N={n}, p=3, 1 seed:")
    rows = []
    for label, surface in bar(FOUR.items(), "orders, certified"):
        case = case_of(surface, surface.random_points(n))
        for name, certify in (("raw", False), ("certified", True)):
            result = measure(ours(3, certify=certify), case)
            cells = [result.error, f"{100 * result.full:.1f}", f"{result.seconds:.1f}"]
            rows.append([label, name, *cells])
    show(["surface", "operator", "error", "% at order p", "s"], rows)


def deserno(asked: argparse.Namespace) -> None:
    """Δ Y_5^4 on Deserno's nodes of the sphere."""
    sizes = asked.sizes or ((500, 2000) if asked.quick else (2000, 8000))
    methods = {}
    for order in (3, 5):
        for way in ("tangent", "normal"):
            methods[f"torchlb, {way}, p={order}"] = ours(order, way)
    for order in (2, 3, 4, 5):
        methods[f"torchlb, tangent, polyharmonic, p={order}"] = ours(order, weights="polyharmonic")
    methods |= {f"torchlb, tangent, p={order}": ours(order) for order in (1, 2, 4)}
    cases = {len(case.points): case for case in map(deserno_case, sizes)}
    table: dict[str, list[Result]] = {}
    for name, apply in bar(list((methods | peers()).items()), "deserno"):
        table[name] = [measure(apply, case) for case in cases.values()]
    header = ["method", *[f"{what}, N={n}" for n in cases for what in ("error", "neighbours")], "s"]
    rows = []
    for name, results in table.items():
        cells: list[object] = []
        for result in results:
            cells += [result.error, f"{result.neighbors:.1f}"]
        rows.append([name, *cells, f"{sum(result.seconds for result in results):.1f}"])
    show(header, rows)
    deserno_acceptance(list(cases)[-1], {name: results[-1] for name, results in table.items()})


def deserno_acceptance(n: int, table: dict[str, Result]) -> None:
    """The bounds that the finest nodes are held to."""
    bounds = {"tangent, p=3": 6e-5, "tangent, p=5": 2e-7, "normal, p=5": 2e-5}
    misses, found = [], []
    for name, bound in bounds.items():
        value = table[f"torchlb, {name}"].error.l2
        text = f"{name} {value:.1e} (bound {bound:.0e})"
        (misses if value > bound else found).append(text)
    for order in (3, 5):
        peer = table.get(f"pycompadre, degree {order + 1} (p={order})")
        if peer:
            mine = table[f"torchlb, tangent, p={order}"]
            ratio = mine.error.l2 / peer.error.l2
            counts = f"{mine.neighbors:.0f} and {peer.neighbors:.0f} neighbours"
            text = f"p={order} to pycompadre's {ratio:.2f} (bound 0.6), {counts}"
            missed = ratio > 0.6 or mine.neighbors >= peer.neighbors
            (misses if missed else found).append(text)
    print(f"Relative l2 at N={n} within bounds: {'; '.join(found) or 'none'}.")
    verdict("Bounds, which are for N=8038", misses)


def ahead(label: str, table: dict[str, Result]) -> tuple[list[str], list[str]]:
    """Ratios to pycompadre at equal order, and peers that beat ours of equal or the default order."""
    mine = {p: table[f"torchlb, tangent, p={p}"].error for p in range(1, 6)}
    ratios, misses = [], []
    for name, (error, *_) in table.items():
        if name.startswith("torchlb"):
            continue
        order = int(name[-2]) if name.startswith("pycompadre") else 3
        if name.startswith("pycompadre"):
            ratio = mine[order].l2 / error.l2
            ratios.append(f"{ratio:.2f}")
            if ratio > 0.6:
                misses.append(f"{label} p={order} l2 ratio {ratio:.2f} to pycompadre")
        for norm, a, b in zip(Error._fields, mine[order], error, strict=True):
            if a >= b:
                misses.append(f"{label} p={order} {norm} {a:.1e}, {name} {b:.1e}")
    return ratios, misses


def compare(asked: argparse.Namespace) -> None:
    """torchlb and its peers on the same nodes of four surfaces."""
    n = asked.sizes[-1] if asked.sizes else (2000 if asked.quick else 8000)
    methods = {f"torchlb, tangent, p={order}": ours(order) for order in range(1, 6)}
    methods |= {f"torchlb, normal, p={order}": ours(order, "normal") for order in (3, 5)}
    methods |= peers()
    cases = {label: case_of(surface, surface.points(n), True) for label, surface in FOUR.items()}
    table: dict[str, dict[str, Result]] = {label: {} for label in FOUR}
    for name, apply in bar(list(methods.items()), "peers"):
        for label, case in cases.items():
            table[label][name] = measure(apply, case)
    rows = []
    for name in methods:
        results = [table[label][name] for label in FOUR]
        counts = sum(result.neighbors for result in results) / len(results)
        seconds = sum(result.seconds for result in results)
        rows.append([name, *[r.error for r in results], f"{counts:.1f}", f"{seconds:.1f}"])
    print(f"\n{EVENLY.capitalize()} nodes, N={n}; the mesh methods get a mesh on the same nodes.")
    show(["method", *FOUR, "neighbours", "s"], rows)
    misses: list[str] = []
    for label in FOUR:
        ratios, missed = ahead(label, table[label])
        misses += missed
        if ratios:
            print(f"{label}: l2 as a fraction of pycompadre's, p=1..5: {', '.join(ratios)}.\n")
    verdict("At most 0.6 of pycompadre at equal order, ahead of every other peer at p=3", misses)


def sphere4070(asked: argparse.Namespace) -> None:
    """Known figures on 4070 points of the sphere."""
    n = asked.sizes[-1] if asked.sizes else (1000 if asked.quick else 4070)
    sphere = FOUR["Sphere"]
    case = case_of(sphere, sphere.points(n))
    known = {("tangent", 3): 3.5e-5, ("tangent", 5): 4.5e-7}
    known |= {("normal", 3): 2.7e-4, ("normal", 5): 1.6e-5}
    rows, misses = [], []
    for (way, order), expected in bar(list(known.items()), "sphere4070"):
        result = measure(ours(order, way), case)
        ratio = result.error.l2 / expected
        cells = [result.error, f"{result.neighbors:.0f}", f"{expected:.1e}", f"{ratio:.2f}"]
        rows.append([way, order, *cells, f"{result.seconds:.1f}"])
        if not ratio <= 1.5:
            misses.append(f"{way} p={order} ratio {ratio:.2f}")
    print(f"\nN={n}; expected are the l2 errors of the prototypes at N=4070.")
    show(["projection", "p", "error", "neighbours", "expected l2", "ratio", "s"], rows)
    verdict("l2 within 1.5 of expected", misses)


def noise(asked: argparse.Namespace) -> None:
    """Gaussian noise on the positions, in units of the spacing; values and Δ of Y_5^4 are those of the true points."""
    n = asked.sizes[-1] if asked.sizes else (500 if asked.quick else 2000)
    sphere, harmonic = FOUR["Sphere"], surfaces.spherical_harmonic(5, 4)
    true = sphere.points(n)
    spacing = (sphere.area / n) ** 0.5
    variants = [(1, None), (2, None), (3, None), (5, None), (3, 60), (5, 120)]
    known = sphere.eigenvalues(26)[1:]
    rows = []
    for order, size in bar(variants, "noise"):
        cells: list[object] = [order, size or "candidates"]
        for share in (0.0, 0.01, 0.03, 0.1):
            generator = torch.Generator().manual_seed(0)
            shift = torch.randn(true.shape, generator=generator, dtype=torch.float64)
            lb = LaplaceBeltrami.from_points(
                true + share * spacing * shift, order=order, num_neighbors=size, progress=False
            )
            error = error_of(lb(harmonic(true)), -30 * harmonic(true)).l2
            found = lb.eigenbasis(26).eigenvalues[1:]
            cells.append(f"{error:.1e} / {float((found / known - 1).abs().max()):.1e}")
        rows.append(cells)
    print(
        f"\nSphere, N={n}; relative l2 error of Δ Y_5^4 / largest relative error of eigenvalues 1 to 25."
    )
    show(["p", "neighbours", "none", "1 %", "3 %", "10 %"], rows)


def theorem(asked: argparse.Namespace) -> None:
    """Both terms of the error h^p + h^q, and p = q = 2 beside the cotangent formula."""
    sizes = asked.sizes or ((500, 1000, 2000) if asked.quick else (2000, 4000, 8000))
    order, rows, misses = 4, [], []
    for label, ways in {"Torus": ("normal", "tangent"), "Sphere": ("normal",)}.items():
        surface = FOUR[label]
        clouds = {n: [case_of(surface, surface.points(n))] for n in sizes}
        variants = [(way, q) for way in ways for q in range(1, 7)]
        for way, q in bar(variants, f"theorem, {label}"):
            cells, rate = converge(clouds, surface, ours(order, way, normal_order=q))
            rows.append([label, way, order, q, *cells[:-2], min(order, q), cells[-1]])
            if rate.l2 < min(order, q) - 0.3:
                misses.append(f"{label} {way} q={q} {rate.l2:.2f}")
    ends = ["slope l2", "slope max", "min(p, q)", "s"]
    print(f"\n### The two terms h^p + h^q, p={order}")
    show(["surface", "projection", "p", "q", *[f"N={n}" for n in sizes], *ends], rows)
    verdict("l2 slopes of at least min(p, q) - 0.3", misses)
    second_order(2000 if asked.quick else 8000)


def second_order(n: int) -> None:
    """p = q = 2 on meshes, beside the cotangent formula."""
    methods = {}
    for way in ("normal", "tangent"):
        methods[f"torchlb, {way}, p=q=2"] = ours(2, way, True, normal_order=2)
    if installed("libigl"):
        methods["libigl cotangent, Voronoi mass"] = cotangent
    cases = {label: case_of(surface, surface.points(n), True) for label, surface in FOUR.items()}
    rows = []
    for name, apply in bar(list(methods.items()), "theorem, p=q=2"):
        results = [measure(apply, case) for case in cases.values()]
        seconds = sum(result.seconds for result in results)
        rows.append([name, *[result.error for result in results], f"{seconds:.1f}"])
    print(f"\n### p = q = 2 beside the cotangent formula, the same meshes, N={n}")
    show(["method", *FOUR, "s"], rows)


TABLES = {
    "orders": orders,
    "orders-random": orders_random,
    "orders-dimensions": orders_dimensions,
    "deserno": deserno,
    "peers": compare,
    "sphere4070": sphere4070,
    "theorem": theorem,
    "noise": noise,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small clouds, for a first look")
    parser.add_argument("--table", choices=TABLES, action="append", help="only this one")
    parser.add_argument("--sizes", type=int, nargs="+", help="numbers of points, ascending")
    parser.add_argument("--seeds", type=int, default=1, help="clouds of each size for the orders")
    parser.add_argument("--surfaces", nargs="+", default=list(FOUR), help="of the orders")
    parser.add_argument("--projections", nargs="+", default=list(PROJECTIONS), help="of the orders")
    parser.add_argument("--p", type=int, nargs="+", default=[1, 2, 3, 4, 5], help="of the orders")
    options = parser.parse_args()
    torch.set_num_threads(1)  # small batches: more threads wait for each other
    print("# Accuracy\n", *versions(), sep="\n", flush=True)
    for name in options.table or TABLES:
        print(f"\n## {name}\n\n{TABLES[name].__doc__}", flush=True)
        TABLES[name](options)


if __name__ == "__main__":
    main()
