"""The eigenbasis against known spectra, its exact properties, how it is kept, and what is computed from it."""

import copy

import numpy as np
import pytest
import torch
from scipy import linalg

from torchlb import (
    Diffusion,
    EigenbasisError,
    InputError,
    LaplaceBeltrami,
    SpectralConv,
    diffusion_distance,
    diffusion_map,
    heat_flow,
    heat_kernel_signature,
    spectral_wavelets,
    wave_kernel_signature,
)
from torchlb.spectral.eigenbasis import check_num_pairs
from torchlb.surfaces import Circle, CliffordTorus, Hemisphere, Sphere, Torus, UnitDisk

BUILDERS = {
    "points": lambda n: LaplaceBeltrami.from_points(Torus().points(n)),
    "random points": lambda n: LaplaceBeltrami.from_points(Torus().random_points(n)),
    "mesh": lambda n: LaplaceBeltrami.from_mesh(*Sphere().mesh(n)),
    "boundary": lambda n: LaplaceBeltrami.from_mesh(*UnitDisk().mesh(n)),
    "cotangent": lambda n: LaplaceBeltrami.from_cotangent(*Sphere().mesh(n)),
    "curve": lambda n: LaplaceBeltrami.from_points(Circle().points(n)),
    "surface in R^4": lambda n: LaplaceBeltrami.from_points(CliffordTorus().points(n), dim=2),
}
every_builder = pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS.keys())


def worst(eigenvalues, exact):
    return float(((eigenvalues[1:] - exact[1:]) / exact[1:]).abs().max())


def sphere_eigenvalues(k):
    order = torch.arange(20)
    return (order * (order + 1)).repeat_interleave(2 * order + 1)[:k].double()


@every_builder
@pytest.mark.parametrize(("n", "k"), [(120, 30), (120, 500), (600, 40)])
def test_contract(build, n, k):
    """ΦᵀMΦ = I, WᵀΦ = I, λ ascending, λ_0 = 0 and φ_0 constant exactly, KΦ = MΦΛ."""
    lb = build(n)
    basis = lb.eigenbasis(k, tolerance=1e-11)
    phi, eye = basis.eigenvectors, torch.eye(min(k, n), dtype=torch.float64)
    assert phi.shape == (n, min(k, n))
    assert (phi.T @ (lb.mass_matrix @ phi) - eye).abs().max() <= 1e-10
    assert (basis.left.T @ phi - eye).abs().max() <= 1e-10
    assert basis.eigenvalues[0] == 0
    assert (phi[:, 0] == phi[0, 0]).all()
    assert basis.eigenvalues[1] > 0
    assert (basis.eigenvalues.diff() >= 0).all()
    action = phi.T @ (lb.stiffness @ phi)
    assert (action - basis.eigenvalues.diag()).abs().max() <= 1e-9 * basis.eigenvalues.max()
    rest = lb.stiffness @ phi - basis.eigenvalues * basis.left
    assert rest.abs().max() <= 1e-11 * (basis.eigenvalues * basis.left).abs().max()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("order", "first", "second"), [(3, 1.5e-5, 1.6e-4), (5, 5e-10, 8e-9)])
def test_spectrum_of_the_sphere(order, first, second):
    """λ = l(l+1), 2l + 1 times; the worst relative error of the first 36 and 100."""
    lb = LaplaceBeltrami.from_points(Sphere().points(4070), order=order)
    values = lb.eigenbasis(100).eigenvalues
    assert worst(values[:36], sphere_eigenvalues(36)) <= first
    assert worst(values, sphere_eigenvalues(100)) <= second


@pytest.mark.usefixtures("unchecked")
def test_spectrum_of_the_torus():
    """R = 1, r = 0.5: the exact eigenvalues, of the separated equation."""
    exact = [0] + [0.997472228] * 2 + [3.17827121] * 2 + [3.90692525, 4.48915308]
    exact += [5.05486779] * 2 + [6.18060331] * 2 + [6.65205815] * 2 + [8.16247260] * 2
    exact += [10.0568008] * 2 + [12.6129542] * 2 + [12.7010054] * 2 + [14.8217076] * 2
    exact = torch.tensor([*exact, 16.1307959, 16.2068949], dtype=torch.float64)
    lb = LaplaceBeltrami.from_points(Torus(1.0, 0.5).points(4000), order=5)
    assert worst(lb.eigenbasis(len(exact)).eigenvalues, exact) < 2.3e-7


