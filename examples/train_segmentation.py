"""DiffusionNet learns the parts of shapes, turned at random, on their meshes; it is tested on meshes or on clouds.

Usage: python examples/train_segmentation.py [--data PATH] [--operator stencil|cotangent] [--test meshes|clouds]
PATH: an .npz of `vertices` (N, 3) or (S, N, 3), `faces`, `labels` (N,), -1 where unknown, or a folder of such files.
"""

import argparse
import os
from pathlib import Path

import igl
import matplotlib as mpl

mpl.use("Agg")  # pictures go to files; no screen is needed
import matplotlib.pyplot as plt
import numpy as np
import torch
import trimesh
from scipy.spatial import KDTree
from torch.nn.functional import cross_entropy
from tqdm import tqdm

from torchlb import DiffusionNet, clean_mesh, load_or_build
from torchlb.plot import plot_points, plot_surface
from torchlb.surfaces import Ellipsoid

FRONT = (90.0, -90.0)  # elevation and azimuth of the eye: y is up


def read(path):
    """Vertices, faces, labels of every shape, centred and of radius one; ellipsoids in three belts without a path."""
    if path is None:
        axes = 0.5 + 0.5 * torch.rand(12, 2, generator=torch.Generator().manual_seed(0))
        meshes = [Ellipsoid((*pair.tolist(), 1.5)).mesh(1000) for pair in axes]
        shapes = [(v, f, (2 * v[:, 2].abs()).long().clamp_max(2)) for v, f in meshes]
    else:
        shapes = []
        for file in sorted(path.glob("*.npz")) if path.is_dir() else [path]:
            with np.load(file) as data:
                v, f, y = (torch.tensor(data[name]) for name in ("vertices", "faces", "labels"))
            stack = v.double().reshape(-1, *v.shape[-2:])
            shapes += [(vertices, f.long(), y.long()) for vertices in stack]
    cleaned = [(*clean_mesh(v, f), y) for v, f, y in shapes]
    centred = [(v - v.mean(0), f, y[kept]) for v, f, kept, y in cleaned]
    return [(v / v.norm(dim=1).max(), f, y) for v, f, y in centred]


def decimated(vertices, faces, labels, size):
    """A mesh of about `size` evenly spread vertices; the mesh itself if it is no manifold, which libigl refuses."""
    if len(vertices) <= size:
        return vertices, faces, labels
    coarse, triangles, _, origin = igl.decimate(vertices.numpy(), faces.numpy(), 2 * size)
    if len(coarse) == 0:
        return vertices, faces, labels
    return torch.tensor(coarse), torch.tensor(triangles), labels[torch.tensor(origin)]


def sampled(vertices, faces, labels, size, seed=0):
    """A cloud of `size` points on a mesh, no two very close, each with the label of the nearest vertex; no faces."""
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    points, _ = trimesh.sample.sample_surface_even(mesh, size, seed=seed)
    return torch.tensor(points), None, labels[KDTree(vertices).query(points)[1]]


def turn():
    """A random rotation."""
    q, r = torch.linalg.qr(torch.randn(3, 3))
    q = q * r.diagonal().sign()
    return q * q.det()


def train_epoch(net, optimizer, data, epoch):
    """One pass in random order, each shape turned anew. The same in every run, also a resumed one."""
    torch.manual_seed(epoch)
    net.train()
    for i in torch.randperm(len(data)).tolist():
        lb, labels = data[i]
        optimizer.zero_grad()
        cross_entropy(net(lb.points @ turn(), lb), labels, ignore_index=-1).backward()
        optimizer.step()


@torch.no_grad()
def evaluate(net, data):
    """Share of right labels among the known ones, and the predictions; each shape is turned, always alike."""
    torch.manual_seed(0)
    net.eval()
    predicted = [net(lb.points @ turn(), lb).argmax(1) for lb, _ in data]
    known = torch.cat([labels for _, labels in data])
    return (torch.cat(predicted) == known)[known >= 0].float().mean().item(), predicted


def draw(shapes, predicted, path):
    """Predicted labels above the given ones, a colour for each triangle (that of its median corner) or point."""
    size = (4 * len(shapes), 8)
    figure, axes = plt.subplots(2, len(shapes), figsize=size, layout="constrained", squeeze=False)
    for column, (vertices, faces, given), found in zip(axes.T, shapes, predicted, strict=True):
        for ax, labels, title in zip(column, (found, given), ("predicted", "given"), strict=True):
            if faces is None:
                plot_points(vertices, labels, ax=ax, title=title, cmap="tab10", view=FRONT)
                continue
            corners = torch.arange(faces.numel()).reshape(-1, 3)
            colors = labels[faces].median(1).values.repeat_interleave(3)
            soup = vertices[faces].flatten(0, 1)
            plot_surface(soup, corners, colors, ax=ax, title=title, cmap="tab10", view=FRONT)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="two of three shapes train, the third tests")
    parser.add_argument("--operator", choices=["stencil", "cotangent"], default="stencil")
    parser.add_argument("--test", choices=["meshes", "clouds"], default="meshes")
    parser.add_argument("--decimate", type=int, default=2000, help="vertices of a shape")
    parser.add_argument("--method", default="spectral", help="of the diffusion")
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--width", type=int, default=32, help="channels of the network")
    parser.add_argument("--k", type=int, default=64, help="eigenpairs")
    parser.add_argument("--output", type=Path, default=Path("segmentation_output"))
    parser.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint in --output"
    )
    options = parser.parse_args(arguments)
    shapes = [decimated(*shape, options.decimate) for shape in read(options.data)]
    if options.test == "clouds":  # which have no cotangent operator: the stencil of points serves
        shapes[2::3] = [sampled(*shape, len(shape[0])) for shape in shapes[2::3]]
    data = []
    for vertices, faces, labels in tqdm(shapes, "operators"):
        lb = load_or_build(
            vertices,
            faces,
            cache=options.output / "operators",
            operator="stencil" if faces is None else options.operator,
            k=options.k,
            progress=False,
        )
        data.append((lb.float(), labels))
    train, test = [pair for i, pair in enumerate(data) if i % 3 < 2], data[2::3]
    torch.manual_seed(0)
    classes = int(max(labels.max() for _, labels in data)) + 1
    # Without rotations of gradients a cloud needs no normals that point all to one side.
    net = DiffusionNet(
        3,
        classes,
        width=options.width,
        rotations=False,
        method=options.method,
        k=options.k,
    )
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    first, checkpoint = 0, options.output / "checkpoint.pt"
    if options.resume and checkpoint.exists():
        state = torch.load(checkpoint)
        net.load_state_dict(state["net"])
        optimizer.load_state_dict(state["optimizer"])
        first = state["epoch"]
    with tqdm(range(first, options.epochs), "epochs") as bar:
        for epoch in bar:
            train_epoch(net, optimizer, train, epoch)
            bar.set_postfix(accuracy=f"{evaluate(net, test)[0]:.3f}")
            state = {"net": net.state_dict(), "optimizer": optimizer.state_dict()}
            torch.save(state | {"epoch": epoch + 1}, checkpoint.with_suffix(".new"))
            os.replace(checkpoint.with_suffix(".new"), checkpoint)  # whole or not at all
    accuracy, predicted = evaluate(net, test)
    draw(shapes[2::3][:3], predicted[:3], options.output / "labels.png")
    print(f"accuracy on {len(test)} test {options.test}: {accuracy:.3f}")
    print(f"{options.output / 'labels.png'}\n{checkpoint}")
    return accuracy


if __name__ == "__main__":
    main()
