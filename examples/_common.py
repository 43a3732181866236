"""What the examples share: their options, the surface that they show, and where their pictures go."""

import argparse
from pathlib import Path

import igl
import matplotlib as mpl

mpl.use("Agg")  # pictures go to files; no screen is needed
import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image

from torchlb.plot.figures import LINE_COLORS
from torchlb.surfaces import StarShaped, limit_surface

mpl.rcParams["axes.prop_cycle"] = mpl.cycler(color=LINE_COLORS)
# Elevation and azimuth of an eye that sees the outer side of a left hemisphere.
LEFT = (15.0, 200.0)


def read_options(doc, arguments=None, **others):
    """Options of the command line: --output and, by name, whole numbers (or a path, None) and what they are."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument(
        "--output", type=Path, default=Path("gallery_output"), help="for the picture"
    )
    for name, (default, text) in others.items():
        kind, note = (Path, "") if default is None else (int, f" (default: {default})")
        parser.add_argument(f"--{name}", type=kind, default=default, help=text + note)
    return parser.parse_args(arguments)


def cortex(kind="infl_left", points=0):
    """Vertices, faces, name and unit of a cortical surface that comes with nilearn, fsaverage5: 10,242 vertices, mm.

    A star-shaped one of `points` where they are asked for, and of 4,000 where nilearn is missing.
    """
    try:
        from nilearn.datasets import fetch_surf_fsaverage
        from nilearn.surface import load_surf_mesh
    except ImportError:
        print(
            "nilearn is not installed: an analytic surface stands in for its cortex (pip install nilearn)"
        )
        points = points or 4000
    if points:
        return *StarShaped().mesh(points), "star-shaped surface", ""
    mesh = load_surf_mesh(fetch_surf_fsaverage("fsaverage5")[kind])  # no download
    vertices, faces = np.array(mesh.coordinates, float), np.array(mesh.faces, int)
    return torch.tensor(vertices), torch.tensor(faces), f"fsaverage5 ({kind})", "mm"


def smoothed(vertices, faces, points, levels, decimate=igl.qslim):
    """Meshes (vertices, faces) of the levels 0, 1, … of a closed surface made smooth, of area 1, and where it was.

    It is decimated to so many points and subdivided to its limit, on which the vertices of all levels stand: those of
    a coarse one are the first of a finer one. The last thing returned has the number of the given vertex that each
    point of level 0 was.
    """
    control = decimate(vertices.numpy(), faces.numpy(), 2 * points - 4)
    places, levels = limit_surface(*(torch.from_numpy(a) for a in control[:2]), levels)
    a, b, c = places[levels[-1]].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2
    places = (places - places.mean(0)) / area.sqrt()
    return [(places[: int(f.max()) + 1], f) for f in levels], torch.from_numpy(control[3])


def smooth_cortex(points, levels):
    """Name and `smoothed` meshes of a folded cortical surface."""
    vertices, faces, name, _ = cortex("pial_left")
    return f"{name}, made smooth", smoothed(vertices, faces, points, levels)[0]


def normals(vertices, faces):
    """Normals of the triangles, twice as long as their areas, and unit ones of the vertices: the means around them."""
    a, b, c = vertices[faces].unbind(1)
    flat = torch.linalg.cross(b - a, c - a)
    mean = torch.zeros_like(vertices).index_add_(0, faces.flatten(), flat.repeat_interleave(3, 0))
    return flat, torch.nn.functional.normalize(mean)


def minimize(loss, unknowns, steps):
    """LBFGS with a line search, in place."""
    optimizer = torch.optim.LBFGS(
        unknowns, max_iter=steps, tolerance_change=1e-14, line_search_fn="strong_wolfe"
    )

    def closure():
        optimizer.zero_grad()
        value = loss()
        value.backward()
        return value

    optimizer.step(closure)


def save(figure, folder, name):
    """Write a figure as a picture of 256 colours, which is small, close it, and say where it is."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / name, dpi=90)
    plt.close(figure)
    with Image.open(folder / name) as picture:
        small = picture.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=4)
    small.save(folder / name, optimize=True)
    print(folder / name)