def test_cotangent_basis_solves_its_pencil():
    """C φ = −λ M φ, against a dense symmetric solver."""
    lb = LaplaceBeltrami.from_cotangent(*Sphere().mesh(600))
    root = lb.mass.sqrt().numpy()
    scaled = root[:, None] * lb.matrix.to_dense().numpy() / root
    expected = linalg.eigvalsh(-(scaled + scaled.T) / 2)[:50]
    found = lb.eigenbasis(50)
    np.testing.assert_allclose(found.eigenvalues, expected, atol=1e-9 * expected[-1])
    torch.testing.assert_close(found.left, lb.mass[:, None] * found.eigenvectors)


def three_spheres():
    points = Sphere().points(450)
    moved = [points, 2 * points + torch.tensor([5.0, 0, 0]), points - torch.tensor([4.0, 0, 0])]
    return LaplaceBeltrami.from_points(torch.cat(moved))


def test_every_component_has_a_zero_and_equal_components_equal_eigenvalues():
    """Radii 1, 2, 1: 0 three times, 1/2 three times, 3/2 five times, 2 six times."""
    lb = three_spheres()
    other, basis = copy.deepcopy(lb), lb.eigenbasis(20)
    values = torch.tensor([0.0] * 3 + [0.5] * 3 + [1.5] * 5 + [2.0] * 6).double()
    assert (basis.eigenvalues[:3] == 0).all()
    torch.testing.assert_close(basis.eigenvalues[:17], values, rtol=2e-3, atol=0)
    phi = basis.eigenvectors
    assert (phi[:, 0] == phi[0, 0]).all()
    assert (phi.T @ basis.left - torch.eye(20)).abs().max() <= 1e-10
    assert other.eigenbasis(2).eigenvalues.tolist() == [0, 0]


def test_neumann_spectrum_of_the_disk():
    """Zeros of the derivatives of Bessel functions: J_1' at 1.8411838, J_2' at 3.0542369, J_0' at 3.8317060."""
    values = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(700), order=3).eigenbasis(6).eigenvalues
    exact = torch.tensor([0, 1.8411838, 1.8411838, 3.0542369, 3.0542369, 3.8317060]).double() ** 2
    assert worst(values, exact) < 8e-6


def test_kept_sliced_stored_and_read_back():
    """One solve; a smaller k is a slice; `state_dict` holds it when asked; types follow the module."""
    lb = LaplaceBeltrami.from_points(Torus().points(500))
    basis = lb.eigenbasis(30)
    assert lb.eigenbasis(30).eigenvectors.data_ptr() == basis.eigenvectors.data_ptr()
    torch.testing.assert_close(lb.eigenbasis(10).eigenvalues, basis.eigenvalues[:10])
    assert lb.eigenbasis(10).eigenvectors.shape == (500, 10)
    assert not any("basis" in key for key in lb.state_dict())
    lb.eigenbasis(30, store=True)
    other = LaplaceBeltrami()
    other.load_state_dict(lb.state_dict())
    assert other.state_dict().keys() == lb.state_dict().keys()
    for twin in (other, copy.deepcopy(lb)):
        torch.testing.assert_close(
            twin.eigenbasis(30).eigenvectors, basis.eigenvectors, rtol=0, atol=0
        )
    assert lb.float().eigenbasis(30).eigenvectors.dtype == torch.float32
    other.load_state_dict(LaplaceBeltrami.from_points(Torus().points(300)).state_dict())
    assert other.eigenbasis(20).eigenvectors.shape == (300, 20)


def test_a_smaller_tolerance_is_that_of_the_pairs_asked_for_and_none_is_lost():
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(60))
    lb.eigenbasis(20)
    lb.modes.relative_errors[10:] = 1e-3
    rough = lb.modes.left
    lb.eigenbasis(8, tolerance=1e-6)
    assert lb.modes.left is rough
    lb.eigenbasis(12, tolerance=1e-6)
    assert lb._basis.relative_errors.max() < 1e-6
    assert lb.modes.count == rough.shape[1]


@pytest.mark.filterwarnings("error:the operator holds a basis")
def test_all_that_a_dirichlet_condition_leaves_is_solved_once(monkeypatch):
    """Also in a batch, where a layer asks for more, and out of a file."""
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(60), condition="dirichlet")
    free = int((~lb.fixed).sum())
    assert lb.eigenbasis(1000).eigenvectors.shape == (60, free)
    monkeypatch.setattr("torchlb.operator.pair_methods.pencil_eigenbasis", None)
    again = LaplaceBeltrami()
    lb.eigenbasis(1000, store=True)
    again.load_state_dict(lb.state_dict())
    for one in (again, LaplaceBeltrami.batch([lb, again])):
        assert one.eigenbasis(1000).eigenvectors.shape == (one.num_points, free)
        layer = Diffusion(1, k=free + 1).double()
        layer(torch.ones(one.num_points, 1, dtype=torch.float64), one)


