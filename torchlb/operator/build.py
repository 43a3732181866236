"""Build an operator on a mesh: checks, shape, weak pair, stencils, certificate."""

from __future__ import annotations

import sys
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchlb.baseline.cotangent import cotangent_laplacian
from torchlb.certified.certificate import certify
from torchlb.cloud.doubts import warn_of_doubts, warn_of_joins
from torchlb.cloud.surface import CloudSurface
from torchlb.errors import InputError, first_few, renumbered, warn
from torchlb.galerkin.coarse import lying_triangles, with_area
from torchlb.galerkin.flips import flipped
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.pair import SparsePair, WeakPair, mesh_pair
from torchlb.geometry.boundary import open_sides, outward_sums
from torchlb.geometry.numbering import Numbering
from torchlb.linalg.precision import LOW
from torchlb.linalg.threads import threads_for
from torchlb.operator.checks import check_boundary, check_faces, check_scale, mended_faces
from torchlb.operator.inputs import ArrayLike, check_points
from torchlb.operator.options import Options
from torchlb.operator.plan import Parts, Plan, operator_parts, stencils_of
from torchlb.stencils.assemble import assemble
from torchlb.stencils.conditions import Condition
from torchlb.stencils.rows import Reason, Rows, matrix_rows
from torchlb.stencils.shape import Shape, mesh_shape

MANY = 0.5
"""Share of low-order rows from which a warning reports them."""
REMEDIES = {
    "mesh": "A finer mesh, or one without noise, has better ones",
    "points": "Do the points lie on a manifold of dimension {}? If not, pass its dimension as `dim`; else add points",
}


def build_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    options: Options,
    *,
    boundary: ArrayLike | str | None,
    progress: bool,
) -> Parts:
    """Build an operator on a mesh; arguments as for `LaplaceBeltrami.from_mesh`."""
    vertices, corners = _checked(vertices, faces)
    options.check(len(vertices), vertices.shape[1], corners.shape[1] - 1)
    corners = mended_faces(vertices, corners)
    if isinstance(boundary, str) and boundary in Condition.known:
        raise InputError(
            f"boundary: expected where the condition holds, a mask of the vertices, got {boundary!r}; what holds there "
            f"is condition={boundary!r}"
        )
    where = check_boundary(boundary, len(vertices))
    progress = progress and sys.stderr.isatty()
    return on_cells(vertices, vertices, corners, options, where, "mesh", progress)


def _checked(vertices: ArrayLike, faces: ArrayLike) -> tuple[Tensor, Tensor]:
    vertices = check_points(vertices, "vertices")
    check_scale(vertices)
    return vertices, check_faces(faces, len(vertices))


