"""Proof that diffusion contracts (`method.md`, section 5), and what makes it hold.

`null_vector`: π with πᵀL = 0. `certificate`: π > 0 and S ≤ 0, checked. `enforce`: rows lower their order until it
holds.
"""
