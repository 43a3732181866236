"""The operator as a module: it stores what the functions below it computed, and multiplies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor

from torchlb.errors import InputError
from torchlb.linalg.sparse import matmul, to_scipy
from torchlb.linalg.spectral_bounds import join_bounds
from torchlb.operator.batching import join_buffers, join_certificates
from torchlb.operator.build import Built, Options, build_cloud, build_cotangent, build_mesh
from torchlb.operator.cleaning import float_type
from torchlb.operator.report import StencilReport
from torchlb.operator.storage import REPORT_FIELDS, OperatorStorage
from torchlb.spectral.eigenbasis import Eigenbasis, check_num_pairs, stack_eigenbases
from torchlb.spectral.eigensolver import blockwise_eigenbasis
from torchlb.stability.certificate import Certificate
from torchlb.stability.null_vector import has_outflow

__all__ = ["LaplaceBeltrami"]


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
        points: Any,
        *,
        dim: int | None = None,
        order: int = 3,
        normal_order: int | None = None,
        projection: str = "tangent",
        weights: str = "least_squares",
        num_neighbors: int | None = None,
        normals: Any = None,
        boundary: Any = None,
        condition: str = "neumann",
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
        normal_order : q of the tangent frames, p + 1 by default; 0 keeps the poor ones (or those of `normals`).
        projection : "tangent" (more accurate) or "normal" (the note's), see `method.md`, section 3.
        weights : "least_squares" (robust) or "polyharmonic" (far more accurate on evenly spread points).
        num_neighbors : size K of every stencil, itself included, instead of the sizes of the ladder.
        normals : (N, n), if known (d = n − 1): the first guess of the tangent frames, and their orientation.
        boundary : (N,) mask of the points on the boundary, or "detect" (surfaces); None for a closed shape, or to do
            without a condition.
        condition : there: "neumann", ∂_ν f = 0, or "dirichlet", f = 0. With the latter the values of f at boundary
            points are not used elsewhere, and have rows of their own, −4d f/h² with h the distance to the nearest, at
            least a tenth of that to the farthest of the row.
        certify : whether rows step down until the certificate of stability holds, whose π is then the mass. Without
            it the operator is the raw one, which may blow up under diffusion, and the mass is that of Voronoi cells.
        progress : whether to show a bar on what takes longer than two seconds.

        Raises
        ------
        ValueError : for bad input, naming the points and the remedy.
        StencilError : where not even the fallback row of a point can be built.
        """
        options = Options(order, normal_order, projection, weights, num_neighbors, certify)
        built = build_cloud(
            points,
            dim,
            options,
            normals=normals,
            boundary=boundary,
            condition=condition,
            progress=progress,
        )
        return cls._of(built, points)

    @classmethod
    def from_mesh(
        cls,
        vertices: Any,
        faces: Any,
        *,
        order: int = 3,
        normal_order: int | None = None,
        projection: str = "tangent",
        weights: str = "least_squares",
        num_neighbors: int | None = None,
        boundary: str | None = "neumann",
        certify: bool = True,
        progress: bool = True,
    ) -> LaplaceBeltrami:
        """Operator on the vertices of a mesh; its faces say who is whose neighbour and give the first normals.

        Parameters
        ----------
        vertices : (N, n) tensor or array, length ℓ.
        faces : (F, 3) indices. Any triangle mesh: several components, non-manifold edges, zero-area triangles.
            Also (F, 2) polylines and (F, 4) tetrahedra, for manifolds of dimension 1 and 3.
        boundary : "neumann" for ∂_ν f = 0 on the boundary that the faces have, if any, or "dirichlet" for f = 0, see
            `condition` of `from_points`; None to do without a condition.
        order, normal_order, projection, weights, num_neighbors, certify, progress : as for `from_points`.

        Raises
        ------
        ValueError : for bad input, such as vertices that belong to no face.
        """
        options = Options(order, normal_order, projection, weights, num_neighbors, certify)
        built = build_mesh(vertices, faces, options, boundary=boundary, progress=progress)
        return cls._of(built, vertices)

    @classmethod
    def from_cotangent(cls, vertices: Any, faces: Any) -> LaplaceBeltrami:
        """libigl's cotangent operator M⁻¹C with its Voronoi mass, behind the same interface: the baseline.

        Parameters
        ----------
        vertices : (N, 3), ℓ.  faces : (F, 3) indices.

        Its gradient is the first-order fit to the vertices around each point. Raises ValueError for bad input and for
        vertices without area.
        """
        return cls._of(build_cotangent(vertices, faces), vertices)

    @classmethod
    def batch(cls, shapes: Sequence[LaplaceBeltrami]) -> LaplaceBeltrami:
        """Several shapes as one block-diagonal operator, which every layer takes like any other.

        Features are the shapes' below each other, (ΣN, C). Indices of shape s (its faces, say) move by
        ``lb.offsets[s]``. Eigenbases that the shapes hold are taken over; the others are solved when asked for.
        Raises ValueError for shapes of different dimension, floating type or device, or for none.
        """
        if len(shapes) == 0:
            raise InputError("batch: got no shapes")
        lb = cls()
        stored = [dict(shape.named_buffers()) for shape in shapes]
        for name, value in join_buffers(stored).items():
            setattr(lb, name, value)
        lb.kind, lb.options = "batch", dict(shapes[0].options)
        lb.certificate = join_certificates([shape.certificate for shape in shapes])
        lb.sizes = tuple(n for shape in shapes for n in shape.sizes or (shape.num_points,))
        lb.set_bounds(join_bounds([shape.spectral_bounds for shape in shapes]))
        bases = [shape.eigenbasis(1, closed=True) for shape in shapes if len(shape.basis_left)]
        if len(bases) == len(shapes) and not any(shape.sizes for shape in shapes):
            lb._keep(stack_eigenbases(bases))
        return lb

    @classmethod
    def _of(cls, built: Built, given: Any) -> LaplaceBeltrami:
        """Store what was built, in the floating type of the input."""
        lb = cls()
        rows, geometry = built.rows, built.geometry
        lb.kind, lb.options, lb.certificate = built.kind, built.options, built.certificate
        lb.crow, lb.col, lb.values = rows.crow, rows.col, rows.laplacian
        lb.gradient_values = rows.gradient.T.contiguous()
        lb.mass, lb.points, lb.frames = geometry.areas, geometry.points, geometry.frames
        lb.normals = lb.points[:0] if geometry.normals is None else geometry.normals
        report = {**vars(rows), "num_neighbors": rows.length, "normal_order": geometry.normal_order}
        for name in REPORT_FIELDS:
            setattr(lb, f"report_{name}", report[name])
        lb._transpose()
        _ = lb.bounds  # found once, from values that are not yet rounded
        return lb.to(float_type(given))

    @property
    def dim(self) -> int:
        """Dimension d of the manifold."""
        return self.frames.shape[-1]

    @property
    def matrix(self) -> Tensor:
        """Δ as a torch sparse CSR tensor (N, N), 1/ℓ²; a view of the buffers."""
        shape = (self.num_points, self.num_points)
        return torch.sparse_csr_tensor(
            self.crow, self.col, self.values, shape, check_invariants=False
        )

    def to_scipy(self) -> sparse.csr_array:
        """Δ as a scipy CSR matrix (N, N), 1/ℓ², negative semidefinite like `igl.cotmatrix`, but strong: no mass in it.

        Weak matrices with the signs and masses of other libraries: `torchlb.interop.conventions`.
        """
        return to_scipy(self.crow, self.col, self.values, (self.num_points, self.num_points))

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

    def _apply_rows(self, values: Tensor, f: Tensor) -> Tensor:
        """The product with one set of values on the pattern, for any layout of f."""
        if not isinstance(f, Tensor):
            raise TypeError(f"expected f as a tensor, got {type(f)}; torch.as_tensor(f) makes one")
        if f.ndim == 1:
            return self._apply_rows(values, f[:, None])[:, 0]
        if not (f.ndim in (2, 3) and f.shape[-2] == self.num_points):
            raise InputError(
                f"expected f of shape (N,), (N, C) or (B, N, C) with N = {self.num_points}, "
                f"got {tuple(f.shape)}"
            )
        columns = f if f.ndim == 2 else f.transpose(0, 1).flatten(1)
        pattern_t = (self.crow_t, self.col_t, self.order_t)
        result = matmul(self.crow, self.col, values, pattern_t, columns)
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
        curvature. Units of v by 1/ℓ.
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

    def mean_curvature_normal(self) -> Float[Tensor, "N n"]:
        """Δx, 1/ℓ: the mean-curvature vector, −(κ₁ + κ₂) times the outer normal; −2x on the unit sphere."""
        return self(self.points)

    def eigenbasis(self, k: int, *, store: bool = False, closed: bool = False) -> Eigenbasis:
        """The k smallest eigenpairs of −Δ: real, ascending, orthonormal in the mass; min(k, N) of them.

        Solved once, in float64 on the CPU (`method.md`, section 7), and kept: a smaller k is a slice of what there is,
        a larger one is solved anew. For a batch each shape has its own.

        Parameters
        ----------
        k : number of pairs, the constants among them.
        store : whether `state_dict` holds the basis from now on; it then loads into any operator.
        closed : whether to return all that was solved, at least k: a span that is invariant under Δ.

        Raises
        ------
        StencilError : where the solver does not converge, or the operator is not stable.
        """
        k = check_num_pairs(k)
        if self.basis_left.shape[-1] < min(k, max(self.sizes or (self.num_points,))):
            n = self.num_points
            matrix = to_scipy(self.crow, self.col, self.values, (n, n))
            rounding = torch.finfo(self.values.dtype).eps
            outflow = bool(has_outflow(matrix, rounding).any())
            options = {"outflow": outflow, "rounding": rounding}
            self._keep(blockwise_eigenbasis(matrix, self.mass, k, self.sizes, **options))
        if store:
            self._keep(None, store=True)
        modes = (self.basis_decay_rates, self.basis_modal_transform)
        pairs = (self.basis_eigenvalues, self.basis_eigenvectors, self.mass, self.basis_left)
        basis = Eigenbasis(*pairs, self.sizes, *(t if len(t) else None for t in modes))
        return basis if closed else basis.truncate(k)

    def extra_repr(self) -> str:
        """N, d, n, kind and options."""
        if self.kind == "empty":
            return "empty"
        size = f"{self.num_points} points, dim={self.dim} in R^{self.points.shape[1]}, from {self.kind}"
        options = [f"{k}={v!r}" for k, v in self.options.items() if v is not None]
        certified = "" if self.certificate is None or self.certificate.holds else "NOT STABLE"
        last = [f"{self.col.shape[0]} entries", str(self.values.dtype), certified]
        return ", ".join(part for part in [size, *options, *last] if part)


# A whole module can be read back with torch.load(weights_only=True) where torchlb is imported.
torch.serialization.add_safe_globals([LaplaceBeltrami, Certificate])
