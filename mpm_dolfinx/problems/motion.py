# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Common part of problems of motion: velocities and the account of energies."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..boundary.supports import Support
from ..errors import MPMError, warn
from ..history import Energy
from ..meshes.values import Value, interpolated
from ..particles.particles import Particles
from ..reals import as_finite
from ..stepping.automatic import local_error
from ..system.inertia import Inertia
from ..system.schemes import order_of
from ..system.term import Term
from ..tolerances import NEGLIGIBLE, UNCERTAIN
from .arguments import as_bodies
from .through_time import TimeProblem

__all__ = [
    "MovingProblem",
    "initial_velocities",
    "initial_velocity",
    "rayleigh_of",
    "require_motion",
]


class MovingProblem(TimeProblem):
    """A problem with inertia, made by its heirs, which set what is below before they begin.

    Attributes:
        inertia: The term that has the velocities.
    """

    # (bodies that have met part again, which a joint would not let them)
    keeps_joints = False
    inertia: Inertia
    _energies: list[Energy]

    @override
    def build(self) -> None:
        self.inertia.join(self.bodies)
        self._pace = self.inertia.dt, self.inertia.scheme.share
        super().build()
        self.trial.newton.lets_go = True
        self.reduced.predictor.clear(measures=True)
        others = [term for term in self.terms if term is not self.inertia]
        self.inertia.follow(self, [*self.built.body_terms, *others])

    def stored_and_done(self) -> tuple[float, float]:
        """Return elastic energy, and the work done against stress in the last step (collective).

        No number, and zero, where forms do not say what they store.
        """
        return math.nan, 0.0

    def domain_masses(self, number: int) -> NDArray[np.float64]:
        """Return the consistent mass of each owned domain of a body, ``(n, k, k)`` (collective)."""
        masses = self.built.mass_matrices(number)
        masses[self.bodies[number].deleted] = 0.0
        return masses

    @cached_property
    def _order(self) -> tuple[int, float]:
        """Order and constant of the scheme (collective)."""
        return order_of(self._comm, self.inertia.scheme)

    @override
    def time_error(self, size: float) -> tuple[float | None, float | None]:
        order, constant = self._order
        known = len(self.reduced.predictor.past) >= order
        error, motion = local_error(self.reduced, size, self._comm, order, constant)
        return error if known else None, motion

    # -- What steps begin with ----------------------------------------------------------------

    @abstractmethod
    def _initial_velocities(self) -> list[fem.Function]:
        """Return the velocities that bodies begin with, by what is given now (collective)."""

    @override
    def begin_anew(self) -> None:
        super().begin_anew()
        for own, start in zip(self.inertia.velocities, self._initial_velocities(), strict=True):
            own.x.array[:] = start.x.array

    @override
    def renew_external(self) -> None:
        if self.inertia.dt > 0.0:
            super().renew_external()
            return
        for term in self.built.body_terms:  # at a run's beginning, where no step is on its way
            term.begin()

    @override
    def beginning(self) -> list[NDArray[np.float64]]:
        of_step = [array for term in self.built.body_terms for array in term.beginning()]
        return [*super().beginning(), *of_step, *self.inertia.state.beginning()]

    @override
    def at_end(self) -> list[NDArray[np.float64]]:
        return self.after_motion([field.changes() for field in self.reduced.fields])

    def after_motion(
        self, changes: Sequence[NDArray[np.float64]], taken: Sequence[PETSc.Vec] | None = None
    ) -> list[NDArray[np.float64]]:
        """Return :meth:`at_end` with other Dirichlet values, and velocities (collective).

        Args:
            changes: Of Dirichlet values in the step, on own dofs of each background.
            taken: See :meth:`.Inertia.at_end`.
        """
        of_step = [array for term in self.built.body_terms for array in term.at_end()]
        forces = self._forces_at_end()
        return [*super().at_end(), *of_step, *self.inertia.at_end(forces, changes, taken)]

    def before_motion(self) -> list[NDArray[np.float64]]:
        """Return :meth:`beginning` of a run's first step, after an update (collective)."""
        of_step = [array for term in self.built.body_terms for array in term.at_end()]
        forces = self._forces_at_end()
        return [*super().beginning(), *of_step, *self.inertia.state.beginning(forces)]

    def _forces_at_end(self) -> list[NDArray[np.float64]]:
        """Return forces of all bodies after the last update, on local dofs of W (collective)."""
        found = []
        for body in self.bodies:
            total = fem.Function(body.W)
            for term in self.built.body_terms:
                if term.particles is body:
                    for force in term.forces_at_end():
                        total.x.array[: force.getLocalSize()] += force.array_r
            total.x.scatter_forward()
            found.append(np.asarray(total.x.array, dtype=np.float64))
        return found

    # -- Velocities ---------------------------------------------------------------------------

    @property
    def velocity(self) -> fem.Function | list[fem.Function]:
        """Velocity on W at the last converged step; a list where particles are one.

        As ``particles.displacement`` it is a new Function after a split, rebase or repartition.
        """
        several = isinstance(self.particles, list | tuple)
        return list(self.inertia.velocities) if several else self.inertia.velocities[0]

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy at the last converged step (collective)."""
        return self.inertia.mass().kinetic(self.inertia.velocities)

    @property
    def momentum(self) -> NDArray[np.float64]:
        """Momentum of all bodies at the last converged step, shape ``(gdim,)`` (collective)."""
        return self.inertia.mass().momentum(self.inertia.velocities)

    @property
    def angular_momentum(self) -> NDArray[np.float64]:
        """Angular momentum about the origin (collective).

        Shape ``(1,)`` in the plane, about the axis normal to it, or ``(3,)``.
        """
        return self.inertia.mass().angular_momentum(self.inertia.velocities)

    # -- Through time -------------------------------------------------------------------------

    @override
    def _aim(self, t: float) -> None:
        self.inertia.aim(t)

    @override
    def _begin_run(self, now: float) -> None:
        self.inertia.begin_run(now)
        for recorder in self.trial.recorders:
            recorder.begins()

    _told_of_steps = False

    @override
    def _end_run(self) -> None:
        """Say so, once, where steps are too long for the motion."""
        error = self.history.time_error
        if self._told_of_steps or error is None or error <= UNCERTAIN:
            return
        moved = max(step.motion or 0.0 for step in self.history.steps)
        reach = max(float(np.abs(one.node_positions).max(initial=0.0)) for one in self.bodies)
        if moved <= NEGLIGIBLE * self._comm.allreduce(reach, MPI.MAX):  # round-off of what rests
            return
        self._told_of_steps = True
        times = [energy.time for energy in self._energies]
        longest = float(np.diff(times).max())
        share = f"{100.0 * error:.0f} %" if error < 1.0 else "as large as all"
        warn(
            self._comm,
            f"Time steps of {longest:.3g} are too coarse: their error is estimated to be {share} "
            f"of the motion, if it does not only lead to rest, which forgets it; take "
            f"dt <= {longest * UNCERTAIN / error:.2g}.",
        )

    @override
    def _resume_run(self) -> None:
        self.inertia.resume()

    def reaction(self, bc: fem.DirichletBC | Support | Term) -> NDArray[np.float64]:
        """Return the force of a support on the body: of a Dirichlet condition in the last step.

        That is the mean over the step, but with ``scheme="euler"``, as is that of a contact;
        supports of :mod:`mpm_dolfinx.boundary`, ties and structures have that at its end. See
        :meth:`Problem.reaction`.
        """
        force = super().reaction(bc)
        if isinstance(bc, Support | Term):
            return force
        return self.inertia.scheme.share * force


def initial_velocities(
    velocity: Any, particles: Particles | Sequence[Particles]
) -> list[fem.Function]:
    """Return the velocities that bodies begin with, on W of each (collective).

    Args:
        velocity: What the user gives.
        particles: The body, or a list of bodies.

    Raises:
        MPMError: They are something else, or not finite.
    """
    bodies = as_bodies(particles)
    count = len(bodies) if isinstance(particles, list | tuple) else 0
    velocities = _for_each(velocity, count)
    return [initial_velocity(v, body) for v, body in zip(velocities, bodies, strict=True)]


def require_motion(name: str, options: dict[str, Any]) -> None:
    """Raise an error where options of a problem of equilibrium make no sense in motion."""
    if options.get("background") is not None:
        raise MPMError(
            f"A form on the background has no past, so it cannot act in a {name}; write it as a "
            "term on the bodies."
        )
    if options.get("fields"):
        raise MPMError(f"fields= are for mpm.ParticleProblem; a {name} has displacements alone.")


def _for_each(value: Any, count: int) -> list[Any]:
    """Return one value for each of ``count`` bodies (0: one body that is not in a list)."""
    if not isinstance(value, list) or count == 0:
        return [value] * max(count, 1)
    if len(value) != count:
        raise MPMError(f"There are {count} bodies, but a list of {len(value)} velocities.")
    return value


def rayleigh_of(values: Any) -> tuple[float, float]:
    """Return alpha and beta of Rayleigh damping.

    Raises:
        MPMError: They are not two numbers, or negative.
    """
    found = as_finite(values, 2)
    if found is None or found.min() < 0.0:
        raise MPMError(
            f"rayleigh must be (alpha, beta), two numbers that are finite and not negative, not "
            f"{values!r}."
        )
    alpha, beta = found.tolist()
    return alpha, beta


def initial_velocity(value: Value | None, body: Particles) -> fem.Function:
    """Return an initial velocity on W, none where none is given (collective).

    Raises:
        MPMError: It is something else, or not finite.
    """
    if value is None:
        return fem.Function(body.W, name="velocity")
    return interpolated(value, body.W, "velocity")
