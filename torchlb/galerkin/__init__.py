"""The weak form (`method.md`, section 9): stiffness and mass matrix of a complex of simplices, d = 1, 2, 3, in Rⁿ.

`elements`: Lagrange elements on the reference simplex. `nodes`: their numbers on a complex. `assembly`: K_FE and M_FE.
`curving`: where the nodes stand on the surface, and where cells are left flat. `coarse`: triangles that fits have
nothing to say about; `delaunay`: what stands for these. `prolongation`: P, from the vertices to the nodes. `rim`:
curves through the boundary of triangles. `boundary`: the nodes along a boundary. `flips`: folded triangles and slivers
out of the way. `pair`: PᵀK_FE P, PᵀM_FE P and the positive mass. `medium`: the same for a conductivity.
"""
