"""Data of a shape for its stencils, points, frames, neighbourhoods, boundary, areas, low-order rows; and their plan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize, pad
from tqdm import tqdm

from torchlb.cloud.surface import CloudSurface
from torchlb.cloud.voronoi import boundary_of_cloud
from torchlb.errors import InputError, first_few
from torchlb.geometry.boundary import Boundary, BoundaryPlan, boundary_of_mesh
from torchlb.geometry.compatibility import thin_sides
from torchlb.geometry.complex import consistently_wound
from torchlb.geometry.fit_search import FitSearch
from torchlb.geometry.frames import complete_frames, mesh_frames, normals_of_frames, vertex_normals
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.neighbors import GraphNeighborhoods, mesh_graph, nearest_neighbors, restricted
from torchlb.geometry.thresholds import NEAREST
from torchlb.geometry.vectors import Frames, Points, dot
from torchlb.linalg.precision import AT_ONCE, TINY
from torchlb.stencils.conditions import Condition
from torchlb.stencils.low_order import MeshLowOrder
from torchlb.stencils.options import Options


@dataclass(frozen=True)
class Placed:
    """Points, frames, normals, shape operators and boundary of a shape.

    [frames, normal] is right-handed where there is a normal, which hypersurfaces have, oriented by the cells, or
    consistently on a cloud. The shape operator, 1/ℓ, is the derivative of the normal along the frames, in the frames,
    zero where the tangent plane is of degree 0 or 1. There is no boundary of a closed shape, nor where no condition
    holds.
    """

    points: Points
    frames: Frames
    normals: Points | None
    shape_operators: Float[Tensor, "N d d"] | None
    boundary: Boundary | None


@dataclass(frozen=True)
class ShapePlan:
    """Plan of a shape of simplices.

    The planes of the `cells` give the initial frames; `shares` are the fractions of them that are integrated, None for
    all. `fits` plans the fits of heights, and of functions where a weak pair is built; `beside` has the data of the
    surface through a cloud, None where points stay as given and frames start from the cells; `side` is the sign of each
    normal along that of the cells around the vertex, None for shapes without sides; `boundary` is as in `Placed`.
    """

    cells: Int[Tensor, "F corners"]
    shares: Float[Tensor, " F"] | None
    fits: FitPlan
    beside: Beside | None
    side: Int[Tensor, " N"] | None
    boundary: BoundaryPlan | None

    def at(self, points: Points) -> tuple[Placed, LocalFits]:
        """Frames, normals, shape operators and boundary at these points, and the fits behind them."""
        if self.beside is None:
            places, initial = points, mesh_frames(points, self.cells)
        else:
            places = self.beside.places(points, self.cells)
            initial = self.beside.frames(places, self.cells)
        fits = LocalFits.at(self.fits, places, initial)
        return self.placed(fits), fits

    def placed(self, fits: LocalFits) -> Placed:
        """Frames, normals, shape operators and boundary from given fits."""
        reference = bending = None
        if self.side is not None:
            reference = self.side[:, None] * vertex_normals(fits.points, self.cells)
        frames, normals = righthanded(fits.frames, reference)
        if normals is not None:
            along = fits.initial.mT @ frames
            bending = along.mT @ -(fits.second @ normals[:, None, :, None])[..., 0] @ along
        boundary = None if self.boundary is None else self.boundary.at(fits.points, frames)
        return Placed(fits.points, frames, normals, bending, boundary)


class Beside(NamedTuple):
    """Normals and displacements of a cloud's surface, relative to its triangles and so without a unit.

    Components are along the normal of the triangles, the tangent towards `neighbor`, and their cross product: those of
    the initial `normals`, and of the `offsets` of the points that were `moved`, as they are noisy or off the surface,
    relative to the distance to the neighbour.
    """

    neighbor: Int[Tensor, " N"]
    normals: Float[Tensor, "N 3"]
    moved: Int[Tensor, " m"]
    offsets: Float[Tensor, "m 3"]

    @classmethod
    def of(
        cls,
        given: Points,
        places: Float[Tensor, "N 3"],
        triangles: Int[Tensor, "F 3"],
        nearest: Int[Tensor, " N"],
        normals: Float[Tensor, "N 3"],
    ) -> Beside:
        """Encode the surface positions `places` of the given points, and the normals there."""
        neighbor = nearest.clone()
        neighbor[triangles.flatten()] = triangles.roll(1, 1).flatten()
        given = pad(given, (0, 3 - given.shape[1]))
        moved = (places != given).any(1).nonzero()[:, 0]
        axes, size = _axes(given, triangles, neighbor)
        offset = (places - given)[moved] / size[moved, None]
        axes, offsets = _axes(places, triangles, neighbor)[0], (axes[moved] @ offset[..., None])
        return cls(neighbor, (axes @ normals[..., None])[..., 0], moved, offsets[..., 0])

    def places(self, points: Points, triangles: Int[Tensor, "F 3"]) -> Points:
        """Positions on the surface for given points."""
        if len(self.moved) == 0:
            return points
        space = pad(points, (0, 3 - points.shape[1]))
        axes, size = _axes(space, triangles, self.neighbor)
        offset = (self.offsets[:, None] @ axes[self.moved])[:, 0] * size[self.moved, None]
        return space.index_add(0, self.moved, offset)[:, : points.shape[1]]

    def frames(self, places: Points, triangles: Int[Tensor, "F 3"]) -> Float[Tensor, "N n 2"]:
        """Initial frames, orthogonal to the initial normals in R³."""
        if places.shape[1] == 2:
            return mesh_frames(places, triangles)
        axes, _ = _axes(places, triangles, self.neighbor)
        normal = normalize((self.normals[:, None] @ axes)[:, 0])
        first = normalize(axes[:, 1] - dot(axes[:, 1], normal)[:, None] * normal)
        return torch.stack([first, torch.linalg.cross(normal, first)], -1)


def _axes(
    points: Float[Tensor, "N 3"], triangles: Int[Tensor, "F 3"], neighbor: Int[Tensor, " N"]
) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, " N"]]:
    """Normal of the triangles around each point, two tangents, the first towards its neighbour, and the distance to it.

    Where a direction is undefined, it is arbitrary.
    """
    normal = vertex_normals(points, triangles)
    normal = torch.where((normal == 0).all(1, keepdim=True), normal.new_tensor([0.0, 0, 1]), normal)
    edge = points[neighbor] - points
    along = edge - dot(edge, normal)[:, None] * normal
    flat = dot(along, along)[:, None] == 0
    along = normalize(torch.where(flat, complete_frames(normal)[..., 0], along), eps=TINY)
    return torch.stack([normal, along, torch.linalg.cross(normal, along)], 1), edge.norm(dim=1)


@dataclass(frozen=True)
class Shape(Placed):
    """A shape ready for stencils.

    `neighborhoods`, `plan` and `fits` are None where the rows are planned already. `on_mesh` says whether triangles are
    given, which follow the surface where its points do not resolve it.
    """

    neighborhoods: GraphNeighborhoods | None
    low_order: MeshLowOrder
    condition: Condition
    on_mesh: bool = False
    plan: ShapePlan | None = None
    fits: LocalFits | None = None
    mass: Float[Tensor, " N"] | None = None

    @cached_property
    def areas(self) -> Float[Tensor, " N"]:
        """Positive shares of the area, ℓ^d: the mass where it is known, else to first order."""
        return self.low_order.areas() if self.mass is None else self.mass

    @property
    def held(self) -> Bool[Tensor, " N"] | None:
        """Points where the condition fixes zero values; None if there are none."""
        return self.boundary.mask if self.boundary is not None and self.condition.fixes else None


def mesh_shape(
    vertices: Points,
    faces: Int[Tensor, "F v"],
    options: Options,
    *,
    boundary: Bool[Tensor, " N"] | None = None,
    progress: bool = True,
    shares: Float[Tensor, " F"] | None = None,
    on_mesh: bool = True,
) -> Shape:
    """Shape of a mesh of segments, triangles or tetrahedra in Rⁿ, with graph and frames from its cells.

    A condition holds on the boundary, or on the part of it in the mask `boundary`. Where faces overlap, `shares`
    weights each of them, and `boundary` alone marks where the shape ends. Triangles through a cloud are not `on_mesh`.
    """
    sides, degree = None, options.q
    if faces.shape[1] == vertices.shape[1] < 4 and consistently_wound(faces):
        candidates = nearest_neighbors(vertices, min(NEAREST, len(vertices)))
        sides = thin_sides(vertices, vertex_normals(vertices, faces), candidates)
    graph = mesh_graph(faces, len(vertices))
    if faces.shape[1] == 2:  # derivatives jump where three and more curves meet
        uses = torch.bincount(faces.flatten(), minlength=len(vertices))
        graph = restricted(graph, uses.numpy() < 3)
    neighborhoods = GraphNeighborhoods(vertices, graph, mesh_frames(vertices, faces), sides)
    edge = None
    if shares is not None and boundary is not None:
        edge = boundary_of_cloud(vertices, boundary, faces.shape[1] - 1, degree)
    elif shares is None and (options.held is not None or boundary is not None):
        edge = boundary_of_mesh(vertices, faces, degree)
        edge = edge if boundary is None else _part(edge, boundary)
    on_mesh = on_mesh and faces.shape[1] == 3
    return _shape(neighborhoods, faces, edge, options, progress, shares=shares, on_mesh=on_mesh)


def surface_shape(
    given: Points,
    surface: CloudSurface,
    options: Options,
    *,
    boundary: Bool[Tensor, " N"] | None = None,
    progress: bool = True,
) -> Shape:
    """Shape of a cloud in R² or R³, from the triangles and normals of a surface through it.

    The boundary is that of the surface, except for points of local stars, or the mask `boundary`. Lone points belong to
    no neighbourhood but their own.
    """
    points, degree = surface.points[:, : given.shape[1]], options.q
    triangles = torch.cat([surface.cells, surface.stars])
    normals = None if given.shape[1] == 2 else surface.normals
    sides = None if normals is None else thin_sides(points, normals, surface.neighbors)
    graph = mesh_graph(triangles, len(points))
    if surface.lone.any():
        others = ~surface.lone.numpy()
        graph = restricted(graph, others, others)
    beside = Beside.of(given, surface.points, triangles, surface.neighbors[:, 1], surface.normals)
    points = beside.places(given, triangles)
    neighborhoods = GraphNeighborhoods(points, graph, beside.frames(points, triangles), sides)
    edge = None
    if options.held is not None:
        edge = boundary_of_mesh(points, surface.cells, degree)
        if edge is not None and len(surface.stars):
            edge = _part(edge, edge.mask & ~torch.isin(torch.arange(len(points)), surface.stars))
        found = torch.zeros(len(points), dtype=torch.bool) if edge is None else edge.mask
        if boundary is not None and not torch.equal(boundary, found):
            edge = boundary_of_cloud(points, boundary, 2, degree)
    return _shape(neighborhoods, triangles, edge, options, progress, beside=beside, normals=normals)


def _shape(
    neighborhoods: GraphNeighborhoods,
    cells: Int[Tensor, "F corners"],
    edge: BoundaryPlan | None,
    options: Options,
    progress: bool,
    *,
    shares: Float[Tensor, " F"] | None = None,
    beside: Beside | None = None,
    normals: Points | None = None,
    on_mesh: bool = False,
) -> Shape:
    """Shape with fitted tangent planes, of order q (initial ones if q = 0 or in a flat space), and functions.

    Normals are on the side of the given ones, or of the cells. It has the data that the search for stencils needs.
    """
    points, dim, sides = neighborhoods.points, neighborhoods.dim, neighborhoods.sides
    degree = 0 if dim == points.shape[1] else options.q
    rest = options.elements[1], options.num_neighbors
    search = FitSearch(neighborhoods, degree, *rest, on_mesh=on_mesh)
    if degree == 0:
        search.order.fill_(options.q)
    else:
        parts = torch.arange(len(points)).split(AT_ONCE)
        for centers in tqdm(parts, "tangent frames", delay=2, disable=not progress, leave=False):
            search.refine(centers)
    fit_plan, fits = search.finish()
    side = None
    if dim == points.shape[1] - 1 < 3:
        side = torch.ones(len(points), dtype=torch.int8)
        if normals is not None:
            _, own = righthanded(fits.frames, normals)
            assert own is not None
            side[(own * vertex_normals(points, cells)).sum(1) < 0] = -1
    held = options.held
    plan = ShapePlan(cells, shares, fit_plan, beside, side, None if held is None else edge)
    placed = plan.placed(fits)
    if sides is not None:  # by the normals of the refined frames
        marked = (sides != 0).any(1, keepdim=True)
        sides = turned(normals_of_frames(placed.frames), sides) * marked
    low_order = MeshLowOrder(placed.points, cells, shares=shares)
    return Shape(
        **vars(placed),
        neighborhoods=replace(neighborhoods, frames=placed.frames, sides=sides),
        low_order=low_order,
        condition=Condition() if held is None else held,
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


def turned(normals: Tensor, reference: Tensor) -> Tensor:
    """Flip the normals to the side of `reference`."""
    return torch.where(((normals * reference).sum(1) < 0)[:, None], -normals, normals)


def righthanded(frames: Frames, reference: Points | None) -> tuple[Frames, Points | None]:
    """Frames with [frames, normal] right-handed, and normals of a hypersurface on the side of `reference`."""
    if frames.shape[2] != frames.shape[1] - 1:
        return frames, None
    righthanded = normals_of_frames(frames)
    normals = righthanded if reference is None else turned(righthanded, reference)
    hand = (normals * righthanded).sum(1)[:, None, None].sign()
    return torch.cat([hand * frames[..., :1], frames[..., 1:]], -1), normals
