r"""Eigenpairs of −Δ from an operator that is not symmetric (`method.md`, section 7).

Let A = −L in the inner product of the mass π. The span of its k slowest right eigenvectors is orthonormalised in π, and
Rayleigh–Ritz is done there: the eigenvectors of the symmetric part of ΦᵀΠAΦ give a real basis of functions, ascending,
ΦᵀΠΦ = I, which keeps the order of L. (Symmetrising L itself would lose it.) Beside it stand the left eigenvectors W of
the same eigenvalues, WᵀΦ = I: the oblique projector ΦWᵀ commutes with L, so that e^{tL} acts on the span and on the
rest apart; and the exact action on the span, e^{−tB} with B = WᵀAΦ, through the eigenvectors of the small matrix B.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import linalg, sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import ArpackError, LinearOperator, eigs
from torch import Tensor

from torchlb.errors import EigenbasisError, StabilityError
from torchlb.linalg.factor import factorized
from torchlb.linalg.krylov import backward_error
from torchlb.spectral.eigenbasis import Eigenbasis, stack_eigenbases
from torchlb.stability.null_vector import (
    CONSERVED,
    has_outflow,
    left_null_vector,
    shared_outflow,
)

DENSE = 400
"""Up to this many points a dense solve is as fast, and never fails."""
SHIFT = 1e-9
"""Of the inverted operator, in units of its diagonal; the constants are projected out, so that it may be tiny."""
GAP = 1e-7
"""Eigenvalues closer than this, relatively, are not separated: conjugate pairs and exact multiplicities stay whole."""
CONDITION = 1e8
"""Of the eigenvectors of B; beyond it e^{−tB} through them has no digits left in float32."""

SINGULAR = "eigenbasis: the operator on {} points is singular beyond its constants; build it with certify=True"


def blockwise_eigenbasis(
    matrix: sparse.csr_array,
    mass: Float[Tensor, " N"],
    k: int,
    sizes: tuple[int, ...] | None,
    **options: Any,
) -> Eigenbasis:
    """As `solve_eigenbasis`, of every diagonal block of the given sizes by itself; None: of the whole."""
    if sizes is None:
        return solve_eigenbasis(matrix, mass, k, **options)
    ends = np.cumsum(sizes)
    blocks = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    return stack_eigenbases([solve_eigenbasis(matrix[b, b], mass[b], k, **options) for b in blocks])


@dataclass
class _Part:
    """One connected component: A scaled to the inner product of the mass, and its slow eigenvectors as found."""

    index: np.ndarray
    matrix: sparse.csr_array
    root: np.ndarray
    null_left: np.ndarray | None  # times √mass/|√mass| it is 1; None where there is outflow
    right: tuple[np.ndarray, np.ndarray]
    left: tuple[np.ndarray, np.ndarray]

    @property
    def complete(self) -> bool:
        return len(self.right[0]) == len(self.index) - (self.null_left is not None)


def solve_eigenbasis(
    matrix: sparse.csr_array,
    mass: Float[Tensor, " N"],
    k: int,
    *,
    outflow: bool = False,
    rounding: float = 0.0,
) -> Eigenbasis:
    """The k smallest eigenpairs of −Δ, and a few more where pairs would be split: an invariant span, in float64.

    Parameters
    ----------
    matrix : Δ, (N, N).
    mass : inner product; π of the certificate.
    k : number of pairs; all N if there are fewer.
    outflow : whether rows may have a sum below zero, as beside a Dirichlet boundary. All others sum to zero up to
        `rounding`, relative, which is removed.

    Raises
    ------
    EigenbasisError : where the iteration does not converge, or the operator has a mode that grows.
    """
    a = -sparse.csr_array(matrix, dtype=np.float64, copy=True)
    a.eliminate_zeros()
    open_rows = has_outflow(a, rounding) if outflow else np.zeros(len(mass), dtype=bool)
    a = sparse.csr_array(a - sparse.diags_array(np.where(open_rows, 0.0, a.sum(axis=1))))
    pi = mass.detach().cpu().double().numpy()
    count, component = csgraph.connected_components(a, directed=True, connection="weak")
    conserving = np.bincount(component, open_rows, minlength=count) == 0
    null_left = pi.copy()
    if backward_error(sparse.csr_array(a.T), np.where(conserving[component], pi, 0.0)) > CONSERVED:
        areas, delta = torch.from_numpy(pi.copy()), sparse.csr_array(-a)
        try:
            q = shared_outflow(delta, areas) if outflow else None
            null_left = left_null_vector(delta, areas, q)[0].numpy()
        except StabilityError as error:
            raise EigenbasisError(SINGULAR.format(len(pi))) from error
    if conserving.sum() > k:
        areas = np.where(conserving, np.bincount(component, pi), 0.0)
        phi = constants(component, areas, k)
        scale = areas / np.where(conserving, np.bincount(component, null_left), 1.0)
        left = (null_left * scale[component])[:, None] * phi
        values, phi, pi, left = map(torch.from_numpy, (np.zeros(k), phi, pi, left))
        return Eigenbasis(values, phi, pi, left)
    wanted = min(k, len(pi)) - int(conserving.sum())
    parts = []
    for c, index in enumerate(members(component)):
        null = null_left[index] if conserving[c] else None
        parts.append(_part(a[index][:, index], index, pi[index], null, wanted))
    cut = _cut(parts, wanted)
    solved = [_ritz(part, cut) for part in parts]
    return _merged(parts, solved, pi)


def members(component: np.ndarray) -> list[np.ndarray]:
    """The points of every component, ascending, of the component of each point.

    >>> members(np.array([0, 1, 0]))
    [array([0, 2]), array([1])]
    """
    order = np.argsort(component, kind="stable")
    return np.split(order, np.cumsum(np.bincount(component))[:-1])


def constants(
    component: np.ndarray, areas: Float[np.ndarray, " P"], k: int
) -> Float[np.ndarray, "N k"]:
    """The first k of orthonormal functions that are constant on every component; the first is so everywhere.

    They vanish on components whose area is given as 0; k is at most the number of the others.

    >>> constants(np.array([0, 0, 1]), np.array([2.0, 2.0]), 2)
    array([[ 0.5,  0.5],
           [ 0.5,  0.5],
           [ 0.5, -0.5]])
    """
    if k == 0:
        return np.zeros((len(component), 0))
    on = areas > 0
    root = np.sqrt(areas[on])
    values = np.zeros((len(areas), k))
    values[on] = global_first(root, k) / root[:, None]
    values[on, 0] = 1 / linalg.norm(root)
    return values[component]


def global_first(root: Float[np.ndarray, " P"], k: int) -> Float[np.ndarray, "P k"]:
    """Orthonormal columns, the first along √area, with which the constants of components are recombined."""
    t = np.linalg.qr(np.column_stack([root, np.eye(len(root), k - 1)]))[0]
    return t * np.sign(t[0, 0])


def _part(
    a: Any,
    index: np.ndarray,
    mass: np.ndarray,
    null: np.ndarray | None,
    wanted: int,
) -> _Part:
    """Scale one component and find its slow eigenvectors, right and left."""
    root = np.sqrt(mass)
    zero = root / linalg.norm(root)
    scaled = sparse.csr_array(sparse.diags_array(root) @ a @ sparse.diags_array(1 / root))
    left_null = None
    if null is not None:
        left_null = null / root
        left_null /= left_null @ zero
    size = len(index)
    if wanted == 0 or size <= (left_null is not None):
        right = left = (np.zeros(0), np.zeros((size, 0)))
    elif size <= DENSE or 2 * wanted >= size:
        right, left = _dense(scaled.toarray(), left_null is not None)
    else:
        right, left = _inverted(scaled, zero, left_null, wanted)
    return _Part(index, scaled, root, left_null, right, left)


Pairs = tuple[np.ndarray, np.ndarray]


def _dense(a: np.ndarray, singular: bool) -> tuple[Pairs, Pairs]:
    """All eigenpairs but a null vector, slowest first, of A and of its transpose."""

    def ordered(values: np.ndarray, vectors: np.ndarray) -> Pairs:
        order = np.argsort(np.abs(values), kind="stable")[int(singular) :]
        return values[order], vectors[:, order]

    return ordered(*np.linalg.eig(a)), ordered(*np.linalg.eig(a.T))


def _inverted(
    a: sparse.csr_array, right: np.ndarray, left: np.ndarray | None, wanted: int
) -> tuple[Pairs, Pairs]:
    """Slow eigenpairs by Arnoldi on the inverse; null vectors, if `left` is one, are projected out on both sides."""
    size = len(right)
    if left is None:
        right = left = np.zeros(size)
    # ARPACK takes what is small in absolute terms for converged; a power of two rounds nothing.
    unit = np.ldexp(1.0, np.frexp(np.median(a.diagonal()))[1])
    a = a / unit
    shift = SHIFT * float(np.median(a.diagonal()))
    try:
        lu = factorized(sparse.csc_array(a + shift * sparse.eye_array(size)), 1e-2)
    except RuntimeError as error:
        raise EigenbasisError(SINGULAR.format(size)) from error
    count = min(wanted + max(6, wanted // 16), size - 3)
    start = np.random.default_rng(0).standard_normal(size)
    found = []
    for mode, u, w in [("N", right, left), ("T", left, right)]:

        def apply(x: np.ndarray, mode: str = mode, u: np.ndarray = u, w: np.ndarray = w) -> Any:
            y = lu.solve(x - u * (w @ x), mode)
            return y - u * (w @ y)

        operator = LinearOperator((size, size), matvec=apply, dtype=np.float64)  # pyright: ignore[reportCallIssue]
        try:
            pairs: Any = eigs(operator, count, which="LM", v0=start)
        except ArpackError as error:
            raise EigenbasisError(
                f"eigenbasis: the iteration for {count} eigenvectors of {size} points did not converge ({error}); "
                "ask for fewer, or for more, so that the cut does not fall into a cluster"
            ) from error
        values, vectors = (1 / pairs[0] - shift) * unit, pairs[1]
        order = np.argsort(np.abs(values), kind="stable")
        found.append((values[order], vectors[:, order]))
    return found[0], found[1]


def _cut(parts: list[_Part], wanted: int) -> float:
    """A modulus with at least `wanted` eigenvalues below it, between two that differ, for right and left alike."""
    if wanted == 0:
        return 0.0
    moduli = np.sort(np.concatenate([np.abs(part.right[0]) for part in parts]))
    # What a component has beyond its largest eigenvalue found is not known.
    known = min((np.abs(p.right[0]).max() for p in parts if not p.complete), default=np.inf)
    above = np.append(moduli[1:], np.inf)
    gaps = (above > moduli * (1 + GAP)) & (moduli < known)
    gaps[: wanted - 1] = False
    if not gaps.any():
        raise EigenbasisError(
            f"eigenbasis: no gap after {wanted} eigenvalues (a multiplicity of {len(moduli) - wanted} or more); "
            "ask for a few more or fewer eigenvectors"
        )
    place = int(gaps.argmax())
    return float(np.sqrt(moduli[place] * min(above[place], 4 * moduli[place])))


def _real_span(pairs: Pairs, cut: float) -> np.ndarray:
    """Orthonormal basis of the real span of the eigenvectors below the cut."""
    values, vectors = pairs
    keep = np.abs(values) <= cut
    values, vectors = values[keep], vectors[:, keep]
    # Of a conjugate pair the first gives the real part and the second the imaginary part.
    columns = np.where(np.imag(values) < 0, np.imag(vectors), np.real(vectors))
    return np.linalg.qr(columns)[0]


Solved = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _ritz(part: _Part, cut: float) -> Solved:
    """Rayleigh–Ritz on one component: eigenvalues, zero first, Φ, W, decay rates, modal transform, all scaled."""
    zero = part.root / linalg.norm(part.root)
    u = _real_span(part.right, cut)
    conserving = part.null_left is not None
    u = np.linalg.qr(u - zero[:, None] * (zero @ u))[0] if conserving else u
    h = u.T @ (part.matrix @ u)
    values, q = linalg.eigh((h + h.T) / 2) if u.shape[1] else (np.zeros(0), np.zeros((0, 0)))
    if (values <= 0).any():
        raise EigenbasisError(
            f"eigenbasis: −Δ has the eigenvalue {values.min():.3g} on a component of {len(zero)} points, where it "
            "should be positive: the operator is not stable; build it with certify=True"
        )
    if not conserving and u.size:
        # π is no null vector there, and Ritz values would be off by the square of the skew part.
        values = np.sort(np.linalg.eigvals(h).real)
    u = u @ q
    if u.size:
        u *= np.sign(u[np.abs(u).argmax(0), np.arange(u.shape[1])])
    phi, z = u, _real_span(part.left, cut)
    if part.null_left is not None:
        phi, z = np.column_stack([zero, u]), np.column_stack([part.null_left, z])
        values = np.append(0.0, values)
    if phi.shape[1] == 0:
        return values, phi, phi, np.zeros((2, 0)), np.zeros((3, 0, 0))
    overlap = phi.T @ z if z.shape == phi.shape else np.zeros((1, 1))
    if linalg.svdvals(overlap)[-1] < 1e-8 * linalg.svdvals(overlap)[0]:
        raise EigenbasisError(
            f"eigenbasis: left and right eigenvectors do not match after {phi.shape[1]} of a component of {len(zero)} "
            "points: the cut falls into a cluster; ask for a few more or fewer"
        )
    w = z @ linalg.inv(overlap)
    b = w.T @ (part.matrix @ phi)
    if conserving:
        b[:, 0] = 0.0  # constants, exactly
    rates, transform = _exact_modes(b)
    return values, phi, w, rates, transform


def _exact_modes(b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decay rates and modal transform for a matrix B; NaN where its eigenvectors are too close to dependent.

    For a pair α ± iβ with p ± iq: B[p q] = [p q](α + βJ'), so e^{−tB} turns [p q] by βt while it shrinks by e^{−αt}.
    """
    values, vectors = np.linalg.eig(b)
    real, imag = np.real(values), np.imag(values)
    first, second = np.flatnonzero(imag > 0), np.flatnonzero(imag < 0)
    v = np.real(vectors).copy()
    v[:, second] = np.imag(vectors)[:, first]
    turn = np.zeros_like(b)
    turn[first, second], turn[second, first] = -1.0, 1.0
    if np.linalg.cond(v) > CONDITION:
        return np.full((2, len(b)), np.nan), np.full((3, *b.shape), np.nan)
    inverse = linalg.inv(v)
    rates = np.stack([real, np.abs(imag)])
    rates[0, np.abs(values) <= 1e-12 * np.abs(values).max()] = 0.0
    return rates, np.stack([v, inverse, turn @ inverse])


