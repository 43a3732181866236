"""Wavelets on a surface: a signal's bands from coarse to fine, whose energies add up, and what they sum to.

Usage: python examples/wavelets.py [--output gallery_output] [--points 0] [--k 300]
The signal is FreeSurfer's `sulc` of fsaverage5, which comes with nilearn; the mean curvature of another surface.
"""

import matplotlib.pyplot as plt
import torch
from _common import LEFT, cortex, read_options, save

from torchlb import LaplaceBeltrami, spectral_wavelets
from torchlb.plot import plot_surface


def sulcal_depth():
    """FreeSurfer's depth of the sulci at the vertices of fsaverage5."""
    from nilearn.datasets import fetch_surf_fsaverage
    from nilearn.surface import load_surf_data

    return torch.tensor(load_surf_data(fetch_surf_fsaverage("fsaverage5")["sulc_left"])).double()


def main(arguments=None):
    options = read_options(
        __doc__, arguments, points=(0, "of an analytic surface instead"), k=(300, "eigenpairs")
    )
    vertices, faces, name, unit = cortex(points=options.points)
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    signal = sulcal_depth() if unit else lb.mean_curvature_normal().norm(dim=1) / 2
    values = lb.eigenbasis(options.k).eigenvalues

    # Bands at a quarter of each other's eigenvalue, twice the wavelength, up to the last that there is.
    scales = 4.0 ** torch.arange(3, -1, -1) / values[-1]
    bands = spectral_wavelets(lb, signal[:, None], scales, k=options.k)[..., 0]  # (N, 1 + scales)
    again = spectral_wavelets(lb, bands, scales, k=options.k).diagonal(dim1=1, dim2=2).sum(1)
    energies = lb.mass @ bands.square()
    total = lb.mass @ signal.square()
    lengths = 2 * torch.pi * scales.sqrt()
    titles = ["low-pass", *(f"wavelength {length:.3g} {unit}" for length in lengths)]
    print(f"{name}: share of the signal's energy in each band of a tight frame")
    for title, energy in zip(titles, energies, strict=True):
        print(f"{title:>22}: {energy / total:6.1%}")
    print(f"{'together':>22}: {energies.sum() / total:6.1%}")
    error = (again - signal).square() @ lb.mass / total
    print(f"{'left out by k':>22}: {error:6.1%}")

    panels = {"signal: sulcal depth" if unit else "signal: mean curvature": signal} | dict(
        zip(titles, bands.T, strict=True)
    )
    figure, axes = plt.subplots(2, 3, figsize=(13.5, 6.4), layout="constrained")
    for ax, (title, band) in zip(axes.flat, panels.items(), strict=True):
        plot_surface(vertices, faces, band, ax=ax, title=title, view=LEFT)
    save(figure, options.output, "wavelets.png")


if __name__ == "__main__":
    main()
