"""From a shape to the rows of Δ and ∇: every point takes the first stencil that passes (`method.md`, section 4).

`shape`: frames, normals, boundary, neighbourhoods and areas, and the plan of them. `conditions`: boundary conditions.
`options`: a user's choices. `low_order`: rows of points without a stencil. `rows`: rows of a sparse operator, with a
record of the stencil behind each. `assemble`: candidates, their tests, rows.
"""