def _merged(parts: list[_Part], solved: list[Solved], pi: np.ndarray) -> Eigenbasis:
    """The components side by side: their constants recombined so that the first is global, the rest ascending."""
    conserving = np.array([part.null_left is not None for part in parts])
    count = int(conserving.sum())
    sizes = [len(s[0]) for s in solved]
    start = np.cumsum([0, *sizes])
    total = int(start[-1])
    values, rates = (np.concatenate([s[i] for s in solved], axis=-1) for i in (0, 3))
    phi, left = np.zeros((len(pi), total)), np.zeros((len(pi), total))
    transform = np.zeros((3, total, total))
    for part, (_, f, w, _, m), at in zip(parts, solved, start[:-1], strict=True):
        place = slice(at, at + f.shape[1])
        phi[part.index, place] = f / part.root[:, None]
        left[part.index, place] = w * part.root[:, None]
        transform[:, place, place] = m
    zeros = start[:-1][conserving]
    order = np.concatenate([zeros, np.setdiff1d(np.arange(total), zeros)])
    order[count:] = order[count:][np.argsort(values[order[count:]], kind="stable")]
    values, phi, left = values[order], phi[:, order], left[:, order]
    v, others = transform[0][order], transform[1:, :, order]
    if count:
        index = [part.index for part in parts if part.null_left is not None]
        root = np.sqrt(np.array([pi[index].sum() for index in index]))
        t = global_first(root, count)
        phi[:, :count], left[:, :count] = phi[:, :count] @ t, left[:, :count] @ t
        v[:count], others[:, :, :count] = t.T @ v[:count], others[:, :, :count] @ t
        phi[np.concatenate(index), 0] = 1 / linalg.norm(root)
    modes: dict[str, Any] = {}
    if np.isfinite(transform).all():
        modes = {
            "decay_rates": torch.from_numpy(rates),
            "modal_transform": torch.from_numpy(np.stack([v, *others])),
        }
    tensors: Any = [torch.from_numpy(np.ascontiguousarray(x)) for x in (values, phi, pi, left)]
    return Eigenbasis(*tensors, **modes)
