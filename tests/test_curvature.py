"""Principal, mean and Gaussian curvature against exact ones; their order, invariances and derivatives."""

import numpy as np
import pytest
import torch

from torchlb import InputError, LaplaceBeltrami
from torchlb.surfaces import CliffordTorus, Ellipsoid, Hemisphere, Sphere, Torus, UnitDisk

R, r = 1.0, 0.4
COUNTS = (700, 1400, 2800, 5600)


def torus(points):
    """κ along the meridian is 1/r, along the circle of latitude cos φ/(R + r cos φ)."""
    cos = (points[:, :2].norm(dim=1) - R) / r
    return torch.full_like(cos, 1 / r), cos / (R + r * cos)


def ellipsoid(points, axes):
    """From its implicit equation: K and H of Σ x²/a² = 1."""
    a = torch.tensor(axes, dtype=torch.float64)
    weight = (points.square() / a**4).sum(1)
    k = 1 / (a.prod() ** 2 * weight**2)
    h = (a.square().sum() - points.square().sum(1)) / (2 * a.prod() ** 2 * weight**1.5)
    root = (h.square() - k).clamp_min(0).sqrt()
    return h + root, h - root


def off(ours, exact, mass):
    """Relative error in the mean square."""
    return float(((mass * (ours - exact).square()).sum() / (mass * exact.square()).sum()).sqrt())


@pytest.mark.parametrize(("source", "bound"), [("mesh", 4e-3), ("cloud", 4e-3), ("random", 1.2e-2)])
def test_a_torus_of_2000_points(source, bound):
    """K and H relative to their size, directions within half a degree."""
    vertices, faces = Torus(R, r).mesh(2000)
    if source == "mesh":
        lb = LaplaceBeltrami.from_mesh(vertices, faces)
    else:
        points = vertices if source == "cloud" else Torus(R, r).random_points(2000)
        lb = LaplaceBeltrami.from_points(points)
    k1, k2 = torus(lb.points)
    found = lb.curvatures()
    for ours, exact in (
        (found.gaussian, k1 * k2),
        (found.mean, (k1 + k2) / 2),
        (found.k1, k1),
        (found.k2, k2),
        (found.curvedness, ((k1**2 + k2**2) / 2).sqrt()),
    ):
        assert off(ours, exact, lb.mass) < bound
    index = 2 / np.pi * torch.atan((k1 + k2) / (k1 - k2))
    assert (found.shape_index - index).abs().max() < 10 * bound
    around = torch.linalg.cross(lb.points.new_tensor([[0, 0, 1.0]]).expand_as(lb.points), lb.points)
    along = torch.nn.functional.normalize(around)
    turn = torch.linalg.cross(found.directions[..., 1], along).norm(dim=1).asin().rad2deg()
    assert turn.max() < 0.5 if source != "random" else turn.median() < 0.5
    bending = found.frames @ found.shape_operator @ found.frames.mT
    bent = found.directions * torch.stack([found.k1, found.k2], -1)[:, None]
    torch.testing.assert_close(bending @ found.directions, bent)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("order", "least"), [(1, 1.5), (3, 3.0), (5, 4.5)])
def test_the_order(order, least):
    """The error of K on an ellipsoid falls like h^p or faster, from 700 to 5,600 vertices."""
    axes, errors = (1.0, 0.8, 0.6), []
    for count in COUNTS:
        lb = LaplaceBeltrami.from_mesh(*Ellipsoid(axes).mesh(count), order=order)
        k1, k2 = ellipsoid(lb.points, axes)
        errors.append(off(lb.curvatures().gaussian, k1 * k2, lb.mass))
    slope = -2 * np.polyfit(np.log(COUNTS), np.log(errors), 1)[0]
    assert slope > least, errors


def test_the_sphere_is_umbilic_and_scaling_turning_and_sides_do_what_they_should():
    """κ₁ = κ₂ = 1/radius; turned inside out both change their sign, and K does not."""
    vertices, faces = Sphere().mesh(500)
    found = LaplaceBeltrami.from_mesh(3 * vertices, faces).curvatures()
    assert (found.k1 - 1 / 3).abs().max() < 1e-3
    assert (found.k2 - 1 / 3).abs().max() < 1e-3
    assert (found.shape_index - 1).abs().max() < 0.01
    assert "500 points, from 0.33" in repr(found)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    vertices, faces = Ellipsoid().mesh(300)
    one, two, three = (
        LaplaceBeltrami.from_mesh(*mesh).curvatures()
        for mesh in ((vertices, faces), (vertices @ turn.T, faces), (vertices, faces.flip(1)))
    )
    sign = turn.det().sign()  # a reflection turns normals of the same faces inward
    torch.testing.assert_close(two.gaussian, one.gaussian, rtol=0, atol=1e-8)
    torch.testing.assert_close(two.mean, sign * one.mean, rtol=0, atol=1e-8)
    torch.testing.assert_close(three.mean, -one.mean, rtol=0, atol=1e-8)
    torch.testing.assert_close(three.k1, -one.k2, rtol=0, atol=1e-8)
    vector = LaplaceBeltrami.from_mesh(vertices, faces).mean_curvature_normal()
    assert (vector.norm(dim=1) - 2 * one.mean).abs().median() < 0.05


