"""Boundaries: their points and conormals, and the Neumann condition as data of the stencil."""

import numpy as np
import pytest
import torch

from torchlb import LaplaceBeltrami
from torchlb.boundary import boundary_of_mesh
from torchlb.surfaces import Hemisphere, UnitDisk
from torchlb.tangent import mesh_frames


def spectrum(lb, count):
    """The smallest eigenvalues of −Δ and the spectral abscissa of Δ, densely."""
    values = torch.linalg.eigvals(lb.matrix.to_dense())
    return (-values.real).sort().values[:count], float(values.real.max())


def operators(surface, n, order):
    vertices, faces = surface.mesh(n)
    mask = surface.boundary_mask(vertices)
    yield LaplaceBeltrami.from_mesh(vertices, faces, order=order)
    yield LaplaceBeltrami.from_points(vertices, dim=2, order=order, boundary=mask)


@pytest.mark.parametrize("surface", [UnitDisk(), Hemisphere()], ids=["disk", "hemisphere"])
@pytest.mark.parametrize(
    ("order", "bound"), [(1, 3e-2), (2, 5e-2), (3, 2e-3), (4, 2e-3), (5, 1e-4)]
)
def test_neumann_spectrum(surface, order, bound):
    """First 10 eigenvalues against the exact ones at N = 700, and the certificate."""
    exact = surface.eigenvalues(10)
    for lb in operators(surface, 700, order):
        values, abscissa = spectrum(lb, 10)
        assert ((values - exact).abs()[1:] / exact[1:]).max() <= bound
        assert abscissa <= 1e-10 * lb.values.abs().max()
        assert lb.certificate.holds


@pytest.mark.parametrize("order", [3, 4])
def test_neumann_spectrum_converges_at_the_order(order):
    """Slope of the worst of 9 eigenvalues ≥ p − 0.5 over N = 350, 700, 1400."""
    sizes, errors = [350, 700, 1400], []
    for n in sizes:
        lb = next(operators(UnitDisk(), n, order))
        exact = UnitDisk().eigenvalues(10)
        values, _ = spectrum(lb, 10)
        errors.append(float(((values - exact).abs()[1:] / exact[1:]).max()))
    slope = -2 * np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert slope >= order - 0.5


def test_conormals_of_disk_and_hemisphere():
    """ν = x on the rim of the disk, ν = −e_z on that of the hemisphere."""
    for surface in (UnitDisk(), Hemisphere()):
        vertices, faces = surface.mesh(700)
        frames = mesh_frames(vertices, faces)
        if isinstance(surface, Hemisphere):
            frames = surface.frames(vertices)
        boundary = boundary_of_mesh(vertices, faces, frames, 4)
        mask = surface.boundary_mask(vertices)
        assert torch.equal(boundary.mask, mask)
        down = torch.tensor([0.0, 0, -1]).double().expand(int(mask.sum()), 3)
        exact = vertices[mask] if isinstance(surface, UnitDisk) else down
        assert (boundary.conormals[mask] - exact).norm(dim=1).max() < 1e-4
        assert (boundary.conormals[~mask] == 0).all()


def test_boundary_of_a_cloud_is_detected():
    points = UnitDisk().points(700)
    asked = LaplaceBeltrami.from_points(points, dim=2, boundary="detect")
    told = LaplaceBeltrami.from_points(points, dim=2, boundary=UnitDisk().boundary_mask(points))
    torch.testing.assert_close(asked.matrix.to_dense(), told.matrix.to_dense())


def test_gradient_at_the_boundary_serves_any_function():
    """x has ∂x/∂ν ≠ 0 on the rim, and its gradient is e_x up to there."""
    vertices, faces = UnitDisk().mesh(700)
    lb = LaplaceBeltrami.from_mesh(vertices, faces, order=3)
    error = lb.gradient(vertices[:, 0]) - torch.tensor([1.0, 0, 0]).double()
    assert error.norm(dim=1).max() < 1e-8


def test_boundary_can_be_left_alone():
    """Without a condition x keeps Δx = 0 on the rows of full order up to the rim."""
    vertices, faces = UnitDisk().mesh(700)
    lb = LaplaceBeltrami.from_mesh(vertices, faces, order=2, boundary=None, certify=False)
    exact_rows = lb.report.order == 2
    assert lb(vertices[:, 0])[exact_rows].abs().max() < 1e-8


@pytest.mark.parametrize("bad", ["dirichlet", torch.zeros(3, dtype=torch.bool), torch.zeros(300)])
def test_bad_boundaries_are_refused(bad):
    with pytest.raises(ValueError, match="boundary"):
        LaplaceBeltrami.from_points(UnitDisk().points(300), dim=2, boundary=bad)


def test_bad_boundary_of_a_mesh_is_refused():
    with pytest.raises(ValueError, match="boundary"):
        LaplaceBeltrami.from_mesh(*UnitDisk().mesh(300), boundary="robin")
