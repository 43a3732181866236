"""High-order Laplace–Beltrami operators on meshes and point clouds, for PyTorch.

The packages, lowest first: `linalg`, matrices without shapes; `fits`, weights from local polynomials; `geometry`,
neighbours, frames, boundaries; `cloud`, from points to cells; `baseline`, libigl's cotangents; `galerkin`, the weak
pair; `stencils`, rows of Δ and ∇; `certified`, their certificate; `spectral`, eigenpairs and signatures; `operator`,
the module that holds them; `pde`, solves and flows; `nn`, layers; `io` and `interop`, files and other libraries.
`surfaces` are shapes with exact answers.
"""

from importlib import import_module
from typing import Any

from torchlb import surfaces
from torchlb.certified.certificate import Certificate
from torchlb.errors import (
    CacheWarning,
    DerivativeError,
    DiffusionError,
    EigenbasisError,
    InputError,
    InputTypeError,
    OperatorFileError,
    StabilityError,
    StabilityWarning,
    StencilError,
    TorchlbError,
    TorchlbWarning,
)
from torchlb.io.cache import load_operator, load_or_build, operator_key, save_operator
from torchlb.io.files import read_point_data, read_shape, write_shape
from torchlb.io.precompute import PrecomputeReport, ShapeResult, precompute_operators
from torchlb.nn.diffusion import Diffusion, ImplicitDiffusion
from torchlb.nn.diffusion_net import DiffusionNet, DiffusionNetBlock
from torchlb.nn.gradient_features import GradientFeatures
from torchlb.nn.poisson_block import PoissonBlock, PoissonFeatures
from torchlb.nn.spectral_conv import SpectralConv
from torchlb.nn.tangent import TangentBlock, TangentDiffusion
from torchlb.operator.cleaning import clean_mesh, clean_points, submesh
from torchlb.operator.collate import collate
from torchlb.operator.connection import Connection
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.report import StencilReport
from torchlb.operator.stencil_methods import Curvatures
from torchlb.pde.geodesics import geodesic_distance, logarithmic_map
from torchlb.pde.heat import heat_flow, smooth
from torchlb.pde.hodge import HodgeParts, hodge_decomposition
from torchlb.pde.solves import implicit_step, poisson_solve
from torchlb.pde.transport import parallel_transport, vector_heat_flow
from torchlb.spectral.eigenbasis import Eigenbasis
from torchlb.spectral.signatures import (
    diffusion_distance,
    diffusion_map,
    heat_kernel_signature,
    spectral_wavelets,
    wave_kernel_signature,
)
from torchlb.stencils.conditions import Robin
from torchlb.version import __version__

__all__ = ["Certificate", "Connection", "Curvatures", "LaplaceBeltrami", "Robin", "StencilReport"]
__all__ += ["__version__", "clean_mesh", "clean_points", "collate", "submesh", "surfaces"]
__all__ += ["Eigenbasis", "diffusion_distance", "diffusion_map", "heat_kernel_signature"]
__all__ += ["spectral_wavelets", "wave_kernel_signature"]
__all__ += ["HodgeParts", "geodesic_distance", "heat_flow", "hodge_decomposition", "implicit_step"]
__all__ += ["logarithmic_map", "parallel_transport", "poisson_solve", "smooth", "vector_heat_flow"]
__all__ += ["Diffusion", "DiffusionNet", "DiffusionNetBlock", "GradientFeatures"]
__all__ += ["ImplicitDiffusion", "PoissonBlock", "PoissonFeatures", "SpectralConv"]
__all__ += ["TangentBlock", "TangentDiffusion"]
__all__ += ["PrecomputeReport", "ShapeResult", "load_operator", "load_or_build", "operator_key"]
__all__ += ["precompute_operators", "read_point_data", "read_shape", "save_operator", "write_shape"]
__all__ += ["CacheWarning", "DerivativeError", "DiffusionError", "EigenbasisError", "InputError"]
__all__ += ["InputTypeError", "OperatorFileError", "StabilityError", "StabilityWarning"]
__all__ += ["StencilError", "TorchlbError", "TorchlbWarning"]


def __getattr__(name: str) -> Any:
    """Import `torchlb.interop` and `torchlb.plot` on first use."""
    if name in ("interop", "plot"):
        return import_module(f"torchlb.{name}")
    raise AttributeError(f"module 'torchlb' has no attribute {name!r}")
