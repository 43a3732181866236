"""Draw the pictures of docs/ again, all or those named: python scripts/draw_docs.py [NAME ...] (make pictures).

A picture of the gallery is that of the example of its name. Two are not drawn: accuracy.png is of seconds, and drawn by
`benchmarks/time_to_accuracy.py --plot`; match_bodies.png is of bodies that do not come with torchlb (`--data`).
"""

import importlib
import itertools
import shutil
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "examples"))

import matplotlib.pyplot as plt  # noqa: E402
from _common import LEFT, cortex, save  # noqa: E402
from PIL import Image  # noqa: E402

from torchlb import LaplaceBeltrami  # noqa: E402
from torchlb.plot import plot_orders  # noqa: E402

DOCS, NOT_DRAWN = ROOT / "docs", ("accuracy", "match_bodies")
PICTURES = {path.stem: path for path in sorted(DOCS.rglob("*.png")) if path.stem not in NOT_DRAWN}
BYTES = 120_000  # of a picture in the repository, as tests/test_examples.py has it


def draw_cortex(folder):
    """Where a folded cortex has the full order, and where the pair could curve its edges."""
    from demo import draw_reached

    vertices, faces, name, _ = cortex("pial_left")
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    figure, axes = plt.subplots(1, 2, figsize=(13, 4), layout="constrained")
    title = f"order of the stencil, {name}"
    plot_orders(vertices, faces, lb.report.order, ax=axes[0], title=title, view=LEFT)
    draw_reached(vertices, faces, lb, axes[1], LEFT)
    save(figure, folder, "cortex.png")


def draw_surface(folder):
    """The picture of the demo."""
    import demo

    vertices, faces, name, unit = cortex()
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    demo.draw_surface(vertices, faces, lb, name, unit, folder / "surface.png")


def shrink(path):
    """Give a picture as many colours, and the size, that its bytes allow."""
    picture = Image.open(path).convert("RGB")
    for share, colors in itertools.product((1.0, 0.9, 0.8, 0.7), (256, 128, 64)):
        size = [round(share * side) for side in picture.size]
        kind = Image.Quantize.MAXCOVERAGE  # rare colours, too
        picture.resize(size).quantize(colors, kind, kmeans=2).save(path, optimize=True)
        if path.stat().st_size <= BYTES:
            break


def draw(name, folder):
    """Draw a picture into a folder, as it stands in docs/; returns its path."""
    own = {"cortex": draw_cortex, "surface": draw_surface}
    if name in own:
        own[name](folder)
    else:
        importlib.import_module(name).main(["--output", str(folder)])
    path = folder / f"{name}.png"
    shrink(path)
    return path


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for name in sys.argv[1:] or PICTURES:
            shutil.move(draw(name, Path(folder)), PICTURES[name])
