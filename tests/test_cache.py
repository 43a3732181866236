"""One entry for one operator, whatever types it came in; and a file that is there whole or not at all."""

import inspect
import json
import os
import signal
import time
import warnings
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import torchlb.io.cache
from torchlb import (
    CacheWarning,
    LaplaceBeltrami,
    OperatorFileError,
    load_operator,
    load_or_build,
    operator_key,
    save_operator,
)
from torchlb.surfaces import Sphere, UnitDisk

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module", autouse=True)
def shape():
    """Made when the first test runs, not when tests are collected."""
    global VERTICES, FACES
    VERTICES, FACES = Sphere().mesh(100)
    VERTICES = VERTICES * (1 + 1 / 3)  # not representable in float32


@pytest.fixture
def no_building(monkeypatch):
    """Fail on every attempt to build an operator."""

    def install():
        for name in ("from_mesh", "from_points", "from_cotangent"):
            refuse = Mock(side_effect=AssertionError("built, though it was in the cache"))
            refuse.__signature__ = inspect.signature(getattr(LaplaceBeltrami, name))
            refuse.__name__ = name
            monkeypatch.setattr(LaplaceBeltrami, name, refuse)

    return install


def files_of(folder):
    return sorted(path.name for path in Path(folder).iterdir())


def assert_same(a, b):
    """Bit for bit, with everything that is plain beside the tensors."""
    ours, theirs = a.state_dict(), b.state_dict()
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == theirs[name].dtype, name
            assert torch.equal(value.nan_to_num(-1), theirs[name].nan_to_num(-1)), name
    assert repr(a) == repr(b)
    assert a.certificate == b.certificate
    assert str(a.report) == str(b.report)


@pytest.mark.parametrize(
    "make",
    [
        lambda: LaplaceBeltrami.from_mesh(VERTICES, FACES, order=2),
        lambda: LaplaceBeltrami.from_points(VERTICES.float()),
        lambda: LaplaceBeltrami.from_cotangent(VERTICES, FACES),
        lambda: LaplaceBeltrami.from_mesh(VERTICES, FACES).bfloat16(),
        lambda: LaplaceBeltrami.batch([LaplaceBeltrami.from_cotangent(VERTICES, FACES)] * 2),
        LaplaceBeltrami,
    ],
    ids=["mesh", "cloud float32", "cotangent", "bfloat16", "batch", "empty"],
)
def test_read_back_bit_for_bit(make, tmp_path):
    lb = make()
    if lb.num_points and not lb.sizes and lb.dtype.itemsize > 2:
        lb.eigenbasis(5, store=True)
    save_operator(lb, tmp_path / "new" / "lb.npz")
    back = load_operator(tmp_path / "new" / "lb.npz")
    assert_same(back, lb)
    assert files_of(tmp_path / "new") == ["lb.npz"]
    if len(lb.modes.left):
        assert torch.equal(back.eigenbasis(5).eigenvectors, lb.eigenbasis(5).eigenvectors)


def test_first_call_builds_and_later_ones_read(tmp_path, no_building):
    first = load_or_build(VERTICES, FACES, cache=tmp_path, order=2)
    assert_same(first, LaplaceBeltrami.from_mesh(VERTICES, FACES, order=2))
    assert files_of(tmp_path) == [operator_key(VERTICES, FACES, order=2) + ".npz"]
    no_building()
    assert_same(load_or_build(VERTICES, FACES, cache=tmp_path, order=2), first)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_type_is_that_of_the_input_and_the_numbers_those_without_a_cache(dtype, tmp_path):
    vertices = VERTICES.to(dtype)
    for _ in range(2):
        lb = load_or_build(vertices, FACES, cache=tmp_path, order=2)
        assert_same(lb, LaplaceBeltrami.from_mesh(vertices, FACES, order=2))


def test_same_values_share_an_entry():
    """float32 and its float64 copy, int32 and int64, arrays and tensors, defaults and defaults spelt out, ±0."""
    vertices = VERTICES.float()
    vertices[0, 0] = 0.0
    signed = vertices.clone()
    signed[0, 0] = -0.0
    key = operator_key(vertices, FACES)
    for other in (
        operator_key(vertices.double(), FACES.int()),
        operator_key(vertices.numpy(), FACES.numpy().astype(np.int32)),
        operator_key(vertices.numpy().astype(np.float64, order="F"), FACES.tolist()),
        operator_key(vertices, FACES, order=np.int64(3), condition="neumann", certify=False),
        operator_key(signed, FACES),
        operator_key(vertices.clone().requires_grad_(), FACES),
    ):
        assert other == key
    normals = vertices / vertices.norm(dim=1, keepdim=True)
    assert operator_key(vertices, normals=normals) == operator_key(
        vertices, normals=normals.double().numpy()
    )


