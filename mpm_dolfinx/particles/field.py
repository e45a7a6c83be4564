# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Fields on a body besides its displacement, each with a background space of its own."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem, mesh

from .. import _compat
from ..background.basis import BackgroundBasis, PointBasis
from ..errors import MPMError, ParticleOutsideError, agree
from ..meshes.nodes import node_positions
from ..meshes.quadrature import quadrature_rule
from ..parallel.boundary import collective
from ..parallel.compilation import compiled_expression
from ..transfer.matrix import transfer_matrix
from ..transfer.transfer import Transfer
from .particles import Particles

__all__ = ["CarriedField", "ParticleField"]

KINDS = ("total", "increment", "body")
PLACES = ("nodes", "points")


class ParticleField(fem.Function):
    """An unknown on a body besides its displacement, such as a pressure or a temperature.

    It is a Function on the body mesh, and stands in UFL as such; give it to
    ``ParticleProblem(..., fields=[...])``. Its values are those of a background space where the
    body is: ``p = T_p x``. The space may have another degree, shape and mesh than that of the
    displacement.

    Args:
        particles: The body.
        V: Background space: scalar, vector or tensor Lagrange elements, continuous or not.
        at: Where the body has values: at the ``"points"`` of ``particles.dx``, for forms
            without the gradient of the field, or at the ``"nodes"`` of a Lagrange space of
            the same degree on the body mesh, for those with it.
        kind: ``"total"``: the background has the values themselves; ``"increment"``: it has
            the change in each step, ``p = p_n + T_p x``, for what does not diffuse;
            ``"body"``: T_p is that of the undeformed body in all steps.
        name: Its name: an identifier, another one for each field of a body.

    Raises:
        MPMError: A space or options that do not go together.

    Attributes:
        particles: The body.
        background: The background space of the unknowns x.
        at: ``"points"`` or ``"nodes"``.
        kind: ``"total"``, ``"increment"`` or ``"body"``.
        previous: The values at the last converged step, a Function on the same space. Set them
            (and the field's own) before the first step to begin with others than zero.
        W: Space of test functions, on the body mesh.
        dx: A measure whose rule knows the values: ``particles.dx``.
    """

    @collective()
    def __init__(
        self,
        particles: Particles,
        V: fem.FunctionSpace,
        at: str = "points",
        kind: str = "total",
        name: str = "field",
    ) -> None:
        if not isinstance(particles, Particles):
            raise MPMError(f"A field is one of mpm.Particles, not of {type(particles).__name__}.")
        _validate(particles, V, at, kind, name)
        shape = tuple(V.ufl_element().reference_value_shape)
        if at == "points":
            W = particles.quadrature_function(name, shape).function_space
        else:
            degree = max(V.ufl_element().degree, 1)
            W = fem.functionspace(particles.mesh, ("Lagrange", degree, shape))
        super().__init__(W, name=name)
        self.particles, self.background, self.at, self.kind = particles, V, at, kind
        self.previous = fem.Function(W, name=f"{name} before")

    @property
    def W(self) -> fem.FunctionSpace:
        """Space of test functions, on the body mesh."""
        return self.function_space

    def at_points(self) -> NDArray[np.float64]:
        """Return the values at the history's points, shape ``(n, nq)``, ``(n, nq, k)``."""
        body, block = self.particles, self.W.dofmap.bs
        values = self.x.array.reshape(-1, block)[self.W.dofmap.list[: body.num_local]]
        if self.at == "nodes":
            points, _ = quadrature_rule(body.mesh.basix_cell(), body.geometry.quadrature_degree)
            shapes = _compat.tabulated(self.W.ufl_element().basix_element, 0, points)[0]
            values = np.einsum("qk,nki->nqi", shapes, values)
        return np.asarray(values[..., 0] if block == 1 else values)

    def from_nodes(self) -> fem.Function | None:
        """Return itself if it has values all over the body, ``None`` if only points have them."""
        return self if self.at == "nodes" else None

    @collective("values")
    def set(self, values: Any) -> None:
        """Set present and converged values, before the first step.

        Args:
            values: A number for all, or an array for the local dofs (collective).

        Raises:
            MPMError: Something else, of another shape, or not finite.
        """
        with agree(self.particles.mesh.comm):
            given = self._numbers(values)
        for function in (self, self.previous):
            function.x.array[:] = given
            function.x.scatter_forward()

    def _numbers(self, values: Any) -> NDArray[Any]:
        """Return values that can be set, as an array."""
        try:
            given = np.asarray(values)
        except (TypeError, ValueError):  # such as a list of lists of different lengths
            given = np.asarray(None)
        if given.dtype.kind not in "iuf":
            raise MPMError(
                f"The values of the field '{self.name}' must be a number or an array of numbers, "
                f"not {type(values).__name__}."
            )
        count = len(self.x.array)
        if given.shape not in ((), (count,)):
            raise MPMError(
                f"The values of the field '{self.name}' have the shape {given.shape}; give a "
                f"number, or one for each local dof, shape ({count},)."
            )
        if not np.isfinite(given).all():
            raise MPMError(f"The values of the field '{self.name}' must be finite.")
        return given


