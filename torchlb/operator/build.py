"""Build an operator on a mesh, or on a complex through a cloud: checks, shape, weak pair, stencils, certificate."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchlb.baseline.cotangent import cotangent_laplacian
from torchlb.certified.certificate import certify
from torchlb.cloud import doubts
from torchlb.cloud.complexes import Complex
from torchlb.cloud.reconstruction import reconstruct
from torchlb.cloud.surface import CloudSurface
from torchlb.errors import InputError, first_few, renumbered, warn
from torchlb.galerkin.coarse import lying_triangles, with_area
from torchlb.galerkin.flips import flipped
from torchlb.galerkin.matrices import PairMatrices
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.pair import mesh_pair
from torchlb.geometry.boundary import open_sides, outward_sums
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.thresholds import NEAREST
from torchlb.geometry.vectors import Points
from torchlb.linalg.precision import LOW
from torchlb.linalg.sparse import from_scipy
from torchlb.linalg.threads import beside, threads_for
from torchlb.operator import checks
from torchlb.operator.inputs import ArrayLike, check_points
from torchlb.operator.plan import Parts, Plan, operator_parts
from torchlb.stencils.assemble import Stencils, assemble
from torchlb.stencils.options import Options
from torchlb.stencils.rows import Reason, Rows, matrix_rows
from torchlb.stencils.shape import Shape, mesh_shape, surface_shape

Reconstruction = Callable[[Tensor], ArrayLike | Complex]
"""Function from points, (N, n) float64, to cells through them."""
MANY = 0.5
"""Share of low-order rows from which a warning reports them."""
REMEDIES = {
    "mesh": "A finer mesh, or one without noise, has better ones",
    "points": "Do the points lie on a manifold of dimension {}? If not, pass its dimension as `dim`; else add points",
}


def build_mesh(
    vertices: ArrayLike, faces: ArrayLike, options: Options, *, boundary: Any, progress: bool
) -> Parts:
    """Build an operator on a mesh; arguments as for `LaplaceBeltrami.from_mesh`."""
    vertices, corners = _checked(vertices, faces)
    options.check(len(vertices), vertices.shape[1], corners.shape[1] - 1)
    corners = checks.mended_faces(vertices, corners)
    where = checks.check_boundary(boundary, len(vertices))
    progress = progress and sys.stderr.isatty()
    return on_cells(vertices, vertices, corners, options, where, "mesh", progress)


def _checked(vertices: ArrayLike, faces: ArrayLike) -> tuple[Tensor, Tensor]:
    vertices = check_points(vertices, "vertices")
    checks.check_scale(vertices)
    return vertices, checks.check_faces(faces, len(vertices))


def build_cloud(
    points: ArrayLike,
    dim: int | None,
    options: Options,
    *,
    normals: ArrayLike | None,
    boundary: ArrayLike | str | None,
    reconstruction: Reconstruction | None,
    progress: bool,
) -> Parts:
    """Build an operator on a point cloud; arguments as for `LaplaceBeltrami.from_points`."""
    points = check_points(points)
    checks.check_scale(points)
    checks.check_distinct(points)
    ambient, found = points.shape[1], None
    if reconstruction is None:
        d = checks.check_dimension(points, dim, hypersurface=normals is not None)
    else:
        found = _given_complex(points, reconstruction, dim)
        d = found.cells.shape[1] - 1
    options.check(len(points), ambient, d)
    where = checks.check_boundary(boundary, len(points))
    held = options.held
    if boundary is None and held is not None and not held.conserves:
        raise InputError(
            f"boundary: condition={held!r} holds at boundary points; pass a mask of them, or 'detect'"
        )
    if normals is not None:
        if d != ambient - 1:
            raise InputError(f"normals: only hypersurfaces have them, not dim={d} in R^{ambient}")
        normals = checks.check_normals(normals, points)
    index, progress = torch.arange(len(points)), progress and sys.stderr.isatty()
    numbering = Numbering.along_tree(points) if found is None else Numbering(index, index)
    here = numbering.sorted(points)
    mask = None if where is None else numbering.sorted(where)
    normals = None if normals is None else numbering.sorted(normals)
    with renumbered(numbering.given), threads_for(len(points)):
        if found is None:
            found = reconstruct(here, d, normals=normals, boundary=mask)
        if found.shares is not None and held and not held.conserves and not held.fixes:
            raise InputError(
                f"condition={held!r}: the boundary of a cloud of dimension {d} in R^{ambient} is that of a mask, which "
                "has no measure; 'neumann' and 'dirichlet' can hold there, and from_mesh takes every condition"
            )
        if mask is not None and found.shares is None:
            doubts.warn_of_buried(found.cells, mask)
        if isinstance(found, CloudSurface):
            return _on_surface(points, here, found, options, mask, numbering, progress)
        if d == 1:
            near = nearest_neighbors(here, min(NEAREST, len(here)))
            doubts.warn_of_near_duplicates(here, near, 1)
    cells, edge = numbering.given[found.cells], None
    if where is not None:
        edge = where if found.shares is not None else where & doubts.on_rim(cells, len(points))
    rest = numbering.restored(found.points), cells, options, edge, "points", progress, found.shares
    return on_cells(points, *rest)


def _given_complex(points: Points, reconstruction: Reconstruction, dim: int | None) -> Complex:
    """The complex that a user's function makes of the points, checked."""
    found = reconstruction(points.clone())
    if isinstance(found, Complex) and (isinstance(found, CloudSurface) or found.shares is not None):
        return found
    places, cells = (found.points, found.cells) if isinstance(found, Complex) else (points, found)
    places = check_points(places)
    cells = checks.mended_faces(places, checks.check_faces(cells, len(points)))
    if places.shape != points.shape or dim not in (None, cells.shape[1] - 1):
        raise InputError(
            f"reconstruct: expected cells through the {len(points)} points, of dimension {dim or 'any'}, got some of "
            f"shape {tuple(cells.shape)} through {tuple(places.shape)}"
        )
    return Complex(points=places, cells=cells)


