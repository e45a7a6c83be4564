# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Well-conditioned symmetric systems, solved on all ranks together to round-off."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

from ..tolerances import ROUND_OFF

__all__ = ["conjugate_gradients"]


def conjugate_gradients(comm: MPI.Comm) -> PETSc.KSP:
    """Return conjugate gradients with a diagonal preconditioner (collective).

    Args:
        comm: The ranks.
    """
    ksp = PETSc.KSP().create(comm)
    ksp.setType("cg")
    ksp.getPC().setType("jacobi")
    ksp.setTolerances(rtol=ROUND_OFF)
    return ksp
