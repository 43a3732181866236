"""Diffusion along the directions of curvature: noise becomes strokes that follow a shape; modes on a torus are exact.

Usage: python examples/curvature_directions.py [--output gallery_output] [--points 12000] [--torus 2000] [--k 30]
The conductivity is a tensor, 1 + s ddᵀ, for a principal direction d of `lb.curvatures()`, in `lb.with_medium`. On a
torus d runs along the parallels or the meridians. Along parallels it multiplies by 1 + s the square of the frequency m
around the axis, so that the eigenvalues are those of ordinary differential equations.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from _common import read_options, save

from torchlb import LaplaceBeltrami, heat_flow
from torchlb.plot import plot_surface
from torchlb.surfaces import StarShaped, Torus

STRENGTH = 300.0  # s, of the strokes


def along(lb, which, strength):
    """1 + strength ddᵀ with the direction d of κ₁ (which = 0) or κ₂ (1): (N, 3, 3)."""
    d = lb.curvatures().directions[..., which]
    return torch.eye(3, dtype=d.dtype) + strength * d[:, :, None] * d[:, None]


def exact(torus, k, strength, n=65):
    """λ of −(wu')'/(r²w) + (1 + s)m²u/w² = λu, w = R + r cos v, by Fourier collocation: (k,)."""
    v, wave = 2 * np.pi * np.arange(n) / n, np.fft.fftfreq(n, 1 / n)
    slope = np.fft.ifft(1j * wave[:, None] * np.fft.fft(np.eye(n), axis=0), axis=0).real
    w, values = torus.major + torus.minor * np.cos(v), []
    radial = -slope @ (w[:, None] * slope) / (torus.minor**2 * w[:, None])
    for m in range(k):
        found = np.linalg.eigvals(radial + np.diag((1 + strength) * (m / w) ** 2)).real
        values += [*found] * (2 if m else 1)
    return torch.from_numpy(np.sort(values)[:k])


def main(arguments=None):
    numbers = dict(points=(12000, "vertices"), torus=(2000, "vertices"), k=(30, "eigenvalues"))
    options = read_options(__doc__, arguments, **numbers)
    torus = Torus()
    lb = LaplaceBeltrami.from_mesh(*torus.mesh(options.torus))
    for strength in (0.0, 8.0):
        values = lb.with_medium(along(lb, 1, strength)).eigenbasis(options.k).eigenvalues[1:]
        off = (values / exact(torus, options.k, strength)[1:] - 1).abs().max()
        name = f"torus, κ = {1 + strength:.0f} along parallels"
        print(f"{name}: {options.k - 1} eigenvalues off by {off:.1e} at most")

    x, faces = StarShaped(0.3).mesh(options.points)
    lb = LaplaceBeltrami.from_mesh(x, faces)
    noise = torch.randn(len(x), generator=torch.Generator().manual_seed(0)).double()
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.4), layout="constrained")
    found = lb.curvatures()
    shown = {"title": "difference of the principal curvatures", "label": "κ₁ − κ₂, 1/length"}
    plot_surface(x, faces, found.k1 - found.k2, ax=axes[0], **shown)
    time = 0.15 * lb.mass.mean()
    for ax, which in zip(axes[1:], (0, 1), strict=True):
        u = heat_flow(lb.with_medium(along(lb, which, STRENGTH)), noise, time)
        slope = lb.gradient(u)[:, None] @ found.directions
        length = slope[:, 0].square().mean(0).sqrt()
        name = "κ" + "₁₂"[which]
        print(
            f"strokes along {name}: slope along over across {length[which] / length[1 - which]:.4f}"
        )
        shown = {"title": f"noise diffused along the direction of {name}", "cmap": "gray"}
        plot_surface(
            x,
            faces,
            u / u.std(),
            ax=ax,
            limits=(-2.0, 2.0),
            label="noise, standard deviations",
            **shown,
        )
    save(figure, options.output, "curvature_directions.png")


if __name__ == "__main__":
    main()
