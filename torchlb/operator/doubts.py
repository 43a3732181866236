"""What may be wrong with the surface through a cloud: warnings that name the points, and what to do."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import sparse
from torch import Tensor

from torchlb.errors import first_few, warn
from torchlb.geometry.boundary import boundary_faces
from torchlb.geometry.surface import CloudSurface
from torchlb.geometry.vertex_fits import REASONS, VertexFits

DOUBTFUL = 0.1
"""Share of the points that do not resolve the surface of a cloud, or of the area that those without a fit hold, from
which on a warning names them."""
OUTLYING = 5.0
"""Times the spacing of its neighbours that an outlier, in no triangle of the surface, is away from all of them."""
TOUCHING = 0.005
"""Share of the points at which sheets of a cloud touch from which on a warning says where."""
LONG, WALL = 3.0, 0.03
"""Of an edge, over the usual ones of its ends; and of the area that triangles with such edges may be."""
ASTRAY = 0.02
"""Of the points of a declared boundary: how many may lie inside."""


def warn_of_doubts(surface: CloudSurface, fits: VertexFits, mass: Float[Tensor, " N"]) -> None:
    """Warnings that name points where a cloud does not resolve its surface, if they are many or hold much of it."""
    apart = ~torch.isin(torch.arange(len(surface.points)), surface.faces)
    doubtful = (fits.surface.reason == REASONS.index("points do not resolve the surface")) | apart
    flat = (fits.degree == 0) | apart
    large = float(mass[flat].sum() / mass.sum()) >= DOUBTFUL
    doubtful |= flat & large
    if large or float(doubtful.double().mean()) >= DOUBTFUL:
        index = doubtful.nonzero()[:, 0]
        warn(
            f"points: at {len(index)} of {len(doubtful)} the cloud is too coarse or noisy for the surface through it "
            f"to be trusted ({first_few(index)}); add points there, remove outliers, or give the mesh if there is one"
        )
    nearest = surface.neighbors[:, 1]
    gap = (surface.points[nearest] - surface.points).norm(dim=1)
    outlying = (apart & (gap > OUTLYING * gap[nearest])).nonzero()[:, 0]
    if len(outlying):
        warn(
            f"points: {len(outlying)} lie {OUTLYING:g} spacings and more away from all others "
            f"({first_few(outlying)}), joined to the surface by triangles that add to its area; remove them if they "
            "are outliers"
        )
    if surface.summary.contacts >= TOUCHING * len(doubtful):
        warn(
            f"points: {surface.summary.contact}; the surface may join what only touches there, or cut it. Add points "
            "there, or give the mesh if there is one"
        )


def warn_of_walls(surface: CloudSurface, boundary: Bool[Tensor, " N"] | None) -> None:
    """Warnings where triangles may close what is open: many long ones, or some around points of a declared boundary."""
    points, faces = surface.points, surface.faces
    sides = points[faces.roll(-1, 1)] - points[faces]
    length = sides.norm(dim=2)
    both, ends = length.flatten().repeat(2), torch.stack([faces, faces.roll(-1, 1)]).flatten()
    order = both.numpy().argsort()
    place = ends.numpy()[order], np.arange(len(order))
    edges = sparse.csr_array((both.numpy()[order], place), shape=(len(points), len(order)))
    middle = edges.indptr[:-1] + np.diff(edges.indptr) // 2
    usual = torch.from_numpy(np.append(edges.data, 0.0)[middle])
    long = (length > LONG * torch.maximum(usual[faces], usual[faces.roll(-1, 1)])).any(1)
    area = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1)
    share = float(area[long].sum() / area.sum())
    if share >= WALL:
        warn(
            f"points: triangles with an edge of more than {LONG:g} spacings are {share:.0%} of the surface "
            f"({first_few(faces[long].unique())}); where they wall up a gap between parts that belong apart, build "
            "each part by itself (LaplaceBeltrami.batch), or give the mesh"
        )
    if boundary is not None:
        rim = torch.zeros_like(boundary).index_fill(0, boundary_faces(faces).flatten(), True)
        inside = (boundary & ~rim & torch.isin(torch.arange(len(points)), faces)).nonzero()[:, 0]
        if len(inside) > ASTRAY * int(boundary.sum()):
            warn(
                f"boundary: {len(inside)} of its points ({first_few(inside)}) lie inside the surface through the "
                "cloud, as around a hole that was closed because it is hardly wider than the spacing; add points "
                "around it, or give the mesh"
            )
