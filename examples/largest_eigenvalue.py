"""The first eigenvalue of a closed membrane raised at fixed area by gradients in its points: a dumbbell becomes round.

Usage: python examples/largest_eigenvalue.py [--output gallery_output] [--points 1000] [--steps 40] [--degree 8]
Hersch (1970): 1/λ₁ + 1/λ₂ + 1/λ₃ ≥ 3A/8π on every surface of genus 0 and area A, so that λ₁A ≤ 8π, and only the round
sphere has equality. λ₁ alone has no gradient where eigenvalues meet, as they do there, but the sum has one. LBFGS
lowers it, by spherical harmonics of the logarithm of the radius, and gradients come through `lb.at(points)`.
"""

import matplotlib.pyplot as plt
import torch
from _common import minimize, read_options, save

from torchlb import LaplaceBeltrami
from torchlb.plot import plot_surface
from torchlb.surfaces import Sphere, spherical_harmonic

HERSCH = 8 * torch.pi
SHOWN = [0, 3, -1]  # evaluations that are drawn


def harmonics(u, degree):
    """Y_l^m / (1 + l) at directions: (N, (degree + 1)²)."""
    terms = [(n, m) for n in range(degree + 1) for m in range(-n, n + 1)]
    return torch.stack([spherical_harmonic(n, m)(u) / (1 + n) for n, m in terms], 1)


def sphere_through(x):
    """Distances of points from the sphere that fits them best, over its radius."""
    columns = torch.cat([2 * x, torch.ones_like(x[:, :1])], 1)  # |x|² = 2c·x + r² − |c|²
    center = torch.linalg.lstsq(columns, x.square().sum(1, keepdim=True)).solution[:3, 0]
    radii = (x - center).norm(dim=1)
    return radii / radii.mean() - 1


def main(arguments=None):
    numbers = dict(points=(1000, "vertices"), steps=(40, "of LBFGS"), degree=(8, "of the radius"))
    options = read_options(__doc__, arguments, **numbers)
    u, faces = Sphere().mesh(options.points)
    dumbbell = (0.4 + 0.65 * u[:, 0].square() + 0.15 * u[:, 0]).log()
    weights, history = harmonics(u, options.degree), []
    moves = torch.zeros(weights.shape[1], dtype=torch.float64, requires_grad=True)
    lb = LaplaceBeltrami.from_mesh(dumbbell.exp()[:, None] * u, faces)

    def bound():
        there = lb.at((dumbbell + weights @ moves).exp()[:, None] * u)
        values = there.eigenbasis(4, tolerance=1e-9).eigenvalues[1:] * there.mass.sum() / HERSCH
        history.append((there.points.detach(), values.detach()))
        return (1 / values).mean() - 1  # ≥ 0

    minimize(bound, [moves], options.steps)
    reached = torch.stack([values for _, values in history])
    best = int(reached[:, 0].argmax())
    x = history[best][0]
    print("λ₁A, λ₂A, λ₃A over 8π:")
    for name, values in (("dumbbell", reached[0]), (f"evaluation {best}", reached[best])):
        print(f"{name:>14}  " + "  ".join(f"{value:.6f}" for value in values))
    print(f"off the nearest sphere by {sphere_through(x).abs().max():.1e} of its radius at most")

    figure, axes = plt.subplots(1, 4, figsize=(18, 4.2), layout="constrained")
    for ax, i in zip(axes, SHOWN, strict=False):
        i = best if i < 0 else min(i, best)
        there = LaplaceBeltrami.from_mesh(history[i][0], faces)
        basis = there.eigenbasis(4)
        alike = basis.eigenvalues < 1.001 * basis.eigenvalues[1]  # three on a sphere
        first = basis.eigenvectors[:, alike]
        mode = first @ (first.T @ (there.mass * there.points[:, 0]))
        mode = mode / mode.abs().max()
        title = f"evaluation {i}: λ₁A = {reached[i, 0] * HERSCH:.4g}"
        shown = {"label": "first mode", "levels": [0.0], "view": (20.0, -70.0)}
        plot_surface(history[i][0], faces, mode, ax=ax, title=title, **shown)
    for i, style in enumerate(("o-C0", "s-C1", "--C3")):
        axes[3].plot(HERSCH * reached[: best + 1, i], style, label=f"λ{'₁₂₃'[i]}A")
    axes[3].axhline(HERSCH, color="0.6", zorder=0, label="8π, the bound of λ₁A")
    axes[3].set(title="eigenvalues times area", xlabel="evaluation", xlim=(-0.5, 12.5))
    axes[3].legend(frameon=False)
    save(figure, options.output, "largest_eigenvalue.png")


if __name__ == "__main__":
    main()