def test_anything_that_changes_the_operator_changes_the_key(monkeypatch):
    moved = VERTICES.clone()
    moved[7, 1] += 1e-15
    mask = torch.zeros(len(VERTICES), dtype=torch.bool)
    keys = [
        operator_key(VERTICES, FACES),
        operator_key(moved, FACES),
        operator_key(VERTICES, FACES.flip(1)),
        operator_key(VERTICES, FACES[torch.arange(len(FACES)).flip(0)]),
        operator_key(VERTICES, FACES, operator="cotangent"),
        operator_key(VERTICES, FACES, order=4),
        operator_key(VERTICES, FACES, normal_order=2),
        operator_key(VERTICES, FACES, projection="normal"),
        operator_key(VERTICES, FACES, weights="polyharmonic"),
        operator_key(VERTICES, FACES, num_neighbors=40),
        operator_key(VERTICES, FACES, condition=None),
        operator_key(VERTICES, FACES, certify=True),
        operator_key(VERTICES),
        operator_key(VERTICES, normals=VERTICES),
        operator_key(VERTICES, normals=-VERTICES),
        operator_key(VERTICES, boundary=mask),
        operator_key(VERTICES, boundary="detect"),
    ]
    monkeypatch.setattr(torchlb.io.cache, "__version__", "0.0.1")
    keys.append(operator_key(VERTICES, FACES))
    assert len(set(keys)) == len(keys)


def test_progress_is_no_part_of_the_key(tmp_path):
    load_or_build(VERTICES, FACES, cache=tmp_path, order=1, progress=False)
    load_or_build(VERTICES, FACES, cache=tmp_path, order=1, progress=True)
    assert len(files_of(tmp_path)) == 1


def test_a_file_is_completed_by_eigenpairs_and_serves_fewer(tmp_path, no_building):
    cache = {"cache": tmp_path, "operator": "cotangent"}
    load_or_build(VERTICES, FACES, **cache)
    no_building()
    more = load_or_build(VERTICES, FACES, k=8, **cache)
    stored = load_operator(tmp_path / files_of(tmp_path)[0])
    assert stored.modes.eigenvectors.shape[1] >= 8
    fewer = load_or_build(VERTICES, FACES, k=5, **cache).eigenbasis(5)
    assert torch.equal(fewer.eigenvectors, more.eigenbasis(8).eigenvectors[:, :5])
    before = (tmp_path / files_of(tmp_path)[0]).stat().st_mtime_ns
    load_or_build(VERTICES, FACES, k=8, **cache)
    assert (tmp_path / files_of(tmp_path)[0]).stat().st_mtime_ns == before
    assert len(load_or_build(VERTICES, FACES, k=1000, **cache).eigenbasis(1000).eigenvalues) == 100
    assert len(files_of(tmp_path)) == 1


def test_overwrite_builds_again(tmp_path):
    arguments = {"cache": tmp_path, "operator": "cotangent"}
    load_or_build(VERTICES, FACES, **arguments)
    path = tmp_path / files_of(tmp_path)[0]
    before = path.stat().st_mtime_ns
    load_or_build(VERTICES, FACES, overwrite=True, **arguments)
    assert path.stat().st_mtime_ns > before


