"""Methods of an operator by its stencil: Δf, ∇f and curvature at a point; curvatures of a surface in R³."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.errors import InputError
from torchlb.geometry.boundary import open_sides
from torchlb.linalg.checks import check_tensor, takes_arrays
from torchlb.linalg.csr import tensors_of
from torchlb.operator.report import StencilReport
from torchlb.operator.storage import OperatorStorage


@dataclass(frozen=True, eq=False, repr=False)
class Curvatures:
    """Curvatures of a surface in R³ at its points, positive where it bends away from its normals, as a sphere does.

    All are differentiable in the points. Directions are so where the principal curvatures differ.

    Attributes
    ----------
    shape_operator
        (N, 2, 2), 1/ℓ, symmetric: the derivative of the normal along the frames, in the frames.
    frames
        (N, 3, 2), orthonormal tangent vectors in columns.
    """

    shape_operator: Float[Tensor, "N 2 2"]
    frames: Float[Tensor, "N 3 2"]

    @property
    def k1(self) -> Float[Tensor, " N"]:
        """The larger principal curvature, κ₁ ≥ κ₂, 1/ℓ."""
        return torch.linalg.eigvalsh(self.shape_operator)[:, 1]

    @property
    def k2(self) -> Float[Tensor, " N"]:
        """The smaller principal curvature, κ₂, 1/ℓ."""
        return torch.linalg.eigvalsh(self.shape_operator)[:, 0]

    @property
    def directions(self) -> Float[Tensor, "N 3 2"]:
        """Unit tangent vectors of space of κ₁ and κ₂, up to their sign; any where both are equal."""
        with torch.autocast(self.frames.device.type, enabled=False):
            return self.frames @ torch.linalg.eigh(self.shape_operator).eigenvectors.flip(2)

    @property
    def mean(self) -> Float[Tensor, " N"]:
        """H = (κ₁ + κ₂)/2, 1/ℓ; the mean-curvature vector Δx is −2H times the normal."""
        return self.shape_operator.diagonal(dim1=1, dim2=2).sum(1) / 2

    @property
    def gaussian(self) -> Float[Tensor, " N"]:
        """K = κ₁κ₂, 1/ℓ², whatever the side of the normals."""
        return torch.linalg.det(self.shape_operator)

    @property
    def curvedness(self) -> Float[Tensor, " N"]:
        """√((κ₁² + κ₂²)/2), 1/ℓ (Koenderink and van Doorn 1992)."""
        return (self.shape_operator.square().sum((1, 2)) / 2).sqrt()

    @property
    def shape_index(self) -> Float[Tensor, " N"]:
        """(2/π) atan((κ₁ + κ₂)/(κ₁ − κ₂)): 1 on spheres, 1/2 on cylinders, 0 on saddles, −1 on cups."""
        return 2 / torch.pi * torch.atan2(self.k1 + self.k2, self.k1 - self.k2)

    def __repr__(self) -> str:
        least, most = float(self.k2.min()), float(self.k1.max())
        return f"Curvatures({len(self.shape_operator)} points, from {least:.4g} to {most:.4g})"


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
        with torch.autocast(f.device.type, enabled=False):
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
        """Product of the frames with a field, as einsum's `equation` says, in the type of the field.

        Autocast does not change the type, since a derivative multiplies the rounding of the field by 1/h.
        """
        frames = self.frames if frames is None else frames
        with torch.autocast(local.device.type, enabled=False):
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

        They are those of the polynomial that gives the normal (osculating jets; Cazals, Pouget 2005), on meshes and
        clouds. Where the points do not resolve it, and for the cotangent operator, they are those of the derivative of
        the normals by the rows of ∇, of first order at best. Signs are those of the normals: positive on a sphere with
        outer ones. Differentiable in the points. Raises InputError for other shapes.

        >>> from torchlb.surfaces import Sphere
        >>> from torchlb import LaplaceBeltrami
        >>> found = LaplaceBeltrami.from_mesh(*Sphere(2.0).mesh(500)).curvatures()
        >>> bool((found.gaussian - 0.25).abs().max() < 1e-3 and (found.mean - 0.5).abs().max() < 1e-3)
        True
        """
        check_surface(self, "curvatures")
        if len(self._shape_operators) == 0:
            raise InputError(
                "curvatures: these data were written by an earlier version, without them; apply "
                "LaplaceBeltramiTransform again"
            )
        return Curvatures(self._shape_operators, self.frames)

    def _boundary_points(self) -> Bool[Tensor, " N"]:
        """Mask of the boundary points, whether or not a condition holds there."""
        sides = open_sides(self.faces.cpu())[0].flatten().to(self.mass.device)
        found = torch.zeros_like(self.mass, dtype=torch.bool).index_fill(0, sides, True)
        return found if self.boundary is None else found | self.boundary


def turned_frames(lb: Any) -> Float[Tensor, "N 3 2"]:
    """The frames of a surface in R³ after a quarter turn about the normals, ν × E."""
    check_surface(lb, "a curl or a quarter turn")
    return torch.linalg.cross(lb.normals[:, :, None].expand_as(lb.frames), lb.frames, dim=1)


def check_surface(lb: Any, what: str) -> None:
    """Raise InputError unless the operator is of a surface in R³ with normals."""
    if lb.points.shape[1:] != (3,) or lb.dim != 2 or not len(lb.normals):
        raise InputError(
            f"{what}: expected a surface in R³ with normals, got one of dimension {lb.dim} in R^{lb.points.shape[1]}"
        )
