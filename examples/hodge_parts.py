"""Parts of a tangent field on a double torus: a gradient, a rotated gradient, and what no function gives.

Usage: python examples/hodge_parts.py [--output gallery_output] [--level 3]
∇u + ν × ∇w of two known functions, and a harmonic field from `lb.connection.hodge`, are added, and
`hodge_decomposition` finds them again. A closed surface of genus g has 2g independent harmonic fields: here four, two
around each hole. The surface is the limit of subdivision of a block of cubes without two columns.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from _common import read_options, save

from torchlb import LaplaceBeltrami, hodge_decomposition
from torchlb.plot import plot_vectors
from torchlb.surfaces import limit_surface


def double_torus(level):
    """A smooth closed surface of genus 2 that subdivision makes of 5 × 3 × 1 cubes without two of them."""
    solid = np.zeros((7, 5, 3), int)
    solid[1:-1, 1:-1, 1] = 1
    solid[[2, 4], 2] = 0
    axes, squares = np.eye(3, dtype=int), []
    for k in range(3):
        one, two = axes[(k + 1) % 3], axes[(k + 2) % 3]
        for sign, a, b in ((-1, one, two), (1, two, one)):  # counterclockwise, seen from outside
            first = np.argwhere(np.diff(solid, axis=k) == sign) + axes[k]
            squares.append(np.stack([first, first + a, first + one + two, first + b], 1))
    places, corners = np.unique(np.concatenate(squares).reshape(-1, 3), axis=0, return_inverse=True)
    corners = torch.from_numpy(corners.reshape(-1, 4))
    faces = torch.cat([corners[:, :3], corners[:, [0, 2, 3]]])
    points, levels = limit_surface(torch.from_numpy(places.astype(float)), faces, level)
    return points - points.mean(0), levels[level]


def main(arguments=None):
    options = read_options(__doc__, arguments, level=(3, "of subdivision"))
    x, faces = double_torus(options.level)
    lb = LaplaceBeltrami.from_mesh(x, faces)
    basis = lb.connection.hodge.eigenbasis(6)
    print(f"{len(x)} vertices, the first eigenvalues of Hodge's Laplacian:")
    print("  ".join(f"{value:.1e}" for value in basis.eigenvalues))
    a, b, c = x.T

    def centered(f):
        return f - lb.integral(f) / lb.mass.sum()

    u, w = centered(a.sin()), centered(a * b / 2 + c)
    harmonic = lb.connection.vectors(basis.eigenvectors[:, 0])
    harmonic = 2 * harmonic / harmonic.norm(dim=1).max()
    field = lb.gradient(u) + torch.linalg.cross(lb.normals, lb.gradient(w)) + harmonic
    parts = hodge_decomposition(lb, field)
    for name, found, known in (
        ("potential u", parts.potential, u),
        ("stream function w", parts.stream, w),
        ("harmonic part", parts.harmonic, harmonic),
    ):
        print(f"{name}: off by {(found - known).norm() / known.norm():.1e}, relative")
    total = lb.inner(field, field).sum()
    three = [parts.gradient, parts.rotated, parts.harmonic]
    products = [lb.inner(three[i], three[j]).sum() / total for i, j in ((0, 1), (0, 2), (1, 2))]
    print(f"products of the parts: {max(abs(float(p)) for p in products):.1e} of that of the field")

    figure, axes = plt.subplots(1, 4, figsize=(20, 4.4), layout="constrained")
    look = {"view": (60.0, -90.0)}
    plot_vectors(x, faces, field, ax=axes[0], title="the field", label="length", **look)
    title = "its gradient part ∇u"
    plot_vectors(x, faces, three[0], parts.potential, ax=axes[1], title=title, label="u", **look)
    title = "its rotated part ν × ∇w"
    plot_vectors(x, faces, three[1], parts.stream, ax=axes[2], title=title, label="w", **look)
    title = "its harmonic part"
    plot_vectors(x, faces, three[2], ax=axes[3], title=title, label="length", **look)
    save(figure, options.output, "hodge_parts.png")


if __name__ == "__main__":
    main()
