"""The same training on one process and on several: DiffusionNet learns the mean curvature of ellipsoids.

Usage: python examples/train_ddp.py [--output ddp_output] [--steps 40]
       torchrun --nproc_per_node=2 examples/train_ddp.py
"""

import argparse
import json
import os
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")  # pictures go to files; no screen is needed
import matplotlib.pyplot as plt
import torch
import torch.distributed as dist
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from torchlb import DiffusionNet, load_or_build
from torchlb.surfaces import Ellipsoid

SHAPES = 4


def shape(i, points, cache):
    """Operator, features and target of ellipsoid i: x, y, z and half the length of Δx. Every process may ask for it."""
    vertices, faces = Ellipsoid((1.0, 0.7 + 0.1 * i, 0.6)).mesh(points)
    lb = load_or_build(vertices, faces, cache=cache, order=3, k=16, progress=False)
    return lb, vertices, lb.mean_curvature_normal().norm(dim=1, keepdim=True) / 2


def train(rank, processes, options):
    """Loss of every step, the mean over all shapes. Each process takes every `processes`-th of them."""
    torch.manual_seed(0)  # the same weights everywhere; DDP would send those of the first
    net = DiffusionNet(
        3, 1, width=16, num_blocks=2, dropout=False, method="spectral", k=16
    ).double()
    model = DistributedDataParallel(net) if processes > 1 else net
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    cache = options.output / "cache"
    mine = [shape(i, options.points, cache) for i in range(SHAPES)][rank::processes]
    losses = []
    for _ in tqdm(range(options.steps), "training", disable=rank > 0, delay=2):
        optimizer.zero_grad()
        # One loss of all shapes, so that gradients, which DDP averages over the processes, are the same.
        loss = torch.stack([(model(x, lb) - y).square().mean() for lb, x, y in mine]).mean()
        loss.backward()
        optimizer.step()
        mean = loss.detach().clone()
        if processes > 1:
            dist.all_reduce(mean)
        losses.append(mean.item() / processes)
    return losses


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("ddp_output"), help="cache and picture")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--points", type=int, default=500, help="of each shape")
    options = parser.parse_args()
    rank, processes = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    torch.set_num_threads(max(1, torch.get_num_threads() // processes))
    if processes > 1:
        dist.init_process_group("gloo")
    losses = train(rank, processes, options)
    if rank == 0:
        (options.output / f"losses_{processes}.json").write_text(json.dumps(losses))
        plt.semilogy(losses)
        plt.gca().set(xlabel="step", ylabel="loss", title=f"{processes} process(es)")
        plt.savefig(options.output / "loss.png", dpi=130)
        print(f"loss {losses[0]:.4f} → {losses[-1]:.4f}; {options.output / 'loss.png'}")
    if processes > 1:
        dist.barrier()  # nobody leaves while another still draws
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
