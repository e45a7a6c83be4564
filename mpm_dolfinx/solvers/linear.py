# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The linear solver of a step: PETSc KSP on the reduced tangent with a shifted diagonal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from petsc4py import PETSc

import numpy as np

from ..errors import MPMError
from ..history import Statistics
from ..parallel.magnitudes import unit_sized

__all__ = ["ShiftedFactor"]

#: Values of MUMPS's INFOG(1) that more workspace cures.
OUT_OF_WORKSPACE = (-8, -9)
FACTORS = ("lu", "cholesky")
#: Most iterations of a refinement, and how often it begins anew.
KRYLOV, REFINEMENTS = 60, 4
#: Options of MUMPS unless others are given: K scaled by its diagonal, as the shift is.
MUMPS = {"mat_mumps_icntl_8": 1}
#: The same where the diagonal says nothing of the size of a row: rows and columns in turn.
SADDLE = {"mat_mumps_icntl_8": 7}
#: PORD orders plane graphs three times as fast as METIS and no worse, in space worse; from that
#: many unknowns on, as it ends the process where all unknowns are neighbours of each other.
PORD, PORD_FROM = {"mat_mumps_icntl_7": 4}, 10000
#: PETSc's error numbers for what an option asks for: not supported, out of range, an unknown
#: type, and a package that is missing.
REFUSALS = (56, 63, 86, 92)


