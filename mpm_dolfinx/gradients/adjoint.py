# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of a functional by any number of parameters, by going through a run backward."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem
from ufl.algorithms.analysis import extract_coefficients

from ..constitutive.moduli import undeformed_tangent
from ..errors import MPMError, agree
from ..materials.base import State
from ..parallel.boundary import collective, of_user
from ..parallel.given import require_same
from ..problems.quasistatic import QuasiStaticProblem
from ..problems.through_time import TimeProblem
from ..reals import as_reals
from ..stepping.trial import Trial
from ..tolerances import DIFFERENCE
from .backward import Backward, Record, Weights, copied, no_weights
from .followed import Followed, require_followed
from .laws import Laws
from .many import Many, assembled
from .nearby import varying

__all__ = ["Adjoint"]

type Array = NDArray[np.float64]
type Sides = tuple[Array, Array]

#: Of so many steps what materials keep is noted once, and found again for the others.
KEPT = 8


@dataclass
class _First:
    """Effects of a parameter before the first step, at the points and cells of each body.

    Attributes:
        states: Derivatives of what materials keep, by the amount; what has none is left out.
        stiffness: Of that of supports, in each cell.
        tangent: Of ``W C_iJiJ`` of undeformed points, shape ``(n nq, gdim, gdim)``.
        modulus: Of the modulus of F-bar, in each cell, or ``None``.
    """

    states: list[list[State]]
    stiffness: list[list[Array]]
    tangent: list[Array]
    modulus: list[Array | None]


