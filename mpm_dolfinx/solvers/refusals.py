# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""PETSc's refusals of options, told in a sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from petsc4py import PETSc

from ..errors import MPMError

__all__ = ["options_refused", "require_factor"]

#: PETSc's error numbers for what an option asks for: not supported, out of range, an unknown
#: type, and a package that is missing.
REFUSALS = (56, 63, 86, 92)


@contextmanager
def options_refused() -> Iterator[None]:
    """Tell in a sentence where PETSc refuses an option inside the block, as it does on all ranks.

    Raises:
        MPMError: It does.
    """
    try:
        yield
    except PETSc.Error as error:
        if error.ierr not in REFUSALS:
            raise
        told = str(error).splitlines()[-1].partition("] ")[2].rstrip(". ")
        raise MPMError(
            f"PETSc refuses an option of the problem: {told}; correct petsc_options=, or what the "
            "program's command line sets."
        ) from error


def require_factor(pc: PETSc.PC) -> None:
    """Let PETSc raise its error where it has not the factorisation that is asked for.

    It would say so at the first step only.
    """
    one = PETSc.Mat().createAIJ(((1, None), (1, None)), nnz=1, comm=pc.comm)
    one.assemble()
    trial = PETSc.PC().create(pc.comm)
    trial.setType(pc.getType())
    trial.setFactorSolverType(pc.getFactorSolverType())
    trial.setOperators(one, one)
    trial.setFactorSetUpSolverType()
