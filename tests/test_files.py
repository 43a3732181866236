"""Files of other libraries: what they write is read, what is written they read, with the data of the points."""

import sys
from importlib.util import find_spec

import lapy
import meshio
import nibabel
import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from torchlb import InputError, read_point_data, read_shape, write_shape
from torchlb.io.files import may_be_shape
from torchlb.surfaces import Sphere

VERTICES, FACES = Sphere().mesh(100)
V, F = VERTICES.numpy(), FACES.numpy()
EPS = 1e-7  # GIFTI and FreeSurfer are in single precision
by_vtk = pytest.mark.skipif(find_spec("pyvista") is None, reason="pyvista reads VTK's files")


def same(path, eps=0.0, vertices=VERTICES, faces=FACES):
    found = read_shape(path)
    assert (found[0].dtype, found[1].dtype) == (torch.float64, torch.int64)
    assert (found[0] - vertices).abs().max() <= eps
    return torch.equal(found[1], faces)


def test_surfaces_of_freesurfer(tmp_path):
    """Whatever their ending; and their maps, which are no surfaces."""
    for name in ("lh.pial", "rh.white.avg"):
        nibabel.freesurfer.write_geometry(tmp_path / name, V, F)
        assert same(tmp_path / name, EPS)
        assert may_be_shape(tmp_path / name)
    nibabel.freesurfer.write_morph_data(tmp_path / "lh.thickness", V[:, 0])
    found = read_point_data(tmp_path / "lh.thickness")
    assert list(found) == ["thickness"]
    np.testing.assert_allclose(found["thickness"].numpy(), V[:, 0], atol=EPS)
    assert not may_be_shape(tmp_path / "lh.thickness")
    with pytest.raises(InputError, match=r"no.* vertices .*read_point_data"):
        read_shape(tmp_path / "lh.thickness")


def test_labels_of_freesurfer(tmp_path):
    """Numbers of the rows of the table of colours; −1 where there is none."""
    labels, names = np.arange(100) % 4 - 1, ["bank", "insula", "pole"]
    colours = np.array([[25, 100, 40, 0, 0], [125, 100, 160, 0, 0], [100, 25, 0, 0, 0]])
    nibabel.freesurfer.write_annot(tmp_path / "lh.aparc.annot", labels, colours, names)
    found = read_point_data(tmp_path / "lh.aparc.annot")
    assert {name: values.tolist() for name, values in found.items()} == {"aparc": labels.tolist()}
    with pytest.raises(InputError, match="read_point_data"):
        read_shape(tmp_path / "lh.aparc.annot")


@pytest.mark.parametrize("name", ["lh.thickness.mgh", "lh.thickness.mgz"])
def test_overlays_of_freesurfer(name, tmp_path):
    """A map, (N, 1, 1), and a series of them, (N, 1, 1, T); volumes are no data of points."""
    values = V.astype(np.float32)
    for data, exact in ((values[:, :1, None], values[:, 0]), (values[:, None, None], values)):
        nibabel.MGHImage(data, np.eye(4)).to_filename(tmp_path / name)
        found = read_point_data(tmp_path / name)
        assert list(found) == ["thickness"]
        assert np.array_equal(found["thickness"].numpy(), exact)
    nibabel.MGHImage(values.reshape(5, 20, 3), np.eye(4)).to_filename(tmp_path / name)
    with pytest.raises(InputError, match=r"a volume of shape \(5, 20, 3\)"):
        read_point_data(tmp_path / name)


def test_gifti_there_and_back(tmp_path):
    data = {"f": VERTICES[:, 0], "labels": V[:, 2] > 0, "modes": VERTICES[:, :2]}
    write_shape(tmp_path / "a.surf.gii", VERTICES, FACES, **data)
    assert same(tmp_path / "a.surf.gii", EPS)
    image = nibabel.load(tmp_path / "a.surf.gii")
    np.testing.assert_allclose(image.agg_data("pointset"), V, atol=EPS)
    assert np.array_equal(image.agg_data("triangle"), F)
    found = read_point_data(tmp_path / "a.surf.gii")
    assert list(found) == ["f", "labels", "modes_0", "modes_1"]
    torch.testing.assert_close(found["modes_1"], VERTICES[:, 1].float())
    assert found["labels"].tolist() == (VERTICES[:, 2] > 0).int().tolist()
    write_shape(tmp_path / "a.func.gii", VERTICES, FACES, f=VERTICES[:, 0])
    (array,) = nibabel.load(tmp_path / "a.func.gii").darrays
    np.testing.assert_allclose(array.data, V[:, 0], atol=EPS)


def test_maps_of_a_gifti_without_names_are_all_kept(tmp_path):
    arrays = [nibabel.gifti.GiftiDataArray(V[:, c].astype(np.float32)) for c in range(3)]
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), tmp_path / "a.func.gii")
    found = read_point_data(tmp_path / "a.func.gii")
    np.testing.assert_allclose(torch.stack([*found.values()], 1).numpy(), V, atol=EPS)


