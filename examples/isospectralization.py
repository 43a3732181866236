"""A body deformed until its first 30 eigenvalues are those of another one, of which nothing else is known.

Usage: python examples/isospectralization.py [--output gallery_output] [--points 1500] [--steps 100] [--k 30]
An ellipsoid, x = Au of directions u, is moved by 25 spherical harmonics of u times three coordinates, rough ones less
easily. That is a smooth surface whatever its mesh, so that what was found on 1,500 vertices is measured by the
cotangent on 16 times as many. LBFGS lessens Σ (log λ_k − log λ*_k)²; its gradient comes through `lb.at(points)`.
"""

import igl
import matplotlib.pyplot as plt
import torch
from _common import minimize, normals, read_options, save

from torchlb import LaplaceBeltrami
from torchlb.plot import plot_surface
from torchlb.surfaces import Sphere, StarShaped, spherical_harmonic

AXES = torch.tensor([1.15, 1.0, 0.85]).double()


def harmonics(u, degree=4):
    """Y_l^m / (1 + l) at directions: (N, 25)."""
    terms = [(n, m) for n in range(degree + 1) for m in range(-n, n + 1)]
    return torch.stack([spherical_harmonic(n, m)(u) / (1 + n) for n, m in terms], 1)


def refined(u, faces):
    """Every triangle of a mesh of directions in four, the old vertices first."""
    points, corners = (torch.from_numpy(a) for a in igl.upsample(u.numpy(), faces.numpy()))
    return torch.nn.functional.normalize(points), corners.long()


def main(arguments=None):
    numbers = dict(points=(1500, "vertices"), steps=(100, "of LBFGS"), k=(30, "eigenvalues"))
    options = read_options(__doc__, arguments, **numbers)
    u, faces = Sphere().mesh(options.points)
    middle, between = refined(u, faces)
    fine, corners = refined(middle, between)
    other, weights = StarShaped(0.2).retract, harmonics(u)
    moves = torch.zeros(weights.shape[1], 3, dtype=torch.float64, requires_grad=True)

    def logarithms(lb):
        return lb.eigenbasis(options.k + 1, tolerance=1e-9).eigenvalues[1:].log()

    def misfit():
        return (logarithms(lb.at(u * AXES + weights @ moves)) - given).square().sum()

    lb = LaplaceBeltrami.from_mesh(u * AXES, faces)
    given = logarithms(LaplaceBeltrami.from_mesh(other(middle), between)).detach()
    minimize(misfit, [moves], options.steps)

    figure, axes = plt.subplots(1, 4, figsize=(18, 4.2), layout="constrained")
    wanted = logarithms(LaplaceBeltrami.from_cotangent(other(fine), corners))
    for name, moved, color in (("before", 0 * moves, "C0"), ("after", moves, "C2")):
        x, finest = (v * AXES + harmonics(v) @ moved.detach() for v in (u, fine))
        measured = logarithms(LaplaceBeltrami.from_cotangent(finest, corners)) - wanted
        labels = f"{name}, torchlb", f"{name}, cotangent, {len(fine)} vertices"
        both = logarithms(lb.at(x)) - given, measured
        for off, style, label in zip(both, "-o", labels, strict=True):
            print(f"{label}: Σ (log λ − log λ*)² = {float(off.square().sum()):.1e}")
            axes[3].semilogy(range(1, options.k + 1), off.abs(), style, color=color, label=label)
    axes[3].set(title="error of the eigenvalues, relative", xlabel="number", ylim=(1e-7, 0.5))
    axes[3].legend(frameon=False)
    flat, mean = normals(x, faces)
    flipped = int(((flat * mean[faces].sum(1)).sum(1) <= 0).sum())
    print(f"{flipped} of {len(faces)} triangles flipped")
    found = middle * AXES + harmonics(middle) @ moves.detach()
    bodies = {"before": middle * AXES, "after": found, "the body that was heard": other(middle)}
    for ax, (title, x) in zip(axes, bodies.items(), strict=False):
        body = LaplaceBeltrami.from_mesh(x, between)
        bent = -(body.mean_curvature_normal() * body.normals).sum(1) / 2
        scale = {"limits": (0.0, 2.0), "cmap": "viridis", "label": "mean curvature"}
        plot_surface(x, between, bent, ax=ax, title=title, **scale)
    save(figure, options.output, "isospectralization.png")


if __name__ == "__main__":
    main()
