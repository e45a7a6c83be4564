# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Solutions for a tangent by the factor of a shifted one."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from ..parallel.magnitudes import unit_sized

__all__ = ["KRYLOV", "Refinement"]

#: Most iterations before a Krylov method begins anew, and how often a refinement does.
KRYLOV, REFINEMENTS = 60, 4


class Refinement:
    """Improves solutions of ``(K + D) x = b`` to those of ``K x = b``.

    The last factor is the preconditioner. Where K is many times D nothing is left to do; where it
    is smaller, in what moves easily beside the stiffness at its nodes, the factor alone would leave
    most of b to D.

    Args:
        pc: The preconditioner (collective).
    """

    def __init__(self, pc: PETSc.PC) -> None:
        self._ksp = PETSc.KSP().create(pc.comm)
        self._ksp.setType("fgmres")
        self._ksp.setGMRESRestart(KRYLOV)
        self._ksp.setPC(pc)

    def __call__(
        self, K: PETSc.Mat, P: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec, tolerance: float
    ) -> float:
        """Improve a solution (collective).

        Args:
            K: The tangent.
            P: What was factorised.
            b: The right-hand side.
            x: The solution by the factor; replaced.
            tolerance: Norm of ``b - K x`` that is small enough, relative to b's.

        Returns:
            That norm in the end, relative to b's.
        """
        scaled, exponent = unit_sized(b)
        size = scaled.norm()
        if size == 0.0 or not np.isfinite(size):
            return 0.0
        ksp = self._ksp
        ksp.setOperators(K, P)
        ksp.setTolerances(rtol=1e-15, atol=0.5 * tolerance * size, max_it=KRYLOV)
        rest, step = b.duplicate(), x.duplicate()
        best = np.inf
        for _ in range(REFINEMENTS):
            _product(K, x, exponent, rest)
            rest.aypx(-1.0, scaled)
            left = rest.norm() / size
            if not left < 0.5 * best:
                break
            best = left
            kept = x.copy()
            if left <= tolerance:
                break
            ksp.solve(rest, step)
            step.array_w[:] = np.ldexp(step.array_r, exponent)
            x.axpy(1.0, step)
        kept.copy(x)
        return float(best)


def _product(K: PETSc.Mat, x: PETSc.Vec, exponent: int, result: PETSc.Vec) -> None:
    """Set a vector to ``K x`` over a power of two (collective)."""
    if exponent == 0:
        K.mult(x, result)
        return
    scaled = x.copy()
    scaled.array_w[:] = np.ldexp(x.array_r, -exponent)
    K.mult(scaled, result)
