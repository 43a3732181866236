"""The weak form (`method.md`, section 9): stiffness and mass matrix from the fits of the vertices.

`pair`: what the others make.
"""
