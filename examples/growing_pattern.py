"""A pattern of reaction and diffusion on a surface that grows: spots divide, and their number follows the area.

Usage: python examples/growing_pattern.py [--output gallery_output] [--points 1600] [--steps 300] [--sphere 300]
∂c/∂t + c div V = DΔc + R(c) on points of velocity V, where c div V is the dilution by growth: d(Mc)/dt = −DKc + MR(c).
A step solves (1 − tDΔ')c' = (m/m')(c + tR(c)), with the areas m of the vertices before and Δ', m' of `lb.at(points)`.
R is that of Schnakenberg (1979). Without R a harmonic on a sphere that grows decays by a known law.
"""

import math

import igl
import matplotlib.pyplot as plt
import torch
from _common import read_options, save

from torchlb import LaplaceBeltrami, implicit_step
from torchlb.plot import plot_surface
from torchlb.surfaces import Sphere, StarShaped

SUPPLY = torch.tensor([0.1, 0.9], dtype=torch.float64)  # steady: c = (1, 0.9)
DIFFUSION = torch.tensor([1.0, 20.0], dtype=torch.float64)
GROWTH, TIME, LIMITS = 3.6, 0.25, (0.0, 3.0)  # of lengths in all, of a step, of colours
PER_SPOT = 8 * math.pi**2 / (3**0.5 * 0.23)  # the fastest hexagons of linear theory: |k|² = 0.23


def step(lb, there, c, width):
    """c without a reaction when the surface of lb has become that of `there`; width is tD."""
    return implicit_step(there, c * (lb.mass / there.mass)[:, None], width)


def react(c):
    gain = c[:, :1].square() * c[:, 1:]
    return SUPPLY + torch.cat([gain - c[:, :1], -gain], 1)


def spots(u, faces):
    """Number of connected parts with u > 1."""
    inside = faces[(u > 1)[faces].all(1)].numpy()
    return igl.facet_components(inside)[0] if len(inside) else 0


def main(arguments=None):
    numbers = dict(points=(1600, "vertices"), steps=(300, "of time 1/4"), sphere=(300, "vertices"))
    options = read_options(__doc__, arguments, **numbers)
    x, faces = Sphere().mesh(options.sphere)
    for steps in (10, 20):  # xy on a sphere of radius e^{t/2} until t = 1: λ = 6e^{−t}, D = 0.1
        plan = lb = LaplaceBeltrami.from_mesh(x, faces)
        c = start = x[:, :1] * x[:, 1:2]
        for n in range(1, steps + 1):
            there = plan.at(math.exp(n / steps / 2) * x)
            c, lb = step(lb, there, c, 0.1 / steps), there
        factor = math.exp(-1 - 0.6 * (1 - math.exp(-1)))
        off = (c / factor - start).norm() / start.norm()
        print(f"sphere, {steps} steps: a harmonic that decays to {factor:.3f} is off by {off:.1e}")

    u, faces = Sphere().mesh(options.points)
    plan = lb = LaplaceBeltrami.from_mesh(4 * u, faces)
    noise = torch.rand(len(u), 2, generator=torch.Generator().manual_seed(0)).double()
    c, area, number = implicit_step(lb, 0.8 + 0.3 * noise, 0.1), [], []
    figure, axes = plt.subplots(1, 5, figsize=(20, 4.2), layout="constrained")
    for n in range(1, options.steps + 1):
        grown = StarShaped(0.3 * n / options.steps).retract(u)  # lobes grow more than the rest
        there = plan.at(4 * GROWTH ** (n / options.steps) * grown)
        c, lb = step(lb, there, c + TIME * react(c), TIME * DIFFUSION), there
        area, number = [*area, float(lb.mass.sum())], [*number, spots(c[:, 0], faces)]
        if 4 * n % options.steps == 0:
            ax, title = axes[4 * n // options.steps - 1], f"concentration at t = {n * TIME:.0f}"
            plot_surface(lb.points, faces, c[:, 0], ax=ax, title=title, limits=LIMITS, label="c₁")
            y = sum(ax.get_ylim()) / 2
            ax.set(xlim=(-25, 25), ylim=(y - 25, y + 25))  # one scale
    print(f"{number[-1]} spots on an area of {area[-1]:.0f}; theory: {area[-1] / PER_SPOT:.0f}")
    axes[4].plot(area, number, "C2", drawstyle="steps-post", label="spots")
    axes[4].plot(area, [a / PER_SPOT for a in area], "0.5", ls="--", label="linear theory")
    axes[4].set(title="number of spots", xlabel="area, where D₁ = 1")
    axes[4].legend(frameon=False)
    save(figure, options.output, "growing_pattern.png")


if __name__ == "__main__":
    main()
