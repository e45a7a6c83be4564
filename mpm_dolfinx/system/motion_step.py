# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A step of a motion: what it begins with, and what an increment makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np

from dolfinx import fem

from .mass import NodalMass
from .schemes import Factors, Kinematics, Rates
from .velocities import Velocities

__all__ = ["MotionStep", "combined"]


class MotionStep(NamedTuple):
    """A step at its beginning: vectors on W of each body. All calls are collective.

    Attributes:
        mass: The mass of the bodies.
        rates: The scheme's, for the step.
        fields: The velocity, and what the scheme keeps.
        factor: What the mass is multiplied by in the tangent.
        staying: The part of the residual that stays.
        sizes: The sum of absolute values of what that consists of.
        dt: Duration.
    """

    mass: NodalMass
    rates: Rates
    fields: list[list[PETSc.Vec]]
    factor: float
    staying: list[PETSc.Vec]
    sizes: list[PETSc.Vec]
    dt: float

    @classmethod
    def begun(
        cls, mass: NodalMass, state: Velocities, rates: Rates, dt: float, damping: float
    ) -> MotionStep:
        """Return the step that begins with a state.

        Args:
            mass: The mass of the bodies.
            state: Velocities and forces.
            rates: The scheme's, for the step.
            dt: Duration.
            damping: In proportion to mass, one over a time.
        """
        share = state.scheme.share
        fields = [mass.vectors(own) for own in (state.velocities, *state.kept)]
        factors = (rates.acceleration + damping * rates.damped) / share
        staying = mass.times(combined(factors[1:], fields))
        sizes = [force.copy() for force in staying]
        for force, size, before in zip(staying, sizes, mass.vectors(state.forces), strict=True):
            size.abs()
            force.axpy((1.0 - share) / share, before)
            before.abs()
            size.axpy((1.0 - share) / share, before)
        return cls(mass, rates, fields, float(factors[0]), staying, sizes, dt)

    def increments(self) -> list[PETSc.Vec]:
        """Return the present change of displacement."""
        return self.mass.around(
            [
                body.displacement.x.array[: len(body.converged_displacement)]
                - body.converged_displacement
                for body in self.mass.bodies
            ]
        )

    def pull(self, motions: Sequence[PETSc.Vec]) -> list[PETSc.Vec]:
        """Return the tangent times motions."""
        forces = self.mass.times(motions)
        for force in forces:
            force.scale(self.factor)
        return forces

    def not_followed(
        self, velocities: Sequence[fem.Function], others: Sequence[PETSc.Vec]
    ) -> list[PETSc.Vec]:
        """Return M times what velocities differ by from others."""
        rest = self.mass.vectors(velocities)
        for vector, other in zip(rest, others, strict=True):
            vector.axpy(-1.0, other)
        return self.mass.times(rest)

    def moved(
        self, w: list[PETSc.Vec], state: Velocities, projected: Sequence[PETSc.Vec] | None
    ) -> Kinematics:
        """Return the motion in the step by the change of displacement.

        Args:
            w: The change.
            state: Says what has no inertia, and how velocities go on.
            projected: The part of the velocities at the beginning that the background can follow.
        """
        before, *kept = self.fields
        taken = before
        if self.rates.velocity[1] == 0.0:
            taken = combined(np.zeros(1), [before])
        elif not state.scheme.reflects:
            assert projected is not None
            taken = list(projected)
        after = combined(self.rates.velocity, [w, taken, *kept])
        for body, v, own in zip(self.mass.bodies, after, w, strict=True):
            if state.is_static(body):
                own.copy(v)
                v.scale(1.0 / self.dt)
        acceleration = combined(self.rates.acceleration, [w, before, *kept])
        return Kinematics(self.mass, w, acceleration, before, taken, after)

    def at_end(self, moved: Kinematics) -> list[list[PETSc.Vec]]:
        """Return the velocity at the end, and what the scheme keeps."""
        parts = [moved.increment, *self.fields]
        return [list(moved.after), *(combined(factors, parts) for factors in self.rates.kept)]

    def local(self, fields: Sequence[Sequence[PETSc.Vec]]) -> list[np.ndarray]:
        """Return values of fields on local dofs of W of each body, one field after the other."""
        values = []
        for vectors in fields:
            for body, vector in zip(self.mass.bodies, vectors, strict=True):
                function = fem.Function(body.W)
                function.x.array[: vector.getLocalSize()] = vector.array_r
                function.x.scatter_forward()
                values.append(np.asarray(function.x.array, dtype=np.float64))
        return values


def combined(factors: Factors, parts: Sequence[Sequence[PETSc.Vec]]) -> list[PETSc.Vec]:
    """Return a linear combination of vectors on W of each body."""
    sums = [vector.duplicate() for vector in parts[0]]
    for total in sums:
        total.set(0.0)
    for factor, vectors in zip(factors, parts, strict=True):
        if factor != 0.0:
            for total, vector in zip(sums, vectors, strict=True):
                total.axpy(factor, vector)
    return sums
