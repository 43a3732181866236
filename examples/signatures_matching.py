"""Heat and wave kernel signatures match the points of a turned cloud with the vertices of a mesh of the same surface.

Usage: python examples/signatures_matching.py [--output gallery_output] [--points 2000] [--k 100]
The two samplings have no point in common; signatures do not change under motions, nor under bending.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from _common import read_options, save
from scipy.spatial import KDTree

from torchlb import LaplaceBeltrami, heat_kernel_signature, wave_kernel_signature
from torchlb.plot import plot_points, plot_surface
from torchlb.surfaces import StarShaped


def signatures(lb, values, k):
    """By name, signatures (N, 32) at times and energies that the eigenvalues of one of the shapes set for both."""
    low, high = float(values[1]), float(values[-1])
    times = torch.logspace(np.log10(4 / high), np.log10(4 / low), 32, dtype=torch.float64)
    energies = torch.linspace(np.log(low), np.log(high) - 0.5, 32, dtype=torch.float64)
    heat = heat_kernel_signature(lb, times, k=k).log()
    wave = wave_kernel_signature(lb, energies, k=k).log()
    return {"heat kernel": heat, "wave kernel": wave}


def main(arguments=None):
    options = read_options(
        __doc__, arguments, points=(2000, "of each sampling"), k=(100, "eigenpairs")
    )
    surface, n, k = StarShaped(), options.points, options.k
    vertices, faces = surface.mesh(n, seed=0)
    unturned = surface.points(n, seed=1)
    turn = torch.tensor([[0, -1.3, 0.4], [1.3, 0, -0.6], [-0.4, 0.6, 0]], dtype=torch.float64)
    cloud = unturned @ turn.matrix_exp().T
    target = LaplaceBeltrami.from_mesh(vertices, faces)
    source = LaplaceBeltrami.from_points(cloud)
    values = target.eigenbasis(k).eigenvalues

    figure, axes = plt.subplots(1, 4, figsize=(16, 4), layout="constrained")
    height, size = vertices[:, 2], surface.area**0.5
    title = "a function on the mesh"
    plot_surface(vertices, faces, height, ax=axes[0], title=title, cmap="coolwarm")
    nearest = KDTree(vertices).query(unturned)[0] / size  # no match can be better
    curves = {"nearest vertex": nearest}
    here, there = (signatures(lb, values, k) for lb in (source, target))
    for ax, name in zip(axes[1:], here, strict=False):
        match = KDTree(there[name]).query(here[name])[1]
        error = curves[name] = (vertices[match] - unturned).norm(dim=1).numpy() / size
        plot_points(cloud, height[match], ax=ax, title=f"matched by {name} signatures", size=18.0)
        print(
            f"{name} signature: {np.mean(error < 0.1):.1%} of {n:,} points are matched within 0.1 √area, median "
            f"distance {np.median(error):.3f} (to the nearest vertex: {np.median(nearest):.3f})"
        )
    radii = np.linspace(0, 0.25, 200)
    for name, error in curves.items():
        axes[3].plot(radii, [100 * np.mean(error <= r) for r in radii], label=name)
    axes[3].set(xlabel="distance from the true place, √area", ylabel="points matched within it, %")
    axes[3].legend(loc="lower right", frameon=False)
    axes[3].spines[["top", "right"]].set_visible(False)
    save(figure, options.output, "signatures_matching.png")


if __name__ == "__main__":
    main()
