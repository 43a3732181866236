"""Tangent fields: a vector transported to all points, normal coordinates around a point, and a harmonic field.

Usage: python examples/vector_fields.py [--points 8000] [--sphere 2000] [--torus 2000]
Transport is compared with the exact one along the great circles of a sphere. A field on a torus is split into a
gradient, a rotated gradient and a harmonic part, which no function gives.
"""

import matplotlib.pyplot as plt
import torch
from _common import read_options, save
from torch.nn.functional import normalize

from torchlb import LaplaceBeltrami, hodge_decomposition, logarithmic_map, parallel_transport
from torchlb.plot import plot_surface, plot_vectors
from torchlb.surfaces import Sphere, StarShaped, Torus

SEEN = [0.4, -0.8, 0.45]  # a direction towards the eye
TILE = 0.25  # side of a square


def along_great_circles(x, vector):
    """A tangent vector of the unit sphere at x[0], turned with the great circles from there, and the distances."""
    cosine = x @ x[0]
    away = normalize(x - cosine[:, None] * x[0], dim=1)
    angle = cosine.clamp(-1, 1).acos()[:, None]
    turned = (angle.cos() - 1) * away - angle.sin() * x[0]
    return vector + (away @ vector)[:, None] * turned, angle[:, 0]


def main(arguments=None):
    numbers = dict(points=(8000, "of the shape"), sphere=(2000, "points"), torus=(2000, "points"))
    options = read_options(__doc__, arguments, **numbers)
    x, faces = Sphere().mesh(options.sphere)
    lb = LaplaceBeltrami.from_mesh(x, faces)
    vector = normalize(torch.linalg.cross(x[0], x[1]), dim=0)
    exact, distance = along_great_circles(x, vector)
    off = (parallel_transport(lb, 0, vector) - exact).norm(dim=1)[distance < 2.5]
    print(f"sphere: transport off by {off.mean():.1e} in the mean, {off.max():.1e} at most")

    figure, axes = plt.subplots(1, 3, figsize=(15, 4.4), layout="constrained")
    x, faces = StarShaped().mesh(options.points)
    lb = LaplaceBeltrami.from_mesh(x, faces)
    source = int((normalize(x, dim=1) @ x.new_tensor(SEEN)).argmax())
    moved = parallel_transport(lb, source, lb.frames[source, :, 0])
    place = logarithmic_map(lb, source)
    shown = {"title": "a vector transported, over the distance", "label": "distance"}
    distance = place.norm(dim=1)
    plot_vectors(x, faces, moved, distance, ax=axes[0], cmap="YlOrBr", **shown)
    tiles = (torch.pi * place / TILE).sin().prod(1)  # changes its sign from a square to the next
    shown = {"title": "squares in normal coordinates", "levels": [0.0]}
    plot_surface(x, faces, tiles, ax=axes[1], label="sin(πa/h) sin(πb/h)", **shown)

    x, faces = Torus().mesh(options.torus)
    lb = LaplaceBeltrami.from_mesh(x, faces)
    a, b, c = x.T
    field = torch.stack([b * c - b, a.square() + a, a.sin()], 1)
    parts = hodge_decomposition(lb, field)
    for name in ("gradient", "rotated", "harmonic"):
        part = getattr(parts, name)
        print(f"torus: {name} part of norm {lb.inner(part, part).sum().sqrt():.3f}")
    total = parts.gradient + parts.rotated + parts.harmonic
    print(f"torus: the field has norm {lb.inner(total, total).sum().sqrt():.3f}")
    shown = {"title": "harmonic part of a field", "label": "length"}
    plot_vectors(x, faces, parts.harmonic, ax=axes[2], **shown)
    save(figure, options.output, "vector_fields.png")


if __name__ == "__main__":
    main()
