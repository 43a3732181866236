"""Parts of an operator: matrices of its weak pair, its eigenbasis as far as it is known, and what is kept with it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any
from weakref import finalize

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.linalg.csr import Csr, Tensors
from torchlb.linalg.exponential import spectral_radius
from torchlb.linalg.sparse import to_scipy
from torchlb.spectral.eigenbasis import Eigenbasis

BASIS = ("eigenvalues", "eigenvectors", "left", "relative_errors")


class PairMatrices(Csr):
    """The weak pair, and that of linear elements beside it.

    Its channels are stiffness K and mass matrix M; on a shape with a boundary the mass matrix B of that; and what a
    condition adds to K.

    Attributes
    ----------
    linear
        The same of linear elements; of no rows where they are the same.
    """

    linear: Csr

    def __init__(
        self,
        crow: Tensor | None = None,
        col: Tensor | None = None,
        values: Tensor | None = None,
        linear: Csr | None = None,
    ) -> None:
        super().__init__(crow, col, values)
        self.linear = Csr() if linear is None else linear
        self._radius: Tensor | None = None

    @property
    def near(self) -> Csr:
        """The matrices of linear elements, close to the pair and 20 times sparser."""
        return self.linear if self.linear.num_rows else self

    @property
    def pair(self) -> tuple[Tensor, Tensor, Tensor]:
        """(crow, col, values (2, nnz)) of K, with what a condition adds to it, and M: what all is computed by."""
        return self.crow, self.col, _with_added(self.values)

    @property
    def linear_pair(self) -> tuple[Tensor, Tensor, Tensor]:
        """As `pair`, of linear elements."""
        return self.near.crow, self.near.col, _with_added(self.near.values)

    def losing(self, fixed: Bool[Tensor, " N"] | None) -> Bool[Tensor, " N"]:
        """Mask of the points where a condition keeps constants out of the null space, of those `fixed` by one, too."""
        diagonal = self.near.row == self.near.col
        found = torch.zeros(self.num_rows, dtype=torch.bool, device=self.col.device)
        if len(self.near.values) > 3:
            found = self.near.values[3, diagonal] > 0
        return found if fixed is None else found | fixed

    @property
    def radius(self) -> Tensor:
        """Bound on the eigenvalues of D⁻¹K₁, the linear pair with lumped mass, for flows beyond the basis.

        1/ℓ², a float64 tensor () on the CPU, which compiled code can take; found once.
        """
        if self._radius is None:
            crow, col, values = self.linear_pair
            shape = self.num_rows, self.num_rows
            stiffness, mass = (to_scipy(crow, col, v.double(), shape) for v in values)
            lumped: Any = mass.sum(axis=1)
            self.known_radius = spectral_radius(stiffness, lumped)
        assert self._radius is not None
        return self._radius

    @property
    def known_radius(self) -> float | None:
        """The same, None where it has not been asked for; it is neither rounded nor moved with the buffers."""
        return None if self._radius is None else float(self._radius)

    @known_radius.setter
    def known_radius(self, radius: float | None) -> None:
        known = None if radius is None else torch.tensor(radius, dtype=torch.float64, device="cpu")
        self._radius = known

    @staticmethod
    def join(records: Sequence[PairMatrices]) -> PairMatrices:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The pairs of shapes, if all have one, and, if any has one of its own, the linear ones."""
        if not all(pair.num_rows for pair in records):
            return PairMatrices()
        whole = Csr.join(records)
        linear = None
        if any(pair.linear.num_rows for pair in records):
            linear = Csr.join([pair.near for pair in records])
        return PairMatrices(whole.crow, whole.col, whole.values, linear)

    def split(self, sizes: Sequence[int]) -> list[PairMatrices]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The inverse of `join`: without what a shape has because others have it."""
        if not self.num_rows:
            return [PairMatrices() for _ in sizes]
        linear = self.linear.split(sizes) if self.linear.num_rows else [None] * len(sizes)
        parts = zip(super().split(sizes), linear, strict=True)
        return [PairMatrices.trimmed(whole, near) for whole, near in parts]

    @staticmethod
    def trimmed(whole: Csr, near: Csr | None = None) -> PairMatrices:
        """A pair without the last matrices where they are zero, and without linear ones that are the same."""
        values = _without_zeros(whole.values)
        if near is not None:
            near = Csr(near.crow, near.col, _without_zeros(near.values))
            same = torch.equal(near.col, whole.col) and torch.equal(near.values, values)
            near = None if same else near
        return PairMatrices(whole.crow, whole.col, values, near)


def _with_added(values: Float[Tensor, "terms nnz"]) -> Float[Tensor, "2 nnz"]:
    """K + R and M, of K, M, B, R; R is what a condition adds, and there is none unless it has been stored."""
    return values[:2] if len(values) < 4 else torch.stack([values[0] + values[3], values[1]])


def _without_zeros(values: Float[Tensor, "terms nnz"]) -> Float[Tensor, "_ nnz"]:
    return values[: 4 if values[3:].any() else 3 if values[2:].any() else 2]


class Modes(Tensors):
    """The eigenpairs that are known.

    Parameters
    ----------
    basis
        They; None for none.
    like
        Of the floating type and on the device of the operator.
    stored
        Whether `state_dict` has them.
    """

    eigenvalues: Tensor
    eigenvectors: Tensor
    left: Tensor
    relative_errors: Tensor

    def __init__(
        self, basis: Eigenbasis | Modes | None, like: Tensor, *, stored: bool = False
    ) -> None:
        none = like.new_zeros(0)
        held = {name: getattr(basis, name, None) for name in BASIS}
        held = {name: none if t is None else t.to(none) for name, t in held.items()}
        super().__init__(held, persistent=stored)
        self.stored = stored
        self._counts = torch.empty(0, 1)  # in the shape of a tensor, since numbers are compiled in

    @property
    def count(self) -> int:
        """Number of pairs of each shape of a batch, but for those that have no more."""
        return self._counts.shape[0]

    def has(self, k: int) -> bool:
        """Whether k pairs of each shape are known, or all that it has."""
        return min(k, self._counts.shape[1]) <= self.count

    def counted(
        self, vectors: Float[Tensor, "N k"], free: Bool[Tensor, " N"], sizes: tuple[int, ...]
    ) -> Modes:
        """Itself, with `count` from the eigenvectors: a batch pads short ones, and there are as many as free points."""
        parts = zip(vectors.split(sizes), free.split(sizes), strict=True)
        counts = [(int((modes != 0).any(0).sum()), int(inside.sum())) for modes, inside in parts]
        most = max(sizes)
        known = min((held for held, all_ in counts if held < all_), default=most)
        self._counts = torch.empty(known, most)
        return self

    def basis(self, mass: Float[Tensor, " N"], sizes: tuple[int, ...] | None) -> Eigenbasis | None:
        """All of them, with the mass and the sizes of the operator; None for none."""
        if len(self.left) == 0:
            return None
        errors = self.relative_errors if len(self.relative_errors) else None
        return Eigenbasis(self.eigenvalues, self.eigenvectors, mass, self.left, sizes, errors)


class OperatorCache:
    """What was computed of an operator and is kept with it, in memory alone: copies and files are without.

    Attributes
    ----------
    values
        Those of the weak pair that all is of; where an operator has others, it has another cache.
    systems
        Linear systems with their factors.
    elements
        Those of the weak pair, once a conductivity has asked for them.
    shapes
        Of a batch its shapes, whose caches serve it, each with the values that it had.
    """

    def __init__(self, values: Tensor) -> None:
        self.values = values
        self.systems: OrderedDict[Any, Any] = OrderedDict()
        self.elements: Any = None
        self.shapes: tuple[tuple[Any, Tensor], ...] = ()
        finalize(self, self.systems.clear)  # cholespy reports factors that outlive Python as leaks
