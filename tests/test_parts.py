"""Parts of a surface: their modes, and maps that are smoothed within them."""

import math

import numpy as np
import pytest
import torch

from torchlb import InputError, LaplaceBeltrami, heat_flow, smooth, submesh
from torchlb.surfaces import Hemisphere, Sphere, UnitDisk

FWHM = math.sqrt(8 * math.log(2))  # of a standard deviation of one


def mirrored(count):
    """A sphere of two hemispheres that share the equator, the upper one first."""
    upper, faces = Hemisphere().mesh(count)
    inside = upper[:, 2] > 1e-9
    number = torch.where(inside, inside.cumsum(0) - 1 + len(upper), torch.arange(len(upper)))
    lower = upper[inside] * torch.tensor([1.0, 1, -1])
    return torch.cat([upper, lower]), torch.cat([faces, number[faces].flip(1)]), upper, faces


@pytest.mark.parametrize("condition", ["neumann", "dirichlet"])
def test_modes_of_a_hemisphere_cut_from_a_sphere(condition):
    """Those of its mesh by itself; l(l + 1), of the spherical harmonics that are even, or odd, across the equator."""
    vertices, faces, upper, half = mirrored(600)
    part, cells, kept = submesh(vertices, faces, vertices[:, 2] > -1e-9)
    assert torch.equal(part, upper)
    assert torch.equal(cells, half)
    assert torch.equal(kept, torch.arange(len(upper)))
    found, expected = (
        LaplaceBeltrami.from_mesh(*mesh, condition=condition).eigenbasis(10).eigenvalues
        for mesh in ((part, cells), (upper, half))
    )
    assert torch.equal(found, expected)
    exact = {"neumann": [0, 2, 2, 6, 6, 6, 12, 12, 12, 12], "dirichlet": [2, 6, 6, *[12] * 3]}
    exact = torch.tensor(exact[condition], dtype=torch.float64)
    assert (found[: len(exact)] - exact).abs().max() < 2e-3


def test_modes_of_a_part_with_a_ragged_boundary():
    """As the area that is left has them: of first order in the edges, which the cut follows."""
    vertices, faces = Sphere().mesh(8000)
    part, cells, kept = submesh(vertices.numpy(), faces.numpy(), (vertices[:, 2] > 0).numpy())
    assert torch.equal(part, vertices[kept])
    lb = LaplaceBeltrami.from_mesh(part, cells)
    assert (lb.eigenbasis(3).eigenvalues[1:] / 2 - 1).abs().max() < 0.06


def test_data_of_a_part_go_out_and_back():
    vertices, faces = Sphere().mesh(200)
    mask, f = vertices[:, 0] > -0.3, vertices[:, 1]
    _, cells, kept = submesh(vertices, faces, mask)
    whole = torch.full_like(f, torch.nan)
    whole[kept] = f[kept]
    assert torch.equal(whole[kept[cells]], f[faces[mask[faces].all(1)]])
    assert not mask[kept].logical_not().any()


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (torch.ones(60), r"boolean mask of shape \(60,\), as f > 0, got torch.float32"),
        (torch.ones(59, dtype=torch.bool), r"got torch.bool \(59,\)"),
        (torch.arange(60) < 2, "no face has all its corners among its 2 vertices"),
    ],
)
def test_masks_that_are_none(mask, message):
    vertices, faces = Sphere().mesh(60)
    with pytest.raises(InputError, match=message):
        submesh(vertices, faces, mask)


def test_smoothing_is_the_flow_of_that_width():
    """Spherical harmonics of degree l fall by e^{−l(l + 1)σ²/2}; at half of the width, half of the maximum."""
    vertices, faces = Sphere().mesh(600)
    lb, (x, y, z) = LaplaceBeltrami.from_mesh(vertices, faces), vertices.T
    f = torch.stack([z, x * y], 1)
    expected = f * torch.exp(-torch.tensor([2.0, 6.0]) * 0.3**2 / 2)
    torch.testing.assert_close(smooth(lb, f, 0.3 * FWHM), expected, atol=1e-4, rtol=0)
    assert torch.equal(smooth(lb, z, np.float64(0)), heat_flow(lb, z, 0.0))
    vertices, faces = UnitDisk().mesh(3000)
    radius = vertices.norm(dim=1)
    peak = torch.zeros_like(radius).index_fill(0, radius.argmin(), 1.0)
    found = smooth(LaplaceBeltrami.from_mesh(vertices, faces), peak, 0.4)
    half = radius[found > found.max() / 2].max()
    assert abs(half - 0.2) < 0.03


def test_smoothing_within_a_mask():
    """Constants stay, whatever is outside; with a whole mask it is that without."""
    vertices, faces = Sphere().mesh(600)
    lb, z = LaplaceBeltrami.from_mesh(vertices, faces), vertices[:, 2]
    mask = z > -0.2
    gaps = torch.where(mask, 3.0, torch.nan).double()
    found = smooth(lb, torch.stack([gaps, torch.where(mask, z, 1e6)], 1), 0.5, mask=mask)
    assert torch.equal(found.isnan(), ~mask[:, None].expand(-1, 2))
    assert (found[mask, 0] - 3).abs().max() < 1e-6
    assert (found[mask, 1] - z[mask]).abs().max() < 0.4
    array = smooth(lb, gaps.numpy(), 0.5, mask=mask.numpy())
    np.testing.assert_allclose(array, found[:, 0].numpy(), atol=1e-12)
    whole = smooth(lb, z, 0.5, mask=torch.ones_like(mask))
    torch.testing.assert_close(whole, smooth(lb, z, 0.5))
    f = z.clone().requires_grad_()
    smooth(lb, f, 0.5, mask=mask)[mask].sum().backward()
    assert torch.equal(f.grad != 0, mask)


@pytest.mark.parametrize(
    ("f", "options", "message"),
    [
        (torch.full((60,), torch.nan), {"fwhm": 1.0}, "at 60 of 60 points"),
        (torch.zeros(60), {"fwhm": -1.0}, "fwhm: expected a length of at least 0, got -1.0"),
        (torch.zeros(60), {"fwhm": "6 mm"}, "fwhm: expected a length of at least 0, got '6 mm'"),
        (torch.zeros(60), {"fwhm": 1.0, "mask": torch.ones(60)}, "mask: expected a boolean mask"),
        (torch.zeros(5), {"fwhm": 1.0, "mask": torch.ones(60) > 0}, "N = 60"),
        ([0.0], {"fwhm": 1.0, "mask": torch.ones(60) > 0}, "expected f as a tensor"),
    ],
)
def test_what_cannot_be_smoothed_is_named(f, options, message, unchecked):
    with pytest.raises(InputError, match=message):
        smooth(LaplaceBeltrami.from_cotangent(*Sphere().mesh(60)), f, **options)
