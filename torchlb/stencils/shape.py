"""What stencils need to know of a shape: points, frames, neighbourhoods, boundary, areas and low-order rows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor
from tqdm import tqdm

from torchlb.errors import InputError, first_few, warn
from torchlb.geometry.boundary import Boundary, boundary_of_cloud, boundary_of_mesh, detect_boundary
from torchlb.geometry.candidates import list_candidates
from torchlb.geometry.frames import (
    cloud_frames,
    complete_frames,
    mesh_frames,
    normals_of_frames,
    refine_frames,
    vertex_normals,
)
from torchlb.geometry.neighbors import (
    AT_ONCE,
    GraphBalls,
    mesh_graph,
    nearest_graph,
    nearest_neighbors,
)
from torchlb.geometry.orientation import consistently_wound, orient_normals, thin_sides
from torchlb.geometry.surface import CloudSurface
from torchlb.geometry.vertex_fits import VertexFits
from torchlb.stencils.conditions import Condition, Neumann
from torchlb.stencils.low_order import (
    CloudLowOrder,
    CurveLowOrder,
    MeshLowOrder,
    simplex_shares,
)

LowOrder = CloudLowOrder | CurveLowOrder | MeshLowOrder
NEUMANN = Neumann()
CANDIDATES = {1: 32, 2: 24, 3: 64}
"""Nearest points from which the frames and the graph of a cloud start, by dimension."""


@dataclass(frozen=True)
class Shape:
    """A shape ready for stencils.

    Attributes
    ----------
    points : (N, n), ℓ, float64.
    frames : (N, n, d), orthonormal; [frames, normal] is right-handed where there is a normal.
    normals : (N, n) unit normals of a hypersurface, else None. Oriented by the faces, or consistently on a cloud.
    normal_order : (N,), the degree q of the fit behind each frame; 0 for a frame that stayed the initial one.
    balls : its neighbourhoods.
    areas : (N,), ℓ^d, positive: a first-order share of the area.
    low_order : M-matrix rows for points without a stencil; None if there are none to be had.
    boundary : its points and conormals; None for a closed shape, or where no condition holds.
    condition : what holds there.
    on_mesh : whether the triangles are given, and know the surface where points do not resolve it.
    fits : of functions at each vertex, where a weak pair is to be made from them.
    """

    points: Float[Tensor, "N n"]
    frames: Float[Tensor, "N n d"]
    normals: Float[Tensor, "N n"] | None
    normal_order: Int[Tensor, " N"]
    balls: GraphBalls
    areas: Float[Tensor, " N"]
    low_order: LowOrder | None
    boundary: Boundary | None
    condition: Condition
    on_mesh: bool = False
    fits: VertexFits | None = None

    @property
    def held(self) -> Bool[Tensor, " N"] | None:
        """Points whose values are zero by the condition; None if there are none."""
        return None if self.boundary is None or self.condition.conserves else self.boundary.mask


def cloud_shape(
    points: Float[Tensor, "N n"],
    dim: int,
    normal_order: int,
    *,
    num_neighbors: int | None = None,
    normals: Float[Tensor, "N n"] | None = None,
    boundary: Bool[Tensor, " N"] | str | None = None,
    condition: Condition | None = NEUMANN,
    progress: bool = True,
) -> Shape:
    """A point cloud: graph and frames from the nearest neighbours.

    `boundary` is the mask of its boundary points, or "detect"; `condition` what holds there, None if nothing does.
    """
    candidates = nearest_neighbors(points, min(CANDIDATES.get(dim, 128), len(points)))
    initial = cloud_frames(points, candidates, dim) if normals is None else complete_frames(normals)
    graph = nearest_graph(points, initial, candidates)
    sides = None
    if dim == points.shape[1] - 1:
        oriented = orient_normals(points, normals_of_frames(initial), candidates)
        normals = oriented if normals is None else normals
        sides = thin_sides(points, oriented, candidates)
    balls, order, _ = _refined(
        GraphBalls(points, graph, initial, sides), normal_order, num_neighbors, progress
    )
    frames = balls.frames
    mask = detect_boundary(points, frames, balls) if isinstance(boundary, str) else boundary
    if mask is None and dim == 2:
        _warn_of_open_surface(detect_boundary(points, frames, balls))
    edge = None if mask is None else boundary_of_cloud(points, mask, frames, normal_order)
    low_order = CloudLowOrder(balls, edge)
    return _oriented(balls, normals, order, low_order.areas(), low_order, edge, condition)


def _warn_of_open_surface(rim: Bool[Tensor, " N"]) -> None:
    index = rim.nonzero()[:, 0]
    if len(index) > len(rim) ** 0.5:
        warn(
            f"boundary: {len(index)} points ({first_few(index)}) look like those of an open surface's, and without a "
            "condition areas and Δ are wrong there; pass boundary='detect', or a mask"
        )


def mesh_shape(
    vertices: Float[Tensor, "N n"],
    faces: Int[Tensor, "F v"],
    normal_order: int,
    *,
    num_neighbors: int | None = None,
    boundary: Bool[Tensor, " N"] | None = None,
    condition: Condition | None = NEUMANN,
    areas: Float[Tensor, " N"] | None = None,
    fit_degrees: tuple[int, ...] = (),
    progress: bool = True,
) -> Shape:
    """A mesh of triangles (or of segments, or tetrahedra in Rⁿ): graph and frames from the faces.

    `condition` holds on its boundary, or on the part of it that is the mask `boundary`; None leaves it alone. With
    `areas` given there are no low-order rows. `fit_degrees` asks for `fits` of the first of them that passes.
    """
    initial = mesh_frames(vertices, faces)
    graph = mesh_graph(faces, len(vertices))
    reference = sides = None
    if faces.shape[1] == vertices.shape[1] and faces.shape[1] < 4:
        reference = vertex_normals(vertices, faces)
        if areas is None and consistently_wound(faces):
            candidates = nearest_neighbors(vertices, min(CANDIDATES[2], len(vertices)))
            sides = thin_sides(vertices, reference, candidates)
    start = GraphBalls(vertices, graph, initial, sides)
    balls, order, fits = _refined(start, normal_order, num_neighbors, progress, fit_degrees)
    edge = None
    if condition is not None or boundary is not None:
        edge = boundary_of_mesh(vertices, faces, balls.frames, normal_order)
    if boundary is not None:
        edge = _part(edge, boundary)
    low_order = None
    if areas is None:
        if faces.shape[1] == 2:
            low_order = CurveLowOrder(vertices, faces)
        elif faces.shape[1] == 3 and vertices.shape[1] <= 3:
            low_order = MeshLowOrder(vertices, faces)
        else:
            low_order = CloudLowOrder(balls, edge)
        of_mesh = isinstance(low_order, MeshLowOrder)
        areas = low_order.areas() if of_mesh else simplex_shares(vertices, faces)
    shape = _oriented(balls, reference, order, areas, low_order, edge, condition)
    return replace(shape, on_mesh=isinstance(low_order, MeshLowOrder), fits=fits)


def surface_shape(
    points: Float[Tensor, "N n"],
    surface: CloudSurface,
    normal_order: int,
    *,
    num_neighbors: int | None = None,
    normals: Float[Tensor, "N 3"] | None = None,
    boundary: Bool[Tensor, " N"] | None = None,
    condition: Condition | None = NEUMANN,
    fit_degrees: tuple[int, ...] = (),
    progress: bool = True,
) -> Shape:
    """A cloud in R² or R³ with a surface through it, whose triangles and normals it starts from.

    The boundary is that of the surface, but for points at local stars; or the mask `boundary`. Lone points are in no
    neighbourhood but their own.
    """
    flat = points.shape[1] == 2
    triangles = torch.cat([surface.faces, surface.stars])
    initial = mesh_frames(points, triangles) if flat else surface.frames
    sides = None if flat else thin_sides(points, surface.normals, surface.neighbors)
    graph = mesh_graph(triangles, len(points))
    if surface.lone.any():
        others = sparse.diags_array((~surface.lone).numpy().astype(graph.dtype))
        graph = sparse.csr_array(others @ graph @ others)
        graph.eliminate_zeros()
    start = GraphBalls(points, graph, initial, sides)
    balls, order, fits = _refined(start, normal_order, num_neighbors, progress, fit_degrees)
    edge = None
    if condition is not None:
        edge = boundary_of_mesh(points, surface.faces, balls.frames, normal_order)
        if edge is not None and len(surface.stars):
            edge = _part(edge, edge.mask & ~torch.isin(torch.arange(len(points)), surface.stars))
        found = torch.zeros(len(points), dtype=torch.bool) if edge is None else edge.mask
        if boundary is not None and not torch.equal(boundary, found):
            edge = boundary_of_cloud(points, boundary, balls.frames, normal_order)
    low_order = MeshLowOrder(points, triangles)
    reference = None if flat else surface.normals if normals is None else normals
    shape = _oriented(balls, reference, order, low_order.areas(), low_order, edge, condition)
    return replace(shape, fits=fits)


def _part(boundary: Boundary | None, mask: Bool[Tensor, " N"]) -> Boundary | None:
    """The boundary of a mesh where the mask is set; InputError if points of it lie inside."""
    astray = (mask if boundary is None else mask & ~boundary.mask).nonzero()[:, 0]
    if len(astray):
        raise InputError(
            f"boundary: expected points of the mesh's own boundary, got {len(astray)} inside ({first_few(astray)}); "
            "leave them out of the mask, or leave `boundary` out to take all of the boundary"
        )
    if boundary is None or not mask.any():
        return None
    return Boundary(mask, boundary.conormals * mask[:, None])


def _follow(sides: Tensor | None, frames: Tensor) -> Tensor | None:
    """The sides by the normals of the refined frames, where they were set."""
    if sides is None:
        return None
    return _turned(normals_of_frames(frames), sides) * (sides != 0).any(1, keepdim=True)


def _turned(normals: Tensor, reference: Tensor) -> Tensor:
    """The normals, on the side of `reference`."""
    return torch.where(((normals * reference).sum(1) < 0)[:, None], -normals, normals)


def _refined(
    balls: GraphBalls,
    degree: int,
    num_neighbors: int | None,
    progress: bool,
    fit_degrees: tuple[int, ...] = (),
) -> tuple[GraphBalls, Int[Tensor, " N"], VertexFits | None]:
    """The same neighbourhoods with frames of order q, in chunks; the initial ones if q = 0 or in a flat space.

    And fits of functions, if `fit_degrees` asks for some, with what the frames' fits say of the surface.
    """
    points, frames, refined = balls.points, balls.frames, balls
    surface_degree = 0 if frames.shape[1] == frames.shape[2] else degree
    fits = VertexFits(balls, fit_degrees, surface_degree) if fit_degrees else None
    order = torch.full((len(points),), degree)
    if surface_degree > 0:
        degrees = range(degree, 0, -1)
        candidates = list_candidates(frames.shape[-1], degrees, num_neighbors=num_neighbors)
        parts = torch.arange(len(points)).split(AT_ONCE)
        bar = tqdm(parts, "tangent frames", delay=2, disable=not progress, leave=False)
        found = [refine_frames(balls, centers, candidates, fits) for centers in bar]
        frames, order = (torch.cat(part) for part in zip(*found, strict=True))
        refined = balls.with_frames(frames, _follow(balls.sides, frames))
    return refined, order, None if fits is None else fits.complete()


def _oriented(
    balls: GraphBalls,
    reference: Tensor | None,
    order: Tensor,
    areas: Tensor,
    low_order: LowOrder | None,
    boundary: Boundary | None,
    condition: Condition | None,
) -> Shape:
    """Turn normals to the side of `reference`, and frames so that [frames, normal] is right-handed."""
    points, frames = balls.points, balls.frames
    normals = None
    if frames.shape[-1] == points.shape[1] - 1:
        righthanded = normals_of_frames(frames)
        normals = righthanded if reference is None else _turned(righthanded, reference)
        hand = (normals * righthanded).sum(1)[:, None, None].sign()
        frames = torch.cat([hand * frames[..., :1], frames[..., 1:]], -1)
    balls = balls.with_frames(frames, balls.sides)
    if condition is None:
        boundary, condition = None, Condition()
    return Shape(points, frames, normals, order, balls, areas, low_order, boundary, condition)
