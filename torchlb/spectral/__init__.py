"""The spectrum of −Δ (`method.md`, section 7) and quantities computed from it.

`eigenbasis`: eigenpairs, analysis and synthesis. `pencil`: eigenpairs of a symmetric pair of stiffness and mass;
`sweeps`: their refinement. `signatures`: heat and wave kernel signatures, wavelets, diffusion maps.
"""
