"""A high-order Laplacian on a real surface: its report, how far its modes are from the mesh's, two pictures.

Usage: python examples/demo.py [--mesh FILE] [--order 3] [--output demo_output]
Without a file it takes a folded cortical surface, and compares modes on coarse meshes of it, made smooth, with those on
a fine one, beside the cotangent and robust_laplacian (`mesh_independent_modes.py`).
"""

import argparse
import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import mesh_independent_modes
from _common import cortex

from torchlb import LaplaceBeltrami, clean_mesh, read_shape
from torchlb.plot import plot_orders, plot_points, plot_surface
from torchlb.surfaces import smooth_function

SIDES = [(15.0, 200.0), (15.0, 20.0)]  # views of the user's surface: elevation, azimuth


def read(path):
    """Vertices, faces (None for a cloud), name and unit of a file; ValueError if it is not a surface or cloud."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    vertices, faces = read_shape(path)
    if faces is None:
        print(f"{path.name} has no faces: it is taken for a cloud")
        return vertices, None, path.name, ""
    count = len(vertices)
    vertices, faces, kept = clean_mesh(vertices, faces, merge=True)
    if len(kept) < count:
        print(
            f"{count - len(kept)} vertices share a place or belong to no face: left out (clean_mesh)"
        )
    return vertices, faces, path.name, ""


def draw_surface(vertices, faces, lb, name, unit, path):
    """f, Δf, mean curvature and what the pair could curve, side by side, each from two sides."""
    low, high = vertices.amin(0), vertices.amax(0)
    f = smooth_function(3 * (vertices - (low + high) / 2) / (high - low).max())  # in [−1.5, 1.5]³
    mean_curvature = -(lb.mean_curvature_normal() * lb.normals).sum(1) / 2  # 1/r on a sphere
    figure, axes = plt.subplots(1, 4, figsize=(19, 6), layout="constrained")
    unit = unit or "length"
    panels = [
        (f, "a smooth function f", ""),
        (lb(f), "Δf", f"1/{unit}²"),
        (mean_curvature, "mean curvature", f"1/{unit}"),
    ]
    for ax, (values, title, label) in zip(axes, panels, strict=False):
        if faces is None:
            plot_points(vertices, values, ax=ax, title=title, label=label, view=SIDES)
        else:
            plot_surface(vertices, faces, values, ax=ax, title=title, label=label, view=SIDES)
    draw_reached(vertices, faces, lb, axes[3], SIDES)
    figure.suptitle(f"{name}, {len(vertices):,} points", fontsize="x-large")
    figure.get_layout_engine().set(h_pad=0.12)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def draw_reached(vertices, faces, lb, ax, view):
    """The share of the edges at each vertex that the weak pair could curve; without triangles the order reached."""
    if lb.dim != 2:
        plot_orders(vertices, faces, lb.report.order, ax=ax, view=view)
        return
    share = lb.report.curved_edges / lb.report.edges.clamp_min(1)
    title = f"curved edges: {100 * lb.report.curved_share:.1f} %"
    scale = {"limits": (0.0, 1.0), "cmap": "bone", "label": "share at each vertex"}
    plot_surface(vertices, lb.faces, share, ax=ax, title=title, view=view, **scale)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--mesh", type=Path, help="a mesh or cloud, any file that torchlb.read_shape reads"
    )
    parser.add_argument("--order", type=int, default=3, help="order of accuracy (default: 3)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="for the pictures")
    options = parser.parse_args(arguments)
    try:
        vertices, faces, name, unit = read(options.mesh) if options.mesh else cortex()
        start = time.perf_counter()
        if faces is None:
            lb = LaplaceBeltrami.from_points(vertices, order=options.order)
        else:
            lb = LaplaceBeltrami.from_mesh(vertices, faces, order=options.order)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"\n{name}\n{lb}\nbuilt in {time.perf_counter() - start:.1f} s\n\n{lb.report}")
    options.output.mkdir(parents=True, exist_ok=True)
    draw_surface(vertices, faces, lb, name, unit, options.output / "surface.png")
    print(f"{options.output / 'surface.png'}\n")
    if not options.mesh:
        mesh_independent_modes.main(["--output", str(options.output)])
    return 0


if __name__ == "__main__":
    sys.exit(main())
