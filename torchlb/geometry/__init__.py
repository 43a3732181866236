"""From points to neighbourhoods and tangent frames (`method.md`, sections 3, 4 and 6).

`thresholds`: the angles and factors by which shapes are judged. `numbering`: points in the order of a k-d tree, so that
near ones are near in memory. `complex`: edges, components and orientation of simplices. `compatibility`: who may enter
a stencil, and the two sides of thin shapes. `neighbors`: the nearest, and k-hop neighbourhoods. `candidates`: the
neighbourhoods that a point tries. `frames`: tangent planes, refined by fits, and coordinates in them. `local_fits`: one
polynomial a vertex, of functions and of the surface; `fit_search`: which. `boundary`: its points and conormals.
`vectors`: sums over many short ones.
"""
