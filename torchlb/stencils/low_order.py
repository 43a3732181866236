"""Low-order rows for points where no stencil passes: P1 elements, stable, and at best of first order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.errors import first_few, warn
from torchlb.galerkin.assembly import ElementMatrices, Elements, summed
from torchlb.galerkin.delaunay import delaunay_cover, sound_lengths
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.geometry.vectors import Points
from torchlb.linalg.precision import ROUNDING
from torchlb.linalg.sparse import with_diagonal


@dataclass(frozen=True, eq=False)
class MeshLowOrder:
    """P1 elements with lumped mass; on triangles, of the intrinsic Delaunay triangulation (`delaunay_cover`).

    The rows are symmetric and negative semidefinite in the mass, so that the certificate holds for these rows alone;
    those of segments and of triangles are M-matrix rows, too. Where several segments meet, the fluxes balance.
    `planned` are the `flips` of the same shape before it moved, `shares` the fractions of the cells that are
    integrated.
    """

    points: Points
    cells: Int[Tensor, "F corners"]
    planned: list[Tensor] | None = None
    shares: Float[Tensor, " F"] | None = None

    @property
    def flips(self) -> list[Tensor]:
        """Edge flips to the triangulation; none where it was not needed, or for other cells than triangles."""
        return self._elements[2] if "_elements" in vars(self) else []

    def _matrices(self) -> tuple[ElementMatrices, list[Tensor]]:
        """Element matrices K + iM, differentiable in the points, and flips."""
        nodes, flips = lagrange_nodes(self.cells, len(self.points), 1), []
        share = 1.0 if self.shares is None else self.shares
        cells, lengths = nodes.cells, sound_lengths(nodes.lengths(self.points), nodes.cells)
        if nodes.dim == 2:
            free = torch.zeros(len(nodes.edges), dtype=torch.bool)
            cover = delaunay_cover(cells, lengths, nodes.edge, free, self.planned)
            cells, lengths, flips, share = cover.faces, cover.lengths, cover.flips, 0.5
        return Elements.flat(cells, lengths, share=share).matrices(), flips

    @cached_property
    def _elements(self) -> tuple[sparse.csr_array, Float[Tensor, " N"], list[Tensor]]:
        """Rows of Δ, lumped masses, none of them zero, and flips."""
        (cells, blocks), flips = self._matrices()
        pair = summed(blocks.detach(), cells, len(self.points))
        mass = torch.from_numpy(pair.imag.sum(axis=1))
        least = ROUNDING * mass.mean()
        tiny = (mass < least).nonzero()[:, 0]
        if len(tiny):
            warn(
                f"{len(tiny)} points ({first_few(tiny)}) have next to no area, their triangles are degenerate; "
                f"{ROUNDING:.0e} of the mean is taken, so that rows stay finite"
            )
        mass = mass.clamp_min(least)
        strong = pair.real  # with entries that are zero: all points have one pattern
        strong.data /= -mass.numpy().repeat(np.diff(strong.indptr))
        return with_diagonal(strong), mass, flips

    def rows(self, centers: Int[Tensor, " B"]) -> sparse.csr_array:
        """Rows (B, N) of Δ, 1/ℓ²."""
        return sparse.csr_array(self._elements[0][centers.numpy()])

    def entries(self, row: Int[Tensor, " e"], col: Int[Tensor, " e"]) -> Float[Tensor, " e"]:
        """Entries of Δ, 1/ℓ², differentiable in the points."""
        (cells, blocks), _ = self._matrices()
        count, corners = len(self.points), cells.shape[1]
        first, second = cells.repeat_interleave(corners, 1).flatten(), cells.repeat(1, corners)
        mass = blocks.imag.new_zeros(count).index_add(0, first, blocks.imag.flatten())
        mass = mass.clamp_min(ROUNDING * float(mass.detach().mean()))
        key, place = (row * count + col).unique(return_inverse=True)
        ours = first * count + second.flatten()
        where = torch.searchsorted(key, ours).clamp_max(len(key) - 1)
        asked = key[where] == ours
        values = blocks.real.flatten()[asked]
        stiffness = values.new_zeros(len(key)).index_add(0, where[asked], values)
        return -stiffness[place] / mass[row]

    def areas(self) -> Float[Tensor, " N"]:
        """Equal shares of the cells around each vertex, ℓ^d, or lumped masses where some are almost zero."""
        points, cells, corners = self.points, self.cells, self.cells.shape[1]
        upper = torch.linalg.qr((points[cells[:, 1:]] - points[cells[:, :1]]).mT).R
        volume = torch.diagonal(upper, dim1=-2, dim2=-1).prod(-1).abs() / factorial(corners - 1)
        volume = volume if self.shares is None else self.shares * volume
        share = (volume / corners).repeat_interleave(corners)
        shares = torch.zeros_like(points[:, 0]).index_add_(0, cells.flatten(), share)
        lengths = lagrange_nodes(cells, len(points), 1).lengths(points)
        square = lengths.amax(1).square().repeat_interleave(corners)
        longest = torch.zeros_like(shares).scatter_reduce(0, cells.flatten(), square, "amax")
        sound = corners != 3 or (shares > ROUNDING * longest).all()
        return shares if sound else self._elements[1]
