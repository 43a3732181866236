"""The spectrum of −Δ (`method.md`, section 7) and what is computed from it.

`eigenbasis`: eigenpairs, and the way there and back. `pencil`: how they are found, from a symmetric pair of stiffness
and mass. `components`: on each connected component, with its constants. `signatures`: heat and wave kernel signatures,
wavelets, diffusion maps.
"""
