"""Training under torchrun on two processes (DDP, gloo): that of one process, and with another shape on each."""

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


TWO_SHAPES = """
import os
import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torchlb.linalg.csr import tensors_of
from torchlb import Diffusion, LaplaceBeltrami
from torchlb.surfaces import Ellipsoid


class Takes(nn.Module):
    def __init__(self):
        super().__init__()
        self.diffusion = Diffusion(3, k=4, init_time=0.1).double()

    def forward(self, x, lb):
        return self.diffusion(x, lb)


class Holds(Takes):
    def __init__(self, lb):
        super().__init__()
        self.lb = lb

    def forward(self, x):
        return super().forward(x, self.lb)


def own_buffers(model):
    modules = model.named_modules()
    return [f"{name}.{b}" for name, m in modules if isinstance(m, LaplaceBeltrami) for b in tensors_of(m)]


dist.init_process_group("gloo")
rank = dist.get_rank()
for sizes in ((60, 90), (60, 60)):  # of the same size, one would be replaced by the other in silence
    vertices, faces = Ellipsoid((1.0, 0.8, 0.6 + 0.2 * rank)).mesh(sizes[rank])
    lb = LaplaceBeltrami.from_cotangent(vertices, faces)
    values, model = lb.stencil.values[0].clone(), Holds(lb)
    DistributedDataParallel._set_params_and_buffers_to_ignore_for_model(model, own_buffers(model))
    held, taken = DistributedDataParallel(model), DistributedDataParallel(Takes())
    for _ in range(2):
        one, other = held(vertices), taken(vertices, lb)
        (one.square().sum() + other.square().sum()).backward()
    assert torch.equal(one, other) and torch.equal(lb.stencil.values[0], values) and torch.equal(lb.points, vertices)
    gradients = [held.module.diffusion.raw_time.grad, taken.module.diffusion.raw_time.grad]
    assert torch.equal(*gradients) and bool((gradients[0] != 0).all())
dist.barrier()
dist.destroy_process_group()
os._exit(0)  # a thread of gloo's that still runs when Python ends would abort the process
"""


def test_each_process_has_a_shape_of_its_own(tmp_path):
    """As an argument, or held by the model and named to DDP: buffers are otherwise those of the first process."""
    script = tmp_path / "two_shapes.py"
    script.write_text(TWO_SHAPES)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", str(script)]
    done = subprocess.run(
        [sys.executable, *torchrun], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
