"""What the eigenbasis of a surface gives: eigenfunctions, heat kernel signatures, wavelets; one picture.

Usage: python examples/spectral_gallery.py [--output gallery_output] [--points 0] [--k 128]
The cortical surface fsaverage5 (inflated, mm) that comes with nilearn, or a star-shaped one of --points points.
"""

import matplotlib.pyplot as plt
import torch
from _common import LEFT, cortex, read_options, save

from torchlb import LaplaceBeltrami, heat_kernel_signature, spectral_wavelets
from torchlb.plot import plot_surface

EIGENFUNCTIONS = [1, 2, 5, 20]


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
    options = read_options(
        __doc__, arguments, points=(0, "of an analytic surface instead"), k=(128, "eigenpairs")
    )
    vertices, faces, name, unit = cortex(points=options.points)
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    figure, axes = plt.subplots(3, 4, figsize=(20, 10), layout="constrained")
    for ax, (title, values) in zip(axes.flat, panels(lb, options.k), strict=True):
        plot_surface(vertices, faces, values, ax=ax, title=title, view=LEFT)
    figure.suptitle(f"{name}, {lb.num_points:,} points" + (unit and f", lengths in {unit}"))
    print(lb.eigenbasis(options.k))
    save(figure, options.output, "spectral_gallery.png")


if __name__ == "__main__":
    main()
