# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Parameters that the result of a run depends on: Constants, Functions, and numbers of laws."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, override

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .. import _compat
from ..constitutive.points import MaterialPoints
from ..errors import MPMError, agree
from ..materials.base import Material, State
from ..problems.problem import Problem
from ..problems.quasistatic import QuasiStaticProblem
from ..reals import as_reals
from ..tolerances import DIFFERENCE

__all__ = ["Parameter", "as_parameter", "largest"]

type Array = NDArray[np.float64]


class Parameter(ABC):
    """Something that can be changed by an amount, along a direction.

    Args:
        name: What it is called in errors.
        scale: An amount by which it matters.
        of_law: Whether materials depend on it.
        outside: Whether loads or conditions may depend on it.

    Attributes:
        name: As given.
        change: The amount by which it is changed for differences.
        of_law: As given.
        outside: As given.
    """

    def __init__(self, name: str, scale: float, of_law: bool, outside: bool) -> None:
        if not np.isfinite(scale):
            raise MPMError(f"{name} must be finite to differentiate by it.")
        if scale <= 0.0:
            raise MPMError(
                f"{name} is zero, which says nothing of its size; give a Sensitivity scales=, for "
                "each parameter an amount by which it matters."
            )
        self.name, self.of_law, self.outside = name, of_law, outside
        # (points between two branches of a law are the fewer the smaller it is)
        self.change = DIFFERENCE * scale

    def shift(self, amount: float) -> None:
        """Change it by an amount from what it was at first; 0 makes it that."""

    @abstractmethod
    def govern(self, points: MaterialPoints, amount: float) -> None:
        """Let materials at points follow, after :meth:`shift` (collective)."""

    def require_unchanged(self) -> None:
        """Raise an error where it is not what it was at first (not collective)."""

    def slope(self, after: Array, before: Array) -> Array:
        """Return the derivative of values that are known at its change, and at minus its change."""
        return np.asarray((after - before) / (2.0 * self.change))

    def rate(self, after: State, before: State) -> State:
        """Return :meth:`slope` of all values of a state."""
        return {name: self.slope(values, before[name]) for name, values in after.items()}


class _Values(Parameter):
    """Values of a Constant or Function.

    Args:
        values: The values, to be set.
        direction: What they are changed by, of the same shape.
        name: As for :class:`Parameter`.
        scale: As for :class:`Parameter`.
        of_law: As for :class:`Parameter`.
        outside: As for :class:`Parameter`.
    """

    def __init__(
        self,
        values: Array,
        direction: Array,
        name: str,
        scale: float,
        of_law: bool,
        outside: bool,
    ) -> None:
        super().__init__(name, scale, of_law, outside)
        self._values, self._first, self._direction = values, values.copy(), direction

    @override
    def shift(self, amount: float) -> None:
        self._values[...] = self._first + amount * self._direction if amount else self._first

    @override
    def govern(self, points: MaterialPoints, amount: float) -> None:
        points.numbers.follow()

    @override
    def require_unchanged(self) -> None:
        if not np.array_equal(self._values, self._first):
            raise MPMError(
                f"{self.name} has changed since its derivative was asked for, so that this "
                "means nothing; let a path change something else, such as a factor of it."
            )


class _OfLaw(Parameter):
    """A number of a law.

    Args:
        law: The law, as it was given.
        name: Its parameter.
        scale: As for :class:`Parameter`.
    """

    def __init__(self, law: Material, name: str, scale: float) -> None:
        super().__init__(f"{name} of {type(law).__name__}", scale, True, False)
        self._law, self._parameter = law, name

    @override
    def govern(self, points: MaterialPoints, amount: float) -> None:
        value = self._law.parameters[self._parameter]
        points.numbers.assume(self._law, self._parameter, value + amount if amount else value)


