"""Analytic manifolds with exact answers: points, meshes, derivatives and spectra to compare with.

`base`: a manifold from a retraction and a chart. `shapes`: spheres, tori, curves and others, with what is known of them
in closed form.
"""

from torchlb.surfaces.base import Surface
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
    "smooth_function",
    "spherical_harmonic",
]
