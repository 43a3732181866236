"""Every page's code runs, every quoted message is one that torchlb gives, and the site builds without a network."""

import ast
import re
import runpy
import subprocess
import sys
import warnings
from functools import cache
from importlib.metadata import metadata
from pathlib import Path

import pytest
import torch
import trimesh

import torchlb
from torchlb import DiffusionNet, LaplaceBeltrami
from torchlb.surfaces import Circle, Sphere, UnitDisk

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
CODE = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
CALLED = re.compile(r"(?<![\w−])([A-Za-z_][\w.]*)\(")
WITH_CODE = [page for page in PAGES if CODE.search(page.read_text("utf-8"))]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_code_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch, capsys):
    """So does what a user may write instead, `# or: `; a comment calls what there is, and `# → ` is printed."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    text = page.read_text("utf-8")
    trimesh.Trimesh(VERTICES.numpy(), FACES.numpy(), process=False).export("my.ply")
    for found in CODE.finditer(text):
        line = text.count("\n", 0, found.start()) + 1
        shown = re.sub(r"^# (yours|or): ", "", found.group(1), flags=re.MULTILINE)
        code = compile("\n" * line + shown, str(page), "exec")
        exec(code, names)
        for comment in re.findall(r"#(.*)$", shown, re.MULTILINE):
            for called in CALLED.findall(comment):
                assert callable(eval(called, names)), comment
    printed = capsys.readouterr().out
    for output in re.findall(r"# → (.*)$", text, re.MULTILINE):
        assert output in printed
        printed = printed[printed.index(output) + len(output) :]


def test_what_a_user_may_write_instead_is_shown():
    """README's first lines of code, after its own imports alone; `torchlb.interop` needs no import of its own."""
    first = CODE.search(PAGES[0].read_text("utf-8")).group(1)
    assert '\n# yours: vertices, faces = read_shape("my.ply")' in first
    program = "import torchlb; print(torchlb.interop.trimesh.to_trimesh, torchlb.plot.plot_surface)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.count("function") == 2, done.stderr


def test_pages_with_code_are_found():
    names = {page.name for page in WITH_CODE}
    assert names >= {"README.md", "index.md", "from_diffusion_net.md", "choosing.md"}
    assert names >= {"troubleshooting.md", "precompute.md", "other_libraries.md", "conventions.md"}


VERTICES, FACES = Sphere().mesh(60)
NAN = VERTICES.clone()
NAN[3, 1] = float("nan")
GRID = torch.arange(100).view(10, 10)


def unstable():
    lb = LaplaceBeltrami.from_points(VERTICES, order=1, certify=True)
    fields = {**vars(lb.certificate), "holds": False}
    lb.certificate = torchlb.Certificate(**fields)
    raise ValueError(repr(lb))


def damaged():
    Path("shape.obj").write_text("nothing")
    torchlb.load_operator("shape.obj")


def circle_network():
    lb = LaplaceBeltrami.from_points(Circle().points(30).float(), order=1)
    DiffusionNet(2, 1, width=4, num_blocks=1, k=4)(torch.zeros(30, 2), lb)


def derivative_of_a_lone_corner():
    corner = int(FACES[FACES[:, 0] == 0][0, 1])
    faces = torch.cat([FACES, torch.tensor([[0, len(VERTICES), corner]])])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        x = torch.cat([VERTICES, VERTICES[:1]]).requires_grad_()
        lb = LaplaceBeltrami.from_mesh(x, faces)
    lb.eigenbasis(4).eigenvalues.sum().backward()


