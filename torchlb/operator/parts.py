"""Parts of an operator: matrices of its weak pair, the known part of its eigenbasis, and its cache."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.galerkin.medium import Field
from torchlb.linalg.csr import Csr, Tensors, tensors_of
from torchlb.linalg.exponential import spectral_radius
from torchlb.linalg.sparse import to_scipy
from torchlb.spectral.eigenbasis import Eigenbasis

FIT_FIELDS = ("fit_degree", "fit_reason", "edges", "curved_edges")
REAL_FIELDS = ("growth", "condition", "off_diagonal_ratio")
ROW_FIELDS = ("order", "normal_order", "num_neighbors", *REAL_FIELDS, "rule", "reason")
BASIS = ("eigenvalues", "eigenvectors", "left", "relative_errors")


class PairMatrices(Csr):
    """The weak pair, and that of P1 elements beside it.

    Channels are the stiffness K and the mass matrix M; with a boundary its mass matrix B; what a condition adds to K;
    what a potential adds to K.

    Attributes
    ----------
    linear
        The same matrices of P1 elements; without rows where they are equal to the pair.
    of_functions
        Whether constants are in the kernel of K without its additions; False for tangent fields.
    """

    linear: Csr

    def __init__(
        self,
        crow: Tensor | None = None,
        col: Tensor | None = None,
        values: Tensor | None = None,
        linear: Csr | None = None,
        *,
        of_functions: bool = True,
    ) -> None:
        super().__init__(crow, col, values)
        self.linear = Csr() if linear is None else linear
        self.of_functions = of_functions
        self.set_radius(None)

    @property
    def has_boundary(self) -> bool:
        """Whether the shape has a boundary."""
        return len(self.values) > 2 and bool(self.values[2].any())

    @property
    def near(self) -> Csr:
        """The matrices of P1 elements, close to the pair and 20 times sparser."""
        return self.linear if self.linear.num_rows else self

    @property
    def pair(self) -> tuple[Tensor, Tensor, Tensor]:
        """(crow, col, values (2, nnz)) of K, with what is added to it, and of M: the pair in every computation."""
        return self.crow, self.col, _with_added(self.values)

    @property
    def linear_pair(self) -> tuple[Tensor, Tensor, Tensor]:
        """As `pair`, of P1 elements."""
        return self.near.crow, self.near.col, _with_added(self.near.values)

    def losing(self, fixed: Bool[Tensor, " N"] | None) -> Bool[Tensor, " N"]:
        """Mask of the points where a condition or a potential keeps constants from the kernel of K; `fixed` too."""
        found = torch.full((self.num_rows,), not self.of_functions, device=self.col.device)
        if not self.of_functions:
            return found
        if len(self.near.values) > 3:
            found = self.near.values[3:, self.near.row == self.near.col].sum(0) > 0
        return found if fixed is None else found | fixed

    @property
    def radius(self) -> Float[Tensor, ""]:
        """Bound on the eigenvalues of D⁻¹K₁, the P1 pair with lumped mass, for flows beyond the basis, 1/ℓ².

        A float64 tensor on the CPU, computed once, which compiled code can take; neither rounded nor moved.
        """
        if self._radius is None:
            crow, col, values = self.linear_pair
            shape = self.num_rows, self.num_rows
            stiffness, mass = (to_scipy(crow, col, v.double(), shape) for v in values)
            lumped: Any = mass.sum(axis=1)
            self.set_radius(spectral_radius(stiffness, lumped))
        known: Any = self._radius
        return known

    def set_radius(self, radius: float | None) -> None:
        """Set the radius where it is known."""
        known = None if radius is None else torch.tensor(radius, dtype=torch.float64, device="cpu")
        self._radius = known

    @staticmethod
    def join(records: Sequence[PairMatrices]) -> PairMatrices:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The joint pair of several shapes, if all have one; with P1 matrices if any shape has its own."""
        if not all(pair.num_rows for pair in records):
            return PairMatrices()
        whole, linear = Csr.join(records), None
        if any(pair.linear.num_rows for pair in records):
            linear = Csr.join([pair.near for pair in records])
        kind = records[0].of_functions
        return PairMatrices(whole.crow, whole.col, whole.values, linear, of_functions=kind)

    def split(self, sizes: Sequence[int]) -> list[PairMatrices]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Inverse of `join`, without matrices that a shape has only because others do."""
        if not self.num_rows:
            return [PairMatrices() for _ in sizes]
        linear = self.linear.split(sizes) if self.linear.num_rows else [None] * len(sizes)
        parts = zip(super().split(sizes), linear, strict=True)
        return [PairMatrices.trimmed(whole, near) for whole, near in parts]

    @staticmethod
    def trimmed(whole: Csr, near: Csr | None = None) -> PairMatrices:
        """A pair without trailing matrices that are zero, and without P1 matrices that are equal to it."""
        values = _without_zeros(whole.values)
        if near is not None:
            near = Csr(near.crow, near.col, _without_zeros(near.values))
            same = torch.equal(near.col, whole.col) and torch.equal(near.values, values)
            near = None if same else near
        return PairMatrices(whole.crow, whole.col, values, near)


def _with_added(values: Float[Tensor, "terms nnz"]) -> Float[Tensor, "2 nnz"]:
    """K + R + C and M, from K, M, B, R, C; R of a condition and C of a potential are there only if needed."""
    return (
        values[:2] if len(values) < 4 else torch.stack([values[0] + values[3:].sum(0), values[1]])
    )


def _without_zeros(values: Float[Tensor, "terms nnz"]) -> Float[Tensor, "_ nnz"]:
    count = len(values)
    while count > 2 and not values[count - 1].any():
        count -= 1
    return values[:count]


class MediumFields(Tensors):
    """The fields of a medium by `FieldName`; those that were not given are not there, also in a state."""

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *given: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._buffers.clear()
        for key in state_dict:
            if key.startswith(prefix):
                self.register_buffer(key.removeprefix(prefix), torch.zeros(0))
        super()._load_from_state_dict(state_dict, prefix, *given)

    def fields(self, num_points: int) -> dict[str, Field]:
        """The fields, which are on the faces where there are not as many as points."""
        return {
            name: Field(values, len(values) != num_points, name != "potential")
            for name, values in tensors_of(self).items()
        }


class Modes(Tensors):
    """The known eigenpairs of a basis or of other modes; `stored` says whether `state_dict` has them.

    They are of the type and on the device of `like`.
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
        self._counts = torch.empty(0, 1)  # a shape, since torch.compile specialises on numbers

    @property
    def count(self) -> int:
        """Number of known pairs of each shape of a batch, except shapes that have no more."""
        return self._counts.shape[0]

    def has(self, k: int) -> bool:
        """Whether k pairs of each shape are known, or all that it has."""
        return min(k, self._counts.shape[1]) <= self.count

    def set_count(
        self, vectors: Float[Tensor, "N k"], free: Bool[Tensor, " N"], sizes: tuple[int, ...]
    ) -> None:
        """Set `count`, the pairs known of every shape, all that the free points allow where these are fewer.

        Columns of the eigenvectors that are zero on a shape are padding there.
        """
        parts = zip(vectors.split(sizes), free.split(sizes), strict=True)
        counts = [(int((modes != 0).any(0).sum()), int(inside.sum())) for modes, inside in parts]
        most = max(sizes)
        self._counts = torch.empty(
            min([held for held, all_ in counts if held < all_] + [most]), most
        )


class OperatorCache:
    """Results that are computed once and kept with an operator, in memory only: copies and files lack them.

    Attributes
    ----------
    values
        Values of the weak pair that the results belong to; an operator with other values gets a new cache.
    system, elements, connection
        The linear system with its factors; elements of the weak pair, made for the first medium; tangent fields.
    shapes
        Shapes of a batch, whose caches serve it, each with the values that it had.
    """

    def __init__(self, values: Tensor) -> None:
        self.values = values
        self.system: Any = None
        self.elements: Any = None
        self.connection: Any = None
        self.shapes: tuple[tuple[Any, Tensor], ...] = ()