def _on_surface(
    points: Points,
    here: Points,
    surface: CloudSurface,
    options: Options,
    boundary: Bool[Tensor, " N"] | None,
    numbering: Numbering,
    progress: bool,
) -> Parts:
    """Build an operator on a cloud in R² or R³, sorted `here`, by the surface through it."""
    placed = torch.where(surface.lone[:, None], surface.points[:, : here.shape[1]], here)
    doubts.warn_of_near_duplicates(placed, surface.neighbors, 2)
    if here.shape[1] == 3:
        doubts.warn_of_layers(here)
    surface = replace(surface, cells=flipped(surface.points, surface.cells))
    own = options.taken(numbering)
    shape = surface_shape(here, surface, own, boundary=boundary, progress=progress)
    faces, order = numbering.given[surface.cells], torch.arange(len(surface.cells))
    plan = _plan(shape, numbering, points, faces, order, order[:0], "points", options)
    return finished(plan, shape, progress, surface)


def on_cells(
    given: Points,
    vertices: Points,
    cells: Int[Tensor, "F corners"],
    options: Options,
    boundary: Bool[Tensor, " N"] | None,
    source: str,
    progress: bool,
    shares: Float[Tensor, " F"] | None = None,
) -> Parts:
    """Build an operator of the points `given` on a complex whose vertices are these points, moved to `vertices`.

    Where cells overlap, `shares` are the fractions of them that count. With a weak pair, triangles without area along
    the boundary are left out, and folds and slivers flipped away, also for the stencil.
    """
    numbering = Numbering.along_tree(vertices)
    here, (corners, order) = numbering.sorted(vertices), numbering.faces(cells)
    if options.weak_form and corners.shape[1] == 3:
        kept = with_area(here, corners)
        corners, order = corners[kept], order[kept]
        if here.shape[1] <= 3:
            corners = flipped(pad(here, (0, 3 - here.shape[1])), corners)
    with renumbered(numbering.given), threads_for(len(vertices)):
        part = None if boundary is None else numbering.sorted(boundary)
        own, on_mesh = options.taken(numbering), source == "mesh"
        shares = None if shares is None else shares[order]
        shape = mesh_shape(
            here, corners, own, boundary=part, progress=progress, shares=shares, on_mesh=on_mesh
        )
        moved = (vertices != given).any(1).nonzero()[:, 0]
        plan = _plan(shape, numbering, given, cells, order, moved, source, options)
        return finished(plan, shape, progress)


def _plan(shape: Shape, numbering: Numbering, points: Tensor, *rest: Any) -> Plan:
    """Plan of a shape, whose stencils and pair are still to be decided."""
    assert shape.plan is not None
    return Plan(numbering, points, shape.plan, None, None, [], *rest)


