"""On request, proof that diffusion by the stencil contracts (`method.md`, section 5), and what makes it hold.

Only `operator.build` asks for it. `null_vector`: π with πᵀL = 0. `krylov`: for matrices too large to factor.
`certificate`: π > 0 and S ≤ 0, checked. `enforce`: rows lower their order until it holds.
"""
