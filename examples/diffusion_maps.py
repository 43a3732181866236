"""The diffusion map of a curled sheet in R¹⁰ unrolls it: its coordinates are those of the flat rectangle.

Usage: python examples/diffusion_maps.py [--output gallery_output] [--points 2500]
The sheet bends without stretching, so that the eigenvalues are the rectangle's, π² (j²/length² + l²/width²).
"""

import math

import matplotlib.pyplot as plt
import torch
from _common import read_options, save

from torchlb import LaplaceBeltrami, diffusion_map
from torchlb.plot import plot_points

LENGTH, WIDTH = 11.0, 8.0


def rectangle(n):
    """About n points (N, 2), evenly spread, and which are on the edges (N,)."""
    sides = torch.tensor([LENGTH, WIDTH], dtype=torch.float64)
    spacing = (LENGTH * WIDTH / n) ** 0.5
    golden = torch.tensor([0.7548776662466927, 0.5698402909980532], dtype=torch.float64)
    inner = (torch.arange(n)[:, None] * golden % 1) * (sides - spacing) + spacing / 2
    count = (sides / spacing).round().int().tolist()
    x, y = (torch.linspace(0, float(s), c + 1).double() for s, c in zip(sides, count, strict=True))
    edges = [torch.cartesian_prod(x, y[[0, -1]]), torch.cartesian_prod(x[[0, -1]], y[1:-1])]
    points = torch.cat([*edges, inner])
    return points, torch.arange(len(points)) < len(points) - n


def curled(flat):
    """The rectangle in R¹⁰, isometrically: a curve of unit speed in R⁸ times an arc in R², turned at random."""
    wave = torch.arange(1, 5)
    angle, arc = flat[:, :1] / 2 * wave, flat[:, 1:] / 5
    parts = [angle.cos() / wave, angle.sin() / wave, 5 * arc.cos(), 5 * arc.sin()]
    generator = torch.Generator().manual_seed(0)
    rotation = torch.linalg.qr(torch.randn(10, 10, generator=generator, dtype=torch.float64))[0]
    return torch.cat(parts, dim=1) @ rotation


def main(arguments=None):
    options = read_options(__doc__, arguments, points=(2500, "of the sheet"))
    flat, on_edge = rectangle(options.points)
    points = curled(flat)
    lb = LaplaceBeltrami.from_points(points, dim=2, boundary=on_edge)
    values = lb.eigenbasis(10).eigenvalues
    waves = torch.cartesian_prod(torch.arange(12), torch.arange(12)).double()
    exact = ((math.pi * waves / torch.tensor([LENGTH, WIDTH])) ** 2).sum(1).sort().values
    print(f"{lb}\neigenvalues of −Δ beside those of the flat rectangle")
    print("\n".join(f"{a:9.5f}{b:9.5f}" for a, b in zip(values, exact, strict=False)))

    coordinates = diffusion_map(lb, time=1.0, dim=2)
    cosines = (math.pi * flat / torch.tensor([LENGTH, WIDTH])).cos()
    for i, name in enumerate(["length", "width"]):
        correlation = torch.corrcoef(torch.stack([coordinates[:, i], cosines[:, i]]))[0, 1].abs()
        print(f"correlation of coordinate {i + 1} with cos(π {name}): {correlation:.6f}")

    figure, axes = plt.subplots(1, 3, figsize=(15, 4.4), layout="constrained")
    label = {"label": "place along the sheet", "cmap": "plasma", "size": 12.0}
    plot_points(points[:, :3], flat[:, 0], ax=axes[0], title="three of ten coordinates", **label)
    plot_points(coordinates, flat[:, 0], ax=axes[1], title="the diffusion map", **label)
    label["label"] = "place across the sheet"
    plot_points(coordinates, flat[:, 1], ax=axes[2], title="the diffusion map", **label)
    for ax in axes[1:]:
        ax.set(frame_on=False, xlabel="φ₁", ylabel="φ₂", xticks=[], yticks=[])
        ax.set_axis_on()
    save(figure, options.output, "diffusion_maps.png")


if __name__ == "__main__":
    main()