def damage(content, kind):
    if kind == "empty":
        return b""
    if kind == "half":
        return content[: len(content) // 2]
    if kind == "without its end":
        return content[:-1]
    if kind == "text":
        return b"no operator"
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 1
    return bytes(flipped)


@pytest.mark.parametrize("kind", ["empty", "half", "without its end", "text", "one bit"])
def test_a_damaged_file_is_named_computed_again_and_replaced(kind, tmp_path):
    arguments = {"cache": tmp_path, "operator": "cotangent"}
    lb = load_or_build(VERTICES, FACES, **arguments)
    path = tmp_path / files_of(tmp_path)[0]
    path.write_bytes(damage(path.read_bytes(), kind))
    with pytest.raises(OperatorFileError, match=path.name):
        load_operator(path)
    with pytest.warns(CacheWarning, match=f"{path.name}.*computed again and replaced"):
        assert_same(load_or_build(VERTICES, FACES, **arguments), lb)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same(load_or_build(VERTICES, FACES, **arguments), lb)
    assert len(files_of(tmp_path)) == 1


def test_no_flipped_bit_gives_other_numbers(tmp_path):
    """At 300 places of a file: it reads as before, or is refused."""
    lb = LaplaceBeltrami.from_cotangent(VERTICES, FACES)
    path = tmp_path / "lb.npz"
    save_operator(lb, path)
    content = path.read_bytes()
    refused = 0
    for place in torch.randint(len(content), (300,)).tolist():
        changed = bytearray(content)
        changed[place] ^= 1 << (place % 8)
        path.write_bytes(bytes(changed))
        try:
            assert_same(load_operator(path), lb)
        except OperatorFileError:
            refused += 1
    assert refused > 200


def test_a_file_under_a_wrong_name_is_not_taken(tmp_path):
    arguments = {"cache": tmp_path, "operator": "cotangent"}
    load_or_build(VERTICES, FACES, **arguments)
    path = tmp_path / files_of(tmp_path)[0]
    other = operator_key(2 * VERTICES, FACES, operator="cotangent")
    path.rename(tmp_path / f"{other}.npz")
    with pytest.warns(CacheWarning, match="another operator"):
        lb = load_or_build(2 * VERTICES, FACES, **arguments)
    assert_same(lb, LaplaceBeltrami.from_cotangent(2 * VERTICES, FACES))


def test_the_file_holds_no_pickle(tmp_path):
    save_operator(LaplaceBeltrami.from_cotangent(VERTICES, FACES), tmp_path / "lb.npz")
    with np.load(tmp_path / "lb.npz", allow_pickle=False) as archive:
        assert all(archive[name].dtype != object for name in archive.files)
        assert json.loads(str(archive["header"]))["state"]["source"] == "cotangent"


def test_a_pickle_is_refused_unopened(tmp_path):
    trap = tmp_path / "opened"

    class Trap:
        def __reduce__(self):
            return (Path.touch, (trap,))

    np.save(tmp_path / "trap.npz", np.array([Trap()], dtype=object), allow_pickle=True)
    (tmp_path / "trap.npz.npy").rename(tmp_path / "trap.npz")
    with pytest.raises(OperatorFileError):
        load_operator(tmp_path / "trap.npz")
    assert not trap.exists()


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torchlb.io.cache.np, "savez", full)
    with pytest.raises(OSError, match="No space left"):
        save_operator(LaplaceBeltrami(), tmp_path / "lb.npz")
    assert files_of(tmp_path) == []


def test_the_file_is_readable_by_whom_the_umask_allows(tmp_path):
    old = os.umask(0o022)
    try:
        save_operator(LaplaceBeltrami(), tmp_path / "lb.npz")
    finally:
        os.umask(old)
    assert (tmp_path / "lb.npz").stat().st_mode & 0o777 == 0o644


def start_writer(path, value, times):
    """Number of a child process that writes an operator of equal values again and again."""
    lb = LaplaceBeltrami()
    lb.stencil.crow = torch.tensor([0, 200_000])
    lb.stencil.values = torch.full((1, 200_000), float(value))
    lb.stencil.col = torch.zeros(200_000, dtype=torch.int64)
    child = os.fork()  # a new interpreter would take seconds to start
    if child == 0:
        code = 1
        try:
            for _ in range(times):
                save_operator(lb, path)
            code = 0
        finally:
            os._exit(code)
    return child


def test_two_processes_writing_one_file_leave_one_good_file(tmp_path):
    path = tmp_path / "lb.npz"
    writers, codes, seen = [start_writer(path, value, 30) for value in (1, 2)], {}, set()
    while len(codes) < 2:
        for writer in set(writers) - codes.keys():
            done, code = os.waitpid(writer, os.WNOHANG)
            codes |= {done: code} if done else {}
        if path.exists():
            values = load_operator(path).stencil.values  # whole at every moment
            assert len(values.unique()) == 1
            seen.add(float(values[0, 0]))
    assert [codes[writer] for writer in writers] == [0, 0]
    assert seen <= {1.0, 2.0}
    assert len(load_operator(path).stencil.values.unique()) == 1
    assert files_of(tmp_path) == ["lb.npz"]


def test_a_writer_killed_in_the_middle_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "lb.npz"
    for _ in range(10):
        writer = start_writer(path, 1, 10_000)
        while not path.exists():
            time.sleep(0.001)
        time.sleep(0.05 * torch.rand(()).item())
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
        assert len(load_operator(path).stencil.values.unique()) == 1
        assert all(name == "lb.npz" or name.endswith(".tmp") for name in files_of(tmp_path))


