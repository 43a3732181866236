"""Local fits (`method.md`, section 2): from coordinates of neighbours to weights of derivatives.

`polynomials`: monomials, and differential functionals of them. `weights`: least squares, each system factored once for
all right-hand sides. `rules`: these and polyharmonic splines by name, and figures of good stencils.
"""