def test_basis_of_a_float32_operator():
    points = Torus().points(500)
    single = LaplaceBeltrami.from_points(points.float()).eigenbasis(40)
    double = LaplaceBeltrami.from_points(points).eigenbasis(40)
    torch.testing.assert_close(
        single.eigenvalues.double(), double.eigenvalues, rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("size", [300, 500])
def test_a_basis_does_not_depend_on_the_unit(size):
    """λ scales by s⁻², Φ by s⁻¹, W by s."""
    points, scales = Torus().random_points(size), (2.0**-45, 2.0**45)
    one, *others = (LaplaceBeltrami.from_points(s * points).eigenbasis(12) for s in (1.0, *scales))
    eigenvalues, phi, left = one.eigenvalues, one.eigenvectors, one.left
    for scale, other in zip(scales, others, strict=True):
        torch.testing.assert_close(other.eigenvalues * scale**2, eigenvalues, rtol=1e-9, atol=0)
        torch.testing.assert_close(other.eigenvectors * scale, phi, rtol=0, atol=1e-6)
        torch.testing.assert_close(other.left / scale, left, rtol=0, atol=1e-6)


def test_a_small_component_has_its_eigenvalues_beside_a_large_one():
    """Two tori, one of them 7e7 times the other: a zero for each, then the large one's, whose ties fall otherwise."""
    points = Torus().points(300)
    both = torch.cat([points, 2.0**26 * (points + 8)])
    values, alone = (
        LaplaceBeltrami.from_points(x).eigenbasis(k, tolerance=1e-10).eigenvalues
        for x, k in ((both, 8), (points, 7))
    )
    values = values * 2.0**52
    assert (values[:2] == 0).all()
    torch.testing.assert_close(values[2:], alone[1:7], rtol=1e-5, atol=0)


@pytest.mark.parametrize("k", [0, -1, 2.5, None, "a", True])
def test_a_number_of_pairs_that_is_none_is_named(k):
    with pytest.raises(InputError, match=f"whole number of eigenpairs, at least 1, got {k!r}"):
        check_num_pairs(k)


@pytest.mark.parametrize("signature", [heat_kernel_signature, wave_kernel_signature])
def test_signatures_need_a_positive_eigenvalue(signature):
    """Times and energies come from λ_1, in the shape's own unit: there is no other scale."""
    lb = LaplaceBeltrami.from_points(Circle().points(40))
    with pytest.raises(EigenbasisError, match="ask for a larger k"):
        signature(lb, k=1)
    with pytest.raises(InputError, match="at least 1, got 0"):
        signature(lb, k=0)
    assert heat_kernel_signature(lb, torch.tensor([1.0]), k=1).shape == (40, 1)


@pytest.mark.usefixtures("unchecked")
def test_heat_kernel_signature_of_the_sphere():
    """Σ (2l + 1)/4π e^{−l(l+1)t}, the same at every point."""
    lb = LaplaceBeltrami.from_points(Sphere().points(2000), order=5)
    times = torch.tensor([0.2, 1.0], dtype=torch.float64)
    order = torch.arange(30).double()
    terms = (2 * order + 1) / (4 * torch.pi) * torch.exp(-order * (order + 1) * times[:, None])
    signature = heat_kernel_signature(lb, times, k=100)
    torch.testing.assert_close(signature, terms.sum(1).expand(2000, 2), rtol=5e-8, atol=0)


def test_signatures_are_those_of_the_shape_at_any_scale_and_sum_to_one():
    """∫HKS = Σ e^{−λt} and ∫WKS = 1, nearly by the weights of the points; both times ℓ² have no unit."""
    lb = LaplaceBeltrami.from_points(Torus().points(400))
    big = LaplaceBeltrami.from_points(3 * Torus().points(400))
    for signature in (heat_kernel_signature, wave_kernel_signature):
        assert signature(lb, k=50).shape == (400, 16)
        torch.testing.assert_close(9 * signature(big, k=50), signature(lb, k=50))
    torch.testing.assert_close(
        lb.mass @ wave_kernel_signature(lb, k=50), torch.ones(16).double(), rtol=0, atol=1e-2
    )
    t = torch.tensor([0.3]).double()
    trace = torch.exp(-0.3 * lb.eigenbasis(50).eigenvalues).sum()
    torch.testing.assert_close(
        lb.mass @ heat_kernel_signature(lb, t, k=50), trace[None], rtol=1e-2, atol=0
    )


def test_wavelets_are_a_tight_frame():
    """Σ_s |W_s f|²_M = |f|²_M for f in the span."""
    lb = LaplaceBeltrami.from_points(Torus().points(400))
    f = lb.eigenbasis(40).from_basis(torch.randn(40, 2).double())
    scales = torch.tensor([0.01, 0.1, 1.0]).double()
    wavelets = spectral_wavelets(lb, f, scales, k=40)
    assert wavelets.shape == (400, 4, 2)
    energy = (wavelets.flatten(1) * (lb.mass_matrix @ wavelets.flatten(1))).sum(0).view(4, 2).sum(0)
    torch.testing.assert_close(energy, (f * (lb.mass_matrix @ f)).sum(0))
    constant = spectral_wavelets(lb, torch.ones(400, 1).double(), scales, k=40)
    assert constant[:, 1:].abs().max() < 1e-10


def test_diffusion_distance_is_the_distance_of_heat_kernels():
    """d_t(x, y) = |e^{tΔ}δ_x − e^{tΔ}δ_y| in L², with all eigenvectors of a symmetric operator."""
    lb = LaplaceBeltrami.from_cotangent(*Sphere().mesh(150))
    kernel = torch.matrix_exp(0.1 * lb.matrix.to_dense()) / lb.mass  # of columns δ_y/π_y
    sources = torch.tensor([3, 70])
    difference = kernel[:, :, None] - kernel[:, None, sources]
    expected = torch.einsum("n,nxs->xs", lb.mass, difference**2).sqrt()
    torch.testing.assert_close(
        diffusion_distance(lb, sources, 0.1, k=150), expected, rtol=1e-6, atol=1e-6
    )


def test_diffusion_map_of_a_circle_is_a_circle():
    """e^{−t}(cos, sin)/√π, up to a rotation."""
    lb = LaplaceBeltrami.from_points(Circle().points(100), order=3)
    radius = diffusion_map(lb, 0.5).norm(dim=1)
    torch.testing.assert_close(
        radius, torch.full_like(radius, np.exp(-0.5) / np.sqrt(np.pi)), rtol=1e-3, atol=0
    )


def test_the_first_mode_of_a_dirichlet_shape_is_no_constant():
    """Its diffusion map has it; and distances of float32 are zero from a point to itself."""
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(300), condition="dirichlet").float()
    basis = lb.eigenbasis(20)
    scaled = basis.eigenvectors * torch.exp(-0.1 * basis.eigenvalues)
    torch.testing.assert_close(diffusion_map(lb, 0.1, dim=3), scaled[:, :3])
    distance = diffusion_distance(lb, [5, 7], 0.1, k=20)
    expected = (scaled[:, None] - scaled[[5, 7]]).norm(dim=-1)
    torch.testing.assert_close(distance, expected)
    assert distance[5, 0] == 0


