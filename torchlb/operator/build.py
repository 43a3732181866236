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
from torchlb.errors import InputError, first_few, renumbered, warn
from torchlb.galerkin.coarse import lying_triangles, with_area
from torchlb.galerkin.flips import flipped
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.pair import PairPlan, SparsePair, WeakPair, mesh_pair
from torchlb.geometry.boundary import open_sides, outward_sums
from torchlb.geometry.numbering import Numbering
from torchlb.linalg.precision import LOW
from torchlb.linalg.threads import threads_for
from torchlb.operator.assembled import AssembledOperator
from torchlb.operator.checks import (
    check_boundary,
    check_faces,
    check_scale,
    mended_faces,
)
from torchlb.operator.inputs import ArrayLike, check_points
from torchlb.operator.options import Options
from torchlb.operator.plan import Plan, stencils_of
from torchlb.stencils.assemble import assemble
from torchlb.stencils.conditions import Condition
from torchlb.stencils.rows import Reason, matrix_rows
from torchlb.stencils.shape import Shape, mesh_shape

MANY = 0.5
"""Share of low-order rows from which a warning reports them."""
REMEDIES = {
    "mesh": "A finer mesh, or one without noise, has better ones",
    "points": "Do the points lie on a manifold of dimension {}? If not, pass its dimension as `dim`; else add points",
}


def with_plan(
    built: AssembledOperator,
    shape: Shape,
    pair: PairPlan | None,
    options: Options,
    numbering: Numbering,
    order: Int[Tensor, " G"],
    moved: Int[Tensor, " m"],
) -> AssembledOperator:
    """Attach the plan of an operator that has a weak pair; any other is returned unchanged."""
    if pair is None or shape.plan is None:
        return built
    rows = None if built.certificate else stencils_of(shape, options).plan(built.rows)
    parts = numbering, shape.plan, rows, pair, shape.low_order.flips, built.faces, order
    plan = Plan(*parts, shape.on_mesh, moved, built.source, options)
    return replace(built, plan=plan)


def numbered_mesh(
    points: Float[Tensor, "N n"], faces: Int[Tensor, "F v"], *, flip: bool
) -> tuple[Numbering, Float[Tensor, "N n"], Int[Tensor, "G v"], Int[Tensor, " G"]]:
    """Number a mesh along a k-d tree; return the numbering, points, faces and the input index of each face.

    With `flip`, as where a weak pair is built, triangles without area along the boundary are left out and folds and
    slivers flipped away. The stencil has these faces, too: they give its neighbours and first normals.
    """
    numbering = Numbering.along_tree(points)
    here, (corners, order) = numbering.sorted(points), numbering.faces(faces)
    if flip and corners.shape[1] == 3:
        kept = with_area(here, corners)
        corners, order = corners[kept], order[kept]
    if flip and corners.shape[1] == 3 and points.shape[1] <= 3:
        corners = flipped(pad(here, (0, 3 - here.shape[1])), corners)
    return numbering, here, corners, order


def build_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    options: Options,
    *,
    boundary: ArrayLike | str | None,
    progress: bool,
) -> AssembledOperator:
    """Build an operator on a mesh; arguments as for `LaplaceBeltrami.from_mesh`."""
    vertices = check_points(vertices, "vertices")
    check_scale(vertices)
    corners = check_faces(faces, len(vertices))
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


def on_cells(
    given: Float[Tensor, "N n"],
    vertices: Float[Tensor, "N n"],
    cells: Int[Tensor, "F corners"],
    options: Options,
    boundary: Bool[Tensor, " N"] | str | None,
    source: str,
    progress: bool,
    shares: Float[Tensor, " F"] | None = None,
) -> AssembledOperator:
    """Build an operator of the points `given` on a complex whose vertices are these points, moved to `vertices`.

    Where cells overlap, `shares` are the fractions of them that count.
    """
    degree, degrees = options.elements
    numbering, here, corners, order = numbered_mesh(vertices, cells, flip=degree > 0)
    with renumbered(numbering.given), threads_for(len(vertices)):
        shape = mesh_shape(
            here,
            corners,
            options.q,
            num_neighbors=options.num_neighbors,
            boundary=numbering.sorted(boundary) if isinstance(boundary, Tensor) else None,
            condition=options.held(numbering),
            fit_degrees=degrees,
            progress=progress,
            shares=None if shares is None else shares[order],
            on_mesh=source == "mesh",
        )
        pair = plan = None
        if degree > 0:
            assert shape.plan is not None
            assert shape.fits is not None
            own = shape.plan.fits, shape.fits, degree, degrees
            rest = {"held": shape.held, "shares": shape.plan.shares}
            plan, pair = mesh_pair(here, corners, *own, **rest, numbering=numbering)
            assert pair.mass is not None
            shape = replace(shape, areas=pair.mass)
        built = replace(finished(shape, source, options, progress, pair, plan), faces=cells)
        moved = (vertices != given).any(1).nonzero()[:, 0]
        built = with_plan(built, shape, plan, options, numbering, order, moved)
    return built.restored(numbering, given, cells)


def build_cotangent(vertices: ArrayLike, faces: ArrayLike) -> AssembledOperator:
    """Build the cotangent operator with its mass; arguments as for `LaplaceBeltrami.from_cotangent`."""
    vertices = check_points(vertices, "vertices")
    check_scale(vertices)
    corners = check_faces(faces, len(vertices))
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
    return replace(AssembledOperator.of(rows, shape, pair, "cotangent", {}), faces=corners)


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


def finished(
    shape: Shape,
    source: str,
    options: Options,
    progress: bool,
    pair: WeakPair | None = None,
    plan: PairPlan | None = None,
) -> AssembledOperator:
    """Assemble the rows, certified if asked for; warn if most points have only low-order rows."""
    stencils = stencils_of(shape, options)
    rows, certificate = assemble(stencils, progress=progress), None
    if options.certify:
        rows, mass, certificate = certify(
            rows,
            shape.areas,
            stencils.rows,
            len(stencils.candidates),
            outflow=not shape.condition.conserves,
            progress=progress,
        )
        shape = replace(shape, areas=mass)
    if shape.boundary is None and not shape.condition.conserves:
        warn(
            f"condition={shape.condition!r} holds nowhere: no boundary, or `boundary` has none of it; leave the "
            "condition out"
        )
    low, counts = rows.order == 0, None if plan is None else plan.counts
    share = float(low.double().mean())
    if share >= MANY:
        reason = Reason(int(rows.reason[low].mode().values)).text
        reason += (
            f". {REMEDIES[source].format(shape.frames.shape[-1])}; `print(lb.report)` says more"
        )
        if counts is not None:
            _, _, edges, curved = counts.sum(1).tolist()
            share_curved = f"{curved / max(edges, 1):.0%} of its edges curved"
            reason += f". Spectrum, diffusion and solves have the weak pair, {share_curved}"
        low_rows = "have only low-order rows for Δf and ∇f, of first order at best"
        warn(f"{share:.0%} of the points {low_rows}; at most of them: {reason}")
    return AssembledOperator.of(rows, shape, pair, source, options.plain, counts, certificate)