def test_errors(tmp_path, unchecked):
    with pytest.raises(FileNotFoundError):
        load_operator(tmp_path / "missing.npz")
    with pytest.raises(ValueError, match=r"expected one of .*stencil.*got 'graph'"):
        load_or_build(VERTICES, FACES, cache=tmp_path, operator="graph")
    with pytest.raises(ValueError, match="needs faces"):
        load_or_build(VERTICES, cache=tmp_path, operator="cotangent")
    with pytest.raises(TypeError, match=r"from_mesh has no option dim.*projection"):
        load_or_build(VERTICES, FACES, cache=tmp_path, dim=2)
    with pytest.raises(TypeError, match="from_cotangent has no option order; its options are none"):
        load_or_build(VERTICES, FACES, cache=tmp_path, operator="cotangent", order=3)
    with pytest.raises(ValueError, match="NaN"):
        load_or_build(VERTICES * float("nan"), FACES, cache=tmp_path)
    assert files_of(tmp_path) == []


def read_only(monkeypatch):
    """A folder that nobody may write to, root neither."""

    def refuse(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(torchlb.io.cache, "open", refuse, raising=False)


def test_a_cache_that_cannot_be_written_loses_nothing(tmp_path, monkeypatch):
    """Neither a finished build, nor the eigenpairs that an entry lacks; the file stays as it was."""
    cache = {"cache": tmp_path, "operator": "cotangent"}
    expected = load_or_build(VERTICES, FACES, **cache)
    path = tmp_path / files_of(tmp_path)[0]
    before = path.read_bytes()
    read_only(monkeypatch)
    with pytest.warns(CacheWarning, match=f"{path.name}.*not written.*Permission denied"):
        more = load_or_build(VERTICES, FACES, k=8, **cache)
    assert len(more.eigenbasis(8).eigenvalues) == 8
    assert path.read_bytes() == before
    path.unlink()
    with pytest.warns(CacheWarning, match="not written"):
        assert_same(load_or_build(VERTICES, FACES, **cache), expected)
    assert files_of(tmp_path) == []


def test_a_cache_is_a_folder(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ValueError, match="expected a folder, "):
        load_or_build(VERTICES, FACES, cache=tmp_path / "file", operator="cotangent")


def test_the_home_directory_has_a_short_name(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    lb = load_or_build(VERTICES, FACES, cache="~/operators", operator="cotangent")
    save_operator(lb, "~/one.npz")
    assert_same(load_operator("~/one.npz"), lb)
    assert files_of(tmp_path) == ["one.npz", "operators"]


def of_format_1(path):
    """The file as an older torchlb wrote it: the names of its arrays are not today's."""
    with np.load(path) as archive:
        arrays = dict(archive)
    header = json.loads(str(arrays.pop("header")))
    header |= {"format": 1, "version": "0.0.9", "types": {"dominance": "float32"}}
    np.savez(path, dominance=np.zeros(3), header=np.array(json.dumps(header)))


def test_a_file_of_an_older_format_is_refused_by_name_and_built_again(tmp_path):
    arguments = {"cache": tmp_path, "operator": "cotangent"}
    lb = load_or_build(VERTICES, FACES, **arguments)
    path = tmp_path / files_of(tmp_path)[0]
    of_format_1(path)
    message = r"written by torchlb 0\.0\.9 in format 1, and torchlb .* reads format 4; build"
    with pytest.raises(OperatorFileError, match=message):
        load_operator(path)
    with pytest.warns(CacheWarning, match=f"{message}.*computed again and replaced"):
        assert_same(load_or_build(VERTICES, FACES, **arguments), lb)
    assert_same(load_operator(path), lb)


def test_any_byte_order(tmp_path, no_building):
    first = load_or_build(VERTICES, FACES, cache=tmp_path, order=1)
    no_building()
    vertices, faces = VERTICES.numpy().astype(">f8"), FACES.numpy().astype(">i4")
    assert_same(load_or_build(vertices, faces, cache=tmp_path, order=1), first)


def test_a_file_remembers_the_boundary_condition(tmp_path):
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(150), order=1, condition="dirichlet")
    save_operator(lb, tmp_path / "disk.npz")
    found = load_operator(tmp_path / "disk.npz")
    assert found.condition == "dirichlet"
    assert torch.equal(found.boundary, lb.boundary)
    assert repr(found) == repr(lb)
