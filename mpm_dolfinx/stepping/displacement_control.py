# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Displacement control: a displacement of the body is prescribed, and the load factor is found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem, la

from ..assembly.expansion import expanded
from ..assembly.rules import depends_on, split_by_rule
from ..background.basis import BackgroundBasis
from ..errors import MPMError, agree
from ..parallel.boundary import collective
from ..parallel.compilation import compiled_form
from ..parallel.given import is_number
from ..particles.geometry import RING
from ..particles.particles import Particles
from ..reals import as_finite
from ..system.reduced import ReducedSystem
from ..tolerances import EQUAL, LAST_PLACES, NEGLIGIBLE

__all__ = ["ControlledSystem", "DisplacementControl"]


class DisplacementControl:
    """A displacement of a body that is prescribed instead of the load.

    Give it to ``problem.solve(steps=n, control=...)``: the displacement goes to ``value`` in n
    equal steps, and the load factor becomes an unknown, so that it may fall beyond a limit load.

    Args:
        particles: The body.
        value: The displacement at the end of the run.
        point: A point of the body mesh whose displacement it is, shape ``(gdim,)``.
        direction: Direction of that displacement, made a unit vector, shape ``(gdim,)``.
        functional: Instead of point and direction: a UFL form, linear in
            ``particles.displacement`` and without test function, such as the mean over facets
            ``ufl.inner(d, n) / area * ds(tag)``.

    Attributes:
        particles: The body.
        value: As given.
        functional: As given.

    Raises:
        MPMError: A point outside the body mesh, a form that is no linear functional, or values
            that make no sense.
    """

    @collective()
    def __init__(
        self,
        particles: Particles,
        value: float,
        point: Any = None,
        direction: Any = None,
        *,
        functional: ufl.Form | None = None,
    ) -> None:
        if not isinstance(particles, Particles):
            raise MPMError(
                f"A displacement control needs mpm.Particles, not {type(particles).__name__}."
            )
        with agree(particles.mesh.comm):
            if not is_number(value) or not np.isfinite(value):
                raise MPMError(
                    f"The controlled displacement must be a finite number, not {value!r}."
                )
            if (functional is None) != (point is not None and direction is not None):
                raise MPMError("Give either point= and direction=, or functional=.")
            if functional is None:
                self._point = _vector(point, particles, "point")
                self._direction = _vector(direction, particles, "direction")
                length = float(np.linalg.norm(self._direction))
                if length == 0.0:
                    raise MPMError("direction must not be zero.")
                self._direction /= length
        self.particles = particles
        self.value = float(value)
        self.functional = functional
        self._space: fem.FunctionSpace | None = None
        self._rebases = particles.trail.rebases
        self.row()

    def require_for(self, bodies: Sequence[Particles], path: bool) -> None:
        """Raise an error unless it can control a run of these bodies."""
        if all(self.particles is not body for body in bodies):
            raise MPMError("The displacement control is of particles that this problem has not.")
        if path:
            raise MPMError("Give either control= or a path (update=...), not both.")

    def require_movable(self) -> None:
        """Raise an error where it cannot follow particles to another mesh."""
        if self.functional is not None:
            raise MPMError(
                "functional is written on the present body mesh, so the particles cannot "
                "move or be split; control a point, or leave repartition and on_distortion alone."
            )

    def row(self) -> PETSc.Vec:
        """Return the functional's coefficients of this rank's own dofs of W (collective).

        Raises:
            MPMError: The body was rebased meanwhile.
        """
        if self._rebases != self.particles.trail.rebases:
            raise MPMError(
                "The body was rebased since this displacement control was made; make a new one, "
                "with a point of the rebased body and a displacement that is counted from there."
            )
        if self._space is not self.particles.W:
            self._space = self.particles.W
            self._row = self.particles.T.createVecLeft()
            self._row.array_w[:] = (
                self._of_point() if self.functional is None else self._of_form(self.functional)
            )
        return self._row

    def present(self) -> float:
        """Return the displacement at the last converged step (collective)."""
        row = self.row().array_r
        mine = float(row @ self.particles.converged_displacement[: len(row)])
        return float(self.particles.mesh.comm.allreduce(mine))

    def _of_point(self) -> NDArray[np.float64]:
        W, comm = self.particles.W, self.particles.mesh.comm
        found = False
        if len(self.particles.trail.cuts):
            nodes, values, found = self._in_triangles()
        if not found:
            asked = self._point[None][: int(comm.rank == 0)]
            basis = BackgroundBasis(W).at(asked)
            every = comm.bcast((basis.nodes, basis.values, basis.found))
            nodes, values, found = (array[0] for array in every)
        if not found:
            where = tuple(float(x) for x in self._point)
            raise MPMError(f"The point {where} of the displacement control is not in the body.")
        first, last = W.dofmap.index_map.local_range
        row = np.zeros((last - first, W.dofmap.index_map_bs))
        own = (nodes >= first) & (nodes < last)
        row[nodes[own] - first] = values[own, None] * self._direction
        return row.ravel()

    def _in_triangles(self) -> tuple[NDArray[np.int64], NDArray[np.float64], bool]:
        """Return nodes and weights of the point in half a quadrilateral, and whether it is in one.

        The map of such a half is singular at the corner that is there twice.
        """
        particles = self.particles
        ring = particles.domain_nodes[particles.geometry.triangular][:, RING]
        x = particles.geometry.nodes
        edges = np.linalg.norm(x[ring] - x[np.roll(ring, 1, axis=1)], axis=2)
        kept = (edges.argmin(axis=1)[:, None] + np.arange(1, 4)) % 4
        nodes = np.take_along_axis(ring, kept, axis=1)
        start, sides = x[nodes[:, 0]], x[nodes[:, 1:]] - x[nodes[:, :1]]
        along = np.linalg.solve(sides.transpose(0, 2, 1), (self._point - start)[:, :, None])
        weights = np.column_stack([1.0 - along.sum(axis=1), along[:, :, 0]])
        error = LAST_PLACES * np.abs(self._point).max() * np.abs(np.linalg.inv(sides)).sum((1, 2))
        inside = weights.min(axis=1) + error
        best = np.argsort(-inside)[:1]
        numbers = particles.W.dofmap.index_map.local_to_global(nodes[best].ravel())
        mine = inside[best].max(initial=-np.inf), numbers, weights[best].ravel()
        most, numbers, values = max(particles.mesh.comm.allgather(mine), key=lambda one: one[0])
        return numbers, values, bool(most >= -NEGLIGIBLE)

    def _of_form(self, functional: Any) -> NDArray[np.float64]:
        particles = self.particles
        d = particles.displacement
        if not isinstance(functional, ufl.Form) or functional.arguments():
            raise MPMError("functional must be a UFL form without test functions.")
        if not depends_on(functional, d):
            raise MPMError("functional does not depend on the displacement of the particles.")
        slope = expanded(ufl.derivative(functional, d, ufl.TestFunction(particles.W)))
        if depends_on(slope, d):
            raise MPMError("functional must be linear in the displacement of the particles.")
        vector = la.vector(particles.W.dofmap.index_map, particles.W.dofmap.index_map_bs)
        for part in split_by_rule(slope, d):
            form: Any = compiled_form(part)
            fem.assemble_vector(vector.array, form)
        vector.scatter_reverse(la.InsertMode.add)
        row = vector.array[: self._row.getLocalSize()].copy()
        comm = particles.mesh.comm
        whole = sum(
            fem.assemble_scalar(compiled_form(part)) for part in split_by_rule(functional, d)
        )
        linear = float(row @ d.x.array[: len(row)])
        whole, linear = comm.allreduce(np.array([whole, linear]))
        size = comm.allreduce(float(np.abs(row) @ np.abs(d.x.array[: len(row)])))
        if abs(whole - linear) > NEGLIGIBLE * size:
            raise MPMError("functional must vanish where the displacement does.")
        return row


