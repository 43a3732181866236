"""Points in the order of a k-d tree, so that near ones are near in memory, and back to the user's numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import KDTree
from torch import Tensor


@dataclass(frozen=True)
class Numbering:
    """A permutation of the points of a shape; all that is built from near points is built faster in it.

    Attributes
    ----------
    given
        (N,), of each point, in the order of the tree, the number that the user gave it.
    here
        (N,), of each of the user's points the place in that order.

    >>> numbering = Numbering.along_tree(torch.rand(50, 3))
    >>> numbering.given[numbering.here].equal(torch.arange(50))
    True
    """

    given: Int[Tensor, " N"]
    here: Int[Tensor, " N"]

    @classmethod
    def along_tree(cls, points: Float[Tensor, "N n"]) -> Numbering:
        """The order of the leaves of a k-d tree, the same however the points are numbered: they go in sorted."""
        places = points.numpy()
        first = np.lexsort(places.T)
        given = torch.from_numpy(first[KDTree(places[first]).indices])
        return cls(given, torch.empty_like(given).scatter_(0, given, torch.arange(len(given))))

    def sorted(self, values: Tensor) -> Tensor:
        """Values (N, …) of the user's points, in this order."""
        return values[self.given]

    def restored(self, values: Tensor) -> Tensor:
        """Inverse of `sorted`."""
        return values[self.here]

    def faces(self, faces: Int[Tensor, "F v"]) -> tuple[Int[Tensor, "F v"], Int[Tensor, " F"]]:
        """Faces in the numbers of this order, by their lowest; and of each its place among those given."""
        faces = self.here[faces]
        order = faces.amin(1).argsort(stable=True)
        return faces[order], order

    def restored_pattern(
        self, crow: Int[Tensor, " N_plus_1"], col: Int[Tensor, " nnz"]
    ) -> tuple[Int[Tensor, " N_plus_1"], Int[Tensor, " nnz"], Int[Tensor, " nnz"]]:
        """A sparse pattern (N, N) in the user's numbers, columns ascending, and of its entries the places here."""
        count, given = len(self.given), self.given.int().numpy()
        parts = np.arange(len(col), dtype=np.int32), given[col.numpy()], crow.numpy()
        turned: Any = sparse.csr_array(sparse.csr_array(parts, shape=(count, count)).T)
        turned.indices = given[turned.indices]
        whole: Any = sparse.csr_array(turned.T)  # sorted as it comes
        found = whole.indptr.astype(np.int64), whole.indices.astype(np.int64), whole.data
        return torch.from_numpy(found[0]), torch.from_numpy(found[1]), torch.from_numpy(found[2])