# By the beginning of the heading: what gives the message.
TRIGGERS = {
    "… vertices (…) belong": lambda: LaplaceBeltrami.from_mesh(
        torch.cat([VERTICES, VERTICES[:1] + 5]), FACES
    ),
    "… points share": lambda: LaplaceBeltrami.from_points(torch.cat([VERTICES, VERTICES[:2]])),
    "… are NaN": lambda: LaplaceBeltrami.from_points(NAN),
    "…: they require": lambda: LaplaceBeltrami.from_cotangent(
        VERTICES.clone().requires_grad_(), FACES
    ),
    "points: they require": lambda: LaplaceBeltrami.from_points(
        VERTICES.clone().requires_grad_(), weak_form=False
    ),
    "points or medium: the derivative": lambda: derivative_of_a_lone_corner(),
    "…: no derivative in": lambda: (
        (LaplaceBeltrami.from_points(VERTICES.clone().requires_grad_()).stiffness @ VERTICES)
        .sum()
        .backward()
    ),
    "normals: the signs": lambda: LaplaceBeltrami.from_points(
        VERTICES, normals=VERTICES * torch.tensor([1.0, -1.0]).repeat(30)[:, None], order=1
    ),
    "normals: … face": lambda: LaplaceBeltrami.from_points(
        VERTICES, normals=torch.cat([-VERTICES[:1], VERTICES[1:]]), order=1
    ),
    "… have indices": lambda: LaplaceBeltrami.from_mesh(VERTICES, FACES + 1),
    "… these look like quads": lambda: LaplaceBeltrami.from_mesh(
        torch.rand(100, 3), GRID[:-1, :-1].reshape(-1, 1) + torch.tensor([0, 1, 11, 10])
    ),
    "… have the corners": lambda: LaplaceBeltrami.from_mesh(
        VERTICES, torch.cat([FACES, FACES[:1]])
    ),
    "… are wound": lambda: LaplaceBeltrami.from_mesh(
        VERTICES, torch.cat([FACES[:1].flip(1), FACES[1:]])
    ),
    "… are taken for": lambda: LaplaceBeltrami.from_points(torch.rand(400, 2)),
    "… float32 has": lambda: LaplaceBeltrami.from_points((VERTICES + 1e6).float()),
    "… points are fewer": lambda: LaplaceBeltrami.from_points(VERTICES[:3]),
    "the cloud is too": lambda: LaplaceBeltrami.from_points(
        Sphere().points(800) + 0.06 * torch.randn(800, 3, generator=torch.manual_seed(0)).double()
    ),
    "… spacings and": lambda: LaplaceBeltrami.from_points(
        torch.cat([Sphere().points(600), torch.tensor([[9.0, 0.0, 0.0]]).double()])
    ),
    "all … lie on": lambda: LaplaceBeltrami.from_points(VERTICES[:1] * torch.arange(9.0)[:, None]),
    "num_neighbors:": lambda: LaplaceBeltrami.from_points(VERTICES, num_neighbors=4),
    "NOT STABLE": unstable,
    "… this operator has": lambda: (
        LaplaceBeltrami.from_mesh(VERTICES, FACES, order=1, weak_form=False).stiffness
    ),
    "boundary_values: no": lambda: torchlb.poisson_solve(
        LaplaceBeltrami.from_mesh(*UnitDisk().mesh(100)), torch.zeros(100), boundary_values=1.0
    ),
    "boundary_values: the": lambda: torchlb.poisson_solve(
        LaplaceBeltrami.from_mesh(VERTICES, FACES), 0 * VERTICES[:, 0], boundary_values=1.0
    ),
    "f: expected finite": lambda: torchlb.heat_flow(
        LaplaceBeltrami.from_mesh(VERTICES, FACES), torch.nan * VERTICES[:, 0], 0.1
    ),
    "…: not a mesh": lambda: (
        Path("shape.obj").write_text("nothing"),
        torchlb.interop.trimesh.read_shape("shape.obj"),
    ),
    "…: not an operator": damaged,
    "… has no option": lambda: torchlb.load_or_build(VERTICES, FACES, cache=".", dim=2),
    "expected f of shape": lambda: LaplaceBeltrami.from_mesh(VERTICES, FACES, order=1)(
        torch.zeros(5, 2)
    ),
    "rotations need": circle_network,
}


def quoted_messages():
    text = (ROOT / "docs" / "troubleshooting.md").read_text("utf-8")
    return re.findall(r"^### `(.*)`$", text, re.MULTILINE)


