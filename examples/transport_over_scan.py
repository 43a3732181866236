"""A vector transported over a scan and a texture laid on it by the logarithmic map, beside potpourri3d's.

Usage: python examples/transport_over_scan.py [--output gallery_output] [--points 1200] [--level 2]
An inflated cortical surface, which nilearn brings, is made smooth by subdivision, so that coarse and fine meshes lie on
one surface. torchlb transports a vector along shortest paths, potpourri3d by the vector heat method with linear
elements, on two meshes, and they are compared with both on the finest mesh (needs potpourri3d).
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
import torch
from _common import LEFT, cortex, read_options, save, smoothed
from torch.nn.functional import normalize

from torchlb import LaplaceBeltrami, logarithmic_map, parallel_transport
from torchlb.plot import plot_surface, plot_vectors

RING, SPOKES = 0.08, 12  # of the texture, on a surface of area 1


def degrees(a, b):
    """Angles between space vectors at the vertices of a."""
    cosine = (normalize(a, dim=1) * normalize(b[: len(a)], dim=1)).sum(1)
    return torch.rad2deg(cosine.clamp(-1, 1).acos())


def main(arguments=None):
    numbers = dict(points=(1200, "vertices of the control mesh"), level=(2, "of the reference"))
    options = read_options(__doc__, arguments, **numbers)
    try:
        from potpourri3d import MeshVectorHeatSolver
    except ImportError:
        sys.exit("potpourri3d is not installed, with which this compares: pip install potpourri3d")

    def by_potpourri3d(x, faces):
        solver = MeshVectorHeatSolver(x.numpy(), faces.numpy())
        frames = torch.from_numpy(np.stack(solver.get_tangent_frames()[:2], 2))
        moved = solver.transport_tangent_vector(source, (vector @ frames[source]).tolist())
        place = torch.from_numpy(solver.compute_log_map(source)) @ frames[source].T
        return torch.einsum("nij,nj->ni", frames, torch.from_numpy(moved)), place

    def by_torchlb(x, faces):
        lb = LaplaceBeltrami.from_mesh(x, faces)
        place = logarithmic_map(lb, source) @ lb.frames[source].T
        return parallel_transport(lb, source, vector), place

    *mesh, name, _ = cortex()
    *levels, (x, faces) = smoothed(*mesh, options.points, options.level)[0]
    source = int((levels[0][0] @ x.new_tensor([-1.0, 0.0, 0.3])).argmax())
    vector, shown = x.new_tensor([0.0, 1.0, 0.0]), []
    methods = {"torchlb": by_torchlb, "potpourri3d": by_potpourri3d}
    best = {method: find(x, faces) for method, find in methods.items()}
    print(f"{name}, made smooth: median degrees to both results on {len(x)} vertices")
    for level in levels:
        for method, find in methods.items():
            found, name = find(*level), f"{method}, {len(level[0])} vertices"
            shown.append((degrees(found[0], best["torchlb"][0]), f"transport by {name}"))
            for i, what in enumerate(("transport", "logarithm")):
                off = [degrees(found[i], known[i]).nanmedian() for known in best.values()]
                print(f"{what} by {name}:", *(f"{float(a):.2f}" for a in off))

    figure, axes = plt.subplots(1, 4, figsize=(20, 4.2), layout="constrained")
    moved, place = best["torchlb"]
    far = place.norm(dim=1)
    look = {"view": LEFT, "cmap": "YlOrBr", "label": "distance from its place, √area"}
    plot_vectors(x, faces, moved, far, ax=axes[0], title="a vector transported", **look)
    look = {"view": LEFT, "cmap": "YlOrRd", "label": "off by, degrees", "limits": (0.0, 4.0)}
    for i in (1, 2):
        plot_surface(*levels[-1], shown[i - 3][0], ax=axes[i], title=shown[i - 3][1], **look)
    turn = torch.atan2(*torch.linalg.svd(place[:1000], full_matrices=False)[2][:2] @ place.T)
    board = ((torch.pi * far / RING).sin() * (SPOKES / 2 * turn).sin()).sign()
    look = {"view": LEFT, "cmap": "gray", "title": "a texture by the logarithmic map"}
    plot_surface(x, faces, board, ax=axes[3], label="light or dark", **look)
    save(figure, options.output, "transport_over_scan.png")


if __name__ == "__main__":
    main()
