"""Operators that several tests build."""

from functools import partial

from torchlb import LaplaceBeltrami

stencil_of_mesh = partial(LaplaceBeltrami.from_mesh, weak_form=False)
"""The certified stencil alone, which does all the work where there is no weak pair."""
