"""Proof, on request, that diffusion by the stencil contracts (`method.md`, section 5), and its enforcement.

Only `operator.build` requests it. `null_vector`: π with πᵀL = 0. `krylov`: Krylov methods for matrices too large to
factor. `certificate`: check of π > 0 and S ≤ 0. `enforce`: order reduction of rows until the certificate holds.
"""