def test_maps_of_a_batch_are_those_of_its_shapes():
    shapes = [
        LaplaceBeltrami.from_mesh(*UnitDisk().mesh(80), condition=condition)
        for condition in ("dirichlet", "neumann")
    ]
    alone = torch.cat([diffusion_map(lb, 0.1) for lb in shapes])
    torch.testing.assert_close(diffusion_map(LaplaceBeltrami.batch(shapes), 0.1), alone)


def test_times_are_one_or_several_and_not_negative(unchecked):
    lb = LaplaceBeltrami.from_points(Circle().points(40))
    for signature in (heat_kernel_signature, wave_kernel_signature):
        assert torch.equal(signature(lb, 0.5, k=9), signature(lb, torch.tensor([0.5]), k=9))
    f = lb.points[:, 0]
    assert spectral_wavelets(lb, f, 0.1, k=9).shape == (40, 2)
    for wrong in (-0.1, [], [[0.1]], torch.nan):
        for call in (
            lambda t=wrong: heat_kernel_signature(lb, t, k=9),
            lambda t=wrong: spectral_wavelets(lb, f, t, k=9),
            lambda t=wrong: diffusion_map(lb, t),
        ):
            with pytest.raises(InputError, match="expected one finite number or more"):
                call()
    with pytest.raises(InputError, match="numbers of points"):
        diffusion_distance(lb, [1.0], 0.1)


def test_functions_and_coefficients_without_channels(unchecked):
    lb = LaplaceBeltrami.from_points(Torus().points(100))
    for each in (lb, LaplaceBeltrami.batch([lb, lb])):
        basis, f = each.eigenbasis(9), each.points[:, 0]
        coefficients = basis.to_basis(f)
        assert torch.equal(coefficients, basis.to_basis(f[:, None])[..., 0])
        assert basis.from_basis(coefficients).shape == f.shape
    with pytest.raises(InputError, match="N = 200"):
        basis.to_basis(f[1:])
    array = spectral_wavelets(each, f.numpy(), 0.1, k=9)
    assert (array == spectral_wavelets(each, f, 0.1, k=9).numpy()).all()


