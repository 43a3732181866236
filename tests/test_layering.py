"""The package reads top to bottom: imports point downward, files and functions stay small."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "torchlb"
# Lowest first. `import torchlb` counts as an import of __init__, which stands on all the rest.
ORDER = [
    "version",
    "voronoi",
    "neighbors",
    "polynomials",
    "ladder",
    "weights",
    "tangent",
    "orientation",
    "boundary",
    "sparse",
    "cotangent",
    "fallback",
    "geometry",
    "rows",
    "stencil",
    "checks",
    "report",
    "iterative",
    "certificate",
    "eigenbasis",
    "eigensolver",
    "batching",
    "storage",
    "heat",
    "galerkin",
    "build",
    "laplace_beltrami",
    "spectral",
    "diffusion",
    "diffusion_net",
    "operators",
    "cache",
    "interop",
    "precompute",
    "manifold",
    "surfaces",
    "drawing",
    "plot",
    "comparison",
    "__init__",
    "__main__",
]
FILES = sorted(PACKAGE.rglob("*.py"))
every_file = pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))


def module_of(file):
    """Name in ORDER of the module or subpackage that a file belongs to."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports_of(file):
    """Full dotted name of everything that a file imports, at its head or inside a function."""
    package = ("torchlb", *file.relative_to(PACKAGE).parts[:-1])
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else ()
            parts = (*start, node.module) if node.module else start
            yield from (".".join((*parts, alias.name)) for alias in node.names)


@every_file
def test_every_module_has_its_place_in_the_order(file):
    assert module_of(file) in ORDER


@every_file
def test_imports_point_downward(file):
    own = module_of(file)
    for name in imports_of(file):
        top, _, rest = name.partition(".")
        if top != "torchlb":
            continue
        first = rest.partition(".")[0]
        target = first if first in ORDER else "__init__"
        assert (own, name.split(".")[1]) == ("surfaces", "manifold") or own != "surfaces", name
        inside = target == own and (PACKAGE / own).is_dir()
        assert inside or ORDER.index(target) < ORDER.index(own), f"{own} imports {name}"


@every_file
def test_only_cotangent_imports_the_libraries_it_wraps(file):
    wrapped = {name.partition(".")[0] for name in imports_of(file)} & {"igl", "robust_laplacian"}
    assert not wrapped or module_of(file) == "cotangent"


@every_file
def test_file_is_under_400_lines_and_each_function_under_60(file):
    text = file.read_text("utf-8")
    assert len(text.splitlines()) < 400
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = node.end_lineno - node.lineno + 1
            assert length < 60, f"{node.name} has {length} lines"