CELLS = {
    "triangles": FACES,
    "segments": torch.stack([torch.arange(99), torch.arange(1, 100)], 1),
    "tetrahedra": torch.from_numpy(Delaunay(VERTICES.numpy()).simplices.astype(np.int64)),
    "none": None,
}


@pytest.mark.parametrize(
    "suffix", [pytest.param(".vtk", marks=by_vtk), pytest.param(".vtu", marks=by_vtk), ".npz"]
)
@pytest.mark.parametrize("kind", CELLS)
def test_simplices_and_data_there_and_back(kind, suffix, tmp_path):
    path, cells = tmp_path / f"a{suffix}", CELLS[kind]
    write_shape(path, VERTICES, cells, f=VERTICES[:, 0], v=V, n=torch.arange(100))
    vertices, faces = read_shape(path)
    assert torch.equal(vertices, VERTICES)
    assert faces is None if cells is None else torch.equal(faces, cells)
    found = read_point_data(path)
    assert torch.equal(found["f"], VERTICES[:, 0])
    assert torch.equal(found["v"], VERTICES)
    assert found["n"].tolist() == list(range(100))


@by_vtk
@pytest.mark.parametrize("name", ["a.vtk", "b.vtk", "a.vtu"])
def test_what_meshio_writes(name, tmp_path):
    """Triangles beside points and lines; tetrahedra beside their boundary; the others are refused."""
    options = {"binary": False} if name == "b.vtk" else {}
    cells = [("vertex", [[4]]), ("line", [[0, 1]]), ("triangle", F[:50]), ("triangle", F[50:])]
    meshio.Mesh(V, cells, point_data={"f": V[:, 0]}).write(tmp_path / name, **options)
    assert same(tmp_path / name)
    assert torch.equal(read_point_data(tmp_path / name)["f"], VERTICES[:, 0])
    inside = [("triangle", F), ("tetra", CELLS["tetrahedra"].numpy())]
    meshio.Mesh(V, inside).write(tmp_path / name, **options)
    assert same(tmp_path / name, 0, VERTICES, CELLS["tetrahedra"])
    meshio.Mesh(V[:8], [("quad", [[0, 1, 2, 3]])]).write(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}.*cells quad; expected tetrahedra, triangles or"):
        read_shape(tmp_path / name)


@by_vtk
@pytest.mark.parametrize("name", ["a.vtk", "a.vtu"])
def test_what_meshio_reads(name, tmp_path):
    """Of a .vtk one array: meshio fails on what VTK writes between several."""
    data = {"f": V[:, 0]}
    if name == "a.vtu":
        data |= {"modes": V[:, :2], "inside": V[:, 2] > 0}
    write_shape(tmp_path / name, VERTICES, FACES, **data)
    found = meshio.read(tmp_path / name)
    assert np.array_equal(found.points, V)
    assert np.array_equal(found.cells_dict["triangle"], F)
    for key, values in data.items():
        assert np.array_equal(found.point_data[key].reshape(values.shape), values), key


def polydata(cells, binary, points=V):
    """A legacy file, as the format's description has it: of version 3, or with offsets of version 5.1."""
    numbers = np.asarray(points, dtype=">f8"), np.arange(len(points), dtype=">f4")
    rows, sizes = np.concatenate(cells), [len(cell) for cell in cells]
    if binary == "offsets":
        offsets = np.r_[0, np.cumsum(sizes)].astype(">i8"), rows.astype(">i8")
        parts = [f"POLYGONS {len(offsets[0])} {len(rows)}\nOFFSETS vtktypeint64\n", offsets[0]]
        parts += ["\nCONNECTIVITY vtktypeint64\n", offsets[1]]
    else:
        padded = np.concatenate([[len(cell), *cell] for cell in cells]).astype(">i4")
        parts = [f"POLYGONS {len(cells)} {len(padded)}\n", padded]
    head = f"# vtk DataFile Version {5.1 if binary == 'offsets' else 3.0}\na title\n"
    head += f"{'BINARY' if binary else 'ASCII'}\nDATASET POLYDATA\nPOINTS {len(points)} double\n"
    tail = f"\nPOINT_DATA {len(points)}\nSCALARS f float 1\nLOOKUP_TABLE default\n"
    content = b""
    for part in (head, numbers[0], "\n", *parts, tail, numbers[1], "\n"):
        if isinstance(part, str):
            content += part.encode()
        else:
            text = " ".join(repr(x) for x in part.ravel().tolist()).encode()
            content += part.tobytes() if binary else text
    return content


