"""Every example runs, writes its pictures, and says what is wrong with a file that it cannot use."""

import importlib.util
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torchlb.surfaces import Ellipsoid

pytest.importorskip("matplotlib")
EXAMPLES = Path(__file__).parents[1] / "examples"
PNG = b"\x89PNG"
sys.path.append(str(EXAMPLES))  # as python does for a script
pytestmark = pytest.mark.usefixtures("unchecked")


def load(name):
    """The module of an example."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def demo():
    return load("demo")


@pytest.fixture(scope="module")
def ellipsoid():
    vertices, faces = Ellipsoid().mesh(250)
    return trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)


def pictures_in(folder):
    names = sorted(path.name for path in folder.iterdir())
    assert all(path.read_bytes().startswith(PNG) for path in folder.iterdir())
    return names


def test_demo_prints_the_report_of_a_mesh_and_draws_it(demo, ellipsoid, tmp_path, capsys):
    ellipsoid.export(tmp_path / "ellipsoid.ply")
    out = tmp_path / "new" / "folder"
    assert demo.main(["--mesh", str(tmp_path / "ellipsoid.ply"), "--output", str(out)]) == 0
    printed = capsys.readouterr().out
    assert pictures_in(out) == ["surface.png"]
    for part in (
        "ellipsoid.ply\nLaplaceBeltrami(250 points",
        "built in",
        "250 points, order 3 requested",
        "weak pair: 100.00 % of the edges curved",
        str(out / "surface.png"),
    ):
        assert part in printed, part


def test_demo_takes_a_cloud_for_a_file_without_faces(demo, ellipsoid, tmp_path, capsys):
    trimesh.PointCloud(ellipsoid.vertices).export(tmp_path / "cloud.ply")
    out = tmp_path / "out"
    assert (
        demo.main(["--mesh", str(tmp_path / "cloud.ply"), "--output", str(out), "--order", "2"])
        == 0
    )
    printed = capsys.readouterr().out
    assert "has no faces: it is taken for a cloud" in printed
    assert "from points, order=2" in printed
    assert pictures_in(out) == ["surface.png"]


def test_demo_leaves_out_vertices_without_faces_and_says_so(demo, ellipsoid, tmp_path, capsys):
    vertices = np.concatenate([ellipsoid.vertices, [[9.0, 9, 9], [8, 8, 8]]])
    trimesh.Trimesh(vertices, ellipsoid.faces, process=False).export(tmp_path / "more.ply")
    read, faces, name, _ = demo.read(tmp_path / "more.ply")
    assert (len(read), len(faces), name) == (250, len(ellipsoid.faces), "more.ply")
    assert "2 vertices share a place or belong to no face" in capsys.readouterr().out


def test_demo_merges_the_corners_of_loose_triangles(demo, ellipsoid, tmp_path, capsys):
    soup = trimesh.Trimesh(ellipsoid.triangles.reshape(-1, 3), process=False)
    soup.faces = np.arange(len(soup.vertices)).reshape(-1, 3)
    soup.export(tmp_path / "soup.ply")
    vertices, faces, _, _ = demo.read(tmp_path / "soup.ply")
    assert (len(vertices), len(faces)) == (250, len(ellipsoid.faces))
    assert "share a place or belong to no face" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.ply", None, "no such file"),
        ("prose.txt", "no mesh", "not a mesh or cloud"),
        ("prose.ply", "no mesh", "not a mesh or cloud"),
        ("prose.obj", "no mesh", "not a mesh or cloud"),
        ("few.xyz", "0 0 0\n1 0 0\n0 1 0\n", "3 points are fewer than the 4"),
    ],
)
def test_demo_ends_with_1_and_a_message_for_a_file_that_is_no_use(
    demo, tmp_path, capsys, name, content, message
):
    if content is not None:
        (tmp_path / name).write_text(content)
    out = tmp_path / "out"
    assert demo.main(["--mesh", str(tmp_path / name), "--output", str(out)]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert not out.exists()


def test_the_cortex_is_a_closed_surface():
    pytest.importorskip("nilearn")
    vertices, faces, name, unit = load("_common").cortex("pial_left")
    assert (tuple(vertices.shape), tuple(faces.shape)) == ((10242, 3), (20480, 3))
    assert (name, unit) == ("fsaverage5 (pial_left)", "mm")
    assert trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False).is_watertight


def test_an_analytic_surface_stands_in_for_the_cortex_where_nilearn_is_missing(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "nilearn.datasets", None)
    vertices, _, name, unit = load("_common").cortex()
    assert (len(vertices), name, unit) == (4000, "star-shaped surface", "")
    assert "nilearn is not installed" in capsys.readouterr().out


SMALL = ["--decimate", "150", "--k", "12", "--width", "8"]


def test_segmentation_trains_resumes_where_it_stopped_and_draws(tmp_path, capsys):
    example = load("train_segmentation")
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for i in range(3):  # two to train with, one to test
        vertices, faces = Ellipsoid((1.0, 0.6 + 0.1 * i, 1.5)).mesh(150)
        labels = (2 * vertices[:, 2].abs()).long().clamp_max(2)
        np.savez(tmp_path / f"{i}.npz", vertices=vertices, faces=faces, labels=labels)
    chosen = [*SMALL, "--data", str(tmp_path), "--test", "clouds", "--output"]
    accuracy = example.main([*chosen, str(whole), "--epochs", "2"])
    shutil.copytree(whole / "operators", parts / "operators")
    example.main([*chosen, str(parts), "--epochs", "1"])
    assert example.main([*chosen, str(parts), "--epochs", "2", "--resume"]) == accuracy
    assert f"accuracy on 1 test clouds: {accuracy:.3f}" in capsys.readouterr().out
    expected, resumed = (torch.load(folder / "checkpoint.pt") for folder in (whole, parts))
    assert expected["epoch"] == resumed["epoch"] == 2
    for name, value in expected["net"].items():
        assert torch.equal(value, resumed["net"][name]), name
    assert (parts / "labels.png").read_bytes().startswith(PNG)
    assert not list(parts.glob("*.new"))


def test_segmentation_brings_shapes_of_its_own_and_takes_the_cotangent_operator(tmp_path, capsys):
    chosen = ["--operator", "cotangent", "--method", "spectral", "--epochs", "1"]
    load("train_segmentation").main([*SMALL, *chosen, "--output", str(tmp_path)])
    assert "accuracy on 4 test meshes: " in capsys.readouterr().out
    assert (tmp_path / "labels.png").read_bytes().startswith(PNG)


def test_segmentation_reads_one_shape_a_file_or_a_stack_and_drops_loose_vertices(tmp_path):
    example = load("train_segmentation")
    vertices, faces = (t.numpy() for t in Ellipsoid().mesh(250))
    loose = np.concatenate([vertices, [[9.0, 9, 9]]])
    labels = np.append(np.arange(250) % 3, -1)
    stack = np.stack([loose, 2 * loose])
    np.savez(tmp_path / "a.npz", vertices=loose.astype("f4"), faces=faces, labels=labels)
    np.savez(tmp_path / "b.npz", vertices=stack, faces=faces.astype("i4"), labels=labels)
    shapes = example.read(tmp_path)
    assert len(shapes) == 3
    for points, corners, found in shapes:
        assert (tuple(points.shape), tuple(corners.shape)) == ((250, 3), faces.shape)
        assert found.tolist() == labels[:250].tolist()
        assert points.norm(dim=1).max().item() == pytest.approx(1)
        assert points.mean(0).abs().max() < 1e-6


GALLERY = {  # options of a small run, and what it prints
    "first_laplacian": (["--points", "300"], "cloud: relative error of Δf "),
    "mesh_independent_modes": (["--points", "100", "--k", "8"], "     394  torchlb "),
    "match_bodies": (["--points", "150", "--k", "30"], "refined, torchlb: half of the points "),
    "cotangent_vs_orders": (["--points", "960"], "   cotangent     order 1     order 3"),
    "cortical_eigenmodes": (["--points", "400", "--k", "10"], "     torchlb        LaPy   cosine"),
    "heterogeneous_modes": (
        ["--points", "400", "--k", "10"],
        "heat later, κ = 9 up and down: ",
    ),
    "diffusion_distances": (["--points", "400", "--k", "40"], "on a sphere of 400 points: 0.3%"),
    "signatures_matching": (["--points", "300", "--k", "40"], "wave kernel signature: "),
    "wavelets": (["--points", "400", "--k", "40"], "low-pass: "),
    "learn_conductivity": (
        ["--points", "150", "--level", "2", "--steps", "5"],
        "           torchlb ",
    ),
    "find_heat_source": (["--points", "150", "--level", "2", "--steps", "5"], "         torchlb "),
    "mean_curvature_flow": (
        ["--points", "300", "--steps", "4", "--sphere", "60", "--times", "1"],
        "it falls in 20 of 20 steps",
    ),
    "growing_pattern": (
        ["--points", "100", "--steps", "8", "--sphere", "100"],
        "20 steps: a harmonic that decays to 0.252 is off by 1.3",
    ),
    "largest_eigenvalue": (
        ["--points", "150", "--steps", "8", "--degree", "3"],
        "evaluation 9  0.99",
    ),
    "curvature_directions": (
        ["--points", "400", "--torus", "400", "--k", "8"],
        "torus, κ = 9 along parallels: 7 eigenvalues off by 2.",
    ),
    "scan_curvature": (["--points", "500"], "libigl, radius 5, as scanned: 0.2"),
    "transport_over_scan": (["--points", "150"], "transport by torchlb, 594 vertices: 1."),
    "hodge_parts": (["--level", "2"], "798 vertices, the first eigenvalues of Hodge's Laplacian:"),
    "isospectralization": (
        ["--points", "150", "--steps", "3", "--k", "8"],
        "0 of 296 triangles flipped",
    ),
    "vector_fields": (
        ["--points", "300", "--sphere", "200", "--torus", "300"],
        "torus: harmonic part of norm 4.1",
    ),
    "diffusion_maps": (["--points", "400"], "correlation of coordinate 2 with cos(π width): 0.99"),
    "train_pyg": (["--points", "150", "--epochs", "2"], "right on a shape never seen: "),
    "spectral_gallery": (["--points", "400", "--k", "40"], "Eigenbasis(40 pairs of 400 points"),
}
NEEDS = {
    "cortical_eigenmodes": "lapy",
    "train_pyg": "torch_geometric",
    "transport_over_scan": "potpourri3d",
}


@pytest.mark.parametrize("name", GALLERY)
def test_an_example_of_the_gallery_prints_its_result_and_writes_one_picture(name, tmp_path, capsys):
    pytest.importorskip(NEEDS.get(name, "torchlb"))
    arguments, printed = GALLERY[name]
    load(name).main(["--output", str(tmp_path), *arguments])
    assert printed in capsys.readouterr().out
    assert pictures_in(tmp_path) == [f"{name}.png"]


def test_bodies_to_match_are_read_from_a_file(tmp_path):
    vertices, faces = (t.numpy() for t in Ellipsoid().mesh(250))
    stack = np.stack([vertices, 2 * vertices, 3 * vertices]).astype("f4")
    np.savez(tmp_path / "a.npz", vertices=stack, faces=faces.astype("i4"))
    pair, triangles, _ = load("match_bodies").read(tmp_path / "a.npz", 2, 0)
    assert np.allclose(pair, stack[[2, 0]])
    assert (triangles.numpy() == faces).all()


@pytest.mark.parametrize("name", NEEDS)
def test_an_example_says_what_to_install(name, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, NEEDS[name], None)
    for module in [m for m in sys.modules if m.startswith(f"{NEEDS[name]}.")]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SystemExit, match="pip install"):
        load(name).main(["--output", str(tmp_path)])


def test_every_example_of_the_gallery_is_run_here_short_and_shown_in_the_docs():
    shown = (EXAMPLES.parent / "docs" / "gallery.md").read_text("utf-8")
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    assert names == {*GALLERY, "_common", "demo", "train_ddp", "train_segmentation"}
    for name in GALLERY:
        lines = (EXAMPLES / f"{name}.py").read_text("utf-8").splitlines()
        assert len(lines) <= 80, name
        picture = EXAMPLES.parent / "docs" / "gallery" / f"{name}.png"
        assert picture.stat().st_size <= 120_000, name
        assert f"(gallery/{name}.png)" in shown, name
