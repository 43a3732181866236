"""`python -m torchlb`: compute on one shape, precompute a folder of them, see what a file holds.

Exit codes: 0 if all went well, 1 for an error or a shape that failed, 2 for a wrong call. Errors are one message on
stderr, without a traceback.
"""

from __future__ import annotations

import math
import sys
import time
import warnings
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, get_args

import click
from click.core import ParameterSource

from torchlb.errors import InputError, OperatorFileError, TorchlbWarning
from torchlb.fits.rules import WeightsName
from torchlb.geometry.frames import Projection
from torchlb.io.cache import load_with_header
from torchlb.io.files import read_point_data, read_shape, write_shape
from torchlb.io.precompute import precompute_operators
from torchlb.operator.cleaning import clean_mesh, cleaned
from torchlb.operator.dispatch import Operator, build_operator
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.pde import geodesics, heat
from torchlb.plot.comparison import draw_comparison, spectrum_table
from torchlb.version import __version__

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
COUNT = click.IntRange(min=1)
SETTINGS = {"help_option_names": ["-h", "--help"], "show_default": True}
PROJECTION, WEIGHTS = (click.Choice(get_args(names)) for names in (Projection, WeightsName))
OF_THE_OPERATOR: dict[str, tuple[Any, Any, str]] = {
    "order": (COUNT, 3, "Order p of accuracy."),
    "projection": (PROJECTION, "tangent", "Onto the tangent plane, or along the normals."),
    "weights": (WEIGHTS, "least_squares", "How they are found."),
    "certify": (bool, False, "Prove the stencil stable."),
    "clean": (bool, False, "Leave out vertices of no face, and points twice."),
}


class _Commands(click.Group):
    """Commands that report errors as messages."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; an error of the input ends it with a message and code 1."""
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show
                return super().invoke(ctx)
        except (ValueError, TypeError, OSError) as error:
            raise click.ClickException(str(error)) from error


def _show(message: Warning | str, category: type[Warning], *_: Any) -> None:
    if issubclass(category, TorchlbWarning):
        click.echo(f"Warning: {message}", err=True)


def _stencil_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that the commands share."""
    for name, (kind, default, text) in OF_THE_OPERATOR.items():
        add = click.option(f"--{name}", type=kind, is_flag=kind is bool, default=default, help=text)
        command = add(command)
    return command


def _built(shape: Path, settings: dict[str, Any]) -> tuple[LaplaceBeltrami, Any]:
    """Build the operator of the shape in a file and return it with its faces; its options leave the settings."""
    vertices, faces = read_shape(shape)
    options = {name: settings.pop(name) for name in OF_THE_OPERATOR}
    if options.pop("clean"):
        vertices, faces = cleaned(vertices, faces)
    return build_operator(vertices, faces, **options), faces


def _stability(lb: LaplaceBeltrami) -> str:
    """What is known of an operator's stability."""
    pair = "stable: symmetric, positive by its weak pair" if lb._has_weak_form else None
    return "\n".join(str(known) for known in (pair, lb.certificate) if known) or "no certificate"


@click.group(cls=_Commands, context_settings=SETTINGS)
@click.version_option(__version__, prog_name="torchlb")
def main() -> None:
    """High-order Laplace–Beltrami operators on meshes and point clouds.

    \b
    Examples:
      python -m torchlb compare bunny.ply
      python -m torchlb smooth lh.pial --data lh.thickness --missing 0 --fwhm 10 --out smooth.func.gii
      python -m torchlb precompute shapes/ --out operators/ -k 128
      python -m torchlb info operators/0a1b….npz
    """


@main.command()
@click.argument("mesh", type=FILE)
@click.option("-k", type=COUNT, default=20, help="Number of eigenvalues.")
@click.option("--out", type=click.Path(path_type=Path), help="Picture; else MESH_compare.png.")
@_stencil_options
def compare(mesh: Path, k: int, out: Path | None, **settings: Any) -> None:
    """Report, stability and spectrum of MESH beside the cotangent operator's, and a picture.

    MESH is a mesh or a cloud, in any format of `read_shape`. A cloud has no cotangent operator.

    \b
    Examples:
      python -m torchlb compare bunny.ply
      python -m torchlb compare scan.xyz --order 2 -k 50 --out scan.png
    """
    start, order = time.perf_counter(), settings["order"]
    lb, faces = _built(mesh, settings)
    click.echo(f"{mesh.name}: {_size(lb.points, faces)}\n{lb}")
    click.echo(f"built in {time.perf_counter() - start:.1f} s\n\n{lb.report}\n{_stability(lb)}\n")
    operators = {"torchlb": lb}
    if faces is not None:
        try:
            operators["cotangent"] = LaplaceBeltrami.from_cotangent(lb.points, faces)
        except ValueError as error:
            click.echo(f"no cotangent operator to compare with: {error}", err=True)
    values = {name: lb.eigenbasis(k).eigenvalues.double() for name, lb in operators.items()}
    click.echo(f"smallest eigenvalues of −Δ, 1/length²\n{spectrum_table(values)}")
    out = out or Path(f"{mesh.stem}_compare.png")
    try:
        draw_comparison(lb, faces, values, out, f"{mesh.name}, order {order} requested")
    except ImportError as error:
        click.echo(f'no picture: {error}; pip install ".[plot]" in a clone', err=True)
    else:
        click.echo(f"\n{out}")


