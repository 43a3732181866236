"""Pictures: what is drawn is what was given, in the order and the colours that the documentation says."""

import builtins
import sys

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from torchlb import LaplaceBeltrami
from torchlb.plot import (
    plot_convergence,
    plot_orders,
    plot_points,
    plot_surface,
    plot_vectors,
)
from torchlb.plot.comparison import draw_comparison, plot_spectrum
from torchlb.plot.figures import ORDER_COLORS
from torchlb.surfaces import Sphere, smooth_function

plt = pytest.importorskip("matplotlib.pyplot")
from matplotlib.colors import to_rgb  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

WRONG = (ValueError, TypeCheckError)  # the suite checks the shapes in the signatures, too


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def sphere():
    return Sphere().mesh(200)


def colorbar_limits(ax):
    """Limits of the colours, from the colour bar that stands beside the axes."""
    (bar,) = [other for other in ax.figure.axes if other is not ax]
    return bar.get_ylim()


def test_surface_draws_every_triangle_once_from_back_to_front(sphere):
    vertices, faces = sphere
    ax = plot_surface(vertices, faces, smooth_function(vertices), view=(90.0, -90.0), title="f")
    (triangles,) = ax.collections
    drawn = np.array([path.vertices[:3] for path in triangles.get_paths()])
    assert len(drawn) == len(faces)
    assert ax.get_title() == "f"
    assert ax.get_aspect() == 1
    depth = vertices[faces][..., 2].mean(1).sort()
    expected = vertices[faces[depth.indices]][:, :, :2].numpy()  # seen from above: x right, y up
    assert np.allclose(drawn - drawn[0, 0], expected - expected[0, 0], atol=1e-12)


def test_several_views_do_not_overlap(sphere):
    vertices, faces = sphere
    ax = plot_surface(vertices, faces, vertices[:, 0], view=[(0.0, 0.0), (0.0, 180.0)])
    above, below = [
        np.concatenate([path.vertices for path in views.get_paths()]) for views in ax.collections
    ]
    assert below[:, 1].max() < above[:, 1].min()


@pytest.mark.parametrize("draw", ["surface", "cloud"])
def test_colors_are_around_zero_for_both_signs_and_ignore_outliers(sphere, draw):
    vertices, faces = sphere
    values = vertices[:, 0].clone()
    values[0] = 1e6
    shape = (vertices, faces) if draw == "surface" else (vertices,)
    ax = {"surface": plot_surface, "cloud": plot_points}[draw](*shape, values)
    low, high = colorbar_limits(ax)
    assert low == -high
    assert 0.8 < high < 1.2


def test_colors_of_one_sign_start_at_the_least_value_and_a_constant_has_a_range(sphere):
    vertices, faces = sphere
    low, high = colorbar_limits(plot_surface(vertices, faces, 5 + vertices[:, 0]))
    assert 4 <= low < 4.2
    assert 5.8 < high <= 6
    low, high = colorbar_limits(plot_surface(vertices, faces, torch.full((200,), 3.0)))
    assert low < 3 < high


@pytest.mark.parametrize("draw", ["surface", "cloud"])
def test_limits_are_those_of_the_colors(sphere, draw):
    vertices, faces = sphere
    shape = (vertices, faces) if draw == "surface" else (vertices,)
    plot = {"surface": plot_surface, "cloud": plot_points}[draw]
    assert colorbar_limits(plot(*shape, vertices[:, 0], limits=(-3.0, 0.5))) == (-3.0, 0.5)


def test_isolines_of_a_linear_function_lie_on_its_level_and_cross_every_triangle_there(sphere):
    vertices, faces = sphere
    levels = [-0.5, 0.123]
    ax = plot_surface(vertices, faces, vertices[:, 0], levels=levels, view=(90.0, -90.0))
    (collection,) = ax.collections
    drawn = [path.vertices for path in collection.get_paths()]
    segments = np.array([path[:2] for path in drawn if len(path) == 3])  # there and back
    x = vertices[faces][..., 0]
    crossed = [int(((x > c).any(1) & ~(x > c).all(1)).sum()) for c in levels]
    assert (len(segments), len(drawn)) == (sum(crossed), sum(crossed) + len(faces))
    middle = (vertices[:, 0].amax() + vertices[:, 0].amin()) / 2  # is at 0 in the picture
    centred = (
        segments[..., 0] + vertices[:, 0].mean().item() + (middle - vertices[:, 0].mean()).item()
    )
    off = np.abs(centred[..., None] - levels).min(axis=-1)
    assert off.max() < 1e-12


