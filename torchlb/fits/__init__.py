"""Local fits (`method.md`, section 2): from coordinates of neighbours to weights of derivatives.

`polynomials`: monomials, and what a functional does to them. `weights`: centre-constrained least squares, one
factorisation for every functional. `polyharmonic`: splines with polynomials. `rules`: these by name, and what
good stencils have.
"""
