"""The operator in the signs, factors and masses of other libraries; tabulated in `docs/conventions.md`.

Most libraries give a weak matrix C and a mass M, with M⁻¹C the operator; half of them give −C. torchlb's matrix is
strong: Δ = M⁻¹C, M the diagonal of `lb.mass`.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.errors import InputError
from torchlb.linalg.checks import check_choice, check_operator
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

__all__ = ["SIGNS", "edge_weights", "weak_matrices"]

Convention = Literal["igl", "potpourri3d", "robust_laplacian", "lapy", "diffusion_net"]
SIGNS = {"igl": 1, "potpourri3d": -1, "robust_laplacian": -1, "lapy": -1, "diffusion_net": -1}
"""Sign of the weak matrix: +1 if it is negative semidefinite like Δ, −1 if positive."""


def weak_matrices(
    lb: LaplaceBeltrami, convention: Convention
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Weak matrix C and diagonal mass M, both (N, N), with the sign of a library: M⁻¹C = ±Δ.

    For the cotangent operator C is that library's, entry by entry, on a mesh without boundary trouble or degenerate
    triangles, that of robust_laplacian, which flips edges, on a Delaunay mesh; M is Voronoi, as igl has it by default.
    For the stencil C is not symmetric; with certify=True its columns sum to zero like its rows, and its symmetric part
    is semidefinite. Methods that need symmetry (Cholesky, eigsh) take the weak pair, `lb.stiffness`.

    Parameters
    ----------
    lb, convention
        Operator, and "igl" (C ≤ 0), or "potpourri3d", "robust_laplacian", "lapy", "diffusion_net" (C ≥ 0), else an
        InputError.

    Examples
    --------
    >>> import igl
    >>> from torchlb.surfaces import Sphere
    >>> vertices, faces = Sphere().mesh(100)
    >>> C, M = weak_matrices(LaplaceBeltrami.from_cotangent(vertices, faces), "igl")
    >>> bool(abs(C - igl.cotmatrix(vertices.numpy(), faces.numpy())).max() < 1e-12)
    True
    """
    check_operator(lb)
    check_choice("convention", convention, Convention)
    mass = sparse.csr_array(sparse.diags_array(lb.mass.detach().cpu().numpy()))
    return SIGNS[convention] * sparse.csr_array(mass @ lb.to_scipy()), mass


def edge_weights(
    lb: LaplaceBeltrami, normalization: Literal["rw"] | None = None
) -> tuple[Int[Tensor, "2 nnz"], Float[Tensor, " nnz"]]:
    """`edge_index, edge_weight` as PyG's `get_mesh_laplacian(pos, face, normalization)` gives them, diagonal included.

    Entry e of the operator is in row `edge_index[0, e]` and column `edge_index[1, e]`. Negative semidefinite.

    Parameters
    ----------
    lb, normalization
        Operator, and None for the weak matrix, "rw" for the strong one, Δ itself, else an InputError. PyG's "sym"
        presumes a symmetric weak matrix, which the stencil does not have.
    """
    check_operator(lb)
    if normalization not in (None, "rw"):
        raise InputError(f"normalization: expected None or 'rw', got {normalization!r}")
    row, values = lb.stencil.row, lb.stencil.values[0]
    values = values if normalization == "rw" else lb.mass[row] * values
    return torch.stack([row, lb.stencil.col]), values