@main.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--out", type=click.Path(file_okay=False), required=True, help="Cache to fill.")
@click.option("--operator", type=click.Choice(get_args(Operator)), default="stencil")
@click.option("-k", type=click.IntRange(min=0), default=0, help="Eigenpairs.")
@click.option("--workers", type=int, default=-1, help="Processes; -1: all cores.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
@_stencil_options
def precompute(folder: Path, out: str, operator: Operator, quiet: bool, **settings: Any) -> None:
    """Compute the operators of all shapes in FOLDER and store them, each once.

    What is in the cache is left as it is: after an interruption, give the same command again. A shape that fails stops
    no other; a table at the end, and precompute.csv in the cache, say which and why, and the exit code is 1 then.

    \b
    Examples:
      python -m torchlb precompute shapes/ --out operators/
      python -m torchlb precompute shapes/ --out operators/ --order 5 -k 128 --workers 8 --clean
    """
    if operator == "cotangent":
        context = click.get_current_context()
        for name in OF_THE_OPERATOR.keys() - {"clean"}:
            del settings[name]
            if context.get_parameter_source(name) != ParameterSource.DEFAULT:
                raise click.UsageError(f"the cotangent operator has no --{name}")
    report = precompute_operators(folder, out, operator=operator, progress=not quiet, **settings)
    click.echo(str(report))
    if report.failed:
        sys.exit(1)


@main.command()
@click.argument("file", type=FILE)
def info(file: Path) -> None:
    """What FILE holds: an operator of a cache, or a shape. It is read in full, so damage is found.

    \b
    Examples:
      python -m torchlb info operators/0a1b….npz
      python -m torchlb info bunny.ply
    """
    try:
        lb, header = load_with_header(file)
    except OperatorFileError:
        vertices, faces = read_shape(file)
        low, high = vertices.amin(0), vertices.amax(0)
        box = " × ".join(f"{side:.4g}" for side in (high - low).tolist())
        click.echo(f"{file.name}: {_size(vertices, faces)}, box {box}")
        if faces is not None:
            loose = len(vertices) - len(clean_mesh(vertices, faces)[2])
            click.echo(f"{loose} vertices belong to no face with distinct corners")
        return
    click.echo(f"{lb}\n\n{lb.report}\n{_stability(lb)}")
    click.echo(f"{lb.modes.left.shape[-1]} eigenpairs stored")
    click.echo(f"{file.stat().st_size / 1e6:.1f} MB, written by torchlb {header['version']}")


def _to_file(compute: Callable[..., dict[str, Any]]) -> Callable[..., None]:
    """A command that writes SHAPE with what is computed of its operator, as data of the points."""

    @main.command()
    @_stencil_options
    @click.option("--out", type=click.Path(path_type=Path), required=True, help="Where to write.")
    @click.argument("shape", type=FILE)
    @wraps(compute)
    def run(shape: Path, out: Path, **settings: Any) -> None:
        lb, faces = _built(shape, settings)
        found = compute(lb, **settings)
        taken = found.keys() & {"path", "points", "cells"}
        if taken:
            raise InputError(f"{', '.join(taken)}: rename these data, a shape has parts so named")
        write_shape(out, lb.points, lb.faces, **found)
        click.echo(f"{out}: {_size(lb.points, faces)}")

    return run


@_to_file
@click.option("-k", type=COUNT, default=20, help="Number of eigenpairs.")
def modes(lb: LaplaceBeltrami, k: int) -> dict[str, Any]:
    """Write the eigenfunctions of SHAPE, orthonormal in the mass, and print the eigenvalues of −Δ."""
    basis = lb.eigenbasis(k)
    click.echo(" ".join(f"{value:.6g}" for value in basis.eigenvalues.tolist()))
    return {"modes": basis.eigenvectors}


@_to_file
@click.option("--data", type=FILE, required=True, help="Maps, as read_point_data reads them.")
@click.option("--fwhm", type=float, required=True, help="Full width at half maximum.")
@click.option("--missing", type=float, default=math.nan, help="Value of points without data.")
def smooth(lb: LaplaceBeltrami, data: Path, fwhm: float, missing: float) -> dict[str, Any]:
    """Write maps on SHAPE smoothed by a Gaussian; points without data count nothing and become NaN."""
    smoothed = {}
    for name, f in read_point_data(data).items():
        columns = f.double().reshape(len(f), -1)
        known = columns.isfinite() & (columns != missing)
        masks, which = known.unique(dim=1, return_inverse=True)
        for number, mask in enumerate(masks.unbind(1)):  # columns with the same gaps at once
            here = which == number
            columns[:, here] = heat.smooth(lb, columns[:, here], fwhm, mask=mask)
        smoothed[name] = columns.view_as(f)
    return smoothed


@_to_file
@click.option("--source", type=int, multiple=True, required=True, help="Point; again for more.")
@click.option("--each", is_flag=True, help="A column for each source, not the nearest of them.")
def distance(lb: LaplaceBeltrami, source: tuple[int, ...], each: bool) -> dict[str, Any]:
    """Write the geodesic distance on SHAPE to points."""
    return {"distance": geodesics.geodesic_distance(lb, source, each=each)}


@_to_file
def curvature(lb: LaplaceBeltrami) -> dict[str, Any]:
    """Write the principal, mean and Gaussian curvatures of SHAPE."""
    found = lb.curvatures()
    return {name: getattr(found, name) for name in ("k1", "k2", "mean", "gaussian")}


def _size(vertices: Any, faces: Any) -> str:
    cells = "a cloud" if faces is None else f"{len(faces)} faces"
    return f"{len(vertices)} points in R^{vertices.shape[1]}, {cells}"


if __name__ == "__main__":
    main(prog_name="python -m torchlb")
