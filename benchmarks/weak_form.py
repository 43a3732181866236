"""What a weak pair made from the stencil's fits gives: python benchmarks/weak_form.py [--quick] [SHAPE.npz ...]

A prototype of `method.md`'s next step, to measure it before it is built in. One unknown a vertex; centre-constrained
fits of degree m prolong a function to the nodes of curved Lagrange triangles of degree r, whose stiffness and mass are
K = PᵀK_FE P and M = PᵀM_FE P: symmetric, K1 = 0, M > 0. Printed are the relative errors of the eigenvalues 1 to 24 on
spheres, and of 1 to 40 on the shapes given, beside libigl's cotangent pair. A shape has `vertices`, `faces` (or
`faces0`, `faces1`, …, on the first vertices each) and `eigenvalues`.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import igl
import numpy as np
import torch
from _common import versions
from scipy import sparse
from scipy.sparse.linalg import eigsh
from scipy.special import roots_jacobi
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.fits.polynomials import monomial_derivatives, monomials, num_monomials
from torchlb.fits.weights import window
from torchlb.geometry.frames import complete_frames, vertex_normals
from torchlb.geometry.neighbors import GraphBalls, mesh_graph
from torchlb.surfaces import Sphere, deserno_points

EDGES = ((0, 1), (1, 2), (2, 0))
"""Corners of the edges of a triangle, in the order of their nodes."""


class Element(NamedTuple):
    """Shape functions φ_i of degree r at the points of a Gauss rule of degree 2r + 1.

    Attributes
    ----------
    weights : (Q,), their sum is the area ½ of the reference triangle.
    values : (Q, n), φ_i.
    gradients : (Q, n, 2), in the reference coordinates (ξ, η), the barycentrics of the corners 1 and 2.
    """

    weights: Tensor
    values: Tensor
    gradients: Tensor


@cache
def lattice(degree: int) -> Tensor:
    """Barycentrics of the nodes: the corners, those of each edge from its first corner on, those inside."""
    unit = torch.eye(3, dtype=torch.float64)
    steps = torch.arange(1, degree, dtype=torch.float64)[:, None] / degree
    edges = [(1 - steps) * unit[i] + steps * unit[j] for i, j in EDGES]
    inside = [
        [(degree - i - j) / degree, i / degree, j / degree]
        for j in range(1, degree)
        for i in range(1, degree - j)
    ]
    return torch.cat([unit, *edges, torch.tensor(inside, dtype=torch.float64).view(-1, 3)])


@cache
def element(degree: int) -> Element:
    """The Lagrange element of degree r ≥ 1."""
    points, weights = _gauss(degree + 1)
    inverse = torch.linalg.inv(_powers(lattice(degree)[:, 1:], degree))
    slopes = monomial_derivatives(points, degree)
    slopes = torch.cat([torch.zeros_like(slopes[:, :1]), slopes], dim=1)
    return Element(
        weights, _powers(points, degree) @ inverse, torch.einsum("qmd,mn->qnd", slopes, inverse)
    )


def _powers(points: Tensor, degree: int) -> Tensor:
    return torch.cat([torch.ones_like(points[:, :1]), monomials(points, degree)], dim=1)


def _gauss(count: int) -> tuple[Tensor, Tensor]:
    """Points and weights of the collapsed product rule of `count`² points, exact up to degree 2 count − 1."""
    x, wx = np.polynomial.legendre.leggauss(count)
    y, wy = roots_jacobi(count, 1, 0)  # weight 1 − y, the width of the triangle at η = (1 + y)/2
    x, y = np.meshgrid((1 + x) / 2, (1 + y) / 2, indexing="ij")
    points = np.stack([x * (1 - y), y], axis=-1).reshape(-1, 2)
    return torch.from_numpy(points), torch.from_numpy(np.outer(wx, wy).reshape(-1) / 8)


CHUNK = 2**14
"""Triangles at a time: some 100 MB."""


def metric(places: Tensor, shape: Element) -> Tensor:
    """G = JᵀJ at the Gauss points of elements with nodes at `places`, as (g_ξξ, g_ξη, g_ηη), ℓ²."""
    jacobian = torch.einsum("qnd,tnc->tqdc", shape.gradients, places)
    x, y = jacobian.unbind(2)
    return torch.stack([(x * x).sum(-1), (x * y).sum(-1), (y * y).sum(-1)], dim=-1)


def flat_metric(lengths: Tensor) -> Tensor:
    """The same of a flat triangle, from the lengths of its edges in the order of `elements.EDGES`, ℓ."""
    a, b, c = lengths.square().unbind(-1)  # of 01, 12, 20
    return torch.stack([a, (a + c - b) / 2, c], dim=-1)


def area_element(g: Tensor) -> Tensor:
    """√det G, ℓ²; zero where rounding makes the determinant negative."""
    return (g[..., 0] * g[..., 2] - g[..., 1].square()).clamp_min(0).sqrt()


def assemble(
    g: Tensor, nodes: Tensor, shape: Element, num_nodes: int
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """(K_FE, M_FE): ∫ ∇φ_i·∇φ_j and ∫ φ_i φ_j over the elements, symmetric, dimensionless and ℓ²."""
    x, y = shape.gradients.unbind(-1)  # (Q, n)
    cross = x[:, :, None] * y[:, None, :]
    products = torch.stack(
        [y[:, :, None] * y[:, None], -(cross + cross.mT), x[:, :, None] * x[:, None]], 1
    )
    squares = shape.values[:, :, None] * shape.values[:, None, :]
    stiffness, mass = [], []
    for part in torch.arange(len(nodes)).split(CHUNK):
        root = area_element(g[part])
        adjugate = shape.weights[:, None] * g[part] / root[..., None]
        stiffness.append(adjugate.flatten(1) @ products.flatten(0, 1).flatten(1))
        mass.append((shape.weights * root) @ squares.flatten(1))
    size = nodes.shape[1]
    row = nodes.repeat_interleave(size, dim=1).numpy().ravel()
    col = nodes.repeat(1, size).numpy().ravel()
    result = []
    for blocks in (stiffness, mass):
        data = torch.cat(blocks).numpy().ravel()
        result.append(sparse.csr_array((data, (row, col)), shape=(num_nodes, num_nodes)))
    return result[0], result[1]


ALIGNED = 0.5
"""Least cosine between a triangle's normal and those of its vertices."""
GOOD = 0.1
"""Least quality 4√3 area/Σℓ² of a triangle; 1 if it is equilateral."""
ROUNDS = 50


