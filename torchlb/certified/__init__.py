"""Proof, on request, that diffusion by the stencil contracts (`method.md`, section 5); only `operator.build` asks.

`certificate`: π with πᵀL = 0, the check of π > 0 and S ≤ 0, and order reduction of rows until both hold.
"""
