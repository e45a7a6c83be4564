# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A background space with the fields of bodies on it that are no displacements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

from petsc4py import PETSc

import numpy as np

from dolfinx import fem

from ..parallel.conjugate_gradients import conjugate_gradients
from ..parallel.magnitudes import norm
from ..particles.field import CarriedField
from .field import Field
from .numbering import FreeDofs

__all__ = ["ValueField"]


class ValueField(Field):
    """The background space of values on bodies that are no displacements.

    Where the background has the values themselves, ``p = T x``, the unknowns are what these differ
    by from ``x_0``, the values on the background that fit those of the bodies at the last
    converged step best (least squares, weighted by volume). These are not those that the
    background had then: where a body moves, nodes get weight that had none, and others' values
    weigh elsewhere.

    Unknowns are counted in a unit (:attr:`factor`) with which their tangent has the size of the
    displacement's, so that norms of all unknowns and residuals mean something.

    Args:
        bodies: The fields on this space.
        conditions: Dirichlet conditions, of which those on this space count.

    Attributes:
        carried: As given as ``bodies``.
        unit: The factor, ``None`` until it is known.
        start: The values of V that the step starts from, on this rank's own dofs; zero where the
            background has changes.
    """

    def __init__(
        self, bodies: Sequence[CarriedField], conditions: Sequence[fem.DirichletBC] = ()
    ) -> None:
        super().__init__(bodies, conditions)
        self.carried = list(bodies)
        self.unit: float | None = None

    @property
    def factor(self) -> float:  # type: ignore[override]
        """Value on V of an unknown of size 1."""
        return 1.0 if self.unit is None else self.unit

    @override
    def find(self) -> FreeDofs:
        """Look for the values that the step starts from."""
        self._found = None  # (the unit of values may be another one)
        found = super().find()
        self.start = self.force.duplicate()
        self.start.set(0.0)
        for carried in self.carried:
            carried.converged_displacement = carried.field.previous.x.array.copy()
        if self.carried[0].total:
            self._start()
        return found

    def _start(self) -> None:
        """Let values start from those of the background that fit them best (collective)."""
        start = self.start
        start.array_w[:] = np.where(self.fixed, self.prescribed.totals, 0.0)
        scaled, right = [], start.duplicate()
        right.set(0.0)
        for carried in self.carried:
            rows = carried.T.createVecLeft()
            weight = rows.duplicate()
            bs = carried.W.dofmap.index_map_bs
            weight.array_w[:] = np.sqrt(np.repeat(carried.weights, bs))
            carried.T.mult(start, rows)
            before = carried.field.previous.x.array[: rows.getLocalSize()]
            rows.array_w[:] = weight.array_r**2 * (before - rows.array_r)
            carried.T.multTransposeAdd(rows, right, right)
            scaled.append(carried.T.copy())
            scaled[-1].diagonalScale(L=weight)
        if norm(right) > 0.0:
            self._fit(scaled, right, start)
        for carried in self.carried:
            rows = carried.T.createVecLeft()
            carried.T.mult(start, rows)
            base = carried.converged_displacement
            base[: rows.getLocalSize()] = rows.array_r
            values = fem.Function(carried.W)
            values.x.array[:] = base
            values.x.scatter_forward()
            base[:] = values.x.array

    def _fit(self, scaled: Sequence[PETSc.Mat], right: PETSc.Vec, start: PETSc.Vec) -> None:
        """Add to the start what solves the normal equations at the free dofs (collective)."""
        normal = scaled[0].transposeMatMult(scaled[0])
        for one in scaled[1:]:
            normal = normal + one.transposeMatMult(one)
        first = start.getOwnershipRange()[0]
        free = PETSc.IS().createGeneral((first + self.dofs).astype(PETSc.IntType), comm=self._comm)
        block, part = normal.createSubMatrix(free, free), right.getSubVector(free)
        change = part.duplicate()
        ksp = conjugate_gradients(self._comm)
        ksp.setOperators(block)
        ksp.solve(part, change)
        if np.isfinite(norm(change)):
            start.array_w[self.dofs] = start.array_r[self.dofs] + change.array_r
        right.restoreSubVector(free, part)
