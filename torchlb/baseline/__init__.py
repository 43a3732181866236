"""The low-order peers as strong-form rows, analyst's sign; the only imports of either library.

`cotangent`: libigl's cotangent operator. `robust`: robust_laplacian's rows, of any triangle mesh or a cloud.
"""
