# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The linear solver of a step: PETSc KSP on the reduced tangent with a shifted diagonal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from petsc4py import PETSc

from .history import Statistics

__all__ = ["ShiftedFactor"]

#: Values of MUMPS's INFOG(1) that more workspace cures.
OUT_OF_WORKSPACE = (-8, -9)
FACTORS = ("lu", "cholesky")
#: Options of MUMPS unless others are given: K scaled by its diagonal, as the shift is.
MUMPS = {"mat_mumps_icntl_8": 1}
#: PORD orders plane graphs three times as fast as METIS and no worse, in space worse; from that
#: many unknowns on, as it ends the process where all unknowns are neighbours of each other.
PORD, PORD_FROM = {"mat_mumps_icntl_7": 4}, 10000


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

    Attributes:
        K: The tangent that was factorised last.
        P: What was factorised; K itself without a shift.
        D: The shift of the step, or ``None`` before its first factorisation and without a shift.
        shift: As given.
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
        self._symmetric = symmetric
        self._statistics = statistics
        self._ksp = ksp = snes.getKSP()
        ksp.setType("preonly")
        pc = ksp.getPC()
        pc.setType("cholesky" if symmetric else "lu")
        pc.setFactorSolverType("mumps")
        self._options = {prefix + key: value for key, value in options.items()}
        self._prefix, self._dim = prefix, dim
        with self._own_options() as database:
            snes.setFromOptions()
            own = database.hasName(f"{prefix}pc_factor_mat_solver_type")
            if pc.getType() in FACTORS and not own:
                pc.setFactorSolverType("mumps")  # changing the type had dropped it

    @contextmanager
    def _own_options(self, size: int = 0) -> Iterator[PETSc.Options]:
        """Put the options into PETSc's database, for what reads them inside the block."""
        database = PETSc.Options()
        plane = self._dim == 2 and size >= PORD_FROM
        defaults = {self._prefix + k: v for k, v in (MUMPS | (PORD if plane else {})).items()}
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

    def set(
        self, K: PETSc.Mat, rigid_motions: Callable[[], PETSc.NullSpace], damping: float = 0.0
    ) -> bool:
        """Factorise K with the step's shift, or with a larger one (collective).

        Args:
            K: The tangent.
            rigid_motions: Makes what multigrid must know.
            damping: Relative shift, if larger.

        Returns:
            Whether K and P are new objects.
        """
        new = self.K is not K
        if self.shift > 0.0 and self.D is None:
            self.D = _shift(K, self.shift)
        diagonal = _shift(K, damping) if damping > self.shift else self.D
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
            if self._symmetric:
                self.P.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            if self._ksp.getPC().getType() not in FACTORS:
                self.P.setNearNullSpace(rigid_motions())
        if self._ksp.getPC().getFailedReason():
            self._ksp.getPC().reset()  # MUMPS does not factorise again where it failed
        self._ksp.setOperators(K, self.P)
        with self._statistics.phase("factorise"), self._own_options(K.getSize()[0]):
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

    def negative_pivots(self) -> int:
        """Return how many pivots of the last factor are negative, where it says so."""
        pc = self._ksp.getPC()
        if pc.getType() != "cholesky" or pc.getFactorSolverType() != "mumps":
            return 0
        return int(pc.getFactorMatrix().getMumpsInfog(12))


def _shift(K: PETSc.Mat, relative: float) -> PETSc.Vec:
    """Return a share of ``|diag K|``, of its largest entry where it is zero (collective)."""
    diagonal = K.getDiagonal()
    diagonal.abs()
    largest = diagonal.max()[1]
    values = diagonal.array_w
    values[values == 0.0] = largest
    diagonal.scale(relative)
    return diagonal
