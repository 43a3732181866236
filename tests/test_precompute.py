"""A data set at once: nothing twice, nothing lost to a bad shape, nothing corrupt when killed."""

import csv
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import joblib
import numpy as np
import pytest
import torch
import trimesh

import torchlb.io.precompute
from torchlb import LaplaceBeltrami, load_operator, load_or_build, precompute_operators
from torchlb.io.files import read_shape
from torchlb.surfaces import Sphere

ROOT = Path(__file__).parents[1]
OPTIONS = {"order": 1, "progress": False}


@pytest.fixture(scope="module", autouse=True)
def shape():
    """Made when the first test runs, not when tests are collected."""
    global VERTICES, FACES
    VERTICES, FACES = Sphere().mesh(100)


def write_shapes(folder, count):
    """Spheres of different sizes as .ply."""
    folder.mkdir()
    for i in range(count):
        shape = trimesh.Trimesh((1 + i) * VERTICES.numpy(), FACES.numpy(), process=False)
        shape.export(folder / f"{i:02d}.ply")


def operators_in(cache):
    return {path.name: path.stat().st_mtime_ns for path in cache.glob("*.npz")}


def test_a_folder_of_meshes_and_clouds(tmp_path):
    """Every kind of file, in depth; the second run computes nothing; load_or_build finds what is there."""
    folder, out = (
        tmp_path / "shapes",
        tmp_path / "shapes" / "cache",
    )  # in the folder, and yet no shape
    write_shapes(folder, 1)
    (folder / "deeper").mkdir()
    np.save(folder / "deeper" / "cloud.npy", VERTICES.numpy())
    np.savetxt(folder / "cloud.xyz", 2 * VERTICES.numpy())
    np.savez(folder / "mesh.npz", vertices=VERTICES.numpy(), faces=FACES.int().numpy())
    (folder / "notes.txt").write_text("no shape")
    report = precompute_operators(folder, out, workers=1, **OPTIONS)
    assert [result.name for result in report.results] == [
        "00.ply",
        "cloud.xyz",
        "deeper/cloud.npy",
        "mesh.npz",
    ]
    assert {result.status for result in report.results} == {"built"}
    assert {result.points for result in report.results} == {100}
    before = operators_in(out)
    again = precompute_operators(folder, out, workers=1, **OPTIONS)
    assert {result.status for result in again.results} == {"cached"}
    assert operators_in(out) == before
    assert again.files == report.files
    load_or_build(VERTICES, cache=out, order=1)
    found = load_or_build(VERTICES, FACES, cache=out, order=1)
    assert operators_in(out) == before
    assert torch.equal(found.stencil.values, load_operator(report.files["mesh.npz"]).stencil.values)
    counts, skipped = str(report).splitlines()
    assert counts == "4 shapes, 4 built, 0 cached, 0 failed"
    assert skipped == "skipped, as no meshes or tables of points: 1 .txt"
    assert report.skipped == ("notes.txt",)


def test_clouds_are_cleaned_whatever_their_file(tmp_path):
    """A point twice in each; labels and pictures beside them are counted, not read."""
    folder, out = tmp_path / "shapes", tmp_path / "out"
    folder.mkdir()
    points = np.r_[VERTICES.numpy(), VERTICES.numpy()[:3]]
    names = ["a.txt", "b.csv", "c.pts", "d.xyz", "e.asc"]
    for i, name in enumerate(names):
        delimiter = "," if name == "b.csv" else " "
        np.savetxt(folder / name, (1 + i) * points, delimiter=delimiter)
    head = "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 103\nDATA binary\n"
    (folder / "f.pcd").write_bytes(head.encode() + (9 * points).tobytes())
    np.save(folder / "g.npy", 10 * points)
    np.savetxt(folder / "labels.txt", np.arange(103), fmt="%d")
    (folder / "names.csv").write_text("name,label\nsphere,1\n")
    (folder / "picture.png").write_bytes(b"\x89PNG")
    report = precompute_operators(folder, out, workers=1, clean=True, **OPTIONS)
    assert [result.name for result in report.results] == [*names, "f.pcd", "g.npy"]
    assert {(result.status, result.points) for result in report.results} == {("built", 100)}
    assert report.skipped == ("labels.txt", "names.csv", "picture.png")
    assert str(report).endswith("no meshes or tables of points: 1 .csv, 1 .png, 1 .txt")
    raw = precompute_operators(folder, out, workers=1, **OPTIONS)
    assert all("torchlb.clean_points(points)" in result.message for result in raw.failed)
    assert len(raw.failed) == 7


