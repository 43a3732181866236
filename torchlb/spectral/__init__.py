"""The spectrum of −Δ (`method.md`, section 7) and what is computed from it.

`eigenbasis`: eigenpairs, and the way there and back. `pencil`: from a symmetric pair of stiffness and mass.
`components`: pieces of a shape, and their constants. `signatures`: heat and wave kernel signatures, wavelets, diffusion
maps.
"""
