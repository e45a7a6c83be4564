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

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..problems.motion import MovingProblem
from ..system.field import Field
from ..system.inertia import Projected
from .nearby import Nearby, Rates
from .parameters import Parameter

__all__ = ["TakenVelocities", "driven_on"]

type Array = NDArray[np.float64]


class TakenVelocities:
    """The velocities that a step takes over, to be differentiated (collective).

    Args:
        problem: The motion.
        projected: What the step takes over.
        nearby: The state at its end, which is held.
    """

    def __init__(self, problem: MovingProblem, projected: Projected, nearby: Nearby) -> None:
        self._problem, self._nearby, self._projected = problem, nearby, projected
        self._unknowns, self._fields = problem.reduced.unknowns, problem.reduced.fields
        self._mass = problem.inertia.mass()
        self._c = []
        for field, values in zip(self._fields, projected.driven, strict=True):
            c = field.on_background(projected.unknowns)
            c.axpy(1.0, driven_on(field, values))
            self._c.append(c)
        self._rest = problem.inertia.step.not_followed(
            problem.inertia.velocities, projected.velocity
        )

    def by(
        self,
        parameter: Parameter,
        rates: Rates,
        turns: Sequence[PETSc.Mat],
        changes: Sequence[Array],
    ) -> tuple[list[PETSc.Vec], list[PETSc.Vec]]:
        """Return the derivatives of P v on W of each body, and of c on each background.

        Args:
            parameter: The parameter.
            rates: Derivatives at the step's beginning.
            turns: D of each body.
            changes: Derivatives of changes of Dirichlet values, on own dofs of each background.
        """
        inertia, own = self._problem.inertia, [field.changes() for field in self._fields]
        sides = []
        for sign in (1.0, -1.0):
            amount = sign * parameter.change
            self._nearby.go(parameter, amount, rates)
            left = inertia.step.not_followed(inertia.velocities, self._projected.velocity)
            beside = [c + amount * rate for c, rate in zip(own, changes, strict=True)]
            sides.append(
                ([v.array_r.copy() for v in left], inertia.state.driven(beside, inertia.dt))
            )
        (after, driven_after), (before, driven_before) = sides
        c_rate = [
            driven_on(field, parameter.slope(*pair))
            for field, *pair in zip(self._fields, driven_after, driven_before, strict=True)
        ]
        taken = [self._moved(number, turn, self._c, c_rate) for number, turn in enumerate(turns)]
        totals = self._unknowns.zeros()
        for body, turn, moved, rest, *pair in zip(
            self._problem.bodies,
            turns,
            self._mass.times(taken),
            self._rest,
            after,
            before,
            strict=True,
        ):
            moved.array_w[:] = parameter.slope(*pair) - moved.array_r
            self._unknowns.add([body], [moved], totals)
            total = totals[self._fields.index(self._unknowns.place(body)[0])]
            turn.multTransposeAdd(rest, total, total)
        y = self._projected.solve(self._unknowns.restricted(totals))
        for c, field in zip(c_rate, self._fields, strict=True):
            c.axpy(1.0, field.on_background(y))
        return [self._moved(n, turn, self._c, c_rate) for n, turn in enumerate(turns)], c_rate

    def _moved(
        self, number: int, turn: PETSc.Mat, c: Sequence[PETSc.Vec], c_rate: Sequence[PETSc.Vec]
    ) -> PETSc.Vec:
        """Return ``D c + T c'`` on W of a body."""
        body = self._problem.bodies[number]
        place = self._fields.index(self._unknowns.place(body)[0])
        moved = turn.createVecLeft()
        body.T.mult(c_rate[place], moved)
        turn.multAdd(c[place], moved, moved)
        return moved


def driven_on(field: Field, values: Array) -> PETSc.Vec:
    """Return :meth:`.Field.driven`, and leave the field's increment as it is (collective)."""
    kept = field.u.copy()
    found = field.driven(values[: kept.getLocalSize()]).copy()
    kept.copy(field.u)
    return found
