"""Manifolds for comparison: analytic ones with exact points, derivatives and spectra, and smooth ones of real shapes.

`base`: a manifold from a retraction and a chart. `shapes`: spheres, tori, curves and others, with their closed forms.
`limit`: smooth surfaces of real shapes, by subdivision.
"""

from torchlb.surfaces.base import Surface
from torchlb.surfaces.limit import limit_surface
from torchlb.surfaces.shapes import (
    Circle,
    CliffordTorus,
    Ellipsoid,
    Hemisphere,
    SpaceCurve,
    Sphere,
    StarShaped,
    ThreeSphere,
    Torus,
    UnitDisk,
    deserno_points,
    smooth_function,
    spherical_harmonic,
)

__all__ = [
    "Circle",
    "CliffordTorus",
    "Ellipsoid",
    "Hemisphere",
    "SpaceCurve",
    "Sphere",
    "StarShaped",
    "Surface",
    "ThreeSphere",
    "Torus",
    "UnitDisk",
    "deserno_points",
    "limit_surface",
    "smooth_function",
    "spherical_harmonic",
]
