"""From a shape to the rows of Δ and ∇: every point takes the first stencil that passes (`method.md`, section 4).

`rows`: rows of a sparse operator, with what is known of each. `conditions`: what holds at the boundary. `low_order`:
the rows of points without a stencil. `placed`: frames, normals and boundary, by a plan at given points. `shape`: these
with neighbourhoods, areas and low-order rows. `acceptance`: the local tests. `assemble`: candidates to weights to rows.
"""
