"""Reconstruction of a complex through a cloud, and what is doubtful about it (`method.md`, sections 4, 6 and 12).

`reconstruct` makes a `Complex` (`complexes`, `reconstruction`): chains of segments for a `curve`, Delaunay tetrahedra
for a `solid`, triangles for a `surface` in R² and R³, and the stars of the `tangential` Delaunay complex otherwise.

The steps of `surface` are: `outliers`, lone points; `frames`, tangent planes and normals; `orientation`, signs of the
normals by neighbours; `noise`, denoising; `cocone`, Delaunay tetrahedra and candidate triangles; `poles`, inside and
outside by Voronoi cells; `manifold`, fans, patches and winding; `gaps`, filled and closed; `stars`, local triangles
where no sheet passes. `doubtful`: triangles that may join or close in error, and their effect; `doubts`: the warnings,
which name `places`. Where cells overlap, the `boundary` comes from a mask, with the sizes of `voronoi` cells in the
tangent plane.
"""

from torchlb.cloud.complexes import Complex
from torchlb.cloud.reconstruction import reconstruct
from torchlb.cloud.surface import CloudSurface, SurfaceSummary

__all__ = ["CloudSurface", "Complex", "SurfaceSummary", "reconstruct"]
