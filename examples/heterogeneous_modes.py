"""Modes of a cortical surface whose conductivity varies, and heat that spreads faster along a direction than across.

Usage: python examples/heterogeneous_modes.py [--output gallery_output] [--points 0] [--k 13]
κ falls from front to back by a factor of nine, and the modes of −div(κ∇u) = λu move to the back, where heat is slow.
Then a spot of heat spreads evenly, and by a tensor that conducts nine times as well along the part of the vertical axis
that is tangential to the surface. The surface comes with nilearn.
"""

import matplotlib.pyplot as plt
import torch
from _common import LEFT, cortex, read_options, save

from torchlb import LaplaceBeltrami, heat_flow
from torchlb.plot import plot_surface

MODES = [1, 7]
RATIO = 9.0


def graded(lb):
    """κ from 3 in front to 1/3 at the back, by a smooth function of the place."""
    y = lb.points[:, 1] - lb.mass @ lb.points[:, 1] / lb.mass.sum()
    return RATIO ** (0.5 * torch.tanh(6 * y / lb.mass.sum().sqrt()))


def along_the_vertical(lb):
    """1 + 8ttᵀ for the tangential part t of the vertical axis: (N, 3, 3), and smooth where t vanishes."""
    up = lb.points.new_tensor([0.0, 0.0, 1.0])
    tangent = up - lb.normals * (lb.normals @ up)[:, None]
    return torch.eye(3, dtype=up.dtype) + (RATIO - 1) * tangent[:, :, None] * tangent[:, None]


def main(arguments=None):
    options = read_options(
        __doc__, arguments, points=(0, "of an analytic surface instead"), k=(13, "eigenpairs")
    )
    vertices, faces, name, unit = cortex(points=options.points)
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    kappa = graded(lb)
    bases = [x.eigenbasis(options.k) for x in (lb, lb.with_medium(conductivity=kappa))]
    name += unit and f", 1/{unit}²"
    print(f"{name}: eigenvalues for κ = 1 and for κ from {kappa.min():.2f} to {kappa.max():.2f},")
    print("and the part of the square of each mode where κ < 1")
    print(" mode       κ = 1    κ varies   κ = 1  varies")
    for i in range(1, options.k):
        values = "".join(f"{basis.eigenvalues[i]:12.4g}" for basis in bases)
        parts = [lb.mass * (kappa < 1) @ basis.eigenvectors[:, i].square() for basis in bases]
        print(f"{i:5}{values}" + "".join(f"{100 * part:6.0f} %" for part in parts))

    # A spot at the middle of the side that is drawn.
    size = lb.mass.sum().sqrt()
    spot = vertices[(vertices @ vertices.new_tensor([-1.0, 0.0, 0.3])).argmax()]
    start = (-((vertices - spot) / (0.05 * size)).square().sum(1)).exp()
    time = float(0.002 * size**2)
    operators = {"heat later, κ = 1": lb}
    operators["heat later, κ = 9 up and down"] = lb.with_medium(conductivity=along_the_vertical(lb))
    heats = {title: heat_flow(x, start, time) for title, x in operators.items()}
    for title, heat in {"heat at the start": start, **heats}.items():
        weight = lb.mass * heat / (lb.mass @ heat)
        width = (weight @ (vertices - weight @ vertices).square()).sqrt() / size
        print(f"{title}: {width[1]:.3f} wide and {width[2]:.3f} high, the root of the area is 1")

    figure, axes = plt.subplots(2, 4, figsize=(16, 5.4), layout="constrained")
    plot_surface(vertices, faces, kappa, ax=axes[0, 0], title="conductivity κ", view=LEFT)
    scale = {"limits": (0.0, 1.0), "cmap": "OrRd", "view": LEFT}
    plot_surface(vertices, faces, start, ax=axes[1, 0], title="heat at the start", **scale)
    for row, basis, kind in zip(axes, bases, ("κ = 1", "κ varies"), strict=True):
        for ax, i in zip(row[1:3], MODES, strict=True):
            mode, title = basis.eigenvectors[:, i], f"mode {i}, {kind}"
            mode = mode * (mode * lb.mass @ vertices[:, 1]).sign()
            plot_surface(vertices, faces, mode, ax=ax, levels=[0.0], title=title, view=LEFT)
    for ax, (title, heat) in zip(axes[:, 3], heats.items(), strict=True):
        scale = {"limits": (0.0, 0.24), "levels": [0.02, 0.1], "cmap": "OrRd", "view": LEFT}
        plot_surface(vertices, faces, heat, ax=ax, title=title, **scale)
    save(figure, options.output, "heterogeneous_modes.png")


if __name__ == "__main__":
    main()
