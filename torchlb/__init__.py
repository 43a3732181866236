"""High-order Laplace–Beltrami operators on meshes and point clouds, for PyTorch.

The walk: points become neighbours (`neighbors`), frames (`tangent`), offsets and weights (`weights`), rows of one
sparse operator (`stencil`), stored in a module (`laplace_beltrami`). Its eigenpairs (`eigensolver`), what is made of
them (`spectral`) and the layers that learn (`diffusion`, `diffusion_net`) take that module as an argument. `surfaces`
has shapes with exact answers.
"""

from torchlb import surfaces
from torchlb.certificate import Certificate, StabilityWarning
from torchlb.checks import clean_mesh
from torchlb.diffusion import Diffusion, heat_flow
from torchlb.diffusion_net import DiffusionNet, DiffusionNetBlock, GradientFeatures
from torchlb.eigenbasis import Eigenbasis
from torchlb.laplace_beltrami import LaplaceBeltrami
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

__all__ = [
    "Certificate",
    "Diffusion",
    "DiffusionNet",
    "DiffusionNetBlock",
    "Eigenbasis",
    "GradientFeatures",
    "LaplaceBeltrami",
    "SpectralConv",
    "StabilityWarning",
    "StencilError",
    "StencilReport",
    "clean_mesh",
    "diffusion_distance",
    "diffusion_map",
    "heat_flow",
    "heat_kernel_signature",
    "spectral_wavelets",
    "surfaces",
    "wave_kernel_signature",
]
__version__ = "0.1.0"
