# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Newton's method on the reduced system, with a proximal term and a line search."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import ConvergenceError, MPMError
from ..history import Statistics
from ..log import NEWTON, tell
from ..parallel.magnitudes import norm
from ..parallel.totals import over_ranks
from ..tolerances import SOLVED
from .attempt import Attempt, Predictions
from .judge import Judge
from .line_search import LineSearch, Rules, stalled
from .linear import ShiftedFactor
from .problem import ReducedProblem
from .residual import Residual
from .steps import Steps

__all__ = ["NewtonSolver"]


class NewtonSolver:
    """Newton's method with the proximal term and the line search that singular transfers need.

    The reduced tangent K is singular whenever a combination of background dofs moves no node
    of the body, and nearly singular where it hardly moves any. ``D (x - x0)`` is added to the
    residual, where x0 is where the step starts and ``D = shift |diag K|`` at its first tangent:
    a step of the proximal point method (Rockafellar 1976), by which unknowns that move nothing stay
    where they are. The tangent is then ``K + D``, which is K scaled to unit diagonal plus
    ``shift`` times the identity. Where the residual itself is not small enough at the end, it is
    solved for by the last factor, unless more than a tenth of it would stay: that is in unknowns
    that move next to nothing.

    Where the unknowns have others among them that enforce constraints, as a pressure does, D is
    negative for these, as the diagonal of their Schur complement is, and K is to have as many
    negative pivots as there are of them.

    The line search halves a Newton step while a domain inverts, or while both the work of the
    residual on the step stays above 0.8 of its start and the residual's norm grows, unless the
    response is smooth and the next steps make up for it.

    Args:
        comm: Communicator.
        prefix: PETSc options prefix.
        options: PETSc options, without prefix.
        symmetric: Whether the tangent is symmetric.
        shift: Relative diagonal shift.
        line_search: Whether to search.
        statistics: Where to count.
        dim: Dimension of space.
        linear_solver: ``"auto"``, ``"direct"`` or ``"multigrid"``.

    Attributes:
        snes: A PETSc SNES, which has the tolerances, the monitors and the linear solver.
        residuals: Relative residuals of the last attempt.
        x: The solution of the last attempt.
        F: Its residual, without the proximal term.
        gave_up: Whether the last attempt's iterations came to nothing.
        lets_go: Whether what the proximal term holds back is let go once however little it is: in
            a motion it is a viscosity, and the same in each step.
        has_another_way: Whether an attempt that fails may be made in another way at once: there is
            no potential, or it began at a prediction and no smaller step is tried.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        prefix: str,
        options: dict[str, Any],
        symmetric: bool,
        shift: float,
        line_search: bool,
        statistics: Statistics,
        dim: int,
        linear_solver: str = "auto",
    ) -> None:
        self._comm, self._symmetric, self._searches = comm, symmetric, line_search
        self.statistics = statistics
        self.residuals: list[float] = []
        self.gave_up = self.has_another_way = False
        self._attempt: Attempt | None = None
        self._predictions = Predictions()
        self.x: PETSc.Vec | None = None
        self.F: PETSc.Vec | None = None
        self._room: list[PETSc.Vec] = []  # of the same size
        self.lets_go = False
        self.snes = PETSc.SNES().create(comm)
        self.snes.setOptionsPrefix(prefix)
        self.snes.setTolerances(rtol=1e-9, atol=0.0, stol=0.0, max_it=30)
        self._factor = ShiftedFactor(
            self.snes, prefix, options, symmetric, shift, dim, statistics, linear_solver
        )

    @property
    def _now(self) -> Attempt:
        """The present attempt."""
        assert self._attempt is not None
        return self._attempt

    @property
    def K(self) -> PETSc.Mat | None:
        """The reduced tangent."""
        return self._factor.K

    @property
    def linear_solver(self) -> str:
        """The solver of the last step's linear systems in words, and the reason for it."""
        return self._factor.in_words()

    @property
    def iterations(self) -> int:
        """Linear solves of the last attempt."""
        return 0 if self._attempt is None else self._attempt.steps.count

    @property
    def unstable(self) -> bool:
        """Whether a tangent of the last attempt was symmetric, and not positive definite."""
        return self._attempt is not None and self._attempt.steps.indefinite > 0

    @property
    def flips(self) -> list[NDArray[np.int64]]:
        """How often each particle began or ceased to yield, late in the last attempt, by body."""
        yielding = [] if self._attempt is None else self._attempt.yielding
        return [
            np.count_nonzero(np.diff(np.array(each), axis=0), axis=0)
            for each in zip(*yielding[len(yielding) // 2 :], strict=True)
        ]

    @property
    def experience(self) -> tuple[float, int]:
        """Success of predictions in earlier steps, for a checkpoint."""
        return self._predictions.kept, self._predictions.from_zero

    @experience.setter
    def experience(self, values: tuple[float, int]) -> None:
        self._predictions.kept, self._predictions.from_zero = values

    def linearise(
        self, anew: bool = False, tolerance: float = SOLVED
    ) -> Callable[[PETSc.Vec, PETSc.Vec], None]:
        """Factorise the tangent at the solution (collective).

        Args:
            anew: Whether it is that of another step than the last one that was solved.
            tolerance: Norm of ``b - K x`` that is small enough, relative to b's.

        Returns:
            A function of b and x that sets x to the solution of ``K x = b``, as far as K holds x.
        """
        problem = self._now.problem
        K = problem.tangent()
        if anew:
            self._factor.begin(K.getSize()[0], problem.levels)
            self._start(K.getSizes()[0])
        self._factor.set(K, problem.levels)

        def solve(b: PETSc.Vec, x: PETSc.Vec) -> None:
            self._factor.solve(b, x)
            self._factor.refine(b, x, tolerance)

        return solve

    def forget(self) -> None:
        """Forget how the last attempt failed: what comes before the next one may fail too."""
        self.gave_up = False
        if self._attempt is not None:
            self._attempt.yielding.clear()
            self._attempt.steps.count = self._attempt.steps.indefinite = 0

    def release(self) -> None:
        """Let go of the last tangent, which is needed no more (collective)."""
        self._factor.release()

    def solve(
        self,
        problem: ReducedProblem,
        sizes: tuple[int, int],
        shorten: bool,
        again: bool = False,
    ) -> None:
        """Find a root of the residual, starting from zero or from the prediction.

        The prediction is kept only where its residual is small beside that of a start from zero.
        From zero, the first linear solve carries the step's Dirichlet values, as it does in
        finite elements, and their linearised forces count as part of the first residual.

        Args:
            problem: Residual and tangent.
            sizes: Local and global number of unknowns.
            shorten: Whether a step that fails is tried again with less load.
            again: Whether an attempt has failed before: this one begins at zero, and without a
                potential it searches on the norm of the residual alone.

        Raises:
            MPMError: Why there is none; ``x`` and ``F`` are the last evaluated then.
        """
        self.residuals, self.gave_up = [], False
        potential = self._symmetric and problem.work_tells()
        self.has_another_way = self._searches and not potential
        x = self._start(sizes)
        now = self._begin(problem, shorten, again)
        self._factor.begin(sizes[1], problem.levels)
        if sizes[1] == 0:
            problem.impose()
        now.residual.begin(x)
        predicts = not again and self._predictions.lead
        if sizes[1] > 0:
            self._solve_from(x, predicts)
        self._predictions.lead = True
        self._factor.end()

    def unbalanced(self) -> float:
        """Return the relative residual at the last solution, evaluated anew (collective).

        Raises:
            MPMError: It cannot be evaluated.
        """
        assert self.x is not None and self.F is not None
        now = self._now
        if (failure := now.residual.at(self.x)) is not None:
            raise failure
        size, scale = norm(self.F), now.judge.compared_with(now.problem.scale(self.F))
        return size / scale if scale > 0.0 else size

    def go_on(self, share: float) -> None:
        """Come nearer to a root from the last solution on, as what the residual depends on changed.

        The last evaluation must be there (:meth:`unbalanced`). Linear solves are counted on.

        Args:
            share: What part of the residual may stay.

        Raises:
            MPMError: Why there is none.
        """
        assert self.x is not None and self.F is not None
        last, first = self._now, norm(self.F)
        now = self._begin(last.problem, last.shorten, False, share * first)
        self._factor.begin(self.x.getSize(), now.problem.levels)
        now.steps.count = last.steps.count
        now.judge.first = first
        now.residual.let_go()
        now.residual.centre = self.x.copy()
        now.steps.follow()
        self._iterate(self.x, fresh=True)
        self._factor.end()

    def _start(self, sizes: tuple[int, int]) -> PETSc.Vec:
        """Return the zero vector of unknowns, with vectors of its size."""
        same = self.x is not None and self.x.getSizes() == sizes
        if not over_ranks(self._comm, same, MPI.LAND):
            self.snes.reset()
            self.x = PETSc.Vec().createMPI(sizes, comm=self._comm)
            self.F, *self._room = (self.x.duplicate() for _ in range(4))
            self.snes.setSolution(self.x)  # which its monitors ask for
        assert self.x is not None
        self.x.set(0.0)
        return self.x

    def _begin(
        self,
        problem: ReducedProblem,
        shorten: bool,
        by_norm: bool,
        enough: float = 0.0,
    ) -> Attempt:
        """Begin an attempt; see :class:`Attempt`, :class:`.Rules` and :class:`.Judge`."""
        assert self.F is not None
        factor, statistics, tells = self._factor, self.statistics, problem.work_tells()
        potential = self._symmetric and tells
        rules = Rules(potential, tells, by_norm and not potential)
        residual = Residual(problem, factor, self.F, self._room[0], statistics)
        steps = Steps(problem, factor, self._symmetric, shorten)
        judge = Judge(problem, residual, steps, factor, statistics, enough)
        search = None
        if self._searches:
            smooth = problem.terms.smooth
            search = LineSearch(rules, residual.at, steps, smooth, statistics)
        now = Attempt(problem, shorten, residual, steps, judge, search)
        self._attempt = now
        return now

    def _solve_from(self, x: PETSc.Vec, predicts: bool) -> None:
        """Solve, where the residual at x, which is zero, is known.

        Args:
            x: Set to the solution.
            predicts: Whether it may begin at a prediction.
        """
        now, K = self._now, None
        problem, steps, judge, forces = now.problem, now.steps, now.judge, now.residual.F
        imposed = problem.impose()
        if imposed:
            K, forces = problem.tangent(), problem.lift()
            forces.axpy(1.0, now.residual.F)
        judge.first = norm(forces)
        predicted = predicts and self._predict(x, judge.first)
        self.has_another_way = self.has_another_way or (predicted and not now.shorten)
        self._predictions.lead = not predicted
        if now.search is not None:
            now.search.damps = not predicted
        now.residual.centre = x.copy()
        steps.follow(K=None if predicted else K)
        if imposed and not predicted:
            self._factor.solve(forces, x)
            steps.permit(x, None)
            judge.look_at_first(x, judge.first)
            if steps.refines:
                steps.solve(forces, x)
                steps.permit(x, None)
            x.scale(-1.0)
            steps.count += 1
            now.residual.at(x)
        self._iterate(x, fresh=not imposed or predicted)
        self._predictions.judge(predicted, self.iterations)

    def _predict(self, x: PETSc.Vec, start: float) -> bool:
        """Move x from zero to the prediction unless its residual is too far above the start's."""
        guess, residual = self._now.problem.prediction(), self._now.residual
        if guess is None:
            return False
        if residual.at(guess) is None and self._predictions.are_near(norm(residual.F), start):
            guess.copy(x)
            self.statistics.count("predictions")
            return True
        self.statistics.count("rejected_predictions")
        residual.at(x)
        return False

    # -- Iterations -------------------------------------------------------------------------------

    def _iterate(self, x: PETSc.Vec, fresh: bool) -> None:
        """Iterate from unknowns whose residual is known, until the attempt is at an end.

        Args:
            x: The unknowns; set to the solution.
            fresh: Whether the tangent there has been factorised.
        """
        most, done = self.snes.getTolerances()[3], 0
        try:
            with self.statistics.phase("solve"):
                while not self._ends(x, done):
                    if done == most:
                        self.gave_up = True
                        raise self._stopped(f"the most that snes_max_it={most} allows")
                    if not fresh:
                        self._now.steps.follow()
                    self._step(x)
                    fresh, done = False, done + 1
        except MPMError:
            raise
        except BaseException:
            self._factor.forget()  # which may have been broken off
            raise

    def _ends(self, x: PETSc.Vec, done: int) -> bool:
        """Return whether the attempt ends at x after some steps.

        Raises:
            MPMError: It ends without a solution.
        """
        now = self._now
        if not np.isfinite(norm(now.residual.R)):
            raise now.residual.failure or ConvergenceError("The residual is not finite")
        rtol, atol, _, _ = self.snes.getTolerances()
        self.residuals.append(now.judge.note(rtol, atol))
        self.snes.monitor(done, now.judge.norms[-1])
        tell(self._comm, NEWTON, "  iteration %d: residual %.2e", done, self.residuals[-1])
        now.yielding.append(now.problem.terms.yielding())
        if now.judge.is_at_rest(x, self.lets_go):
            return True
        norms = now.judge.norms
        if now.search is not None and stalled(norms):
            self.gave_up = True
            raise ConvergenceError(
                f"Newton's method makes no headway: in {self.iterations} linear solves the "
                f"relative residual did not stay below {min(self.residuals[-len(norms) :]):.1e}"
            )
        return False

    def _step(self, x: PETSc.Vec) -> None:
        """Take a step from x.

        Raises:
            MPMError: It cannot be taken.
        """
        now = self._now
        R, trial, y = self._room
        residual, judge = now.residual, now.judge
        self._factor.aim(judge.norms, judge.tolerance)
        failure = now.steps.newton(R, y, x)
        if failure is not None:
            raise self._stopped(*failure)
        if now.steps.count == 1:
            refined = now.steps.refines
            judge.look_at_first(y, norm(R))
            if now.steps.refines and not refined:
                now.steps.solve(R, y)
                now.steps.permit(y, x)
        if not np.isfinite(norm(y)):
            if now.search is None or not now.search.trusts:
                raise residual.at(y) or self._stopped("as the linear solve broke down")
            now.search.withdraw(x, y, R, trial)
        elif now.search is not None and not judge.is_settled(y, x):
            now.search(x, y, R, trial)
        else:
            trial.waxpy(-1.0, y, x)
            residual.at(trial)
        judge.note_step(y, trial)
        trial.copy(x)

    def _stopped(self, why: str, advice: str = "") -> ConvergenceError:
        residual = self.residuals[-1] if self.residuals else np.nan
        error = ConvergenceError(
            f"Newton's method stopped after {self.iterations} linear solves at a relative residual "
            f"of {residual:.1e} ({why})"
        )
        error.advice = advice
        return error
