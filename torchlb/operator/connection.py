"""The connection Laplacian: tangent fields in the place of functions (`method.md`, section 15)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchlb.errors import DerivativeError, InputError
from torchlb.galerkin.creases import across_creases, creased_cells
from torchlb.galerkin.matrices import PairMatrices
from torchlb.galerkin.tangent import in_space, tangent_matrices
from torchlb.geometry.vectors import Points
from torchlb.linalg.checks import as_floats, check_tensor
from torchlb.linalg.csr import Csr
from torchlb.operator.batching import remember_shapes, shapes_of
from torchlb.operator.medium import elements_of, plain
from torchlb.operator.pair_methods import PairMethods, check_pair
from torchlb.operator.parts import Modes


class Connection(PairMethods):
    """Tangent fields of a shape: −∇*∇, Bochner's or the connection Laplacian, as a weak pair.

    A field v has the components c = Eᵀv in ``lb.frames``, row d·i + c of a matrix. The stiffness is ∫κ∇u:∇v of
    covariant derivatives, without the term of the curvature that Hodge's Laplacian has beside it; conditions, media and
    derivatives in points and medium are as for functions. At creases the triangles are linear elements with vectors
    that are turned into their planes. All that takes an operator's weak pair takes this one:
    `implicit_step`, `heat_flow`, and `eigenbasis`, whose relative errors are those of λ + area^{−2/d}, since fields may
    be parallel (λ = 0) in no, one or more ways.
    """

    def __init__(self) -> None:
        super().__init__()
        self._lb: tuple[Any, ...] = ()
        self._is_hodge = False

    def _bilinear(self) -> Callable[..., Float[Tensor, ""]]:
        lb, moved, hodge = self._lb[0], self.points.requires_grad, self._is_hodge

        def bilinear(*given: Any) -> Float[Tensor, ""]:
            if hodge:
                raise DerivativeError("Hodge's Laplacian has no derivatives in points and medium")
            if moved:
                return lb.plan.bilinear(*given, tangent=True)
            forms, medium = given
            forms = in_space(forms, lb.frames.detach().cpu().double())
            slopes = [form for form in forms if form.along]
            others = [form for form in forms if not form.along]
            total = _field_elements(lb).bilinear(slopes, medium)
            return total + elements_of(lb).bilinear(others, medium)

        return bilinear

    @property
    def hodge(self) -> Connection:
        """The same with Hodge's Laplacian of a surface, ∫κ(div u)² + κ(curl u)², made where it is asked for first.

        On fields it is Bochner's plus the Gaussian curvature. Those in its kernel are harmonic: 2g of them on a closed
        surface of genus g; with a boundary all fields without divergence and curl, infinitely many. Where the surface
        bends within one or two triangles eigenvalues converge slowly, from above. Without derivatives in points and
        medium. Raises InputError in other dimensions, for a conductivity that is a tensor, and for a batch, whose
        shapes have their own.
        """
        if self.cache.connection is None:
            tensors = self._medium.fields(len(self.points)).get("conductivity")
            if self.dim != 2 or self.sizes or (tensors and tensors.values.ndim == 3):
                raise InputError(
                    "hodge: expected one surface with a conductivity that is a number, if any"
                )
            with torch.inference_mode(False):
                self.cache.connection = _of_shape(self._lb[0], hodge=True)
        return self.cache.connection

    def components(
        self, v: Shaped[Tensor, "N n C"] | Shaped[Tensor, "N n"]
    ) -> Float[Tensor, "rows C"] | Float[Tensor, " rows"]:
        """Components in the frames, (N d, C) or (N d,), of the tangential part of the space vectors `v`.

        Raises InputError for another shape.
        """
        check_tensor(v, "v")
        size, n, _ = self.frames.shape
        if v.ndim not in (2, 3) or v.shape[:2] != (size, n):
            raise InputError(
                f"expected a field of shape (N, n) or (N, n, C) with N = {size}, n = {n}, got {tuple(v.shape)}"
            )
        v = as_floats(v, self.frames.dtype)
        with torch.autocast(v.device.type, enabled=False):
            return torch.einsum("ind,in...->id...", self.frames.to(v), v).flatten(0, 1)

    def vectors(
        self, c: Shaped[Tensor, "rows C"] | Shaped[Tensor, " rows"]
    ) -> Float[Tensor, "N n C"] | Points:
        """The tangent field of space vectors, (N, n, C) or (N, n), with components `c`, (N d, C) or (N d,)."""
        check_tensor(c, "c")
        if c.ndim not in (1, 2) or len(c) != self.num_points:
            raise InputError(
                f"expected components of shape (N d,) or (N d, C) with N d = {self.num_points}, got {tuple(c.shape)}"
            )
        c = as_floats(c, self.frames.dtype)
        with torch.autocast(c.device.type, enabled=False):
            return torch.einsum(
                "ind,id...->in...", self.frames.to(c), c.unflatten(0, (-1, self.dim))
            )

    @classmethod
    def _of(cls, lb: Any, weak: PairMatrices, hodge: bool = False) -> Connection:
        """The tangent fields of an operator with their matrices."""
        own, dim = cls(), lb.dim
        own.source, own.options, own._is_hodge = "connection", lb.options, hodge
        own.mass, own.points, own.frames = lb.mass.repeat_interleave(dim), lb.points, lb.frames
        own._on_boundary = lb._on_boundary.repeat_interleave(dim)
        own.weak, own.stencil = weak, Csr(values=lb.stencil.values[:, :0].detach())
        own.sizes = None if lb.sizes is None else [dim * size for size in lb.sizes]
        own._states, own._medium, own._in_medium = lb._states, lb._medium, lb._in_medium
        own._carries, own._lb, own.modes = lb._carries, (lb,), Modes(None, own.mass)
        return own


def connection_of(lb: Any) -> Connection:
    """The tangent fields of an operator, of one shape or a batch, made once and kept in its cache."""
    if lb.cache.connection is None:
        check_pair(lb)
        with torch.inference_mode(False):
            lb.cache.connection = _of_shape(lb) if lb.sizes is None else _of_batch(lb)
    return lb.cache.connection


def _field_elements(lb: Any) -> Any:
    """The elements for derivatives of fields, in the user's numbering."""
    cells, frames = lb.faces.cpu(), lb.frames.detach().cpu().double()
    if lb.source == "cotangent":
        creased = creased_cells(lb.points.detach().cpu().double(), cells)
    else:
        creased = torch.zeros(len(cells), dtype=torch.bool)
        creased[lb.plan.order] = lb.plan.creased()
    return across_creases(elements_of(lb), cells, creased, frames)


def _of_shape(lb: Any, *, hodge: bool = False) -> Connection:
    frames = lb.frames.detach().cpu().double()
    medium = plain(lb._known_medium.fields(len(lb.points)))
    elements = _field_elements(lb).in_medium(medium)
    with torch.no_grad():
        kappa = medium.get("conductivity")
        kappa = None if kappa is None else elements.values(kappa)
        others = [lb.weak, *([lb.weak.linear] if lb.weak.linear.num_rows else [])]
        found = tangent_matrices(elements, kappa, frames, others, hodge=hodge)
    whole, *near = (each.to(lb.weak.values) for each in found)
    weak = PairMatrices(whole.crow, whole.col, whole.values, *near, of_functions=False)
    return Connection._of(lb, weak, hodge)


def _of_batch(lb: Any) -> Connection:
    parts: Sequence[Connection] = [shape.connection for shape in shapes_of(lb) or lb.unbatch()]
    own = Connection._of(lb, PairMatrices.join([part.weak for part in parts]))
    remember_shapes(own, parts)
    return own