def test_a_bad_shape_is_named_and_stops_no_other(tmp_path):
    folder, out = tmp_path / "shapes", tmp_path / "out"
    write_shapes(folder, 3)
    content = (folder / "01.ply").read_bytes()
    (folder / "half.ply").write_bytes(content[: len(content) // 2])
    (folder / "text.obj").write_text("no mesh")
    np.save(folder / "nan.npy", np.full((50, 3), np.nan))
    np.savez(
        folder / "loose.npz", vertices=np.r_[VERTICES.numpy(), [[9.0, 9, 9]]], faces=FACES.numpy()
    )
    report = precompute_operators(folder, out, workers=2, **OPTIONS)
    assert [r.status for r in report.results if r.name[0] == "0"] == ["built"] * 3
    reasons = {result.name: result.message for result in report.failed}
    assert set(reasons) == {"half.ply", "text.obj", "nan.npy", "loose.npz"}
    assert "half.ply: not a mesh or cloud" in reasons["half.ply"]
    assert "50 are NaN or infinite" in reasons["nan.npy"]
    assert "clean_mesh" in reasons["loose.npz"]
    assert len(operators_in(out)) == 3
    printed = str(report)
    assert printed.startswith("7 shapes, 3 built, 0 cached, 4 failed\nfailed\n")
    assert all(name in printed for name in reasons)
    with open(out / "precompute.csv", encoding="utf-8", newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert {name for name, row in rows.items() if row["status"] == "failed"} == set(reasons)
    assert rows["nan.npy"]["message"] == reasons["nan.npy"]
    cleaned = precompute_operators(folder, out, workers=1, clean=True, **OPTIONS)
    assert {result.name for result in cleaned.failed} == set(reasons) - {"loose.npz"}


def test_a_shape_that_kills_its_worker_is_named_and_stops_no_other(tmp_path):
    class Killer:
        """Ends the process that reads it, as compiled code does that crashes."""

        def __reduce__(self):
            return os._exit, (9,)

    shapes = [(i * VERTICES, FACES) for i in range(1, 7)]
    shapes.insert(2, (Killer(), None))
    report = precompute_operators(shapes, tmp_path, workers=2, **OPTIONS)
    assert [result.name for result in report.failed] == ["shape 2"]
    assert "its process died" in report.failed[0].message
    assert len(operators_in(tmp_path)) == 6


def test_arrays_types_and_eigenpairs(tmp_path):
    """int32 faces of float32 vertices are the same entry; k pairs are in the file."""
    single = VERTICES.float()
    shapes = [(single, FACES), (single.double().numpy(), FACES.int().numpy())]
    report = precompute_operators(
        shapes, tmp_path, operator="cotangent", k=6, workers=1, progress=False
    )
    assert [result.status for result in report.results] == ["built", "cached"]
    assert load_operator(report.files["shape 0"]).modes.eigenvectors.shape[1] >= 6


def test_workers_use_one_thread_and_give_back_what_there_was(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        torchlb.io.precompute,
        "load_or_build",
        lambda *a, **b: (seen.append(torch.get_num_threads()), load_or_build(*a, **b))[1],
    )
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        precompute_operators([(VERTICES, FACES)], tmp_path, workers=1, **OPTIONS)
        assert (seen, torch.get_num_threads()) == ([1], 2)
    finally:
        torch.set_num_threads(before)


KILLED = """
import sys, time
import torchlb.io.precompute
from torchlb import precompute_operators
if __name__ == "__main__":
    precompute_operators(sys.argv[1], sys.argv[2], workers=2, order=3, progress=False)
"""


def test_killed_and_resumed_computes_nothing_twice(tmp_path):
    folder, out = tmp_path / "shapes", tmp_path / "out"
    write_shapes(folder, 20)
    (folder / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(folder), str(out)],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )
    while process.poll() is None and len(list(out.glob("*.npz"))) < 5:
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)  # and its workers
    assert process.wait() == -signal.SIGKILL
    done = operators_in(out)
    assert 5 <= len(done) < 20
    report = precompute_operators(folder, out, workers=1, order=3, progress=False)
    after = operators_in(out)
    assert {name: after[name] for name in done} == done
    assert sum(result.status == "cached" for result in report.results) == len(done)
    assert [result.name for result in report.failed] == ["broken.ply"]
    assert len(after) == 20
    for file in report.files.values():
        assert load_operator(file)._has_weak_form


def test_the_same_call_runs_on_a_dask_cluster(tmp_path, monkeypatch):
    """Two worker processes; this process computes nothing."""
    from dask.distributed import Client, LocalCluster

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(torchlb.io.precompute, "load_or_build", None)
    folder, out = tmp_path / "shapes", tmp_path / "out"
    write_shapes(folder, 6)
    (folder / "broken.ply").write_text("ply")
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster) as client,
        joblib.parallel_config(backend="dask"),
    ):
        assert len(set(client.run(os.getpid).values()) - {os.getpid()}) == 2
        report = precompute_operators(folder, out, **OPTIONS)
        again = precompute_operators(folder, out, **OPTIONS)
    assert [result.status for result in report.results] == ["built"] * 6 + ["failed"]
    assert [result.status for result in again.results] == ["cached"] * 6 + ["failed"]
    lb = load_operator(report.files["03.ply"])
    direct = LaplaceBeltrami.from_mesh(*read_shape(folder / "03.ply"), order=1)
    assert torch.equal(lb.stencil.values[0], direct.stencil.values[0])


