"""Layers: they hold learned parameters, and take the operator as an argument.

`checks`: checks of features, for all layers. `diffusion`: heat flow for learned times. `spectral_conv`: learned filters
in the spectrum. `gradient_features`: tangent fields. `implicit_diffusion`, `poisson_block`: layers that solve linear
systems. `pointwise`: networks at each point. `tangent`: functions and tangent fields together.
`diffusion_net`: the network of Sharp et al. on any operator, with blocks of any kind.
"""