def _validate(particles: Particles, V: Any, at: str, kind: str, name: str) -> None:
    if not isinstance(V, fem.FunctionSpace):
        raise MPMError(f"A field needs a dolfinx FunctionSpace, not {type(V).__name__}.")
    if at not in PLACES:
        raise MPMError(f"Unknown at={at!r} of a field; choose 'nodes' or 'points'.")
    if kind not in KINDS:
        raise MPMError(f"Unknown kind={kind!r} of a field; choose {', '.join(map(repr, KINDS))}.")
    if not isinstance(name, str) or not name.isidentifier() or name == "displacement":
        raise MPMError(f"The name of a field must be an identifier of its own, not {name!r}.")
    if V is particles.V:
        raise MPMError(
            "A field needs a background space of its own, not the V of the displacement; make "
            "another one, on the same mesh if you like."
        )
    if V.mesh.geometry.dim != particles.mesh.geometry.dim:
        raise MPMError("The space of a field must be on a mesh of the body's dimension.")
    if V.mesh is particles.mesh and kind != "body":
        raise MPMError("A field whose space is on the body mesh needs kind='body'.")
    if V.ufl_element().family_name not in ("P", "DPC"):
        raise MPMError("A field needs a space of polynomials: Lagrange, DG or DPC.")
    if at == "nodes" and not particles.shares_nodes:
        raise MPMError(
            "Fields at nodes need particles that hang together, as with method='cpdi2'; use "
            "at='points'."
        )
    if at == "nodes" and particles.deletion is not None:
        raise MPMError(
            "Fields at nodes cannot follow particles with outside='delete'; use at='points'."
        )


