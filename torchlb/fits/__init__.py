"""Local fits (`method.md`, section 2): from coordinates of neighbours to weights of derivatives.

`polynomials`: monomials, and differential functionals of them. `least_squares`: batches of small problems, each
factored once for all right-hand sides. `weights`: derivatives of the polynomial through the centre's value.
`polyharmonic`: polyharmonic splines with polynomials. `rules`: these rules by name, and figures of good stencils.
"""
