# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The derivative of one step.

A step solves ``T^T r(u, h_n, p) + G y = 0`` for the increment y of the background, with
``u = u_n + T y``, and then ``h = H(u, h_n, p)``. T is that at the positions of u_n and changes with
these by ``D_v``, of which the rows are ``grad N . v`` at the nodes of the body. With dashes for
derivatives by a parameter

    u' = u_n' + D_(u_n') y + T y',
    T^T r'(u', h_n', 1) + D_(u_n')^T r + G y' + G' y = 0,

where r' is the derivative of the forces in the direction of all that they depend on. It is a
central difference, and so is that of H: whatever law, load or support there is takes part. The
tangent of the step, factorised at its end, gives y'. One that is not quite the derivative costs
further evaluations, not accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError
from ..materials.base import State
from ..parallel.magnitudes import norm
from ..particles.particles import Particles
from ..problems.particle_problem import ParticleProblem
from ..stepping.loading import Stepper
from ..transfer.matrix import transfer_matrix
from .nearby import Nearby, Rates, varying
from .parameters import CHANGE, Parameter

__all__ = ["StepDerivative"]

type Array = NDArray[np.float64]

#: What the residual of a derivative falls to, relative to what it begins with; what of it is
#: round-off of differences, relative to the forces; most corrections; and what must not be left.
SOLVED, NOISE, MOST, LEFT = 1e-10, 1e-8, 6, 1e-3


class _Side(NamedTuple):
    """Forces on own dofs of each V, what laws answer and what they have seen, beside the state."""

    forces: list[Array]
    states: list[list[State]]
    seen: list[Array]


