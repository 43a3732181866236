"""Angles, factors and shares by which shapes are judged."""

from __future__ import annotations

from math import acos, cos, pi, radians, sqrt

CREASE = cos(radians(60))
"""Cosine of the least angle between two tangent planes, or two edges, that counts as a crease, a fold or a corner."""
LEVEL = cos(radians(45))
"""Cosine, and sine, of the angle that separates level from steep."""
KINK = cos(radians(20))
"""Cosine of the largest turning angle that counts as smooth."""
OBTUSE = pi - acos(CREASE)
"""Supplement of the crease angle, 120° in radians: a gap around a point, or a turn back."""
HALF_CREASE = sqrt((1 - CREASE) / 2)
"""Sine of half the crease angle: slope of the chord of an arc that turns by the crease angle, 0.5."""

FACTOR = 3.0
"""Multiple of what is usual (of good stencils, neighbours, flat triangles) from which on something is an outlier."""
WIDER = 1.5
"""Safety factor on what is needed, or usual."""
ROUGH = 0.3
"""Share by which a last resort may miss, or a shape leave its plane: heights over lengths, noise over spacings."""
SLIGHT = 0.05
"""Relative error allowed to a good fit, and overlap allowed to good triangles."""

AROUND = 6
"""Mean number of neighbours of a vertex in a planar triangulation, by Euler's formula."""
RING = 8
"""Number of nearest points that surround a point; groups of fewer points or cells do not count as a component."""
NEAREST = 24
"""Number of nearest points that hold the neighbours of a point, also in an uneven cloud: three rings."""