def test_isolines_leave_out_triangles_with_nan(sphere):
    vertices, faces = sphere
    values = vertices[:, 0].clone()
    values[values > -0.9] = torch.nan
    ax = plot_surface(vertices, faces, values, levels=[0.0])
    assert len(ax.collections[0].get_paths()) == len(faces)


def arrows_in(ax):
    """Tails (A, 2) and arrows (A, 2) of the picture."""
    (quiver,) = [c for c in ax.collections if hasattr(c, "U")]
    return np.asarray(quiver.get_offsets()), np.stack([quiver.U, quiver.V], axis=1)


def test_arrows_of_the_plane_are_the_vectors_in_one_scale_at_the_points_themselves():
    points = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    vectors = torch.stack([points[:, 1], -points[:, 0]], dim=1)
    ax = plot_vectors(points, None, vectors, count=50)
    tails, arrows = arrows_in(ax)
    assert len(tails) == 50
    middle = torch.stack([(points[:, 0].amax() + points[:, 0].amin()) / 2, points[:, 1].amax()])
    places = tails + middle.numpy()  # the picture hangs from y = 0
    expected = np.stack([places[:, 1], -places[:, 0]], axis=1)
    scale = (arrows * expected).sum() / (expected**2).sum()
    assert scale > 0
    assert np.allclose(arrows, scale * expected, atol=1e-12)
    assert colorbar_limits(ax)[0] > 0  # of the lengths


def test_a_surface_hides_the_arrows_behind_it(sphere):
    vertices, faces = sphere
    east = torch.stack([-vertices[:, 1], vertices[:, 0], 0 * vertices[:, 2]], dim=1)
    ax = plot_vectors(vertices, faces, east, vertices[:, 2], count=200, view=(90.0, -90.0))
    tails, _ = arrows_in(ax)
    above = int((vertices[:, 2] > 0.1).sum())
    assert above <= len(tails) <= int((vertices[:, 2] > -0.25).sum())  # the spacing is 0.25
    assert colorbar_limits(ax)[0] < 0  # of the scalar


def test_arrows_are_evenly_spread_and_none_stands_for_zero_or_nan(sphere):
    vertices, _ = sphere
    vectors = torch.ones_like(vertices)
    vectors[:50] = 0
    vectors[50:100] = torch.nan
    tails, _ = arrows_in(plot_vectors(vertices, None, vectors, count=200))
    assert len(tails) == 100
    assert len(arrows_in(plot_vectors(vertices, None, 0 * vertices + 1, count=30))[0]) == 30
    empty = plot_vectors(vertices, None, torch.zeros_like(vertices))
    assert not [c for c in empty.collections if hasattr(c, "U")]


def test_nan_is_grey(sphere):
    vertices, _ = sphere
    ax = plot_points(vertices, torch.full((200,), torch.nan))
    colors = ax.collections[0].get_facecolors()
    assert np.ptp(colors[:, :3], axis=1).max() < 1e-12


def test_arrays_and_tensors_that_require_gradients_are_taken_too(sphere):
    vertices, faces = sphere
    values = smooth_function(vertices)
    plot_surface(vertices.numpy(), faces.numpy(), values.numpy())
    plot_surface(vertices.requires_grad_(), faces, values.float())
    vertices.requires_grad_(False)


def test_points_of_the_plane_keep_their_coordinates_apart_from_a_shift():
    points = torch.rand(50, 2)
    ax = plot_points(points, points[:, 0], size=4.0)
    drawn = np.asarray(ax.collections[0].get_offsets())
    assert np.allclose(np.ptp(drawn, axis=0), np.ptp(points.numpy(), axis=0), atol=1e-6)


def test_points_of_the_plane_are_all_equally_near():
    points = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    colors = plot_points(points, torch.ones(50)).collections[0].get_facecolors()
    assert np.ptp(colors, axis=0).max() < 1e-6


def test_order_map_counts_points_and_shows_the_lowest_order_of_a_triangle():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    order = torch.tensor([0, 3, 3, 9])
    ax = plot_orders(vertices, faces, order)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == ["order 9: 1", "order 3: 2", "low order: 1"]
    hues = ax.collections[0].get_facecolors()[:, :3]  # shaded alike, as both lie in a plane
    light, dark = (np.array(to_rgb(ORDER_COLORS[p])) for p in (0, 3))
    shade = hues.max() / light.max()
    assert {tuple(hue.round(6)) for hue in hues} == {
        tuple((shade * color).round(6)) for color in (light, dark)
    }
    cloud = plot_orders(vertices, None, order)
    assert [text.get_text() for text in cloud.get_legend().get_texts()] == texts


