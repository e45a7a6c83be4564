# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Projection of velocities on what a step's backgrounds can follow, orthogonal in the mass.

Combinations of unknowns that hardly move the bodies' nodes are held by a shift, and let go as far
as they can be, as in Newton's method, for which this is the start.
"""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from ..errors import ConvergenceError
from ..tolerances import EQUAL, LAST_PLACES, LOCAL_ITERATIONS, ROUND_OFF, SOLVED

__all__ = ["Projection"]


class Projection:
    """Solves with the mass reduced to the unknowns.

    Args:
        A: The reduced mass ``T^T M T``.
    """

    def __init__(self, A: PETSc.Mat) -> None:
        self._unit = scale = A.getDiagonal()
        values = scale.array_w
        values[:] = np.where(values > 0.0, values, 1.0) ** -0.5
        shifted = A.copy()
        shifted.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        shifted.diagonalScale(scale, scale)
        diagonal = shifted.getDiagonal()
        values = diagonal.array_w
        values[:] = np.where(values > 0.0, ROUND_OFF, 1.0)
        shifted.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD_VALUES)
        self._shifted, self._held = shifted, diagonal
        self._incomplete: PETSc.KSP | None = None
        self._factor: PETSc.KSP | None = None
        self._iterates = True

    def zeros(self) -> PETSc.Vec:
        """Return zero for all unknowns."""
        vector = self._unit.duplicate()
        vector.set(0.0)
        return vector

    def solve(self, right: PETSc.Vec, guess: PETSc.Vec | None = None) -> PETSc.Vec:
        """Return the unknowns of a projection (collective).

        Args:
            right: ``T^T M v``.
            guess: Unknowns to begin with.

        Raises:
            ConvergenceError: That failed.
        """
        scaled, y = right.duplicate(), self.zeros()
        scaled.pointwiseMult(right, self._unit)
        size = scaled.norm()
        if size == 0.0:
            return y
        if guess is not None:
            y.pointwiseDivide(guess, self._unit)
        rest = self._rest(scaled, y)
        # (to the last place, so that momentum does not wander in thousands of steps)
        while rest.norm() > 2.0 * LAST_PLACES * size:
            part = y.duplicate()
            self._solve_scaled(rest, part, size)
            part.axpy(1.0, y)
            left = self._rest(scaled, part)
            if not left.norm() <= 0.5 * rest.norm():
                break
            y, rest = part, left
        result = y.duplicate()
        result.pointwiseMult(y, self._unit)
        return result

    def _rest(self, right: PETSc.Vec, y: PETSc.Vec) -> PETSc.Vec:
        """Return the right-hand side that y leaves, without the shift."""
        rest, held = right.duplicate(), right.duplicate()
        self._shifted.mult(y, rest)
        held.pointwiseMult(self._held, y)
        rest.axpby(1.0, -1.0, right)
        rest.axpy(1.0, held)
        return rest

    def _solve_scaled(self, right: PETSc.Vec, y: PETSc.Vec, size: float) -> None:
        """Solve with the matrix of unit diagonal: by iterations, or where they fail by a factor.

        What is left is judged by a size.
        """
        if self._iterates:
            if self._incomplete is None:
                self._incomplete = _incomplete(self._shifted)
            ksp = self._incomplete
            ksp.setTolerances(rtol=0.0, atol=LAST_PLACES * size, max_it=LOCAL_ITERATIONS)
            ksp.solve(right, y)
            if ksp.getConvergedReason() > 0:
                return
            self._iterates = False
        more = 0.0
        while more <= SOLVED:
            if self._factor is None:
                self._shifted.shift(more)
                self._held.shift(more)
                self._factor = _solver(self._shifted, "preonly", "cholesky")
                self._factor.getPC().setFactorSolverType("mumps")
            y.set(0.0)
            rest, part, before = right.copy(), y.duplicate(), np.inf
            while ROUND_OFF * size < rest.norm() < 0.5 * before:
                before = rest.norm()
                self._factor.solve(rest, part)
                y.axpy(1.0, part)
                self._shifted.mult(y, rest)
                rest.aypx(-1.0, right)
            if rest.norm() <= SOLVED * size:
                return
            self._factor, more = None, max(10.0 * more, EQUAL)  # the factor is at round-off
        raise ConvergenceError("The projection of the velocities on the range of T failed")


def _solver(A: PETSc.Mat, kind: str, preconditioner: str) -> PETSc.KSP:
    """Return a solver with a matrix (collective)."""
    ksp = PETSc.KSP().create(A.comm)
    ksp.setType(kind)
    ksp.setOperators(A)
    ksp.getPC().setType(preconditioner)
    return ksp


def _incomplete(A: PETSc.Mat) -> PETSc.KSP:
    """Return conjugate gradients with an incomplete factor on each rank (collective)."""
    ksp = _solver(A, "cg", "icc" if A.comm.size == 1 else "asm")
    if A.comm.size > 1:
        pc = ksp.getPC()
        pc.setASMOverlap(0)
        ksp.setUp()
        for part in pc.getASMSubKSP():
            part.setType("preonly")
            part.getPC().setType("icc")
    return ksp