class Adjoint:
    """Derivatives of a functional by any number of parameters (collective).

    It is made before the first step, and kept; it notes each step, and :meth:`of` goes through
    them backward, at the cost of about one run whatever the number of parameters::

        young = fem.Function(fem.functionspace(body, ("DG", 0)))
        law = mpm.materials.Hencky(young, 0.3)
        problem = mpm.QuasiStaticProblem(mpm.Body(particles, law), bcs)
        adjoint = mpm.Adjoint(problem, [young])
        problem.solve(steps=20)
        d = particles.displacement
        (slope,) = adjoint.of(0.5 * ufl.inner(d - measured, d - measured) * ds(1))

    Like those of a :class:`Sensitivity` the derivatives are those of the discrete run, with its
    history, its moving domains and its stabilisation.

    Args:
        problem: A :class:`QuasiStaticProblem`.
        parameters: By what to differentiate: Functions, each value by itself (DG0 ones of laws, or
            of loads), Constants, and pairs of a material and the name of one of its numbers.

    Attributes:
        problem: As given.

    Raises:
        MPMError: Something that cannot be differentiated (yet), or a problem that has begun.
    """

    @collective("parameters")
    def __init__(self, problem: QuasiStaticProblem, parameters: Sequence[Any]) -> None:
        require_followed(problem, "An Adjoint")
        _require_plain(problem)
        self.problem = problem
        self._many = [Many(given, problem) for given in parameters]
        if not self._many:
            raise MPMError("Name a parameter to differentiate by.")
        self._first = [self._at_first(one) for one in self._many]
        self._shear = self._shear_modes()
        self._records: list[Record] = []
        self._trial: Trial | None = None
        parameters = [one.parameter for one in self._many]
        self._followed = Followed(problem, parameters, "An Adjoint")
        problem.trial.record(self)

    @property
    def displacements(self) -> list[list[Array]]:
        """Displacements of the bodies, on the local dofs of W, at the end of each step so far."""
        return [record.after for record in self._records]

    # -- What follows the run -----------------------------------------------------------------

    def begins(self) -> None:
        """Do nothing: this is for motions."""

    def solved(self, trial: Trial) -> Callable[[], None]:
        """Note a step that is solved; see :class:`.Recorder`."""
        problem = self.problem
        self._followed.require_step(trial)
        before = [body.converged_displacement.copy() for body in problem.bodies]
        record = Record(
            self._records[-1].after if self._records else before,
            [np.array(body.displacement.x.array) for body in problem.bodies],
            [field.u.array_r.copy() for field in trial.reduced.fields],
            []
            if len(self._records) % KEPT
            else copied([points.last.memories() for points in problem.points]),
            [array.copy() for array in self._data()],
        )

        def take() -> None:
            self._trial = trial
            self._records.append(record)
            self._followed.note()

        return take

    def _data(self) -> list[Array]:
        """Return the data of forms besides displacements, to be set."""
        constants = [c for body in self.problem.bodies for c in (body.load, body.proportional)]
        found = [*constants, *self.problem.built.loads, *self.problem.built.constants]
        mine = [one.function for one in self._many]
        return [
            value.x.array if isinstance(value, fem.Function) else value.value
            for value in found
            if all(value is not own for own in mine)
        ]

    # -- Before the first step ------------------------------------------------------------------

    def _at_first(self, one: Many) -> _First:
        """Return the effects of a parameter before the first step (collective)."""
        problem, parameter = self.problem, one.parameter
        sides = []
        for sign in (1.0, -1.0, 0.0):
            parameter.shift(sign * parameter.change)
            for points in problem.points:
                parameter.govern(points, sign * parameter.change)
            problem.begin_anew()
            if sign != 0.0:
                sides.append(self._look())
        after, before = sides
        return _First(
            [
                [_changing(parameter.rate(*pair)) for pair in zip(*own, strict=True)]
                for own in zip(after.states, before.states, strict=True)
            ],
            [
                [parameter.slope(*pair) for pair in zip(*own, strict=True)]
                for own in zip(after.stiffness, before.stiffness, strict=True)
            ],
            [parameter.slope(*p) for p in zip(after.tangent, before.tangent, strict=True)],
            [
                None if a is None or b is None else parameter.slope(a, b)
                for a, b in zip(after.modulus, before.modulus, strict=True)
            ],
        )

    def _shear_modes(self) -> list[tuple[tuple[int, int], float]]:
        """Return the simple shear that tells each body's modulus, and its volume (collective)."""
        found = []
        for body, tangent in zip(self.problem.bodies, self._look().tangent, strict=True):
            comm: MPI.Comm = body.mesh.comm
            energies = comm.allreduce(tangent.sum(axis=0))
            positive = np.where(energies > 0.0, energies, np.inf)
            i, J = divmod(int(positive.argmin()), positive.shape[1])
            found.append(((i, J), comm.allreduce(float(body.initial_volume.sum()))))
        return found

    def _look(self) -> _First:
        """Return the values of what :class:`_First` has derivatives of (collective)."""
        problem, tangents = self.problem, []
        for points in problem.points:
            gdim = points.strain.particles.mesh.geometry.dim
            C = undeformed_tangent(points.laws)[:, :gdim, :gdim, :gdim, :gdim]
            tangents.append(
                points.strain.weights.ravel()[:, None, None] * np.einsum("niJiJ->niJ", C)
            )
        return _First(
            [[varying(s) for s in points.last.states] for points in problem.points],
            [
                [one.stiffness.copy() for one in problem.setup.supports_of(body)]
                for body in problem.bodies
            ],
            tangents,
            [
                None if points.averaging is None else points.averaging.modulus.copy()
                for points in problem.points
            ],
        )

    # -- Backward -------------------------------------------------------------------------------

    @collective()
    def of(self, functional: Any) -> list[Array]:
        """Return the derivatives of a functional by all parameters (collective).

        Args:
            functional: A scalar UFL form in ``particles.displacement``, of the last step; a
                dictionary of such forms by the numbers of steps, from 0; or a function of the
                number of a step, which sees its displacements in place, and returns a form,
                ``None``, or derivatives as arrays: a dictionary of them by ``"displacement"`` (on
                the local dofs of W) and by the names of variables of the materials, shape
                ``(n, nq, ...)`` (of each body in a list).

        Returns:
            An array for each parameter: one number, or one for each local dof of a Function.
        """
        self._followed.require_present()
        if self._trial is None:
            raise MPMError("There is no step yet that an Adjoint could go through.")
        look = self._look_of(functional)
        problem, data = self.problem, self._data()
        back = Backward(problem, self._trial.newton)
        own = [array.copy() for array in data]
        states = [points.last.states for points in problem.points]
        for one in self._many:
            one.zero()
        try:
            self._go_back(back, look, data)
        finally:
            for array, values in zip(data, own, strict=True):
                array[...] = values
            for body, points, last, its in zip(
                problem.bodies,
                problem.points,
                self._records[-1].after,
                states,
                strict=True,
            ):
                body.restore(last.copy().reshape(-1, body.mesh.geometry.dim))
                points.go_from(its)
            self.problem.reduced.unknowns.forget()
            self._trial.go_back()
        found = [one.result() for one in self._many]
        with agree(problem.bodies[0].mesh.comm):
            if not all(np.isfinite(slope).all() for slope in found):
                raise MPMError("A derivative is not finite, as that of the functional is not.")
        return found

    def _go_back(self, back: Backward, look: Callable[[int], Any], data: Sequence[Array]) -> None:
        """Go through all steps backward, and add up derivatives."""
        problem, weights = self.problem, no_weights(self.problem)
        penalised: dict[int, Array] = {}
        stiffened = [
            [np.zeros_like(one.stiffness) for one in problem.setup.supports_of(body)]
            for body in problem.bodies
        ]
        for number, record in self._from_the_end(back):
            back.go_to(record, data)
            self._add_functional(look(number), weights)
            self._go_through(back, record, weights, penalised, stiffened)
        for one, first in zip(self._many, self._first, strict=True):
            if one.parameter.of_law:
                self._add_first(one, first, weights, penalised, stiffened)

    def _go_through(
        self,
        back: Backward,
        record: Record,
        weights: Weights,
        penalised: dict[int, Array],
        stiffened: Sequence[Sequence[Array]],
    ) -> None:
        """Go through one step backward; all that is large is forgotten after it."""
        problem = self.problem
        moved, backgrounds, laws = back.step(record, weights)
        self._add_penalties(backgrounds, penalised)
        for own, body, motion in zip(stiffened, problem.bodies, moved, strict=True):
            for total, support in zip(own, problem.setup.supports_of(body), strict=True):
                total -= support.work_by_stiffness(motion)
        for one in self._many:
            if one.parameter.outside:
                self._add_loads(one, moved)
        for place, (law, motion) in enumerate(zip(laws, moved, strict=True)):
            self._add_law(place, law, motion, weights)

    def _from_the_end(self, back: Backward) -> Iterator[tuple[int, Record]]:
        """Yield the steps from the last one, with their numbers and what materials kept."""
        for first in reversed(range(0, len(self._records), KEPT)):
            some = back.remembered(self._records[first : first + KEPT])
            yield from reversed(list(enumerate(some, first)))

    def _add_law(self, place: int, law: Laws, motion: fem.Function, weights: Weights) -> None:
        """Add what the laws of a body depend on, and take weights to the step's beginning."""
        points, body = self.problem.points[place], self.problem.bodies[place]
        seen, resists = law.seen(motion)
        work = points.strain.weights.ravel()[:, None, None] * seen
        states = weights.states[place]
        pulled = law.pull(states, work)
        for one, first in zip(self._many, self._first, strict=True):
            if not one.parameter.of_law:
                continue
            one.add_of_points(body, law.by_parameter(one.parameter, states, work, pulled))
            modulus = first.modulus[place]
            if modulus is not None:
                one.add_of_cells(body, -modulus * (points.strain.weights * resists).sum(axis=1))
        if any(law.have_history()):
            weights.states[place] = law.by_states(states, work, pulled)
        else:
            weights.states[place] = [{k: 0.0 * v for k, v in own.items()} for own in states]

    def _add_loads(self, one: Many, moved: Sequence[fem.Function]) -> None:
        """Add what forces depend on besides laws."""
        problem, parameter = self.problem, one.parameter
        if one.function is not None:
            for term, motion in zip(problem.built.body_terms, moved, strict=True):
                one.total -= term.forms.work_by(one.function, motion)
            return
        sides = []
        for sign in (1.0, -1.0):
            parameter.shift(sign * parameter.change)
            problem.renew_external()
            sides.append(problem.reduced.terms.last_nodal_forces())
        parameter.shift(0.0)
        problem.renew_external()
        for motion, after, before in zip(moved, *sides, strict=True):
            work = motion.x.array[: len(after)] @ (after - before)
            one.total = one.total - work / (2.0 * parameter.change)

    def _add_penalties(self, backgrounds: Sequence[PETSc.Vec], totals: dict[int, Array]) -> None:
        """Add derivatives by the moduli of penalties."""
        pairs = zip(self.problem.reduced.fields, backgrounds, strict=True)
        for number, (field, z) in enumerate(pairs):
            if field.acting.moduli is None:
                continue
            own, slopes = np.array(field.acting.moduli), []
            for place in range(len(own)):
                amount = np.zeros(len(own))
                amount[place] = DIFFERENCE * own.max()
                parts = [
                    field.acting.penalty_force(field.u, (own + s * amount).tolist())
                    for s in (1.0, -1.0)
                ]
                slopes.append((z.dot(parts[0]) - z.dot(parts[1])) / (2.0 * amount[place]))
            totals[number] = totals.get(number, 0.0) - np.array(slopes)

    def _add_first(
        self,
        one: Many,
        first: _First,
        weights: Weights,
        penalised: Mapping[int, Array],
        stiffened: Sequence[Sequence[Array]],
    ) -> None:
        """Add what a parameter of a law does before the first step (collective)."""
        problem = self.problem
        for place, (body, points) in enumerate(zip(problem.bodies, problem.points, strict=True)):
            found = np.zeros(len(first.tangent[place]))
            for own, rates, part in zip(
                weights.states[place], first.states[place], points.laws.governed, strict=True
            ):
                for name, rate in rates.items():
                    product = (own[name] * rate).reshape(len(part.points), -1)
                    found[part.points] += product.sum(axis=1)
            one.add_of_points(body, found)
            for total, slope in zip(stiffened[place], first.stiffness[place], strict=True):
                dofs = slice(0, body.num_local)
                one.add_of_cells(body, (total * slope)[dofs])
            field = problem.reduced.unknowns.place(body)[0]
            number = problem.reduced.fields.index(field)
            if number in penalised:
                its = next(n for n, own in enumerate(field.bodies) if own is body)
                mode, volume = self._shear[place]
                slope = first.tangent[place][:, *mode] / volume
                one.add_of_points(body, penalised[number][its] * slope)

    # -- The functional ---------------------------------------------------------------------------

    def _look_of(self, functional: Any) -> Callable[[int], Any]:
        """Return a function of the number of a step that returns what there is of a functional."""
        last = len(self._records) - 1
        if isinstance(functional, ufl.Form):
            return lambda number: functional if number == last else None
        if isinstance(functional, Mapping):
            steps = range(-last - 1, last + 1)
            if not functional or any(number not in steps for number in functional):
                raise MPMError(
                    f"A functional is a dictionary of forms by steps from 0 to {last} (or back "
                    f"from -1), not by {list(functional)}."
                )
            return lambda number: functional.get(number, functional.get(number - last - 1))
        if not callable(functional) or isinstance(functional, ufl.core.expr.Expr):
            raise MPMError(
                "A functional is a UFL form, a dictionary of forms by steps, or a function of the "
                f"number of a step, not {functional!r}."
            )
        return of_user(self.problem.bodies[0].mesh.comm, functional)

    def _add_functional(self, given: Any, weights: Weights) -> None:
        """Add derivatives of a functional at the end of a step (collective)."""
        bodies, is_form = self.problem.bodies, isinstance(given, ufl.Form)
        comm = bodies[0].mesh.comm
        kind = given if given is None or is_form else "derivatives as arrays"
        require_same(comm, functional=kind)
        if given is None:
            return
        if is_form:
            self._add_form(given, weights)
            return
        listed = given if isinstance(given, list | tuple) else [given]
        with agree(comm):
            if len(listed) != len(bodies) or not all(isinstance(own, Mapping) for own in listed):
                raise MPMError(
                    "Derivatives of a functional are a dictionary of arrays (a list of them where "
                    "there is a list of bodies) by 'displacement' and names of variables."
                )
            for place, own in enumerate(listed):
                for name, values in own.items():
                    self._add_array(place, name, values, weights)
        for motion in weights.motion:
            motion.x.scatter_forward()

    def _add_array(self, place: int, name: str, given: Any, weights: Weights) -> None:
        """Add derivatives by displacements or a variable of a body (not collective)."""
        points, body = self.problem.points[place], self.problem.bodies[place]
        targets, shape = [weights.motion[place].x.array], weights.motion[place].x.array.shape
        places: Sequence[Any] = [slice(None)]
        if name != "displacement":
            pairs = zip(weights.states[place], points.laws.governed, strict=True)
            found = [(own[name], part.points) for own, part in pairs if name in own]
            if not found:
                raise MPMError(
                    f"No material of these particles has a variable {name!r} that varies."
                )
            targets, places = [own for own, _ in found], [where for _, where in found]
            shape = (body.num_local, body.num_points, *targets[0].shape[1:])
        try:
            values = as_reals(given)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != shape:
            raise MPMError(f"Derivatives by {name!r} are an array of the shape {shape}.")
        values = values.reshape(-1, *targets[0].shape[1:])
        for target, where in zip(targets, places, strict=True):
            target += values[where]

    def _add_form(self, form: ufl.Form, weights: Weights) -> None:
        """Add derivatives of a form by displacements and by parameters in it (collective)."""
        held = form.coefficients()
        if form.arguments():
            raise MPMError(
                "A functional is a form without test functions, whose value is a number."
            )
        if not any(one.is_in(form) for one in self._many) and not any(
            one is body.displacement for body in self.problem.bodies for one in held
        ):
            raise MPMError(
                "A functional has particles.displacement of this problem in it, or a parameter; "
                f"this form has neither: {form}."
            )
        for body, motion in zip(self.problem.bodies, weights.motion, strict=True):
            if any(one is body.displacement for one in held):
                motion.x.array[:] += assembled(ufl.derivative(form, body.displacement))
                motion.x.scatter_forward()
        for one in self._many:
            if one.is_in(form):
                one.add_of_form(form)


def _changing(rates: State) -> State:
    """Return the derivatives that are not zero."""
    return {name: values for name, values in rates.items() if np.any(values)}


def _require_plain(problem: Any) -> None:
    """Raise an error where going backward would not be exact.

    Raises:
        MPMError: It would not.
    """
    if not isinstance(problem, QuasiStaticProblem) or isinstance(problem, TimeProblem):
        raise MPMError(
            f"An Adjoint follows a QuasiStaticProblem, not a {type(problem).__name__}; a "
            "Sensitivity follows others too."
        )
    for body in problem.setup.given:
        if body.initial_stress is not None:
            raise MPMError("An Adjoint does not follow an initial stress yet.")
        follows = any(
            one is body.particles.displacement
            for value, _ in body.tractions
            if isinstance(value, ufl.core.expr.Expr)
            for one in extract_coefficients(value)
        )
        if body.pressures or follows:
            raise MPMError("An Adjoint does not follow loads that depend on the displacement yet.")
