"""High-order Laplace–Beltrami operators on meshes and point clouds, for PyTorch.

The walk: points become neighbours (`neighbors`), frames (`tangent`), offsets and weights (`weights`), rows of one
sparse operator (`stencil`), stored in a module (`laplace_beltrami`). Its eigenpairs (`eigensolver`), what is made of
them (`spectral`) and the layers that learn (`diffusion`, `diffusion_net`) take that module as an argument. `surfaces`
has shapes with exact answers.
"""

from torchlb import surfaces
from torchlb.cache import (
    CacheWarning,
    OperatorFileError,
    load_operator,
    load_or_build,
    operator_key,
    save_operator,
)
from torchlb.certificate import Certificate, StabilityWarning
from torchlb.checks import clean_mesh
from torchlb.diffusion import Diffusion, heat_flow
from torchlb.diffusion_net import DiffusionNet, DiffusionNetBlock, GradientFeatures
from torchlb.eigenbasis import Eigenbasis
from torchlb.laplace_beltrami import LaplaceBeltrami
from torchlb.precompute import PrecomputeReport, ShapeResult, precompute_operators
from torchlb.report import StencilReport
from torchlb.spectral import (
    SpectralConv,
    diffusion_distance,
    diffusion_map,
    heat_kernel_signature,
    spectral_wavelets,
    wave_kernel_signature,
)
from torchlb.stencil import StencilError
from torchlb.version import __version__

__all__ = [
    "CacheWarning",
    "Certificate",
    "Diffusion",
    "DiffusionNet",
    "DiffusionNetBlock",
    "Eigenbasis",
    "GradientFeatures",
    "LaplaceBeltrami",
    "OperatorFileError",
    "PrecomputeReport",
    "ShapeResult",
    "SpectralConv",
    "StabilityWarning",
    "StencilError",
    "StencilReport",
    "__version__",
    "clean_mesh",
    "diffusion_distance",
    "diffusion_map",
    "heat_flow",
    "heat_kernel_signature",
    "load_operator",
    "load_or_build",
    "operator_key",
    "precompute_operators",
    "save_operator",
    "spectral_wavelets",
    "surfaces",
    "wave_kernel_signature",
]
