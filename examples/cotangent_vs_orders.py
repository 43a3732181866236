"""The cotangent Laplacian beside orders 1, 3 and 5: where on the surface the errors are, and how they fall.

Usage: python examples/cotangent_vs_orders.py [--output gallery_output] [--points 8000]
"""

import matplotlib.pyplot as plt
from _common import read_options, save

from torchlb import LaplaceBeltrami
from torchlb.plot import plot_convergence, plot_surface
from torchlb.surfaces import StarShaped, smooth_function

METHODS = {
    "cotangent": LaplaceBeltrami.from_cotangent,
    "order 1": lambda v, f: LaplaceBeltrami.from_mesh(v, f, order=1),
    "order 3": lambda v, f: LaplaceBeltrami.from_mesh(v, f, order=3),
    "order 5": lambda v, f: LaplaceBeltrami.from_mesh(v, f, order=5),
}


def main(arguments=None):
    options = read_options(__doc__, arguments, points=(8000, "of the finest mesh"))
    surface = StarShaped()
    sizes = [options.points // 2**level for level in (4, 3, 2, 1, 0)]
    table = {name: [] for name in METHODS}
    for n in sizes:
        vertices, faces = surface.mesh(n)
        f, exact = smooth_function(vertices), surface.laplacian(smooth_function, vertices)
        differences = {name: build(vertices, faces)(f) - exact for name, build in METHODS.items()}
        for name, difference in differences.items():
            table[name].append(float(difference.norm() / exact.norm()))

    print("relative error of Δf on a star-shaped surface of N vertices")
    print("     N" + "".join(f"{name:>12}" for name in table))
    for n, *row in zip(sizes, *table.values(), strict=True):
        print(f"{n:6}" + "".join(f"{error:12.1e}" for error in row))

    figure, axes = plt.subplot_mosaic(
        [["cotangent", "order 1", "table"], ["order 3", "order 5", "table"]],
        figsize=(13, 6.4),
        layout="constrained",
        width_ratios=[1, 1, 1.5],
    )
    unit = exact.norm() / len(exact) ** 0.5
    for name, difference in differences.items():
        error = (difference.abs() / unit).log10()
        scale = {"limits": (-7.0, -1.0), "cmap": "magma", "label": "log₁₀"}
        plot_surface(vertices, faces, error, ax=axes[name], title=name, **scale)
    plot_convergence(sizes, table, ax=axes["table"], title="Δf of a smooth f")
    figure.suptitle(f"|error of Δf| / root mean square of Δf, {len(f):,} vertices")
    figure.get_layout_engine().set(h_pad=0.12)
    save(figure, options.output, "cotangent_vs_orders.png")


if __name__ == "__main__":
    main()
