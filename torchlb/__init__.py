"""High-order Laplace–Beltrami operators on meshes and point clouds, for PyTorch.

The walk: points become neighbours (`neighbors`), frames (`tangent`), offsets and weights (`weights`), rows of one
sparse operator (`stencil`), stored in a module (`laplace_beltrami`). `surfaces` has shapes with exact answers.
"""

from torchlb import surfaces
from torchlb.certificate import Certificate, StabilityWarning
from torchlb.checks import clean_mesh
from torchlb.laplace_beltrami import LaplaceBeltrami
from torchlb.report import StencilReport
from torchlb.stencil import StencilError

__all__ = [
    "Certificate",
    "LaplaceBeltrami",
    "StabilityWarning",
    "StencilError",
    "StencilReport",
    "clean_mesh",
    "surfaces",
]
__version__ = "0.1.0"
