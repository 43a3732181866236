"""Files as others write them: a mesh stays a mesh, a cloud a cloud, whatever their dialect."""

import numpy as np
import pytest
import torch
import trimesh

from torchlb import LaplaceBeltrami, clean_mesh, read_shape
from torchlb.operator.cleaning import triangles_of
from torchlb.surfaces import Sphere

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TWO = [[0, 1, 2], [0, 2, 3]]
ROWS = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in SQUARE)
OBJ = "".join(f"v {row}\n" for row in ROWS.splitlines())
PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"


def written(tmp_path, name, content):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return tmp_path / name


@pytest.mark.parametrize(
    "faces",
    [
        "f -4 -3 -2\nf -4 -2 -1\n",
        "f 1 2 3 4\n",
        "f -4 -3 -2 -1\n",
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf -4/-4 -3/-3 -2/-2 -1/-1\n",
        "vn 0 0 1\nf -4//-1 -3//-1 -2//-1\nf 1//1 3//1 4//1\n",
        "usemtl red\nf 1 2 3\nusemtl blue\nf 1 3 4\n",
        "f 1 2 \\\n3\ng other\nf 1 3 4 # the second\n",
    ],
)
def test_faces_of_an_obj(faces, tmp_path):
    vertices, found = read_shape(written(tmp_path, "a.obj", OBJ + faces))
    assert (vertices.tolist(), found.tolist()) == (SQUARE.tolist(), TWO)
    vertices, found = read_shape(written(tmp_path, "b.obj", (OBJ + faces).replace("\n", "\r\n")))
    assert (vertices.tolist(), found.tolist()) == (SQUARE.tolist(), TWO)


def test_an_index_below_zero_counts_from_its_face(tmp_path):
    """Of two parts that a program writes one after the other."""
    part = "v 0 0 {0}\nv 1 0 {0}\nv 0 1 {0}\nf -3 -2 -1\n"
    _, faces = read_shape(written(tmp_path, "a.obj", part.format(0) + part.format(1)))
    assert faces.tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize(
    "content",
    [
        "OFF\n4 1 0\n" + ROWS + "4 0 1 2 3\n",
        "OFF 4 2 5\n" + ROWS + "3 0 1 2 255 0 0\n3 0 2 3 0 255 0\n",
        "OFF4 1 0\n# corners\n\n" + ROWS + "4 0 1 2 3 0.5 0.5 0.5 1\n",
        "COFF\n4 1 0\n" + ROWS.replace("\n", " 255 0 0 255\n") + "4 0 1 2 3\n",
        "NOFF\n4 1 0\n" + ROWS.replace("\n", " 0 0 1\n") + "4 0 1 2 3\n",
    ],
)
def test_faces_of_an_off(content, tmp_path):
    vertices, faces = read_shape(written(tmp_path, "a.off", content))
    assert (vertices.tolist(), faces.tolist()) == (SQUARE.tolist(), TWO)


@pytest.mark.parametrize("size", ["uchar", "int"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    ("element", "rows", "expected"),
    [
        ("face", [[0, 1, 2], [0, 2, 3]], TWO),
        ("face", [[0, 1, 2, 3]], TWO),
        ("face", [[0, 1, 2, 3], [0, 1, 2]], [*TWO, [0, 1, 2]]),
        ("tristrips", [[0, 1, 3, 2]], [[0, 1, 3], [2, 3, 1]]),
        ("tristrips", [[0, 1, 2, -1, 0, 0, 2, 3]], [[0, 1, 2], [3, 2, 0]]),
    ],
)
def test_faces_and_strips_of_a_ply(element, rows, expected, kind, size, tmp_path):
    """With a colour beside the corners, and another element behind."""
    head = PLY.replace("ascii", kind).replace("float x", "double x") + "property uchar red\n"
    head += f"element {element} {len(rows)}\nproperty list {size} int vertex_indices\n"
    head += "property uchar red\nelement edge 1\nproperty int vertex1\nend_header\n"
    if kind == "ascii":
        body = ROWS.replace("\n", " 7\n") + "".join(
            f"{len(row)} {' '.join(map(str, row))} 9\n" for row in rows
        )
        body = (body + "3\n").encode()
    else:
        order = "<" if "little" in kind else ">"
        types = [("x", f"{order}f8"), ("y", f"{order}f4"), ("z", f"{order}f4"), ("red", "u1")]
        table = np.array([(*row, 7) for row in SQUARE], types)
        body = table.tobytes()
        for row in rows:
            length = np.array(len(row), "u1" if size == "uchar" else f"{order}i4")
            body += length.tobytes() + np.array(row, f"{order}i4").tobytes() + b"\x09"
        body += bytes(4)
    vertices, faces = read_shape(written(tmp_path, "a.ply", head.encode() + body))
    assert (vertices.tolist(), faces.tolist()) == (SQUARE.tolist(), expected)


@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0), (1, 0.2), (0, 1), (0.4, 0.3)],  # a dart: one diagonal lies outside
        [(0, 0), (2, 0), (2, 1), (1, 1), (0, 1)],  # three corners on a line
        [(0, 0), (7, 0), (7, 1), (6, 0.2), (5, 1), (4, 0.2), (3, 1), (2, 0.2), (1, 1)],  # a comb
        [(4, 0), (4, 4), (0, 4), (0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (3, 3), (3, 0.0001 + 1)],
    ],
)
def test_triangles_cover_their_polygon_once(corners):
    """All face as the polygon does, and their areas sum to its area, ½ Σ x_i y_{i+1} − x_{i+1} y_i, in any plane."""
    x = torch.tensor(corners, dtype=torch.float64)
    area = (x[:, 0] * x[:, 1].roll(-1) - x[:, 0].roll(-1) * x[:, 1]).sum() / 2
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.manual_seed(0)).double())[0]
    turn = turn * torch.linalg.det(turn)
    for way in (1, -1):
        order = torch.arange(len(x)) if way > 0 else torch.arange(len(x)).flip(0)
        space = torch.nn.functional.pad(x, (0, 1)) @ turn.T
        (triangles,) = triangles_of(space, order[None])
        assert len(triangles) == len(x) - 2
        a, b, c = space[triangles].unbind(1)
        areas = torch.linalg.cross(b - a, c - a) @ turn[:, 2] / 2 * way * area.sign()
        assert (areas > 0).all()
        torch.testing.assert_close(areas.sum(), area.abs())


