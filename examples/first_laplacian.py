"""A first Laplacian: on a mesh and on its points alone, applied to a function and compared with the exact answer.

Usage: python examples/first_laplacian.py [--output gallery_output] [--points 3000] [--order 3]
"""

import matplotlib.pyplot as plt
from _common import read_options, save

from torchlb import LaplaceBeltrami
from torchlb.plot import plot_points, plot_surface, plot_vectors
from torchlb.surfaces import Torus, smooth_function


def main(arguments=None):
    options = read_options(
        __doc__, arguments, points=(3000, "of the torus"), order=(3, "of accuracy")
    )
    torus = Torus()
    vertices, faces = torus.mesh(options.points)
    f = smooth_function(vertices)
    exact = torus.laplacian(smooth_function, vertices)

    on_mesh = LaplaceBeltrami.from_mesh(vertices, faces, order=options.order)
    on_cloud = LaplaceBeltrami.from_points(vertices, order=options.order)  # no faces
    print(on_mesh.report)

    errors = {}
    for name, lb in {"mesh": on_mesh, "cloud": on_cloud}.items():
        errors[name] = ((lb(f) - exact) / exact.norm() * len(f) ** 0.5).abs()
        slope = torus.gradient(smooth_function, vertices)
        print(
            f"{name}: relative error of Δf {errors[name].square().mean() ** 0.5:.1e}, "
            f"of ∇f {(lb.gradient(f) - slope).norm() / slope.norm():.1e}, "
            f"of the area {abs(lb.mass.sum() / torus.area - 1):.1e}"
        )

    figure, axes = plt.subplots(2, 2, figsize=(12, 7.6), layout="constrained")
    plot_vectors(vertices, faces, on_mesh.gradient(f), f, ax=axes[0, 0], title="f and its gradient")
    plot_surface(vertices, faces, on_mesh(f), ax=axes[0, 1], title="Δf on the mesh")
    scale = {"limits": (-5.5, -2.5), "cmap": "viridis", "label": "log₁₀"}
    for ax, name in zip(axes[1], errors, strict=True):
        shown = {"title": f"|error of Δf| / root mean square of Δf, {name}", **scale}
        if name == "mesh":
            plot_surface(vertices, faces, errors[name].log10(), ax=ax, **shown)
        else:
            plot_points(vertices, errors[name].log10(), ax=ax, **shown)
    save(figure, options.output, "first_laplacian.png")


if __name__ == "__main__":
    main()
