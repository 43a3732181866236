"""The operator as a module, from input to answer.

`inputs`: points and faces as tensors. `cleaning`: duplicates, quads, orientation.
`checks`: bad input is refused, with the remedy. `report`: the order reached at each point. `storage`: the tensors,
and how they travel; `parts`: the weak pair and the eigenbasis among them. `batching`: several shapes as one operator.
`plan`: the decisions behind an operator, and its parts by them at given points. `build`: both from checked input.
`stencil_methods`: Δf, ∇f and curvatures at a point. `connection`: tangent fields.
`medium`: the weak pair in a medium. `systems`: linear systems of the pair, and their factors. `through`: derivatives
in points and medium. `pair_methods`: the pair's matrices, the eigenbasis.
`laplace_beltrami`: the class. `dispatch`: any operator by name and options. `collate`: samples of a `DataLoader`.
"""
