"""Training with PyTorch Geometric: its DataLoader batches shapes of different sizes, and their operators with them.

Usage: python examples/train_pyg.py [--output gallery_output] [--points 400] [--epochs 20]
Needs `pip install ".[pyg]"`. DiffusionNet learns from heat kernel signatures which vertices are more curved than
the others of their shape, however it is turned and meshed.
"""

import sys

import matplotlib.pyplot as plt
import torch
from _common import read_options, save
from torch.nn.functional import binary_cross_entropy_with_logits
from tqdm import tqdm

from torchlb import DiffusionNet, heat_kernel_signature
from torchlb.plot import plot_surface
from torchlb.surfaces import StarShaped

K = 32


def label(data, lb):
    """Add signatures as features, and as labels which vertices have more than the median of the mean curvature."""
    signatures = heat_kernel_signature(lb, k=K).log()
    data.x = (signatures - signatures.mean(0)) / signatures.std(0)
    curvature = lb.mean_curvature_normal().norm(dim=1)
    data.y = (curvature > curvature.median()).float()
    return data


def main(arguments=None):
    sizes = {"points": (400, "of the smallest shape"), "epochs": (20, "of training")}
    options = read_options(__doc__, arguments, **sizes)
    try:
        from torch_geometric.data import Data
        from torch_geometric.loader import DataLoader

        from torchlb.interop.pyg import LaplaceBeltramiTransform, to_operator
    except ImportError:
        sys.exit('PyTorch Geometric is not installed: pip install ".[pyg]"')
    torch.manual_seed(0)
    transform, shapes = LaplaceBeltramiTransform(order=3, k=K), []
    for i in tqdm(range(6), "shapes", disable=None):
        vertices, faces = StarShaped(0.1 + 0.03 * i).mesh(options.points + 20 * i, seed=i)
        turn = torch.linalg.qr(torch.randn(3, 3))[0]
        pos = vertices.float() @ (turn * turn.det())
        data = transform(Data(pos=pos, face=faces.T))  # faces are (3, F) in PyG
        shapes.append(label(data, to_operator(data)))
    test = shapes.pop(3)
    train = DataLoader(shapes, batch_size=2, shuffle=True)

    small = {"width": 32, "num_blocks": 2, "k": K, "dropout": False}
    net = DiffusionNet(test.x.shape[1], 1, method="spectral", **small)
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-3)
    losses = []
    for _ in tqdm(range(options.epochs), "epochs", disable=None):
        for batch in train:
            logits = net(batch.x, to_operator(batch))[:, 0]
            loss = binary_cross_entropy_with_logits(logits, batch.y)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    with torch.no_grad():
        predicted = net(test.x, to_operator(test))[:, 0].sigmoid()
    right = ((predicted > 0.5) == test.y).float().mean()
    print(f"loss {losses[0]:.3f} → {losses[-1]:.3f}; right on a shape never seen: {right:.1%}")

    figure, axes = plt.subplots(1, 3, figsize=(14, 4), layout="constrained")
    axes[0].plot(losses)
    axes[0].set(xlabel="step", ylabel="loss", ylim=(0, None))
    panels = {"predicted probability of more curvature": predicted, "given": test.y}
    for ax, (title, values) in zip(axes[1:], panels.items(), strict=True):
        plot_surface(test.pos, test.face.T, values, ax=ax, title=title, limits=(0.0, 1.0))
    save(figure, options.output, "train_pyg.png")


if __name__ == "__main__":
    main()
