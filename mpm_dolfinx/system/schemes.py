# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time schemes: how a step's increment makes velocities, and which forces it balances.

The increment w of displacement is the unknown of a step. With f the forces at its ends, M the mass
and C the damping in proportion to it, a scheme has

    T^T [ M a + C s + (1 - share) f_n + share f_1 ] = 0,

where the acceleration a, the velocity s that damping resists, the velocity v_1 at the end and what
is kept for the next step are linear combinations of w, of the velocity v_n at the beginning and of
what was kept. No acceleration needs to be kept: what the cells cannot follow would add up in it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..parallel.boundary import Hooked
from ..parallel.given import is_number, require_same, require_truth
from ..reals import is_one_of
from ..tolerances import EQUAL
from .mass import NodalMass

__all__ = ["OUT_OF_RANGE", "SCHEMES", "Conserving", "Euler", "Kinematics", "Midpoint", "Rates"]
__all__ += ["Scheme", "as_scheme", "order_of", "rates_of"]

OUT_OF_RANGE = ("project", "reflect")

type Factors = NDArray[np.float64]
"""Factors of the increment, of the velocity at the beginning, and of all that a scheme keeps."""


class Rates(NamedTuple):
    """Linear combinations of the increment, the velocity at the beginning, and what is kept.

    Attributes:
        acceleration: The force of inertia, over the mass.
        damped: Velocity that damping in proportion to the mass resists.
        velocity: At the step's end.
        kept: What is kept of the step, in the order of :attr:`Scheme.keeps`.
    """

    acceleration: Factors
    damped: Factors
    velocity: Factors
    kept: Sequence[Factors] = ()


@dataclass(frozen=True)
class Kinematics:
    """Motion in a step that has converged: vectors on W of each body.

    Attributes:
        mass: The mass of the bodies.
        increment: Of displacement.
        acceleration: Of which the mass times it is the force of inertia.
        before: Velocity at the beginning.
        taken: The part of it that has come into that at the end.
        after: Velocity at the end.
    """

    mass: NodalMass
    increment: Sequence[PETSc.Vec]
    acceleration: Sequence[PETSc.Vec]
    before: Sequence[PETSc.Vec]
    taken: Sequence[PETSc.Vec]
    after: Sequence[PETSc.Vec]

    @property
    def left(self) -> list[PETSc.Vec]:
        """Velocity at the beginning that has not come into that at the end."""
        return _difference(self.before, self.taken)

    @property
    def change(self) -> list[PETSc.Vec]:
        """Change of the velocity."""
        return _difference(self.after, self.before)


class Scheme(Hooked, ABC, hooks=True):
    """A rule by which bodies move through a step in time; a subclass is a new one.

    Give an instance as ``scheme=`` to a :class:`DynamicProblem`.

    Args:
        reflects: Whether the velocity at a step's end has in it all of that at the beginning;
            otherwise the part of it alone that the step's background can follow.

    Attributes:
        name: A word by which a checkpoint knows it.
        share: Weight of the forces at a step's end, from 0.5 to 1; those at its beginning have the
            rest.
        stress_of_step: Whether the stress of a material is one of the whole step, by which angular
            momentum and the energy of elastic bodies are kept; with ``share`` 0.5.
        keeps: Names of the fields that it keeps from step to step, besides the velocity. They are
            zero before the first step, are saved in checkpoints, and go with the bodies.
        reflects: As given.
    """

    name: str
    share: float = 1.0
    stress_of_step: bool = False
    keeps: tuple[str, ...] = ()

    def __init__(self, reflects: bool = False) -> None:
        self.reflects = reflects

    @abstractmethod
    def rates(self, dt: float, last: float) -> Rates:
        """Return how a step makes velocities.

        Args:
            dt: Duration of the step.
            last: Duration of the step before; 0 where there is none.
        """

    def lost(self, step: Kinematics) -> float:
        """Return the kinetic energy that a step has lost by the scheme alone (collective).

        That is the work of the acceleration less the change of kinetic energy; a scheme whose loss
        is known as a square can tell it without a difference.
        """
        product = step.mass.product
        change = 0.5 * (product(step.after, step.after) - product(step.before, step.before))
        return product(step.acceleration, step.increment) - change


class Midpoint(Scheme):
    """Second order; the force of a step is the mean of those at its ends."""

    name = "midpoint"
    share = 0.5

    @override
    def rates(self, dt: float, last: float) -> Rates:
        mean = np.array([1.0 / dt, 0.0])
        velocity = np.array([2.0 / dt, -1.0])
        return Rates(np.array([2.0 / dt**2, -2.0 / dt]), mean, velocity)

    @override
    def lost(self, step: Kinematics) -> float:
        """Energy of the motion that the background could not follow."""
        product, left = step.mass.product, step.left
        return 0.5 * product(left, left) - product(step.after, left)


class Conserving(Midpoint):
    """The midpoint rule with a stress of the whole step."""

    name = "conserving"
    stress_of_step = True


class Euler(Scheme):
    """Backward Euler: first order, with forces at the step's end."""

    name = "euler"

    def __init__(self, reflects: bool = False) -> None:
        super().__init__()  # its velocities have nothing of those before

    @override
    def rates(self, dt: float, last: float) -> Rates:
        velocity = np.array([1.0 / dt, 0.0])
        return Rates(np.array([1.0 / dt**2, -1.0 / dt]), velocity, velocity)

    @override
    def lost(self, step: Kinematics) -> float:
        change = step.change
        return 0.5 * step.mass.product(change, change)