def text_of(node, named):
    """The words of a string in the source, and … for what varies; `named` has the strings of variables."""
    match node:
        case ast.Constant(value=str(words)):
            return words
        case ast.JoinedStr(values=parts):
            return "".join(text_of(part, named) for part in parts)
        case ast.FormattedValue(value=ast.Name(id=name)) | ast.Name(id=name):
            return named.get(name, "…")
        case _:
            return "…"


@cache
def messages(calls):
    """Texts of the first arguments of what is called `calls` in the package, by file and line."""
    found = {}
    source = ROOT / "torchlb"
    for path in sorted({*source.rglob("*.py")} - {source / "errors.py"}):  # which has `warn`
        tree = ast.parse(path.read_text("utf-8"))
        named = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                named[node.targets[0].id] = text_of(node.value, {})
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Call)
                and node.args
                and re.search(calls, ast.unparse(node.func))
            ):
                found[f"{path.relative_to(source)}:{node.lineno}"] = text_of(node.args[0], named)
    return found


def says(text, message):
    return all(words.strip() in text for words in message.split("…"))


def test_every_warning_is_explained():
    unexplained = {
        place: text
        for place, text in messages(r"\bwarn$").items()
        if not any(says(text, message) for message in quoted_messages())
    }
    assert not unexplained


@pytest.mark.parametrize("message", quoted_messages())
def test_a_quoted_message_is_one_that_comes(message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    triggers = [call for start, call in TRIGGERS.items() if message.startswith(start)]
    if not triggers:  # hard to provoke on purpose
        assert any(says(text, message) for text in messages(r"\bwarn$|Error$").values())
        return
    pattern = ".*".join(re.escape(part) for part in message.split("…"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", torchlb.StabilityWarning)
        warnings.filterwarnings("error", "(faces|points|vertices|normals|batch): ")
        with pytest.raises((ValueError, TypeError, RuntimeError, UserWarning)) as caught:
            triggers[0]()
    assert re.search(pattern, str(caught.value), re.DOTALL), str(caught.value)


def test_the_table_of_numbers_is_that_of_the_source():
    """As `python scripts/write_numbers.py` writes it, which fails for a number without a docstring."""
    script = runpy.run_path(str(ROOT / "scripts" / "write_numbers.py"))
    page = script["PAGE"].read_text("utf-8")
    assert script["with_table"](page) == page
    assert page.count("| `linalg.precision`: `LOW` | `0.1` |") == 1


def test_every_public_name_is_in_the_reference():
    text = "".join(path.read_text("utf-8") for path in (ROOT / "docs" / "api").glob("*.md"))
    listed = set(re.findall(r"^::: torchlb\.([\w.]+)$", text, re.MULTILINE))
    assert set(torchlb.__all__) - {"__version__"} <= listed
    modules = {f"interop.{p.stem}" for p in (ROOT / "torchlb" / "interop").glob("[a-z]*.py")}
    assert modules <= listed


def test_every_extra_is_described():
    page = (ROOT / "docs" / "install.md").read_text("utf-8")
    extras = metadata("torchlb").get_all("Provides-Extra")
    assert extras
    assert [name for name in extras if f"| `{name}` |" not in page] == []


def test_the_site_builds_without_a_network(tmp_path):
    """Strictly: every link and every name leads somewhere. No page asks another host for anything."""
    blocked = "import socket; socket.socket.connect = None; socket.getaddrinfo = None\n"
    run = f"{blocked}from mkdocs.__main__ import cli; cli(['build', '--strict', '-d', {str(tmp_path)!r}])"
    done = subprocess.run(
        [sys.executable, "-c", run], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 10
    for page in pages:
        html = page.read_text("utf-8")
        fetched = re.findall(r'<(?:script|img|iframe)[^>]+src="(https?:[^"]+)"', html)
        fetched += re.findall(r'<link[^>]+rel="stylesheet"[^>]+href="(https?:[^"]+)"', html)
        assert not fetched, (page.name, fetched)
    reference = (tmp_path / "api" / "operators.html").read_text("utf-8")
    assert "from_points" in reference
    assert 'id="torchlb.LaplaceBeltrami.eigenbasis"' in reference  # of a base class
    assert "Raises" in reference
