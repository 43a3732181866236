"""Layers: they hold what is learned, and take the operator as an argument.

`checks`: what all of them ask of features. `diffusion`: heat flow for learned times. `spectral_conv`: learned filters
in the spectrum. `gradient_features`: tangent fields. `implicit_diffusion`, `poisson_block`: layers that solve instead.
`pointwise`: what acts on each point. `diffusion_net`: the network of Sharp et al. on any operator, with blocks of
either kind.
"""
