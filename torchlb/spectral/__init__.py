"""The spectrum of −Δ (`method.md`, section 7) and what is computed from it.

`eigenbasis`: eigenpairs, and the way there and back. `eigensolver`: from an operator that is not symmetric to a real,
orthonormal basis. `pencil`: from a symmetric pair of stiffness and mass. `signatures`: heat and wave kernel signatures,
wavelets, diffusion maps.
"""
