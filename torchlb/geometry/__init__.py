"""From points to neighbourhoods and tangent frames (`method.md`, sections 3, 4 and 6).

`numbering`: points in the order of a k-d tree, so that near ones are near in memory. `voronoi`: cells in the tangent
plane. `admission`: who may enter a stencil. `neighbors`: the nearest, and graph balls. `candidates`: the neighbourhoods
that a point tries. `frames`: tangent planes, refined by fits, and coordinates in them. `orientation`: which way is out,
and the two sides of thin shapes. `local_fits`: one polynomial a vertex, of functions and of the surface; `fit_search`:
which. `boundary`: its points and conormals. A surface through a cloud of points (section 12), `surface`, is found in
steps: `outliers`, which points lie on none; `noise`, where the others belong; `delaunay`, tetrahedra; `cocone`, normals
and triangles; `poles`, which way is out; `manifold`, which triangles hang together; `gaps`, filled and closed; `stars`,
where no sheet goes through. `doubtful`: what it may join or close in error, and what that does; `places`: where.
`vectors`: sums over many short ones.
"""
