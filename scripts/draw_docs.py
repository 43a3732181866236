"""Draw docs/surface.png and docs/cortex.png again: python scripts/draw_docs.py (needs torchlb[demo]).

The pictures of the gallery are those that the examples write.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "examples"))

import demo  # noqa: E402
import matplotlib.pyplot as plt  # noqa: E402
from _common import LEFT, cortex  # noqa: E402

from torchlb import LaplaceBeltrami  # noqa: E402
from torchlb.plot import plot_orders  # noqa: E402

vertices, faces, name, unit = cortex()
lb = LaplaceBeltrami.from_mesh(vertices, faces)
demo.draw_surface(vertices, faces, lb, name, unit, ROOT / "docs" / "surface.png")

vertices, faces, name, _ = cortex("pial_left")
lb = LaplaceBeltrami.from_mesh(vertices, faces)
print(lb.report)
figure, axes = plt.subplots(1, 2, figsize=(13, 4), layout="constrained")
title = f"order of the stencil, {name}"
plot_orders(vertices, faces, lb.report.order, ax=axes[0], title=title, view=LEFT)
demo.draw_reached(vertices, faces, lb, axes[1], LEFT)
figure.savefig(ROOT / "docs" / "cortex.png", dpi=90)