def flipped(vertices: Tensor, faces: Tensor) -> Tensor:
    """The faces, with an edge flipped of every folded triangle or sliver that gains by it.

    Only edges of two triangles, and only where the new edge is not there yet. The normals are renewed each round.
    """
    faces = faces.clone()
    for _ in range(ROUNDS):
        normals = vertex_normals(vertices, faces)
        alignment, quality = _scores(vertices, normals, faces)
        bad = ((alignment < ALIGNED) | (quality < GOOD)).nonzero()[:, 0]
        pairs = _flips(faces, bad)
        if pairs is None:
            return faces
        left, right, after = pairs
        before = torch.stack([faces[left], faces[right]], dim=1)
        gain = _value(vertices, normals, after) - _value(vertices, normals, before)
        chosen = _independent(gain, left, right, after, len(faces))
        if len(chosen) == 0:
            return faces
        faces[left[chosen]], faces[right[chosen]] = after[chosen, 0], after[chosen, 1]
    return faces


def _scores(vertices: Tensor, normals: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Least cosine between the normal and those of the corners, and quality."""
    corners = vertices[faces]
    sides = corners.roll(-1, dims=-2) - corners
    normal = torch.linalg.cross(sides[..., 0, :], sides[..., 1, :])
    twice = normal.norm(dim=-1, keepdim=True)
    unit = normal / twice.clamp_min(torch.finfo(normal.dtype).tiny)
    alignment = (unit[..., None, :] * normals[faces]).sum(-1).amin(-1)
    return alignment, 2 * 3**0.5 * twice[..., 0] / sides.square().sum((-1, -2))


def _value(vertices: Tensor, normals: Tensor, pairs: Tensor) -> Tensor:
    """What a flip is to raise: the lesser alignment of the two, as far as it lacks, then the lesser quality."""
    alignment, quality = _scores(vertices, normals, pairs)
    return 1e3 * alignment.amin(1).clamp_max(ALIGNED) + quality.amin(1)


def _flips(faces: Tensor, bad: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
    """Flips of the edges of the bad faces: the two faces (a, b, c), (b, a, d) and (c, d, b), (d, c, a) instead."""
    count, size = len(faces), int(faces.max()) + 1
    half = torch.cat(
        [faces[:, list(edge)] for edge in EDGES]
    )  # of face h mod F, the corner after is opposite
    opposite = torch.cat([faces[:, 2], faces[:, 0], faces[:, 1]])
    low, high = half.amin(1), half.amax(1)
    unique, edge, uses = torch.unique(low * size + high, return_inverse=True, return_counts=True)
    order = edge.argsort(stable=True)
    first = uses.cumsum(0) - uses
    twin = torch.full_like(edge, -1)
    two = first[uses == 2]
    twin[order[two]], twin[order[two + 1]] = order[two + 1], order[two]
    sides = (bad[:, None] + count * torch.arange(3)).flatten()
    sides = sides[twin[sides] >= 0]
    other = twin[sides]
    c, d = opposite[sides], opposite[other]
    known = torch.isin(torch.minimum(c, d) * size + torch.maximum(c, d), unique)
    wound = half[sides, 0] == half[other, 1]
    keep = wound & (c != d) & ~known
    sides, other, c, d = sides[keep], other[keep], c[keep], d[keep]
    if len(sides) == 0:
        return None
    a, b = half[sides].unbind(1)
    after = torch.stack([torch.stack([c, d, b], 1), torch.stack([d, c, a], 1)], dim=1)
    return sides % count, other % count, after


def _independent(
    gain: Tensor,
    left: Tensor,
    right: Tensor,
    after: Tensor,
    num_faces: int,
) -> Tensor:
    """Flips that gain, best first, none of which shares a face or makes an edge with a better one."""
    order = gain.argsort(descending=True, stable=True)
    order = order[gain[order] > 1e-9]
    rank = torch.arange(len(order))
    far = torch.full((num_faces,), len(order))
    for face in (left[order], right[order]):
        far.scatter_reduce_(0, face, rank, "amin")
    free = (far[left[order]] == rank) & (far[right[order]] == rank)
    order = order[free]
    made = after[order, 0, :2].sort(dim=1).values
    _, place = torch.unique(made, dim=0, return_inverse=True)
    best = torch.full((int(place.max()) + 1 if len(place) else 0,), len(order))
    best.scatter_reduce_(0, place, torch.arange(len(order)), "amin")
    return order[best[place] == torch.arange(len(order))]


FITS_PER_MONOMIAL = 5 / 3
"""Points of a fit per polynomial, the vertex included."""
LEAST_PER_MONOMIAL = 1.5
"""Neighbours per non-constant polynomial below which a fit is not tried."""
MAX_CONDITION = 1e4
MAX_RESIDUAL = {2: 0.3}
DEFAULT_RESIDUAL = 0.05
NEWTON_STEPS = 5


@dataclass(frozen=True)
class Fits:
    """One fit a vertex: u(y) = u_a + Σ_α y^α Σ_j map[a, α, j] (u_j − u_a), y in units of the radius.

    Attributes
    ----------
    degree : (N,), m of each fit; 0 where none passed.
    index : (N, K), its points, the vertex first; padded by the vertex.
    map : (N, M − 1, K − 1), zero beyond a fit's own points and monomials.
    height : (N, M − 1, n − 2), ℓ, of the surface over the tangent plane.
    radius : (N,), ℓ.
    """

    degree: Tensor
    index: Tensor
    map: Tensor
    height: Tensor
    radius: Tensor


def fit_vertices(points, frames, normals, balls, degrees) -> Fits:
    """Fits of the highest of the degrees that passes at each vertex."""
    n = len(points)
    top = max(degrees)
    size = _size(top)
    count_m = num_monomials(2, top) - 1
    degree = torch.zeros(n, dtype=torch.int64)
    index = torch.arange(n)[:, None].repeat(1, size)
    fit_map = points.new_zeros(n, count_m, size - 1)
    height = points.new_zeros(n, count_m, 1)
    radius = points.new_ones(n)
    for part in torch.arange(n).split(2**13):
        around, count = balls(part, size)
        for m in degrees:
            k, monos = _size(m), num_monomials(2, m) - 1
            todo = (degree[part] == 0) & (count.clamp_max(k) - 1 >= LEAST_PER_MONOMIAL * monos)
            rows = part[todo]
            if len(rows) == 0:
                continue
            near = around[todo, :k]
            valid = torch.arange(1, k) < count[todo, None]
            offset = points[near[:, 1:]] - points[rows, None]
            y = offset @ frames[rows]
            h = (offset * normals[rows, None]).sum(-1, keepdim=True)
            rho = (y.norm(dim=-1) * valid).amax(1)
            y = y / rho[:, None, None]
            root = window(y.norm(dim=-1).clamp_max(1.0)).sqrt() * valid
            system = root[..., None] * monomials(y, m)
            scale = system.norm(dim=1).clamp_min(torch.finfo(y.dtype).tiny)
            q, r = torch.linalg.qr(system / scale[:, None])
            inverse = torch.linalg.solve_triangular(r, q.mT * root[:, None], upper=True)
            inverse = inverse / scale[..., None]
            singular = torch.linalg.svdvals(r)
            coefficients = inverse @ h
            left = root[..., None] * (h - monomials(y, m) @ coefficients)
            residual = left.norm(dim=-1).amax(1) / rho
            good = singular[:, 0] <= MAX_CONDITION * singular[:, -1]
            good &= residual <= MAX_RESIDUAL.get(m, DEFAULT_RESIDUAL)
            kept = rows[good]
            degree[kept] = m
            index[kept, :k] = near[good]
            index[kept, k:] = kept[:, None]
            fit_map[kept, :monos, : k - 1] = inverse[good]
            height[kept, :monos] = coefficients[good]
            radius[kept] = rho[good]
    return Fits(degree, index, fit_map, height, radius)


def _size(degree: int) -> int:
    return -(-int(3000 * FITS_PER_MONOMIAL * num_monomials(2, degree) - 1e-6) // 3000)


def prolongation(
    points: Tensor, places: Tensor, frames: Tensor, fits: Fits, ends: Ends, bary: Tensor
) -> sparse.csr_array:
    """P: identity rows of the vertices, then the nodes' rows; `ends.curved` says whose fits speak."""
    count, top = len(points), int(fits.degree.max())
    rows, cols, values = [torch.arange(count)], [torch.arange(count)], [bary.new_ones(count)]
    flat = ~ends.curved[ends.node]
    rows.append(count + ends.node[flat])
    cols.append(ends.vertex[flat])
    values.append(ends.weight[flat])
    for part in (~flat).nonzero()[:, 0].split(2**15):
        node, vertex = ends.node[part], ends.vertex[part]
        y = ((places[count + node] - points[vertex])[:, None] @ frames[vertex])[:, 0]
        powers = monomials(y / fits.radius[vertex, None], top)
        others = (powers[:, None] @ fits.map[vertex])[:, 0]
        row = torch.cat([1 - others.sum(1, keepdim=True), others], 1) * ends.weight[part, None]
        rows.append((count + node)[:, None].expand_as(row).flatten())
        cols.append(fits.index[vertex].flatten())
        values.append(row.flatten())
    where = torch.cat(rows).numpy(), torch.cat(cols).numpy()
    return sparse.csr_array((torch.cat(values).numpy(), where), shape=(len(places), count))


class Ends(NamedTuple):
    """Pairs of a node and one of the vertices that it asks, with its barycentric; and which nodes are curved."""

    node: Tensor
    vertex: Tensor
    weight: Tensor
    curved: Tensor


def heights(
    points: Tensor, frames: Tensor, normals: Tensor, fits: Fits, ends: Ends, s: Tensor, nu: Tensor
) -> Tensor:
    """t of every pair: where the line s + tν of the node meets the graph of the vertex's heights, by Newton."""
    top, t = int(fits.degree.max()), torch.zeros(len(ends.node), dtype=points.dtype)
    frame, normal = frames[ends.vertex], normals[ends.vertex]
    radius, height = fits.radius[ends.vertex, None], fits.height[ends.vertex][..., 0]
    along = nu[ends.node]
    turn = (along[:, None] @ frame)[:, 0] / radius
    for _ in range(NEWTON_STEPS):
        p = s[ends.node] + t[:, None] * along - points[ends.vertex]
        y = (p[:, None] @ frame)[:, 0] / radius
        value = (p * normal).sum(1) - (monomials(y, top) * height).sum(1)
        slope = (monomial_derivatives(y, top) * height[..., None]).sum(1)
        t = t - value / ((along * normal).sum(1) - (slope * turn).sum(1))
    return torch.where(t.isfinite(), t, torch.inf)


def weak_pair(points: Tensor, faces: Tensor, degree: int, degrees: tuple[int, ...]):
    """(K, M, share of the edges that are curved) with elements of one degree, and fits of the first that passes."""
    faces = flipped(points, faces)
    count = len(points)
    normals = vertex_normals(points, faces)
    frames = complete_frames(normals)
    balls = GraphBalls(points, mesh_graph(faces, count), frames)
    fits = fit_vertices(points, frames, normals, balls, degrees)
    half = torch.cat([faces[:, list(edge)] for edge in EDGES])
    low_high = torch.stack([half.amin(1), half.amax(1)], 1)
    edges, edge, uses = torch.unique(low_high, dim=0, return_inverse=True, return_counts=True)
    edge = edge.view(3, len(faces)).T
    inner, inside = degree - 1, len(lattice(degree)) - 3 * degree
    steps = torch.arange(1, degree, dtype=points.dtype) / degree
    on_edges = torch.stack([1 - steps, steps, 0 * steps], 1).repeat(len(edges), 1)
    corners = torch.cat([edges, edges[:, :1]], 1).repeat_interleave(inner, 0)
    corners = torch.cat([corners, faces.repeat_interleave(inside, 0)])
    bary = torch.cat([on_edges, lattice(degree)[3 * degree :].repeat(len(faces), 1)])
    s = (bary[..., None] * points[corners]).sum(1)
    nu = normalize((bary[..., None] * normals[corners]).sum(1))
    node, place = (bary > 0).nonzero(as_tuple=True)
    vertex, weight = corners[node, place], bary[node, place]
    ends = Ends(node, vertex, weight, torch.ones(len(s), dtype=torch.bool))
    t = heights(points, frames, normals, fits, ends, s, nu)

    length = (points[edges[:, 0]] - points[edges[:, 1]]).norm(dim=1)
    size = torch.cat(
        [length.repeat_interleave(inner), length[edge].amax(1).repeat_interleave(inside)]
    )
    least = torch.full_like(size, torch.inf).scatter_reduce(0, node, t, "amin")
    most = torch.full_like(size, -torch.inf).scatter_reduce(0, node, t, "amax")
    fitted = torch.ones(len(s), dtype=torch.bool)
    fitted = fitted.scatter_reduce(0, node, fits.degree[vertex] > 0, "amin")
    sound = fitted & (most - least <= 0.15 * size)
    sound &= torch.maximum(most.abs(), least.abs()) <= 0.3 * size
    curved = (normals[edges[:, 0]] + normals[edges[:, 1]]).norm(dim=1) > 1
    curved &= (uses <= 2) & sound[: len(edges) * inner].view(len(edges), inner).all(1)
    mean = torch.zeros_like(size).index_add(0, node, weight * t.nan_to_num(0, 0, 0))

    on_edge = count + edge[:, :, None] * inner + torch.arange(inner)
    turned = torch.stack([faces[:, i] > faces[:, j] for i, j in EDGES], 1)
    on_edge = torch.where(turned[..., None], on_edge.flip(-1), on_edge)
    first = count + len(edges) * inner + torch.arange(len(faces))[:, None] * inside
    nodes = torch.cat([faces, on_edge.flatten(1), first + torch.arange(inside)], 1)
    sides = (points[faces[:, [1, 2, 0]]] - points[faces]).norm(dim=2)
    lack = 1e-5 * sides.mean() - (sides.sum(1) - 2 * sides.amax(1))
    plane = flat_metric(sides + lack.clamp_min(0).max())
    area, shape = area_element(plane), element(degree)
    curved[edge[area < 1e-3 * sides.amax(1) ** 2].flatten()] = False
    while True:
        whole = curved[edge].all(1) & sound[len(edges) * inner :].view(len(faces), inside).all(1)
        bent = torch.cat([curved.repeat_interleave(inner), whole.repeat_interleave(inside)])
        places = torch.cat([points, s + torch.where(bent, mean, 0.0)[:, None] * nu])
        flat = ~curved[edge].any(1)
        g = torch.where(flat[:, None, None], plane[:, None], metric(places[nodes], shape))
        ratio = area_element(g) / area[:, None]
        bad = ((ratio < 1 / 3) | (ratio > 3)).any(1) & ~flat
        if not bad.any():
            break
        curved[edge[bad].flatten()] = False
    p = prolongation(points, places, frames, fits, ends._replace(curved=bent), bary)
    stiffness, mass = assemble(g, nodes, shape, len(places))
    pair = (sparse.csc_array(p.T @ matrix @ p) for matrix in (stiffness, mass))
    return *pair, float(curved.double().mean())


def cotangent_pair(points: Tensor, faces: Tensor, *_):
    vertices, corners = points.numpy(), faces.numpy()
    mass = igl.massmatrix(vertices, corners, igl.MASSMATRIX_TYPE_VORONOI)
    return sparse.csc_array(-igl.cotmatrix(vertices, corners)), sparse.csc_array(mass), 0.0


METHODS = {
    "cotangent": (cotangent_pair, 0, ()),
    "r = 2, m = 2": (weak_pair, 2, (2,)),
    "r = 2, m = 4, 2": (weak_pair, 2, (4, 2)),
    "r = 3, m = 4, 2": (weak_pair, 3, (4, 2)),
    "r = 4, m = 6, 4, 2": (weak_pair, 4, (6, 4, 2)),
}


def show(name: str, points: Tensor, faces: Tensor, exact: np.ndarray, methods: list[str]) -> None:
    for method in methods:
        pair, degree, degrees = METHODS[method]
        start = time.perf_counter()
        stiffness, mass, curved = pair(points, faces, degree, degrees)
        seconds = time.perf_counter() - start
        found = np.sort(eigsh(stiffness, len(exact), mass, sigma=-0.01)[0])
        error = np.abs(found[1:] / exact[1:] - 1)
        print(
            f"| {name} | {len(points)} | {method} | {100 * curved:.1f} | {np.median(error):.1e} | {error.max():.1e} "
            f"| {seconds:.1f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("shapes", nargs="*", help="files with vertices, faces, eigenvalues")
    parser.add_argument("--quick", action="store_true", help="the small sphere alone")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("\n".join(versions()), end="\n\n")
    print("| shape | N | pair | % of edges curved | median | worst | s |")
    print("|:--|--:|:--|--:|--:|--:|--:|", flush=True)
    exact = np.repeat([level * (level + 1) for level in range(5)], [1, 3, 5, 7, 9])
    for size in (2022,) if options.quick else (2022, 8038):
        points = deserno_points(size)
        show("sphere", points, Sphere().triangulate(points), exact, list(METHODS))
    for path in options.shapes:
        with np.load(path) as shape:
            names = [n for n in shape.files if n.startswith("faces") or n.endswith("_faces")]
            for key in names:
                faces = torch.from_numpy(shape[key].astype(np.int64))
                of = shape["irregular_vertices" if key.startswith("irregular") else "vertices"]
                points = torch.from_numpy(of[: int(faces.max()) + 1].astype(np.float64))
                show(f"{path} {key}", points, faces, shape["eigenvalues"][:41], list(METHODS)[:3])


if __name__ == "__main__":
    main()
