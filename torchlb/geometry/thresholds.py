"""The angles, factors and shares by which shapes are judged, each said once."""

from __future__ import annotations

from math import acos, cos, pi, radians, sqrt

CREASE = cos(radians(60))
"""Cosine of the angle between two tangent planes, or two edges, that makes a crease, a fold or a corner."""
LEVEL = cos(radians(45))
"""Cosine, and sine, of the angle that tells level from steep."""
KINK = cos(radians(20))
"""Cosine of the angle up to which what turns is taken for smooth."""
OBTUSE = pi - acos(CREASE)
"""What the angle of a crease leaves of a straight one, 120° in radians: a gap around a point, and a turn back."""
HALF_CREASE = sqrt((1 - CREASE) / 2)
"""Sine of half the angle of a crease: slope of the chord of an arc that turns by so much, 0.5."""

FACTOR = 3.0
"""Times what is usual, of good stencils, of neighbours or of flat triangles, from which on something is out of line."""
WIDER = 1.5
"""Times what is needed, or usual, that is safe: half as much again."""
ROUGH = 0.3
"""Share by which the last resort may miss, and a shape leave its plane: heights over lengths, noise over spacings."""
SLIGHT = 0.05
"""Share by which a good fit may miss, and good triangles overlap."""

AROUND = 6
"""Neighbours of a point in triangles of a plane, on average, by Euler's formula."""
RING = 8
"""Nearest points that surround one, and points or cells too few to be a part of their own."""
NEAREST = 24
"""Nearest points among which those beside one are, also where a cloud is uneven: three rings."""