class ControlledSystem:
    """The reduced system of a step in which a displacement is prescribed and the load is found.

    The residual is affine in the load factor, ``r + load q``. At given unknowns the load factor
    is that for which the residual's norm is least, which leaves it orthogonal to q; a Newton step
    y solves ``K y = F + m q`` with m such that ``row . (x - y)`` is the step's share of the
    displacement (Batoz & Dhatt 1979: two solves with one factor). Both vanish at the solution
    of residual and control together.

    Args:
        reduced: The system at a given load factor, its step begun.
        control: What is prescribed.
        goal: Its value at the end of the step.
        bodies: All bodies of the problem.

    Attributes:
        terms, tangent, balance, levels, resistance: Those of the reduced system.
        softens: Whether tangents may be indefinite: they are, where the load falls.

    Raises:
        MPMError: Nothing in the residual scales with the load, or more than linearly, or no
            unknown moves what is prescribed.
    """

    softens = True

    def __init__(
        self,
        reduced: ReducedSystem,
        control: DisplacementControl,
        goal: float,
        bodies: list[Particles],
    ) -> None:
        self._reduced = reduced
        self.terms, self.tangent, self.balance = reduced.terms, reduced.tangent, reduced.balance
        self.levels, self.resistance = reduced.levels, reduced.resistance
        self._bodies = bodies
        self._start = float(bodies[0].load.value)
        self._size = float(control.row().norm())
        self._row = reduced.unknowns.functional(control.particles, control.row())
        if any(field.prescribed.changes for field in reduced.fields):
            raise MPMError(
                "Under displacement control Dirichlet values stay as they are, but some differ "
                "from those of the last step; move them before, by problem.step() or a path."
            )
        self._gap = goal - control.present()
        if self._row.norm() <= EQUAL * self._size:
            raise MPMError(
                "No unknown of the background moves the controlled displacement; control that of "
                "a point that is not held."
            )
        curvature, size = reduced.balance.load_derivative(order=2)
        if _norm(curvature) > NEGLIGIBLE * size:
            raise MPMError(
                "Displacement control needs a residual that is affine in particles.load, such as "
                "loads that are proportional to it."
            )
        self._find_slope()
        if self._slope.norm() == 0.0:
            raise MPMError(
                "Displacement control needs a load to find, but nothing in the residual scales "
                "with particles.load."
            )

    def _find_slope(self) -> None:
        """Take the derivative of the residual by the load factor at the present displacement."""
        self._on_all, _ = self._reduced.balance.load_derivative()
        self._slope = self._reduced.unknowns.restricted(self._on_all)

    @property
    def load(self) -> float:
        """The load factor of the last residual."""
        return float(self._bodies[0].load.value)

    def _set_load(self, load: float) -> None:
        for body in self._bodies:
            np.copyto(body.load.value, load)

    def residual(self, x: PETSc.Vec, F: PETSc.Vec) -> MPMError | None:
        """Evaluate the residual at x and the load factor that leaves least of it."""
        self._set_load(self._start)
        failure = self._reduced.residual(x, F)
        if failure is not None:
            return failure
        if self._reduced.terms.follow_load:
            self._find_slope()
        change = -F.dot(self._slope) / self._slope.dot(self._slope)
        F.axpy(change, self._slope)
        for force, part in zip(self._reduced.unknowns.forces, self._on_all, strict=True):
            force.axpy(change, part)
        self._set_load(self._start + change)
        return None

    def constrain(
        self, y: PETSc.Vec, x: PETSc.Vec | None, solve: Callable[[PETSc.Vec, PETSc.Vec], None]
    ) -> int:
        """Amend a Newton step so that ``x - y`` has the prescribed displacement.

        Args:
            y: Solution of ``K y = F``; changed.
            x: The unknowns; ``None`` is zero.
            solve: Solves with the same factor.

        Returns:
            1 where the load falls as the displacement grows, else 0: the negative eigenvalues of
            a tangent that is positive definite on steps without that displacement.

        Raises:
            MPMError: The load does not move the prescribed displacement.
        """
        w = self._slope.duplicate()
        solve(self._slope, w)
        moved = self._row.dot(w)
        if abs(moved) <= EQUAL * self._size * self._reduced.resistance.motion(w):
            raise MPMError(
                "The load does not move the controlled displacement; control another one."
            )
        wanted = (0.0 if x is None else self._row.dot(x)) - self._gap
        y.axpy((wanted - self._row.dot(y)) / moved, w)
        return int(moved < 0.0)

    def prediction(self) -> PETSc.Vec | None:
        """Return unknowns to expect, with the prescribed displacement, if the past says any."""
        x = self._reduced.prediction()
        moved = 0.0 if x is None else self._row.dot(x)
        if x is None or self._gap == 0.0 or not 0.5 < moved / self._gap < 2.0:
            return None
        x.scale(self._gap / moved)
        return x

    def impose(self) -> bool:
        """Impose the displacement from now on."""
        self._reduced.impose()
        return True

    def lift(self) -> PETSc.Vec:
        """Return the forces of the present load, by which a prediction is judged.

        Multiples of q change no step that :meth:`constrain` has amended.
        """
        forces = self._slope.copy()
        forces.scale(self._start)
        return forces

    def scale(self, F: PETSc.Vec | None = None) -> float:
        """Return the size of external forces and reactions, by which a residual is judged."""
        return max(self._reduced.scale(F), abs(self.load) * _norm(self._on_all))

    def work_tells(self) -> bool:
        """Return that work tells nothing, since the load factor follows the unknowns."""
        return False


def _norm(vectors: Sequence[PETSc.Vec]) -> float:
    return float(np.linalg.norm([vector.norm() for vector in vectors]))


def _vector(value: Any, particles: Particles, name: str) -> NDArray[np.float64]:
    gdim = particles.mesh.geometry.dim
    array = as_finite(value, gdim)
    if array is None:
        raise MPMError(f"{name} must be {gdim} finite numbers, not {value!r}.")
    return array
