"""Modes that do not depend on the mesh: three operators on coarse meshes of a smooth cortex, against a fine one.

Usage: python examples/mesh_independent_modes.py [--output gallery_output] [--points 500] [--k 40]
Levels 1 to 3 of a cortical surface, decimated to --points and subdivided (Loop), against level 3 by torchlb at order 3.
"""

import time
import warnings

import matplotlib.pyplot as plt
import torch
from _common import LEFT, read_options, save, smooth_cortex
from robust_laplacian import mesh_laplacian
from scipy.sparse import csc_array
from scipy.sparse.linalg import eigsh

from torchlb import LaplaceBeltrami
from torchlb.plot import plot_convergence, plot_surface

METHODS, SHOWN = ["cotangent", "robust_laplacian", "torchlb"], 30
HEADER = "vertices  operator            s  eigenvalues: median worst  modes: median worst"


def eigenpairs(method, vertices, faces, k):
    """The first k of −Δ by torchlb's pair, the cotangent's, or robust_laplacian's with scipy's eigsh."""
    if method == "robust_laplacian":
        stiffness, mass = (csc_array(m) for m in mesh_laplacian(vertices.numpy(), faces.numpy()))
        values, modes = eigsh(stiffness, k, mass, sigma=-1e-6)
        order = values.argsort()
        return torch.tensor(values[order]), torch.tensor(modes[:, order])
    names = {"torchlb": LaplaceBeltrami.from_mesh, "cotangent": LaplaceBeltrami.from_cotangent}
    basis = names[method](vertices, faces).eigenbasis(k)
    return basis.eigenvalues, basis.eigenvectors


def remainder(mode, exact):
    """What of a mode is not in the span of exact ones."""
    return mode - exact @ torch.linalg.lstsq(exact, mode[:, None]).solution[:, 0]


def main(arguments=None):
    options = read_options(
        __doc__, arguments, points=(500, "of the control mesh"), k=(40, "modes but the constant")
    )
    warnings.filterwarnings("ignore", ".* low-order rows")  # of Δf, which modes do without
    name, meshes = smooth_cortex(options.points, 3)
    k, shown = options.k, min(SHOWN, options.k)
    values, exact = eigenpairs("torchlb", *meshes[3], k + 8)  # some more, of clusters
    near = (values / values[:, None] - 1).abs() < 0.03
    print(f"{name}: relative errors", HEADER, sep="\n")
    sizes, errors = [len(vertices) for vertices, _ in meshes[1:]], {m: [] for m in METHODS}
    pictures = [(exact[: sizes[1], shown], f"mode {shown}, {sizes[-1]:,} vertices", {})]
    for (vertices, faces), n in zip(meshes[1:], sizes, strict=True):
        for method in METHODS if n < sizes[-1] else METHODS[:-1]:
            start = time.perf_counter()
            found, modes = eigenpairs(method, vertices, faces, k + 1)
            seconds = time.perf_counter() - start
            off = [remainder(modes[:, i], exact[:n, near[i]]) for i in range(1, k + 1)]
            turned = torch.stack([r.norm() for r in off]) / modes[:, 1:].norm(dim=0)
            wrong = (found[1:] / values[1 : k + 1] - 1).abs()
            columns = [f"{e.median():.1e} {e.max():.1e}" for e in (wrong, turned)]
            print(f"{n:>8}  {method:<16}{seconds:5.1f}{columns[0]:>27}{columns[1]:>21}")
            errors[method].append(float(wrong.median()))
            if n == sizes[1] and method != "robust_laplacian":
                share = (off[shown - 1].abs() / modes[:, shown].abs().max()).clamp_min(1e-4).log10()
                label = "log₁₀ of |error| / largest |value|"
                scale = {"limits": (-3.5, -1.5), "label": label, "cmap": "magma"}
                pictures.append((share, f"its error by {method}, {n:,} vertices", scale))
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    errors["torchlb"].append(float("nan"))  # the reference
    ylabel = f"median relative error, eigenvalues 1 to {k}"
    plot_convergence(sizes, errors, ax=axes[0, 0], ylabel=ylabel)
    axes[0, 0].legend(loc="upper right", frameon=False)
    for ax, (shares, title, scale) in zip(axes.flat[1:], pictures, strict=True):
        plot_surface(*meshes[2], shares, ax=ax, title=title, view=LEFT, **scale)
    save(figure, options.output, "mesh_independent_modes.png")


if __name__ == "__main__":
    main()