def test_the_colors_of_the_orders_grow_darker():
    luminance = np.array([to_rgb(color) for color in ORDER_COLORS]) @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(luminance) < -0.05).all()


def test_axes_that_are_given_leave_pyplot_alone(sphere, tmp_path, monkeypatch):
    """No figure is registered, and the backend is not touched: importing pyplot would choose one."""
    vertices, faces = sphere
    lb = LaplaceBeltrami.from_cotangent(vertices, faces)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    figure = Figure()
    assert plot_surface(vertices, faces, vertices[:, 0], ax=(ax := figure.subplots())) is ax
    draw_comparison(lb, faces, {"a": lb.eigenbasis(4).eigenvalues}, tmp_path / "a.png", "title")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_spectrum_shows_how_far_the_others_are_in_per_cent_and_whole_numbers():
    values = {"a": torch.tensor([0.0, 2.0, 4.0]), "b": torch.tensor([0.0, 2.1, 4.0])}
    ax = plot_spectrum(values, (figure := Figure()).subplots())
    [difference] = figure.axes[1].lines
    assert np.allclose(difference.get_ydata(), [np.nan, 5.0, 0.0], equal_nan=True, atol=1e-4)
    assert all(tick == round(tick) for tick in ax.get_xticks())


@pytest.mark.parametrize(("dim", "expected"), [(2, "4.0"), (1, "2.0")])
def test_measured_order_is_the_slope_against_the_spacing(dim, expected):
    sizes = [100, 400, 1600, 6400]
    errors = {"squared": [n**-2.0 for n in sizes], "exact": [0.0] * 4}
    ax = plot_convergence(sizes, errors, dim=dim)
    squared, exact = [text.get_text() for text in ax.get_legend().get_texts()]
    assert squared == f"squared:  $h^{{{expected}}}$"
    assert exact == "exact"
    assert ax.get_xscale() == ax.get_yscale() == "log"


def test_reference_lines_have_whole_slopes_and_stay_inside():
    sizes = [100, 200, 400]
    ax = plot_convergence(sizes, {"p": [n**-1.9 for n in sizes], "q": [n**-0.6 for n in sizes]})
    fan = [line for line in ax.lines if line.get_linestyle() == "--"]
    powers = []
    for line in fan:
        x, y = np.log(line.get_xdata()), np.log(line.get_ydata())
        powers.append(-2 * (y[1] - y[0]) / (x[1] - x[0]))
        assert ax.get_ylim()[0] <= line.get_ydata()[1] * (1 + 1e-9)
    assert np.allclose(powers, [1, 4])
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    assert all(left < x < right and low < y < high for x, y in (name.xy for name in ax.texts))


def test_what_does_not_fit_is_refused(sphere):
    vertices, faces = sphere
    values = vertices[:, 0]
    with pytest.raises(WRONG):
        plot_surface(vertices, faces, values[:-1])
    with pytest.raises(WRONG):
        plot_surface(vertices[:, :2], faces, values)
    with pytest.raises(ValueError, match=r"indices outside 0 … 199: face 0 is \[0, 1, 200\]"):
        plot_surface(vertices, torch.tensor([[0, 1, 200]]), values)
    with pytest.raises(ValueError, match=r"choose the coordinates to draw"):
        plot_points(torch.rand(9, 4), torch.rand(9))
    with pytest.raises(ValueError, match=r"choose the coordinates to draw"):
        plot_vectors(torch.rand(9, 4), None, torch.rand(9, 4))
    with pytest.raises(WRONG):
        plot_vectors(vertices, faces, torch.rand(199, 3))
    with pytest.raises(WRONG):
        plot_vectors(vertices, faces, vertices, values[:-1])
    with pytest.raises(ValueError, match=r"expected 2, one for a size, got 1"):
        plot_convergence([10, 20], {"p": [0.1]})
    with pytest.raises(ValueError, match=r"expected some that are positive"):
        plot_convergence([10, 20], {"p": [0.0, 0.0]})


def test_without_matplotlib_the_error_says_what_to_install(sphere, monkeypatch):
    vertices, faces = sphere
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r'pip install "\.\[plot\]"'):
        plot_surface(vertices, faces, vertices[:, 0])
