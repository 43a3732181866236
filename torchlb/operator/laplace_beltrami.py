"""The operator as a module: it stores the results of the functions below it, and multiplies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch

from torchlb.certified.certificate import Certificate
from torchlb.cloud.surface import SurfaceSummary
from torchlb.errors import InputError, InputTypeError
from torchlb.fits.rules import WeightsName
from torchlb.galerkin.matrices import PairMatrices
from torchlb.geometry.frames import Projection
from torchlb.linalg.csr import Csr, Record, tensors_of
from torchlb.operator import batching, inputs
from torchlb.operator.build import Reconstruction, build_cloud, build_cotangent, build_mesh
from torchlb.operator.checks import check_none
from torchlb.operator.connection import Connection, connection_of
from torchlb.operator.inputs import ArrayLike
from torchlb.operator.medium import checked_fields, pair_in, split_fields
from torchlb.operator.pair_methods import PairMethods
from torchlb.operator.parts import MediumFields, Modes
from torchlb.operator.plan import Parts, Plan, check_fit, evaluate
from torchlb.operator.stencil_methods import StencilMethods
from torchlb.operator.through import carrying, origins
from torchlb.spectral.eigenbasis import stack_eigenbases, unstack_eigenbases
from torchlb.stencils.conditions import Condition, ConditionName
from torchlb.stencils.options import Options


class LaplaceBeltrami(StencilMethods, PairMethods):
    """The Laplace–Beltrami operator Δ of a surface (or any manifold in Rⁿ) as a sparse matrix.

    Build it with `from_points`, `from_mesh` or `from_cotangent`; ``LaplaceBeltrami()`` alone is empty and takes any
    `load_state_dict`. The sign is the analyst's: Δ is negative semidefinite, Δ Y_l = −l(l+1) Y_l on the unit sphere.

    Attributes
    ----------
    stencil
        A `Csr`: crow, col and values (1 + d, nnz) of Δ, in 1/ℓ², where ℓ is the unit of the points, and of the
        tangential derivatives in the frame of each row's point, 1/ℓ.
    mass
        (N,), ℓ^d: positive quadrature weights that sum to the area; π of the certificate where there is one.
    certificate
        Proof of the stability of Δ; None where it was not asked for, and for the cotangent.
    points, frames
        (N, n), ℓ, and (N, n, d), orthonormal tangent vectors.
    normals
        (N, n), unit normals of a hypersurface, empty (0, n) otherwise.
    faces
        (F, d + 1), of the mesh, or of the complex through a cloud.
    surface
        How the surface through a cloud was found, a `SurfaceSummary`; None where there is none.
    sizes
        Numbers of points of the shapes of a `batch`; None for a single shape.
    source, options
        "points", "mesh", "cotangent" or "batch", and the options of the constructor, as passed.

    >>> theta = torch.arange(36, dtype=torch.float64) * torch.pi / 18
    >>> circle = torch.stack([theta.cos(), theta.sin()], dim=1)
    >>> lb = LaplaceBeltrami.from_points(circle, order=3)
    >>> bool(torch.allclose(lb(circle[:, 0]), -circle[:, 0], atol=0.02))
    True
    """

    def __init__(self, *given: Any) -> None:
        check_none(given, "LaplaceBeltrami() takes no arguments")
        super().__init__()

    @classmethod
    def from_points(
        cls,
        points: ArrayLike,
        *surplus: Any,
        dim: int | None = None,
        order: int = 3,
        normal_order: int | None = None,
        projection: Projection = "tangent",
        weights: WeightsName = "least_squares",
        num_neighbors: int | None = None,
        normals: ArrayLike | None = None,
        boundary: ArrayLike | Literal["detect"] | None = None,
        condition: ConditionName | Condition | None = "neumann",
        reconstruct: Reconstruction | None = None,
        weak_form: bool = True,
        certify: bool = False,
        progress: bool = True,
    ) -> LaplaceBeltrami:
        """Operator on a point cloud.

        Parameters
        ----------
        points
            (N, n) tensor or array, length ℓ, without duplicates. Computed in float64 on the CPU; the result has the
            floating type of the points. If they require a gradient, see `at`.
        dim, order, normal_order
            Dimension d of the manifold, n − 1 by default; order p ≥ 1 of the Laplacian, whose error falls like h^p;
            order q of the tangent frames, p + 1 by default.
        projection
            "tangent" (more accurate) or "normal" (the note's), see `method.md`, section 3.
        weights, num_neighbors
            "least_squares" (robust) or "polyharmonic" (for evenly spread points); the size of every stencil.
        normals
            (N, n), if known (d = n − 1): they orient the surface where neighbours agree; a warning says where not.
        boundary
            (N,) mask of the points on the boundary; by default, or for "detect", that of the complex through the cloud.
            Dirichlet's and Robin's condition need one of the two.
        condition
            Boundary condition: "neumann", ∂_ν f = 0; "dirichlet", f = 0; or `torchlb.Robin(a)`, ∂_ν f + a f = 0. With
            Dirichlet's the values of f at boundary points enter only the rows of these points. None uses no boundary
            data: stencils there are one-sided, hardly one passes, and low-order rows in their place have ∂_ν f = 0.
        reconstruct
            Function from points (N, n) to cells through them, (F, d + 1), or to a `torchlb.cloud.Complex`; by default
            `torchlb.cloud.reconstruct`, for d ≤ 3. `lb.faces` are its cells.
        weak_form, certify
            Whether to build the weak pair (K, M), on which eigenpairs, flows and solves rest; whether to lower rows of
            the stencil until the certificate of stability holds, whose π is then the mass.
        progress
            Whether to show a bar, on a terminal.

        Raises InputError for bad input; StencilError where not even the low-order row of a point can be built.
        """
        check_none(surplus, "from_points() takes points alone, and options by name")
        options = Options(
            order, normal_order, projection, weights, num_neighbors, condition, weak_form, certify
        )
        with torch.inference_mode(False):  # the tensors may be used in training
            given = {"normals": normals, "boundary": boundary, "reconstruction": reconstruct}
            built = build_cloud(points, dim, options, **given, progress=progress)
        return cls._stored(built, points)

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        order: int = 3,
        normal_order: int | None = None,
        projection: Projection = "tangent",
        weights: WeightsName = "least_squares",
        num_neighbors: int | None = None,
        boundary: ArrayLike | Literal["detect"] | None = None,
        condition: ConditionName | Condition | None = "neumann",
        weak_form: bool = True,
        certify: bool = False,
        progress: bool = True,
    ) -> LaplaceBeltrami:
        """Operator on the vertices of a mesh; its faces give the neighbours and the first normals.

        Parameters
        ----------
        vertices
            (N, n) tensor or array, length ℓ; if they require a gradient, see `at`.
        faces
            (F, 3) indices of any triangle mesh: several components, non-manifold edges, zero-area triangles. Also
            (F, 2) polylines and (F, 4) tetrahedra, for manifolds of dimension 1 and 3 in Rⁿ.
        boundary
            (N,) mask of the part of the boundary where the condition holds; the rest has none. By default, or for
            "detect", all the boundary of the faces, if any.
        order, normal_order, projection, weights, num_neighbors, condition, weak_form, certify, progress
            As for `from_points`. The order chooses the weak pair, too (degree of elements, of fits of functions): 1 and
            2 (2, 2), 3 (2, 3), 4 (3, 4), 5 and above (4, 6); its surface is that of the frames, of degree q.

        Raises InputError for bad input, such as vertices that belong to no face; `torchlb.submesh` cuts a part out.
        """
        options = Options(
            order, normal_order, projection, weights, num_neighbors, condition, weak_form, certify
        )
        with torch.inference_mode(False):
            built = build_mesh(vertices, faces, options, boundary=boundary, progress=progress)
        return cls._stored(built, vertices)

    @classmethod
    def from_cotangent(cls, vertices: ArrayLike, faces: ArrayLike) -> LaplaceBeltrami:
        """libigl's cotangent operator M⁻¹C with its Voronoi mass, behind the same interface: the baseline.

        Parameters
        ----------
        vertices
            (N, 3), ℓ.
        faces
            (F, 3) indices.

        Its gradient is the first-order fit to the vertices around each point, and ∂_ν f = 0 at a boundary. Long
        triangles along a boundary tie its vertices to lines: a warning says so, and `from_mesh` is right there. Raises
        InputError for bad input and for vertices without area.
        """
        inputs.warn_of_gradients(vertices, "vertices")
        with torch.inference_mode(False):
            built = build_cotangent(vertices, faces)
        return cls._stored(built, inputs.as_tensor(vertices).detach())

    @classmethod
    def batch(cls, shapes: Sequence[LaplaceBeltrami]) -> LaplaceBeltrami:
        """Several shapes as one block-diagonal operator, which every layer takes like any other.

        Features are those of the shapes, concatenated, (ΣN, C). Indices of shape s (its faces, for example) move by
        ``lb.offsets[s]``. The batch has a weak pair if all shapes have one. Eigenbases that all shapes hold are taken
        over; others are solved when asked for. Raises InputError for shapes of different dimension, floating type or
        device, or for none; InputTypeError for anything but a sequence of operators.
        """
        alone = isinstance(shapes, LaplaceBeltrami)
        if alone or not all(isinstance(shape, LaplaceBeltrami) for shape in shapes):
            raise InputTypeError("batch: expected a sequence of operators, [lb, …]")
        if len(shapes) == 0:
            raise InputError("batch: got no shapes")
        batching.check_alike(shapes)
        sizes = [n for shape in shapes for n in shape.sizes or (shape.num_points,)]
        state = batching.join_states([shape.get_extra_state() for shape in shapes], sizes)
        bases = [shape._basis for shape in shapes if shape._basis and not shape.sizes]
        with torch.inference_mode(False):
            basis = stack_eigenbases(bases) if len(bases) == len(shapes) else None
            joined = cls._of_parts(batching.joined_parts(shapes), state, basis)
        batching.remember_shapes(joined, shapes)
        joined._carries = any(origins(shape) is not None for shape in shapes)
        return joined

    @property
    def plan(self) -> Plan:
        """The decisions behind the operator, integers and flags.

        Copies, files, and the shapes of a batch have them, too. Raises InputError for batches, the cotangent operator,
        operators without a weak pair, and where they were let go.
        """
        plan = None if self.sizes is not None else self._known_plans[0]
        if plan is None:
            raise InputError(
                f"plan: an operator of kind {self.source!r} has none here; those of LaplaceBeltrami.from_mesh and "
                "from_points have, with a weak pair, unless they come from PyG's Data or it was let go"
            )
        return plan

    @plan.deleter
    def plan(self) -> None:
        """``del lb.plan`` frees it, about a kilobyte a point."""
        self._plans = []

    def at(self, points: ArrayLike) -> LaplaceBeltrami:
        """The operator of the shape moved to other points, by the same decisions: neighbours, degrees, cells.

        It is computed on the operator's device, in about half the time of a build. It is meant for points that moved a
        little, as in an animation or a flow; for others the decisions may not fit, and `from_mesh` or `from_points`
        makes new ones. Cells keep their winding, so that normals of a mirror image point inwards.

        Parameters
        ----------
        points
            (N, n), ℓ, in the order of those that the operator was built from. If they require a gradient, results are
            differentiable in them; those that are not raise DerivativeError where they are asked for one.

        Warns where edges changed by more than three times against the others. Raises InputError for another shape,
        cells turned inside out, where there is no `plan`, and with a certificate.

        >>> from torchlb.surfaces import Sphere
        >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(200))
        >>> ratio = lb.at(2 * lb.points).eigenbasis(4).eigenvalues / lb.eigenbasis(4).eigenvalues
        >>> ratio[1:].round(decimals=6).tolist()
        [0.25, 0.25, 0.25]
        """
        there = inputs.check_points(points, device=self.device)
        if there.shape != self.points.shape:
            raise InputError(
                f"points: expected {tuple(self.points.shape)}, as the operator has, got {tuple(there.shape)}"
            )
        plan = self.plan
        check_fit(plan, there)
        with torch.inference_mode(False):
            built = evaluate(plan, there) | {"surface": self.surface}
        lb = self._stored(built, points, self.device)
        return lb.with_medium(**tensors_of(self._known_medium)) if self._in_medium else lb

    def with_medium(
        self,
        conductivity: ArrayLike | float | None = None,
        density: ArrayLike | float | None = None,
        potential: ArrayLike | float | None = None,
    ) -> LaplaceBeltrami:
        """The operator of −div(A∇u) + cu = λρu, for eigenpairs, flows, solves, layers: another weak pair on the shape.

        Results are differentiable in A, ρ and c. Rows of Δ and ∇, `mass` and the frames are those of the shape; the
        medium of this operator, if any, is replaced.

        Parameters
        ----------
        conductivity
            A: positive numbers at the vertices (N,), or on the faces (F,), if F ≠ N; or symmetric positive space
            tensors, (N, n, n) or (F, n, n), of which the part along the surface counts; 1 by default. With a boundary,
            fluxes and the condition are those of A∂_ν u.
        density
            ρ > 0, at either; 1 by default.
        potential
            c ≥ 0, 1/ℓ² if A has no unit, at either; 0 by default.

        Each may be a number. From vertices the logarithms of A and ρ are prolonged as functions are, and c itself.
        Raises InputError for other shapes and values, and without a weak pair.

        >>> from torchlb.surfaces import Sphere
        >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(300))
        >>> lb.with_medium(density=4.0, potential=2.0).eigenbasis(2).eigenvalues.round(decimals=3).tolist()
        [0.5, 1.0]
        """
        given = {"conductivity": conductivity, "density": density, "potential": potential}
        if self.sizes is not None:
            shapes = batching.shapes_of(self) or self.unbatch()
            parts = zip(shapes, split_fields(self, shapes, given), strict=True)
            return self.batch([shape.with_medium(**own) for shape, own in parts])
        with torch.inference_mode(False):
            medium, lb = checked_fields(self, given), self._alias()
            lb.weak = pair_in(self, medium.fields(self.num_points))
            lb.modes, lb._medium, lb._in_medium = Modes(None, self.mass), medium, True
        lb.cache.elements = self.cache.elements
        return lb

    @property
    def connection(self) -> Connection:
        """The tangent fields of the shape, or of a batch: `Connection`, with stiffness, mass matrix, eigenbasis.

        Made where it is asked for first, in about three times the time of a build. InputError without a weak pair.

        >>> from torchlb.surfaces import Sphere
        >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(500))
        >>> lb.connection.eigenbasis(6).eigenvalues.round(decimals=3).tolist()  # l(l + 1) − 1
        [1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
        """
        return connection_of(self)

    def unbatch(self) -> list[LaplaceBeltrami]:
        """The operators of the shapes of a `batch`, with weak pairs only if all shapes of the batch had one."""
        if self.sizes is None or self._states is None:
            raise InputError(f"unbatch: expected a batch of operators, got one from {self.source}")
        bases = unstack_eigenbases(self._basis) if self._basis else [None] * len(self.sizes)
        shapes = zip(batching.split_parts(self, self.sizes), self._states, bases, strict=True)
        return [type(self)._of_parts(*shape) for shape in shapes]

    @classmethod
    def _stored(
        cls, parts: Parts, given: ArrayLike, device: torch.device | None = None
    ) -> LaplaceBeltrami:
        """Store a finished operator, in the floating type of the input, whose gradient it carries."""
        with torch.inference_mode(False):
            lb = cls._of_parts(parts).to(device, inputs.float_type(given))
        return carrying(lb, given)


# A whole module can be read back with torch.load(weights_only=True) where torchlb is imported.
torch.serialization.add_safe_globals(
    [LaplaceBeltrami, Csr, PairMatrices, MediumFields, Modes, Record, Certificate, SurfaceSummary]
)
