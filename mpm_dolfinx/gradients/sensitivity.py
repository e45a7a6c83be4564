# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of a run by a few parameters, carried along step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError, agree
from ..parallel.boundary import collective, of_user
from ..parallel.given import as_positive, require_same
from ..problems.motion import MovingProblem
from ..problems.problem import Problem
from ..reals import as_reals
from ..stepping.control import Run
from ..stepping.trial import Trial
from .followed import Followed, require_followed
from .forward import StepDerivative
from .nearby import Nearby, Rates, followed, varying, without_tangents
from .parameters import as_parameter

__all__ = ["Sensitivity"]

type Array = NDArray[np.float64]


class Sensitivity:
    """Derivatives of all that a run computes by a few parameters, as it goes on (collective).

    It is made before the first step, and kept; each step of ``solve``, ``steps`` or ``step`` then
    takes one linear solve and four evaluations of the forces for each parameter besides::

        young = fem.Constant(body, 1e6)
        law = mpm.materials.VonMises(young, 0.3, yield_stress=2e4)
        problem = mpm.QuasiStaticProblem(mpm.Body(particles, law, ...), bcs)
        gradient = mpm.Sensitivity(problem, [young, (law, "yield_stress")])
        problem.solve(steps=20)
        gradient.of(lambda: particles.stress)  # shape (n, 3, 3, 2)

    The derivatives are those of the discrete run, with the history of its materials, its moving
    domains and its stabilisation: those of the steps that were made. Where a point yields or a
    node crosses a line of the background just there, a run has a kink.

    Args:
        problem: A :class:`QuasiStaticProblem`, :class:`DynamicProblem`, :class:`PorousProblem`,
            or a :class:`ParticleProblem` or :class:`DynamicParticleProblem` in UFL.
        parameters: By what to differentiate: Constants (of laws, loads, densities, residuals,
            Dirichlet values, values of supports, an initial stress or velocity), pairs of a
            material and the name of one of its numbers, ``(law, "young")``, and pairs of a Constant
            or Function of many values and a direction in which they change together. Expressions
            follow what they are made of; a ``modulus=`` given to a support is a number that it
            keeps.
        scales: For each parameter an amount by which it matters, instead of its own value; needed
            where that is zero.

    Attributes:
        problem: As given.
        displacement: The derivative of ``particles.displacement`` by each parameter, a Function, or
            a list of them where the problem was given a list of bodies.

    Raises:
        MPMError: Something that cannot be differentiated (yet), or a problem that has begun.
    """

    @collective("parameters")
    def __init__(
        self,
        problem: Problem,
        parameters: Sequence[Any],
        scales: Sequence[float] | None = None,
    ) -> None:
        require_followed(problem, "A Sensitivity")
        sizes: list[float | None] = [None] * len(parameters)
        if scales is not None:
            sizes = [as_positive(scale, "scales of Sensitivity()") for scale in scales]
        if len(sizes) != len(parameters):
            raise MPMError(f"There are {len(sizes)} scales for {len(parameters)} parameters.")
        self.problem = problem
        self._parameters = [
            as_parameter(given, problem, size)
            for given, size in zip(parameters, sizes, strict=True)
        ]
        if not self._parameters:
            raise MPMError("Name a parameter to differentiate by.")
        require_same(problem.bodies[0].mesh.comm, names=[one.name for one in self._parameters])
        self._followed = Followed(problem, self._parameters, "A Sensitivity")
        self._trial: Trial | None = None
        self._run: Run | None = None
        self._rates, self._nearby = self._beginning()
        problem.trial.record(self)

    # -- Results --------------------------------------------------------------------------

    @property
    def displacement(self) -> list[Any]:
        """The derivative of the displacement by each parameter."""
        many = isinstance(self.problem.particles, list | tuple)
        found = [rates.motion[: len(self.problem.bodies)] for rates in self._rates]
        return [list(own) if many else own[0] for own in found]

    @collective("function")
    def of(self, function: Callable[[], Any]) -> Array:
        """Return the derivative of what a function returns that looks at the problem (collective).

        It is called in states beside the present one, in which the bodies have other displacements,
        stresses and internal variables, the problem other reactions and the parameters other
        values: ``lambda: problem.reaction(bc)``, ``lambda: particles.stress``, or the integral of
        a form.

        Args:
            function: Returns a number or an array.

        Returns:
            One more axis than what it returns: the last one is that of parameters.
        """
        self._followed.require_present()
        comm = self.problem.bodies[0].mesh.comm
        look = of_user(comm, function)
        columns = []
        with self._nearby.held():
            for parameter, rates in zip(self._parameters, self._rates, strict=True):
                sides = []
                for sign in (1.0, -1.0):
                    amount = sign * parameter.change
                    self._nearby.go(parameter, amount, rates)
                    shown = self._nearby.shown(amount, rates, self._reactions())
                    with shown, self._supported():
                        found = look()
                        with agree(comm):
                            sides.append(_numbers(found))
                with agree(comm):
                    if sides[0].shape != sides[1].shape:
                        raise MPMError("A function of Sensitivity.of must always return one shape.")
                columns.append(parameter.slope(*sides))
        return np.stack(columns, axis=-1)

    def _reactions(self) -> list[Array]:
        """Return the reactions of the last step, to be set."""
        return [] if self._trial is None else self._trial.converged.reactions or []

    @contextmanager
    def _supported(self) -> Iterator[None]:
        """Let the forces of supports be those of the state now, in the block (collective)."""
        if self._trial is None:
            yield
            return
        converged = self._trial.converged
        before = converged.supports, converged.force
        try:
            converged.supports = [support.reaction for support in self.problem.built.supports]
            converged.force = None
            yield
        finally:
            converged.supports, converged.force = before

    # -- What follows the run --------------------------------------------------------------

    def solved(self, trial: Trial) -> Callable[[], None]:
        """Find the derivatives of a step that is solved; see :class:`.Recorder`.

        Raises:
            MPMError: There are none.
        """
        self._followed.require_step(trial)
        reduced, newton = trial.reduced, trial.newton
        rates = self._rates
        if trial.run is not None and trial.run is not self._run:
            for one in rates:
                one.base = one.prescribed
        problem = self.problem
        with self._nearby.held():
            step = StepDerivative(problem, trial, self._nearby)
            with without_tangents(problem):
                pairs = zip(self._parameters, rates, strict=True)
                found = [step.by(parameter, one) for parameter, one in pairs]
        assert newton.x is not None and newton.F is not None
        if (failure := reduced.residual(newton.x, newton.F)) is not None:
            raise MPMError(failure.message)

        def take() -> None:
            self._trial, self._run, self._rates = trial, trial.run, found
            self._followed.note()

        return take

    def begins(self) -> None:
        """Find the derivatives of the forces that a motion begins with.

        Raises:
            MPMError: There are none.
        """
        self._followed.require_present()
        problem, points = self.problem, self.problem.points
        assert isinstance(problem, MovingProblem)
        with self._nearby.held():
            for parameter, rates in zip(self._parameters, self._rates, strict=True):
                sides = []
                for sign in (1.0, -1.0):
                    self._nearby.go(parameter, sign * parameter.change, rates)
                    with ExitStack() as blocks:
                        for own in points:
                            blocks.enter_context(own.laws.in_no_time())
                        if (failure := problem.reduced.terms.update()) is not None:
                            raise failure
                        sides.append([array.copy() for array in problem.before_motion()])
                rates.kept = [parameter.slope(*pair) for pair in zip(*sides, strict=True)]
        problem.reduced.terms.roll_back()

    def _beginning(self) -> tuple[list[Rates], Nearby]:
        """Return the derivatives of what the bodies begin with, and the state (collective)."""
        problem = self.problem
        points, found = problem.points, []
        none = [np.zeros(len(f.bodies[0].increment.x.array)) for f in problem.reduced.fields]
        for parameter in self._parameters:
            sides = []
            for sign in (1.0, -1.0):
                amount = sign * parameter.change
                parameter.shift(amount)
                for own in points:
                    parameter.govern(own, amount)
                problem.begin_anew()
                kept = [array.copy() for array in problem.beginning()]
                sides.append(([[varying(s) for s in p.last.states] for p in points], kept))
            parameter.shift(0.0)
            for own in points:
                parameter.govern(own, 0.0)
            (after, more), (before, less) = sides
            states = [
                [parameter.rate(*pair) for pair in zip(*own, strict=True)]
                for own in zip(after, before, strict=True)
            ]
            found.append(
                Rates(
                    [fem.Function(thing.W) for thing in followed(problem)],
                    states,
                    [np.zeros_like(p.last.gradient) for p in points],
                    [parameter.slope(*pair) for pair in zip(more, less, strict=True)],
                    none,
                    none,
                    [],
                    {},
                )
            )
        problem.begin_anew()
        if any(len(rates.kept) != len(problem.beginning()) for rates in found):
            raise MPMError(
                "A parameter brings forces to a body that begins without any; begin with an "
                "initial stress that is not zero."
            )
        return found, Nearby(problem)


def _numbers(value: Any) -> Array:
    """Return the result of a user's function, as numbers.

    Raises:
        MPMError: It is something else.
    """
    try:
        return as_reals(value)
    except (TypeError, ValueError):
        raise MPMError(
            f"A function of Sensitivity.of must return a number or an array, not {value!r}."
        ) from None
