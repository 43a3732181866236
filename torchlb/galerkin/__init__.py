"""The weak form (`method.md`, section 9): stiffness and mass matrix of a complex of simplices, d = 1, 2, 3, in Rⁿ.

Decisions (`CurvingPlan`, `PairPlan`) are kept apart from what is evaluated at given points. `elements`: Lagrange
elements on the reference simplex. `nodes`: the numbering of Lagrange nodes on a complex. `assembly`: K_FE and M_FE.
`curving`: positions of the nodes on the surface, and which cells stay flat. `coarse`: triangles too coarse for the
fits; `delaunay`: the intrinsic Delaunay tufted cover that replaces them. `prolongation`: P, from the vertices to the
nodes. `boundary`: nodes on curves along the boundary of a surface, or on the boundary surface of a solid. `flips`:
edge flips that remove folded triangles and slivers. `medium`: conductivity, density and potential. `forms`: PᵀK_FE P
and PᵀM_FE P, in any medium, and bilinear forms; `matrices`: K, M and what is added to them. `tangent`: matrices of
tangent fields, and between these and functions; `creases`: these fields where triangles fold. `pair`: an operator's
matrices and positive lumped mass; `device`: what they are made of elsewhere than on the CPU.
"""
