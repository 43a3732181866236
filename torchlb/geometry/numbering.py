"""Numbering of points along a k-d tree, so that near points are near in memory, and back to the user's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from scipy import sparse
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.geometry.vectors import Points


@dataclass(frozen=True)
class Numbering:
    """Permutation of the points of a shape along a k-d tree, in which operators are built faster.

    `given` is the user's number of each point in the order of the tree, `here` the position of each of the user's
    points in that order.
    """

    given: Int[Tensor, " N"]
    here: Int[Tensor, " N"]

    @classmethod
    def along_tree(cls, points: Points) -> Numbering:
        """Order of the leaves of a k-d tree of the sorted points, the same however the user numbers them."""
        places = points.numpy()
        first = np.lexsort(places.T)
        given = torch.from_numpy(first[KDTree(places[first]).indices])
        return cls(given, torch.empty_like(given).scatter_(0, given, torch.arange(len(given))))

    def sorted(self, values: Tensor) -> Tensor:
        """Values (N, …) of the user's points, in the order of the tree."""
        return values[self.given]

    def restored(self, values: Tensor) -> Tensor:
        """Inverse of `sorted`."""
        return values[self.here]

    def of_nodes(self, count: int) -> tuple[Int[Tensor, " X"], Int[Tensor, " X"]]:
        """As `given` and `here`, of so many nodes, the points first, those beyond them with numbers of their own."""
        beyond = torch.arange(len(self.given), count)
        return torch.cat([self.given, beyond]), torch.cat([self.here, beyond])

    def faces(self, faces: Int[Tensor, "F v"]) -> tuple[Int[Tensor, "F v"], Int[Tensor, " F"]]:
        """(faces in the numbers of the tree, sorted by their lowest; the position of each among `faces`)."""
        faces = self.here[faces]
        order = faces.amin(1).argsort(stable=True)
        return faces[order], order

    def restored_pattern(
        self, crow: Int[Tensor, " N_plus_1"], col: Int[Tensor, " nnz"]
    ) -> tuple[Int[Tensor, " nnz"], Int[Tensor, " nnz"]]:
        """Columns of a sparse (N, N) pattern in the user's numbers, ascending, and their positions in `col`."""
        if col.device.type != "cpu":
            row = self.given.repeat_interleave(crow.diff())
            key, order = (row * len(self.given) + self.given[col]).sort()
            return key % len(self.given), order
        count, given = len(self.given), self.given.int().numpy()
        parts = np.arange(len(col), dtype=np.int32), given[col.numpy()], crow.numpy()
        turned: Any = sparse.csr_array(sparse.csr_array(parts, shape=(count, count)).T)
        turned.indices = given[turned.indices]
        whole: Any = sparse.csr_array(turned.T)  # transposing has sorted the columns
        return torch.from_numpy(whole.indices.astype(np.int64)), torch.from_numpy(whole.data)
