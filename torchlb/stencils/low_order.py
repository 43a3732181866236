"""Low-order rows for points where no stencil passes: P1 elements, stable, and at best of first order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.errors import first_few, warn
from torchlb.galerkin.assembly import Elements, area_element, flat_metric
from torchlb.galerkin.delaunay import delaunay_cover, sound_lengths
from torchlb.galerkin.elements import edge_lengths
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.geometry.vectors import Points
from torchlb.linalg.precision import ROUNDING


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
        return self._flat[3] if "_flat" in vars(self) else []

    @cached_property
    def _flat(self) -> tuple[Int[Tensor, "T corners"], Tensor, Float[Tensor, " T"], list[Tensor]]:
        """Flat cells, the lengths of their edges, the fractions of them that are integrated, and flips."""
        nodes, flips = lagrange_nodes(self.cells, len(self.points), 1), []
        cells = nodes.cells
        lengths = sound_lengths(edge_lengths(self.points, cells), cells)
        shares = torch.ones_like(lengths[:, 0]) if self.shares is None else self.shares
        if nodes.dim == 2:
            free = torch.zeros(len(nodes.edges), dtype=torch.bool)
            cover = delaunay_cover(cells, lengths, nodes.edge, free, self.planned)
            cells, lengths, flips = cover.faces, cover.lengths, cover.flips
            shares = torch.full_like(lengths[:, 0], 0.5)
        return cells, lengths, shares, flips

    @cached_property
    def _mass(self) -> Float[Tensor, " N"]:
        """Lumped masses, none of them zero."""
        cells, lengths, shares, _ = self._flat
        mass = self._in_equal_parts(cells, shares * area_element(flat_metric(lengths)))
        least = ROUNDING * float(mass.detach().mean())
        tiny = (mass < least).nonzero()[:, 0]
        if len(tiny):
            warn(
                f"{len(tiny)} points ({first_few(tiny)}) have next to no area, their triangles are degenerate; "
                f"{ROUNDING:.0e} of the mean is taken, so that rows stay finite"
            )
        return mass.clamp_min(least)

    def _in_equal_parts(self, cells: Tensor, boxes: Float[Tensor, " T"]) -> Float[Tensor, " N"]:
        """Volumes of cells, given those of the parallelotopes on them, in equal shares at their corners."""
        corners = cells.shape[1]
        share = (boxes / factorial(corners)).repeat_interleave(corners)
        return torch.zeros_like(self.points[:, 0]).index_add(0, cells.flatten(), share)

    def rows(
        self, centers: Int[Tensor, " B"]
    ) -> tuple[Int[Tensor, " B"], Int[Tensor, " nnz"], Float[Tensor, " nnz"], Bool[Tensor, " nnz"]]:
        """Rows of Δ, 1/ℓ²: their lengths, columns and entries, and which columns are of the point's own cells.

        The diagonal is among them.
        """
        count, local = len(self.points), torch.full((len(self.points),), -1)
        local[centers] = torch.arange(len(centers))

        def pairs(cells: Int[Tensor, "T corners"]) -> Int[Tensor, " e"]:
            """A number for each pair of a center, or −1, and a corner of the same cell."""
            corners = cells.shape[1]
            row = local[cells].repeat_interleave(corners, 1).flatten()
            return torch.where(row < 0, -1, row * count + cells.repeat(1, corners).flatten())

        around = (local[self._flat[0]] >= 0).any(1)
        cells, lengths, shares = (part[around] for part in self._flat[:3])
        blocks = Elements.flat(cells, lengths, share=shares).matrices().blocks
        mine, own = pairs(cells), pairs(self.cells[(local[self.cells] >= 0).any(1)])
        own = torch.cat([own[own >= 0], torch.arange(len(centers)) * count + centers]).unique()
        key, place = torch.cat([mine[mine >= 0], own]).unique(return_inverse=True)
        values = blocks.real.flatten()[mine >= 0]
        stiffness = values.new_zeros(len(key)).index_add(0, place[: len(values)], values)
        row, beside = key // count, torch.zeros_like(key, dtype=torch.bool)
        beside[place[len(values) :]] = True
        return torch.bincount(row), key % count, -stiffness / self._mass[centers[row]], beside

    def areas(self) -> Float[Tensor, " N"]:
        """Equal shares of the cells around each vertex, ℓ^d, or lumped masses where some are almost zero."""
        points, cells, corners = self.points, self.cells, self.cells.shape[1]
        upper = torch.linalg.qr((points[cells[:, 1:]] - points[cells[:, :1]]).mT).R
        boxes = torch.diagonal(upper, dim1=-2, dim2=-1).prod(-1).abs()
        shares = self._in_equal_parts(cells, boxes if self.shares is None else self.shares * boxes)
        square = edge_lengths(points, cells).amax(1).square().repeat_interleave(corners)
        longest = torch.zeros_like(shares).scatter_reduce(0, cells.flatten(), square, "amax")
        sound = corners != 3 or (shares > ROUNDING * longest).all()
        return shares if sound else self._mass
