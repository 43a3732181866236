"""Proof, on request, that diffusion by the stencil contracts (`method.md`, section 5), and its enforcement.

Only `operator.build` requests it. `certificate`: π with πᵀL = 0, and the check of π > 0 and S ≤ 0. `enforce`: order
reduction of rows until the certificate holds.
"""
