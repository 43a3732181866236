"""Adapters to other libraries, each in the words of the library that it is named after.

`trimesh`: shapes from files and back. `conventions`: signs, factors and masses of igl, potpourri3d, LaPy and PyG.
`pyg`: PyTorch Geometric's data, batches and loaders. `diffusion_net`: the operators that DiffusionNet code expects.
Each needs its own library, and is imported on first use.
"""

from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    if name in ("conventions", "diffusion_net", "pyg", "trimesh"):
        return import_module(f"torchlb.interop.{name}")
    raise AttributeError(f"module 'torchlb.interop' has no attribute {name!r}")
