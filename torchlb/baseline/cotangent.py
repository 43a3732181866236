"""libigl's cotangent operator as strong-form rows, analyst's sign: (Lf)_i ≈ Δf(x_i), L1 = 0, diagonal negative."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.errors import InputError
from torchlb.linalg.sparse import with_diagonal


def cotangent_laplacian(
    vertices: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"]
) -> tuple[sparse.csr_array, Float[Tensor, " N"]]:
    """libigl's cotangent matrix C (negative semidefinite, weak) and Voronoi mass, as (M⁻¹C, diagonal of M).

    Units: 1/ℓ² and ℓ². Raises ValueError if a vertex has no area.
    """
    import igl

    points = np.ascontiguousarray(vertices.double().numpy())
    corners = np.ascontiguousarray(faces.numpy().astype(np.int64))
    weak = sparse.csr_array(igl.cotmatrix(points, corners))
    area = igl.massmatrix(points, corners, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    usable = area > 0  # False for NaN as well
    if not usable.all():
        bad = np.flatnonzero(~usable)[:5].tolist()
        raise InputError(
            f"cotangent operator: vertices {bad} have no area (all their triangles are degenerate); "
            "remove or merge them, or use LaplaceBeltrami.from_mesh, which accepts degenerate triangles"
        )
    return with_diagonal(sparse.csr_array(sparse.diags_array(1 / area) @ weak)), torch.from_numpy(
        area.copy()
    )
