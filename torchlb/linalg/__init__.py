"""Linear algebra that knows nothing of shapes.

`precision`: the numbers that rounding, memory and patience set. `checks`: functions are finite tensors. `kernels`: the
two compiled loops. `sparse`: the product with a CSR matrix that layers differentiate through. `csr`: matrices and other
tensors as they are stored. `factor`: sparse Cholesky and LU. `lanczos`: eigenpairs of a symmetric pencil.
`conjugate_gradients`: solves with many right-hand sides. `two_grid`: their preconditioner. `exponential`: e^{tL}x by
a Chebyshev or a rational series, with derivatives. `once`: an error for second derivatives, where there are none.
`threads`: one thread for small tensors.
"""
