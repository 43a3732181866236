"""What acts on functions, with the operator as an argument: solves, flows, and the layers that learn.

`checks`: what all of them ask of features and operator. `systems`: the linear systems, and their factors.
`conduction`: the stiffness of div κ∇. `solves`: implicit steps and Poisson problems. `pair_flow`: heat flow by
solves. `geodesics`: distances. `diffusion`: heat flow for given and for learned times. `spectral_conv`: learned
filters in the spectrum. `gradient_features`: tangent fields. `implicit_diffusion`, `poisson_block`: layers that solve
instead. `pointwise`: what acts on each point. `diffusion_net`: the network of Sharp et al. on any operator, with
blocks of either kind.
"""