def test_a_warning_of_a_shape_is_in_the_report(tmp_path, monkeypatch):
    def warned(*arguments, **options):
        warnings.warn("few points", torchlb.TorchlbWarning, stacklevel=1)
        warnings.warn("Sparse CSR tensor support is in beta", UserWarning, stacklevel=1)
        return load_or_build(*arguments, **options)

    monkeypatch.setattr(torchlb.io.precompute, "load_or_build", warned)
    report = precompute_operators([(VERTICES, FACES)], tmp_path, workers=1, **OPTIONS)
    assert report.results[0].message == "few points"
    assert str(report).endswith("warned\n  shape 0  few points")


def test_what_killed_writers_left_is_removed_after_a_day(tmp_path):
    old, new = tmp_path / ".a.npz.0.tmp", tmp_path / ".b.npz.0.tmp"
    old.touch()
    new.touch()
    os.utime(old, (time.time() - 2 * 24 * 3600,) * 2)
    precompute_operators([(VERTICES, FACES)], tmp_path, workers=1, **OPTIONS)
    assert not old.exists()
    assert new.exists()


def test_what_would_fail_for_every_shape_is_refused_at_once(unchecked, tmp_path):
    (tmp_path / "empty").mkdir()
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="no such folder"):
        precompute_operators(tmp_path / "missing", out)
    with pytest.raises(ValueError, match=r"no shapes in it; they end in .*\.ply"):
        precompute_operators(tmp_path / "empty", out)
    with pytest.raises(ValueError, match="got none"):
        precompute_operators([], out)
    with pytest.raises(ValueError, match="shape 0: expected a file or"):
        precompute_operators([VERTICES], out)
    with pytest.raises(TypeError, match="no option degree"):
        precompute_operators([(VERTICES, FACES)], out, degree=3)
    with pytest.raises(TypeError, match="'cotangent' has no option order"):
        precompute_operators([(VERTICES, FACES)], out, operator="cotangent", order=3)
    with pytest.raises(ValueError, match="operator: expected one of"):
        precompute_operators([(VERTICES, FACES)], out, operator="graph")
    assert not out.exists()
