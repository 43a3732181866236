"""What the benchmarks share: which peers are there, and the line that says what ran."""

import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import torch

import torchlb

PACKAGES = {  # peers, and the names they are imported by
    "libigl": "igl",
    "robust_laplacian": "robust_laplacian",
    "pcdiff": "pcdiff",
    "pycompadre": "pycompadre",
    "lapy": "lapy",
    "potpourri3d": "potpourri3d",
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


def peak() -> float:
    """MiB of memory that this process has had at most; Linux tells."""
    status = Path("/proc/self/status").read_text()
    return (
        int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])
        / 2**10
    )


def alone(script: str, arguments: Sequence[str], threads: int = 1) -> Any:
    """What a script prints last, as JSON, from a process of its own with so many threads."""
    numbers = {f"{library}_NUM_THREADS": str(threads) for library in ("OMP", "MKL", "OPENBLAS")}
    done = subprocess.run(
        [sys.executable, script, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=os.environ | numbers,
    )
    return json.loads(done.stdout.splitlines()[-1])
