"""Parts of an operator: fields of its medium, the known part of its eigenbasis, and its cache."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.galerkin.medium import Field
from torchlb.linalg.csr import Tensors, tensors_of
from torchlb.spectral.eigenbasis import Eigenbasis

BASIS = ("eigenvalues", "eigenvectors", "left", "relative_errors")


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
        """Set `count`, the pairs known of every shape, all that the free points allow where these are fewer."""
        parts = zip(vectors.split(sizes), free.split(sizes), strict=True)
        # zero columns are padding
        counts = [(int((modes != 0).any(0).sum()), int(inside.sum())) for modes, inside in parts]
        most = max(sizes)
        known = min((held for held, every in counts if held < every), default=most)
        self._counts = torch.empty(known, most)


class OperatorCache:
    """Results that are computed once and kept with an operator, in memory only: copies and files lack them.

    They belong to `values` of the weak pair: an operator with other values gets a new cache. `system` is the linear
    system with its factors, `elements` are those of the weak pair, made for the first medium, `connection` the tangent
    fields; the `shapes` of a batch, each with the values that it had, serve it by their caches.
    """

    def __init__(self, values: Tensor) -> None:
        self.values = values
        self.system: Any = None
        self.elements: Any = None
        self.connection: Any = None
        self.shapes: tuple[tuple[Any, Tensor], ...] = ()