class StepDerivative:
    """A step that is solved, to be differentiated by one parameter after the other (collective).

    Args:
        problem: The problem.
        stepper: What has solved the step.
        nearby: The state at its end, which is held.
    """

    def __init__(self, problem: ParticleProblem, stepper: Stepper, nearby: Nearby) -> None:
        self._problem, self._stepper, self._nearby = problem, stepper, nearby
        self._reduced = stepper.reduced
        self._fields = self._reduced.fields
        self._solve = stepper.newton.linearise()
        self._size = self._reduced.scale()
        self._y = [field.u.copy() for field in self._fields]
        self._r = self._reduced.terms.last_nodal_forces()
        self._bases = [body.node_gradients() for body in problem.bodies]

    def by(self, parameter: Parameter, rates: Rates) -> Rates:
        """Return the derivatives at the end of the step from those at its beginning.

        Raises:
            MPMError: There is no state beside that of the step, or no solution.
        """
        prescribed, moduli = self._prescribed(parameter, rates), self._moduli(parameter, rates)
        turns = [self._turn(number, rates) for number in range(len(self._bases))]
        y_rate = self._lifts(prescribed, rates.prescribed)
        motion = [_copy(function) for function in rates.displacement]
        for body, function, turn in zip(self._problem.bodies, motion, turns, strict=True):
            _add(function, turn, self._y[self._field_of(body)])
        self._move(motion, y_rate)
        held = self._held(parameter, moduli, turns)
        first, last = 0.0, np.inf
        for tried in range(MOST + 1):
            sides = [self._beside(parameter, sign, rates, motion) for sign in (1.0, -1.0)]
            forces = self._forces(parameter, sides)
            self._add_background(forces, held, y_rate)
            rest = self._reduced.unknowns.restricted(forces)
            size = norm(rest)
            first = first or size
            small = max(SOLVED * first, NOISE * self._size * CHANGE / parameter.change)
            if size <= small or size > 0.5 * last or tried == MOST:
                break
            last = size
            step = rest.duplicate()
            self._solve(rest, step)
            step.scale(-1.0)
            changes = [field.on_background(step) for field in self._fields]
            for total, change in zip(y_rate, changes, strict=True):
                total.axpy(1.0, change)
            self._move(motion, changes)
        if size > max(small, LEFT * first):
            raise MPMError(
                f"The derivative by {parameter.name} was not found: {size / first:.1e} of its "
                "residual is left. A tangent is far from its derivative "
                "(mpm.materials.check_tangent), or the step ends between two branches of a law."
            )
        after, before = sides
        return replace(
            rates,
            displacement=motion,
            states=[
                [parameter.rate(*pair) for pair in zip(*own, strict=True)]
                for own in zip(after.states, before.states, strict=True)
            ],
            seen=[parameter.slope(*pair) for pair in zip(after.seen, before.seen, strict=True)],
            prescribed=prescribed,
            reactions=[force.array_r.copy() for force in forces],
            moduli=moduli,
        )

    def _field_of(self, body: Particles) -> int:
        """Return the number of the field that moves a body."""
        every = enumerate(self._fields)
        return next(n for n, field in every if any(one is body for one in field.bodies))

    # -- What the step's beginning and its conditions change -------------------------------

    def _turn(self, number: int, rates: Rates) -> PETSc.Mat:
        """Return D of a body: how T changes as its nodes move."""
        body, basis = self._problem.bodies[number], self._bases[number]
        assert basis.gradients is not None
        motion = rates.displacement[number].x.array.reshape(-1, basis.gradients.shape[2])
        values = np.einsum("nki,ni->nk", basis.gradients, motion[: len(basis.nodes)])
        return transfer_matrix(basis._replace(values=values), body.W, body.V)

    def _prescribed(self, parameter: Parameter, rates: Rates) -> list[Array]:
        """Return the derivative of the Dirichlet totals at the step's end."""
        run = self._stepper.run
        base = [] if run is None else run.base

        if not parameter.outside and not any(np.any(rate) for rate in rates.base):
            return rates.base

        def totals(sign: float) -> list[Array]:
            amount = sign * parameter.change
            parameter.shift(amount)
            if run is not None:
                run.base = [b + amount * rate for b, rate in zip(base, rates.base, strict=True)]
            return self._stepper.prescribed()

        try:
            pairs = zip(totals(1.0), totals(-1.0), strict=True)
            return [parameter.slope(*pair) for pair in pairs]
        finally:
            parameter.shift(0.0)
            if run is not None:
                run.base = base

    def _lifts(self, now: Sequence[Array], before: Sequence[Array]) -> list[PETSc.Vec]:
        """Return increments of the backgrounds by changes of Dirichlet totals."""
        found = []
        for field, y, *totals in zip(self._fields, self._y, now, before, strict=True):
            change = (totals[0] - totals[1])[: y.getLocalSize()]
            found.append(field.driven(change).copy())
            y.copy(field.u)
        return found

    def _moduli(self, parameter: Parameter, rates: Rates) -> dict[int, Array]:
        """Return derivatives of the moduli of penalties, which are those of their first step."""
        new = [
            number
            for number, field in enumerate(self._fields)
            if field.moduli is not None and number not in rates.moduli
        ]
        if not new:
            return rates.moduli
        bodies = self._problem.bodies
        offsets = [body.converged_displacement - body.displacement.x.array for body in bodies]

        def moduli(sign: float) -> list[Array]:
            self._nearby.go(parameter, sign * parameter.change, rates)
            for body, offset in zip(bodies, offsets, strict=True):
                body.displacement.x.array[:] += offset
            self._require(self._reduced.balance.evaluate(), parameter)
            return [np.array(self._reduced.terms.shear_moduli(self._fields[n])) for n in new]

        pairs = zip(moduli(1.0), moduli(-1.0), strict=True)
        found = [parameter.slope(*pair) for pair in pairs]
        return rates.moduli | dict(zip(new, found, strict=True))

    def _held(
        self, parameter: Parameter, moduli: dict[int, Array], turns: Sequence[PETSc.Mat]
    ) -> list[PETSc.Vec]:
        """Return ``D^T r + G' y`` on own dofs of each V."""
        found = [y.duplicate() for y in self._y]
        for force in found:
            force.set(0.0)
        for body, turn, r in zip(self._problem.bodies, turns, self._r, strict=True):
            nodal, force = turn.createVecLeft(), found[self._field_of(body)]
            nodal.array_w[:] = r
            turn.multTransposeAdd(nodal, force, force)
        for number, rate in moduli.items():
            field = self._fields[number]
            own = np.array(field.moduli)
            if np.any(rate):
                for sign in (1.0, -1.0):
                    moduli_beside = own + sign * parameter.change * rate
                    part = field.penalty_force(moduli_beside.tolist())
                    found[number].axpy(sign / (2.0 * parameter.change), part)
        return found

    # -- The solution -----------------------------------------------------------------------

    def _beside(
        self, parameter: Parameter, sign: float, rates: Rates, motion: Sequence[fem.Function]
    ) -> _Side:
        """Return an evaluation on one side of the state, in the direction of a motion."""
        points = self._problem.material_points()
        arrays = [function.x.array for function in motion]
        self._nearby.go(parameter, sign * parameter.change, rates, arrays)
        with ExitStack() as blocks:
            for own in points:
                blocks.enter_context(own.without_tangents())
            self._require(self._reduced.balance.evaluate(), parameter)
        return _Side(
            [force.array_r.copy() for force in self._reduced.unknowns.forces],
            [[varying(state) for state in own.states(trial=True)] for own in points],
            [own.seen_gradient(trial=True) for own in points],
        )

    def _forces(self, parameter: Parameter, sides: Sequence[_Side]) -> list[PETSc.Vec]:
        """Return derivatives of forces."""
        found = []
        for y, *pair in zip(self._y, *(side.forces for side in sides), strict=True):
            force = y.duplicate()
            force.array_w[:] = parameter.slope(*pair)
            found.append(force)
        return found

    def _add_background(
        self, forces: Sequence[PETSc.Vec], held: Sequence[PETSc.Vec], y_rate: Sequence[PETSc.Vec]
    ) -> None:
        """Add to derivatives of forces what does not come of the bodies' motion."""
        for field, force, known, rate in zip(self._fields, forces, held, y_rate, strict=True):
            more = known.copy()
            field.add_product(rate, more, partial(self._reduced.terms.shear_moduli, field))
            force.axpy(1.0, more)

    def _move(self, motion: Sequence[fem.Function], changes: Sequence[PETSc.Vec]) -> None:
        """Add to a motion of the bodies that of the backgrounds."""
        for body, function in zip(self._problem.bodies, motion, strict=True):
            _add(function, body.T, changes[self._field_of(body)])

    @staticmethod
    def _require(failure: MPMError | None, parameter: Parameter) -> None:
        """Raise an error where there is no state beside that of the step."""
        if failure is not None:
            raise MPMError(f"There is no derivative by {parameter.name} at this step: {failure}")


def _copy(function: fem.Function) -> fem.Function:
    other = fem.Function(function.function_space, name=function.name)
    other.x.array[:] = function.x.array
    return other


def _add(function: fem.Function, matrix: PETSc.Mat, change: PETSc.Vec) -> None:
    """Add the product of a matrix on V to a Function on W (collective)."""
    part = matrix.createVecLeft()
    matrix.mult(change, part)
    function.x.array[: part.getLocalSize()] += part.array_r
    function.x.scatter_forward()
