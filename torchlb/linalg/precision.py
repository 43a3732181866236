"""What rounding, memory and patience allow: the numbers that all rooms share."""

from __future__ import annotations

import numpy as np

EPS = float(np.finfo(float).eps)
"""Rounding of one number in float64, 2e-16."""
ROUNDING: float = EPS**0.75
"""Share of its terms that a sum of thousands may be off by, 2e-12."""
ROOT_EPS: float = EPS**0.5
"""Half of the digits, 1.5e-8: what is smaller is gone in a square, and no answer has to be more accurate."""
TINY = float(np.finfo(float).tiny)
"""Least divisor, which keeps 0/0 at 0."""

NEGLIGIBLE = 1e-6
"""Share of a quantity that no result shows; a volume, a spread or a residual below it counts as none."""
SINGLE = 1e-5
"""What single precision is good for: error of solves in float32, and share of lengths that rounding to it makes."""
SMALL = 1e-3
"""Share of a quantity that changes a result by less than the mesh does."""
LOW = 0.1
"""Share of what is usual below which something is poor, and of a shape from which on a warning names it."""

BYTES = 2**24
"""Size of the arrays that are worked on: smaller ones are mostly overhead, larger ones leave the processor's cache."""
AT_ONCE = 2**13
"""Points, elements or rows of a matrix that are worked on together; 2¹¹ to 2¹⁸ take the same time."""
DENSE = 600
"""Unknowns up to which a dense eigensolver is as fast."""
LARGEST_FACTORED = 100_000
"""Unknowns beyond which an iteration takes the place of sparse factors, whose memory grows faster than the points."""
ROUNDS = 20
"""Restarts of an iteration, after which it has failed; two or three suffice where things are well."""
STEPS = 500
"""Steps of a Krylov method between restarts at most; a tenth suffices where things are well."""


def rows_at_once(size: int) -> int:
    """Rows of so many numbers that fit into `BYTES`, at least 64.

    >>> rows_at_once(2**10)
    2048
    """
    return max(64, BYTES // max(8 * size, 1))
