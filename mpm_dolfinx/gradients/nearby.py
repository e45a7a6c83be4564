# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""States of a problem beside the one it is in, and what differs between them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..constitutive.numbers import Governing
from ..materials.base import State
from ..parallel.totals import over_ranks
from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..problems.motion import MovingProblem
from ..problems.problem import Problem
from ..system.mass import NodalMass
from .parameters import Parameter

__all__ = ["Nearby", "Rates", "add_product", "followed", "varying", "without_tangents"]

type Array = NDArray[np.float64]


@dataclass
class Rates:
    """Derivatives by one parameter at the last converged step.

    Attributes:
        motion: Of displacements and values of fields, in the order of :func:`followed`.
        states: Of what materials keep, for each body, in numbers that vary.
        seen: Of ``F - I`` as materials see it, for each body.
        kept: Of what the next step begins with besides.
        prescribed: Of Dirichlet totals, on local dofs of V for each field.
        base: The same at the beginning of the run.
        reactions: Of the forces on own dofs of V, for each field.
        moduli: Of shear moduli that scale a penalty, by the number of the field.
    """

    motion: list[fem.Function]
    states: list[list[State]]
    seen: list[Array]
    kept: list[Array]
    prescribed: list[Array]
    base: list[Array]
    reactions: list[Array]
    moduli: dict[int, Array]


@contextmanager
def without_tangents(problem: Problem) -> Iterator[None]:
    """Ask materials for no tangents in the block, but where the stress itself needs them."""
    with ExitStack() as blocks:
        for points in problem.points:
            blocks.enter_context(points.asked.without_tangents())
        yield


def followed(problem: Problem) -> list[Particles | CarriedField]:
    """Return the motions of a problem: of its bodies, then of their other fields."""
    return [*problem.bodies, *problem.built.carried]


class _Here:
    """The state that a problem is in, to come back to (collective).

    Args:
        problem: The problem.

    Attributes:
        points: The materials at the points of each body.
        arrays: Displacements, values of fields and what a step begins with, each with its values.
        begun: Displacements at the last converged step.
        states: What materials keep of it.
        seen: ``F - I`` that they have seen.
        moved: The parameter that was changed last, ``None`` where all have their own numbers.
        side: That with its change and the derivatives of the state that has been gone to.
    """

    def __init__(self, problem: Problem) -> None:
        self._bodies = problem.bodies
        self.points = problem.points
        present = [np.asarray(one.displacement.x.array) for one in followed(problem)]
        self.arrays = [(values, values.copy()) for values in (*present, *problem.beginning())]
        self.begun = [body.converged_displacement.copy() for body in problem.bodies]
        self.states = [points.last.states for points in self.points]
        self.seen = [points.last.gradient for points in self.points]
        self.moved: Parameter | None = None
        self.side: tuple[Parameter, float, Rates] | None = None

    def return_to(self) -> None:
        """Come back, but for parameters."""
        for array, values in self.arrays:
            array[...] = values
        for body, values in zip(self._bodies, self.begun, strict=True):
            body.placement.displacement[...] = body.carried_by(values)
        for points, states in zip(self.points, self.states, strict=True):
            points.go_from(states)