class ShiftedFactor:
    """Factorises ``K + D`` with ``D = shift |diag K|``, which is kept through a step.

    Args:
        snes: PETSc SNES whose KSP is set up.
        prefix: PETSc options prefix.
        options: PETSc options, without prefix.
        symmetric: Whether K is symmetric.
        shift: Relative shift.
        dim: Dimension of space.
        statistics: Where to count.

    Raises:
        MPMError: PETSc refuses an option.

    Attributes:
        K: The tangent that was factorised last.
        P: What was factorised; K itself without a shift.
        D: The shift of the step, or ``None`` before its first factorisation and without a shift.
        shift: As given.
        num_negative: Number of unknowns, of all ranks, with a negative shift.
    """

    def __init__(
        self,
        snes: PETSc.SNES,
        prefix: str,
        options: dict[str, Any],
        symmetric: bool,
        shift: float,
        dim: int,
        statistics: Statistics,
    ) -> None:
        self.shift = shift
        self.K: PETSc.Mat | None = None
        self.P: Any = None
        self.D: PETSc.Vec | None = None
        self.num_negative = 0
        self._symmetric = symmetric
        self._statistics = statistics
        self._refining: PETSc.KSP | None = None
        self._ksp = ksp = snes.getKSP()
        ksp.setType("preonly")
        pc = ksp.getPC()
        pc.setType("cholesky" if symmetric else "lu")
        pc.setFactorSolverType("mumps")
        self._options = {prefix + key: value for key, value in options.items()}
        self._prefix, self._dim = prefix, dim
        with _options_refused(), self._own_options() as database:
            snes.setFromOptions()
            own = database.hasName(f"{prefix}pc_factor_mat_solver_type")
            if pc.getType() in FACTORS:
                if not own:
                    pc.setFactorSolverType("mumps")  # changing the type had dropped it
                _require_factor(pc)

    @contextmanager
    def _own_options(self, size: int = 0) -> Iterator[PETSc.Options]:
        """Put the options into PETSc's database, for what reads them inside the block."""
        database = PETSc.Options()
        plane = self._dim == 2 and size >= PORD_FROM
        chosen = (SADDLE if self.num_negative else MUMPS) | (PORD if plane else {})
        defaults = {self._prefix + k: v for k, v in chosen.items()}
        options = {k: v for k, v in defaults.items() if not database.hasName(k)} | self._options
        for key, value in options.items():
            database[key] = value
        try:
            yield database
        finally:
            for key in options:
                database.delValue(key)

    def begin(self) -> None:
        """Begin a step (collective)."""
        self.D = None

    def forget(self) -> None:
        """Take the next tangent for a new one, since SNES knows none any more."""
        self.K = None

    def set(
        self,
        K: PETSc.Mat,
        sizes: Callable[[PETSc.Mat], PETSc.Vec],
        rigid_motions: Callable[[], PETSc.NullSpace],
        damping: float = 0.0,
    ) -> bool:
        """Factorise K with the step's shift, or with a larger one (collective).

        Args:
            K: The tangent.
            sizes: Returns the sizes of its diagonal with the signs of the shift, none zero.
            rigid_motions: Makes what multigrid must know.
            damping: Relative shift, if larger.

        Returns:
            Whether K and P are new objects.
        """
        new = self.K is not K
        if self.shift > 0.0 and self.D is None:
            self.D = self.shift * sizes(K)
            negative = int(np.count_nonzero(self.D.array_r < 0.0))
            self.num_negative = K.comm.tompi4py().allreduce(negative)
        diagonal = damping * sizes(K) if damping > self.shift else self.D
        if diagonal is None:
            self.P = K
        elif new:
            self.P = K.copy()
        else:
            K.copy(self.P, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        if diagonal is not None:
            self.P.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD_VALUES)
        if new:
            self.K = K
            self._refining = None
            if self._symmetric:
                self.P.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            if self._ksp.getPC().getType() not in FACTORS:
                self.P.setNearNullSpace(rigid_motions())
        if self._ksp.getPC().getFailedReason():
            self._ksp.getPC().reset()  # MUMPS does not factorise again where it failed
        self._ksp.setOperators(K, self.P)
        with self._statistics.phase("factorise"), self._own_options(K.getSize()[0]):
            with _options_refused():
                self._ksp.setUp()  # where the factor is made, which reads options of its own
            self._give_workspace()
        self._statistics.count("factorisations")
        return new

    def _give_workspace(self) -> None:
        """Factorise again with more workspace where MUMPS ran out of it."""
        pc = self._ksp.getPC()
        if pc.getType() not in FACTORS or pc.getFactorSolverType() != "mumps":
            return
        for percent in (100, 200, 400, 800):
            if pc.getFactorMatrix().getMumpsInfog(1) not in OUT_OF_WORKSPACE:
                return
            pc.reset()
            self._ksp.setOperators(self.K, self.P)
            pc.setFactorSetUpSolverType()
            pc.getFactorMatrix().setMumpsIcntl(14, percent)
            self._ksp.setUp()
            self._statistics.count("workspace_retries")

    def solve(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve with the last factor (collective)."""
        with self._statistics.phase("solve"):
            self._ksp.solve(b, x)

    def refine(self, b: PETSc.Vec, x: PETSc.Vec, tolerance: float) -> float:
        """Improve a solution of ``(K + D) x = b`` to one of ``K x = b`` (collective).

        The last factor is the preconditioner. Where K is many times D nothing is left to do;
        where it is smaller, in what moves easily beside the stiffness at its nodes, the factor
        alone would leave most of b to D.

        Args:
            b: The right-hand side.
            x: The solution by the last factor; replaced.
            tolerance: Norm of ``b - K x`` that is small enough, relative to b's.

        Returns:
            That norm in the end, relative to b's.
        """
        assert self.K is not None
        scaled, exponent = unit_sized(b)
        size = scaled.norm()
        if size == 0.0 or not np.isfinite(size):
            return 0.0
        if self._refining is None:
            self._refining = ksp = PETSc.KSP().create(b.comm)
            ksp.setType("fgmres")
            ksp.setGMRESRestart(KRYLOV)
            ksp.setPC(self._ksp.getPC())
        ksp = self._refining
        ksp.setOperators(self.K, self.P)
        ksp.setTolerances(rtol=1e-15, atol=0.5 * tolerance * size, max_it=KRYLOV)
        rest, step = b.duplicate(), x.duplicate()
        best = np.inf
        with self._statistics.phase("solve"):
            for _ in range(REFINEMENTS):
                _product(self.K, x, exponent, rest)
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

    def negative_pivots(self) -> int:
        """Return how many pivots of the last factor are negative, where it says so."""
        pc = self._ksp.getPC()
        if pc.getType() != "cholesky" or pc.getFactorSolverType() != "mumps":
            return 0
        return int(pc.getFactorMatrix().getMumpsInfog(12))


@contextmanager
def _options_refused() -> Iterator[None]:
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


def _require_factor(pc: PETSc.PC) -> None:
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


def _product(K: PETSc.Mat, x: PETSc.Vec, exponent: int, result: PETSc.Vec) -> None:
    """Set a vector to ``K x`` over a power of two (collective)."""
    if exponent == 0:
        K.mult(x, result)
        return
    scaled = x.copy()
    scaled.array_w[:] = np.ldexp(x.array_r, -exponent)
    K.mult(scaled, result)