def as_parameter(given: Any, problem: Problem, scale: float | None) -> Parameter:
    """Return the parameter that a user names (collective).

    Args:
        given: See :class:`Sensitivity`.
        problem: The problem.
        scale: Size of amounts by which it matters; ``None``: by its values.

    Raises:
        MPMError: It is nothing by which a result can be differentiated.
    """
    thing, direction = given if isinstance(given, tuple) and len(given) == 2 else (given, None)
    if isinstance(thing, Material):
        name = str(direction)
        if name not in thing.parameters:
            raise MPMError(
                f"A {type(thing).__name__} has no parameter {direction!r}; there are "
                f"{', '.join(sorted(thing.parameters))}."
            )
        value: Any = thing.parameters[name]
        if isinstance(value, fem.Constant | fem.Function):
            thing, direction = value, 1.0
        else:
            size = largest(np.abs(value), problem) if scale is None else scale
            known = [law for points in problem.points for law in points.laws.given]
            if all(law is not thing for law in known):
                raise MPMError(f"{thing!r} is no material of this problem; name one as given.")
            return _OfLaw(thing, name, size)
    if not isinstance(thing, fem.Constant | fem.Function):
        raise MPMError(
            "A parameter is a Constant, a pair of a Constant or Function and a direction, or a "
            f"pair of a material and the name of one of its numbers, not {given!r}."
        )
    return _along(thing, direction, problem, scale)


def _along(
    thing: fem.Constant | fem.Function, direction: Any, problem: Problem, scale: Any
) -> Parameter:
    """Return a Constant or Function along a direction as a parameter (collective)."""
    function = isinstance(thing, fem.Function)
    name = f"'{thing.name}'" if isinstance(thing, fem.Function) else f"a Constant {thing.value}"
    values = thing.x.array if isinstance(thing, fem.Function) else thing.value
    if direction is None:
        if function or values.size != 1:
            raise MPMError(f"{name} has many values; give a pair of it and a direction.")
        direction = 1.0
    with agree(problem.bodies[0].mesh.comm):
        try:
            way = direction.x.array if isinstance(direction, fem.Function) else as_reals(direction)
            along = np.array(np.broadcast_to(way, values.shape), dtype=np.float64)
        except (TypeError, ValueError):
            raise MPMError(
                f"The direction of {name} must be numbers of its shape {values.shape}, not "
                f"{direction!r}."
            ) from None
        if not np.isfinite(along).all():
            raise MPMError(f"The direction of {name} must be finite.")
    size = largest(np.abs(along), problem)
    if size == 0.0:
        raise MPMError(f"The direction of {name} must not be zero.")
    if scale is None:
        scale = largest(np.abs(values), problem) / size
    laws = [law for points in problem.points for law in points.laws.given]
    numbers: list[Any] = [value for law in laws for value in law.parameters.values()]
    of_law = any(value is thing for value in numbers)
    elsewhere = any(load is thing for load in problem.built.loads)
    elsewhere = elsewhere or any(_compat.holds(bc, thing) for bc in problem.bcs)
    with agree(problem.bodies[0].mesh.comm):
        if not of_law and not elsewhere and _is_in_none(thing, problem):
            raise MPMError(
                f"{name} is in no material, load, support or Dirichlet value of this problem, "
                "which does not depend on it; name one that is, as given."
            )
    outside = not of_law or elsewhere
    return _Values(values, along, name, scale, of_law, outside)


def _is_in_none(thing: fem.Constant | fem.Function, problem: Problem) -> bool:
    """Return whether no form has what is in no material, load or condition, where that is known.

    Laws of the user's own may hold whatever they like, and initial stresses are of no form.
    """
    if type(problem) is not QuasiStaticProblem:
        return False
    if any(
        b.initial_stress is not None or b.pore_pressure is not None for b in problem.setup.given
    ):
        return False
    if not all(points.laws.are_own for points in problem.points):
        return False
    if isinstance(thing, fem.Function):
        return not any(problem.setup.supports_of(body) for body in problem.bodies)
    return all(constant is not thing for constant in problem.built.constants)


def largest(sizes: Any, problem: Problem) -> float:
    """Return the largest of sizes on all ranks, infinite where one is no number (collective)."""
    comm: MPI.Comm = problem.bodies[0].mesh.comm
    known = np.where(np.isfinite(sizes), sizes, np.inf)
    return float(comm.allreduce(float(np.max(known, initial=0.0)), MPI.MAX))