def test_spectral_convolution_is_its_formula():
    lb = LaplaceBeltrami.from_points(Torus().points(300))
    layer = SpectralConv(3, 2, k=20, num_filters=2).double()
    x = torch.randn(300, 3).double()
    basis = lb.eigenbasis(20)
    u = 2 * basis.eigenvalues / (basis.eigenvalues + layer.scale) - 1
    filters = layer.weight[0] + u[:, None, None] * layer.weight[1]
    expected = basis.eigenvectors @ torch.einsum("koi,ki->ko", filters, basis.to_basis(x))
    torch.testing.assert_close(layer(x, lb), expected)
    torch.testing.assert_close(layer(x.expand(4, 300, 3), lb)[2], expected)
    layer(x, lb).sum().backward()
    assert layer.weight.grad.isfinite().all()
    with pytest.raises(ValueError, match="expected 3 channels"):
        layer(x[:, :2], lb)


@pytest.mark.parametrize("surface", [UnitDisk(), Hemisphere()], ids=["disk", "hemisphere"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dirichlet_basis(surface, dtype):
    """Without constants: squared Bessel zeros or l(l + 1), zero on the boundary, orthonormal; and heat that leaves."""
    vertices, faces = surface.mesh(500)
    lb = LaplaceBeltrami.from_mesh(vertices.to(dtype), faces, condition="dirichlet")
    basis = lb.eigenbasis(20)
    exact = surface.eigenvalues(10, condition="dirichlet")
    assert ((basis.eigenvalues[:10].double() / exact - 1).abs() < 5e-3).all()
    mask = surface.boundary_mask(vertices)
    assert (basis.eigenvectors[mask] == 0).all()
    product = basis.eigenvectors.T @ basis.left
    tolerance = 1e-10 if dtype == torch.float64 else 1e-5
    assert (product - torch.eye(20)).abs().max() < tolerance
    f = basis.eigenvectors[:, 0]
    cooled = torch.exp(-0.1 * basis.eigenvalues[0]) * f
    for method in ("spectral", "rational"):
        assert (heat_flow(lb, f, 0.1, method=method, k=20) - cooled).norm() < 2e-2 * cooled.norm()


@pytest.mark.parametrize(("order", "bound"), [(3, 1.1e-4), (5, 9e-9)])
def test_dirichlet_eigenvalues_and_the_first_mode(order, bound):
    """Squared Bessel zeros, J_0; and the weights sum to the area."""
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(700), order=order, condition="dirichlet")
    basis = lb.eigenbasis(10)
    exact = UnitDisk().eigenvalues(10, condition="dirichlet")
    assert (basis.eigenvalues / exact - 1).abs().max() < bound
    assert float(lb.mass.sum()) == pytest.approx(np.pi, rel=1e-7)
    mode = torch.special.bessel_j0(5.783186**0.5 * lb.points.norm(dim=1))
    mode /= (mode @ lb.mass_matrix @ mode).sqrt()
    found = basis.eigenvectors[:, 0]
    assert (found.abs() - mode).abs().max() < 1.2e-5


def test_dirichlet_beside_a_closed_component():
    """One zero, of the sphere; the disk's own λ_1 = 5.783 among the sphere's 2, 2, 2, 6."""
    vertices, faces = UnitDisk().mesh(300)
    ball, shell = Sphere().mesh(300)
    both = torch.cat([vertices, ball + 5])
    lb = LaplaceBeltrami.from_mesh(both, torch.cat([faces, shell + 300]), condition="dirichlet")
    basis = lb.eigenbasis(5)
    assert basis.eigenvalues[0] == 0
    expected = torch.tensor([2.0, 2, 2, 5.783]).double()
    assert ((basis.eigenvalues[1:] / expected - 1).abs() < 5e-3).all()
    assert len(basis.eigenvectors[:, 0].unique()) == 2


def test_wave_kernel_signatures_of_a_batch_leave_out_padding():
    """A Dirichlet condition leaves fewer pairs than points."""
    disk = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(150), condition="dirichlet")
    batch = LaplaceBeltrami.batch([disk, LaplaceBeltrami.from_mesh(*Sphere().mesh(300))])
    found = wave_kernel_signature(batch, k=128)[:150]
    torch.testing.assert_close(found, wave_kernel_signature(disk, k=128), rtol=1e-6, atol=1e-6)