@by_vtk
@pytest.mark.parametrize("binary", [False, True, "offsets"])
def test_polydata_in_legacy_files(binary, tmp_path):
    path = tmp_path / "a.vtk"
    path.write_bytes(polydata(F, binary))
    assert same(path, 0 if binary else 1e-9)  # VTK reads decimals with an error in the last digits
    assert read_point_data(path)["f"].tolist() == list(range(100))
    kite = [[0.0, 0, 0], [1, 0, 0], [0.6, 0.6, 0], [0, 1, 0], [2, 2, 0]]
    path.write_bytes(polydata([[0, 1, 2, 3], [1, 4, 2]], binary, kite))
    vertices, faces = read_shape(path)
    assert vertices.tolist() == kite
    assert sorted(faces.tolist()) == [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
    path.write_bytes(polydata(F, binary)[: 3000 if binary else 1500])  # ASCII: within the points
    told = "VTK says" if binary else "100 points, and [0-9]+ numbers follow"
    with pytest.raises(InputError, match=rf"a\.vtk: not a mesh .*{told}"):
        read_shape(path)


@by_vtk
def test_polydata_of_lapy_and_pyvista(tmp_path):
    import pyvista

    lapy.TriaMesh(V, F).write_vtk(str(tmp_path / "lapy.vtk"))
    assert same(tmp_path / "lapy.vtk", EPS)
    mesh = pyvista.PolyData.from_regular_faces(V, F)
    mesh.point_data.update({"f": V[:, 0], "modes": V[:, :2], "labels": np.arange(100)})
    for name in ("a.vtp", "a.vtk"):
        for binary in (True, False):
            mesh.save(tmp_path / name, binary=binary)
            assert same(tmp_path / name, 0 if binary else 1e-9)
            found = read_point_data(tmp_path / name)
            np.testing.assert_allclose(found["modes"].numpy(), V[:, :2], atol=1e-9)
            assert found["labels"].tolist() == list(range(100))
    pyvista.PolyData(V, lines=[100, *range(100)]).save(tmp_path / "curve.vtp")
    assert same(tmp_path / "curve.vtp", faces=CELLS["segments"])
    pyvista.PolyData(V).save(tmp_path / "cloud.vtp")
    assert read_shape(tmp_path / "cloud.vtp")[1] is None


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl"])
def test_meshes_without_data_through_trimesh(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    write_shape(path, VERTICES, FACES)
    assert len(read_shape(path)[1]) == len(FACES)
    with pytest.raises(InputError, match=r"does not hold cells .*, f; .npz holds"):
        write_shape(path, VERTICES, FACES, f=VERTICES[:, 0])
    write_shape(tmp_path / "cloud.ply", VERTICES)
    assert read_shape(tmp_path / "cloud.ply")[1] is None


@pytest.mark.parametrize(
    ("name", "points", "cells", "data", "message"),
    [
        ("a.npz", VERTICES, FACES, {"f": VERTICES[:5, 0]}, r"f: expected data of 100 points.*\(5,"),
        ("a.npz", VERTICES, FACES, {"faces": VERTICES[:, 0]}, "under another name than vertices"),
        ("a.gii", VERTICES, CELLS["segments"], {}, r"does not hold cells \(99, 2\)"),
        ("a.ply", VERTICES[:, :2], FACES, {}, r"points \(100, 2\); .npz holds all"),
        ("a.vtu", VERTICES[:, [0, 1, 2, 0]], FACES, {}, r"points \(100, 4\)"),
        ("a.jpg", VERTICES, FACES, {}, r"a\.jpg: this format does not hold"),
        ("a.npz", VERTICES, FACES + 1, {}, "subtract 1"),
    ],
)
def test_what_cannot_be_written_is_named(name, points, cells, data, message, tmp_path):
    with pytest.raises(InputError, match=message):
        write_shape(tmp_path / name, points, cells, **data)


@pytest.mark.parametrize(("name", "library"), [("a.gii", "nibabel"), ("a.vtu", "pyvista")])
def test_a_missing_library_is_named_with_its_extra(name, library, tmp_path, monkeypatch):
    (tmp_path / name).touch()
    monkeypatch.setitem(sys.modules, library, None)
    for call in (read_shape, read_point_data, lambda path: write_shape(path, VERTICES, FACES)):
        with pytest.raises(
            InputError, match=f"{library} is needed: pip install {library}, or torchlb.files"
        ):
            call(tmp_path / name)


@pytest.mark.parametrize("name", ["a.gii", "a.mgz", "a.vtk", "a.vtp", "a.vtu", "a.npz", "a.ply"])
def test_a_damaged_file_is_named(name, tmp_path):
    (tmp_path / name).write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match=f"{name}: not a mesh or cloud"):
        read_shape(tmp_path / name)
    write_shape(tmp_path / "bare.npz", VERTICES, FACES)
    with pytest.raises(InputError, match=r"bare.npz: no data of points"):
        read_point_data(tmp_path / "bare.npz")
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_point_data(tmp_path / f"other{name}")
