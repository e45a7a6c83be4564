# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The derivative of what a step in time takes over of the velocities before.

That is ``P v = T c``, where ``T^T M (v - T c) = 0``, with M the mass and c the velocity of the
background, the values of which are given where Dirichlet conditions are. With dashes for
derivatives by a parameter, and D as in :mod:`~mpm_dolfinx.gradients.forward`,

    (P v)' = D c + T c',    T^T (M v' + M' (v - T c) - M (P v)') + D^T M (v - T c) = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..particles.particles import Particles
from ..problems.motion import MovingProblem
from ..system.field import Field
from ..system.inertia import Projected
from .parameters import Parameter
from .slopes import Slopes, along

__all__ = ["Beginning", "TakenVelocities", "driven_on"]

type Array = NDArray[np.float64]


class Beginning(NamedTuple):
    """Beginning of a step beside the state.

    Attributes:
        left: M times what velocities are beside P v, on own dofs of W of each body.
        driven: Rates of Dirichlet values, on own dofs of each background.
    """

    left: list[Array]
    driven: list[Array]


class TakenVelocities:
    """The velocities that a step takes over, to be differentiated (collective).

    Args:
        problem: The motion, at the step's end.
        projected: What the step takes over.
        slopes: Of each body.
    """

    def __init__(
        self, problem: MovingProblem, projected: Projected, slopes: Sequence[Slopes]
    ) -> None:
        self._problem, self._projected = problem, projected
        self._unknowns, self._fields = problem.reduced.unknowns, problem.reduced.fields
        self._mass = problem.inertia.mass()
        self._c = []
        for field, values in zip(self._fields, projected.driven, strict=True):
            c = field.on_background(projected.unknowns)
            c.axpy(1.0, driven_on(field, values))
            self._c.append(c)
        self._slopes = slopes
        self._slopes_of_c = [
            own.of(self._c[self._place(body)])
            for body, own in zip(problem.bodies, slopes, strict=True)
        ]
        self._rest = problem.inertia.step.not_followed(
            problem.inertia.velocities, projected.velocity
        )

    def beside(self, changes: Sequence[Array]) -> Beginning:
        """Return the start of the step in a state beside, which the problem is in.

        Args:
            changes: Of Dirichlet values, on own dofs of each background.
        """
        inertia = self._problem.inertia
        left = inertia.step.not_followed(inertia.velocities, self._projected.velocity)
        driven = inertia.state.driven(changes, inertia.dt)
        return Beginning([v.array_r.copy() for v in left], driven)

    def by(
        self, parameter: Parameter, carried: Sequence[Array], sides: Sequence[Beginning]
    ) -> list[PETSc.Vec]:
        """Return the derivatives of P v on W of each body.

        Args:
            parameter: The parameter.
            carried: How the nodes of each body move at the step's beginning.
            sides: :meth:`beside` at its change, and at minus that.
        """
        (after, driven_after), (before, driven_before) = sides
        c_rate = [
            driven_on(field, parameter.slope(*pair))
            for field, *pair in zip(self._fields, driven_after, driven_before, strict=True)
        ]
        taken = self._moved(carried, c_rate)
        totals = self._unknowns.zeros()
        for body, slopes, v, moved, rest, *pair in zip(
            self._problem.bodies,
            self._slopes,
            carried,
            self._mass.times(taken),
            self._rest,
            after,
            before,
            strict=True,
        ):
            moved.array_w[:] = parameter.slope(*pair) - moved.array_r
            self._unknowns.add([body], [moved], totals)
            slopes.add_transposed(v, rest, totals[self._place(body)])
        y = self._projected.solve(self._unknowns.restricted(totals))
        for c, field in zip(c_rate, self._fields, strict=True):
            c.axpy(1.0, field.on_background(y))
        return self._moved(carried, c_rate)

    def _place(self, body: Particles) -> int:
        """Return the number of the field that moves a body."""
        return self._fields.index(self._unknowns.place(body)[0])

    def _moved(self, carried: Sequence[Array], c_rate: Sequence[PETSc.Vec]) -> list[PETSc.Vec]:
        """Return ``D c + T c'`` on W of each body."""
        found = []
        for body, slope, v in zip(self._problem.bodies, self._slopes_of_c, carried, strict=True):
            found.append(body.T.createVecLeft())
            body.T.mult(c_rate[self._place(body)], found[-1])
            found[-1].array_w[:] += along(slope, v)
        return found


def driven_on(field: Field, values: Array) -> PETSc.Vec:
    """Return :meth:`.Field.driven`, and leave the field's increment as it is (collective)."""
    kept = field.u.copy()
    found = field.driven(values[: kept.getLocalSize()]).copy()
    kept.copy(field.u)
    return found
