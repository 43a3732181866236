"""Methods of an operator by its stencil: Δf, ∇f and curvature at a point."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.errors import InputError
from torchlb.geometry.boundary import boundary_faces
from torchlb.linalg.checks import check_tensor, takes_arrays
from torchlb.linalg.csr import tensors_of
from torchlb.operator.curvature import Curvatures, curvatures_of, turned_frames
from torchlb.operator.report import StencilReport
from torchlb.operator.storage import OperatorStorage


class StencilMethods(OperatorStorage):
    """Products with the rows of the stencil, and the differential operators made of them."""

    @property
    def matrix(self) -> Tensor:
        """Δ as a torch sparse CSR tensor (N, N), 1/ℓ²; a view of the buffers."""
        return self.stencil.tensor(0)

    @property
    def report(self) -> StencilReport:
        """The order that each point reached, and why not more; print it."""
        if len(self._record.order) != self.num_points:
            raise InputError("report: PyG's Data do not carry it; it is with the operator as built")
        order, fields = self.options.get("order", 0), tensors_of(self._record)
        return StencilReport(order, self.dim, **fields, surface=self.surface)

    @takes_arrays
    def forward(self, f: Float[Tensor, "*batch N C"] | Float[Tensor, " N"]) -> Tensor:
        """Δf, of the shape of f: (N,), (N, C) or (B, N, C) on one surface. Units of f by 1/ℓ².

        Near a boundary it is that of functions which satisfy the condition, ∂f/∂ν + a f = 0 or f = 0; for any other
        function it is far off there, and `divergence(gradient(f))` is right.
        """
        return self.stencil.product(0, f)

    def __matmul__(self, f: Tensor) -> Tensor:
        """``lb @ f`` is ``lb(f)``."""
        return self(f)

    @takes_arrays
    def local_gradient(self, f: Tensor) -> Tensor:
        """∇f in the frames, (N, d, C) for f (N, C), (N, d) for (N,), (B, N, d, C) for (B, N, C). Units of f by 1/ℓ."""
        check_tensor(f)
        if torch.is_autocast_enabled(f.device.type):
            with torch.autocast(f.device.type, enabled=False):
                return self.local_gradient(f)
        parts = [self.stencil.product(c, f) for c in range(1, 1 + self.dim)]
        return torch.stack(parts, dim=1 if f.ndim < 3 else 2)

    @takes_arrays
    def gradient(self, f: Tensor) -> Tensor:
        """∇f as tangent vectors of space, (N, n, C) for f (N, C), (N, n) for (N,), (B, N, n, C) for (B, N, C).

        Units of f by 1/ℓ. Order p + 1 or better where the stencil has order p.
        """
        local = self.local_gradient(f)
        return self._turned("ind,id->in" if f.ndim == 1 else "ind,...idc->...inc", local)

    def _turned(self, equation: str, local: Tensor, frames: Tensor | None = None) -> Tensor:
        """Frames times a field, in its type, also under autocast: rounding before a derivative grows by 1/h."""
        if torch.is_autocast_enabled(local.device.type):
            with torch.autocast(local.device.type, enabled=False):
                return self._turned(equation, local, frames)
        frames = self.frames if frames is None else frames
        return torch.einsum(equation, frames.to(local.dtype), local)

    @takes_arrays
    def divergence(self, v: Tensor) -> Tensor:
        """div v = Σ_c E_c · ∂_c v of space vectors v: (N,) for (N, n), (N, C) for (N, n, C), batches (B, N, C) too.

        The divergence on the manifold of the tangential part of v plus, for a normal part φν, the term −Hφ of the mean
        curvature. Units of v by 1/ℓ. It is consistent, but neither −1 times the adjoint of `gradient` nor exactly
        conservative: ∫ div v = 0 on a closed surface, and div ∇f = Δf, up to the order of the stencils.
        """
        return self._contracted(v, self.frames)

    @takes_arrays
    def curl(self, v: Tensor) -> Tensor:
        """curl v = ν·(∇ × v) = div(v × ν) of space vectors v on a surface in R³ with normals ν; shapes as `divergence`.

        What v has of a normal part does not count. Units of v by 1/ℓ. Raises InputError for other shapes.

        >>> from torchlb import LaplaceBeltrami
        >>> from torchlb.surfaces import Sphere
        >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(500))
        >>> turning = torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]]).to(lb.points), lb.points)
        >>> bool((lb.curl(turning) - 2 * lb.points[:, 2]).abs().max() < 1e-2)
        True
        """
        return self._contracted(v, turned_frames(self))

    def _contracted(self, v: Tensor, frames: Tensor) -> Tensor:
        """Σ_c F_c · ∂_c v for vectors F_c at each point, (N, n, d)."""
        check_tensor(v, "v")
        if v.ndim == 2:
            return self._contracted(v[..., None], frames)[:, 0]
        size, n = self.num_points, self.points.shape[1]
        if not (v.ndim in (3, 4) and v.shape[-3:-1] == (size, n)):
            raise InputError(
                f"expected a field of shape (N, n), (N, n, C) or (B, N, n, C) with N = {size}, n = {n}, got "
                f"{tuple(v.shape)}"
            )
        local = self.local_gradient(v.flatten(-2)).unflatten(-1, v.shape[-2:])  # (…, N, d, n, C)
        return self._turned("ind,...idnc->...ic", local, frames)

    @takes_arrays
    def hessian(self, f: Tensor) -> Tensor:
        """∇²f, covariant second derivatives E_b·∂_a(∇f) in the frames: (N, d, d) for f (N,), (N, d, d, C) for (N, C).

        Symmetric, units of f by 1/ℓ², of order p; first order at best in low-order rows. Its trace is Δf up to that.
        """
        check_tensor(f)
        if f.ndim == 1:
            return self.hessian(f[:, None])[..., 0]
        if f.ndim != 2:
            raise InputError(f"expected f of shape (N,) or (N, C), got {tuple(f.shape)}")
        slope = self.gradient(f)  # (N, n, C)
        change = self.local_gradient(slope.flatten(1)).unflatten(-1, slope.shape[1:])
        result = self._turned("inb,ianc->iabc", change)
        return (result + result.transpose(1, 2)) / 2

    def mean_curvature_normal(self) -> Float[Tensor, "N n"]:
        """Δx, 1/ℓ: the mean-curvature vector, −(κ₁ + κ₂) times the outer normal; −2x on the unit sphere.

        In rows that contain a boundary point, and so a condition that x does not satisfy, it is computed as div ∇x.
        """
        normal, on_boundary = self(self.points), self._boundary_points()
        if not on_boundary.any():
            return normal
        row = self.stencil.row[on_boundary[self.stencil.col]]
        free = torch.ones_like(on_boundary).index_fill(0, row, False)[:, None]
        return torch.where(free, normal, self.divergence(self.gradient(self.points)))

    def curvatures(self) -> Curvatures:
        """Principal, mean and Gaussian curvature of a surface in R³, of the order p of the operator.

        They are those of the derivative of the normals by the rows of ∇, on meshes and clouds; at low-order rows
        (`report`) of first order at best. Signs are those of the normals: positive on a sphere with outer ones.
        Differentiable in the points. Raises InputError for other shapes.

        >>> from torchlb.surfaces import Sphere
        >>> from torchlb import LaplaceBeltrami
        >>> found = LaplaceBeltrami.from_mesh(*Sphere(2.0).mesh(500)).curvatures()
        >>> bool((found.gaussian - 0.25).abs().max() < 1e-3 and (found.mean - 0.5).abs().max() < 1e-3)
        True
        """
        return curvatures_of(self)

    def _boundary_points(self) -> Bool[Tensor, " N"]:
        """Mask of the boundary points, whether or not a condition holds there."""
        on_boundary = torch.zeros_like(self.mass, dtype=torch.bool)
        if self.boundary is not None:
            on_boundary |= self.boundary
        sides = boundary_faces(self.faces.cpu()).flatten()
        return on_boundary.index_fill(0, sides.to(on_boundary.device), True)
