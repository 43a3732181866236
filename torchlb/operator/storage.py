"""The parts of an operator, and how they travel: copies, types, files, and the eigenbasis once it is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import accumulate
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.certified.certificate import Certificate
from torchlb.cloud.surface import SurfaceSummary
from torchlb.errors import InputError, first_few, warn
from torchlb.galerkin.matrices import PairMatrices
from torchlb.linalg.csr import Csr, Record, Tensors, tensors_of
from torchlb.operator.parts import MediumFields, Modes, OperatorCache
from torchlb.operator.plan import packed, unpacked
from torchlb.operator.report import FIELDS
from torchlb.spectral.eigenbasis import Eigenbasis
from torchlb.stencils.conditions import Condition, condition_of, kind_of

Storage = TypeVar("Storage", bound="OperatorStorage")

BY_POINT = ("mass", "points", "frames", "normals", "_shape_operators", "_on_boundary")
"""Tensors with a row for each point; some are empty: normals, shape operators, the mask of the boundary."""


class OperatorStorage(Tensors):
    """Tensors of any size, which an empty instance takes from any `state_dict`.

    Attributes
    ----------
    weak
        The matrices of the weak pair.
    modes
        The known part of the eigenbasis; `state_dict` has it if asked to.
    """

    mass: Tensor
    points: Tensor
    frames: Tensor
    normals: Tensor
    _shape_operators: Tensor
    _on_boundary: Tensor
    faces: Tensor
    stencil: Csr
    weak: PairMatrices
    modes: Modes
    _record: Record
    _medium: MediumFields

    def __init__(self) -> None:
        none, whole = torch.zeros(0), torch.zeros(0, dtype=torch.int64)
        by_point = dict.fromkeys(BY_POINT, none)
        super().__init__(by_point | {"_on_boundary": whole.bool(), "faces": whole.view(0, 3)})
        self.source = "empty"
        self.options: dict[str, Any] = {}
        self.certificate: Certificate | None = None
        self.surface: SurfaceSummary | None = None
        self._sizes: list[Tensor] | None = None
        self._states: list[dict[str, Any]] | None = None  # of the shapes of a batch
        self._in_medium = self._carries = False  # whether shapes of a batch require gradients
        self._plans: list[Any] | Tensor = []  # one a shape; in a state packed, until asked for
        self._cache: OperatorCache | None = None
        self._medium = MediumFields({})
        self.stencil, self.weak, self.modes = Csr(order_t=whole), PairMatrices(), Modes(None, none)
        real = dict.fromkeys(("growth", "condition", "off_diagonal_ratio"), none)
        self._record = Record(dict.fromkeys(FIELDS, whole) | real)

    def __getstate__(self) -> dict[str, Any]:
        """State for copies and files, without the cache."""
        return {**self.__dict__, "_plans": self._packed_plans(), "_cache": None}

    @property
    def _known_plans(self) -> list[Any]:
        """The plan of each shape, None where there is none."""
        if isinstance(self._plans, Tensor):
            self._plans = unpacked(self._plans)
        return self._plans or [None] * len(self.sizes or (1,))

    def _packed_plans(self) -> list[Any] | Tensor:
        if isinstance(self._plans, Tensor):
            return self._plans
        return packed(self._plans) if any(self._plans) else []

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if len(plans := self._packed_plans()):
            destination[f"{prefix}plans"] = plans

    @property
    def cache(self) -> OperatorCache:
        """Factors and elements, kept as long as the operator and its matrices; ``del lb.cache`` frees them."""
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
        # As shapes of tensors, since torch.compile specialises on numbers.
        self._sizes = None if sizes is None else [torch.empty(n, 0) for n in sizes]

    @classmethod
    def _of_parts(
        cls: type[Storage],
        parts: dict[str, Any],
        state: dict[str, Any] | None = None,
        basis: Eigenbasis | None = None,
    ) -> Storage:
        """Create an operator from attributes by name, the others empty, and a state as of `get_extra_state`."""
        lb = cls()
        for name, part in parts.items():
            setattr(lb, name, part)
        if state is not None:
            lb.set_extra_state(state)
        if basis is not None:
            lb._keep_basis(basis)
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
    def condition(self) -> str | Condition | None:
        """Boundary condition, "neumann", "dirichlet" or a `Robin`; None if no boundary data are used."""
        plain = self.options.get("condition")
        return condition_of(plain) if isinstance(plain, dict) else plain

    @property
    def boundary(self) -> Tensor | None:
        """(N,), mask of the points where `condition` holds; None on a closed shape."""
        return self._on_boundary if len(self._on_boundary) else None

    @property
    def fixed(self) -> Bool[Tensor, " N"] | None:
        """Mask of the points where a Dirichlet condition holds; None if there are none."""
        states = self._states or [{"options": self.options}]
        holds = [kind_of(state["options"].get("condition")).fixes for state in states]
        if len(self._on_boundary) == 0 or not any(holds):
            return None
        sizes = torch.tensor(self.sizes or (self.num_points,))
        held = torch.tensor(holds).repeat_interleave(sizes)
        return held.to(self._on_boundary) & self._on_boundary

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
        """Device of the buffers."""
        return self.stencil.values.device

    @property
    def offsets(self) -> tuple[int, ...]:
        """Index of the first point of each shape of a batch, and N at the end; (0, N) for a single shape."""
        return tuple(accumulate(self.sizes or (self.num_points,), initial=0))

    @property
    def _basis(self) -> Eigenbasis | None:
        """All known eigenpairs; None if there are none."""
        held = self.modes
        if len(held.left) == 0:
            return None
        errors = held.relative_errors if len(held.relative_errors) else None
        pairs = held.eigenvalues, held.eigenvectors, self.mass, held.left
        return Eigenbasis(*pairs, self.sizes, errors)

    def _keep_basis(
        self,
        basis: Eigenbasis | None = None,
        *,
        stored: bool | None = None,
        loaded: Float[Tensor, "N k"] | None = None,
    ) -> None:
        """Hold a basis (None: the present one), in `state_dict` or not (None: as before).

        `loaded` are the eigenvectors of one that is still to be loaded.
        """
        stored = self.modes.stored if stored is None else stored
        modes = Modes(basis or self.modes, self.mass, stored=stored)
        vectors, fixed = modes.eigenvectors if loaded is None else loaded, self.fixed
        if len(vectors):
            free = torch.ones_like(self.mass) > 0 if fixed is None else ~fixed
            modes.set_count(vectors, free, self.sizes or (self.num_points,))
        self.modes = modes

    @property
    def _known_medium(self) -> MediumFields:
        """The medium; InputError where only the batch that the operator comes from knew it."""
        if self._in_medium and not tensors_of(self._medium):
            raise InputError(
                "the medium of this operator is not known, as it comes from a batch; lb.at and lb.connection need it"
            )
        return self._medium

    def check_points(self, points: Tensor) -> None:
        """Raise InputError unless the operator was built from these points, in their order, to float32 rounding.

        An operator does not follow its points: after scaling, turning, or taking a part of them it is another one.
        """
        built = self.points
        if points.shape != built.shape:
            raise InputError(
                f"points: expected the {tuple(built.shape)} that the operator was built from, got "
                f"{tuple(points.shape)}; build it again after points are added, left out or projected"
            )
        theirs, ours = points.detach().to(built.device).double(), built.double()
        types = (torch.promote_types(t, torch.float16) for t in (points.dtype, built.dtype))
        rounding = max(torch.finfo(t).eps for t in (*types, torch.float32))
        distance = (theirs - ours).abs().amax(1)
        moved = (~(distance <= 4 * rounding * float(ours.abs().amax()))).nonzero()[:, 0]
        if len(moved):
            raise InputError(
                f"points: {len(moved)} of {len(points)} are not where they were when the operator was built "
                f"({first_few(moved)}; by up to {float(distance.amax()):.3g}); build it again after scaling, turning "
                "or deforming a shape"
            )

    def __repr__(self) -> str:
        """N, d, n, source and options."""
        if self.source == "empty":
            return f"{type(self).__name__}(empty)"
        size = f"{self.num_points} points, dim={self.dim} in R^{self.points.shape[1]}, from {self.source}"
        options = self.options | {"condition": self.condition}
        options = [f"{k}={v!r}" for k, v in options.items() if v is not None]
        certified = "" if self.certificate is None or self.certificate.holds else "NOT STABLE"
        last = [f"{len(self.stencil.col)} entries", str(self.dtype), certified]
        inside = ", ".join(part for part in [size, *options, *last] if part)
        return f"{type(self).__name__}({inside})"

    def get_extra_state(self) -> dict[str, Any]:
        """Source, options, certificate and the surface's summary, plain types only."""
        return {
            "source": self.source,
            "options": self.options,
            "certificate": None if self.certificate is None else asdict(self.certificate),
            "sizes": None if self.sizes is None else list(self.sizes),
            "parts": self._states,
            "medium": self._in_medium,
            "surface": None if self.surface is None else asdict(self.surface),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Inverse of `get_extra_state`; entries that are left out are unknown."""
        self.source, self.options = state["source"], dict(state["options"])
        found, surface, sizes = (state.get(key) for key in ("certificate", "surface", "sizes"))
        self.surface = None if surface is None else SurfaceSummary.of(surface)
        self.certificate = None if found is None else Certificate(**found)
        self.sizes, self._states = sizes, state.get("parts")
        self._in_medium = bool(state.get("medium"))

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *given: Any) -> None:
        """Load a state; warn where it replaces an operator on other points."""
        theirs = state_dict.get(f"{prefix}points")
        if self.num_points and theirs is not None:
            try:
                self.check_points(theirs)
            except InputError:
                warn(
                    f"{prefix or 'LaplaceBeltrami'}: the operator on {self.num_points} points is replaced by one on "
                    f"{len(theirs)} others; leave it out of the state to keep the one that is there"
                )
        vectors = state_dict.get(f"{prefix}modes.eigenvectors")
        self._plans, self._cache = state_dict.pop(f"{prefix}plans", []), None
        super()._load_from_state_dict(state_dict, prefix, *given)
        self.modes = Modes(None, self.mass)
        self._keep_basis(stored=vectors is not None, loaded=vectors)
