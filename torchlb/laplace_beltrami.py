"""The operator as a module: it stores what the functions below it computed, and multiplies."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchlb.build import Built, Options, build_cloud, build_cotangent, build_mesh
from torchlb.certificate import Certificate
from torchlb.report import StencilReport
from torchlb.sparse import matmul, transpose_pattern

__all__ = ["LaplaceBeltrami"]

REPORT_FIELDS = (
    "order",
    "normal_order",
    "num_neighbors",
    "growth",
    "condition",
    "dominance",
    "reason",
)
BUFFERS = ("crow", "col", "values", "gradient_values", "mass", "points", "frames", "normals")


class LaplaceBeltrami(nn.Module):
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

    Examples
    --------
    >>> theta = torch.arange(12, dtype=torch.float64) * torch.pi / 6
    >>> circle = torch.stack([theta.cos(), theta.sin()], dim=1)
    >>> lb = LaplaceBeltrami.from_points(circle, order=3)
    >>> bool(torch.allclose(lb(circle[:, 0]), -circle[:, 0], atol=0.02))
    True
    """

    crow: Tensor
    col: Tensor
    values: Tensor
    gradient_values: Tensor
    mass: Tensor
    points: Tensor
    frames: Tensor
    normals: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.kind = "empty"
        self.options: dict[str, Any] = {}
        self.certificate: Certificate | None = None
        for name in BUFFERS:
            self.register_buffer(name, torch.zeros(0))
        self.crow, self.col = torch.zeros(1, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)
        for name in REPORT_FIELDS:
            real = name in ("growth", "condition", "dominance")
            empty = torch.zeros(0, dtype=torch.get_default_dtype() if real else torch.int64)
            self.register_buffer(f"report_{name}", empty)
        for name in ("crow_t", "col_t", "order_t"):  # of the transpose, for the backward pass
            self.register_buffer(name, torch.zeros(0, dtype=torch.int64), persistent=False)

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
        weights : "least_squares" (robust) or "polyharmonic" (more accurate at high order on evenly spread points).
        num_neighbors : size K of every stencil, itself included, instead of the sizes of the ladder.
        normals : (N, n), if known (d = n − 1): the first guess of the tangent frames, and their orientation.
        boundary : (N,) mask of the points on the boundary, or "detect" (surfaces); None for a closed shape, or to do
            without a condition.
        condition : there: "neumann", ∂_ν f = 0, or "dirichlet", f = 0. With the latter the values of f at boundary
            points are not used elsewhere, and have rows of their own, −c f, in which they decay at the grid's rate c.
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
        dtype = torch.as_tensor(given).dtype
        return lb.to(dtype if dtype.is_floating_point else torch.get_default_dtype())

    def _transpose(self) -> None:
        self.crow_t, self.col_t, self.order_t = transpose_pattern(
            self.crow, self.col, self.num_points
        )

    @property
    def num_points(self) -> int:
        """Number of points N."""
        return self.crow.shape[0] - 1

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

    @property
    def report(self) -> StencilReport:
        """What order each point reached, and why not more; print it."""
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
        torch._check(
            f.ndim in (2, 3) and f.shape[-2] == self.num_points,
            lambda: (
                f"expected f of shape (N,), (N, C) or (B, N, C) with N = {self.num_points}, "
                f"got {tuple(f.shape)}"
            ),
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
        torch._check(
            v.ndim in (2, 3) and v.shape[:2] == expected,
            lambda: (
                f"expected a field of shape {expected} or {(*expected, 'C')}, got {tuple(v.shape)}"
            ),
        )
        field = v[..., None] if v.ndim == 2 else v
        local = self.local_gradient(field.flatten(1)).unflatten(-1, field.shape[1:])  # (N, d, n, C)
        result = torch.einsum("ind,idnc->ic", self.frames.to(local.dtype), local)
        return result[:, 0] if v.ndim == 2 else result

    def mean_curvature_normal(self) -> Float[Tensor, "N n"]:
        """Δx, 1/ℓ: the mean-curvature vector, −(κ₁ + κ₂) times the outer normal; −2x on the unit sphere."""
        return self(self.points)

    def extra_repr(self) -> str:
        """N, d, n, kind and options."""
        if self.kind == "empty":
            return "empty"
        size = f"{self.num_points} points, dim={self.dim} in R^{self.points.shape[1]}, from {self.kind}"
        options = [f"{k}={v!r}" for k, v in self.options.items() if v is not None]
        certified = "" if self.certificate is None or self.certificate.holds else "NOT STABLE"
        last = [f"{self.col.shape[0]} entries", str(self.values.dtype), certified]
        return ", ".join(part for part in [size, *options, *last] if part)

    def get_extra_state(self) -> dict[str, Any]:
        """Kind, options and certificate, plain types only."""
        certificate = None if self.certificate is None else asdict(self.certificate)
        return {"kind": self.kind, "options": self.options, "certificate": certificate}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Inverse of `get_extra_state`."""
        self.kind, self.options = state["kind"], dict(state["options"])
        found = state["certificate"]
        self.certificate = None if found is None else Certificate(**found)

    def _load_from_state_dict(
        self,
        state_dict: Any,
        prefix: str,
        local_metadata: Any,
        strict: bool,
        missing_keys: Any,
        unexpected_keys: Any,
        error_msgs: Any,
    ) -> None:
        """Take buffers of any size: an operator is data, not parameters of a fixed shape."""
        for name, buffer in list(self.named_buffers()):
            incoming = state_dict.get(prefix + name)
            if incoming is not None:
                setattr(self, name, torch.empty_like(incoming, device=buffer.device))
        super()._load_from_state_dict(
            state_dict,
            prefix,
            local_metadata,
            strict,
            missing_keys,
            unexpected_keys,
            error_msgs,
        )
        self._transpose()


# A whole module can be read back with torch.load(weights_only=True) where torchlb is imported.
torch.serialization.add_safe_globals([LaplaceBeltrami, Certificate])
