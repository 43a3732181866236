"""Connected components of a shape, and the functions that are constant on each: the null space of K."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import linalg


def constants(
    component: np.ndarray, areas: Float[np.ndarray, " P"], k: int
) -> Float[np.ndarray, "N k"]:
    """The first k of orthonormal functions that are constant on every component; the first is constant everywhere.

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
    q = np.linalg.qr(np.column_stack([root, np.eye(len(root), k - 1)]))[0]
    values[on] = q * np.sign(q[0, 0]) / root[:, None]
    values[on, 0] = 1 / linalg.norm(root)
    return values[component]
