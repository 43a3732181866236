"""Eigenmodes of a cortical surface, beside those of LaPy's linear finite elements.

Usage: python examples/cortical_eigenmodes.py [--output gallery_output] [--points 0] [--k 16]
Needs `pip install lapy`; the surface comes with nilearn. On folded surfaces (white, pial), which the vertices do not
resolve, most rows fall to those of the triangles, and the eigenvalues are within 3 %.
"""

import sys

import matplotlib.pyplot as plt
import torch
from _common import LEFT, cortex, read_options, save

from torchlb import LaplaceBeltrami
from torchlb.plot import plot_surface

MODES = [1, 2, 3, 8]


def main(arguments=None):
    options = read_options(
        __doc__, arguments, points=(0, "of an analytic surface instead"), k=(16, "eigenpairs")
    )
    try:
        from lapy import Solver, TriaMesh
    except ImportError:
        sys.exit("LaPy is not installed, with which this example compares: pip install lapy")
    vertices, faces, name, unit = cortex(points=options.points)
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    basis = lb.eigenbasis(options.k)
    # LaPy solves −Δφ = λφ in the same sign: eigenvalues ≥ 0, ascending.
    values, vectors = (
        torch.tensor(pair)
        for pair in Solver(TriaMesh(vertices.numpy(), faces.numpy())).eigs(options.k)
    )

    # Cosine between each mode and the span of LaPy's modes with nearly the same eigenvalue.
    overlap = (basis.eigenvectors.T @ (lb.mass[:, None] * vectors)) / (
        lb.mass @ vectors.square()
    ).sqrt()
    near = (values / basis.eigenvalues[:, None] - 1).abs() < 0.02
    print(f"{name}: eigenvalues of −Δ" + (unit and f", 1/{unit}²"))
    print(" mode     torchlb        LaPy   cosine")
    for i in range(1, options.k):
        cosine = overlap[i, near[i]].norm()
        print(f"{i:5}{basis.eigenvalues[i]:12.5g}{values[i]:12.5g}{cosine:9.4f}")

    figure, axes = plt.subplots(2, len(MODES), figsize=(15, 5.2), layout="constrained")
    sides = {"torchlb": basis.eigenvectors, "LaPy": vectors}
    for row, (library, modes), eigenvalues in zip(
        axes, sides.items(), (basis.eigenvalues, values), strict=True
    ):
        for ax, i in zip(row, MODES, strict=True):
            mode = modes[:, i] * (modes[:, i] @ basis.eigenvectors[:, i]).sign()
            title = f"{library}: $\\lambda_{{{i}}}$ = {eigenvalues[i]:.4g}" + (
                unit and f" / {unit}²"
            )
            plot_surface(vertices, faces, mode, ax=ax, levels=[0.0], title=title, view=LEFT)
    save(figure, options.output, "cortical_eigenmodes.png")


if __name__ == "__main__":
    main()
