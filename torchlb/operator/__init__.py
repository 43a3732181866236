"""The operator as a module, from input to answer.

`inputs`: what comes in as tensors. `options`: the choices of a user. `cleaning`: every face and point once, wound
alike. `checks`: bad input is refused, with the remedy. `report`: what order was reached where. `storage`: its tensors,
and how they travel; `parts`: the pair and the eigenbasis among them. `batching`: several shapes as one operator.
`assembled`: a finished operator before it is stored. `plan`: what is decided about it, and what follows at given
points. `build`: checked input to both; `build_cloud`: the same by a complex through a cloud. `stencil_methods`: Δf, ∇f
and curvature at a point. `pair_methods`: the matrices of the weak pair, the eigenbasis. `through`: derivatives in the
points. `laplace_beltrami`: the class. `dispatch`: any operator by name and options. `collate`: samples of a
`DataLoader`.
"""
