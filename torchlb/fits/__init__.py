"""Local fits (`method.md`, section 2): from coordinates of neighbours to weights of derivatives.

`polynomials`: monomials, and what a functional does to them. `least_squares`: many small problems, each factored once
for every right-hand side. `weights`: derivatives of the polynomial through the centre's value. `polyharmonic`: splines
with polynomials. `rules`: these by name, and what good stencils have.
"""
