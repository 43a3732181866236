"""Layers that learn, with the operator as an argument.

`checks`: what all of them ask of features and operator. `diffusion`: heat flow for given and for learned times.
`spectral_conv`: learned filters in the spectrum.
`gradient_features`, `diffusion_net`: the network of Sharp et al. on any operator.
"""
