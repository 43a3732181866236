"""Reconstruction of a complex through a cloud, and what is doubtful about it (`method.md`, sections 4, 6 and 12).

`reconstruct` makes a `Complex` (`complexes`, `reconstruction`): chains of segments for a `curve`, Delaunay tetrahedra
for a `solid`, triangles for a `surface` in R² and R³, and the stars of the `tangential` Delaunay complex otherwise.

The steps of `surface` are: `frames`, tangent planes, normals and their signs; `noise`, denoising, and lone points put
aside; `cocone`, Delaunay tetrahedra and candidate triangles; `poles`, inside and outside by Voronoi cells; `manifold`,
fans, patches and winding; `gaps`, filled, closed, or left to local stars. `doubts`: triangles that may join or close in
error, their effect, and the warnings. `voronoi`: cells in the tangent plane, and the boundary of a mask where simplices
overlap.
"""

from torchlb.cloud.complexes import Complex
from torchlb.cloud.reconstruction import reconstruct
from torchlb.cloud.surface import CloudSurface, SurfaceSummary

__all__ = ["CloudSurface", "Complex", "SurfaceSummary", "reconstruct"]
