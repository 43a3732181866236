"""trimesh in and out, and files read in their own order."""

import shutil

import numpy as np
import pytest
import torch
import trimesh

from torchlb import LaplaceBeltrami
from torchlb.interop.trimesh import from_trimesh, to_trimesh
from torchlb.io.files import read_shape
from torchlb.surfaces import Sphere


@pytest.fixture(scope="module", autouse=True)
def shape():
    """Made when the first test runs, not when tests are collected."""
    global VERTICES, FACES, MESH
    VERTICES, FACES = Sphere().mesh(200)
    MESH = trimesh.Trimesh(VERTICES.numpy(), FACES.numpy(), process=False)


def test_the_operator_of_a_mesh_a_cloud_and_a_scene():
    mesh = LaplaceBeltrami.from_mesh(VERTICES, FACES, order=2)
    assert torch.equal(from_trimesh(MESH, order=2).stencil.values, mesh.stencil.values)
    cloud = from_trimesh(trimesh.PointCloud(VERTICES.numpy()), order=2)
    assert torch.equal(
        cloud.stencil.values, LaplaceBeltrami.from_points(VERTICES, order=2).stencil.values
    )
    cotangent = LaplaceBeltrami.from_cotangent(VERTICES, FACES)
    assert torch.equal(
        from_trimesh(MESH, operator="cotangent").stencil.values, cotangent.stencil.values
    )
    scene = trimesh.Scene([MESH, MESH.copy().apply_translation([5, 0, 0])])
    both = from_trimesh(scene, order=2)
    assert both.num_points == 400
    assert both.eigenbasis(3).eigenvalues[:2].tolist() == [0, 0]  # two components


def test_there_and_back():
    lb = from_trimesh(MESH, order=2)
    back = to_trimesh(lb, FACES, curvature=lb.mean_curvature_normal(), mass=lb.mass.numpy())
    assert np.array_equal(back.vertices, MESH.vertices)
    assert np.array_equal(back.faces, MESH.faces)
    assert torch.equal(from_trimesh(back, order=2).stencil.values[0], lb.stencil.values[0])
    assert np.array_equal(back.vertex_attributes["curvature"], lb.mean_curvature_normal().numpy())
    assert back.vertex_attributes["mass"].sum() == pytest.approx(float(lb.mass.sum()))
    assert np.array_equal(to_trimesh(lb).faces, MESH.faces)
    points = np.random.default_rng(0).random((200, 3))
    lb = LaplaceBeltrami.from_points(points, dim=3, order=1)
    cloud = to_trimesh(lb, mass=lb.mass)
    assert isinstance(cloud, trimesh.PointCloud)
    assert np.array_equal(cloud.vertices, points)
    assert cloud.metadata["mass"].shape == (200,)


def test_errors_of_conversion(unchecked):
    lb = from_trimesh(MESH, order=1)
    with pytest.raises(ValueError, match="mass: expected 200 rows"):
        to_trimesh(lb, FACES, mass=lb.mass[:5])
    with pytest.raises(ValueError, match="points in R³"):
        to_trimesh(LaplaceBeltrami())
    with pytest.raises(ValueError, match="Trimesh, PointCloud or Scene"):
        from_trimesh([1, 2])
    with pytest.raises(ValueError, match="needs faces"):
        from_trimesh(trimesh.PointCloud(VERTICES.numpy()), operator="cotangent")
    with pytest.raises(ValueError, match="operator: expected one of"):
        from_trimesh(MESH, operator="graph")


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".off", ".ply", ".stl"])
def test_meshes_keep_their_order(suffix, tmp_path):
    path = tmp_path / f"mesh{suffix}"
    MESH.export(path)
    vertices, faces = read_shape(path)
    assert (vertices.dtype, faces.dtype) == (torch.float64, torch.int64)
    if suffix == ".stl":  # which has loose triangles; they are merged
        assert (tuple(vertices.shape), tuple(faces.shape)) == (VERTICES.shape, FACES.shape)
        assert trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False).is_watertight
    else:
        assert torch.allclose(vertices, VERTICES, atol=1e-6)
        assert torch.equal(faces, FACES)


def test_corners_of_an_obj_are_not_split_by_their_texture(tmp_path):
    """Four vertices, of which two have different texture coordinates in different faces, stay four."""
    lines = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1"]
    lines += [f"vt {i / 5} 0" for i in range(6)] + ["f 1/1 2/2 3/3", "f 1/4 2/5 4/6"]
    (tmp_path / "square.obj").write_text("\n".join(lines))
    vertices, faces = read_shape(tmp_path / "square.obj")
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert faces.tolist() == [[0, 1, 2], [0, 1, 3]]


def test_clouds(tmp_path):
    np.save(tmp_path / "a.npy", VERTICES.numpy())
    np.savez(tmp_path / "b.npz", points=VERTICES.numpy())
    np.savetxt(tmp_path / "c.xyz", VERTICES.numpy())
    trimesh.PointCloud(VERTICES.numpy()).export(tmp_path / "d.ply")
    for name in ("a.npy", "b.npz"):
        shutil.copy(tmp_path / name, tmp_path / name.upper())
    for name in ("a.npy", "A.NPY", "b.npz", "B.NPZ", "c.xyz", "d.ply"):
        vertices, faces = read_shape(tmp_path / name)
        assert faces is None
        assert torch.allclose(vertices, VERTICES, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", b"ply\n"),
        ("b.obj", b"nothing"),
        ("c.stl", b""),
        ("d.npy", b"\x93NUMPY"),
        ("e.npz", b"PK"),
        ("f.xyz", b"a b c"),
        ("g.jpg", b"no shape"),
    ],
)
def test_a_file_that_is_no_shape_is_named(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"{name}: not a mesh or cloud"):
        read_shape(tmp_path / name)


def test_arrays_that_are_no_shape_are_named(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((2, 5, 3)))
    np.savez(tmp_path / "b.npz", labels=np.zeros(3))
    with pytest.raises(ValueError, match=r"a\.npy.*shape \(2, 5, 3\), expected"):
        read_shape(tmp_path / "a.npy")
    with pytest.raises(ValueError, match=r"b\.npz.*neither vertices nor points among \['labels'\]"):
        read_shape(tmp_path / "b.npz")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_shape(tmp_path / "missing.ply")
