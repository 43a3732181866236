"""Layers: they hold learned parameters, and take the operator as an argument.

`diffusion`: heat flow, and an implicit step of it, for learned times. `spectral_conv`: learned filters in the spectrum.
`gradient_features`: tangent fields. `poisson_block`: layers that solve a Poisson problem. `tangent`: functions and
tangent fields together. `diffusion_net`: the network of Sharp et al. on any operator, with blocks of any kind.
`pointwise`: checks of features, and networks at each point.
"""
