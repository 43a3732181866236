"""Equations on a shape, with the operator as an argument; nothing here learns.

`checks`: checks of functions and of the operator. `solves`: implicit steps and Poisson problems. `heat`: heat flow by
such solves, by the spectrum or by series. `geodesics`: distances and the logarithmic map, `fronts`: their compiled
loops. `transport`: flow and transport of tangent fields. `hodge`: their decomposition.
"""
