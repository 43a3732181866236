"""The matrices of a weak pair: K and M, B along the boundary, and what conditions and potentials add to K."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.geometry.boundary import open_sides
from torchlb.geometry.vectors import Points
from torchlb.linalg.csr import Csr
from torchlb.linalg.precision import LOW


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

    @property
    def root_of_absorption(self) -> Float[Tensor, "N 1"] | None:
        """√a of Robin's condition, from R_ii = a_i B_ii; None for another condition."""
        if not self.values[3:4].any():
            return None
        values = self.values[:, self.row == self.col].double()
        a = torch.where(values[2] != 0, values[3] / values[2], 0.0)
        return a.clamp_min(0).sqrt()[:, None]

    def losing(self, fixed: Bool[Tensor, " N"] | None) -> Bool[Tensor, " N"]:
        """Mask of the points where a condition or a potential keeps constants from the kernel of K; `fixed` too."""
        found = torch.full((self.num_rows,), not self.of_functions, device=self.col.device)
        if not self.of_functions:
            return found
        if len(self.near.values) > 3:
            found = self.near.values[3:, self.near.row == self.near.col].sum(0) > 0
        return found if fixed is None else found | fixed

    def absorbing(
        self, points: Points, cells: Int[Tensor, "F corners"], a: Float[Tensor, " N"]
    ) -> PairMatrices:
        """The matrices with R_ij = B_ij √(a_i a_j), a ≥ 0 at the boundary vertices, of κ∂_ν f + a f = 0.

        R is positive semidefinite for every a ≥ 0, equals aB for constant a, and is as accurate as B where a is smooth
        and positive. B has entries inside where fits along the boundary of a solid, or coarse triangles, reach there:
        these have the a of the nearest boundary vertex. P1 elements take B lumped to its row sums, but at least to a
        tenth of its absolute row sums.
        """
        edge = open_sides(cells)[0].unique()
        if len(self.values) < 3 or not (a[edge] > 0).any():
            return self
        nearest = KDTree(points[edge].cpu().numpy()).query(points.cpu().numpy())[1]
        a = a[edge][torch.from_numpy(nearest).to(edge)].index_copy(0, edge, a[edge])
        boundary, near = self.values[2], self.linear
        sums, sizes = (
            torch.zeros_like(a).index_add(0, self.row, b) for b in (boundary, boundary.abs())
        )
        if near.num_rows:
            lumped = torch.where(near.row == near.col, sums.maximum(LOW * sizes)[near.row], 0.0)
            values = torch.stack([*near.values, lumped, lumped * a[near.row]])
            near = Csr(near.crow, near.col, values)
        added = boundary * (a[self.row] * a[self.col]).sqrt()
        return PairMatrices(self.crow, self.col, torch.stack([*self.values, added]), near)

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
