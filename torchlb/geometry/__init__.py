"""Neighbourhoods, tangent frames and local fits of a set of points (`method.md`, sections 3, 4 and 6).

`thresholds`: angles and factors by which shapes are judged. `numbering`: the order of the points along a k-d tree.
`complex`: edges, components and orientations of simplices. `compatibility`: which neighbours are compatible, and the
two sides of thin shapes. `neighbors`: nearest neighbours and k-hop neighbourhoods. `candidates`: the neighbourhoods
tried at a point. `frames`: tangent frames and coordinates in them. `local_fits`: one polynomial per vertex, for
functions and for the surface; `fit_search`: the choice of their degrees and neighbours. `boundary`: boundary points and
conormals. `vectors`: operations on many short vectors.
"""
