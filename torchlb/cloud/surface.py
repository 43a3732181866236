"""A triangulated surface through a cloud of points in R³ (`method.md`, section 12)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.cloud.cocone import REACH, Candidates, Cloud, Tetrahedra, best_manifold
from torchlb.cloud.complexes import Complex, Places, in_words, places_of
from torchlb.cloud.frames import cloud_frames, refined_normals, settled_normals
from torchlb.cloud.gaps import Pairs, at_gaps, closed, filled, stars_in_gaps, with_left_points
from torchlb.cloud.manifold import boundary_loops, facing_out, with_single_fans, wound_alike
from torchlb.cloud.noise import denoised, lone_points, put_beside
from torchlb.cloud.poles import Poles, corrected_normals
from torchlb.errors import InputError
from torchlb.geometry.compatibility import mutually_compatible
from torchlb.geometry.complex import Faces, components, delaunay, pieces_of
from torchlb.geometry.frames import vertex_normals
from torchlb.geometry.neighbors import mesh_graph, nearest_neighbors
from torchlb.geometry.thresholds import LEVEL, NEAREST, RING
from torchlb.geometry.vectors import Mask, Near, Nearest, Points, Vectors, lengths
from torchlb.linalg.precision import LOW, NEGLIGIBLE, ROOT_EPS


@dataclass(frozen=True)
class SurfaceSummary:
    """Figures of the surface through a cloud.

    Attributes
    ----------
    points, reached, stars
        Number of points, of points in faces of the surface, and of triangles in local stars, which reach the others.
    holes_closed, boundary_loops
        Numbers of boundary loops taken for gaps and closed, and of those left.
    components, noise
        Number of components; root mean square distance of the points from the surface, ℓ, 0 if no noise is seen.
    contacts, places
        Number of points nearest to one of another sheet, more than three edges away, where shapes touch or are too thin
        for their points and the sheets are a guess; up to eight places where most of these are, ℓ.
    lone
        Number of points in mid-air, as scanners leave them, which are put beside others for all that is computed.
    """

    points: int
    reached: int
    stars: int
    holes_closed: int
    boundary_loops: int
    components: int
    noise: float
    contacts: int = 0
    places: Places = ()
    lone: int = 0

    @classmethod
    def of(cls, entries: dict[str, Any]) -> SurfaceSummary:
        """Inverse of `dataclasses.asdict`, also after a round trip through JSON."""
        places: Any = tuple(map(tuple, entries.get("places", ())))
        return cls(**entries | {"places": places})

    def __str__(self) -> str:
        """Summary of two lines, or three."""
        noise = f"; noise of {self.noise:.2g} smoothed" if self.noise else ""
        noise += f"; lone points: {self.lone}" if self.lone else ""
        text = (
            f"surface through the cloud: {self.reached} of {self.points} points, {self.stars} triangles of local stars"
            f"{noise}\n  {self.components} components, {self.boundary_loops} boundary loops, {self.holes_closed} gaps "
            "closed"
        )
        if not self.contacts:
            return text
        where = in_words(self.places)
        return f"{text}\n  {self.contacts} points are nearest to one of another sheet, most of them near {where}"


@dataclass(frozen=True, kw_only=True)
class CloudSurface(Complex):
    """Triangles through a cloud, of one sheet: at most two at an edge, all wound to face outward.

    Attributes
    ----------
    stars
        (S, 3), local triangles in its gaps, each counted by a third.
    normals
        (N, 3), unit, on the side of the faces; they turn with the points.
    neighbors
        (N, K), nearest points, itself first.
    lone
        (N,), points in mid-air, moved beside others, and no neighbours of points on the surface.
    summary
        Figures of the reconstruction.
    """

    stars: Int[Tensor, "S 3"]
    normals: Float[Tensor, "N 3"]
    neighbors: Int[Tensor, "N K"]
    lone: Bool[Tensor, " N"]
    summary: SurfaceSummary


def cloud_surface(
    points: Points, *, normals: Points | None = None, boundary: Bool[Tensor, " N"] | None = None
) -> CloudSurface:
    """The surface through all points, as far as they resolve one.

    `normals` tell the outward side where most of them agree; `boundary` marks points of a true boundary.
    """
    spread = torch.linalg.svdvals(points - points.mean(0))
    if spread[1] <= ROOT_EPS * spread[0]:
        raise InputError(
            f"points: all {len(points)} lie on a line, and no surface goes through them; a curve has dim=1"
        )
    candidates, oriented = nearest_neighbors(points, min(NEAREST, len(points))), False
    if normals is not None:
        normals, oriented = settled_normals(points, normals, candidates)
    cloud, found, two_sided, noise, lone = _start(points, candidates, normals, boundary)
    places, pairs, count = cloud.points, _neighbor_graph(cloud), len(points)
    outward = normals.numpy() if normals is not None and oriented else found.outward
    every, seam = wound_alike(places, _chosen(cloud, found, two_sided, pairs))
    faces = with_single_fans(every[~seam], count) if seam.any() else every
    faces, done = _completed(cloud, faces, found.small, pairs, outward)
    if _single_seams(every, seam, count) and wound_alike(places, faces)[1].any():
        faces, done = _completed(cloud, every, found.small, pairs, outward)
    # not by the faces, which may lead into a mouth from outside
    cloud = _along(_along(cloud, _of_faces(cloud, faces)), outward)
    if normals is None:
        cloud = _realigned(cloud, faces)
    stars = stars_in_gaps(cloud, faces, pairs)
    if len(faces) == 0:
        raise InputError(
            f"points: no surface goes through the {count}, as through those of a curve, which has dim=1"
        )
    loops = boundary_loops(faces, count)
    pieces = pieces_of(np.concatenate([faces, stars]), count)
    figures = len(np.unique(faces)), len(stars), done, len(loops), int(pieces.max()) + 1
    touched = _contacts(cloud, faces)
    contacts = int(touched.sum()), places_of(places, cloud.neighbors, touched)
    summary = SurfaceSummary(count, *figures, noise, *contacts, int(lone.sum()))
    parts = {"points": places, "cells": faces, "stars": stars, "normals": cloud.normals}
    parts |= {"neighbors": cloud.neighbors, "lone": lone}
    tensors: Any = {name: torch.from_numpy(part) for name, part in parts.items()}
    return CloudSurface(**tensors, summary=summary)


def _start(
    points: Points, candidates: Near, given: Points | None, boundary: Bool[Tensor, " N"] | None
) -> tuple[Cloud, Candidates, bool, float, Mask]:
    """(denoised cloud; candidates among Delaunay triangles; whether these have two sides; noise; lone points).

    The normals are those given, that of the plane for planar points, or estimated.
    """
    lone = lone_points(points.numpy(), candidates.numpy())
    if lone.any():
        points = torch.from_numpy(put_beside(points.numpy(), lone))
        candidates = nearest_neighbors(points, candidates.shape[1])
    near = candidates.numpy()
    on_boundary = np.zeros(len(points), dtype=bool) if boundary is None else boundary.numpy()

    def cloud_of(points: Tensor, normals: Tensor) -> Cloud:
        reach = _reaches(points.numpy(), near)
        return Cloud(points.numpy(), normals.numpy(), near, reach, on_boundary)

    normals, centered = given, (points - points.mean(0)).numpy()
    _, spread, axes = np.linalg.svd(centered, full_matrices=False)
    if spread[2] <= NEGLIGIBLE * spread[0]:
        up = torch.from_numpy(axes[2] if axes[2, 2] >= 0 else -axes[2]).expand_as(points)
        cloud = cloud_of(points, up if given is None else given)
        small = cloud.small(delaunay(centered @ axes[:2].T).simplices.astype(np.int64))
        every = np.ones(len(small), dtype=bool)
        found = Candidates(small, small, every, every, up.numpy())
        return cloud, found, True, 0.0, lone
    if normals is None:
        frames = cloud_frames(points, candidates, 2, rounds=1)
        first = torch.linalg.cross(*frames.unbind(-1))
        normals = refined_normals(points, first, candidates, rounds=2)
    points, noise = denoised(points, normals, candidates)
    if noise and given is None:
        normals = refined_normals(points, normals, candidates, rounds=2)
    places = points.numpy()
    nearest = lengths(places[near[:, 1]] - places)
    tetrahedra = Tetrahedra.of(places, normals.numpy(), nearest)
    poles = Poles.of(tetrahedra)
    if given is None:
        normals = corrected_normals(points, normals, candidates, poles)
    side, two_sided = poles.sides(normals)
    cloud = cloud_of(points, normals)
    return cloud, tetrahedra.candidates(cloud, side), two_sided, noise, lone


def _reaches(points: Vectors, near: Nearest) -> Float[np.ndarray, " N"]:
    """Largest circumradius of a triangle at each point, by the `RING` nearest; by all neighbours if these are in a row.

    Rings of a scan may be many times farther apart than the points along them.
    """
    few = near[:, : RING + 1]
    offset = points[few] - points[few].mean(1, keepdims=True)
    length = np.linalg.eigvalsh(offset.transpose(0, 2, 1) @ offset)
    in_row = length[:, 1] < LOW**2 * length[:, 2]
    far = np.where(in_row, near[:, -1], few[:, -1])
    return REACH * np.linalg.norm(points[far] - points, axis=1)


def _chosen(cloud: Cloud, found: Candidates, two_sided: bool, pairs: Pairs) -> Faces:
    """Choose faces with single fans, first those that part the outside from the inside if there are two sides.

    Tangent faces come first where a cavity would be cut off from points that belong to it, as where lips touch.
    """
    points, (i, j) = cloud.points, pairs

    def best_of(first: Bool[np.ndarray, " F"]) -> Faces:
        return best_manifold(points, found.triangles[np.argsort(~first, kind="stable")])

    first = found.parting if two_sided else found.tangent
    faces = with_single_fans(best_of(first), len(points))
    piece = pieces_of(faces, len(points))
    across = piece[i] != piece[j]
    if not across.any():
        return faces
    centers = np.stack([np.bincount(piece, x) for x in points.T], 1) / np.bincount(piece)[:, None]
    volume = np.bincount(piece, ((points - centers[piece]) * found.outward).sum(1))
    cavity = (volume < 0)[piece]
    across &= cavity[i] | cavity[j]
    torn = np.isin(np.arange(len(points)), [i[across], j[across]])
    first = np.where(torn[found.triangles].any(1), found.tangent, first)
    return with_single_fans(best_of(first), len(points)) if torn.any() else faces


def _completed(
    cloud: Cloud, bare: Faces, pool: Faces, pairs: Pairs, outward: Vectors
) -> tuple[Faces, int]:
    """(faces turned outward, with gaps filled from the pool or closed, and all points; number of loops closed)."""
    places, count = cloud.points, len(cloud.points)
    bare = facing_out(places, bare, outward)
    cloud = _along(cloud, _of_faces(cloud, bare))
    faces = _without_gaps(cloud, bare, pool)
    # the loop of a point with a neighbour in another component is no hole
    within = np.isin(pairs, faces).all(0)
    kept = at_gaps(faces, (pairs[0][within], pairs[1][within]), count)
    faces, done = closed(cloud, faces, kept)
    faces = with_left_points(cloud, faces)
    if faces is not bare:
        faces = facing_out(places, wound_alike(places, faces)[0], outward)
    return faces, done


def _single_seams(faces: Faces, seam: Bool[np.ndarray, " F"], count: int) -> bool:
    """Whether each component with a seam has one only, as a one-sided band; wrong triangles make several."""
    ends = faces[seam][:, 0]
    seams, pieces = (np.unique(pieces_of(part, count)[ends]) for part in (faces[seam], faces))
    return len(seams) == len(pieces) > 0


def _without_gaps(cloud: Cloud, faces: Faces, pool: Faces) -> Faces:
    """Faces with all that fits into their gaps, pruned to single fans; they themselves if nothing fits."""
    count, more = len(cloud.points), faces
    for oriented in (True, False):  # a one-sided surface is closed in the second round
        more = filled(cloud, more, pool, oriented=oriented, strict=True)
    faces = faces if more is faces else with_single_fans(more, count)
    more = filled(cloud, faces, pool, oriented=True, strict=False)
    return faces if more is faces else with_single_fans(more, count)


def _of_faces(cloud: Cloud, faces: Faces) -> Vectors:
    """Unit normals of the faces at every point, zero where there are none."""
    return vertex_normals(torch.from_numpy(cloud.points), torch.from_numpy(faces)).numpy()


def _along(cloud: Cloud, vectors: Vectors) -> Cloud:
    """Cloud with its normals on the side of the vectors, where these have one."""
    away = (cloud.normals * vectors).sum(1) < 0
    return replace(cloud, normals=np.where(away[:, None], -cloud.normals, cloud.normals))


def _realigned(cloud: Cloud, faces: Faces) -> Cloud:
    """Cloud with normals realigned to those of its faces where they are misaligned, on their previous side."""
    of_faces = _of_faces(cloud, faces)
    cosine = (cloud.normals * of_faces).sum(1)
    misaligned = (np.abs(cosine) < LEVEL) & of_faces.any(1)
    realigned = replace(cloud, normals=np.where(misaligned[:, None], of_faces, cloud.normals))
    return _along(realigned, cloud.normals)


def _contacts(cloud: Cloud, faces: Faces) -> Mask:
    """Points whose nearest one is more than three edges away, and these nearest ones."""
    count = len(cloud.points)
    graph = sparse.csr_array(mesh_graph(torch.from_numpy(faces), count) + sparse.eye_array(count))
    nearest = cloud.neighbors[:, 1]
    apart = np.flatnonzero(graph[np.arange(count), nearest] == 0)
    beyond = sparse.csr_array(graph[nearest[apart]] @ graph)
    # a path of three edges: two from the nearest, one from the point
    met = (beyond * graph[apart]).sum(1)
    far = apart[met == 0]
    return np.isin(np.arange(count), [far, nearest[far]])


def _neighbor_graph(cloud: Cloud) -> Pairs:
    """Edges of the graph of the `RING` nearest compatible neighbours, or of all nearest ones in small components."""
    points, normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)
    i, j, good = mutually_compatible(points, normals, torch.from_numpy(cloud.neighbors))
    near = (good & (good.cumsum(1) <= RING)).view(-1).numpy()
    i, j = i.numpy(), j.numpy()
    piece = components(i[near], j[near], len(points))
    lone = (np.bincount(piece) < NEAREST)[piece]
    near |= (lone[:, None] & (np.arange(good.shape[1]) < RING)).ravel()
    return i[near], j[near]