def test_quads_of_a_file_are_a_surface(tmp_path):
    """The sides of a cube in squares: closed, of area 6, in each format."""
    box = trimesh.creation.box().vertices + 0.5
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    rows = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in box)
    lists = "".join(f"4 {' '.join(map(str, side))}\n" for side in sides)
    head = (
        PLY.replace("vertex 4", "vertex 8")
        + "element face 6\nproperty list uchar int vertex_index\nend_header\n"
    )
    obj = "".join(f"v {row}\n" for row in rows.splitlines())
    obj += "".join(f"f {' '.join(str(i - 8) for i in side)}\n" for side in sides)
    for name, content in {
        "a.off": "OFF\n8 6 12\n" + rows + lists,
        "a.ply": head + rows + lists,
        "a.obj": obj,
    }.items():
        vertices, faces = read_shape(written(tmp_path, name, content))
        mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
        assert mesh.is_watertight, name
        assert mesh.area == pytest.approx(6)


def jittered_stl(path, turn, scale):
    """A sphere around 0 whose zeros are 0 or 1e-16 and less, and all of whose corners are rounded by themselves."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    corners = mesh.triangles @ turn.T * scale
    rng = np.random.default_rng(0)
    if scale == 1:  # as float32 leaves them, and one step away
        corners = np.nextafter(
            corners.astype(np.float32), np.float32(rng.choice([-9, 9], corners.shape))
        )
    tiny = np.abs(mesh.triangles) < 1e-6
    if turn.trace() == 3:
        corners[tiny] = rng.choice(np.float32([0, -2.7e-16, 1.2e-17]), tiny.sum())
    trimesh.Trimesh(
        corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3), process=False
    ).export(path)
    return len(mesh.vertices)


@pytest.mark.parametrize("scale", [1, 1e-3, 1e4])
@pytest.mark.parametrize("turned", [False, True])
def test_corners_of_an_stl_that_differ_by_rounding_are_one(turned, scale, tmp_path):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0] if turned else np.eye(3)
    count = jittered_stl(tmp_path / "part.stl", turn, scale)
    vertices, faces = read_shape(tmp_path / "part.stl")
    assert (len(vertices), len(faces)) == (count, 2 * count - 4)
    assert trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False).is_watertight


def test_distinct_vertices_of_a_fine_stl_stay(tmp_path):
    """A sphere of radius 1e-7 at 1 from another: its corners differ in the last digits of single precision there."""
    fine, coarse = trimesh.creation.icosphere(subdivisions=2), trimesh.creation.icosphere()
    fine.apply_scale(1e-7)
    coarse.apply_translation([3, 0, 0])
    trimesh.util.concatenate([fine, coarse]).export(tmp_path / "fine.stl")
    assert len(read_shape(tmp_path / "fine.stl")[0]) == len(fine.vertices) + len(coarse.vertices)
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(5)), -1).reshape(-1, 2) * 2e-7 + 1
    sheet = trimesh.Trimesh(
        np.c_[grid, np.zeros(25)], [[0, 1, 6], [0, 6, 5], [18, 19, 24]], process=False
    )
    sheet.export(tmp_path / "sheet.stl")  # open, and its edges are as short as rounding
    _, faces = read_shape(tmp_path / "sheet.stl")
    assert all(len(set(face)) == 3 for face in faces.tolist())


PCD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb normal\nSIZE 8 4 4 4 4\nTYPE F F F U F\nCOUNT 1 1 1 1 3\n"
PCD += "WIDTH 5\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 5\nDATA "


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.pcd", PCD + "ascii\n" + ROWS.replace("\n", " 7 0 0 1\n") + "nan nan nan 7 0 0 1\n"),
        (
            "b.pcd",
            (PCD + "binary\n").encode()
            + np.array(
                [(*row, 7, (0, 0, 1)) for row in [*SQUARE, [np.nan] * 3]],
                [("x", "<f8"), ("y", "<f4"), ("z", "<f4"), ("c", "<u4"), ("n", "<f4", (3,))],
            ).tobytes(),
        ),
        ("a.xyz", ROWS),
        ("b.xyz", "# x y z, in m\n" + ROWS.replace(" ", "\t")),
        ("c.xyz", "\n" + ROWS.replace("\n", " 255 0 0\n")),
        ("a.pts", "4\n" + ROWS.replace("\n", " 17 255 0 0\n")),
        ("a.txt", "//X Y Z R G B\n4\n" + ROWS.replace("\n", " 255 0 0\n")),
        ("a.asc", "\ufeff" + ROWS),
        ("a.csv", "x,y,z\n" + ROWS.replace(" ", ",")),
        (
            "b.csv",
            "id;X;Y;Z\n" + "".join(f"9;{row.replace(' ', ';')},0\n" for row in ROWS.splitlines()),
        ),
        (
            "c.csv",
            '"Z","Y","X"\n'
            + "".join(",".join(row.split()[::-1]) + "\n" for row in ROWS.splitlines()),
        ),
        (
            "d.csv",
            ",x [mm],y [mm],z [mm]\n"
            + "".join(f"{i},{row.replace(' ', ',')}\n" for i, row in enumerate(ROWS.splitlines())),
        ),
        (
            "e.csv",
            "id,name,x,y,z,\n"
            + "".join(f"9,,{row.replace(' ', ',')},\n" for row in ROWS.splitlines()),
        ),
    ],
)
def test_clouds(name, content, tmp_path):
    points, faces = read_shape(written(tmp_path, name, content))
    assert (points.tolist(), faces) == (SQUARE.tolist(), None)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.pcd", PCD + "binary_compressed\n123", "data are binary_compressed; write them as"),
        ("a.pcd", "FIELDS x y z\n1 2 3\n", "no line DATA"),
        ("a.txt", "Read me first.\n", "no rows of two or more numbers"),
        ("b.txt", "0 0 0\n1 0 0\n1 1\n", "rows of 3 numbers and of others"),
        ("b.csv", "id,x,y,z\n1,2,3\n", r"4 names of columns \(id, x, y, z\) and rows of 3 numbers"),
        ("a.csv", "1,2,3\n1,2,car\n", "line 2: '1,2,car' has no numbers"),
        ("a.obj", OBJ + "f 1 2 9\n", "a corner 8, and there are 4 vertices"),
        ("b.obj", OBJ + "f 0 1 2\n", "they count from 1"),
        ("a.off", "OFF\n4 3 0\n" + ROWS + "3 0 1 2\n", "4 vertices and 3 faces announced, 5 lines"),
    ],
)
def test_what_is_wrong_is_named(name, content, reason, tmp_path):
    with pytest.raises(ValueError, match=f"{name}: not a mesh or cloud .*{reason}"):
        read_shape(written(tmp_path, name, content))


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_the_remedy_for_vertices_in_one_place_is_exact(scale):
    """A sphere cut open along all edges, by rounding: what is warned of is merged, and nothing is left to warn of."""
    vertices, faces = Sphere().mesh(80)
    corners = vertices[faces.flatten()] * scale
    corners = corners * (
        1 + 1e-13 * torch.randn(corners.shape, generator=torch.manual_seed(0)).double()
    )
    loose = torch.arange(len(corners)).view(-1, 3)
    with pytest.warns(
        UserWarning, match=r"share a place .*clean_mesh\(vertices, faces, merge=True\)"
    ):
        LaplaceBeltrami.from_mesh(corners, loose, order=1)
    mended, triangles, kept = clean_mesh(corners, loose, merge=True)
    assert (len(mended), len(triangles)) == (80, len(faces))
    assert torch.equal(mended, corners[kept])
    lb = LaplaceBeltrami.from_mesh(mended / scale, triangles, order=1)
    exact = LaplaceBeltrami.from_mesh(vertices, faces, order=1)
    torch.testing.assert_close(
        lb.eigenbasis(4).eigenvalues, exact.eigenbasis(4).eigenvalues, rtol=1e-6, atol=1e-8
    )
