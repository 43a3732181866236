"""The one table of tolerances. Scale a quantity to order one, then `assert_close(a, b, **TOLERANCE[a.dtype])`."""

import torch

TOLERANCE = {
    torch.float32: {"rtol": 1e-4, "atol": 1e-5},
    torch.float64: {"rtol": 1e-9, "atol": 1e-10},
}
