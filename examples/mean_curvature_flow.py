"""Mean-curvature flow: a sphere against its exact radius, an ellipsoid's area, and a noisy surface made fair.

Usage: python examples/mean_curvature_flow.py [--points 13000] [--steps 100] [--sphere 2000] [--times 12]
∂x/∂t = Δx with Δ of the surface where it is: a step solves (1 − tΔ)x' = x by the operator at x. Extrapolated over 1, 2,
3 and 4 such steps it is of fourth order in time, and still damps what is rough. A sphere has radius √(1 − 4t).
"""

from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import torch
from _common import normals, read_options, save

from torchlb import LaplaceBeltrami, implicit_step
from torchlb.plot import plot_surface
from torchlb.surfaces import Ellipsoid, Sphere, StarShaped

NOISE, END, REACH = 0.3, 3.0, 0.1  # mean edges, mean edges squared, mean edges


def step(lb, x, dt, order=1):
    """The points a time dt later."""
    first, table = lb.at(x), []
    for parts in range(1, order + 1):
        y = implicit_step(first, x, dt / parts)
        for _ in range(parts - 1):
            y = implicit_step(lb.at(y), y, dt / parts)
        table.append(y)
    for k in range(1, order):  # Aitken and Neville's extrapolation to infinitely many parts
        table = [b + (b - a) * (j / k) for j, (a, b) in enumerate(pairwise(table), 1)]
    return table[0]


def main(arguments=None):
    numbers = dict(points=(13000, "noisy"), steps=(100, ""), sphere=(2000, "points"))
    options = read_options(__doc__, arguments, **numbers, times=(12, "steps of the sphere"))
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.4), layout="constrained")
    x, faces = Sphere().mesh(options.sphere)
    lb, times = LaplaceBeltrami.from_mesh(x, faces), np.linspace(0.0, 0.2, options.times + 1)
    for order in (1, 2, 4):
        y, off = x, []
        for time in times[1:]:
            y = step(lb, y, times[1], order)
            off.append(float((y.norm(dim=1) - (1 - 4 * time) ** 0.5).abs().max()))
        print(f"sphere, {len(off)} steps of order {order}: radius off by {max(off):.1e} at most")
        axes[0].semilogy(times[1:], off, "o-", label=f"steps of order {order}")
    axes[0].set(title="a sphere that shrinks: error of its radius", xlabel="time")
    axes[0].legend(frameon=False)

    x, faces = Ellipsoid().mesh(options.sphere)
    lb, areas = LaplaceBeltrami.from_mesh(x, faces), []
    for _ in range(21):
        areas.append(float(normals(x, faces)[0].norm(dim=1).sum() / 2))
        x = step(lb, x, 0.01)
    falls = sum(b < a for a, b in pairwise(areas))
    print(f"ellipsoid: area {areas[0]:.2f} to {areas[-1]:.2f}, it falls in {falls} of 20 steps")

    smooth, faces = StarShaped(0.3).mesh(options.points)
    (_, right), random = normals(smooth, faces), torch.Generator().manual_seed(0)
    edge = float((smooth[faces[:, 0]] - smooth[faces[:, 1]]).norm(dim=1).mean())
    x = smooth + NOISE * edge * torch.randn(len(smooth), 1, generator=random).double() * right
    lb, builds = LaplaceBeltrami.from_mesh(x, faces), 1
    for ax, steps in zip(axes[1:], (0, options.steps), strict=True):
        for _ in range(steps):
            if (x - lb.points).norm(
                dim=1
            ).max() > REACH * edge:  # what was decided for noise no longer fits
                lb, builds = LaplaceBeltrami.from_mesh(x, faces), builds + 1
            x = step(lb, x, END * edge**2 / options.steps)
        angle = torch.rad2deg((normals(x, faces)[1] * right).sum(1).clamp(-1, 1).acos())
        print(f"{steps} steps, {builds} builds: normals off by {angle.mean():.1f}° in the mean")
        title = f"after {steps} steps" if steps else f"with noise of {NOISE} edges"
        scale = {"limits": (0.0, 30.0), "cmap": "YlOrRd", "label": "normals off by, degrees"}
        plot_surface(x, faces, angle, ax=ax, title=title, **scale)
    save(figure, options.output, "mean_curvature_flow.png")


if __name__ == "__main__":
    main()
