"""libigl's cotangent operator as strong-form rows, analyst's sign: (Lf)_i ≈ Δf(x_i), L1 = 0, diagonal negative."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.errors import InputError, first_few
from torchlb.linalg.sparse import with_diagonal


def cotangent_laplacian(
    vertices: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"]
) -> tuple[sparse.csr_array, Float[Tensor, " N"]]:
    """(M⁻¹C, diagonal of M), with libigl's cotangent matrix C (negative semidefinite, weak) and Voronoi mass M.

    Units: 1/ℓ² and ℓ². Raises InputError if a vertex has no area, or a triangle around it.
    """
    import igl

    points = np.ascontiguousarray(vertices.double().numpy())
    corners = np.ascontiguousarray(faces.numpy().astype(np.int64))
    weak = sparse.csr_array(igl.cotmatrix(points, corners))
    area = igl.massmatrix(points, corners, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    usable = (area > 0) & np.isfinite(weak.sum(axis=1))  # False for NaN as well
    if not usable.all():
        bad = torch.from_numpy(np.flatnonzero(~usable))
        raise InputError(
            f"cotangent operator: {len(bad)} vertices ({first_few(bad)}) have no area, or are corners of triangles of "
            "none, whose cotangents are infinite; remove these triangles, or use LaplaceBeltrami.from_mesh, which "
            "accepts them"
        )
    strong = sparse.csr_array(sparse.diags_array(1 / area) @ weak)
    return with_diagonal(strong), torch.from_numpy(area.copy())
