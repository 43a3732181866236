"""Distances on a surface: geodesic distance, and diffusion distances at two times.

Usage: python examples/diffusion_distances.py [--output gallery_output] [--points 0] [--k 200]
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from _common import LEFT, cortex, read_options, save

from torchlb import LaplaceBeltrami, diffusion_distance, geodesic_distance
from torchlb.plot import plot_surface
from torchlb.surfaces import Sphere


def main(arguments=None):
    options = read_options(
        __doc__, arguments, points=(0, "of an analytic surface instead"), k=(200, "eigenpairs")
    )
    points, triangles = Sphere().mesh(options.points or 4000)
    exact = torch.arccos((points @ points[0]).clamp(-1, 1))
    lb = LaplaceBeltrami.from_mesh(points, triangles)
    error = (geodesic_distance(lb, 0) - exact).abs().mean() / exact.mean()
    print(f"mean error of geodesic distances on a sphere of {len(points):,} points: {error:.1%}")

    vertices, faces, name, unit = cortex(points=options.points)
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    source = int(vertices[:, 0].argmin())
    slowest = 1 / lb.eigenbasis(options.k).eigenvalues[1]
    times = {"short": slowest / 16, "long": slowest / 2}
    panels = {f"geodesic distance{unit and f', {unit}'}": geodesic_distance(lb, source)}
    for when, t in times.items():
        title = f"diffusion distance, a {when} time: √t = {t**0.5:.2g} {unit}"
        panels[title] = diffusion_distance(lb, torch.tensor([source]), float(t), k=options.k)[:, 0]

    figure, axes = plt.subplots(1, 3, figsize=(15, 3.8), layout="constrained")
    figure.get_layout_engine().set(h_pad=0.1)
    for ax, (title, distance) in zip(axes, panels.items(), strict=True):
        levels = np.linspace(0, float(distance.max()), 21)
        colors = {"limits": (0.0, float(levels[-1])), "levels": levels[1:-1]}
        plot_surface(vertices, faces, distance, ax=ax, title=title, view=LEFT, **colors)
    figure.suptitle(f"{name}: distances from one point")
    save(figure, options.output, "diffusion_distances.png")


if __name__ == "__main__":
    main()
