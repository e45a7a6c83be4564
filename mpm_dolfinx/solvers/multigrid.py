# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Geometric multigrid as a preconditioner: Galerkin levels below a tangent."""

from __future__ import annotations

from collections.abc import Sequence

from petsc4py import PETSc

import numpy as np

from ..tolerances import HALF_DIGITS
from .products import acting, galerkin

__all__ = ["Multigrid"]


#: Power iterations that look for the largest correction of a sweep, what it may fall short of it,
#: and what it may be, relative to the right one: below 2.
POWERS, MARGIN, OVERSHOOT = 12, 1.15, 1.8


class Multigrid:
    """Makes a PETSc PC a V cycle over given levels.

    Coarse tangents are Galerkin products, which keep their sparsity as long as the finest one is
    the same object. One symmetric sweep of successive over-relaxation smooths before and after; on
    several ranks each sweeps over its own unknowns.

    Args:
        pc: The preconditioner (collective).
        interpolations: What gives the unknowns of each level from those of the next coarser one,
            from the finest level on.
        symmetric: Whether tangents are symmetric.

    Attributes:
        levels: Number of levels below the finest.
    """

    def __init__(self, pc: PETSc.PC, interpolations: Sequence[PETSc.Mat], symmetric: bool) -> None:
        self._pc, self._interpolations = pc, list(interpolations)
        self.levels = len(self._interpolations)
        self._products: list[PETSc.Mat] = []
        self._symmetric = symmetric
        count = len(self._interpolations) + 1
        pc.reset()
        pc.setType("none")  # what an earlier hierarchy has left goes, and that it has failed
        pc.setFailedReason(PETSc.PC.FailedReason.NOERROR)
        pc.setType("mg")
        pc.setMGLevels(count)
        for number, matrix in enumerate(self._interpolations):
            pc.setMGInterpolation(count - 1 - number, matrix)
        for level in range(1, count):
            smoother = pc.getMGSmoother(level)
            smoother.setType("richardson")
            smoother.setTolerances(max_it=1)
            smoother.getPC().setType("sor")
        coarse = pc.getMGCoarseSolve()
        coarse.setType("preonly")
        inner = coarse.getPC()
        kind = "cholesky" if symmetric else "lu"
        inner.setType(kind)
        inner.setFactorSolverType("mumps")

    def set(self, K: PETSc.Mat) -> None:
        """Take over the values of a tangent (collective)."""
        fresh = not self._products
        fine = K
        for number, P in enumerate(self._interpolations):
            if fresh:
                self._products.append(galerkin(fine, P))
                if self._symmetric:
                    self._products[-1].setOption(PETSc.Mat.Option.SYMMETRIC, True)
            else:
                galerkin(fine, P, self._products[number])
            fine = self._products[number]
            _shift_diagonal(fine)
        for number, matrix in enumerate(reversed([K, *self._products])):
            solver = self._pc.getMGSmoother(number) if number else self._pc.getMGCoarseSolve()
            solver.setOperators(acting(matrix) if number else matrix, matrix)
            if number and fresh and K.comm.size > 1:
                _damp(solver, matrix)


def _damp(smoother: PETSc.KSP, matrix: PETSc.Mat) -> None:
    """Shorten the sweeps of several ranks where together they would overshoot (collective).

    Each rank corrects its own unknowns as if the others stood still. Where that is more than twice
    what it should be, the cycle is not positive definite. How much it is, is the largest eigenvalue
    of the sweep times the matrix, found by power iterations.
    """
    smoother.setUp()
    sweep = smoother.getPC()
    x, force = matrix.createVecRight(), matrix.createVecLeft()
    first = x.getOwnershipRange()[0]
    x.array_w[:] = np.sin(1.0 + 1.7 * (first + np.arange(x.getLocalSize())))
    size = 1.0
    for _ in range(POWERS):
        x.scale(1.0 / x.norm())
        matrix.mult(x, force)
        sweep.apply(force, x)
        size = x.norm()
        if not 0.0 < size < np.inf:
            return
    scale = min(1.0, OVERSHOOT / (MARGIN * size))
    key = f"{smoother.getOptionsPrefix()}ksp_richardson_scale"
    options = PETSc.Options()
    if options.hasName(key):
        return
    options[key] = scale
    smoother.setFromOptions()
    options.delValue(key)


def _shift_diagonal(matrix: PETSc.Mat) -> None:
    """Make a singular tangent definite (collective): by the largest entry where nothing moves."""
    diagonal = matrix.getDiagonal()
    diagonal.abs()
    largest = diagonal.max()[1]
    values = diagonal.array_w
    zero = values == 0.0
    # (boxes may have more dofs than the body can tell apart)
    values *= HALF_DIGITS
    values[zero] = largest if largest > 0.0 else 1.0
    matrix.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD_VALUES)
