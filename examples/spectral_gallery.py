"""What the eigenbasis of a surface gives: eigenfunctions, heat kernel signatures, wavelets; one picture.

Usage: python examples/spectral_gallery.py [--out spectral_output] [--points 0] [--k 128]
The cortical surface fsaverage5 (inflated, mm) that comes with nilearn, or a star-shaped one of --points points.
"""

import argparse
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")  # pictures go to files; no screen is needed
import matplotlib.pyplot as plt
import numpy as np
import torch

from torchlb import LaplaceBeltrami, heat_kernel_signature, spectral_wavelets
from torchlb.plot import plot_surface
from torchlb.surfaces import StarShaped

VIEW = (20.0, 200.0)  # elevation and azimuth of the eye: the outer side of the left hemisphere
EIGENFUNCTIONS = [1, 2, 5, 20]


def surface(points):
    """Vertices, faces and the unit of length; the analytic surface where points are asked for or nilearn is missing."""
    try:
        from nilearn.datasets import fetch_surf_fsaverage
        from nilearn.surface import load_surf_mesh
    except ImportError:
        points = points or 4000
    if points:
        return *StarShaped().mesh(points), ""
    mesh = load_surf_mesh(fetch_surf_fsaverage("fsaverage5")["infl_left"])  # no download
    vertices, faces = np.array(mesh.coordinates, float), np.array(mesh.faces, int)
    return torch.tensor(vertices), torch.tensor(faces), "mm"


def panels(lb, k):
    """Titles and scalars: eigenfunctions, signatures at three times, curvature, wavelets of a point at four scales."""
    basis = lb.eigenbasis(k)
    values = basis.eigenvalues
    for i in EIGENFUNCTIONS:
        length = 2 * torch.pi / values[i] ** 0.5
        yield f"eigenfunction {i}, wavelength {length:.3g}", basis.eigenvectors[:, i]
    times = torch.tensor([4 / values[-1], 4 / values[k // 8], 1 / values[1]])
    for t, signature in zip(times, heat_kernel_signature(lb, times, k=k).T, strict=True):
        yield f"log₁₀ of the heat kernel signature, t = {t:.3g}", signature.log10()
    yield "mean curvature H = |Δx|/2", lb.mean_curvature_normal().norm(dim=1) / 2
    point = int(lb.points[:, 0].argmin())
    delta = torch.zeros(lb.num_points, 1, dtype=values.dtype)
    delta[point] = 1 / lb.mass[point]
    scales = 1 / values[torch.tensor([k // 2, k // 8, k // 32, 1])]
    coefficients = spectral_wavelets(lb, delta, scales, k=k)[:, 1:, 0]  # the first is the low-pass
    for s, wavelet in zip(scales, coefficients.T, strict=True):
        yield f"wavelet at one point, scale √s = {s**0.5:.3g}", wavelet


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("spectral_output"), help="for the picture")
    parser.add_argument("--points", type=int, default=0, help="of an analytic surface instead")
    parser.add_argument("--k", type=int, default=128, help="eigenpairs")
    options = parser.parse_args(arguments)
    vertices, faces, unit = surface(options.points)
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    figure, axes = plt.subplots(3, 4, figsize=(20, 10), layout="constrained")
    for ax, (title, values) in zip(axes.flat, panels(lb, options.k), strict=True):
        plot_surface(vertices, faces, values, ax=ax, title=title, view=VIEW)
    figure.suptitle(f"{lb.num_points:,} points" + (unit and f", lengths in {unit}"))
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "spectral.png", dpi=90)
    plt.close(figure)
    print(lb.eigenbasis(options.k), options.out / "spectral.png", sep="\n")


if __name__ == "__main__":
    main()
