# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contribution of a rigid body to the tangent of what it touches, by yielding to it."""

from __future__ import annotations

from collections.abc import Sequence

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import MatrixSum
from ..particles.particles import Particles
from .body_contact import ActingPoints, YieldBlocks
from .surface import Blocks, PointMatrix

__all__ = ["Yielding"]


class Yielding:
    """Contribution of a yielding rigid body, ``sum_ab L_a^T R_b`` on W of the bodies.

    Args:
        bodies: The bodies that it touches.
        count: Number of its unknowns.
    """

    def __init__(self, bodies: Sequence[Particles], count: int) -> None:
        self._left, self._right = (
            [PointMatrix(count, body.W) for body in bodies] for _ in range(2)
        )
        self._bodies = bodies
        self._at: tuple[NDArray[np.float64], list[NDArray[np.float64]]] | None = None
        self._factors: list[list[PETSc.Mat | None]] = [[], []]
        self._sums = MatrixSum(), MatrixSum()
        self._reduced: dict[tuple[int, int], tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat]] = {}
        self._product: tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat] | None = None

    def set(
        self,
        s: NDArray[np.float64],
        inverse: NDArray[np.float64],
        parts: Sequence[tuple[ActingPoints, YieldBlocks]],
        share: float,
    ) -> None:
        """Take derivatives at the present positions, where s balances the body (collective)."""
        self._at = s, [np.array(body.displacement.x.array) for body in self._bodies]
        rows = np.arange(len(inverse))
        self._factors = [[], []]
        for place, (acting, blocks) in enumerate(parts):
            keys = acting.facets
            here = np.broadcast_to(rows, (len(keys), len(rows)))
            left = blocks.of_nodes.swapaxes(1, 2) / share
            for side, matrix, values in (
                (0, self._left[place], left),
                (1, self._right[place], inverse @ blocks.by_nodes),
            ):
                factor = matrix.of([Blocks(keys, here, acting.dofs, values)])
                self._factors[side].append(factor)

    def followed(self) -> list[NDArray[np.float64]]:
        """Return how the body would follow to the present positions, if that is known (collective).

        By the last derivatives: where a Newton step is good, that is where it is to be looked for.
        """
        if self._at is None:
            return []
        s, before = self._at
        total = self._yielding(
            [
                None if factor is None else _changed(factor, body, d)
                for factor, body, d in zip(self._factors[1], self._bodies, before, strict=True)
            ]
        )
        if total is None:
            return []
        own = total.array_r.copy()
        return [s - self._bodies[0].mesh.comm.bcast(own)]

    def _yielding(self, motions: Sequence[PETSc.Vec | None]) -> PETSc.Vec | None:
        """Return how the body follows displacements on W of all bodies, with the other sign."""
        total: PETSc.Vec | None = None
        for factor, motion in zip(self._factors[1], motions, strict=False):
            if factor is not None and motion is not None:
                part = factor.createVecLeft()
                factor.mult(motion, part)
                total = part if total is None else total + part
        return total

    def times(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        """Return the product with displacements on W of all bodies (collective)."""
        total = self._yielding(motions)
        if total is None:
            return ()
        forces = []
        for factor, motion in zip(self._factors[0], motions, strict=True):
            force = motion.duplicate()
            force.set(0.0)
            if factor is not None:
                factor.multTranspose(total, force)
            forces.append(force)
        return forces

    def reduced(self, transfers: Sequence[PETSc.Mat]) -> Sequence[PETSc.Mat]:
        """Return the part in all unknowns, the same object for the same pattern (collective).

        Args:
            transfers: T of each body.
        """
        sums = []
        for side, factors in enumerate(self._factors):
            found = [
                self._times_transfer(side, place, factor, T)
                for place, (factor, T) in enumerate(zip(factors, transfers, strict=False))
                if factor is not None
            ]
            if not found:
                return ()
            sums.append(self._sums[side].of(found))
        left, right = sums
        known = self._product
        same = known is not None and known[0] is left and known[1] is right
        result = left.transposeMatMult(right, result=known[2] if same and known else None)
        self._product = left, right, result
        return [result]

    def _times_transfer(self, side: int, place: int, factor: PETSc.Mat, T: PETSc.Mat) -> PETSc.Mat:
        known = self._reduced.get((side, place))
        same = known is not None and known[0] is factor and known[1] is T
        product = factor.matMult(T, result=known[2] if same and known else None)
        self._reduced[side, place] = factor, T, product
        return product


def _changed(factor: PETSc.Mat, body: Particles, before: NDArray[np.float64]) -> PETSc.Vec:
    """Return how a body has been displaced since its displacements were others."""
    change = factor.createVecRight()
    own = slice(0, change.getLocalSize())
    change.array_w[:] = body.displacement.x.array[own] - before[own]
    return change
