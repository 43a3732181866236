"""The tensors of an operator, and how they travel: copies, types, files, and the eigenbasis once it is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchlb.certified.certificate import Certificate
from torchlb.cloud.surface import SurfaceSummary
from torchlb.errors import InputError, warn
from torchlb.linalg.exponential import spectral_radius
from torchlb.linalg.sparse import to_scipy, transpose_pattern
from torchlb.operator.checks import check_same_points
from torchlb.spectral.eigenbasis import Eigenbasis
from torchlb.stencils.conditions import Condition, condition_of, kind_of

REAL_FIELDS = ("growth", "condition", "off_diagonal_ratio")
FIT_FIELDS = ("fit_degree", "fit_reason", "edges", "curved_edges")
REPORT_FIELDS = (
    *("order", "normal_order", "num_neighbors", *REAL_FIELDS, "rule", "reason"),
    *FIT_FIELDS,
)
PAIRS = ("weak", "linear")
"""The weak pair (K, M), and the linear pair beside it, by the names of their buffers."""
BUFFERS = ("crow", "col", "values", "gradient_values", "mass", "points", "frames", "normals")
TRANSPOSE = ("crow_t", "col_t", "order_t")
Storage = TypeVar("Storage", bound="OperatorStorage")
BASIS = ("eigenvalues", "eigenvectors", "left", "relative_errors")
FORMER = ("basis_decay_rates", "basis_modal_transform")
"""Of a state of an older torchlb, whose stencils had eigenpairs of their own."""


def no_pairs(like: Tensor) -> dict[str, Tensor]:
    """The buffers of both pairs where there are none, of the type and on the device of a tensor."""
    index, values = like.new_zeros(0, dtype=torch.int64), like.new_zeros(2, 0)
    parts = {"crow": index, "col": index, "values": values}
    return {f"{pair}_{part}": t.clone() for pair in PAIRS for part, t in parts.items()}


def with_added(values: Float[Tensor, "terms nnz"]) -> Float[Tensor, "2 nnz"]:
    """K + R and M, of K, M, B, R; R is what a condition adds, and there is none unless it has been stored."""
    return values[:2] if len(values) < 4 else torch.stack([values[0] + values[3], values[1]])


class OperatorStorage(nn.Module):
    """Plain buffers of any size, which an empty instance takes from any `state_dict`.

    Attributes are those of `LaplaceBeltrami`; the transpose's pattern and, unless asked for, the basis are left out of
    `state_dict`. ``weak_crow``, ``weak_col``, ``weak_values`` (2, nnz) are stiffness and mass matrix on one pattern,
    (3, nnz) with the mass matrix of the boundary, (4, nnz) with what a condition adds to the stiffness; ``linear_…``
    those of linear elements, empty where they are the same.
    ``faces`` are those of the mesh, or of the surface through a cloud; ``surface`` says how that was found.
    """

    crow: Tensor
    col: Tensor
    values: Tensor
    gradient_values: Tensor
    mass: Tensor
    points: Tensor
    frames: Tensor
    normals: Tensor
    on_boundary: Tensor
    faces: Tensor
    weak_crow: Tensor
    weak_col: Tensor
    weak_values: Tensor
    linear_crow: Tensor
    linear_col: Tensor
    linear_values: Tensor
    crow_t: Tensor
    col_t: Tensor
    order_t: Tensor
    basis_eigenvalues: Tensor
    basis_eigenvectors: Tensor
    basis_left: Tensor
    basis_relative_errors: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.source = "empty"
        self.options: dict[str, Any] = {}
        self.certificate: Certificate | None = None
        self.surface: SurfaceSummary | None = None
        self._sizes: list[Tensor] | None = None
        self.parts: list[dict[str, Any]] | None = None  # the extra states of the shapes of a batch
        self._plan: Any = None
        self._radius: Tensor | None = None
        self._pairs = torch.empty(0, 0)  # as many rows as `num_pairs`
        for name in BUFFERS:
            self.register_buffer(name, torch.zeros(0))
        self.register_buffer("on_boundary", torch.zeros(0, dtype=torch.bool))
        self.register_buffer("faces", torch.zeros(0, 3, dtype=torch.int64))
        self.crow, self.col = torch.zeros(1, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)
        for name, tensor in no_pairs(torch.zeros(0)).items():
            self.register_buffer(name, tensor)
        for name in REPORT_FIELDS:
            dtype = torch.get_default_dtype() if name in REAL_FIELDS else torch.int64
            self.register_buffer(f"report_{name}", torch.zeros(0, dtype=dtype))
        for name in TRANSPOSE:  # for the backward pass
            self.register_buffer(name, torch.zeros(0, dtype=torch.int64), persistent=False)
        for name in BASIS:
            self.register_buffer(f"basis_{name}", torch.zeros(0), persistent=False)

    def __getstate__(self) -> dict[str, Any]:
        """For copies and files: without the plan, which is made again when it is asked for."""
        return {**self.__dict__, "_plan": None}

    def __getattr__(self, name: str) -> Any:
        """A buffer. Not by way of `nn.Module`, for whose buffers `torch.compile` makes a graph of every size."""
        buffers = self.__dict__.get("_buffers", {})
        return buffers[name] if name in buffers else super().__getattr__(name)

    @property
    def sizes(self) -> tuple[int, ...] | None:
        """Numbers of points of the shapes of a `batch`; None for a single shape."""
        return None if self._sizes is None else tuple(t.shape[0] for t in self._sizes)

    @sizes.setter
    def sizes(self, sizes: Sequence[int] | None) -> None:
        # In shapes of tensors, since numbers are compiled in.
        self._sizes = None if sizes is None else [torch.empty(n, 0) for n in sizes]

    @classmethod
    def from_buffers(
        cls: type[Storage],
        buffers: dict[str, Tensor],
        state: dict[str, Any],
        basis: Eigenbasis | None = None,
    ) -> Storage:
        """An operator of given tensors, by their names here, and of what `get_extra_state` has beside them.

        Without the pattern of the transpose it is found; all else that is left out stays empty.
        """
        lb = cls()
        for name, tensor in buffers.items():
            setattr(lb, name, tensor)
        lb.set_extra_state(state)
        if "order_t" not in buffers:
            lb._transpose()
        if basis is not None:
            lb.keep_basis(basis)
        return lb

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All buffers by name, also those that share their memory, as the patterns of Δ and K of the cotangent."""
        return dict(self.named_buffers(remove_duplicate=False))

    @property
    def num_points(self) -> int:
        """Number of points N."""
        return self.crow.shape[0] - 1

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
        _, col, values = self.channels("linear" if len(self.linear_crow) else "weak")
        if len(values) < 4:
            return self.fixed
        mask = torch.zeros_like(self.mass, dtype=torch.bool)
        mask[col[values[3] > 0]] = True  # on the diagonal
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
        return self.values.dtype

    @property
    def device(self) -> torch.device:
        """Where the buffers are."""
        return self.values.device

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
        crow, col, values = self.channels("weak")
        return crow, col, with_added(values)

    @property
    def linear_pair(self) -> tuple[Tensor, Tensor, Tensor]:
        """The same of the pair of linear elements, close to (K, M) and 20 times sparser."""
        crow, col, values = self.channels("linear" if len(self.linear_crow) else "weak")
        return crow, col, with_added(values)

    def channels(self, pair: str) -> tuple[Tensor, Tensor, Tensor]:
        """The buffers of the pair "weak" or "linear": crow, col, and values of K, M, B, and of what is added to K."""
        return tuple(getattr(self, f"{pair}_{part}") for part in ("crow", "col", "values"))  # type: ignore[return-value]

    def set_radius(self, radius: float | None) -> None:
        """Hold what is known of the spectrum; it is neither rounded nor moved with the buffers."""
        known = None if radius is None else torch.tensor(radius, dtype=torch.float64, device="cpu")
        self._radius = known

    def _transpose(self) -> None:
        self.crow_t, self.col_t, self.order_t = transpose_pattern(
            self.crow, self.col, self.num_points
        )

    @property
    def basis(self) -> Eigenbasis | None:
        """All eigenpairs that are stored; None if there are none."""
        if len(self.basis_left) == 0:
            return None
        pairs = (self.basis_eigenvalues, self.basis_eigenvectors, self.mass, self.basis_left)
        errors = self.basis_relative_errors if len(self.basis_relative_errors) else None
        return Eigenbasis(*pairs, self.sizes, errors)

    def keep_basis(self, basis: Eigenbasis | None = None, *, store: bool | None = None) -> None:
        """Hold a basis (None: the one there is) in buffers, in `state_dict` or not (None: as it was)."""
        for name in BASIS:
            key = f"basis_{name}"
            value = getattr(self, key) if basis is None else getattr(basis, name)
            value = self.values.new_zeros(0) if value is None else value.to(self.values)
            outside = key in self._non_persistent_buffers_set
            self.register_buffer(key, value, persistent=not outside if store is None else store)
        self._pairs = torch.empty(self._count_pairs(), 0)

    @property
    def num_pairs(self) -> int:
        """Number of eigenpairs that are stored of each shape of a batch, but for those that have no more."""
        return self._pairs.shape[0]

    def has_pairs(self, k: int) -> bool:
        """Whether k eigenpairs of each shape are stored, or all that it has."""
        return min(k, max(self.sizes or (self.num_points,))) <= self.num_pairs

    def _count_pairs(self) -> int:
        """`num_pairs` of the basis in the buffers: a batch pads short ones, and a Dirichlet condition takes points."""
        if len(self.basis_left) == 0:
            return 0
        sizes = self.sizes or (self.num_points,)
        fixed = self.fixed if len(self.weak_crow) else None
        free = torch.ones_like(self.mass, dtype=torch.bool) if fixed is None else ~fixed
        parts = zip(self.basis_eigenvectors.split(sizes), free.split(sizes), strict=True)
        counts = [(int((modes != 0).any(0).sum()), int(inside.sum())) for modes, inside in parts]
        return min((held for held, most in counts if held < most), default=max(sizes))

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

    def _load_from_state_dict(
        self,
        state_dict: Any,
        prefix: str,
        local_metadata: Any,
        strict: bool,
        missing_keys: Any,
        unexpected_keys: Any,
        error_msgs: Any,
    ) -> None:
        """Take buffers of any size: an operator is data, not parameters of a fixed shape.

        Where that replaces an operator on other points a warning says so.
        """
        theirs = state_dict.get(f"{prefix}points")
        if self.num_points and theirs is not None:
            try:
                self.check_points(theirs)
            except InputError:
                warn(
                    f"{prefix or 'LaplaceBeltrami'}: the operator on {self.num_points} points is replaced by one on "
                    f"{len(theirs)} others; leave it out of the state to keep the one that is there"
                )
        for name in FORMER:
            state_dict.pop(prefix + name, None)
        for name in BASIS:
            stored = f"{prefix}basis_{name}" in state_dict
            self.register_buffer(f"basis_{name}", self.values.new_zeros(0), persistent=stored)
        self._radius = None
        missing = {"faces": torch.zeros(0, 3, dtype=torch.int64)} | no_pairs(torch.zeros(0))
        for name, tensor in missing.items():  # as in a state of an older torchlb
            state_dict.setdefault(prefix + name, tensor)
        for name, buffer in self.tensors.items():
            incoming = state_dict.get(prefix + name)
            if incoming is not None:
                setattr(self, name, torch.empty_like(incoming, device=buffer.device))
        super()._load_from_state_dict(
            state_dict,
            prefix,
            local_metadata,
            strict,
            missing_keys,
            unexpected_keys,
            error_msgs,
        )
        self._transpose()
        self.keep_basis()
