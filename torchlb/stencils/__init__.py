"""From a shape to the rows of Δ and ∇: every point takes the first stencil that passes (`method.md`, section 4).

`rows`: rows of a sparse operator, with a record of the stencil behind each. `conditions`: boundary conditions.
`low_order`: rows of points without a stencil. `placed`: frames, normals and boundary of a plan at given points.
`shape`: these with neighbourhoods, areas and low-order rows. `assemble`: candidates, their tests, rows.
"""
