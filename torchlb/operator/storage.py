"""The parts of an operator, and how they travel: copies, types, files, and the eigenbasis once it is known."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, TypeVar
from weakref import finalize

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.certified.certificate import Certificate
from torchlb.cloud.surface import SurfaceSummary
from torchlb.errors import InputError, warn
from torchlb.linalg.csr import Csr, Record, Tensors
from torchlb.linalg.exponential import spectral_radius
from torchlb.linalg.sparse import to_scipy
from torchlb.operator.checks import check_same_points
from torchlb.spectral.eigenbasis import Eigenbasis
from torchlb.stencils.conditions import Condition, condition_of, kind_of

FIT_FIELDS = ("fit_degree", "fit_reason", "edges", "curved_edges")
REAL_FIELDS = ("growth", "condition", "off_diagonal_ratio")
ROW_FIELDS = ("order", "normal_order", "num_neighbors", *REAL_FIELDS, "rule", "reason")
BASIS = ("eigenvalues", "eigenvectors", "left", "relative_errors")


def with_added(values: Float[Tensor, "terms nnz"]) -> Float[Tensor, "2 nnz"]:
    """K + R and M, of K, M, B, R; R is what a condition adds, and there is none unless it has been stored."""
    return values[:2] if len(values) < 4 else torch.stack([values[0] + values[3], values[1]])


Storage = TypeVar("Storage", bound="OperatorStorage")


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


class OperatorStorage(Tensors):
    """Tensors of any size, which an empty instance takes from any `state_dict`.

    Attributes
    ----------
    weak, linear
        Matrices of the weak pair: stiffness and mass matrix; on a shape with a boundary the mass matrix of that; and
        what a condition adds to the stiffness. Those of linear elements, of no rows where they are the same.
    record
        The fields of a `StencilReport`.
    modes
        The eigenbasis, as far as it is known; `state_dict` has it where it is asked to.
    """

    mass: Tensor
    points: Tensor
    frames: Tensor
    normals: Tensor
    on_boundary: Tensor
    faces: Tensor
    stencil: Csr
    weak: Csr
    linear: Csr
    record: Record
    modes: Record

    def __init__(self) -> None:
        none, whole = torch.zeros(0), torch.zeros(0, dtype=torch.int64)
        by_point = dict.fromkeys(("mass", "points", "frames", "normals"), none)
        super().__init__(by_point | {"on_boundary": whole.bool(), "faces": whole.view(0, 3)})
        self.source = "empty"
        self.options: dict[str, Any] = {}
        self.certificate: Certificate | None = None
        self.surface: SurfaceSummary | None = None
        self._sizes: list[Tensor] | None = None
        self.parts: list[dict[str, Any]] | None = None  # the extra states of the shapes of a batch
        self._plan: Any = None
        self._radius: Tensor | None = None
        self._pairs = torch.empty(0, 0)  # as many rows as `num_pairs`
        self._cache: OperatorCache | None = None
        self.stencil, self.weak, self.linear = Csr(order_t=whole), Csr(), Csr()
        fields = {n: none if n in REAL_FIELDS else whole for n in (*ROW_FIELDS, *FIT_FIELDS)}
        self.record = Record(fields)
        self.modes = Record(dict.fromkeys(BASIS, none), persistent=False)

    def __getstate__(self) -> dict[str, Any]:
        """For copies and files: without the plan, which is made again when it is asked for, and the cache."""
        return {**self.__dict__, "_plan": None, "_cache": None}

    @property
    def cache(self) -> OperatorCache:
        """Factors and elements, kept as long as the operator and its matrices; ``del lb.cache`` lets them go."""
        if self._cache is None or self._cache.values is not self.weak.values:
            self._cache = OperatorCache(self.weak.values)
        return self._cache

    @cache.deleter
    def cache(self) -> None:
        self._cache = None

    @property
    def sizes(self) -> tuple[int, ...] | None:
        """Numbers of points of the shapes of a `batch`; None for a single shape."""
        return None if self._sizes is None else tuple(t.shape[0] for t in self._sizes)

    @sizes.setter
    def sizes(self, sizes: Sequence[int] | None) -> None:
        # In shapes of tensors, since numbers are compiled in.
        self._sizes = None if sizes is None else [torch.empty(n, 0) for n in sizes]

    @classmethod
    def of_parts(
        cls: type[Storage],
        parts: dict[str, Any],
        state: dict[str, Any],
        basis: Eigenbasis | None = None,
    ) -> Storage:
        """An operator of given tensors, matrices and records by name, and of what `get_extra_state` has beside them.

        What is left out stays empty.
        """
        lb = cls()
        for name, part in parts.items():
            setattr(lb, name, part)
        lb.set_extra_state(state)
        if basis is not None:
            lb.keep_basis(basis)
        return lb

    @property
    def num_points(self) -> int:
        """Number of points N."""
        return self.mass.shape[0]

    @property
    def dim(self) -> int:
        """Dimension d of the manifold."""
        return self.frames.shape[-1]

    @property
    def order(self) -> int | None:
        """Order p that was asked for; None where there is none, as for the cotangent operator."""
        return self.options.get("order")

    @property
    def condition(self) -> str | Condition | None:
        """What holds at the boundary, "neumann", "dirichlet" or a `Robin`; None if no datum is used there."""
        plain = self.options.get("condition")
        return condition_of(plain) if isinstance(plain, dict) else plain

    @property
    def boundary(self) -> Tensor | None:
        """(N,), mask of the points where `condition` holds; None on a closed shape."""
        return self.on_boundary if len(self.on_boundary) else None

    @property
    def fixed(self) -> Bool[Tensor, " N"] | None:
        """Mask of the points where a Dirichlet condition holds; None if there are none."""
        if len(self.on_boundary) == 0:
            return None
        holds = [kind.fixes for kind in self.conditions]
        sizes = self.sizes or (self.num_points,)
        mask = torch.tensor(holds).repeat_interleave(torch.tensor(sizes)).to(self.on_boundary)
        return mask & self.on_boundary if any(holds) else None

    @property
    def losing(self) -> Bool[Tensor, " N"] | None:
        """Mask of the points where a condition keeps constants out of the null space of the pair; None for none."""
        if len(self.near.values) < 4:
            return self.fixed
        mask = torch.zeros_like(self.mass, dtype=torch.bool)
        mask[self.near.col[self.near.values[3] > 0]] = True  # on the diagonal
        return mask if self.fixed is None else mask | self.fixed

    @property
    def conditions(self) -> list[type[Condition]]:
        """What kind of condition holds at the boundary of each shape."""
        states = [{"options": self.options}] if self.parts is None else self.parts
        return [kind_of(state["options"].get("condition")) for state in states]

    @property
    def shape(self) -> tuple[int, int]:
        """(N, N), of the matrix."""
        return self.num_points, self.num_points

    @property
    def dtype(self) -> torch.dtype:
        """Floating type of the matrix."""
        return self.stencil.values.dtype

    @property
    def device(self) -> torch.device:
        """Where the buffers are."""
        return self.stencil.values.device

    @property
    def offsets(self) -> tuple[int, ...]:
        """Where the points of each shape of a batch start, and N at the end; (0, N) for a single shape."""
        sizes = self.sizes or (self.num_points,)
        return tuple(sum(sizes[:i]) for i in range(len(sizes) + 1))

    @property
    def radius(self) -> Tensor:
        """Bound on the eigenvalues of D⁻¹K₁, the linear pair with lumped mass, for flows beyond the basis.

        1/ℓ², a float64 tensor () on the CPU, which compiled code can take; found once, and stored with the operator.
        """
        if self._radius is None:
            crow, col, values = self.linear_pair
            stiffness, mass = (to_scipy(crow, col, v.double(), self.shape) for v in values)
            lumped: Any = mass.sum(axis=1)
            self.set_radius(spectral_radius(stiffness, lumped))
        assert self._radius is not None
        return self._radius

    @property
    def pair(self) -> tuple[Tensor, Tensor, Tensor]:
        """(crow, col, values (2, nnz)) of K, with what a condition adds to it, and M: what all is computed by."""
        return self.weak.crow, self.weak.col, with_added(self.weak.values)

    @property
    def near(self) -> Csr:
        """The matrices of linear elements, close to the weak pair and 20 times sparser."""
        return self.linear if self.linear.num_rows else self.weak

    @property
    def linear_pair(self) -> tuple[Tensor, Tensor, Tensor]:
        """As `pair`, of linear elements."""
        return self.near.crow, self.near.col, with_added(self.near.values)

    def set_radius(self, radius: float | None) -> None:
        """Hold what is known of the spectrum; it is neither rounded nor moved with the buffers."""
        known = None if radius is None else torch.tensor(radius, dtype=torch.float64, device="cpu")
        self._radius = known

    @property
    def basis(self) -> Eigenbasis | None:
        """All eigenpairs that are stored; None if there are none."""
        held = self.modes
        if len(held.left) == 0:
            return None
        errors = held.relative_errors if len(held.relative_errors) else None
        pairs = held.eigenvalues, held.eigenvectors, self.mass, held.left
        return Eigenbasis(*pairs, self.sizes, errors)

    def keep_basis(self, basis: Eigenbasis | None = None, *, store: bool | None = None) -> None:
        """Hold a basis (None: the one there is), in `state_dict` or not (None: as it was)."""
        store = not self.modes._non_persistent_buffers_set if store is None else store
        none = self.mass.new_zeros(0)
        held = {name: getattr(basis or self.modes, name) for name in BASIS}
        held = {name: none if t is None else t.to(none) for name, t in held.items()}
        self.modes = Record(held, persistent=store)
        if len(held["left"]) > 0:
            self._count_pairs(self.modes.eigenvectors)

    @property
    def num_pairs(self) -> int:
        """Number of eigenpairs that are stored of each shape of a batch, but for those that have no more."""
        return self._pairs.shape[0]

    def has_pairs(self, k: int) -> bool:
        """Whether k eigenpairs of each shape are stored, or all that it has."""
        return min(k, max(self.sizes or (self.num_points,))) <= self.num_pairs

    def _count_pairs(self, eigenvectors: Float[Tensor, "N k"]) -> None:
        """Set `num_pairs`: a batch pads the bases of its shapes, and a Dirichlet condition takes points."""
        sizes = self.sizes or (self.num_points,)
        free = torch.ones_like(self.mass, dtype=torch.bool) if self.fixed is None else ~self.fixed
        parts = zip(eigenvectors.split(sizes), free.split(sizes), strict=True)
        counts = [(int((modes != 0).any(0).sum()), int(inside.sum())) for modes, inside in parts]
        known = min((held for held, most in counts if held < most), default=max(sizes))
        self._pairs = torch.empty(known, 0)

    def check_points(self, points: Tensor) -> None:
        """InputError unless the operator was built from these points: as many, each in its place to float32 rounding.

        An operator does not follow its points: after scaling, turning, or taking a part of them it is another one.
        """
        check_same_points(points, self.points)

    def get_extra_state(self) -> dict[str, Any]:
        """Source, options, certificate, spectral radius and what is known of the surface, plain types only."""
        return {
            "source": self.source,
            "options": self.options,
            "certificate": None if self.certificate is None else asdict(self.certificate),
            "sizes": None if self.sizes is None else list(self.sizes),
            "radius": None if self._radius is None else float(self._radius),
            "parts": self.parts,
            "surface": None if self.surface is None else asdict(self.surface),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Inverse of `get_extra_state`; what is left out is not known."""
        self.source, self.options = state["source"], dict(state["options"])
        found, sizes, radius = (state.get(key) for key in ("certificate", "sizes", "radius"))
        surface = state.get("surface")
        self.surface = None if surface is None else SurfaceSummary.of(surface)
        self.certificate = None if found is None else Certificate(**found)
        self.sizes, self.parts = None if sizes is None else tuple(sizes), state.get("parts")
        self.set_radius(radius)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *given: Any) -> None:
        """Where that replaces an operator on other points a warning says so."""
        theirs = state_dict.get(f"{prefix}points")
        if self.num_points and theirs is not None:
            try:
                self.check_points(theirs)
            except InputError:
                warn(
                    f"{prefix or 'LaplaceBeltrami'}: the operator on {self.num_points} points is replaced by one on "
                    f"{len(theirs)} others; leave it out of the state to keep the one that is there"
                )
        stored = f"{prefix}modes.left" in state_dict
        none = self.mass.new_zeros(0)
        self.modes = Record(dict.fromkeys(BASIS, none), persistent=stored)
        self._radius = self._plan = self._cache = None
        self._pairs = torch.empty(0, 0)
        super()._load_from_state_dict(state_dict, prefix, *given)
        if stored:
            self._count_pairs(state_dict[f"{prefix}modes.eigenvectors"])