def on_cells(
    given: Float[Tensor, "N n"],
    vertices: Float[Tensor, "N n"],
    cells: Int[Tensor, "F corners"],
    options: Options,
    boundary: Bool[Tensor, " N"] | str | None,
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
        shape = mesh_shape(
            here,
            corners,
            options.q,
            num_neighbors=options.num_neighbors,
            boundary=numbering.sorted(boundary) if isinstance(boundary, Tensor) else None,
            condition=options.held(numbering),
            fit_degrees=options.elements[1],
            progress=progress,
            shares=None if shares is None else shares[order],
            on_mesh=source == "mesh",
        )
        moved = (vertices != given).any(1).nonzero()[:, 0]
        places = given, cells, order, moved
        return finished(shape, corners, places, source, options, numbering, progress)


def finished(
    shape: Shape,
    cells: Int[Tensor, "G corners"],
    places: tuple[Tensor, Tensor, Tensor, Tensor],
    source: str,
    options: Options,
    numbering: Numbering,
    progress: bool,
    surface: CloudSurface | None = None,
) -> Parts:
    """The operator of a shape of cells: weak pair, rows, certified if asked for, and plan.

    `places` are the user's points and cells, the place of each cell of the shape among these, and moved points.
    """
    (degree, degrees), pair, pair_plan, plan = options.elements, None, None, None
    if degree > 0:
        assert shape.plan is not None
        assert shape.fits is not None
        own = shape.plan.fits, shape.fits, degree, degrees
        stars = None if surface is None else surface.stars
        rest = stars, shape.held, shape.plan.shares, numbering
        pair_plan, pair = mesh_pair(shape.points, cells, *own, *rest)
        assert pair.mass is not None
        shape = replace(shape, areas=pair.mass)
    if surface is not None:
        if pair_plan is not None:
            warn_of_doubts(surface, pair_plan.fits, shape.areas)
        warn_of_joins(surface)
    stencils = stencils_of(shape, options)
    rows, certificate = assemble(stencils, progress=progress), None
    if options.certify:
        last, outflow = len(stencils.candidates), not shape.condition.conserves
        rows, mass, certificate = certify(
            rows, shape.areas, stencils.rows, last, outflow=outflow, progress=progress
        )
        shape = replace(shape, areas=mass)
    if shape.boundary is None and not shape.condition.conserves:
        warn(
            f"condition={shape.condition!r} holds nowhere: no boundary, or `boundary` has none of it; leave the "
            "condition out"
        )
    points, faces, order, moved = places
    if pair_plan is not None and shape.plan is not None:
        planned = None if certificate else stencils.plan(rows), pair_plan, shape.low_order.flips
        of_cells = faces, order, shape.on_mesh, moved
        plan = Plan(numbering, points, shape.plan, *planned, *of_cells, source, options)
    _warn_of_low_order(rows, shape, source, plan)
    found = {"certificate": certificate, "surface": surface and surface.summary}
    of_user = numbering, points, faces, source, options
    return operator_parts(rows, shape, pair, *of_user, plan, **found)


def _warn_of_low_order(rows: Rows, shape: Shape, source: str, plan: Plan | None) -> None:
    """Warn if most points have only low-order rows."""
    low = rows.order == 0
    share = float(low.double().mean())
    if share < MANY:
        return
    reason = Reason(int(rows.reason[low].mode().values)).text
    reason += f". {REMEDIES[source].format(shape.frames.shape[-1])}; `print(lb.report)` says more"
    if plan is not None:
        _, _, edges, curved = plan.pair.counts.sum(1).tolist()
        share_curved = f"{curved / max(edges, 1):.0%} of its edges curved"
        reason += f". Spectrum, diffusion and solves have the weak pair, {share_curved}"
    low_rows = "have only low-order rows for Δf and ∇f, of first order at best"
    warn(f"{share:.0%} of the points {low_rows}; at most of them: {reason}")


def build_cotangent(vertices: ArrayLike, faces: ArrayLike) -> Parts:
    """Build the cotangent operator with its mass; arguments as for `LaplaceBeltrami.from_cotangent`."""
    vertices, corners = _checked(vertices, faces)
    if corners.shape[1] != 3:
        raise InputError(
            f"faces: the cotangent operator needs triangles, got {tuple(corners.shape)}"
        )
    corners = mended_faces(vertices, corners)
    _warn_of_long_triangles(vertices, corners)
    matrix, mass = cotangent_laplacian(vertices, corners)
    shape = replace(mesh_shape(vertices, corners, 0, condition=None), areas=mass)
    centers = torch.arange(len(vertices))
    rows = matrix_rows(matrix, shape.points, shape.frames, centers)
    row = centers.repeat_interleave(rows.length)
    diagonal = row == rows.col
    weak = [-mass[row] * rows.laplacian, mass[row] * diagonal]
    _, length = outward_sums(vertices, *open_sides(corners))
    if length.any():  # lumped, as the mass is
        weak.append(length[row] / 2 * diagonal)
    pair = WeakPair(SparsePair(rows.crow, rows.col, torch.stack(weak)))
    of_user = Numbering(centers, centers), vertices, corners, "cotangent", None, None
    return operator_parts(rows, shape, pair, *of_user)


def _warn_of_long_triangles(vertices: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"]) -> None:
    """Warn where long triangles lie along much of the boundary."""
    nodes = lagrange_nodes(faces, len(vertices), 2)
    outer = nodes.sides[2].uses == 1
    of = torch.zeros_like(outer)
    of[nodes.edge[lying_triangles(vertices, nodes, outer)].flatten()] = True
    length = (vertices[nodes.edges[:, 0]] - vertices[nodes.edges[:, 1]]).norm(dim=1)
    long, whole = length[of & outer].sum(), length[outer].sum()
    if long > LOW * whole:
        ends = nodes.edges[of & outer].unique()
        warn(
            f"cotangent operator: {long / whole:.0%} of the boundary ({first_few(ends)}) has long triangles along it, "
            "which tie the vertices there to straight lines, and eigenvalues may be far too large; "
            "LaplaceBeltrami.from_mesh has no such ties"
        )
