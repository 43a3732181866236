"""From points to a complex, and what is doubtful about it (`method.md`, sections 4, 6 and 12).

`reconstruct` makes a `Complex` (`complexes`, `reconstruction`): of a `curve` chains of segments, of a `solid`
Delaunay tetrahedra, of a `surface` in R² and R³ triangles, of all else the stars of the `tangential` Delaunay complex.

A surface through a cloud of points, `surface`, is found in steps:
`outliers`, which points lie on none; `frames`, tangent planes and normals; `orientation`, which way is out by
neighbours; `noise`, where the points belong; `cocone`, tetrahedra and candidates for triangles; `poles`,
which way is out by Voronoi cells; `manifold`, which triangles hang together; `gaps`, filled and closed; `stars`,
where no sheet goes through. `doubtful`: what it may join or close in error, and what that does; `doubts`: warnings of
that, which name the `places`. Where cells overlap the `boundary` is that of a mask, with the sizes of `voronoi`
cells in the tangent plane.
"""

from torchlb.cloud.complexes import Complex
from torchlb.cloud.reconstruction import reconstruct
from torchlb.cloud.surface import CloudSurface, SurfaceSummary

__all__ = ["CloudSurface", "Complex", "SurfaceSummary", "reconstruct"]
