# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""How unknowns move bodies, and whether these resist."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from ..parallel.magnitudes import joint_norm, norm
from ..tolerances import SMALL
from .terms import Terms
from .unknowns import Unknowns
from .value_field import ValueField

__all__ = ["Resistance"]


class Resistance:
    """Motions of bodies by the unknowns, and what resists them. All calls are collective.

    Args:
        unknowns: The unknowns.
        terms: The terms.
    """

    def __init__(self, unknowns: Unknowns, terms: Terms) -> None:
        self._unknowns, self._terms = unknowns, terms

    @property
    def one_sided(self) -> bool:
        """Whether something may let bodies go and hold them again, as contact does."""
        return self._terms.one_sided

    def stiffness(self, x: PETSc.Vec) -> float:
        """Return ``x . K x``, summed domain by domain: nothing, for a rigid motion.

        The reduced tangent has each entry to round-off of the stiffest domain around; the
        gradient of a rigid motion is round-off in every domain.
        """
        total, fields = 0.0, self._unknowns.fields
        increments = [field.on_background(x) for field in fields]
        for field, u in zip(fields, increments, strict=True):
            force = u.duplicate()
            force.set(0.0)
            field.acting.add_product(u, force)
            total += force.dot(u)
        for term in self._terms:
            motions = [self._unknowns.moved(body, increments) for body in term.bodies]
            if term.own is not None:
                motions.append(term.own.of(x))
            forces = term.stiffness_force(motions)
            for force, moved in zip(forces, motions, strict=False):
                total += force.dot(moved)
        return float(total)

    def motion(self, x: PETSc.Vec) -> float:
        """Return the size of the displacement that x causes on the bodies."""
        sizes = [size for field in self._unknowns.fields for size in field.on_bodies(x)]
        return joint_norm([*sizes, *(norm(own.of(x)) for own in self._unknowns.own)])

    def field_of(self, x: PETSc.Vec) -> str | None:
        """Return the name of the field that x changes alone, if it is one of no displacement."""
        sizes = [joint_norm(field.on_bodies(x)) for field in self._unknowns.fields]
        largest = int(np.argmax(sizes))
        field = self._unknowns.fields[largest]
        if not isinstance(field, ValueField) or max(sizes) == 0.0:
            return None
        others = [size for number, size in enumerate(sizes) if number != largest]
        alone = joint_norm([0.0, *others]) <= SMALL * sizes[largest]
        return field.carried[0].field.name if alone else None

    def extent(self) -> float:
        """Return the size of the positions of all nodes."""
        places = self._unknowns.places
        return joint_norm([motion.extent() / field.factor for field, motion in places])

    def is_rigid(self, x: PETSc.Vec) -> bool:
        """Return whether x moves each body as a rigid one."""
        increments = [field.on_background(x) for field in self._unknowns.fields]
        return all(
            [
                motion.is_rigid(self._unknowns.moved(motion.particles, increments))
                for _, motion in self._unknowns.places
            ]
        )