def finished(
    plan: Plan, shape: Shape, progress: bool, surface: CloudSurface | None = None
) -> Parts:
    """The operator of a shape of cells: weak pair, rows, certified if asked for, and the rest of the plan."""
    options, fits = plan.options.taken(plan.numbering), plan.shape.fits
    waiting = pair = None
    if options.weak_form:
        cells, stars = (surface.cells, surface.stars) if surface else (plan.shape.cells, None)
        rest = stars, shape.held, plan.shape.shares, plan.numbering
        assert shape.fits is not None
        own = fits, shape.fits, *options.elements
        waiting = beside(mesh_pair, cells, *own, *rest)
        if not shape.condition.conserves:  # low-order rows need the mass
            shape = replace(shape, mass=waiting()[2])
    stencils = Stencils(shape, options)
    rows, certificate = assemble(stencils, progress=progress), None
    if waiting is not None:
        pair_plan, pair, mass = waiting()
        plan, shape = replace(plan, pair=pair_plan), replace(shape, mass=mass)
    if surface is not None:
        if pair is not None:
            doubts.warn_of_doubts(surface, fits, shape.areas)
        doubts.warn_of_joins(surface)
    if options.certify:
        last, outflow = len(stencils.candidates), not shape.condition.conserves
        rows, mass, certificate = certify(
            rows, shape.areas, stencils.rows, last, outflow=outflow, progress=progress
        )
        shape = replace(shape, mass=mass)
    if shape.boundary is None and not shape.condition.conserves:
        warn(
            f"condition={shape.condition!r} holds nowhere: no boundary, or `boundary` has none of it; leave the "
            "condition out"
        )
    planned = None if certificate else stencils.plan(rows)
    plan = replace(plan, rows=planned, flips=shape.low_order.flips)
    _warn_of_low_order(rows, plan)
    found = {"certificate": certificate, "surface": surface and surface.summary}
    return operator_parts(plan, plan.points, rows, shape, pair, **found)


def _warn_of_low_order(rows: Rows, plan: Plan) -> None:
    """Warn if most points have only low-order rows."""
    low = rows.order == 0
    share = float(low.double().mean())
    if share < MANY:
        return
    reason = Reason(int(rows.reason[low].mode().values)).text
    remedy = REMEDIES[plan.source].format(plan.faces.shape[1] - 1)
    reason += f". {remedy}; `print(lb.report)` says more"
    if plan.pair is not None:
        _, _, edges, curved = plan.pair.counts.sum(1).tolist()
        share_curved = f"{curved / max(edges, 1):.0%} of its edges curved"
        reason += f". Spectrum, diffusion and solves have the weak pair, {share_curved}"
    low_rows = "have only low-order rows for Δf and ∇f, of first order at best"
    warn(f"{share:.0%} of the points {low_rows}; at most of them: {reason}")


def build_cotangent(vertices: ArrayLike, faces: ArrayLike) -> Parts:
    """Build the cotangent operator with its mass; arguments as for `LaplaceBeltrami.from_cotangent`."""
    vertices, cells = _checked(vertices, faces)
    if cells.shape[1] != 3:
        raise InputError(f"faces: the cotangent operator needs triangles, got {tuple(cells.shape)}")
    cells = checks.mended_faces(vertices, cells)
    _warn_of_long_triangles(vertices, cells)
    matrix, mass = cotangent_laplacian(vertices, cells)
    options = Options(1, 0, condition=None, weak_form=False)
    shape = replace(mesh_shape(vertices, cells, options), mass=mass)
    centers = torch.arange(len(vertices))
    crow, col, laplacian = from_scipy(matrix)
    entries = col, laplacian, torch.ones_like(col, dtype=torch.bool)
    rows = matrix_rows(crow.diff(), *entries, shape.points, shape.frames, centers)
    row = centers.repeat_interleave(rows.length)
    diagonal = row == rows.col
    weak = [-mass[row] * rows.laplacian, mass[row] * diagonal]
    _, length = outward_sums(vertices, *open_sides(cells))
    if length.any():  # lumped, as the mass is
        weak.append(length[row] / 2 * diagonal)
    pair = PairMatrices(rows.crow, rows.col, torch.stack(weak))
    every, same = torch.arange(len(cells)), Numbering(centers, centers)
    plan = _plan(shape, same, vertices, cells, every, every[:0], "cotangent", options)
    return operator_parts(plan, vertices, rows, shape, pair)


def _warn_of_long_triangles(vertices: Points, faces: Int[Tensor, "F 3"]) -> None:
    """Warn where long triangles lie along much of the boundary."""
    nodes = lagrange_nodes(faces, len(vertices), 2)
    outer = nodes.sides[2].uses == 1
    sides = nodes.edge[lying_triangles(vertices, nodes, outer)].flatten()
    of = outer & torch.isin(torch.arange(len(outer)), sides)
    length = (vertices[nodes.edges[:, 0]] - vertices[nodes.edges[:, 1]]).norm(dim=1)
    long, whole = length[of].sum(), length[outer].sum()
    if long > LOW * whole:
        ends = nodes.edges[of].unique()
        warn(
            f"cotangent operator: {long / whole:.0%} of the boundary ({first_few(ends)}) has long triangles along it, "
            "which tie the vertices there to straight lines, and eigenvalues may be far too large; "
            "LaplaceBeltrami.from_mesh has no such ties"
        )
