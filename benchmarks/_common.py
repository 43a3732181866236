"""What the benchmarks share: which peers are there, and the line that says what ran."""

import importlib.metadata
import importlib.util
import platform
from datetime import date

import torch

import torchlb

PACKAGES = {  # peers, and the names they are imported by
    "libigl": "igl",
    "robust_laplacian": "robust_laplacian",
    "pcdiff": "pcdiff",
    "pycompadre": "pycompadre",
}


def installed(package: str) -> bool:
    return importlib.util.find_spec(PACKAGES[package]) is not None


def versions() -> list[str]:
    """Lines on what ran, and notes on peers that did not."""
    found = [f"python {platform.python_version()}", f"torch {torch.__version__}"]
    found += [f"{name} {importlib.metadata.version(name)}" for name in ("numpy", "scipy")]
    found.append(f"torchlb {torchlb.__version__}")
    lines = []
    for package in PACKAGES:
        if installed(package):
            found.append(f"{package} {importlib.metadata.version(package)}")
        else:
            lines.append(f"{package} is not installed; its rows are left out.")
    return [f"{date.today().isoformat()}; {', '.join(found)}.", *lines]
