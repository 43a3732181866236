"""An eigenbasis of −Δ: real functions, orthonormal in the mass; analysis and synthesis (`method.md`, section 7)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchlb.errors import InputError, shown
from torchlb.linalg.checks import check_finite, check_tensor, takes_arrays


def check_num_pairs(k: object) -> int:
    """Return k as an int; InputError unless it is a number of eigenpairs.

    >>> check_num_pairs(0)
    Traceback (most recent call last):
    torchlb.errors.InputError: k: expected a whole number of eigenpairs, at least 1, got 0
    """
    if isinstance(k, bool) or not isinstance(k, Integral) or k < 1:
        raise InputError(f"k: expected a whole number of eigenpairs, at least 1, got {shown(k)}")
    return int(k)


@runtime_checkable
class Spectral(Protocol):
    """An object with an eigenbasis: an operator of one shape or of a batch."""

    def eigenbasis(self, k: int) -> Eigenbasis:
        """The k smallest eigenpairs of −Δ."""
        ...


@dataclass(eq=False)
class Eigenbasis:
    """Eigenpairs of −Δ, K φ = λ M φ: real, ascending, orthonormal in M.

    Attributes
    ----------
    eigenvalues
        (k,), 1/ℓ², ≥ 0 and ascending, exactly 0 once for every connected component (except those with a Dirichlet or
        Robin condition); (S, k) for a batch of S shapes, each with its own.
    eigenvectors
        Φ, (N, k), ΦᵀMΦ = I; the first is constant where its eigenvalue is 0. In a batch each shape has its eigenvectors
        on its own rows; a shape with fewer than k pairs has zero columns at the end.
    mass
        (N,), ℓ^d: the weights of the operator.
    left
        MΦ, (N, k): its transpose maps functions to coefficients.
    sizes
        Numbers of points of the shapes of a batch; None for a single shape.
    relative_errors
        (k,) or (S, k), estimates for the eigenvalues; None without estimates.
    """

    eigenvalues: Float[Tensor, "*S k"]
    eigenvectors: Float[Tensor, "N k"]
    mass: Float[Tensor, " N"]
    left: Float[Tensor, "N k"]
    sizes: tuple[int, ...] | None = None
    relative_errors: Float[Tensor, "*S k"] | None = None

    def __repr__(self) -> str:
        n, k = self.eigenvectors.shape
        shapes = "" if self.sizes is None else f", {len(self.sizes)} shapes"
        last = float(self.eigenvalues.max()) if k else 0.0
        return f"Eigenbasis({k} pairs of {n} points{shapes}, eigenvalues 0 to {last:.4g})"

    def __iter__(self) -> Iterator[Tensor]:
        """Eigenvalues and eigenvectors, as in ``values, vectors = lb.eigenbasis(k)``."""
        return iter((self.eigenvalues, self.eigenvectors))

    def truncate(self, k: int) -> Eigenbasis:
        """The first k of the pairs; the basis itself if it has no more."""
        if k >= self.eigenvectors.shape[1]:
            return self
        cut = (self.eigenvalues[..., :k], self.eigenvectors[:, :k], self.mass, self.left[:, :k])
        errors = None if self.relative_errors is None else self.relative_errors[..., :k]
        return Eigenbasis(*cut, sizes=self.sizes, relative_errors=errors)

    @takes_arrays
    def to_basis(
        self, f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"]
    ) -> Float[Tensor, "*S k C"] | Float[Tensor, "*S k"]:
        """Coefficients ΦᵀMf, (…, k, C), or (…, S, k, C) for a batch of shapes.

        (k,), or (S, k), for f (N,). In the type of f, that of the basis where f are integers; computed in that of f, at
        least float32. InputError for another number of points, and for NaN or infinity in f.
        """
        coefficients = self.analyse(f)
        check_finite(f)
        return coefficients

    @takes_arrays
    def from_basis(
        self, coefficients: Shaped[Tensor, "*S k C"] | Shaped[Tensor, "*S k"]
    ) -> Float[Tensor, "*B N C"] | Float[Tensor, " N"]:
        """The function Φc with the coefficients c, (…, N, C), or (N,) for (k,) or (S, k).

        In the type of the coefficients, as for `to_basis`; InputError for another number of them.
        """
        check_tensor(coefficients, "coefficients")
        if coefficients.ndim == self.eigenvalues.ndim:
            return self.from_basis(coefficients[..., None])[..., 0]
        rows = self.eigenvalues.shape
        if coefficients.shape[-1 - len(rows) : -1] != rows:
            raise InputError(
                f"expected coefficients of shape {(*rows,)} or (…, {', '.join(map(str, rows))}, C), got "
                f"{tuple(coefficients.shape)}"
            )
        return self.synthesise(self.eigenvectors, coefficients)

    def synthesise(
        self, functions: Float[Tensor, "N k"], coefficients: Shaped[Tensor, "*S k C"]
    ) -> Float[Tensor, "*B N C"]:
        """Σ_k functions[:, k] c_k; in a batch, with the coefficients of each point's shape."""
        functions, c, dtype = self._typed(functions, coefficients)
        with torch.autocast(c.device.type, enabled=False):
            if self.sizes is None:
                return (functions @ c).to(dtype)
            parts = zip(functions.split(self.sizes), c.unbind(-3), strict=True)
            return torch.cat([block @ column for block, column in parts], dim=-2).to(dtype)

    def analyse(self, f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"]) -> Tensor:
        """The coefficients of `to_basis`, where NaN in f propagate, without waiting for a GPU."""
        check_tensor(f)
        if f.ndim == 1:
            return self.analyse(f[:, None])[..., 0]
        if f.shape[-2:-1] != self.mass.shape:
            raise InputError(
                f"expected f of shape (N,) or (…, N, C) with N = {len(self.mass)}, got {tuple(f.shape)}"
            )
        left, f, dtype = self._typed(self.left, f)
        with torch.autocast(f.device.type, enabled=False):
            if self.sizes is None:
                return (left.mT @ f).to(dtype)
            parts = zip(left.split(self.sizes), f.split(self.sizes, dim=-2), strict=True)
            return torch.stack([block.mT @ g for block, g in parts], dim=-3).to(dtype)

    @staticmethod
    def _typed(functions: Tensor, f: Tensor) -> tuple[Tensor, Tensor, torch.dtype]:
        """The factors in the type to multiply in, that of f and at least float32, and the type of the result.

        Integers and masks take the type of the basis. In half precision, masses and functions of small shapes are 0.
        """
        dtype = f.dtype if f.is_floating_point() or f.is_complex() else functions.dtype
        wide = torch.promote_types(dtype, torch.float32)
        return functions.to(wide), f.to(wide), dtype


def unstack_eigenbases(basis: Eigenbasis) -> list[Eigenbasis]:
    """The basis of each shape of a batch, without the padding: inverse of `stack_eigenbases`."""
    if basis.sizes is None:
        return [basis]
    parts = []
    columns = [t.split(basis.sizes) for t in (basis.eigenvectors, basis.mass, basis.left)]
    for s, (vectors, mass, left) in enumerate(zip(*columns, strict=True)):
        errors = None if basis.relative_errors is None else basis.relative_errors[s]
        part = Eigenbasis(basis.eigenvalues[s], vectors, mass, left, relative_errors=errors)
        parts.append(part.truncate(int((vectors != 0).any(0).sum())))
    return parts


def stack_eigenbases(bases: list[Eigenbasis]) -> Eigenbasis:
    """The basis of a batch from those of its shapes, padded to the longest by zero columns."""
    k = max(basis.eigenvectors.shape[1] for basis in bases)

    def padded(t: Tensor) -> Tensor:
        return torch.nn.functional.pad(t, (0, k - t.shape[-1]))

    def extended(t: Tensor) -> Tensor:
        return torch.cat([t, t[-1:].expand(k - len(t))])

    errors = [extended(b.relative_errors) for b in bases if b.relative_errors is not None]
    return Eigenbasis(
        torch.stack([extended(b.eigenvalues) for b in bases]),
        torch.cat([padded(b.eigenvectors) for b in bases]),
        torch.cat([b.mass for b in bases]),
        torch.cat([padded(b.left) for b in bases]),
        tuple(len(b.mass) for b in bases),
        torch.stack(errors) if len(errors) == len(bases) else None,
    )
