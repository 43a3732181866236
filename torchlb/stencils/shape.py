"""Data of a shape for its stencils: points, frames, neighbourhoods, boundary, areas and low-order rows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor
from tqdm import tqdm

from torchlb.cloud.surface import CloudSurface
from torchlb.cloud.voronoi import boundary_of_cloud
from torchlb.errors import InputError, first_few
from torchlb.geometry.boundary import BoundaryPlan, boundary_of_mesh
from torchlb.geometry.compatibility import thin_sides
from torchlb.geometry.complex import consistently_wound
from torchlb.geometry.fit_search import FitSearch
from torchlb.geometry.frames import mesh_frames, normals_of_frames, vertex_normals
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.neighbors import GraphNeighborhoods, mesh_graph, nearest_neighbors
from torchlb.geometry.thresholds import NEAREST
from torchlb.linalg.precision import AT_ONCE
from torchlb.stencils.conditions import Condition, Neumann
from torchlb.stencils.low_order import MeshLowOrder
from torchlb.stencils.placed import Beside, Placed, ShapePlan, righthanded, turned

NEUMANN = Neumann()


@dataclass(frozen=True)
class Shape(Placed):
    """A shape ready for stencils.

    Attributes
    ----------
    normal_order
        (N,), degree q of the fit behind each frame; 0 for an initial frame.
    neighborhoods
        k-hop neighbourhoods; None where the rows are planned already.
    areas
        (N,), positive, shares of the area to first order, ℓ^d.
    low_order
        Rows for points without a stencil.
    condition
        Boundary condition.
    on_mesh
        Whether triangles are given, which follow the surface where its points do not resolve it.
    plan, fits
        Plan of the shape, and the fits evaluated from it; None for a cloud without simplices.
    """

    normal_order: Int[Tensor, " N"]
    neighborhoods: GraphNeighborhoods | None
    areas: Float[Tensor, " N"]
    low_order: MeshLowOrder
    condition: Condition
    on_mesh: bool = False
    plan: ShapePlan | None = None
    fits: LocalFits | None = None

    @property
    def held(self) -> Bool[Tensor, " N"] | None:
        """Points where the condition fixes zero values; None if there are none."""
        return self.boundary.mask if self.boundary is not None and self.condition.fixes else None


def mesh_shape(
    vertices: Float[Tensor, "N n"],
    faces: Int[Tensor, "F v"],
    normal_order: int,
    *,
    num_neighbors: int | None = None,
    boundary: Bool[Tensor, " N"] | None = None,
    condition: Condition | None = NEUMANN,
    fit_degrees: tuple[int, ...] = (),
    progress: bool = True,
    shares: Float[Tensor, " F"] | None = None,
    on_mesh: bool = True,
) -> Shape:
    """Shape of a mesh of segments, triangles or tetrahedra in Rⁿ, with graph and frames from its cells.

    `condition` holds on the boundary, or on the part of it in the mask `boundary`; None imposes nothing. `fit_degrees`
    requests `fits` of the first of these degrees that passes. Where faces overlap, `shares` weights each of them, and
    `boundary` alone marks where the shape ends. Triangles reconstructed from a cloud are not `on_mesh`.
    """
    sides = None
    hypersurface = faces.shape[1] == vertices.shape[1] and faces.shape[1] < 4
    if hypersurface and consistently_wound(faces):
        candidates = nearest_neighbors(vertices, min(NEAREST, len(vertices)))
        sides = thin_sides(vertices, vertex_normals(vertices, faces), candidates)
    neighborhoods = GraphNeighborhoods(
        vertices, mesh_graph(faces, len(vertices)), mesh_frames(vertices, faces), sides
    )
    plan, fits = _searched(neighborhoods, normal_order, num_neighbors, progress, fit_degrees)
    edge = None
    if shares is not None:
        dim = faces.shape[1] - 1
        if boundary is not None:
            edge = boundary_of_cloud(vertices, boundary, dim, normal_order)
    elif condition is not None or boundary is not None:
        edge = boundary_of_mesh(vertices, faces, normal_order)
        edge = edge if boundary is None else _part(edge, boundary)
    side = torch.ones(len(vertices), dtype=torch.int8) if hypersurface else None
    whole = ShapePlan(faces, shares, plan, None, side, None if condition is None else edge)
    on_mesh = on_mesh and faces.shape[1] == 3
    low_order = MeshLowOrder(vertices, faces, shares=shares)
    return _shape(whole, fits, neighborhoods, low_order, condition, on_mesh)


def surface_shape(
    given: Float[Tensor, "N n"],
    surface: CloudSurface,
    normal_order: int,
    *,
    num_neighbors: int | None = None,
    boundary: Bool[Tensor, " N"] | None = None,
    condition: Condition | None = NEUMANN,
    fit_degrees: tuple[int, ...] = (),
    progress: bool = True,
) -> Shape:
    """Shape of a cloud in R² or R³, from the triangles and normals of a surface through it.

    The boundary is that of the surface, except for points of local stars, or the mask `boundary`. Lone points belong to
    no neighbourhood but their own.
    """
    flat, points = given.shape[1] == 2, surface.points[:, : given.shape[1]]
    triangles = torch.cat([surface.cells, surface.stars])
    sides = None if flat else thin_sides(points, surface.normals, surface.neighbors)
    graph = mesh_graph(triangles, len(points))
    if surface.lone.any():
        others = sparse.diags_array((~surface.lone).numpy().astype(graph.dtype))
        graph = sparse.csr_array(others @ graph @ others)
        graph.eliminate_zeros()
    beside = Beside.of(given, surface.points, triangles, surface.neighbors[:, 1], surface.normals)
    points = beside.places(given, triangles)
    neighborhoods = GraphNeighborhoods(points, graph, beside.frames(points, triangles), sides)
    plan, fits = _searched(neighborhoods, normal_order, num_neighbors, progress, fit_degrees)
    edge = None
    if condition is not None:
        edge = boundary_of_mesh(points, surface.cells, normal_order)
        if edge is not None and len(surface.stars):
            edge = _part(edge, edge.mask & ~torch.isin(torch.arange(len(points)), surface.stars))
        found = torch.zeros(len(points), dtype=torch.bool) if edge is None else edge.mask
        if boundary is not None and not torch.equal(boundary, found):
            edge = boundary_of_cloud(points, boundary, 2, normal_order)
    side = None
    if not flat:
        _, own = righthanded(fits.frames, surface.normals)
        assert own is not None
        against = (own * vertex_normals(points, triangles)).sum(1) < 0
        side = torch.where(against, -1, 1).to(torch.int8)
    whole = ShapePlan(triangles, None, plan, beside, side, edge)
    return _shape(whole, fits, neighborhoods, MeshLowOrder(points, triangles), condition)


def _shape(
    plan: ShapePlan,
    fits: LocalFits,
    neighborhoods: GraphNeighborhoods,
    low_order: MeshLowOrder,
    condition: Condition | None,
    on_mesh: bool = False,
) -> Shape:
    """Shape of a plan at the points that it was made for, with the data that the search for stencils needs."""
    placed, sides = plan.placed(fits), neighborhoods.sides
    if sides is not None:  # by the normals of the refined frames
        marked = (sides != 0).any(1, keepdim=True)
        sides = turned(normals_of_frames(placed.frames), sides) * marked
    return Shape(
        **vars(placed),
        normal_order=plan.fits.order,
        neighborhoods=replace(neighborhoods, frames=placed.frames, sides=sides),
        areas=low_order.areas(),
        low_order=low_order,
        condition=Condition() if condition is None else condition,
        on_mesh=on_mesh,
        plan=plan,
        fits=fits,
    )


def _part(boundary: BoundaryPlan | None, mask: Bool[Tensor, " N"]) -> BoundaryPlan | None:
    """Boundary of a mesh, restricted to the mask; InputError if masked points lie inside."""
    astray = (mask if boundary is None else mask & ~boundary.mask).nonzero()[:, 0]
    if len(astray):
        raise InputError(
            f"boundary: expected points of the mesh's own boundary, got {len(astray)} inside ({first_few(astray)}); "
            "leave them out of the mask, or leave `boundary` out to take all of the boundary"
        )
    return None if boundary is None or not mask.any() else replace(boundary, mask=mask)


def _searched(
    neighborhoods: GraphNeighborhoods,
    degree: int,
    num_neighbors: int | None,
    progress: bool,
    fit_degrees: tuple[int, ...],
) -> tuple[FitPlan, LocalFits]:
    """Fit tangent planes of order q (initial ones if q = 0 or in a flat space), and functions."""
    flat = neighborhoods.dim == neighborhoods.points.shape[1]
    search = FitSearch(neighborhoods, 0 if flat else degree, fit_degrees, num_neighbors)
    if flat or degree == 0:
        search.order.fill_(degree)
    else:
        parts = torch.arange(len(neighborhoods.points)).split(AT_ONCE)
        for centers in tqdm(parts, "tangent frames", delay=2, disable=not progress, leave=False):
            search.refine(centers)
    return search.finish()
