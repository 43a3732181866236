"""The low-order peers: libigl's cotangent operator, and the rows that catch what no high-order stencil can hold.

This is the one place that talks to libigl and robust_laplacian. Both are turned into strong-form rows with the
analyst's sign: (Lf)_i ≈ Δf(x_i), L1 = 0, diagonal negative.
"""

from __future__ import annotations

from typing import cast

import igl
import numpy as np
import robust_laplacian
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

__all__ = ["cotangent_laplacian", "robust_rows"]

MOLLIFY = 1e-5
"""robust_laplacian's intrinsic mollification, relative to the mean edge: lets zero-area triangles in."""


def cotangent_laplacian(
    vertices: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"]
) -> tuple[sparse.csr_array, Float[Tensor, " N"]]:
    """libigl's cotangent matrix C (negative semidefinite, weak) and Voronoi mass, as (M⁻¹C, diagonal of M).

    Units: 1/ℓ² and ℓ². Raises ValueError if a vertex has no area.
    """
    points = np.ascontiguousarray(vertices.double().numpy())
    corners = np.ascontiguousarray(faces.numpy().astype(np.int64))
    weak = sparse.csr_array(igl.cotmatrix(points, corners))
    area = igl.massmatrix(points, corners, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    if (area <= 0).any():
        bad = np.flatnonzero(area <= 0)[:5].tolist()
        raise ValueError(
            f"cotangent operator: vertices {bad} have no area (all their triangles are degenerate); "
            "remove or merge them, or use LaplaceBeltrami.from_mesh, which accepts degenerate triangles"
        )
    strong = sparse.csr_array(sparse.diags_array(1 / area) @ weak)
    return strong, torch.from_numpy(area.copy())


def robust_rows(
    points: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"] | None
) -> tuple[sparse.csr_array, Float[Tensor, " N"]]:
    """Strong-form rows and areas of `robust_laplacian`, for a mesh (tufted cover) or a cloud in R² or R³.

    Off-diagonal entries are ≥ 0 and the diagonal is their negative sum: an M-matrix row, stable on its own. First
    order at best. Units: 1/ℓ² and ℓ².
    """
    space = np.zeros((len(points), 3))
    space[:, : points.shape[1]] = points.double().numpy()
    if faces is None:
        neighbors = min(30, len(points) - 1)
        weak, mass = robust_laplacian.point_cloud_laplacian(space, MOLLIFY, neighbors)
    else:
        corners = faces.numpy().astype(np.int64)
        weak, mass = robust_laplacian.mesh_laplacian(space, corners, MOLLIFY)
    area = cast(np.ndarray, mass.diagonal())
    # Degenerate triangles leave vertices with next to no area; a row must stay finite.
    area = np.maximum(area, 1e-12 * area.mean())
    off = sparse.coo_array(-weak)
    keep = (off.row != off.col) & (off.data > 0)
    weights = sparse.csr_array((off.data[keep], (off.row[keep], off.col[keep])), shape=off.shape)
    strong = weights - sparse.diags_array(weights.sum(axis=1))
    return sparse.csr_array(sparse.diags_array(1 / area) @ strong), torch.from_numpy(area)
