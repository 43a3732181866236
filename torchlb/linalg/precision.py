"""Constants set by rounding, memory and computing time, shared by all packages."""

from __future__ import annotations

import numpy as np

EPS = float(np.finfo(float).eps)
"""Machine epsilon of float64, 2e-16."""
ROUNDING: float = EPS**0.75
"""Relative rounding error that a sum of thousands of terms may have, 2e-12."""
ROOT_EPS: float = EPS**0.5
"""Half of the digits, 1.5e-8: anything smaller is lost in a square, and no result has to be more accurate."""
TINY = float(np.finfo(float).tiny)
"""Smallest divisor, with which 0/0 is 0."""

NEGLIGIBLE = 1e-6
"""Relative size that affects no result; a volume, a spread or a residual below it counts as zero."""
SINGLE = 1e-5
"""Accuracy of single precision: error of solves in float32, and relative error of lengths that are rounded to it."""
SMALL = 1e-3
"""Relative change that affects a result by less than the mesh does."""
LOW = 0.1
"""Fraction of the usual value below which a quantity is poor, and of a shape from which on a warning is issued."""

BYTES = 2**24
"""Size of work arrays: smaller ones are mostly overhead, larger ones exceed the processor's cache."""
AT_ONCE = 2**13
"""Points, elements or rows of a matrix that are processed together; 2¹¹ to 2¹⁸ take the same time."""
DENSE = 600
"""Unknowns up to which a dense eigensolver is as fast."""
LARGEST_FACTORED = 100_000
"""Unknowns beyond which iterations replace sparse factors, whose memory grows faster than the number of points."""
ROUNDS = 20
"""Restarts after which an iteration has failed; two or three suffice as a rule."""
STEPS = 500
"""Largest number of steps of a Krylov method between restarts; a tenth suffices as a rule."""


def rows_at_once(size: int) -> int:
    """Number of rows of `size` numbers that fit into `BYTES`, at least 64.

    >>> rows_at_once(2**10)
    2048
    """
    return max(64, BYTES // max(8 * size, 1))
