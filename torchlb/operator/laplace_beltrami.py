"""The operator as a module: it stores what the functions below it computed, and multiplies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor

from torchlb.errors import InputError
from torchlb.fits.rules import WeightsName
from torchlb.geometry.frames import Projection
from torchlb.linalg.sparse import csr_product, csr_tensor, to_scipy
from torchlb.operator import build
from torchlb.operator.batching import join_buffers, join_states, split_buffers
from torchlb.operator.cleaning import ArrayLike, float_type
from torchlb.operator.report import StencilReport
from torchlb.operator.storage import REPORT_FIELDS, OperatorStorage
from torchlb.spectral.eigenbasis import (
    Eigenbasis,
    check_num_pairs,
    stack_eigenbases,
    unstack_eigenbases,
)
from torchlb.spectral.eigensolver import blockwise_eigenbasis
from torchlb.stability.certificate import Certificate
from torchlb.stencils.conditions import CONDITIONS, ConditionName


class LaplaceBeltrami(OperatorStorage):
    """The Laplace–Beltrami operator Δ of a surface (or any manifold in Rⁿ) as a sparse matrix.

    Build it with `from_points`, `from_mesh` or `from_cotangent`; ``LaplaceBeltrami()`` alone is empty and takes any
    `load_state_dict`. The sign is the analyst's: Δ is negative semidefinite, Δ Y_l = −l(l+1) Y_l on the unit sphere.

    Attributes
    ----------
    crow, col, values : the matrix of Δ in CSR; values in 1/ℓ², where ℓ is the unit of the points.
    gradient_values : (d, nnz), 1/ℓ: tangential derivatives in the frame of each row's point, on the same pattern.
    mass : (N,), ℓ^d: positive quadrature weights that sum to the area; π of the certificate.
    certificate : what is proved of the stability of Δ; None where it was not asked for, and for the cotangent.
    points : (N, n), ℓ.  frames : (N, n, d), orthonormal tangent vectors.
    normals : (N, n), unit normals of a hypersurface, empty (0, n) otherwise.
    sizes : numbers of points of the shapes of a `batch`; None for a single shape.
    source : "points", "mesh", "cotangent" or "batch".  options : of the constructor, as given.

    Examples
    --------
    >>> theta = torch.arange(36, dtype=torch.float64) * torch.pi / 18
    >>> circle = torch.stack([theta.cos(), theta.sin()], dim=1)
    >>> lb = LaplaceBeltrami.from_points(circle, order=3)
    >>> bool(torch.allclose(lb(circle[:, 0]), -circle[:, 0], atol=0.02))
    True
    """

    @classmethod
    def from_points(
        cls,
        points: ArrayLike,
        *,
        dim: int | None = None,
        order: int = 3,
        normal_order: int | None = None,
        projection: Projection = "tangent",
        weights: WeightsName = "least_squares",
        num_neighbors: int | None = None,
        normals: ArrayLike | None = None,
        boundary: ArrayLike | Literal["detect"] | None = None,
        condition: ConditionName | None = "neumann",
        certify: bool = True,
        progress: bool = True,
    ) -> LaplaceBeltrami:
        """Operator on a point cloud.

        Parameters
        ----------
        points : (N, n) tensor or array, length ℓ, without duplicates. Computed in float64 on the CPU, without
            gradients; the result has the floating type of the points.
        dim : d of the manifold; n − 1 by default. Curves, surfaces in R⁴, S³ in R⁴ take the same path.
        order : p ≥ 1 of the Laplacian: the error falls like h^p.
        normal_order : q of the tangent frames, p + 1 by default; 0 keeps the initial ones (or those of `normals`).
        projection : "tangent" (more accurate) or "normal" (the note's), see `method.md`, section 3.
        weights : "least_squares" (robust) or "polyharmonic" (far more accurate on evenly spread points).
        num_neighbors : size K of every stencil, itself included, instead of the sizes of the candidates.
        normals : (N, n), if known (d = n − 1): the first guess of the tangent frames, and their orientation.
        boundary : (N,) mask of the points on the boundary, or "detect" (surfaces); None for a closed shape.
        condition : there: "neumann", ∂_ν f = 0, or "dirichlet", f = 0. With the latter the values of f at boundary
            points are not used elsewhere, and have rows of their own, −4d f/h² with h the distance to the nearest, at
            least a tenth of that to the farthest of the row. None uses no datum. That, and a boundary that is not
            declared, leaves stencils there one-sided; hardly one passes, and the low-order rows in their place have
            ∂_ν f = 0 at first order: Δx at the boundary of a disk is of size 1/h then, not 0.
        certify : whether rows are lowered until the certificate of stability holds, whose π is then the mass. Without
            it the operator is the raw one, which may blow up under diffusion, and the mass is that of Voronoi cells.
        progress : whether to show a bar, on a terminal, for what takes longer than two seconds.

        Raises
        ------
        InputError : for bad input, naming the points and the remedy.
        StencilError : where not even the low-order row of a point can be built.
        """
        options = build.Options(
            order, normal_order, projection, weights, num_neighbors, condition, certify
        )
        built = build.build_cloud(
            points, dim, options, normals=normals, boundary=boundary, progress=progress
        )
        return cls._from_assembled(built, points)

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        order: int = 3,
        normal_order: int | None = None,
        projection: Projection = "tangent",
        weights: WeightsName = "least_squares",
        num_neighbors: int | None = None,
        boundary: ArrayLike | Literal["detect"] | None = None,
        condition: ConditionName | None = "neumann",
        certify: bool = True,
        progress: bool = True,
    ) -> LaplaceBeltrami:
        """Operator on the vertices of a mesh; its faces say who is whose neighbour and give the first normals.

        Parameters
        ----------
        vertices : (N, n) tensor or array, length ℓ.
        faces : (F, 3) indices. Any triangle mesh: several components, non-manifold edges, zero-area triangles.
            Also (F, 2) polylines and (F, 4) tetrahedra, for manifolds of dimension 1 and 3.
        boundary : (N,) mask of the part of the boundary where the condition holds; the rest has none. By default, or
            for "detect", all the boundary that the faces have, if any.
        order, normal_order, projection, weights, num_neighbors, condition, certify, progress : as for `from_points`.

        Raises
        ------
        InputError : for bad input, such as vertices that belong to no face.
        """
        options = build.Options(
            order, normal_order, projection, weights, num_neighbors, condition, certify
        )
        built = build.build_mesh(vertices, faces, options, boundary=boundary, progress=progress)
        return cls._from_assembled(built, vertices)

    @classmethod
    def from_cotangent(cls, vertices: ArrayLike, faces: ArrayLike) -> LaplaceBeltrami:
        """libigl's cotangent operator M⁻¹C with its Voronoi mass, behind the same interface: the baseline.

        Parameters
        ----------
        vertices : (N, 3), ℓ.  faces : (F, 3) indices.

        Its gradient is the first-order fit to the vertices around each point, and ∂_ν f = 0 at a boundary.
        Raises InputError for bad input and for vertices without area.
        """
        return cls._from_assembled(build.build_cotangent(vertices, faces), vertices)

    @classmethod
    def batch(cls, shapes: Sequence[LaplaceBeltrami]) -> LaplaceBeltrami:
        """Several shapes as one block-diagonal operator, which every layer takes like any other.

        Features are the shapes' below each other, (ΣN, C). Indices of shape s (its faces, say) move by
        ``lb.offsets[s]``. Eigenbases that the shapes hold are taken over; the others are solved when asked for.
        Raises InputError for shapes of different dimension, floating type or device, or for none.
        """
        if len(shapes) == 0:
            raise InputError("batch: got no shapes")
        sizes = [n for shape in shapes for n in shape.sizes or (shape.num_points,)]
        _ = [shape.bounds for shape in shapes]  # of one from an old state they are found here, once
        state = join_states([shape.get_extra_state() for shape in shapes], sizes)
        bases = [shape.basis for shape in shapes if shape.basis and not shape.sizes]
        basis = stack_eigenbases(bases) if len(bases) == len(shapes) else None
        return cls.from_buffers(
            join_buffers([dict(s.named_buffers()) for s in shapes]), state, basis
        )

    def unbatch(self) -> list[LaplaceBeltrami]:
        """The operators of the shapes of a `batch`, with all that they had: certificates, bounds, eigenbases."""
        if self.sizes is None or self.parts is None:
            raise InputError(f"unbatch: expected a batch of operators, got one from {self.source}")
        basis = self.basis
        bases = [None] * len(self.sizes) if basis is None else unstack_eigenbases(basis)
        buffers = split_buffers(dict(self.named_buffers()), self.sizes)
        shapes = zip(buffers, self.parts, bases, strict=True)
        return [type(self).from_buffers(*shape) for shape in shapes]

    @classmethod
    def _from_assembled(cls, built: build.AssembledOperator, given: ArrayLike) -> LaplaceBeltrami:
        """Store what was built, in the floating type of the input."""
        rows, shape = built.rows, built.shape
        points = shape.points
        report = {**vars(rows), "num_neighbors": rows.length, "normal_order": shape.normal_order}
        buffers = {f"report_{name}": report[name] for name in REPORT_FIELDS} | {
            "crow": rows.crow,
            "col": rows.col,
            "values": rows.laplacian,
            "gradient_values": rows.gradient.T.contiguous(),
            "mass": shape.areas,
            "points": points,
            "frames": shape.frames,
            "normals": points[:0] if shape.normals is None else shape.normals,
        }
        if shape.boundary is not None and shape.boundary.mask.any():
            buffers["on_boundary"] = shape.boundary.mask
        lb = cls.from_buffers(buffers, {"source": built.source, "options": built.options})
        lb.certificate = built.certificate
        _ = lb.bounds  # found once, from values that are not yet rounded
        return lb.to(float_type(given))

    @property
    def dim(self) -> int:
        """Dimension d of the manifold."""
        return self.frames.shape[-1]

    @property
    def order(self) -> int | None:
        """Order p that was asked for; None where there is none, as for the cotangent operator."""
        return self.options.get("order")

    @property
    def condition(self) -> str | None:
        """What holds at the boundary, "neumann" or "dirichlet"; None if no datum is used there."""
        return self.options.get("condition")

    @property
    def boundary(self) -> Tensor | None:
        """(N,), mask of the points where `condition` holds; None on a closed shape."""
        return self.on_boundary if len(self.on_boundary) else None

    @property
    def shape(self) -> tuple[int, int]:
        """(N, N), of the matrix."""
        return self.num_points, self.num_points

    @property
    def dtype(self) -> torch.dtype:
        """Floating type of the matrix."""
        return self.values.dtype

    @property
    def device(self) -> torch.device:
        """Where the buffers are."""
        return self.values.device

    @property
    def matrix(self) -> Tensor:
        """Δ as a torch sparse CSR tensor (N, N), 1/ℓ²; a view of the buffers."""
        return csr_tensor(self.crow, self.col, self.values, self.num_points)

    def to_scipy(self) -> sparse.csr_array:
        """Δ as a scipy CSR matrix (N, N), 1/ℓ², negative semidefinite like `igl.cotmatrix`, but strong: no mass in it.

        Weak matrices with the signs and masses of other libraries: `torchlb.interop.conventions`.
        """
        return to_scipy(self.crow, self.col, self.values, self.shape)

    @property
    def report(self) -> StencilReport:
        """What order each point reached, and why not more; print it."""
        if len(self.report_order) != self.num_points:
            raise InputError("report: PyG's Data do not carry it; it is with the operator as built")
        fields = {name: getattr(self, f"report_{name}") for name in REPORT_FIELDS}
        return StencilReport(self.options.get("order", 0), self.dim, **fields)

    def forward(self, f: Float[Tensor, "*batch N C"] | Float[Tensor, " N"]) -> Tensor:
        """Δf, of the shape of f: (N,), (N, C) or (B, N, C) on one surface. Units of f by 1/ℓ²."""
        return self._apply_rows(self.values, f)

    def __matmul__(self, f: Tensor) -> Tensor:
        """``lb @ f`` is ``lb(f)``."""
        return self(f)

    def adjoint(self, f: Float[Tensor, "*batch N C"] | Float[Tensor, " N"]) -> Tensor:
        """Lᵀf, of the shape of f, for the matrix L of Δ: Σ_i (Δg)_i f_i = Σ_i g_i (Lᵀf)_i for all g.

        In the inner product of the mass π the adjoint is Lᵀ(πf)/π.
        """
        return self._apply_rows(self.values, f, transposed=True)

    def _apply_rows(self, values: Tensor, f: Tensor, transposed: bool = False) -> Tensor:
        """The product with one set of values on the pattern, or its transpose, for any layout of f."""
        if not isinstance(f, Tensor):
            raise TypeError(f"expected f as a tensor, got {type(f)}; torch.as_tensor(f) makes one")
        if f.ndim == 1:
            return self._apply_rows(values, f[:, None], transposed)[:, 0]
        if not (f.ndim in (2, 3) and f.shape[-2] == self.num_points):
            raise InputError(
                f"expected f of shape (N,), (N, C) or (B, N, C) with N = {self.num_points}, "
                f"got {tuple(f.shape)}"
            )
        columns = f if f.ndim == 2 else f.transpose(0, 1).flatten(1)
        pattern = [self.crow, self.col, self.crow_t, self.col_t, self.order_t]
        result = csr_product(pattern, values, columns, transposed)
        if f.ndim == 2:
            return result
        return result.view(f.shape[1], f.shape[0], f.shape[2]).transpose(0, 1)

    def local_gradient(self, f: Tensor) -> Tensor:
        """∇f in the frames, (N, d, C) for f (N, C), (N, d) for (N,), (B, N, d, C) for (B, N, C). Units of f by 1/ℓ."""
        parts = [self._apply_rows(values, f) for values in self.gradient_values]
        return torch.stack(parts, dim=1 if f.ndim < 3 else 2)

    def gradient(self, f: Tensor) -> Tensor:
        """∇f as tangent vectors of space, (N, n, C) for f (N, C), (N, n) for (N,), (B, N, n, C) for (B, N, C).

        Units of f by 1/ℓ. Order p + 1 or better where the stencil has order p.
        """
        local = self.local_gradient(f)
        if f.ndim == 1:
            return torch.einsum("ind,id->in", self.frames.to(local.dtype), local)
        return torch.einsum("ind,...idc->...inc", self.frames.to(local.dtype), local)

    def divergence(self, v: Tensor) -> Tensor:
        """div v = Σ_c E_c · ∂_c v of a field of space vectors v: (N,) for (N, n), (N, C) for (N, n, C).

        The divergence on the manifold of its tangential part plus, for a normal part φν, the term −Hφ of its mean
        curvature. Units of v by 1/ℓ. It is consistent, but neither −1 times the adjoint of `gradient` nor exactly
        conservative: ∫ div v = 0 on a closed surface, and div ∇f = Δf, up to the order of the stencils.
        """
        expected = (self.num_points, self.points.shape[1])
        if not (v.ndim in (2, 3) and v.shape[:2] == expected):
            raise InputError(
                f"expected a field of shape {expected} or {(*expected, 'C')}, got {tuple(v.shape)}"
            )
        field = v[..., None] if v.ndim == 2 else v
        local = self.local_gradient(field.flatten(1)).unflatten(-1, field.shape[1:])  # (N, d, n, C)
        result = torch.einsum("ind,idnc->ic", self.frames.to(local.dtype), local)
        return result[:, 0] if v.ndim == 2 else result

    def hessian(self, f: Tensor) -> Tensor:
        """∇²f, covariant second derivatives E_b·∂_a(∇f) in the frames: (N, d, d) for f (N,), (N, d, d, C) for (N, C).

        Symmetric, units of f by 1/ℓ², of order p; first order at best in low-order rows. Its trace is Δf up to that.
        """
        if f.ndim == 1:
            return self.hessian(f[:, None])[..., 0]
        slope = self.gradient(f)  # (N, n, C)
        change = self.local_gradient(slope.flatten(1)).unflatten(-1, slope.shape[1:])
        result = torch.einsum("inb,ianc->iabc", self.frames.to(change.dtype), change)
        return (result + result.transpose(1, 2)) / 2

    def mean_curvature_normal(self) -> Float[Tensor, "N n"]:
        """Δx, 1/ℓ: the mean-curvature vector, −(κ₁ + κ₂) times the outer normal; −2x on the unit sphere."""
        return self(self.points)

    def eigenbasis(self, k: int, *, store: bool = False) -> Eigenbasis:
        """The k smallest eigenpairs of −Δ: real, ascending, orthonormal in the mass; min(k, N) of them.

        Solved once, in float64 on the CPU (`method.md`, section 7), and kept: a smaller k is a slice of what there is,
        a larger one is solved anew. For a batch each shape has its own.

        Parameters
        ----------
        k : number of pairs, the constants among them.
        store : whether `state_dict` holds the basis from now on; it then loads into any operator.

        Raises
        ------
        EigenbasisError : where the solver does not converge, or the operator is not stable.
        """
        return self.invariant_basis(k, store=store).truncate(k)

    def invariant_basis(self, k: int, *, store: bool = False) -> Eigenbasis:
        """At least k eigenpairs, all that are solved, so that their span is invariant under Δ; else as `eigenbasis`."""
        k = check_num_pairs(k)
        if self.basis_left.shape[-1] < min(k, max(self.sizes or (self.num_points,))):
            matrix, rounding = self.to_scipy(), torch.finfo(self.dtype).eps
            states = self.parts or [self.get_extra_state()]
            conditions = [CONDITIONS.get(state["options"].get("condition")) for state in states]
            outflow = not all(c is None or c.conserves for c in conditions)
            options = {"outflow": outflow, "rounding": rounding}
            self.keep_basis(blockwise_eigenbasis(matrix, self.mass, k, self.sizes, **options))
        if store:
            self.keep_basis(store=True)
        basis = self.basis
        assert basis is not None
        return basis

    def extra_repr(self) -> str:
        """N, d, n, source and options."""
        if self.source == "empty":
            return "empty"
        size = f"{self.num_points} points, dim={self.dim} in R^{self.points.shape[1]}, from {self.source}"
        options = [f"{k}={v!r}" for k, v in self.options.items() if v is not None]
        certified = "" if self.certificate is None or self.certificate.holds else "NOT STABLE"
        last = [f"{self.col.shape[0]} entries", str(self.values.dtype), certified]
        return ", ".join(part for part in [size, *options, *last] if part)


# A whole module can be read back with torch.load(weights_only=True) where torchlb is imported.
torch.serialization.add_safe_globals([LaplaceBeltrami, Certificate])
