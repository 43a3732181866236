"""A body deformed to a given spectrum, by three operators: python benchmarks/isospectralization.py [--steps 150]

The first 30 eigenvalues of a star-shaped surface are given, and an ellipsoid is deformed until it has them: LBFGS on
Σ (log λ_k − log λ*_k)², over 49 spherical harmonics times three coordinates, on 1,500 vertices. The operators are
linear elements with lumped (the cotangent Laplacian) and with consistent mass, and the pair of order 3.

The deformed surface is one of directions, smooth and known everywhere. It is measured on nested meshes of it, and so
is the target, by libigl's cotangent Laplacian with Voronoi areas and scipy's eigenvalues: on 16 times the vertices, and
extrapolated from 4 and 16 times. Subdividing the deformed mesh instead would measure another surface, that through its
limit points, and its distance from this one would count as error of the operator that found it.

Given are either the exact eigenvalues of the target, extrapolated, as if they had been heard, or those that the same
operator has on a mesh of the target with the same vertices. The second is kind to an operator: of its errors there
only the difference between the two bodies is left.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import igl
import torch
from _common import versions
from scipy.sparse import coo_array
from scipy.sparse.linalg import eigsh
from torch import Tensor

from torchlb import LaplaceBeltrami
from torchlb.surfaces import Sphere, StarShaped, spherical_harmonic

K = 30
AXES = (1.15, 1.0, 0.85)


def harmonics(u: Tensor) -> Tensor:
    """Y_l^m / (1 + l) for l ≤ 6 at directions: (N, 49)."""
    terms = [(n, m) for n in range(7) for m in range(-n, n + 1)]
    return torch.stack([spherical_harmonic(n, m)(u) / (1 + n) for n, m in terms], 1)


def refined(u: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Every triangle of a mesh of directions in four."""
    points, corners = (torch.from_numpy(a) for a in igl.upsample(u.numpy(), faces.numpy()))
    return torch.nn.functional.normalize(points), corners.long()


def flat_normals(x: Tensor, faces: Tensor) -> Tensor:
    """Normals of triangles, twice as long as their areas."""
    a, b, c = x[faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)


def linear(x: Tensor, faces: Tensor, lumped: bool) -> Tensor:
    """Eigenvalues 1 to K of linear elements: Rayleigh quotients of fixed vectors, whose derivatives are exact."""
    area = flat_normals(x, faces).norm(dim=1) / 2
    corner = x[faces]
    edge = corner.roll(-1, 1) - corner.roll(1, 1)  # opposite to the corner
    stiffness = (edge @ edge.mT) / (4 * area[:, None, None])
    share = torch.eye(3).double() * 4 if lumped else torch.eye(3).double() + 1
    mass = area[:, None, None] / 12 * share

    def assembled(blocks: Tensor) -> coo_array:
        row, col = (faces.repeat_interleave(3, 1), faces.repeat(1, 3))
        entries = blocks.detach().numpy().ravel(), (row.numpy().ravel(), col.numpy().ravel())
        return coo_array(entries, shape=(len(x), len(x))).tocsc()

    vectors = eigsh(assembled(stiffness), K + 1, assembled(mass), sigma=-0.01)[1][:, 1:]
    v = torch.from_numpy(vectors)[faces]
    quotients = [torch.einsum("fik,fij,fjk->k", v, blocks, v) for blocks in (stiffness, mass)]
    return quotients[0] / quotients[1]


def measured(x: Tensor, faces: Tensor) -> Tensor:
    """Eigenvalues 1 to K of libigl's cotangent Laplacian."""
    points, corners = x.numpy(), faces.numpy()
    stiffness = -igl.cotmatrix(points, corners)
    mass = igl.massmatrix(points, corners, igl.MASSMATRIX_TYPE_VORONOI)
    return torch.from_numpy(eigsh(stiffness, K + 1, mass, sigma=-0.01)[0][1:])


def misfit(values: Tensor, others: Tensor) -> Tensor:
    return (values.log() - others.log()).square().sum()


def descend(
    values: Callable[[Tensor], Tensor], x: Tensor, fields: Tensor, given: Tensor, steps: int
) -> tuple[Tensor, list[float]]:
    """Coefficients of the displacement, and the loss at every evaluation."""
    moves = torch.zeros(fields.shape[1], 3, dtype=torch.float64, requires_grad=True)
    losses: list[float] = []
    optimizer = torch.optim.LBFGS(
        [moves],
        max_iter=steps,
        tolerance_grad=1e-12,
        tolerance_change=1e-16,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = misfit(values(x + fields @ moves), given)
        loss.backward()
        losses.append(loss.item())
        return loss

    optimizer.step(closure)
    return moves.detach(), losses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=150, help="of LBFGS")
    parser.add_argument("--points", type=int, default=1500, help="vertices of the body")
    options = parser.parse_args()
    torch.set_num_threads(1)
    axes, target = torch.tensor(AXES).double(), StarShaped(0.2).retract
    u, faces = Sphere().mesh(options.points)
    four = refined(u, faces)
    sixteen = refined(*four)

    def heard(surface: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Eigenvalues of a surface of directions on 16 times the vertices, and extrapolated."""
        coarse, fine = (measured(surface(v), corners) for v, corners in (four, sixteen))
        return fine, fine + (fine - coarse) / 3

    lb = LaplaceBeltrami.from_mesh(u * axes, faces)
    operators = {
        "linear elements, lumped mass": lambda x: linear(x, faces, lumped=True),
        "linear elements, consistent mass": lambda x: linear(x, faces, lumped=False),
        "weak pair, p = 3": lambda x: lb.at(x).eigenbasis(K + 1, tolerance=1e-10).eigenvalues[1:],
    }
    fine, exact = heard(target)
    before = heard(lambda v: v * axes)
    print("\n".join(versions()), end="\n\n")
    print(
        f"N = {len(u)}, {options.steps} steps; before them, measured: {misfit(before[0], fine):.1e}, "
        f"{misfit(before[1], exact):.1e}.",
        end="\n\n",
    )
    print(
        "| given | operator | own loss, before | after | measured, 16 N | extrapolated "
        "| flipped | smallest area | evaluations | s |"
    )
    print("|:--|:--|--:|--:|--:|--:|--:|--:|--:|--:|", flush=True)
    fields = harmonics(u)
    for kind in ("exact", "its own"):
        for name, values in operators.items():
            given = exact if kind == "exact" else values(target(u)).detach()
            start = time.process_time()
            moves, losses = descend(values, u * axes, fields, given, options.steps)
            seconds = time.process_time() - start
            found = heard(lambda v, c=moves: v * axes + harmonics(v) @ c)
            x = u * axes + fields @ moves
            flat = flat_normals(x, faces)
            spread = flat.repeat_interleave(3, 0)
            around = torch.zeros_like(x).index_add_(0, faces.flatten(), spread)[faces].sum(1)
            areas = flat.norm(dim=1)
            figures = losses[0], min(losses), misfit(found[0], fine), misfit(found[1], exact)
            cells = [kind, name, *(f"{float(a):.1e}" for a in figures)]
            cells += [str(int(((around * flat).sum(1) <= 0).sum()))]
            cells += [
                f"{float(areas.min() / areas.mean()):.2f}",
                str(len(losses)),
                f"{seconds:.0f}",
            ]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
