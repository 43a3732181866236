"""The weak form (`method.md`, section 9): stiffness and mass matrix of a complex of simplices, d = 1, 2, 3, in Rⁿ.

What is decided (`CurvingPlan`, `PairPlan`) stands apart from what follows at given points. `elements`: Lagrange
elements on the reference simplex. `nodes`: their numbers on a complex. `assembly`: K_FE and M_FE. `curving`: where the
nodes stand on the surface, and where cells are left flat. `coarse`: triangles that fits have nothing to say about;
`delaunay`: what stands for these. `prolongation`: P, from the vertices to the nodes. `boundary_curves`: those through
the boundary of triangles. `boundary`: the nodes along a boundary. `flips`: folded triangles and slivers out of the way.
`forms`: PᵀK_FE P and PᵀM_FE P, for any conductivity. `pair`: the matrices of an operator, and the positive mass.
`absorption`: what a condition adds to K.
"""
