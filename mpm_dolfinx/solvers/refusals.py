# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Options that PETSc refuses or does not read, and solves that fail, told in a sentence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

from ..errors import MPMError, warn
from .workspace import FACTORS

__all__ = ["Failure", "failure_of", "options_refused", "require_factor", "warn_of_unread"]

#: PETSc's error numbers for what an option asks for: not supported, out of range, an unknown
#: type, and a package that is missing.
REFUSALS = (56, 63, 86, 92)


class Failure(NamedTuple):
    """Why a linear solve has failed, and what to do where that is known."""

    why: str
    advice: str = ""


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


def warn_of_unread(comm: MPI.Comm, names: Sequence[str]) -> None:
    """Warn of options that PETSc has not read by the time of its first solve (collective).

    Args:
        comm: The ranks.
        names: The options.
    """
    warn(
        comm,
        f"PETSc does not read {' and '.join(map(repr, names))} of petsc_options=, as nothing that "
        "solves here has such an option; correct the spelling or leave it out.",
    )


def failure_of(ksp: PETSc.KSP) -> Failure | None:
    """Say why the last solve has failed, if it has."""
    reasons = PETSc.KSP.ConvergedReason
    reason, pc = ksp.getConvergedReason(), ksp.getPC().getType()
    if reason >= 0:
        return None
    if reason == reasons.DIVERGED_PCSETUP_FAILED:
        return Failure("as the factorisation of the tangent failed")
    if pc in FACTORS:
        return Failure("as a linear solve failed")
    names = (name for name, value in vars(reasons).items() if value == reason)
    name = next(names, f"reason {reason}")
    return Failure(
        f"as ksp_type {ksp.getType()} with pc_type {pc} did not solve for a step: {name} after "
        f"{ksp.getIterationNumber()} iterations",
        "take options that solve in petsc_options=, or leave ksp_type and pc_type out",
    )
