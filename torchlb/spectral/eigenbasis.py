"""An eigenbasis of −Δ: real functions, orthonormal in the mass, and the way there and back (`method.md`, section 7)."""

from __future__ import annotations

from numbers import Integral
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchlb.errors import InputError
from torchlb.linalg.checks import check_finite, check_tensor


def check_num_pairs(k: object) -> int:
    """k as an int; InputError if it is no number of eigenpairs.

    >>> check_num_pairs(0)
    Traceback (most recent call last):
    torchlb.errors.InputError: k: expected a whole number of eigenpairs, at least 1, got 0
    """
    if isinstance(k, bool) or not isinstance(k, Integral) or k < 1:
        raise InputError(f"k: expected a whole number of eigenpairs, at least 1, got {k!r}")
    return int(k)


@runtime_checkable
class Spectral(Protocol):
    """What has an eigenbasis: an operator of one shape or of a batch."""

    sizes: tuple[int, ...] | None

    @property
    def num_points(self) -> int:
        """Number of points N."""
        ...

    def eigenbasis(self, k: int) -> Eigenbasis:
        """The k smallest eigenpairs of −Δ."""
        ...


class Eigenbasis:
    """Eigenpairs of −Δ: real, ascending, orthonormal in the mass.

    Attributes
    ----------
    eigenvalues : (k,), 1/ℓ², ≥ 0 and ascending, exactly 0 once for every connected component (but one with a Dirichlet
        boundary); (S, k) for a batch of S shapes, each with its own.
    eigenvectors : Φ, (N, k), ΦᵀΠΦ = I; the first is constant. For a batch, those of each shape on its own rows; a
        shape of fewer than k points has zero columns at the end.
    mass : π, (N,), ℓ^d.
    left : W, (N, k), WᵀΦ = I: left eigenvectors of Δ, for the oblique projector ΦWᵀ. Equal to ΠΦ if ΠΔ is symmetric,
        to MΦ for a symmetric pair (K, M).
    sizes : numbers of points of the shapes of a batch; None for a single shape.
    decay_rates : (2, k) or (S, 2, k): real and imaginary parts of the eigenvalues of B = −WᵀΔΦ, in 1/ℓ².
    modal_transform : (3, k, k) or (S, 3, k, k): V, V⁻¹ and JV⁻¹ with BV = V(decay_rates[0] − decay_rates[1] J), J a
        quarter turn in each conjugate pair. Both are there only where the span is invariant: see `is_invariant`.
    is_symmetric : whether they are eigenpairs of a symmetric pair, KΦ = MΦΛ with ΦᵀMΦ = I. Coefficients are then those
        of the full mass matrix, decay rates the eigenvalues, every part of the span is invariant, and the two above
        are None.
    relative_errors : (k,) or (S, k), estimates for the eigenvalues of a symmetric pair; None if they were not made. NaN
        for the other shapes of a batch of both kinds, in which those of a pair have the two above, too.
    """

    def __init__(
        self,
        eigenvalues: Float[Tensor, "*S k"],
        eigenvectors: Float[Tensor, "N k"],
        mass: Float[Tensor, " N"],
        left: Float[Tensor, "N k"],
        sizes: tuple[int, ...] | None = None,
        decay_rates: Float[Tensor, "*S 2 k"] | None = None,
        modal_transform: Float[Tensor, "*S 3 k k"] | None = None,
        *,
        is_symmetric: bool = False,
        relative_errors: Float[Tensor, "*S k"] | None = None,
    ) -> None:
        self.eigenvalues, self.eigenvectors = eigenvalues, eigenvectors
        self.mass, self.left, self.sizes = mass, left, sizes
        self.decay_rates, self.modal_transform = decay_rates, modal_transform
        self.is_symmetric, self.relative_errors = is_symmetric, relative_errors

    def __repr__(self) -> str:
        n, k = self.eigenvectors.shape
        shapes = "" if self.sizes is None else f", {len(self.sizes)} shapes"
        last = float(self.eigenvalues.max()) if k else 0.0
        return f"Eigenbasis({k} pairs of {n} points{shapes}, eigenvalues 0 to {last:.4g})"

    @property
    def is_invariant(self) -> bool:
        """Whether the span is invariant under Δ, and the exact e^{tΔ} on it is at hand."""
        return self.is_symmetric or self.modal_transform is not None

    def truncate(self, k: int) -> Eigenbasis:
        """The first k of the pairs; itself if there are no more."""
        if k >= self.eigenvectors.shape[1]:
            return self
        cut = (self.eigenvalues[..., :k], self.eigenvectors[:, :k], self.mass, self.left[:, :k])
        errors = None if self.relative_errors is None else self.relative_errors[..., :k]
        symmetric = {"is_symmetric": self.is_symmetric, "relative_errors": errors}
        return Eigenbasis(*cut, sizes=self.sizes, **symmetric)

    def to_basis(
        self, f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"]
    ) -> Float[Tensor, "*S k C"] | Float[Tensor, "*S k"]:
        """Coefficients Φᵀ(πf), ΦᵀMf for a symmetric pair, (…, k, C), or (…, S, k, C) for a batch of shapes.

        (k,), or (S, k), for f (N,). In the type of f, that of the basis where f are integers; computed in that of f,
        at least float32. InputError for another number of points, and for NaN or infinity in f.
        """
        coefficients = self.analyse(self.functionals, f)
        check_finite(f)
        return coefficients

    def to_basis_obliquely(
        self, f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"]
    ) -> Float[Tensor, "*S k C"] | Float[Tensor, "*S k"]:
        """Coefficients Wᵀf: zero on every left-over eigenvector of Δ, which Φᵀ(πf) is not."""
        coefficients = self.analyse(self.left, f)
        check_finite(f)
        return coefficients

    @property
    def functionals(self) -> Float[Tensor, "N k"]:
        """ΠΦ, or MΦ for a symmetric pair: what `to_basis` multiplies by."""
        return self.left if self.is_symmetric else self.mass[:, None] * self.eigenvectors

    def from_basis(
        self, coefficients: Shaped[Tensor, "*S k C"] | Shaped[Tensor, "*S k"]
    ) -> Float[Tensor, "*B N C"] | Float[Tensor, " N"]:
        """The function Φc with the given coefficients, (…, N, C), or (N,) for (k,) or (S, k).

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
        """Σ_k functions[:, k] c_k, with the coefficients of its own shape at every point."""
        if torch.is_autocast_enabled(coefficients.device.type):
            with torch.autocast(coefficients.device.type, enabled=False):
                return self.synthesise(functions, coefficients)
        functions, c, dtype = self._typed(functions, coefficients)
        if self.sizes is None:
            return (functions @ c).to(dtype)
        parts = zip(functions.split(self.sizes), c.unbind(-3), strict=True)
        return torch.cat([block @ column for block, column in parts], dim=-2).to(dtype)

    def analyse(
        self, functionals: Float[Tensor, "N k"], f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"]
    ) -> Tensor:
        """Σ_i functionals[i] f_i, over the points of each shape. NaN in f pass on, and no GPU is waited for."""
        check_tensor(f)
        if f.ndim == 1:
            return self.analyse(functionals, f[:, None])[..., 0]
        if f.shape[-2:-1] != self.mass.shape:
            raise InputError(
                f"expected f of shape (N,) or (…, N, C) with N = {len(self.mass)}, got {tuple(f.shape)}"
            )
        if torch.is_autocast_enabled(f.device.type):
            with torch.autocast(f.device.type, enabled=False):
                return self.analyse(functionals, f)
        functionals, f, dtype = self._typed(functionals, f)
        if self.sizes is None:
            return (functionals.mT @ f).to(dtype)
        parts = zip(functionals.split(self.sizes), f.split(self.sizes, dim=-2), strict=True)
        return torch.stack([block.mT @ g for block, g in parts], dim=-3).to(dtype)

    @staticmethod
    def _typed(functions: Tensor, f: Tensor) -> tuple[Tensor, Tensor, torch.dtype]:
        """Both in the type to multiply in, that of f and at least float32, and the type of the result.

        Integers and masks are of the type of the basis. In half precision masses and functions of small shapes are 0.
        """
        dtype = f.dtype if f.is_floating_point() or f.is_complex() else functions.dtype
        wide = torch.promote_types(dtype, torch.float32)
        return functions.to(wide), f.to(wide), dtype


def unstack_eigenbases(basis: Eigenbasis) -> list[Eigenbasis]:
    """The basis of each shape of a batch, without the padding: the inverse of `stack_eigenbases`."""
    if basis.sizes is None:
        return [basis]
    parts = []
    columns = [t.split(basis.sizes) for t in (basis.eigenvectors, basis.mass, basis.left)]
    for s, (vectors, mass, left) in enumerate(zip(*columns, strict=True)):
        k = int((vectors != 0).any(0).sum())
        pairs = (basis.eigenvalues[s, :k], vectors[:, :k], mass, left[:, :k])
        errors = None if basis.relative_errors is None else basis.relative_errors[s, :k]
        if errors is not None and not errors.isnan().any():
            parts.append(Eigenbasis(*pairs, is_symmetric=True, relative_errors=errors))
        elif basis.decay_rates is None or basis.modal_transform is None:
            parts.append(Eigenbasis(*pairs, is_symmetric=basis.is_symmetric))
        else:
            modes = (basis.decay_rates[s, :, :k], basis.modal_transform[s, :, :k, :k])
            parts.append(Eigenbasis(*pairs, None, *modes))
    return parts


def stack_eigenbases(bases: list[Eigenbasis]) -> Eigenbasis:
    """One basis of a batch from those of its shapes, padded to the longest by zero columns."""
    k = max(basis.eigenvectors.shape[1] for basis in bases)

    def padded(t: Tensor, sides: int) -> Tensor:
        return torch.nn.functional.pad(t, (0, k - t.shape[-1]) * sides)

    def extended(t: Tensor) -> Tensor:
        return torch.cat([t, t[-1:].expand(k - len(t))])

    is_symmetric = all(basis.is_symmetric for basis in bases)
    decay_rates = modal_transform = relative_errors = None
    if any(basis.relative_errors is not None for basis in bases):
        unknown = torch.nan * bases[0].eigenvalues
        errors = [unknown[:1] if b.relative_errors is None else b.relative_errors for b in bases]
        relative_errors = torch.stack([extended(each) for each in errors])
    if all(basis.is_invariant for basis in bases) and not is_symmetric:
        modes = [_modes(basis) for basis in bases]
        decay_rates = torch.stack([padded(rates, 1) for rates, _ in modes])
        modal_transform = torch.stack([padded(transform, 2) for _, transform in modes])
    return Eigenbasis(
        torch.stack([extended(b.eigenvalues) for b in bases]),
        torch.cat([padded(b.eigenvectors, 1) for b in bases]),
        torch.cat([b.mass for b in bases]),
        torch.cat([padded(b.left, 1) for b in bases]),
        tuple(len(b.mass) for b in bases),
        decay_rates,
        modal_transform,
        is_symmetric=is_symmetric,
        relative_errors=relative_errors,
    )


def _modes(basis: Eigenbasis) -> tuple[Tensor, Tensor]:
    """Decay rates and modal transform; of a symmetric pair the eigenvalues and 1, 1, 0."""
    if basis.decay_rates is not None and basis.modal_transform is not None:
        return basis.decay_rates, basis.modal_transform
    rates = basis.eigenvalues
    one = torch.eye(len(rates)).to(rates)
    return torch.stack([rates, 0 * rates]), torch.stack([one, one, 0 * one])
