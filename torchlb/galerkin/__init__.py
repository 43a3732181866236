"""The weak form (`method.md`, section 9): stiffness and mass matrix from the fits of the vertices.

`elements`: Lagrange triangles and segments. `flips`: folded triangles and slivers out of the way. `nodes`: their
numbers on a mesh. `rim`: curves through its boundary. `curving`: where the nodes stand on the surface, and where it is
left flat. `coarse`: triangles that fits have nothing to say about; `delaunay`: what stands for these. `prolongation`:
P, from the vertices to the nodes. `assembly`: K_FE and M_FE. `pair`: PᵀK_FE P, PᵀM_FE P and the positive mass.
`medium`: the same for a conductivity.
"""
