# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Workspace of MUMPS, whose estimate may be too small."""

from __future__ import annotations

from petsc4py import PETSc

from ..history import Statistics

__all__ = ["FACTORS", "give_workspace", "lacks_workspace"]

#: Values of MUMPS's INFOG(1) that more workspace cures.
OUT_OF_WORKSPACE = (-8, -9)
#: Types of PCs that factorise.
FACTORS = ("lu", "cholesky")


def lacks_workspace(pc: PETSc.PC) -> bool:
    """Return whether MUMPS ran out of workspace."""
    if pc.getType() not in FACTORS or pc.getFactorSolverType() != "mumps":
        return False
    return pc.getFactorMatrix().getMumpsInfog(1) in OUT_OF_WORKSPACE


def give_workspace(ksp: PETSc.KSP, K: PETSc.Mat, P: PETSc.Mat, statistics: Statistics) -> None:
    """Factorise again with more workspace where MUMPS ran out of it (collective).

    Args:
        ksp: The solver.
        K: Its tangent.
        P: What it factorises.
        statistics: Where to count.
    """
    pc = ksp.getPC()
    for percent in (100, 200, 400, 800):
        if not lacks_workspace(pc):
            return
        pc.reset()
        ksp.setOperators(K, P)
        pc.setFactorSetUpSolverType()
        pc.getFactorMatrix().setMumpsIcntl(14, percent)
        ksp.setUp()
        statistics.count("workspace_retries")
