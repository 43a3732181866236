"""The command line as a user meets it: what it prints, its pictures, its exit codes, and no traceback."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from click.testing import CliRunner

import torchlb
from torchlb import LaplaceBeltrami, __version__, read_shape, save_operator
from torchlb.__main__ import main
from torchlb.surfaces import Ellipsoid

ROOT = Path(__file__).parents[1]
VERTICES, FACES = Ellipsoid().mesh(150)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def run(*arguments):
    """A call in this process, which is quicker; it ends by an exit code, not by an exception."""
    done = CliRunner().invoke(main, list(map(str, arguments)))
    assert done.exception is None or type(done.exception) is SystemExit
    return done


@pytest.fixture
def mesh(tmp_path):
    trimesh.Trimesh(VERTICES.numpy(), FACES.numpy(), process=False).export(tmp_path / "shape.ply")
    return tmp_path / "shape.ply"


def test_compare_prints_report_certificate_and_spectra_and_draws(mesh, tmp_path):
    done = run("compare", mesh, "-k", 6, "--order", 2)
    assert done.exit_code == 0, done.stderr
    for part in (
        "shape.ply: 150 points in R^3, 296 faces",
        "150 points, order 2 requested",
        "weak pair: 100.00 % of the edges curved",
        "stable: symmetric, positive by its weak pair",
        "   k     torchlb   cotangent",
        "shape_compare.png",
    ):
        assert part in done.stdout, part
    table = done.stdout.partition("cotangent\n")[2].splitlines()[:6]
    first = [float(line.split()[1]) for line in table]
    assert first == sorted(first)
    assert first[0] == 0
    assert (tmp_path / "shape_compare.png").read_bytes().startswith(b"\x89PNG")


def test_compare_of_a_cloud_has_no_cotangent(tmp_path):
    np.save(tmp_path / "cloud.npy", VERTICES.numpy())
    done = run("compare", "cloud.npy", "--out", "a.png", "-k", 3)
    assert done.exit_code == 0, done.stderr
    assert "150 points in R^3, a cloud" in done.stdout
    assert "cotangent" not in done.stdout
    assert (tmp_path / "a.png").exists()


def test_precompute_then_again_then_info(mesh, tmp_path):
    arguments = (
        "precompute",
        ".",
        "--out",
        "cache",
        "--order",
        1,
        "-k",
        4,
        "--certify",
        "--workers",
        1,
    )
    first = run(*arguments)
    assert (first.exit_code, first.stdout) == (0, "1 shapes, 1 built, 0 cached, 0 failed\n")
    again = run(*arguments)
    assert (again.exit_code, again.stdout) == (0, "1 shapes, 0 built, 1 cached, 0 failed\n")
    [file] = (tmp_path / "cache").glob("*.npz")
    done = run("info", file)
    assert done.exit_code == 0, done.stderr
    for part in ("order=1", "certificate holds", "eigenpairs stored", f"torchlb {__version__}"):
        assert part in done.stdout, part


def test_an_error_is_one_message_on_stderr(tmp_path):
    """In a process of its own, as from a shell."""
    np.savetxt("few.xyz", np.eye(3))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    call = [sys.executable, "-m", "torchlb", "compare", "few.xyz"]
    done = subprocess.run(call, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (1, "")
    assert "3 points are fewer than the 4" in done.stderr
    assert "Traceback" not in done.stderr


def test_precompute_names_what_failed_and_ends_with_1(mesh, tmp_path):
    (tmp_path / "broken.obj").write_text("nothing")
    done = run("precompute", ".", "--out", "cache", "--order", 1, "--workers", 1, "--quiet")
    assert done.exit_code == 1
    assert "2 shapes, 1 built, 0 cached, 1 failed\nfailed\n  broken.obj" in done.stdout
    assert done.stderr == ""


def test_info_of_a_shape_and_of_a_damaged_operator(mesh, tmp_path):
    done = run("info", mesh)
    assert done.exit_code == 0
    assert "150 points in R^3, 296 faces, box" in done.stdout
    save_operator(LaplaceBeltrami.from_cotangent(VERTICES, FACES), tmp_path / "lb.npz")
    content = (tmp_path / "lb.npz").read_bytes()
    (tmp_path / "lb.npz").write_bytes(content[: len(content) // 2])
    done = run("info", "lb.npz")
    assert done.exit_code == 1
    assert done.stderr.startswith("Error: ")
    assert "lb.npz" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["compare", "missing.ply"], 2, "does not exist"),
        (["compare", "prose.obj"], 1, "prose.obj: not a mesh or cloud that can be read"),
        (["compare", "few.xyz"], 1, "3 points are fewer than the 4"),
        (["compare", "few.xyz", "--order", "0"], 2, "0 is not in the range"),
        (["compare", "few.xyz", "--weights", "heavy"], 2, "'heavy' is not one of"),
        (["precompute", "."], 2, "Missing option '--out'"),
        (
            ["precompute", ".", "--out", "cache", "--operator", "cotangent", "--order", "3"],
            2,
            "cotangent operator has no --order",
        ),
        (["precompute", "empty", "--out", "cache"], 1, "no shapes in it"),
        (["curvature", "few.xyz", "--out", "a.npz"], 1, "3 points are fewer than the 4"),
        (["modes", "few.xyz"], 2, "Missing option '--out'"),
        (["conquer"], 2, "No such command 'conquer'"),
    ],
)
def test_a_wrong_call_ends_with_a_message(arguments, code, message, tmp_path):
    (tmp_path / "prose.obj").write_text("no mesh")
    (tmp_path / "few.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    (tmp_path / "empty").mkdir()
    done = run(*arguments)
    assert done.exit_code == code
    assert message in done.output
    assert not list(tmp_path.glob("*.png"))


def test_commands_write_what_they_compute(mesh):
    vertices, faces = read_shape(mesh)
    lb = LaplaceBeltrami.from_mesh(vertices, faces, order=2)
    gaps = torch.where(vertices[:, 2] > 0, vertices[:, 0], torch.nan)
    np.savez("maps.npz", f=vertices[:, 0].numpy(), gaps=gaps.numpy())
    np.savez("zeros.npz", gaps=gaps.nan_to_num().numpy())  # as FreeSurfer has them
    curvatures = lb.curvatures()
    for arguments, expected in {
        ("modes", "-k", "5"): {"modes": lb.eigenbasis(5).eigenvectors},
        ("smooth", "--data", "maps.npz", "--fwhm", "0.4"): {
            "f": torchlb.smooth(lb, vertices[:, 0], 0.4),
            "gaps": torchlb.smooth(lb, gaps, 0.4, mask=~gaps.isnan()),
        },
        ("smooth", "--data", "zeros.npz", "--missing", "0", "--fwhm", "0.4"): {
            "gaps": torchlb.smooth(lb, gaps, 0.4, mask=~gaps.isnan())
        },
        ("distance", "--source", "3", "--source", "7"): {
            "distance": torchlb.geodesic_distance(lb, [3, 7])
        },
        ("distance", "--source", "3", "--source", "7", "--each"): {
            "distance": torchlb.geodesic_distance(lb, [3, 7], each=True)
        },
        ("curvature",): {n: getattr(curvatures, n) for n in ("k1", "k2", "mean", "gaussian")},
    }.items():
        command, *options = arguments
        call = [command, str(mesh), "--order", "2", *options, "--out", "out.npz"]
        done = run(*call)
        assert done.exit_code == 0, done.output
        assert "out.npz: 150 points in R^3, 296 faces" in done.output
        found = torchlb.read_point_data("out.npz")
        assert found.keys() == expected.keys()
        for name, values in expected.items():
            torch.testing.assert_close(found[name], values, equal_nan=True)
        assert torch.equal(read_shape("out.npz")[1], faces)


@pytest.mark.parametrize("command", [[], ["compare"], ["precompute"], ["info"]])
def test_help_has_examples(command):
    done = run(*command, "--help")
    assert done.exit_code == 0
    assert f"  python -m torchlb {command[0] if command else 'compare'} " in done.output


def test_version():
    assert run("--version").stdout == f"torchlb, version {__version__}\n"
