"""Geodesic distance: over the given triangles, along curves, and over the surface through a cloud."""

import igl
import numpy as np
import pytest
import torch
import trimesh

from torchlb import InputError, LaplaceBeltrami, geodesic_distance
from torchlb.surfaces import Sphere


def test_distances_are_those_over_the_given_triangles():
    """At the corners of a box, whose frames do not tell which neighbours follow each other around a corner."""
    box = trimesh.creation.box()
    lb = LaplaceBeltrami.from_cotangent(box.vertices, box.faces)
    every = np.arange(8)
    exact = igl.exact_geodesic(
        np.asarray(box.vertices), np.asarray(box.faces), every[:1], every[:0], every, every[:0]
    )
    distance = geodesic_distance(lb, 0)
    adjacent = torch.from_numpy(exact) <= 2**0.5 + 1e-9  # within a pair of triangles
    torch.testing.assert_close(distance[adjacent], torch.from_numpy(exact)[adjacent])
    assert int(adjacent.sum()) == 7


@pytest.mark.parametrize("build", ["mesh", "cloud", "stencil"])
def test_distances_on_a_sphere(build):
    vertices, faces = Sphere().mesh(1000)
    lb = {
        "mesh": lambda: LaplaceBeltrami.from_mesh(vertices, faces),
        "cloud": lambda: LaplaceBeltrami.from_points(vertices),
        "stencil": lambda: LaplaceBeltrami.from_mesh(vertices, faces, weak_form=False),
    }[build]()
    exact = torch.acos((vertices @ vertices[0]).clamp(-1, 1))
    assert (geodesic_distance(lb, 0) - exact).abs().mean() < 0.01 * exact.mean()


def test_along_a_polygon():
    angle = 2 * torch.pi * torch.arange(40, dtype=torch.float64) / 40
    ends = torch.stack([torch.arange(40), (torch.arange(40) + 1) % 40], 1)
    lb = LaplaceBeltrami.from_mesh(torch.stack([angle.cos(), angle.sin()], 1), ends)
    side = 2 * torch.sin(torch.tensor(torch.pi / 40).double())
    steps = torch.minimum(torch.arange(40), 40 - torch.arange(40))
    torch.testing.assert_close(geodesic_distance(lb, 0), steps * side)


@pytest.mark.parametrize("sources", [[], 300, [-1], torch.zeros(300, dtype=torch.bool)])
def test_sources_that_are_none(sources):
    lb = LaplaceBeltrami.from_cotangent(*Sphere().mesh(300))
    with pytest.raises(InputError, match="sources"):
        geodesic_distance(lb, sources)
