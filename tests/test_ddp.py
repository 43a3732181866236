"""Training under torchrun on two processes (DDP, gloo) is the training of one process."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "train_ddp.py"


def run(launcher, out):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [
            sys.executable,
            *launcher,
            str(EXAMPLE),
            "--output",
            str(out),
            "--points",
            "150",
            "--steps",
            "20",
        ],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_two_processes_give_the_loss_curve_of_one(tmp_path):
    """In float64, to rounding; the two also filled one cache at the same time, from empty."""
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    printed = run(torchrun, tmp_path / "two")
    assert printed.count("loss.png") == 1  # one process speaks
    run([], tmp_path / "one")
    two = json.loads((tmp_path / "two" / "losses_2.json").read_text())
    one = json.loads((tmp_path / "one" / "losses_1.json").read_text())
    assert len(one) == 20
    assert two == pytest.approx(one, rel=1e-9)
    assert one[-1] < one[0] / 5
    assert (tmp_path / "two" / "loss.png").read_bytes().startswith(b"\x89PNG")
    assert len(list((tmp_path / "two" / "cache").iterdir())) == 4
