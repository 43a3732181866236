"""PyTorch Geometric (`pip install ".[pyg]"` in a clone): operators as keys of its `Data`, which its loaders batch.

Build the operators once; loaders then batch them::

    transform = LaplaceBeltramiTransform(order=3, k=64, cache="operators")
    for batch in torch_geometric.loader.DataLoader([transform(data) for data in shapes], batch_size=8):
        lb = to_operator(batch)  # block diagonal: every layer of torchlb takes it
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn.functional import pad

try:
    from torch_geometric.data import Batch, Data
    from torch_geometric.data.datapipes import functional_transform
    from torch_geometric.transforms import BaseTransform
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"torchlb.interop.pyg needs PyTorch Geometric, pip install torch_geometric ({error})",
        name=error.name,
    ) from error

from torchlb.errors import InputError, TorchlbError, first_few, shown, warn
from torchlb.galerkin.matrices import PairMatrices
from torchlb.io.cache import load_or_build
from torchlb.linalg.csr import Csr
from torchlb.operator.batching import join_states
from torchlb.operator.dispatch import Operator, build_operator
from torchlb.operator.inputs import warn_of_gradients
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.parts import BASIS
from torchlb.spectral.eigenbasis import Eigenbasis, stack_eigenbases
from torchlb.stencils.conditions import kind_of

__all__ = ["LaplaceBeltramiTransform", "to_operator"]

KEPT = ("mass", "frames", "normals", "_shape_operators")
"""Attributes of the operator that are keys as they are; the last two of hypersurfaces alone."""


@functional_transform("laplace_beltrami")
class LaplaceBeltramiTransform(BaseTransform):
    """Add the Laplace–Beltrami operator of a shape to its `Data`, under keys that PyG batches correctly.

    =================  ===========  ============================================================================
    key                shape        what
    =================  ===========  ============================================================================
    lb_stencil_index   (2, nnz)     [j; i] of every entry Δ_ij: messages flow j → i, as in `edge_index`
    lb_stencil_values  (nnz, 1 + d) Δ_ij, 1/ℓ², and tangential derivatives in the frame of i, 1/ℓ: of the first column w
                                    ``propagate(data.lb_stencil_index, x=f, edge_weight=w)`` is Δf
    lb_order_t         (nnz,)       the entries sorted by column, within the shape: the transpose, for the backward pass
    lb_mass            (N,)         quadrature weights, ℓ^d
    lb_frames          (N, n, d)    orthonormal tangent vectors
    lb_pos             (N, n)       the points, by which `to_operator` detects a change of `pos`
    lb_normals         (N, n)       unit normals of a hypersurface
    lb_shape_operators (N, d, d)    its curvatures, 1/ℓ, in the frames
    lb_face_index      (d + 1, F)   faces of the mesh, or of the surface through the cloud; F = 0 for other clouds
    lb_boundary        (N,)         mask of the points where the boundary condition holds; all False on a closed shape
    lb_weak_index      (2, nnz)     [j; i] of every entry of the weak pair, none where there is no pair
    lb_weak_values     (nnz, 3)     stiffness, mass matrix, boundary mass matrix; (nnz, 4) with Robin's term
    lb_linear_…                     the same for P1 elements
    lb_basis, _size    (…,), (1,)   with k > 0: all parts of the eigenbasis in one vector, and the number of pairs
    lb_nodes, lb_first (N,), (1,)   lb_first, lb_first + 1, …, which reveal a permutation of the nodes, from a checksum
    lb_info            str          source, options, certificate, radius as JSON
    =================  ===========  ============================================================================

    Every key has a last or first axis that concatenates, and those whose names contain "index" are shifted by the
    number of nodes; nothing depends on a subclass of `Data`. The report is left out. A translation of `pos` changes
    nothing; rotation, scaling, jitter and sampling belong before the transform.

    Parameters
    ----------
    operator, k
        "stencil" or "cotangent"; number of eigenpairs for spectral layers, 0 for none, which
        `to_operator(batch).eigenbasis` would solve anew.
    cache
        Folder, so that each shape is computed once (`load_or_build`); None to compute at every call.
    normals
        Key, or keys of which the first present one is used, of the normals that orient a cloud (PyG's own transforms
        write "norm" or "normal"); None to ignore them. Missing normals are estimated.
    on_error
        "raise", or "skip": a warning says why a shape has no operator, and its data are returned without the keys, so
        that ``[d for d in map(transform, shapes) if "lb_info" in d]`` keeps the others.
    **options
        Options of `LaplaceBeltrami.from_mesh` (for data with `face`) or `from_points` (without).

    A call raises ValueError for data without `pos`, and for bad shapes. `FaceToEdge` drops `face`, which makes the
    shape a cloud; a warning says so where there are no normals either.
    """

    def __init__(
        self,
        *,
        operator: Operator = "stencil",
        k: int = 0,
        cache: str | Path | None = None,
        normals: str | Sequence[str] | None = ("norm", "normal"),
        on_error: Literal["raise", "skip"] = "raise",
        **options: Any,
    ) -> None:
        if on_error not in ("raise", "skip"):
            raise InputError(f"on_error: expected 'raise' or 'skip', got {on_error!r}")
        self.operator, self.k, self.cache, self.on_error = operator, k, cache, on_error
        self.normals = (normals,) if isinstance(normals, str) else normals or ()
        self.options = options

    def forward(self, data: Data) -> Data:
        """The data with the keys added; reads `pos` (N, n) and, for a mesh, `face` (d + 1, F)."""
        if data.pos is None:
            raise InputError(f"expected data with pos, got {data}")
        try:
            keys = _keys(self._operator(data), self.k)
        except TorchlbError as error:
            if self.on_error == "raise":
                raise
            warn(f"{data} stays without an operator: {error}")
            return data
        for key, value in keys.items():
            data[key] = value.to(data.pos.device) if isinstance(value, Tensor) else value
        return data

    def _operator(self, data: Data) -> LaplaceBeltrami:
        """The operator of the mesh or the cloud, from the cache or built."""
        faces = None if data.get("face") is None else data["face"].T
        options: dict[str, Any] = {"operator": self.operator, "progress": False, **self.options}
        normals = [data[key] for key in self.normals if data.get(key) is not None]
        if faces is None and normals:
            options.setdefault("normals", normals[0])
        elif faces is None and data.get("edge_index") is not None:
            warn(
                f"{data} has edges but no face, so that the operator is that of a cloud; a mesh keeps its faces with "
                "FaceToEdge(remove_faces=False), or with this transform first"
            )
        warn_of_gradients(data["pos"], "pos")
        points = data["pos"].detach()
        if self.cache is None:
            return build_operator(points, faces, **options)
        return load_or_build(points, faces, cache=self.cache, k=self.k, **options)

    def __repr__(self) -> str:
        shown = {"operator": self.operator, "k": self.k, "cache": self.cache, **self.options}
        return f"{type(self).__name__}({', '.join(f'{k}={v!r}' for k, v in shown.items())})"


def _keys(lb: LaplaceBeltrami, k: int) -> dict[str, Any]:
    """The keys and values to store in the data of one shape."""
    first = zlib.crc32(lb.points.cpu().numpy().tobytes())
    keys: dict[str, Any] = {
        "lb_order_t": lb.stencil.order_t,
        "lb_pos": lb.points,
        "lb_nodes": torch.arange(first, first + lb.num_points),
        "lb_first": torch.tensor([first]),
        "lb_face_index": lb.faces.T.contiguous(),
        "lb_boundary": lb.mass < 0 if lb.boundary is None else lb.boundary,
        "lb_info": json.dumps(lb.get_extra_state()),
    }
    keys |= {f"lb_{n.strip('_')}": getattr(lb, n) for n in KEPT if len(getattr(lb, n))}
    kind = kind_of(lb.options.get("condition"))
    width = 3 if kind.conserves or kind.fixes else 4  # the same for every shape with this condition
    for name, pair in {"stencil": lb.stencil, "weak": lb.weak, "linear": lb.weak.near}.items():
        more = 0 if name == "stencil" else width - len(pair.values)
        keys[f"lb_{name}_index"] = torch.stack([pair.col, pair.row])
        keys[f"lb_{name}_values"] = pad(pair.values, (0, 0, 0, more)).T.contiguous()
    if k > 0:
        basis = lb.eigenbasis(k)
        parts = [getattr(basis, name) for name in BASIS]
        keys["lb_basis"] = torch.cat([part.flatten() for part in parts if part is not None])
        keys["lb_basis_size"] = torch.tensor([basis.eigenvectors.shape[1]])
    return keys


def to_operator(data: Any) -> LaplaceBeltrami:
    """The operator of a `Data` or `Batch` that went through `LaplaceBeltramiTransform`, on the device of the data.

    Of a `Batch` it is block-diagonal, as `LaplaceBeltrami.batch` makes it, and `lb(x)` acts on the features of all
    nodes. It holds the eigenbases, if they were stored. Nothing is solved or sorted: cheap enough for every step.

    Raises ValueError for data without the keys, for `pos` changed since by more than a translation, and for nodes in
    another order, since transforms permute nodes, not matrices.
    """
    if not hasattr(data, "keys") or "lb_stencil_index" not in data:
        raise InputError(
            f"expected data that went through LaplaceBeltramiTransform, got {shown(data)}"
        )
    batched = isinstance(data, Batch)
    infos = [json.loads(text) for text in (data["lb_info"] if batched else [data["lb_info"]])]
    sizes = data["ptr"].diff() if batched else data.lb_mass.new_tensor([len(data.lb_mass)]).long()
    warn_of_gradients(data.pos, "pos")
    _check_unchanged(data, sizes)
    basis = None
    if "lb_basis" in data:
        bases = _bases(data, sizes.tolist())
        basis = stack_eigenbases(bases) if batched else bases[0]
    state = join_states(infos, sizes.tolist()) if batched else infos[0]
    return LaplaceBeltrami._of_parts(_parts(data, sizes), state, basis)


def _parts(data: Any, sizes: Int[Tensor, " S"]) -> dict[str, Any]:
    """The block-diagonal matrices, and the other tensors of the operator."""
    points = data.pos.detach().to(data.lb_mass)
    parts = {n: data.get(f"lb_{n.strip('_')}", points[:0]) for n in KEPT}
    parts |= {"points": points, "faces": data.lb_face_index.T}
    parts["_on_boundary"] = data.lb_boundary[: None if data.lb_boundary.any() else 0]
    matrices = []
    for name in ("stencil", "weak", "linear"):
        col, row = data[f"lb_{name}_index"]
        crow = pad(torch.bincount(row, minlength=len(points)).cumsum(0), (1, 0))
        ends = crow[pad(sizes.cumsum(0), (1, 0))]
        entries = ends.diff()
        if bool((entries == 0).any()):
            break  # as in `LaplaceBeltrami.batch`, if one shape has no pair
        values, order_t = data[f"lb_{name}_values"].T.contiguous(), None
        if name == "stencil":
            order_t = data.lb_order_t + ends[:-1].repeat_interleave(entries)
        matrices.append(Csr(crow, col.contiguous(), values, order_t))
    parts["stencil"], *pair = matrices
    if pair:
        parts["weak"] = PairMatrices.trimmed(*pair)
    return parts


def _check_unchanged(data: Any, sizes: Int[Tensor, " S"]) -> None:
    """Raise ValueError unless `pos` is that of the operator, in its order, up to a translation of each shape."""
    built, pos = data.lb_pos, data.pos.detach()
    # some transforms sample every key
    count = max(len(built), int(data.lb_stencil_index.max()) + 1)
    if not len(pos) == int(sizes.sum()) == count:
        raise InputError(
            f"{len(pos)} points, but an operator of {count}: nodes were added or taken away after "
            "LaplaceBeltramiTransform; apply it last"
        )
    shift = data.lb_first - (sizes.cumsum(0) - sizes)
    expected = shift.repeat_interleave(sizes) + torch.arange(len(pos), device=sizes.device)
    astray = (data.lb_nodes != expected).nonzero()[:, 0]
    if len(astray):
        raise InputError(
            f"pos: {len(astray)} of {len(pos)} points ({first_few(astray)}) are in another order since "
            "LaplaceBeltramiTransform, and its matrices are not; permute or sample first, and apply it last"
        )
    moved = (pos - built).split(sizes.tolist())
    by = max(float((d - d[0]).abs().max()) for d in moved)
    scale = max(float(pos.abs().max()), float(built.abs().max()))
    if by > 64 * max(torch.finfo(t.dtype).eps for t in (pos, built)) * scale:
        raise InputError(
            f"pos: its points moved by up to {by:.3g} against each other since LaplaceBeltramiTransform, whose "
            "operator is that of the old ones; scale, rotate, jitter or deform first, and apply it last"
        )


def _bases(data: Any, sizes: list[int]) -> list[Eigenbasis]:
    """The eigenbasis of each shape, from the concatenated vector."""
    numbers, bases = data.lb_basis_size.tolist(), []
    pieces = data.lb_basis.split([2 * k * (1 + n) for n, k in zip(sizes, numbers, strict=True)])
    masses = data.lb_mass.split(sizes)
    for piece, mass, k in zip(pieces, masses, numbers, strict=True):
        values, vectors, left, errors = piece.view(-1, k).split([1, len(mass), len(mass), 1])
        bases.append(Eigenbasis(values[0], vectors, mass, left, relative_errors=errors[0]))
    return bases
