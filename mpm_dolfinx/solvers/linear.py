# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The linear solver of a step: PETSc KSP on the reduced tangent with a shifted diagonal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from petsc4py import PETSc

import numpy as np

from ..errors import ConvergenceError, MPMError
from ..history import Statistics
from ..parallel.totals import over_ranks
from ..tolerances import HALF_DIGITS, INEXACT, SOLVED
from .multigrid import Multigrid
from .problem import Levels
from .products import acting
from .refinement import KRYLOV, Refinement
from .refusals import Failure, failure_of, options_refused, require_factor, warn_of_unread
from .saddle import SaddleMultigrid
from .strategies import STRATEGIES, mumps_options
from .workspace import FACTORS, give_workspace, lacks_workspace

__all__ = ["ShiftedFactor"]

#: Most unknowns of the coarsest level of multigrid, which is factorised.
COARSEST = 600
#: Relative residual of what multigrid solves besides Newton's steps, and its most iterations.
ACCURATE, ITERATIONS = 1e-6, 200
#: Relative residual of the first of Newton's steps by multigrid (Eisenstat & Walker 1996), and
#: what is left of a residual's tolerance by one that is to meet it.
FIRST, FINAL = 1e-2, 0.2
#: Tries of a step that end where a tangent is indefinite, before it is solved with all the same.
PATIENCE = 3
#: How packages that factorise write themselves.
NAMES = {"mumps": "MUMPS", "petsc": "PETSc", "superlu_dist": "SuperLU_DIST"}
#: By which conjugate gradients say that a tangent is not positive definite.
INDEFINITE = (
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT,
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC,
)


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
        linear_solver: ``"auto"``, ``"direct"`` or ``"multigrid"``.

    Raises:
        MPMError: PETSc refuses an option, or a PC is given beside multigrid.

    Attributes:
        K: The tangent that was factorised last.
        P: What was factorised; K itself without a shift, and with multigrid.
        D: The shift of the step, or ``None`` before its first factorisation and where there is
            none: by ``shift=0``, or as masses hold all unknowns.
        shift: As given.
        num_negative: Number of unknowns, of all ranks, with a negative shift.
        iterates: Whether multigrid solves in the step that has begun.
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
        linear_solver: str = "auto",
    ) -> None:
        self.shift = shift
        self.iterates = False
        self._own_rtol = self._own_type = False
        self._longest = ITERATIONS
        self._bearable = np.inf  # iterations for a decade of the residual
        self._taken_over = False  # by a factor, where multigrid comes to nothing
        self._dear = False  # what multigrid takes, beside a factorisation
        self._left: float | None = None  # of the residual, by the linear model
        self._bent, self._curved = 1.0, 1.0  # what that lacked in the first solve of a step
        self._multigrid: Multigrid | SaddleMultigrid | None = None
        self._constrained = False
        self._levels: Levels | None = None
        self._linear_solver = linear_solver
        self._negative = False
        self._indefinite = 0
        self._singular = False  # whether multigrid has failed for want of a shift
        self.K: PETSc.Mat | None = None
        self.P: Any = None
        self.D: PETSc.Vec | None = None
        self.num_negative = 0
        self._symmetric = symmetric
        self._statistics = statistics
        self._refining: Refinement | None = None
        self._ksp = ksp = snes.getKSP()
        ksp.setType("preonly")
        pc = ksp.getPC()
        pc.setType("cholesky" if symmetric else "lu")
        pc.setFactorSolverType("mumps")
        self._options = {prefix + key: value for key, value in options.items()}
        self._unread = set(self._options)
        self._prefix, self._dim, self._strategy = prefix, dim, STRATEGIES[dim]
        given = {*PETSc.Options(prefix).getAll(), *options}
        said = any(key.startswith(("ksp_", "pc_", "mat_")) for key in given)
        with options_refused(), self._own_options() as database:
            snes.setFromOptions()
            if snes.getType() != "newtonls" or database.hasName(f"{prefix}snes_linesearch_type"):
                raise MPMError(
                    "snes_type and snes_linesearch_type of petsc_options= have no meaning here, as "
                    "Newton's method and its line search are this package's own; leave them out."
                )
            own = database.hasName(f"{prefix}pc_factor_mat_solver_type")
            self._own_rtol = database.hasName(f"{prefix}ksp_rtol")
            self._own_type = any(database.hasName(prefix + key) for key in ("pc_type", "ksp_type"))
            if self._own_type and linear_solver == "multigrid":
                raise MPMError(
                    "linear='multigrid' chooses ksp_type and pc_type; leave them out of "
                    "petsc_options=."
                )
            if pc.getType() in FACTORS:
                if not own:
                    pc.setFactorSolverType("mumps")  # changing the type had dropped it
                require_factor(pc)
        self._direct = ksp.getType(), pc.getType(), pc.getFactorSolverType()
        suits = symmetric and shift > 0.0 and not said and snes.comm.size == 1
        self._few = self._strategy.few if suits else 0

    def in_words(self) -> str:
        """Return the solver in words, and the reason for it."""
        if self._own_type:
            return f"{self._ksp.getType()} with {self._ksp.getPC().getType()} by PETSc's options"
        if self.iterates:
            chosen = "chosen for so many unknowns" if self._linear_solver == "auto" else "as asked"
            return f"multigrid ({chosen})"
        _, factor, package = self._direct
        kind, why = ("LDL^T", "symmetric") if factor == "cholesky" else ("LU", "unsymmetric")
        why += " tangent"
        if package != (package := self._ksp.getPC().getFactorSolverType()):
            why += ", few unknowns"
        elif self._dear:
            why += ", after multigrid took longer than a factor or came to nothing"
        return f"{kind} by {NAMES.get(package, package)} ({why})"

    @contextmanager
    def _own_options(self, size: int = 0) -> Iterator[PETSc.Options]:
        """Put the options into PETSc's database, for what reads them inside the block."""
        database = PETSc.Options()
        saddle, compresses = self.num_negative > 0, self._compresses(size)
        ranks = self._ksp.comm.size
        chosen = mumps_options(self._strategy, size, saddle, compresses, ranks)
        defaults = {self._prefix + k: v for k, v in chosen.items()}
        options = {k: v for k, v in defaults.items() if not database.hasName(k)} | self._options
        for key, value in options.items():
            database[key] = value
        try:
            yield database
        finally:
            self._unread = {key for key in self._unread if not database.used(key)}
            for key in options:
                database.delValue(key)

    def begin(self, size: int, levels: Levels) -> None:
        """Begin a step (collective).

        Args:
            size: Number of all unknowns.
            levels: What multigrid must know of the unknowns.
        """
        self.D = self._left = None
        self._constrained = levels.constrained
        self._bearable = self._iterations_for_a_factor(size)
        self._taken_over = size <= self._strategy.taken_over
        iterates = self._prefers_multigrid(size, levels)
        if iterates != self.iterates:
            self._choose(iterates)
        if not iterates:
            self._choose_package(size)
            self._iterate_with_factor(size)

    def _choose_package(self, size: int) -> None:
        """Let PETSc's own factor take few unknowns, which nothing constrains."""
        pc = self._ksp.getPC()
        few = 0 < size <= self._few and not self._constrained
        package = PETSc.Mat.SolverType.PETSC if few else self._direct[2]
        if self._few == 0 or pc.getFactorSolverType() == package:
            return
        self._ksp.reset()
        self.K = None
        pc.setFactorSolverType(package)
        if few:
            pc.setFactorOrdering("nd")
            pc.setFactorPivot(0.0)  # pivots of the shift are as small as round-off

    def _compresses(self, size: int) -> bool:
        """Return whether factors have blocks of low rank."""
        least = self._strategy.compressed
        if least is None or size < least or self._own_type:
            return False
        _, factor, package = self._direct
        return factor in FACTORS and package == "mumps"

    def _iterate_with_factor(self, size: int) -> None:
        """Let a factor with blocks of low rank precondition, others solve (collective)."""
        if self._compresses(size):
            self._ksp.setType("fgmres")
            self._ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
            self._ksp.setTolerances(rtol=SOLVED, atol=0.0, max_it=ITERATIONS)
            self._ksp.setGMRESRestart(KRYLOV)
        elif self._ksp.getType() != self._direct[0]:
            self._ksp.setType(self._direct[0])
            self._ksp.setNormType(PETSc.KSP.NormType.NORM_DEFAULT)

    def _prefers_multigrid(self, size: int, levels: Levels) -> bool:
        if size <= COARSEST:
            return False  # a factor is all that its levels would be
        if self._own_type or self._dear:
            return False
        if self._linear_solver != "auto":
            return self._linear_solver == "multigrid"
        least = self._strategy.crossover
        if least is None or self._constrained or size < least[0]:
            return False
        # (whether boxes follow the tangent is asked of many unknowns alone: that takes time)
        return size >= least[0 if self._symmetric and levels.nested else 1]

    def _iterations_for_a_factor(self, size: int) -> float:
        """Return the iterations for a decade of the residual that cost as much as a factor."""
        bearable = self._strategy.bearable
        if self._linear_solver != "auto" or bearable is None:
            return np.inf
        power, share = bearable
        return float(size**power / share)

    def _choose(self, iterates: bool) -> None:
        """Set up the KSP for multigrid or for a factorisation (collective)."""
        self.iterates = iterates
        ksp, pc = self._ksp, self._ksp.getPC()
        ksp.reset()
        self._multigrid = self._flexible = self._refining = self._shifted = self.K = None
        if iterates:
            plain = self._symmetric and not self._constrained
            ksp.setType("cg" if plain else "fgmres")
            ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
            ksp.setTolerances(rtol=ACCURATE, atol=0.0, max_it=ITERATIONS)
            ksp.setGMRESRestart(KRYLOV)
            pc.setType("mg")
            with options_refused(), self._own_options():
                ksp.setFromOptions()
            self._longest = ksp.getTolerances()[3]
            return
        kind, factor, package = self._direct
        ksp.setType(kind)
        ksp.setNormType(PETSc.KSP.NormType.NORM_DEFAULT)
        pc.setType(factor)
        pc.setFactorSolverType(package)

    def forget(self) -> None:
        """Take the next tangent for a new one."""
        self.K = None

    def release(self) -> None:
        """Let go of the last tangent and of the levels below it (collective)."""
        if self.iterates:
            self._choose(True)
            self.P = None

    def set(
        self, K: PETSc.Mat, levels: Levels, damping: float = 0.0, of_first: bool = False
    ) -> None:
        """Factorise K with the step's shift, or with a larger one (collective).

        Args:
            K: The tangent.
            levels: What multigrid must know of the unknowns.
            damping: Relative shift, if larger.
            of_first: Whether that is relative to the step's first tangent, where it has a shift.
        """
        self._levels = levels
        if self.iterates and self._dear:
            self._choose(False)
            self._iterate_with_factor(K.getSize()[0])
        if self.shift > 0.0 and self.D is None and not levels.held:
            self.D = self.shift * levels.diagonal(K)
            negative = int(np.count_nonzero(self.D.array_r < 0.0))
            self.num_negative = over_ranks(K.comm.tompi4py(), negative)
        self._negative = False
        diagonal = None
        if damping > self.shift:
            if of_first and self.D is not None:
                diagonal = damping / self.shift * self.D
            else:
                diagonal = damping * levels.diagonal(K)
        if self.iterates:
            self._make_levels(K, levels, diagonal)
        else:
            self._factorise(K, levels, diagonal)
        self._statistics.count("factorisations")
        if self._unread:
            names = [key.removeprefix(self._prefix) for key in sorted(self._unread)]
            self._unread = set()
            warn_of_unread(K.comm.tompi4py(), names)

    def _factorise(self, K: PETSc.Mat, levels: Levels, damping: PETSc.Vec | None = None) -> None:
        """Make a factor of K with a shift, the step's or a larger one (collective)."""
        new = self.K is not K
        diagonal = self.D if damping is None else damping
        if diagonal is None:
            self.P = K
        elif new or self.P is K:
            self.P = K.copy()
        else:
            K.copy(self.P, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        if diagonal is not None:
            self.P.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD_VALUES)
        pc = self._ksp.getPC()
        failed = bool(pc.getFailedReason())
        split = pc.getType() == "fieldsplit"
        if new:
            self.K = K
            self._refining = None
            if self._symmetric:
                self.P.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            if not split and pc.getType() not in FACTORS:
                self.P.setNearNullSpace(levels.rigid_motions())
        if split and (new or failed):
            self._split(levels.splits())  # what a reset would forget
        elif failed:
            pc.reset()  # MUMPS does not factorise again where it failed
        self._ksp.setOperators(K, self.P)
        with self._statistics.phase("factorise"):
            if not (new or failed or split) and self._ksp.getPC().getType() in FACTORS:
                self._ksp.setUp()  # numbers alone, which reads no options
                if not lacks_workspace(self._ksp.getPC()):
                    return
            with self._own_options(K.getSize()[0]), options_refused():
                self._ksp.setUp()  # where the factor is made, which reads options of its own
                give_workspace(self._ksp, self.K, self.P, self._statistics)

    def _split(self, splits: Sequence[tuple[str, slice]]) -> None:
        """Tell a PC of type fieldsplit where the unknowns of each field are, by name (collective).

        It is made anew, as it keeps what it was told before.
        """
        pc = self._ksp.getPC()
        pc.setType("none")
        pc.setType("fieldsplit")
        first = self.P.getOwnershipRange()[0]
        for name, part in splits:
            size = part.stop - part.start
            where = PETSc.IS().createStride(size, first=first + part.start, comm=self.P.comm)
            pc.setFieldSplitIS((name, where))
        with options_refused(), self._own_options():
            pc.setFromOptions()

    def _make_levels(self, K: PETSc.Mat, levels: Levels, damping: PETSc.Vec | None) -> None:
        """Make the levels of multigrid for K, a copy of which is shifted where it must be."""
        known = self.K is K
        damped = damping is not None
        with self._statistics.phase("factorise"), self._own_options(), options_refused():
            if not known:
                self._refining = self._flexible = self._shifted = None
                pc, symmetric = self._ksp.getPC(), self._symmetric
                moves = levels.splits()[0][0] == "displacement"
                if self._constrained and moves:
                    self._multigrid = SaddleMultigrid(pc, levels, COARSEST, symmetric, self._dim)
                else:
                    interpolations = levels.interpolations(COARSEST, values=not moves)
                    self._multigrid = Multigrid(pc, interpolations, symmetric)
                    pc.setFromOptions()
            assert self._multigrid is not None
            matrix = K if not damped and self._sweepable(K) else None
            if matrix is None:
                diagonal = HALF_DIGITS * levels.diagonal(K) if damping is None else damping
                matrix = self._shifted_copy(K, diagonal)
            if self._symmetric:
                matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self._ksp.setOperators(acting(matrix if damped else K), matrix)
            self._multigrid.set(matrix)
            self._ksp.setUp()
        self.K, self.P = K, matrix

    def _sweepable(self, K: PETSc.Mat) -> bool:
        """Return whether multigrid sweeps over K as it is (collective)."""
        diagonal = K.getDiagonal()
        diagonal.abs()
        return not (self._constrained or self._singular) and bool(diagonal.min()[1] > 0.0)

    def _shifted_copy(self, K: PETSc.Mat, diagonal: PETSc.Vec) -> PETSc.Mat:
        """Return K with more on its diagonal, the same object for the same K."""
        matrix = self._shifted
        if matrix is None:
            matrix = self._shifted = K.copy()
        else:
            K.copy(matrix, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        matrix.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD_VALUES)
        return matrix

    def aim(self, norms: Sequence[float], tolerance: float) -> None:
        """Say how exactly the next of Newton's steps is needed, where multigrid finds it.

        That is the finer of Eisenstat & Walker's (1996) two choices: by how much the linear model
        has missed the residual, and what the last iteration has made of that, to the power of the
        golden ratio; no more than its tolerance asks for. A step begins with what the model
        lacked at the beginning of the last one. Where a factor would take over, multigrid may take
        as long as that.

        Args:
            norms: Norms of the residuals so far.
            tolerance: That which is small enough.
        """
        if not self.iterates or self._own_rtol:
            return
        rtol = min(FIRST, self._bent)
        if len(norms) > 1 and norms[-2] > 0.0:
            golden = 0.5 * (1.0 + math.sqrt(5.0))  # Eisenstat & Walker's exponent
            rtol = min(float((norms[-1] / norms[-2]) ** golden), INEXACT)
            if self._left is not None:
                missed = abs(norms[-1] - self._left) / norms[-2]
                rtol = min(rtol, missed)
                if len(norms) == 2:
                    self._curved = missed
        if norms and norms[-1] > 0.0:
            rtol = max(rtol, min(FINAL * tolerance / norms[-1], INEXACT))
        rtol = max(rtol, SOLVED)
        most = self._longest
        if self._taken_over:
            most = math.ceil(min(self._bearable * max(-math.log10(rtol), 1.0), most))
        self._ksp.setTolerances(rtol=rtol, max_it=most)

    def end(self) -> None:
        """End a step that has converged."""
        self._indefinite = 0
        self._bent = self._curved

    def step(self, b: PETSc.Vec, x: PETSc.Vec, shorten: bool = False) -> Failure | None:
        """Solve for a Newton step, or say why that failed (collective).

        Where the method of conjugate gradients has found the tangent indefinite, that of
        generalised minimal residuals solves. Where multigrid comes to nothing a factor takes over
        for the rest of the step, and by ``"auto"`` for good, unless there are so many unknowns that
        it would take far longer.

        Args:
            b: The right-hand side.
            x: Set to the solution.
            shorten: Whether a step that fails is tried again with less load.

        Raises:
            ConvergenceError: The tangent is indefinite, and a smaller step of the load does better.
        """
        if not self.iterates:
            self._ksp.solve(b, x)
            return failure_of(self._ksp)
        K, levels = self.K, self._levels
        assert K is not None and levels is not None
        done = self._iterate(b, x)
        if not done and self.P is K:
            self._singular = True
            self.forget()  # (what has failed is made anew)
            self._make_levels(K, levels, None)
            done = self._iterate(b, x)
        if done:
            self._assess(self._ksp, b)
            return None
        if self._ksp.getConvergedReason() in INDEFINITE:
            self._negative = True
            if self._solve_indefinite(b, x, self._ksp.getTolerances()[0]):
                self._assess(self._flexible, b)
                return None
            self.give_up(shorten)
        if not self._taken_over:
            return Failure("as multigrid does not solve for a step", "use linear='direct'")
        self._dear = self._linear_solver == "auto"
        self._choose(False)
        self._iterate_with_factor(K.getSize()[0])
        self._factorise(K, levels)
        self._statistics.count("multigrid_failures")
        self._ksp.solve(b, x)
        return failure_of(self._ksp)

    def give_up(self, shorten: bool) -> None:
        """Give a step up whose tangent is indefinite, a few times, where multigrid solves.

        Args:
            shorten: Whether a step that fails is tried again with less load.

        Raises:
            ConvergenceError: The step is given up.
        """
        if self.iterates and shorten and self._indefinite < PATIENCE:
            self._indefinite += 1
            raise ConvergenceError("The tangent is not positive definite")

    def _iterate(self, b: PETSc.Vec, x: PETSc.Vec) -> bool:
        """Solve with multigrid; return whether that does (collective)."""
        self._ksp.solve(b, x)
        self._statistics["krylov_iterations"] += self._ksp.getIterationNumber()
        return self._ksp.getConvergedReason() >= 0 or self._does(b)

    def _assess(self, ksp: PETSc.KSP, b: PETSc.Vec) -> None:
        """Note what a solve has left, and whether a factor would have cost less (collective)."""
        size, left = b.norm(), ksp.getResidualNorm()
        self._left = left
        if 0.0 < left < size:
            decades = max(math.log10(size / left), 1.0)
            dear = ksp.getIterationNumber() > decades * self._bearable
            self._dear = self._taken_over and dear

    def _does(self, b: PETSc.Vec) -> bool:
        """Return whether a solve that round-off has ended leaves a residual that does for Newton.

        Near the floor of round-off a tangent with directions that nothing holds looks indefinite.
        """
        reason = self._ksp.getConvergedReason()
        limit = FIRST if reason in INDEFINITE else INEXACT
        done = reason in INDEFINITE or reason == PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT
        return done and bool(self._ksp.getResidualNorm() <= limit * b.norm())

    def _solve_indefinite(self, b: PETSc.Vec, x: PETSc.Vec, rtol: float) -> bool:
        ksp = self._flexible
        if ksp is None:
            ksp = self._flexible = PETSc.KSP().create(b.comm)
            ksp.setType("fgmres")
            ksp.setGMRESRestart(KRYLOV)
            ksp.setPC(self._ksp.getPC())
        ksp.setOperators(acting(self.P), self.P)
        ksp.setTolerances(rtol=rtol, atol=0.0, max_it=ITERATIONS)
        x.set(0.0)
        ksp.solve(b, x)
        self._statistics["krylov_iterations"] += ksp.getIterationNumber()
        return bool(ksp.getConvergedReason() > 0)

    def solve(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve with the last factor, or to a relative residual of 1e-6 (collective)."""
        with self._statistics.phase("solve"):
            if not self.iterates:
                self._ksp.solve(b, x)
                return
            before = self._ksp.getTolerances()[0]
            self._ksp.setTolerances(max_it=self._longest)
            if not self._own_rtol:
                self._ksp.setTolerances(rtol=ACCURATE)
            if not self._negative:
                self._ksp.solve(b, x)
                self._statistics["krylov_iterations"] += self._ksp.getIterationNumber()
                self._negative = self._ksp.getConvergedReason() in INDEFINITE
            if self._negative:
                self._solve_indefinite(b, x, self._ksp.getTolerances()[0])
            self._ksp.setTolerances(rtol=before)

    def refine(self, b: PETSc.Vec, x: PETSc.Vec, tolerance: float) -> float:
        """Improve a solution of ``(K + D) x = b`` to one of ``K x = b`` (collective).

        Args:
            b: The right-hand side.
            x: The solution by the last factor; replaced.
            tolerance: Norm of ``b - K x`` that is small enough, relative to b's.

        Returns:
            That norm in the end, relative to b's.
        """
        assert self.K is not None
        if self._refining is None:
            self._refining = Refinement(self._ksp.getPC())
        with self._statistics.phase("solve"):
            return self._refining(self.K, self.P, b, x, tolerance)

    def negative_pivots(self) -> int:
        """Return how many pivots of the last factor are negative, where it says so.

        Of multigrid is known only whether there would be any.
        """
        if self.iterates:
            return int(self._negative)
        pc = self._ksp.getPC()
        if pc.getType() != "cholesky":
            return 0
        package = pc.getFactorSolverType()
        if package == PETSc.Mat.SolverType.PETSC and not pc.getFailedReason():
            return int(pc.getFactorMatrix().getInertia()[0])
        return int(pc.getFactorMatrix().getMumpsInfog(12)) if package == "mumps" else 0