#: The schemes that a problem knows by name.
SCHEMES: dict[str, type[Scheme]] = {one.name: one for one in (Midpoint, Conserving, Euler)}


def as_scheme(value: Any, out_of_range: Any) -> Scheme:
    """Return a scheme by its name, or one that is given.

    Args:
        value: One of :data:`SCHEMES`, or a :class:`Scheme`.
        out_of_range: One of :data:`OUT_OF_RANGE`, for those with a name.

    Raises:
        MPMError: There is none of this name, or one that is given cannot do as asked.
    """
    if not is_one_of(out_of_range, OUT_OF_RANGE):
        raise MPMError(
            f"Unknown out_of_range={out_of_range!r}; choose one of {', '.join(OUT_OF_RANGE)}."
        )
    reflects = out_of_range == "reflect"
    if isinstance(value, Scheme):
        if reflects and not value.reflects:
            raise MPMError("out_of_range='reflect' is for schemes by name; make this one reflect.")
        _require_whole(value)
        return value
    if not is_one_of(value, SCHEMES):
        raise MPMError(
            f"Unknown scheme={value!r}; choose one of {', '.join(SCHEMES)}, or give an mpm.Scheme."
        )
    return SCHEMES[value](reflects)


def _require_whole(scheme: Scheme) -> None:
    """Raise an error unless a user's scheme says all that a scheme must."""
    kind, name = type(scheme).__name__, getattr(scheme, "name", None)
    if not hasattr(scheme, "reflects"):
        raise MPMError(f"{kind}.__init__ must call super().__init__(reflects).")
    for truth in ("reflects", "stress_of_step"):
        require_truth(f"{kind}.{truth}", getattr(scheme, truth))
    if not isinstance(name, str) or not name or not isinstance(scheme, SCHEMES.get(name, Scheme)):
        raise MPMError(
            f"{kind}.name must be a word of its own, by which a checkpoint knows it, not {name!r}."
        )
    share, keeps = scheme.share, scheme.keeps
    if not is_number(share) or not 0.5 <= share <= 1.0 or (scheme.stress_of_step and share != 0.5):
        raise MPMError(
            f"{kind}.share must be from 0.5 to 1, and 0.5 with a stress of the whole step, not "
            f"{share!r}."
        )
    words = isinstance(keeps, list | tuple) and all(isinstance(one, str) and one for one in keeps)
    if not words or len(set(keeps)) < len(keeps):
        raise MPMError(f"{kind}.keeps must be a tuple of names that differ, not {keeps!r}.")


def rates_of(comm: MPI.Comm, scheme: Scheme, dt: float, last: float) -> Rates:
    """Return the rates of a scheme, all with a factor for each field (collective).

    Raises:
        MPMError: Some have not, are not finite, or differ between ranks.
    """
    found, count = scheme.rates(dt, last), 2 + len(scheme.keeps)
    if not isinstance(found, Rates):
        raise MPMError(f"{type(scheme).__name__}.rates must return mpm.Rates, not {found!r}.")
    rows = [found.acceleration, found.damped, found.velocity, *found.kept]
    shapes = {np.shape(row) for row in rows}
    if len(found.kept) != len(scheme.keeps) or shapes != {(count,)} or not np.isfinite(rows).all():
        raise MPMError(
            f"{type(scheme).__name__}.rates must return {3 + len(scheme.keeps)} rows of {count} "
            "finite numbers: factors of the increment, of the velocity, and of each field in keeps."
        )
    require_same(comm, rates=rows)
    return found


def order_of(comm: MPI.Comm, scheme: Scheme) -> tuple[int, float]:
    """Return the order p of a scheme, and C of the error ``C dt^(p + 1)`` that a step makes.

    They are those of equal steps of an oscillation ``exp(i t)`` without damping, which the scheme
    multiplies in a step by the eigenvalue next to ``exp(i dt)``. No more than two counts.

    Args:
        comm: The ranks.
        scheme: The scheme.

    Raises:
        MPMError: Its rates are none.
    """
    errors = (_error_of_oscillation(scheme, dt, comm) for dt in (0.02, 0.01))
    long, short = (max(error, EQUAL) for error in errors)
    order = min(max(round(math.log2(long / short)) - 1, 1), 2)
    return order, short / 0.01 ** (order + 1)


def _error_of_oscillation(scheme: Scheme, dt: float, comm: MPI.Comm) -> float:
    """Return the error that a step makes of an oscillation of size and frequency 1."""
    rates = rates_of(comm, scheme, dt, dt)
    increment = np.zeros(2 + len(scheme.keeps))  # by displacement, velocity and what is kept
    increment[0], increment[1:] = -1.0, -rates.acceleration[1:]
    increment /= rates.acceleration[0] + scheme.share
    rows = np.array([rates.velocity, *rates.kept])
    step = np.outer([1.0, *rows[:, 0]], increment)
    step[0, 0] += 1.0
    step[1:, 1:] += rows[:, 1:]
    return float(np.abs(np.linalg.eigvals(step) - np.exp(1j * dt)).min())


def _difference(some: Sequence[PETSc.Vec], others: Sequence[PETSc.Vec]) -> list[PETSc.Vec]:
    """Return the differences of vectors."""
    found = [vector.copy() for vector in some]
    for vector, other in zip(found, others, strict=True):
        vector.axpy(-1.0, other)
    return found
