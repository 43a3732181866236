"""Points in the order of a k-d tree, so that near ones are near in memory, and back to the user's numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor


@dataclass(frozen=True)
class Numbering:
    """A permutation of the points of a shape; all that is built from near points is built faster in it.

    Attributes
    ----------
    given : (N,), of each point, in the order of the tree, the number that the user gave it.
    here : (N,), of each of the user's points the place in that order.

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
