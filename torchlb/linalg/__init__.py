"""Linear algebra, independent of shapes.

`precision`: constants set by rounding, memory and computing time. `checks`: validation of tensors. `kernels`: the three
compiled loops. `sparse`: differentiable products with CSR matrices. `csr`: stored matrices and tensors of points.
`factor`: sparse Cholesky and LU. `lanczos`: eigenpairs of a symmetric pencil. `conjugate_gradients`: solves with many
right-hand sides. `two_grid`: their preconditioner. `exponential`: e^{tL}x by a Chebyshev or a rational series, with
derivatives. `once`: an error for second derivatives that do not exist. `threads`: one thread for small tensors.
`devices`: data and constants on a device.
"""
