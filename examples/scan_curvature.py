"""Curvature of a noisy scan: what smoothing takes away, noise at first and then the shape.

Usage: python examples/scan_curvature.py [--output gallery_output] [--points 6000]
Points of a shape of known mean curvature H are off by a tenth of an edge, which ruins second derivatives.
S = (1 − tΔ)⁻¹, with Δ of the noisy scan, smooths the places of the points over a length √t. It moves smooth parts by
tΔx, and the filter 1 − (1 − S)³ by t³Δ³x, so that this one can be longer.
"""

import warnings

import igl
import matplotlib.pyplot as plt
import torch
from _common import read_options, save

from torchlb import LaplaceBeltrami, implicit_step
from torchlb.plot import plot_surface
from torchlb.surfaces import StarShaped

NOISE = 0.1  # standard deviation in each coordinate, mean edges
LENGTHS = [0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0]  # mean edges
ONE, THREE = "S x", "x − (1 − S)³x"
SHOWN = [(ONE, 8.0), (THREE, 4.0)]


def main(arguments=None):
    options = read_options(__doc__, arguments, points=(6000, "vertices"))
    shape = StarShaped(0.2)
    clean, faces = shape.mesh(options.points)
    exact = -(shape.mean_curvature_normal(clean) * shape.normals(clean)).sum(1) / 2
    edge = float((clean[faces[:, 0]] - clean[faces[:, 1]]).norm(dim=1).mean())
    random = torch.Generator().manual_seed(0)
    scan = clean + NOISE * edge * torch.randn(clean.shape, generator=random).double()

    def off(mean_curvature):
        return float((mean_curvature - exact).norm() / exact.norm())

    def curvature(points):
        return LaplaceBeltrami.from_mesh(points, faces).curvatures().mean

    warnings.filterwarnings("ignore", ".*only low-order rows")  # noise has none of high order
    print(f"relative error of H without noise: {off(curvature(clean)):.1e}")
    lb = LaplaceBeltrami.from_mesh(scan, faces)
    raw = lb.curvatures().mean
    low = 100 * float((lb.report.order == 0).double().mean())
    print(f"as scanned: {off(raw):.2f}; {low:.0f} % of the points have rows of low order")

    maps, lines = {}, {ONE: [], THREE: []}
    for length in LENGTHS:
        powers = [scan]
        for _ in range(3):
            powers.append(implicit_step(lb, powers[-1], (length * edge) ** 2))
        for name, x in ((ONE, powers[1]), (THREE, 3 * powers[1] - 3 * powers[2] + powers[3])):
            maps[name, length] = x, curvature(x)
            lines[name].append(off(maps[name, length][1]))
    for name, line in lines.items():
        least, at = min(zip(line, LENGTHS, strict=True))
        print(f"{name}: {least:.3f} for √t = {at:g} edges, {line[-1]:.3f} for {LENGTHS[-1]:g}")

    figure, axes = plt.subplots(1, 5, figsize=(22, 4.0), layout="constrained")
    scale = {"limits": (-0.5, 2.0), "cmap": "viridis", "label": "mean curvature H, 1/length"}
    plot_surface(scan, faces, raw, ax=axes[0], title="as scanned", **scale)
    plot_surface(clean, faces, exact, ax=axes[3], title="exact, without noise", **scale)
    for ax, key in zip(axes[1:], SHOWN, strict=False):
        x, found = maps[key]
        plot_surface(x, faces, found, ax=ax, title=f"{key[0]}, √t = {key[1]:g} edges", **scale)
    for (name, line), style in zip(lines.items(), ("o-C0", "s-C2"), strict=True):
        axes[4].plot(LENGTHS, line, style, label=name)
    for radius, style in ((5, "--"), (8, ":")):
        found = igl.principal_curvature(scan.numpy(), faces.numpy(), radius)
        error = off(torch.from_numpy((found[2] + found[3]) / 2))
        print(f"libigl, radius {radius}, as scanned: {error:.3f}")
        axes[4].axhline(error, color="0.4", ls=style, label=f"libigl, radius {radius}")
    axes[4].set(title="relative error of H", xlabel="smoothing length √t, edges", ylim=(0, 0.8))
    axes[4].legend(frameon=False, loc="upper center")
    save(figure, options.output, "scan_curvature.png")


if __name__ == "__main__":
    main()
