"""robust_laplacian's rows: the low-order operator that takes any triangle mesh (Sharp, Crane 2020)."""

from __future__ import annotations

from typing import cast

import numpy as np
import robust_laplacian
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb.errors import first_few, warn
from torchlb.geometry.neighbors import mesh_graph
from torchlb.linalg.sparse import with_diagonal

LEAST_AREA = 1e-12
MOLLIFY = 1e-5
"""robust_laplacian's intrinsic mollification, relative to the mean edge: lets zero-area triangles in."""


SCALES = 1024.0
"""Parts of a mesh with mean edges this many times apart are of two scales; a power of two rounds nothing."""


def robust_rows(
    points: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"]
) -> tuple[sparse.csr_array, Float[Tensor, " N"]]:
    """Strong-form rows and areas of `robust_laplacian`: the tufted cover of any triangle mesh in R³.

    Off-diagonal entries are ≥ 0 and the diagonal is their negative sum: an M-matrix row, stable on its own. First
    order at best. Units: 1/ℓ² and ℓ². Points in R² are lifted.
    """
    space = np.zeros((len(points), 3))
    space[:, : points.shape[1]] = points.numpy()
    unit = _units(space, mesh_graph(faces, len(space)))
    weak, mass = robust_laplacian.mesh_laplacian(space / unit[:, None], faces.numpy(), MOLLIFY)
    area = cast(np.ndarray, mass.diagonal())
    least = LEAST_AREA * area.mean()
    tiny = np.flatnonzero(area < least)
    if len(tiny):
        warn(
            f"{len(tiny)} points ({first_few(tiny)}) have next to no "
            f"area, their triangles are degenerate; {LEAST_AREA:g} of the mean is taken, so that rows stay finite"
        )
    area = np.maximum(area, least) * unit**2
    off = sparse.coo_array(-weak)
    row, col = off.coords
    keep = (row != col) & (off.data > 0)
    weights = sparse.csr_array((off.data[keep], (row[keep], col[keep])), shape=off.shape)
    strong = weights - sparse.diags_array(weights.sum(axis=1))
    return with_diagonal(sparse.csr_array(sparse.diags_array(1 / area) @ strong)), torch.from_numpy(
        area
    )


def _units(points: np.ndarray, graph: sparse.csr_array) -> np.ndarray:
    """Of each vertex, the power of `SCALES` nearest to how many times its component's mean edge is that of the mesh.

    Mollification and the least area are relative to the mean edge, which says nothing of a part of another scale.
    """
    _, component = csgraph.connected_components(graph, directed=False)
    tail, head = sparse.coo_array(graph).coords
    length = np.linalg.norm(points[tail] - points[head], axis=1)
    total, count = np.bincount(component[tail], length), np.bincount(component[tail])
    longer = total / np.maximum(count, 1) / max(length.mean(), np.finfo(float).tiny)
    power = np.log(np.where(longer > 0, longer, 1.0)) / np.log(SCALES)
    return SCALES ** np.round(power)[component]