class Nearby:
    """The state of a problem, and those beside it.

    Args:
        problem: The problem.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._moving = problem if isinstance(problem, MovingProblem) else None
        # whether forces that stay through a step depend on what it begins with
        self._has_past = self._moving is not None or bool(problem.fields)
        self._masses: dict[tuple[int, float], NodalMass] = {}
        self._of_mass: NodalMass | None = None
        self._governing: dict[tuple[int, float], list[Governing]] = {}
        self._own: list[Governing] = []

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the present state, to which all comes back after the block (collective).

        Displacements and fields come back, and history as it was converged.
        """
        self._here = here = _Here(self._problem)
        own = [points.numbers.present() for points in here.points]
        same = _are_same(own, self._own)
        if not over_ranks(self._problem.bodies[0].mesh.comm, same, MPI.LAND):
            self._own, self._governing = own, {}
        with ExitStack() as blocks:
            if self._moving is not None:
                blocks.enter_context(self._moving.inertia.held())
                if self._of_mass is not self._moving.inertia.mass():
                    self._of_mass, self._masses = self._moving.inertia.mass(), {}
            try:
                yield
            finally:
                here.return_to()
                self._restore()
                self._problem.renew_external()

    def _restore(self) -> None:
        """Give the parameter that was changed last its own value."""
        moved, self._here.moved, self._here.side = self._here.moved, None, None
        if moved is not None:
            self._shift(moved, 0.0)

    def _shift(self, parameter: Parameter, amount: float) -> None:
        """Change a parameter by an amount; what materials make of that is kept (collective)."""
        parameter.shift(amount)
        if parameter.of_law:
            self._govern(parameter, amount)
        if parameter.outside and self._moving is not None and self._of_mass is not None:
            self._weigh(self._moving, self._of_mass, (id(parameter), amount))

    def _govern(self, parameter: Parameter, amount: float) -> None:
        """Let materials take over a changed parameter; what they make of it is kept."""
        key, points = (id(parameter), amount), self._here.points
        known = self._own if amount == 0.0 else self._governing.get(key)
        if known is None:
            for own in points:
                parameter.govern(own, amount)
            self._governing[key] = [own.numbers.present() for own in points]
        else:
            for own, governing in zip(points, known, strict=True):
                own.numbers.take(governing)

    def _weigh(self, problem: MovingProblem, own: NodalMass, key: tuple[int, float]) -> None:
        """Let bodies have the mass that they have with a changed parameter (collective)."""
        if key[1] == 0.0:
            problem.inertia.assume(own)
            return
        if key not in self._masses:
            self._masses[key] = problem.inertia.weighed()
        problem.inertia.assume(self._masses[key])

    def go(
        self,
        parameter: Parameter,
        amount: float,
        rates: Rates,
        motion: Sequence[NDArray[np.float64]] | None = None,
    ) -> None:
        """Go to the state beside that a change of a parameter would bring (collective).

        Args:
            parameter: The parameter.
            amount: Its change.
            rates: Derivatives of the state.
            motion: Those of displacements and values of fields, if others, on local dofs of W.
        """
        here = self._here
        motions = motion or [function.x.array for function in rates.motion]
        for (array, values), rate in zip(here.arrays, motions, strict=False):
            array[...] = values + amount * rate
        if here.side is not None and _same(here.side, (parameter, amount, rates)):
            return  # only what moves is another one
        stale = self._has_past or parameter.outside or (here.moved and here.moved.outside)
        if here.moved is not parameter:
            self._restore()
        here.moved, here.side = parameter, (parameter, amount, rates)
        # (forces that were held back are last, and gone where they have been let go)
        for (array, values), rate in zip(here.arrays[len(motions) :], rates.kept, strict=False):
            array[...] = values + amount * rate
        for body, values, function in zip(
            self._problem.bodies, here.begun, rates.motion, strict=False
        ):
            moved = values + amount * function.x.array
            body.placement.displacement[...] = body.carried_by(moved)
        for points, states, own in zip(here.points, here.states, rates.states, strict=True):
            points.go_from([_moved(*pair, amount) for pair in zip(states, own, strict=True)])
        self._shift(parameter, amount)
        if stale:
            self._problem.renew_external()

    @contextmanager
    def shown(self, amount: float, rates: Rates, reactions: Sequence[Array]) -> Iterator[None]:
        """Let stresses and reactions be those beside the state too, in the block (collective).

        Args:
            amount: Change of the parameter.
            rates: Derivatives of the state.
            reactions: Those of the problem, to be set.
        """
        before = [force.copy() for force in reactions]
        try:
            here = self._here
            for points, seen, rate in zip(here.points, here.seen, rates.seen, strict=True):
                points.see(seen + amount * rate)
            for force, rate in zip(reactions, rates.reactions, strict=True):
                force += amount * rate
            yield
        finally:
            for force, values in zip(reactions, before, strict=True):
                force[:] = values
            for points, seen in zip(self._here.points, self._here.seen, strict=True):
                points.see(seen)


def add_product(function: fem.Function, matrix: PETSc.Mat, change: PETSc.Vec) -> None:
    """Add the product of a matrix on V to a Function on W (collective)."""
    part = matrix.createVecLeft()
    matrix.mult(change, part)
    function.x.array[: part.getLocalSize()] += part.array_r
    function.x.scatter_forward()


def varying(state: State) -> State:
    """Return the parts of a state that can vary little by little, in one order."""
    return {name: values for name, values in sorted(state.items()) if values.dtype.kind == "f"}


def _are_same(some: Sequence[Governing], others: Sequence[Governing]) -> bool:
    """Return whether the materials of all bodies are the same objects."""
    pairs = zip(some, others, strict=False)
    return len(some) == len(others) and all(
        len(one.materials) == len(other.materials)
        and all(a is b for a, b in zip(one.materials, other.materials, strict=True))
        and one.modulus is other.modulus
        for one, other in pairs
    )


def _same(side: tuple[Parameter, float, Rates], other: tuple[Parameter, float, Rates]) -> bool:
    """Return whether two states beside are of the same parameter, change and derivatives."""
    return side[0] is other[0] and side[1] == other[1] and side[2] is other[2]


def _moved(state: State, rate: State, amount: float) -> State:
    return state | {name: state[name] + amount * values for name, values in rate.items()}
