"""Where and when heat was put on a surface, found from its temperature afterwards.

Usage: python examples/find_heat_source.py [--output gallery_output] [--points 1200] [--level 3] [--steps 200]
Three spots at unknown places spread on a smooth cortical surface for an unknown time. Their temperature is seen at
4,800 vertices; the data are made by the cotangent on a finer level. Places and the time are found by gradients through
the heat flow, by the pair of order 3 and by the cotangent's.
"""

import matplotlib.pyplot as plt
import torch
from _common import LEFT, minimize, read_options, save, smooth_cortex

from torchlb import LaplaceBeltrami, heat_flow
from torchlb.plot import plot_surface

TIME = 0.005  # of a surface of area 1
PAIRS = 256  # of the flow: the surface is the same at every step, the time is not


def spots(points, places):
    """A sum of Gaussians: (N,)."""
    return (-100 * (points[:, None] - places).square().sum(2)).exp().sum(1)


def find(lb, seen, guess, steps):
    """Places (3, 3) and the time of spots with the temperature seen."""
    places = guess.clone().requires_grad_()
    log_time = torch.tensor(0.01, dtype=torch.float64).log().requires_grad_()

    def misfit():
        u = heat_flow(lb, spots(lb.points, places), log_time.exp(), method="spectral", k=PAIRS)
        return (u - seen).square().mean() / seen.square().mean()

    minimize(misfit, [places, log_time], steps)
    return places.detach(), log_time.detach().exp()


def main(arguments=None):
    options = read_options(
        __doc__,
        arguments,
        points=(1200, "vertices of the control mesh"),
        level=(3, "of the data"),
        steps=(200, "of the optimiser, at most"),
    )
    name, (_, coarse, *_, fine) = smooth_cortex(options.points, options.level)
    print(f"{name}: seen at {len(coarse[0])} vertices, data from {len(fine[0])}")
    random = torch.Generator().manual_seed(4)
    outside = coarse[0][: options.points]
    outside = outside[outside[:, 0] < -0.05]  # the side that is drawn
    places = outside[torch.randperm(len(outside), generator=random)[:3]]
    guess = places + 0.05 * torch.randn(3, 3, dtype=torch.float64, generator=random)
    data = heat_flow(LaplaceBeltrami.from_cotangent(*fine), spots(fine[0], places), TIME)
    before, seen = spots(coarse[0], places), data[: len(coarse[0])]

    figure, axes = plt.subplots(1, 4, figsize=(19, 4.2), layout="constrained")
    plot_surface(*coarse, before, ax=axes[0], title="heat at the start", view=LEFT)
    plot_surface(*coarse, seen, ax=axes[1], title="what is seen", view=LEFT)
    print("relative error of     places      time")
    builds = {"cotangent": LaplaceBeltrami.from_cotangent, "torchlb": LaplaceBeltrami.from_mesh}
    for ax, (method, build) in zip(axes[2:], builds.items(), strict=True):
        found = find(build(*coarse), seen, guess, options.steps)
        errors = [
            float((a - b).norm() / b.norm())
            for a, b in zip(found, (places, torch.tensor(TIME)), strict=True)
        ]
        print(f"{method:>17}" + "".join(f"{error:10.1e}" for error in errors))
        off = (spots(coarse[0], found[0]) - before).abs().clamp_min(1e-6).log10()
        title = f"error of the start, {method} (time off by {100 * errors[1]:.2g} %)"
        scale = {"limits": (-4.5, -2.0), "label": "log₁₀ of |error|", "cmap": "magma"}
        plot_surface(*coarse, off, ax=ax, title=title, view=LEFT, **scale)
    save(figure, options.output, "find_heat_source.png")


if __name__ == "__main__":
    main()
