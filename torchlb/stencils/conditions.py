"""Boundary conditions, a class each, with their effect on rows and on the weak pair (`method.md`, 6 and 9)."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.errors import InputError, first_few
from torchlb.linalg.precision import LOW
from torchlb.stencils.rows import Rows


class Condition:
    """No condition, with one-sided stencils at the boundary; base class of all conditions.

    Attributes
    ----------
    name
        Name under which the class is registered, for options, files and messages.
    conserves
        Whether constants are preserved: rows sum to zero, and K1 = 0.
    fixes
        Whether values at the boundary are zero: solves remove rows and columns there.
    share
        a ≥ 0 of ∂_ν f + a f = 0, 1/ℓ, a number or one per point: stencils use it as data, and K gains a along the
        boundary. None without such data.
    data
        The one argument of the constructor, numbers and lists; None where it takes none.
    """

    known: ClassVar[dict[str | None, type[Condition]]] = {}
    name: ClassVar[str] = "none"
    conserves: ClassVar[bool] = True
    fixes: ClassVar[bool] = False
    share: float | Float[Tensor, " N"] | None = None
    data: Any = None

    def __init_subclass__(cls) -> None:
        if "name" in cls.__dict__:
            Condition.known[cls.name] = cls

    @property
    def plain(self) -> str | dict[str, Any]:
        """The condition in plain types: its name, or {name: data}."""
        return self.name if self.data is None else {self.name: self.data}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Condition) and self.plain == other.plain

    def __hash__(self) -> int:
        return hash(str(self.plain))

    def __repr__(self) -> str:
        return repr(self.plain)

    def taken(self, points: Int[Tensor, " N"], count: int) -> Condition:
        """Condition of the points in another order; InputError unless it has one value, or one per point, `count`."""
        if not isinstance(self.share, Tensor):
            return self
        if len(self.share) != count:
            raise InputError(
                f"{self!r}: expected one a, or one of each of {count} points, got {len(self.share)}"
            )
        other = copy(self)
        other.share = self.share.to(points.device)[points]
        return other

    def absorption(self, on_boundary: Bool[Tensor, " N"]) -> Float[Tensor, " N"] | None:
        """a at the points of the boundary, zero at the others, 1/ℓ; None without data."""
        if self.share is None:
            return None
        share = torch.as_tensor(self.share, dtype=torch.float64, device=on_boundary.device)
        return share * on_boundary

    def finish(self, shape: Any, centers: Int[Tensor, " B"], rows: Rows) -> Rows:
        """Adapt the rows of a `Shape`: low-order ones, without data, lose a f over their share of the boundary."""
        if self.share is None or self.conserves:
            return rows
        lost = self.share * shape.boundary.sizes / shape.areas
        own = (centers[rows.row] == rows.col) & (rows.order == 0)[rows.row]
        return replace(rows, laplacian=rows.laplacian - torch.where(own, lost[rows.col], 0.0))


Condition.known[None] = Condition


class Neumann(Condition):
    """∂_ν f = 0."""

    name = "neumann"
    share = 0.0


class Dirichlet(Condition):
    """f = 0: no entry couples a boundary point to another point.

    The diagonal entry of a boundary point is −4d/h², as for the fastest wave of a grid; h is the distance to the
    nearest point, but at least `LOW` times that to the farthest in the row.
    """

    name = "dirichlet"
    conserves = False
    fixes = True

    def finish(self, shape: Any, centers: Int[Tensor, " B"], rows: Rows) -> Rows:
        """Decouple the rows from the boundary."""
        points, mask, dim = shape.points, shape.boundary.mask, rows.gradient.shape[1]
        local, row, col = rows.row, centers[rows.row], rows.col
        square = (points[col] - points[row]).square().sum(1)
        farthest = square.new_zeros(len(centers)).scatter_reduce(0, local, square, "amax")
        square = torch.where(row == col, torch.inf, square)
        nearest = farthest.scatter_reduce(0, local, square, "amin").maximum(LOW**2 * farthest)
        nearest = torch.where(nearest > 0, nearest, 1.0)  # a row of coincident points has no scale
        kept = torch.where(mask[row] | mask[col], 0.0, rows.laplacian)
        own = mask[row] & (row == col)
        return replace(rows, laplacian=torch.where(own, -4 * dim / nearest[local], kept))


class Robin(Condition):
    """κ∂_ν f + a f = 0: the flux out through the boundary is a ≥ 0 times f.

    Parameters
    ----------
    a
        In units of κ/ℓ: a number, or one per point, of which those off the boundary are ignored. 0 is Neumann's
        condition, and a → ∞ Dirichlet's. First order where a jumps.

    Raises InputError for anything else, and for values that are negative or not finite.

    >>> Robin(2.0)
    Robin(2.0)
    """

    name = "robin"
    conserves = False

    def __init__(self, a: Any) -> None:
        try:
            share = torch.as_tensor(a, dtype=torch.float64).detach().cpu()
        except (TypeError, ValueError, RuntimeError) as error:
            raise InputError(
                f"Robin: expected a number, or one of each point, got {a!r}"
            ) from error
        if share.ndim > 1:
            raise InputError(
                f"Robin: expected a number, or one of each point, (N,), got {tuple(share.shape)}"
            )
        bad = (~((share >= 0) & share.isfinite())).reshape(-1).nonzero()[:, 0]
        if len(bad):
            where = f" at {len(bad)} points ({first_few(bad)})" if share.ndim else ""
            raise InputError(
                f"Robin: expected finite a ≥ 0, got {float(share.reshape(-1)[bad[0]]):.3g}{where}; with a < 0 more "
                "comes in the more there is, and Δ may have positive eigenvalues"
            )
        self.data, self.share = share.tolist(), share if share.ndim else float(share)

    def __repr__(self) -> str:
        many = isinstance(self.data, list)
        return f"Robin(a of {len(self.data)} points)" if many else f"Robin({self.data})"


ConditionName = Literal["neumann", "dirichlet"]


def condition_of(given: Any) -> Condition | None:
    """Condition of a name or of plain types; a condition itself, and None, are returned. InputError for anything else.

    >>> condition_of({"robin": 2.0})
    Robin(2.0)
    """
    if given is None or isinstance(given, Condition):
        return given
    if isinstance(given, str) and given in Condition.known:
        kind = Condition.known[given]
        if kind.__init__ is object.__init__:
            return kind()
    elif isinstance(given, Mapping) and kind_of(given) is not Condition:
        return kind_of(given)(*given.values())  # pyright: ignore[reportCallIssue]
    known = [
        repr(kind.name) if kind.__init__ is object.__init__ else f"{kind.__name__}(…)"
        for name, kind in Condition.known.items()
        if name is not None
    ]
    raise InputError(f"condition: expected {', '.join(known)} or None, got {given!r}")


def kind_of(plain: str | Mapping[str, Any] | None) -> type[Condition]:
    """The class of a condition in plain types.

    >>> kind_of("dirichlet").fixes
    True
    """
    name = next(iter(plain), "") if isinstance(plain, Mapping) else plain
    if name not in Condition.known:
        raise InputError(f"condition: {name!r} is none; a class of yours has to be imported first")
    return Condition.known[name]
