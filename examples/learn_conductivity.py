"""An unknown conductivity found from temperatures, by the pair of order 3 and by the cotangent's, on the same data.

Usage: python examples/learn_conductivity.py [--output gallery_output] [--points 1200] [--level 3] [--steps 150]
A cortical surface of 1,200 vertices is smoothed by subdivision; eight sources heat it, u − t div(κ∇u) = f, and u is
seen at its 4,800 vertices of level 1. The data are made by the cotangent on a finer level (4 has 307,000 vertices). κ
is sought as the exponential of 20 smooth functions, and then freely at each vertex, with a penalty on its roughness.
"""

import matplotlib.pyplot as plt
import torch
from _common import LEFT, minimize, read_options, save, smooth_cortex

from torchlb import LaplaceBeltrami, implicit_step
from torchlb.plot import plot_surface

TIME, ROUGHNESS = 0.02, 1e-7  # the surface has area 1


def waves(points, count=20):
    """Smooth functions in random directions, about as long as the surface is wide: (N, count)."""
    random = torch.Generator().manual_seed(0)
    directions = 8 * torch.randn(3, count, dtype=torch.float64, generator=random)
    return torch.cos(points @ directions + torch.arange(count))


def learn(lb, f, seen, functions, steps):
    """κ as the exponential of functions, (N, 20), and free at each vertex."""

    def misfit(log_kappa):
        u = implicit_step(lb, f, TIME, conductivity=log_kappa.exp())
        return (u - seen).square().mean() / seen.square().mean()

    few, many = (torch.zeros(n, dtype=torch.float64, requires_grad=True) for n in (20, len(f)))
    minimize(lambda: misfit(functions @ few), [few], steps)
    minimize(lambda: misfit(many) + ROUGHNESS * many @ (lb.stiffness @ many), [many], steps)
    return [log.detach().exp() for log in (functions @ few, many)]


def main(arguments=None):
    options = read_options(
        __doc__,
        arguments,
        points=(1200, "vertices of the control mesh"),
        level=(3, "of the data"),
        steps=(150, "of the optimiser, at most"),
    )
    name, (_, coarse, *_, fine) = smooth_cortex(options.points, options.level)
    print(f"{name}: seen at {len(coarse[0])} vertices, data from {len(fine[0])}")
    count, random = len(coarse[0]), torch.Generator().manual_seed(1)
    centers = coarse[0][torch.randperm(options.points, generator=random)[:8]]
    f = (-50 * (fine[0][:, None] - centers).square().sum(2)).exp()  # eight sources, one a column
    functions = waves(fine[0])
    truth = (functions @ (0.2 * torch.randn(20, dtype=torch.float64, generator=random))).exp()
    data = implicit_step(LaplaceBeltrami.from_cotangent(*fine), f, TIME, conductivity=truth)
    truth, f, seen, functions = (x[:count] for x in (truth, f, data, functions))

    figure, axes = plt.subplots(2, 3, figsize=(15, 7), layout="constrained")
    plot_surface(*coarse, truth, ax=axes[0, 0], title="κ", view=LEFT)
    plot_surface(*coarse, seen[:, 0], ax=axes[1, 0], title="one of eight temperatures", view=LEFT)
    print("relative error of κ     20 functions   each vertex")
    builds = {"cotangent": LaplaceBeltrami.from_cotangent, "torchlb": LaplaceBeltrami.from_mesh}
    for column, (method, build) in zip(axes.T[1:], builds.items(), strict=True):
        lb = build(*coarse)
        learned = learn(lb, f, seen, functions, options.steps)
        errors = [(lb.mass @ (k - truth) ** 2 / (lb.mass @ truth**2)).sqrt() for k in learned]
        print(f"{method:>19}" + "".join(f"{float(error):14.1e}" for error in errors))
        kinds = zip(column, ("20 functions", "each vertex"), learned, errors, strict=True)
        for ax, kind, kappa, error in kinds:
            off = (kappa / truth - 1).abs().clamp_min(1e-5).log10()
            title = f"{method}, {kind}: κ off by {100 * error:.2g} %"
            scale = {"limits": (-4.0, -1.0), "label": "log₁₀ of relative error", "cmap": "magma"}
            plot_surface(*coarse, off, ax=ax, title=title, view=LEFT, **scale)
    save(figure, options.output, "learn_conductivity.png")


if __name__ == "__main__":
    main()
