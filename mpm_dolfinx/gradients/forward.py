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
from dataclasses import replace
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError
from ..materials.base import State
from ..parallel.magnitudes import norm
from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..problems.motion import MovingProblem
from ..problems.problem import Problem
from ..stepping.trial import Trial
from ..system.value_field import ValueField
from ..tolerances import DIFFERENCE
from .nearby import Nearby, Rates, add_product, followed, varying
from .parameters import Parameter
from .slopes import Slopes, along
from .velocities import Beginning, TakenVelocities, driven_on

__all__ = ["StepDerivative"]

type Array = NDArray[np.float64]

#: What the residual of a derivative falls to, relative to what it begins with; what of it is
#: round-off of differences, relative to the forces; most corrections; and what must not be left.
SOLVED, NOISE, MOST, LEFT = 1e-10, 1e-7, 6, 1e-3


class _Side(NamedTuple):
    """The end of a step beside the state.

    Attributes:
        forces: On own dofs of each V.
        states: What laws answer.
        seen: What they have seen.
        kept: What the next step begins with besides.
        begun: What a motion begins with.
    """

    forces: list[Array]
    states: list[list[State]]
    seen: list[Array]
    kept: list[Array]
    begun: Beginning = Beginning([], [])


class StepDerivative:
    """A step that is solved, to be differentiated by one parameter after the other (collective).

    Args:
        problem: The problem.
        trial: What has solved the step.
        nearby: The state at its end, which is held.
    """

    def __init__(self, problem: Problem, trial: Trial, nearby: Nearby) -> None:
        self._problem, self._trial, self._nearby = problem, trial, nearby
        self._reduced = trial.reduced
        self._fields = self._reduced.fields
        self._solve = trial.newton.linearise()
        self._size = self._reduced.scale()
        self._y = [field.u.copy() for field in self._fields]
        self._own = [field.changes() for field in self._fields]
        self._z = [y.copy() for y in self._y]
        for z, field in zip(self._z, self._fields, strict=True):
            if isinstance(field, ValueField):
                z.axpy(1.0, field.start)
        self._things = self._reduced.bodies
        self._slopes = [Slopes(thing) for thing in self._things]
        places = followed(problem)
        self._numbers = [
            next(n for n, one in enumerate(places) if one is thing) for thing in self._things
        ]
        self._of_fields = [
            self._fields.index(self._reduced.unknowns.place(thing)[0]) for thing in self._things
        ]
        pairs = zip(self._slopes, self._of_fields, strict=True)
        self._slopes_of_z = [slopes.of(self._z[field]) for slopes, field in pairs]
        self._r = []
        for thing, force in zip(self._things, self._reduced.terms.last_nodal_forces(), strict=True):
            self._r.append(thing.T.createVecLeft())
            self._r[-1].array_w[:] = force
        self._moving = problem if isinstance(problem, MovingProblem) else None
        projected = None if self._moving is None else self._moving.inertia.projected
        self._velocities: TakenVelocities | None = None
        if self._moving is not None and projected is not None:
            self._velocities = TakenVelocities(self._moving, projected, self._slopes)

    def by(self, parameter: Parameter, rates: Rates) -> Rates:
        """Return the derivatives at the end of the step from those at its beginning.

        Raises:
            MPMError: There is no state beside that of the step, or no solution.
        """
        prescribed = self._prescribed(parameter, rates)
        carried = [self._carried(thing, rates) for thing in self._things]
        changes = self._changes(prescribed, rates.prescribed)
        taken: list[PETSc.Vec] | None = None
        moduli = self._moduli(parameter, rates)
        y_rate = self._lifts(prescribed, rates.prescribed)
        motion = [_copy(function) for function in rates.motion]
        for thing, number, slope, v in zip(
            self._things, self._numbers, self._slopes_of_z, carried, strict=True
        ):
            if isinstance(thing, CarriedField) and thing.total:
                motion[number].x.array[:] = 0.0
            turned = along(slope, v)
            motion[number].x.array[: len(turned)] += turned
        self._move(motion, y_rate)
        held = self._held(parameter, moduli, carried)
        first, last = 0.0, np.inf
        signs = [1.0, -1.0]
        for tried in range(MOST + 1):
            signs.reverse()  # it goes on where it is
            whole = tried > 0  # what the step leaves is of a motion that has been corrected
            found = {}
            for sign in signs:
                self._go(parameter, sign, rates, motion)
                amount = sign * parameter.change
                beside = [own + amount * r for own, r in zip(self._own, changes, strict=True)]
                found[sign] = self._end(amount, beside, taken) if whole else self._begun(beside)
            sides = [found[1.0], found[-1.0]]
            if self._velocities is not None and not whole:
                taken = self._velocities.by(parameter, carried, [side.begun for side in sides])
            forces = self._forces(parameter, sides)
            self._add_background(forces, held, y_rate)
            rest = self._reduced.unknowns.restricted(forces)
            size = norm(rest)
            first = first or size
            small = max(SOLVED * first, NOISE * self._size * DIFFERENCE / parameter.change)
            if whole and (size <= small or size > 0.5 * last or tried == MOST):
                break
            last = size
            step = rest.duplicate()
            self._solve(rest, step)
            step.scale(-1.0)
            more = [field.on_background(step) for field in self._fields]
            for total, part in zip(y_rate, more, strict=True):
                total.axpy(1.0, part)
            self._move(motion, more)
        if size > max(small, LEFT * first):
            raise MPMError(
                f"The derivative by {parameter.name} was not found: {size / first:.1e} of its "
                "residual is left. A tangent is far from its derivative "
                "(mpm.materials.check_tangent), or the step ends between two branches of a law."
            )
        after, before = sides
        return replace(
            rates,
            motion=motion,
            states=[
                [parameter.rate(*pair) for pair in zip(*own, strict=True)]
                for own in zip(after.states, before.states, strict=True)
            ],
            seen=[parameter.slope(*pair) for pair in zip(after.seen, before.seen, strict=True)],
            kept=[parameter.slope(*pair) for pair in zip(after.kept, before.kept, strict=True)],
            prescribed=prescribed,
            reactions=[force.array_r.copy() for force in forces],
            moduli=moduli,
        )

    # -- What the step's beginning and its conditions change -------------------------------

    def _carried(self, thing: Particles | CarriedField, rates: Rates) -> Array:
        """Return how the nodes of a body, or of a field on it, move at the step's beginning."""
        body = thing.field.particles if isinstance(thing, CarriedField) else thing
        place = next(n for n, one in enumerate(self._problem.bodies) if one is body)
        return thing.carried_by(rates.motion[place].x.array)

    def _changes(self, now: Sequence[Array], before: Sequence[Array]) -> list[Array]:
        """Return derivatives of changes of Dirichlet values, on own dofs of each background."""
        pairs = zip(now, before, self._y, strict=True)
        return [(after - start)[: y.getLocalSize()] for after, start, y in pairs]

    def _prescribed(self, parameter: Parameter, rates: Rates) -> list[Array]:
        """Return the derivative of the Dirichlet totals at the step's end."""
        run = self._trial.run
        base = [] if run is None else run.base

        if not parameter.outside and not any(np.any(rate) for rate in rates.base):
            return rates.base

        def totals(sign: float) -> list[Array]:
            amount = sign * parameter.change
            parameter.shift(amount)
            if run is not None:
                run.base = [b + amount * rate for b, rate in zip(base, rates.base, strict=True)]
            return self._trial.prescribed()

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
        for field, total, last in zip(self._fields, now, before, strict=True):
            whole = isinstance(field, ValueField) and field.carried[0].total
            found.append(driven_on(field, total if whole else total - last))
        return found

    def _moduli(self, parameter: Parameter, rates: Rates) -> dict[int, Array]:
        """Return derivatives of the moduli of penalties, as their first step begins."""
        new = [
            number
            for number, field in enumerate(self._fields)
            if field.acting.moduli is not None and number not in rates.moduli
        ]
        if not new:
            return rates.moduli
        bodies = self._problem.bodies
        offsets = [body.converged_displacement - body.displacement.x.array for body in bodies]

        def moduli(sign: float) -> list[Array]:
            arrays = [function.x.array for function in rates.motion]
            self._nearby.go(parameter, sign * parameter.change, rates, arrays)
            for body, offset in zip(bodies, offsets, strict=True):
                body.displacement.x.array[:] += offset
            self._require(self._reduced.balance.evaluate_beside(), parameter)
            return [np.array(self._reduced.terms.shear_moduli(self._fields[n])) for n in new]

        pairs = zip(moduli(1.0), moduli(-1.0), strict=True)
        found = [parameter.slope(*pair) for pair in pairs]
        return rates.moduli | dict(zip(new, found, strict=True))

    def _held(
        self, parameter: Parameter, moduli: dict[int, Array], carried: Sequence[Array]
    ) -> list[PETSc.Vec]:
        """Return ``D^T r + G' y`` on own dofs of each V."""
        found = [y.duplicate() for y in self._y]
        for force in found:
            force.set(0.0)
        for number, slopes, v, r in zip(
            self._of_fields, self._slopes, carried, self._r, strict=True
        ):
            slopes.add_transposed(v, r, found[number])
        for number, rate in moduli.items():
            field = self._fields[number]
            own = np.array(field.acting.moduli)
            if np.any(rate):
                for sign in (1.0, -1.0):
                    moduli_beside = own + sign * parameter.change * rate
                    part = field.acting.penalty_force(field.u, moduli_beside.tolist())
                    found[number].axpy(sign / (2.0 * parameter.change), part)
        return found

    # -- The solution -----------------------------------------------------------------------

    def _go(
        self, parameter: Parameter, sign: float, rates: Rates, motion: Sequence[fem.Function]
    ) -> None:
        """Go to one side of the state, in the direction of a motion, and evaluate forces."""
        arrays = [function.x.array for function in motion]
        self._nearby.go(parameter, sign * parameter.change, rates, arrays)
        self._require(self._reduced.balance.evaluate_beside(), parameter)

    def _begun(self, changes: Sequence[Array]) -> _Side:
        """Return the forces of this side, and what a motion begins with there."""
        side = _Side(self._evaluated(), [], [], [])
        if self._velocities is None:
            return side
        return side._replace(begun=self._velocities.beside(changes))

    def _end(
        self, amount: float, changes: Sequence[Array], taken: Sequence[PETSc.Vec] | None
    ) -> _Side:
        """Return this side of the step's end.

        Args:
            amount: Change of the parameter.
            changes: Of Dirichlet values.
            taken: Derivatives of the velocities that the background can follow, if it does.
        """
        points = self._problem.points
        forces = self._evaluated()
        # (what follows may ask the laws again, which may answer in the same arrays)
        states = [[_copies(varying(one)) for one in own.trial.states] for own in points]
        seen = [own.trial.gradient.copy() for own in points]
        if self._moving is None:
            kept = self._problem.at_end()
        elif taken is None:
            kept = self._moving.after_motion(changes)
        else:
            kept = self._moving.after_motion(changes, self._taken(amount, taken))
        return _Side(forces, states, seen, [array.copy() for array in kept])

    def _evaluated(self) -> list[Array]:
        """Return the forces of the last evaluation."""
        return [force.array_r.copy() for force in self._reduced.unknowns.forces]

    def _taken(self, amount: float, rates: Sequence[PETSc.Vec]) -> list[PETSc.Vec]:
        """Return the velocities that the background can follow, with a change."""
        assert self._moving is not None and self._moving.inertia.projected is not None
        found = [v.copy() for v in self._moving.inertia.projected.velocity]
        for velocity, rate in zip(found, rates, strict=True):
            velocity.axpy(amount, rate)
        return found

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
            field.acting.add_product(rate, force)
            force.axpy(1.0, known)

    def _move(self, motion: Sequence[fem.Function], changes: Sequence[PETSc.Vec]) -> None:
        """Add to a motion of the bodies that of the backgrounds."""
        for thing, number, field in zip(self._things, self._numbers, self._of_fields, strict=True):
            add_product(motion[number], thing.T, changes[field])

    @staticmethod
    def _require(failure: MPMError | None, parameter: Parameter) -> None:
        """Raise an error where there is no state beside that of the step."""
        if failure is not None:
            raise MPMError(f"There is no derivative by {parameter.name} at this step: {failure}")


def _copies(state: State) -> State:
    return {name: values.copy() for name, values in state.items()}


def _copy(function: fem.Function) -> fem.Function:
    other = fem.Function(function.function_space, name=function.name)
    other.x.array[:] = function.x.array
    return other
