"""Methods of an operator by its weak pair: spectrum, and the matrices behind diffusion and solves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, get_args

import torch
from scipy import sparse
from torch import Tensor

from torchlb.errors import InputError
from torchlb.linalg.checks import check_choice, check_rows, takes_arrays
from torchlb.linalg.csr import Csr
from torchlb.linalg.sparse import csr_tensor, to_scipy
from torchlb.linalg.threads import threads_for
from torchlb.operator.batching import shapes_of
from torchlb.operator.checks import check_tolerance
from torchlb.operator.medium import elements_of
from torchlb.operator.storage import OperatorStorage
from torchlb.operator.through import BEYOND, origins, through_eigenpairs, through_product, without
from torchlb.spectral.eigenbasis import (
    Eigenbasis,
    check_num_pairs,
    stack_eigenbases,
    unstack_eigenbases,
)
from torchlb.spectral.pencil import pencil_eigenbasis

MatrixName = Literal["laplacian", "stiffness", "mass", "boundary_mass"]
FieldMatrixName = Literal["connection", "vector_mass"]


def check_pair(lb: Any, what: str = "eigenpairs, flows and solves") -> None:
    """Raise InputError for an operator without a weak pair, on which eigenpairs, flows and solves rest."""
    if not lb._has_weak_form:
        raise InputError(
            f"{what}: this operator has no weak pair, as it was built with weak_form=False, or is a batch of which one "
            "was; the stencil is lb.matrix"
        )


class PairMethods(OperatorStorage):
    """Stiffness and mass matrix of the weak pair, and its eigenbasis."""

    @property
    def _has_weak_form(self) -> bool:
        """Whether the operator has a weak pair; only one built with weak_form=False has none."""
        return self.weak.num_rows > 0

    def _bilinear(self) -> Callable[..., Tensor]:
        """The sum of bilinear forms, of (forms, medium), or of (points, forms, medium) where points need a gradient."""
        return self.plan.bilinear if self.points.requires_grad else elements_of(self).bilinear

    @property
    def stiffness(self) -> Tensor:
        """K, torch sparse CSR (N, N), ℓ^{d−2}: uᵀKv = ∫∇u·∇v. Symmetric, positive semidefinite, K1 = 0.

        A view of the buffers, without boundary conditions: the rows and columns of Dirichlet points (`fixed`) are
        there, and solves take them out; the term of a Robin condition is in `pair`. Raises InputError without a weak
        pair.
        """
        return self._tensor("stiffness")

    @property
    def mass_matrix(self) -> Tensor:
        """M, torch sparse CSR (N, N), ℓ^d: uᵀMv = ∫uv. Symmetric, positive definite; diagonal for the cotangent.

        Raises InputError without a weak pair.
        """
        return self._tensor("mass")

    @property
    def boundary_mass(self) -> Tensor:
        """B, torch sparse CSR (N, N), ℓ^{d−1}: uᵀBv = ∫uv along the boundary. Raises InputError where there is none."""
        return self._tensor("boundary_mass")

    def _tensor(self, name: MatrixName) -> Tensor:
        matrices, channel = self._channel(name)
        values = without(self, matrices.values[channel], f"{name} as a tensor")
        return csr_tensor(matrices.crow, matrices.col, values, self.num_points)

    def _channel(self, name: str) -> tuple[Csr, int]:
        """The matrices that hold "laplacian", "stiffness", "mass" or "boundary_mass", and its channel in them."""
        check_choice("name", name, MatrixName)
        if name == "laplacian":
            return self.stencil, 0
        check_pair(self, name)
        if name == "boundary_mass" and not self.weak.has_boundary:
            raise InputError("boundary_mass: the shape is closed")
        return self.weak, get_args(MatrixName).index(name) - 1

    @takes_arrays
    def product(self, name: MatrixName, f: Tensor) -> Tensor:
        """A matrix of the operator times f, of the shape of f, differentiable in f any number of times.

        Computed in the wider of the types of f and the operator, at least float32, also under autocast; only a
        half-precision f gets its own type back. ``lb.stiffness @ f`` is torch's product, which needs equal types and,
        on the CPU, no half precision.

        Parameters
        ----------
        name
            "stiffness", "mass", "boundary_mass", as `to_scipy` has them; "laplacian" is ``lb(f)``.
        f
            (N,), (N, C) or (B, N, C), of any type.

        Raises InputError for another name or shape, and where there is no such matrix.
        """
        matrices, channel = self._channel(name)
        return through_product(self, name, f, matrices.product(channel, f))

    @takes_arrays
    def integral(self, f: Tensor) -> Tensor:
        """∫f over the shape, by the weights `mass`: () for f (N,), (C,) for (N, C), (B, C) for (B, N, C).

        Of a batch of S shapes one for each, (S,), (S, C) or (B, S, C). Units of f by ℓ^d.

        >>> from torchlb import LaplaceBeltrami
        >>> from torchlb.surfaces import Sphere
        >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(500))
        >>> bool((lb.integral(lb.points.square()) - 4 * torch.pi / 3).abs().max() < 1e-4)
        True
        """
        check_rows(f, self.num_points)
        weights = self.mass.to(torch.promote_types(f.dtype, self.dtype))
        return self._summed((weights if f.ndim == 1 else weights[:, None]) * f)

    @takes_arrays
    def inner(self, f: Tensor, g: Tensor) -> Tensor:
        """∫fg = fᵀMg for equal shapes, as for `integral`, with the density of a medium; by component for fields."""
        if f.shape != g.shape:
            raise InputError(f"inner: expected equal shapes, got {(*f.shape,)}, {(*g.shape,)}")
        return self._summed(f * self.product("mass", g))

    def _summed(self, x: Tensor) -> Tensor:
        """Sums over the points of each shape."""
        where = max(x.ndim - 2, 0)
        if self.sizes is None:
            return x.sum(where)
        return torch.stack([part.sum(where) for part in x.split(self.sizes, where)], where)

    def to_scipy(self, name: MatrixName | FieldMatrixName = "laplacian") -> sparse.csr_array:
        """Δ, or another matrix of the operator, as a scipy CSR matrix (N, N) on the CPU.

        Parameters
        ----------
        name
            "laplacian" is Δ, 1/ℓ², negative semidefinite like `igl.cotmatrix`, but strong: no mass in it. The others
            are `stiffness`, `mass_matrix` and `boundary_mass`, which raise InputError where there are none;
            "connection" and "vector_mass" are stiffness and mass of `LaplaceBeltrami.connection`, (N d, N d).

        Weak matrices with the signs and masses of other libraries: `torchlb.interop.conventions`.
        """
        if name in get_args(FieldMatrixName):
            fields: PairMethods = getattr(self, "connection", self)
            return fields.to_scipy("stiffness" if name == "connection" else "mass")
        matrices, channel = self._channel(name)
        return matrices.to_scipy(channel)

    def eigenbasis(
        self, k: int, *, tolerance: float | None = None, store: bool = False
    ) -> Eigenbasis:
        """The k smallest eigenpairs of −Δ: real, ascending, orthonormal in the mass; min(k, N) of them.

        Solved once, in float64 on the device of the operator (`method.md`, sections 7 and 10), and kept: a smaller k is
        a slice of the stored basis, a larger k or a smaller tolerance is solved anew. In a batch each shape has its own
        basis, solved where that shape has too few pairs.

        Parameters
        ----------
        k
            Number of pairs, the constants among them.
        tolerance
            Bound on the estimated relative errors of the eigenvalues against those of the matrices (K, M); the basis
            has the estimates as `relative_errors`. None for what suits k and the order: 1.5e-8 k², at order 4 1e-9,
            above 1e-11.
        store
            Whether `state_dict` holds the basis from now on; it then loads into any operator.

        Raises EigenbasisError where the solver does not converge, InputError without a weak pair.
        """
        k = check_num_pairs(k)
        count = k + (0 if origins(self) is None else BEYOND)
        return through_eigenpairs(self, self._known_basis(count, tolerance, store), k)

    def _known_basis(
        self, k: int, tolerance: float | None = None, store: bool = False
    ) -> Eigenbasis:
        """All eigenpairs known, at least k, solved anew where there are fewer, or where they are less exact."""
        if tolerance is not None:
            check_tolerance(tolerance)
        errors = self.modes.relative_errors[..., :k]
        if not self.modes.has(k) or (tolerance is not None and (errors > tolerance).any()):
            # The basis is kept, and may be used in training.
            exact = torch.autocast(self.device.type, enabled=False)
            with torch.inference_mode(False), exact, threads_for(self.num_points):
                check_pair(self)
                self._keep_basis(self._solved_basis(max(k, self.modes.count), tolerance))
        if store:
            self._keep_basis(stored=True)
        basis = self._basis
        assert basis is not None
        return basis

    def _solved_basis(self, k: int, tolerance: float | None) -> Eigenbasis:
        """Solve for k eigenpairs; the shapes of a batch solve for their own and keep them, where they are known."""
        if not (shapes := shapes_of(self)):
            return self._pair_eigenbasis(k, tolerance)
        bases = [shape._known_basis(k, tolerance) for shape in shapes]
        return stack_eigenbases([part for basis in bases for part in unstack_eigenbases(basis)])

    def _pair_eigenbasis(self, k: int, tolerance: float | None) -> Eigenbasis:
        """Eigenpairs of the weak pair of each shape; the default tolerance falls with the order."""
        matrices = [
            to_scipy(crow, col, v.double(), self.shape)
            for crow, col, values in (self.weak.pair, self.weak.linear_pair)
            for v in values
        ]
        fixed = torch.zeros_like(self.mass, dtype=torch.bool) if self.fixed is None else self.fixed
        losing, fixed = (mask.cpu().numpy() for mask in (self.weak.losing(fixed), fixed))
        order = self.options.get("order") or 3
        if tolerance is None and order > 3:
            tolerance = 10.0 ** -(2 * min(order, 5) + 1)
        bases = []
        for start, end in zip(self.offsets[:-1], self.offsets[1:], strict=True):
            block = slice(start, end)
            k_of, m_of, *near = (m[block, block] for m in matrices)
            mass, shift = self.mass[block].detach().double(), 0.0
            if not self.weak.of_functions:  # fields may be parallel
                shift = float(mass.sum() / self.dim) ** (-2 / self.dim)
                k_of, near[0] = k_of + shift * m_of, near[0] + shift * near[1]
            rest: Any = {"linear": (near[0], near[1]) if self.weak.linear.num_rows else None}
            rest |= {"fixed": fixed[block], "losing": losing[block], "tolerance": tolerance}
            basis = pencil_eigenbasis(k_of, m_of, mass, k, dim=self.dim, **rest)
            bases.append(replace(basis, eigenvalues=(basis.eigenvalues - shift).clamp_min(0.0)))
        return bases[0] if self.sizes is None else stack_eigenbases(bases)
