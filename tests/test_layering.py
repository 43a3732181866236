"""The package reads top to bottom: imports point to lower packages, files and functions stay small."""

import ast
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "torchlb"
# Lowest first. `import torchlb` counts as an import of __init__, which stands on all the rest.
ORDER = ["errors", "version", "linalg", "surfaces", "fits", "geometry", "cloud"]
ORDER += ["baseline", "galerkin", "stencils", "certified", "spectral", "operator", "pde", "nn"]
ORDER += ["io", "interop"]
ORDER += ["plot", "__init__", "__main__"]
FILES = sorted(PACKAGE.rglob("*.py"))


def place(file):
    """Package (or module at the top) that a file belongs to."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports_of(file):
    """Full dotted name of everything that a file imports, at its head or inside a function."""
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def own_imports(file):
    """The modules of torchlb that a file imports, as paths below the package without suffix."""
    for name in imports_of(file):
        top, *parts = name.split(".")
        if top == "torchlb":
            while parts and not PACKAGE.joinpath(*parts).with_suffix(".py").exists():
                if PACKAGE.joinpath(*parts, "__init__.py").exists():
                    break
                parts.pop()
            yield tuple(parts or ["__init__"])


def test_every_file_has_its_package_and_every_package_its_files():
    assert {place(file) for file in FILES} == set(ORDER)


def test_at_most_four_files_stand_at_the_top():
    assert len(list(PACKAGE.glob("*.py"))) <= 4


def test_imports_point_to_lower_packages():
    wrong = [
        f"{file.relative_to(PACKAGE)} imports {'.'.join(target)}"
        for file in FILES
        for target in own_imports(file)
        if target[0] != place(file) and ORDER.index(target[0]) > ORDER.index(place(file))
    ]
    assert not wrong


def test_no_cycle_between_files_of_a_package():
    def module(file):
        parts = file.relative_to(PACKAGE).with_suffix("").parts
        return parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts

    arrows = {module(file): set(own_imports(file)) - {module(file)} for file in FILES}
    while arrows:  # take away what imports nothing that is left
        free = [name for name, targets in arrows.items() if not targets & arrows.keys()]
        assert free, f"cycle among {sorted(arrows)}"
        for name in free:
            del arrows[name]


def test_only_baseline_imports_the_libraries_it_wraps():
    wrapped = {"igl": {"baseline"}, "robust_laplacian": set()}
    for library, places in wrapped.items():
        users = {place(f) for f in FILES if library in {n.partition(".")[0] for n in imports_of(f)}}
        assert users == places


def test_a_file_is_at_most_400_lines_and_a_function_60():
    long = [file for file in FILES if len(file.read_text("utf-8").splitlines()) > 400]
    for file in FILES:
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.end_lineno - node.lineno >= 60:
                long.append(f"{file}: {node.name}")
    assert not long


def test_every_package_says_what_its_files_are_for():
    silent = [
        f"{folder.parent.name}: {file.stem}"
        for folder in PACKAGE.glob("*/__init__.py")
        for file in folder.parent.glob("[a-z]*.py")
        if f"`{file.stem}`" not in ast.get_docstring(ast.parse(folder.read_text("utf-8")))
    ]
    assert not silent


def test_import_loads_what_it_needs():
    """What takes long to load, and few calls need, is imported where it is used."""
    late = [
        "trimesh",
        "igl",
        "pyamg",
        "joblib",
        "click",
        "matplotlib",
        "scipy.optimize",
        "torch._dynamo",
        "numba",
        "nibabel",
        "pyvista",
    ]
    program = f"import sys, torchlb; print([name for name in {late} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
