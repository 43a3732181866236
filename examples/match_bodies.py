"""ShapeDNA of two shapes, and a map between them, from five landmarks by ZoomOut, on two operators' modes.

Usage: python examples/match_bodies.py [--data FILE.npz] [--first 3] [--second 11] [--points 1000] [--k 100]
FILE: `vertices` (S, N, 3) and closed `faces` of S shapes; without it, both sides of a cortex. Each is decimated to
--points and made smooth by Loop's subdivision; its level 1 is matched, 2 another mesh of it.
"""

import igl
import matplotlib.pyplot as plt
import numpy as np
import torch
from _common import LEFT, cortex, read_options, save, smoothed
from scipy.spatial import KDTree

from torchlb import LaplaceBeltrami
from torchlb.plot import plot_surface


def read(path, *chosen):
    """Vertices of two shapes in correspondence, their faces, and a view of them."""
    if path is None:
        return [cortex(side)[0] for side in ("white_left", "pial_left")], cortex()[1], LEFT
    vertices, faces = (torch.tensor(np.load(path)[name]) for name in ("vertices", "faces"))
    return vertices[list(chosen)].double(), faces.long(), (90.0, -90.0)  # y is up


def heat(basis, landmarks):
    """(N, times · landmarks), heat at every point that was at a landmark."""
    times = 0.003 * 4.0 ** torch.arange(4)[:, None, None]
    decay = torch.exp(-times * basis.eigenvalues)
    kernel = (decay * basis.eigenvectors[landmarks]) @ basis.eigenvectors.T
    return (kernel / kernel.amax(2, keepdim=True)).flatten(0, 1).T


def zoom_out(here, there, match, k):
    """The map refined: by the first 10 modes of both shapes, 15, …, k."""
    for size in range(10, k + 1, 5):
        c = here.left[:, :size].T @ there.eigenvectors[match, :size]  # the functional map
        match = KDTree(there.eigenvectors[:, :size]).query(here.eigenvectors[:, :size] @ c)[1]
    return match


def main(arguments=None):
    numbers = dict(first=(3, "shape"), second=(11, "shape"), points=(1000, "control"), k=(100, ""))
    options = read_options(__doc__, arguments, data=(None, "shapes"), **numbers)
    shapes, faces, view = read(options.data, options.first, options.second)
    smooth = [smoothed(shape, faces, options.points, 2, igl.decimate) for shape in shapes]
    (here, origin), (there, known) = ((meshes[1], origin) for meshes, origin in smooth)
    truth = KDTree(shapes[1][known]).query(shapes[1][origin])[1]  # next to the true place
    control, marks = shapes[1][known], [0]
    for _ in range(4):  # as far as can be from those before
        marks.append(int(KDTree(control[marks]).query(control)[0].argmax()))
    places = KDTree(shapes[0][origin]).query(shapes[0][known[marks]])[1]
    figure, axes = plt.subplots(1, 4, figsize=(19, 4.4), layout="constrained")
    curves, bars, weights, k = {}, {}, 1 / torch.arange(1, options.k), options.k
    for name, kind in (("cotangent", "cotangent"), ("torchlb", "mesh")):
        build, meshes = getattr(LaplaceBeltrami, f"from_{kind}"), (here, there, smooth[0][0][2])
        bases = [build(*mesh).eigenbasis(k) for mesh in meshes]
        own, other, finer = (weights * b.eigenvalues[1:] for b in bases)  # all of area 1
        bars[f"two meshes, {name}"] = float((finer - own).norm())
        curves["by five landmarks"] = KDTree(heat(bases[1], marks)).query(heat(bases[0], places))[1]
        match = curves[f"refined, {name}"] = zoom_out(*bases[:2], curves["by five landmarks"], k)
    bars["two shapes"] = float((other - own).norm())
    print(*(f"ShapeDNA, {name}: {bar:.2f}" for name, bar in bars.items()), sep="\n")
    for label, found in curves.items():
        off = (there[0][found[: len(truth)]] - there[0][truth]).norm(dim=1).sort().values
        print(f"{label}: half of the points within {off.median():.3f} √area")
        axes[2].plot(off, torch.linspace(0, 100, len(off)), label=label)
    axes[2].set(xlabel="distance from the true place, √area", ylabel="points within, %")
    axes[2].legend(loc="lower right", frameon=False)
    axes[3].barh(list(bars), list(bars.values()), color="0.5")
    axes[3].set_title("distance of their ShapeDNA")
    f = (12 * there[0]).sin().sum(1)
    plot_surface(*there, f, ax=axes[0], title="a function on one shape", view=view)
    plot_surface(*here, f[match], ax=axes[1], title="carried to the other one", view=view)
    save(figure, options.output, "match_bodies.png")


if __name__ == "__main__":
    main()
