"""Pictures with matplotlib (`pip install ".[plot]"` in a clone).

`figures`: scalars, vectors, orders on a surface or cloud; convergence. `drawing`: projection and the painter's
algorithm. `comparison`: an operator beside the cotangent one, as a table and a picture.
"""

from torchlb.plot.figures import (
    plot_convergence,
    plot_orders,
    plot_points,
    plot_surface,
    plot_vectors,
)

__all__ = ["plot_convergence", "plot_orders", "plot_points", "plot_surface", "plot_vectors"]