def moebius():
    """A strip with a half turn: no side is the outer one."""
    t = torch.arange(80, dtype=torch.float64) * torch.pi / 40
    s = torch.linspace(-0.3, 0.3, 9, dtype=torch.float64)
    t, s = (x.flatten() for x in torch.meshgrid(t, s, indexing="ij"))
    radius = 1 + s * (t / 2).cos()
    points = torch.stack([radius * t.cos(), radius * t.sin(), s * (t / 2).sin()], 1)
    i, j = (x.flatten() for x in torch.meshgrid(torch.arange(80), torch.arange(8), indexing="ij"))

    def number(i, j):
        return torch.where(i < 80, 9 * i + j, 9 * (i - 80) + 8 - j)

    corners = number(i, j), number(i + 1, j), number(i + 1, j + 1), number(i, j + 1)
    a, b, c, d = corners
    return points, torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])


def test_a_surface_without_sides():
    """K = −(1/4)/(s²/4 + (1 + s cos t/2)²)² of the ruled strip has no seam where the normals turn round."""
    points, faces = moebius()
    lb = LaplaceBeltrami.from_mesh(points, faces)
    found = lb.curvatures().gaussian
    s = torch.linspace(-0.3, 0.3, 9, dtype=torch.float64).repeat(80)
    t = (torch.arange(80, dtype=torch.float64) * torch.pi / 40).repeat_interleave(9)
    exact = -((s**2 / 4 + (1 + s * (t / 2).cos()) ** 2) ** -2) / 4
    middle = s.abs() < 0.2
    assert off(found[middle], exact[middle], lb.mass[middle]) < 0.02


def test_derivatives_in_the_points():
    """Of all that does not depend on a sign, by differences; finite at the umbilics of a sphere."""
    vertices, faces = Ellipsoid((1.0, 0.8, 0.6)).mesh(200)
    generator = torch.Generator().manual_seed(0)
    w, way, bend = torch.randn(3, *vertices.shape, dtype=torch.float64, generator=generator)
    lb = LaplaceBeltrami.from_mesh(vertices + 0.003 * bend, faces)
    for name in ("mean", "gaussian", "k1", "k2", "curvedness", "shape_index"):

        def value(points, name=name):
            return (w[:, 0] * getattr(lb.at(points).curvatures(), name)).sum()

        x = lb.points.clone().requires_grad_()
        (g,) = torch.autograd.grad(value(x), x)
        ends = [float(value(lb.points + s * 1e-6 * way)) for s in (1, -1)]
        assert float((g * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-4)
    x = Sphere().mesh(200)[0].requires_grad_()
    LaplaceBeltrami.from_mesh(x, Sphere().mesh(200)[1]).curvatures().gaussian.sum().backward()
    assert x.grad.isfinite().all()


def test_boundaries_batches_and_float32():
    """A cap of the sphere; shapes of a batch have their own."""
    lb = LaplaceBeltrami.from_mesh(*Hemisphere().mesh(400))
    assert (lb.curvatures().gaussian - 1).abs().median() < 1e-3
    other = LaplaceBeltrami.from_mesh(*Torus().mesh(300))
    together = LaplaceBeltrami.batch([lb, other]).curvatures().mean
    torch.testing.assert_close(together, torch.cat([x.curvatures().mean for x in (lb, other)]))
    assert (lb.float().curvatures().gaussian - 1).abs().median() < 2e-3


def test_other_shapes_are_refused():
    disk = LaplaceBeltrami.from_mesh(UnitDisk().mesh(100)[0][:, :2], UnitDisk().mesh(100)[1])
    clifford = LaplaceBeltrami.from_points(CliffordTorus().points(300), dim=2)
    for lb in (disk, clifford):
        with pytest.raises(InputError, match="expected a surface in R³"):
            lb.curvatures()
