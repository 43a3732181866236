"""The weak pair as it is stored."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class SparsePair:
    """Two symmetric matrices on one pattern: stiffness, dimensionless on a surface, and mass, ℓ².

    Attributes
    ----------
    crow, col : (N + 1,), (nnz,), CSR with ascending columns.
    values : (2, nnz), of K and of M.
    """

    crow: Int[Tensor, " N_plus_1"]
    col: Int[Tensor, " nnz"]
    values: Float[Tensor, "2 nnz"]


@dataclass(frozen=True)
class WeakPair:
    """(K, M), and the pair of linear elements that is near it, None where it is the same.

    Attributes
    ----------
    matrices, linear : the pairs.
    """

    matrices: SparsePair
    linear: SparsePair | None = None

    @property
    def buffers(self) -> dict[str, Tensor]:
        """The tensors by their names in an operator."""
        found = {f"weak_{name}": t for name, t in vars(self.matrices).items()}
        if self.linear is not None:
            found |= {f"linear_{name}": t for name, t in vars(self.linear).items()}
        return found