class CarriedField:
    """A field of a body as the system moves it: as it moves a body, with values for displacement.

    What has the names of a body's attributes is what fields and terms of the system ask for.

    Args:
        field: The field.

    Attributes:
        field: As given.
        V: Its background space.
        W: Its space on the body mesh.
        displacement: The field, whose values change.
        increment: The change of the background's values in the step, on V.
        converged_displacement: What the values change from in the step that has begun, on the
            local dofs of W: those of the last converged step, or what the background makes of them.
    """

    def __init__(self, field: ParticleField) -> None:
        self.field = field
        self.V, self.W = field.background, field.W
        self.displacement: fem.Function = field
        self.increment = fem.Function(self.V, name=f"increment of {field.name}")
        self.converged_displacement: NDArray[Any] = field.previous.x.array.copy()
        self._basis = BackgroundBasis(self.V)
        if self.V.mesh is field.particles.V.mesh:
            # (where its boundary holds the body, it holds what the body has)
            count = self.V.dofmap.index_map.size_local
            self._basis.hold(np.ones((count, self.V.mesh.geometry.dim), dtype=bool))
        self._at: Transfer | None = None
        self._rows: PointBasis | None = None
        self._T: PETSc.Mat | None = None
        self._vectors: fem.FunctionSpace | None = None

    @property
    def total(self) -> bool:
        """Whether the background has the values themselves, not their change."""
        return self.field.kind != "increment"

    @property
    def place(self) -> Literal["points", "nodes"]:
        """Where the values live."""
        return "points" if self.field.at == "points" else "nodes"

    @property
    def mesh(self) -> mesh.Mesh:
        """The body mesh."""
        return self.field.particles.mesh

    @property
    def shares_nodes(self) -> bool:
        """Whether the values of neighbours are values at the same nodes."""
        return self.place == "nodes" and self.field.particles.shares_nodes

    @property
    def num_local(self) -> int:
        """Number of particles that are a field's own: none."""
        return 0

    @property
    def domain_nodes(self) -> NDArray[np.int32]:
        """Local nodes of W of each owned domain, shape ``(n, k)``."""
        return np.asarray(self.W.dofmap.list[: self.field.particles.num_local])

    @property
    def global_index(self) -> NDArray[np.int64]:
        """Input index of each owned particle, shape ``(n,)``."""
        return self.field.particles.global_index

    @property
    def node_positions(self) -> NDArray[np.float64]:
        """The converged values on the local dofs of W: what round-off of changes is judged by."""
        return np.asarray(self.field.previous.x.array)

    @property
    def weights(self) -> NDArray[np.float64]:
        """Undeformed volume of each own point, or 1 at each node, shape ``(N,)``."""
        count = self.W.dofmap.index_map.size_local
        if self.field.at == "nodes":
            return np.ones(count)
        return np.asarray(self.field.particles.undeformed.rule.weights.ravel())

    def inverted(self) -> NDArray[np.int64]:
        """Return no particles: values cannot turn a domain inside out."""
        return np.zeros(0, dtype=np.int64)

    def locate(self) -> None:
        """Find the background cells of all points, unless that is done (collective).

        Raises:
            ParticleOutsideError: A point is outside the mesh of the background space.
        """
        body = self.field.particles
        if self._rows is not None and (self.is_frozen or self._at is body.transfer):
            return
        self._at = body.transfer
        rows = self._basis.at(self._positions())
        gone = np.zeros(len(rows.nodes), dtype=bool)
        if self.field.at == "points":
            gone = np.repeat(body.deleted, body.num_points)
        lost = ~rows.found & ~gone
        with agree(self.mesh.comm):
            if lost.any():
                raise ParticleOutsideError(
                    f"Points of {{particles}} are outside the mesh of the field "
                    f"'{self.field.name}'; make it larger or the load smaller.",
                    self._particles_at(lost),
                )
        rows.values[gone] = 0.0
        self._rows, self._T = rows, None

    @property
    def is_frozen(self) -> bool:
        """Whether the background knows the undeformed body, so that T does not change."""
        return self.field.kind == "body"

    def _positions(self) -> NDArray[np.float64]:
        """Return where this rank's own values live, shape ``(N, gdim)`` (collective)."""
        body, gdim = self.field.particles, self.mesh.geometry.dim
        if self.field.at == "points":
            points = _undeformed_points(body) if self.is_frozen else body.placement.points()
            return points.reshape(-1, gdim)
        x = self._undeformed
        if not self.is_frozen:
            x = x + self._at_nodes(body.converged_displacement)
        return x[: self.W.dofmap.index_map.size_local]

    @cached_property
    def _undeformed(self) -> NDArray[np.float64]:
        """Undeformed positions of the local nodes of W, shape ``(N, gdim)``."""
        return node_positions(self.W)

    def _at_nodes(self, motion: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a motion of the body's nodes at those of the field, ``(N, gdim)`` (collective)."""
        body, gdim = self.field.particles, self.mesh.geometry.dim
        if self._vectors is None:
            degree = self.W.ufl_element().degree
            self._vectors = fem.functionspace(self.mesh, ("Lagrange", degree, (gdim,)))
            if not np.array_equal(self._vectors.dofmap.list, self.W.dofmap.list):
                raise MPMError("DOLFINx numbers nodes of scalars and vectors differently here.")
        own, moved = fem.Function(body.W), fem.Function(self._vectors)
        own.x.array[:] = motion
        moved.interpolate(own)
        moved.x.scatter_forward()
        return np.asarray(moved.x.array.reshape(-1, gdim))

    def node_gradients(self) -> PointBasis:
        """Return :attr:`node_basis` with gradients, zero where T does not change (collective)."""
        rows = self.node_basis
        basis = self._basis.at(self._positions(), gradients=True)
        assert basis.gradients is not None
        gradients = 0.0 * basis.gradients if self.is_frozen else basis.gradients
        return rows._replace(gradients=gradients)

    def carried_by(self, motion: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how the values' places move with the body, shape ``(N, gdim)`` (collective).

        Args:
            motion: On the local dofs of the body's W.
        """
        body = self.field.particles
        gdim = self.mesh.geometry.dim
        if self.field.at == "points":
            moved = body.undeformed.at_points(body.of_domains(motion))
            return moved.reshape(-1, gdim)
        return self._at_nodes(motion)

    def _particles_at(self, rows: NDArray[np.bool_]) -> NDArray[np.int64]:
        touched = np.isin(self.domain_nodes, np.flatnonzero(rows)).any(axis=1)
        return np.asarray(self.global_index[touched])

    @property
    def node_basis(self) -> PointBasis:
        """The background basis at this rank's own nodes of W, at the last converged positions."""
        self.locate()
        assert self._rows is not None
        return self._rows

    @property
    def T(self) -> PETSc.Mat:
        """The transfer: all dofs of W by all dofs of V (collective)."""
        self.locate()
        if self._T is None:
            self._T = transfer_matrix(self.node_basis, self.W, self.V)
        return self._T

    def forget_transfer(self) -> None:
        """Drop T, which is made anew when it is needed."""
        self._rows = self._T = self._at = None

    def commit(self) -> NDArray[np.float64]:
        """Make the present values the converged ones; return what these were before."""
        before = self.field.previous.x.array.copy()
        self.field.previous.x.array[:] = self.field.x.array
        return np.asarray(before)

    def restore(self, values: NDArray[np.float64]) -> None:
        """Set the converged values, on the local dofs of W."""
        self.field.previous.x.array[:] = values

    def roll_back(self) -> None:
        """Return to the converged values."""
        self.field.x.array[:] = self.field.previous.x.array
        self.increment.x.array[:] = 0.0


def _undeformed_points(body: Particles) -> NDArray[np.float64]:
    """Return the undeformed positions of a body's points, ``(n, nq, gdim)`` (collective)."""
    gdim = body.mesh.geometry.dim
    x = body.quadrature_function("x", (gdim,))
    points = x.function_space.ufl_element().custom_quadrature()[0]
    where = compiled_expression(ufl.SpatialCoordinate(body.mesh), points, body.mesh.comm)
    x.interpolate(where)
    count = body.num_local * body.num_points * gdim
    return np.asarray(x.x.array[:count]).reshape(-1, body.num_points, gdim)
