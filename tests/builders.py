"""Operators that several tests build."""

from functools import partial

from torchlb import LaplaceBeltrami

stencil_of_mesh = partial(LaplaceBeltrami.from_mesh, weak_form=False)
stencil_of_cloud = partial(LaplaceBeltrami.from_points, weak_form=False)
"""The certified stencil alone, which does all the work where there is no weak pair."""
