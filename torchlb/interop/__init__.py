"""At home in other libraries: each module speaks the words of the one that it is named after.

`trimesh`: shapes from files and back. `conventions`: signs, factors and masses of igl, potpourri3d, LaPy and PyG.
`pyg`: PyTorch Geometric's data, batches and loaders. `diffusion_net`: the operators that DiffusionNet code expects.
Import the one you need; each needs its own library.
"""
