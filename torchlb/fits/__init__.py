"""Local fits (`method.md`, section 2): from coordinates of neighbours to weights of derivatives.

`polynomials`: monomials, and what a functional does to them. `least_squares`: many small problems, each factored once
for all. `weights`: derivatives at the centre, which the polynomial passes through. `polyharmonic`: splines with polynomials. `rules`: these by name, and what
good stencils have.
"""
