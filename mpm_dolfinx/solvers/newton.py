# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Newton's method on the reduced system: PETSc SNES, a proximal term and a line search."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .. import _compat
from ..errors import ConvergenceError, MPMError
from ..history import Statistics
from ..log import NEWTON, tell
from ..parallel.garbage import weakly
from ..parallel.magnitudes import norm, sign_of_product
from ..parallel.totals import over_ranks
from ..tolerances import (
    EQUAL,
    HALF_DIGITS,
    LAST_PLACES,
    NEGLIGIBLE,
    ROUND_OFF,
    SMALL,
    SOLVED,
)
from .attempt import Attempt, Predictions
from .line_search import LineSearch, stalled
from .linear import Indefinite, ShiftedFactor
from .mechanism import mechanism, not_held
from .problem import ReducedProblem

__all__ = ["NewtonSolver"]

#: Share of the residual that the proximal term may go on to hold back where it is released.
HELD = 0.1
#: Share of the forces that the proximal term may bear in the first step.
LOOSE = 1e-3
#: Iterations after which it is noted which particles yield, should a solve fail.
LATE = 5
#: Relative diagonal shifts tried in turn until a tangent is positive definite.
DAMPINGS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)


class NewtonSolver:
    """SNES with the proximal term and the line search that singular transfers need.

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
        snes: The PETSc SNES.
        residuals: Relative residuals of the last attempt.
        iterations: Linear solves of the last attempt.
        x: The solution of the last attempt.
        F: Its residual, without the proximal term.
        gave_up: Whether the last attempt's iterations came to nothing.
        lets_go: Whether what the proximal term holds back is let go once however little it is: in
            a motion it is a viscosity, and the same in each step.
        has_another_way: Whether an attempt that fails may be made in another way at once: there is
            no potential, or it began at a prediction and no smaller step is tried.
        gives_up_early: Whether a solve whose residual is not the gradient of a potential is given
            up soon where it makes no headway: in a motion half of the step is much easier.
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
        self._comm = comm
        self._symmetric = symmetric
        self._search = (
            LineSearch(
                symmetric,
                weakly(self._evaluate),
                weakly(self._uphill),
                weakly(self._redirect),
                weakly(self._smooth),
                statistics,
            )
            if line_search
            else None
        )
        self.statistics = statistics
        self.residuals: list[float] = []
        self.iterations = 0
        self.gave_up = self.has_another_way = False
        self._attempt: Attempt | None = None
        self._predictions = Predictions()
        self.x: PETSc.Vec | None = None
        self.F: PETSc.Vec | None = None
        self.lets_go = self.gives_up_early = False
        self._asked: tuple[PETSc.Mat, ...] = ()
        self._raised: BaseException | None = None
        self.snes = PETSc.SNES().create(comm)
        self.snes.setOptionsPrefix(prefix)
        self.snes.setType("newtonls")
        _compat.use_basic_line_search(self.snes)
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
    def _problem(self) -> ReducedProblem:
        """The present problem."""
        return self._now.problem

    @property
    def K(self) -> PETSc.Mat | None:
        """The reduced tangent."""
        return self._factor.K

    @property
    def flips(self) -> list[NDArray[np.int64]]:
        """How often each particle began or ceased to yield, late in the last attempt, by body."""
        return [
            np.count_nonzero(np.diff(np.array(each), axis=0), axis=0)
            for each in zip(*([] if self._attempt is None else self._attempt.yielding), strict=True)
        ]

    def linearise(self, anew: bool = False) -> Callable[[PETSc.Vec, PETSc.Vec], None]:
        """Factorise the tangent at the solution (collective).

        Args:
            anew: Whether it is that of another step than the last one that was solved.

        Returns:
            A function of b and x that sets x to the solution of ``K x = b``, as far as K holds x.
        """
        K = self._problem.tangent()
        if anew:
            self._factor.begin(K.getSize()[0], self._problem.levels, self.lets_go)
            self._start(K.getSizes()[0])
        self._set_tangent(K)

        def solve(b: PETSc.Vec, x: PETSc.Vec) -> None:
            self._factor.solve(b, x)
            self._factor.refine(b, x, SOLVED)

        return solve

    def forget(self) -> None:
        """Forget how the last attempt failed: what comes before the next one may fail too."""
        self.gave_up = False
        if self._attempt is not None:
            self._attempt.yielding = []

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
            BaseException: What a user's code has raised inside a call of PETSc's, as it is.
        """
        self.residuals, self.iterations = [], 0
        self.gave_up = self.has_another_way = False
        now = self._attempt = Attempt(problem, shorten, not again and self._predictions.lead)
        if self._search is not None:
            potential = self._symmetric and problem.work_tells()
            self.has_another_way = not potential
            now.hurries = self.gives_up_early and shorten and not potential
            self._search.begin(problem.work_tells(), now.hurries, again)
        self._factor.begin(sizes[1], problem.levels, self.lets_go)
        # What an iterative solve that fails means is for _pre_check to say.
        self.snes.setMaxLinearSolveFailures(1000 if self._factor.iterates else 1)
        x = self._start(sizes)
        if sizes[1] == 0:
            problem.impose()
        self._evaluate(x)
        if self._now.failure is None and sizes[1] > 0:
            self._iterate(x)
        if self._now.failure is not None:
            raise self._now.failure
        self._predictions.lead = True
        self._factor.end()

    def unbalanced(self) -> float:
        """Return the relative residual at the last solution, evaluated anew (collective).

        Raises:
            MPMError: It cannot be evaluated.
        """
        assert self.x is not None and self.F is not None
        self._evaluate(self.x)
        if self._now.failure is not None:
            raise self._now.failure
        size, scale = norm(self.F), self._judged_by(self._problem.scale(self.F))
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
        last = self._now
        now = self._attempt = Attempt(last.problem, last.shorten, False)
        if self._search is not None:
            self._search.begin(now.problem.work_tells(), False, False)
        self._factor.begin(self.x.getSize(), now.problem.levels, self.lets_go)
        now.centre, now.first = self.x.copy(), norm(self.F)
        now.enough = share * now.first
        self._set_tangent(now.problem.tangent())
        now.fresh = now.known = True
        self.x.copy(self._trial)
        self.F.copy(self._R)
        if not self._run(self.x):
            assert now.failure is not None
            raise now.failure
        self._factor.end()

    def _start(self, sizes: tuple[int, int]) -> PETSc.Vec:
        """Return the zero vector of unknowns, with vectors and SNES of its size."""
        same = self.x is not None and self.x.getSizes() == sizes
        if over_ranks(self._comm, same, MPI.LAND):
            assert self.x is not None
            self.x.set(0.0)
            return self.x
        self.snes.reset()
        self.x = PETSc.Vec().createMPI(sizes, comm=self._comm)
        self.F = self.x.duplicate()
        self._R = self.x.duplicate()
        self._trial = self.x.duplicate()
        self.snes.setFunction(self._callback(self._function), self.x.duplicate())
        self.snes.setConvergenceTest(self._callback(self._test))
        self.snes.setLineSearchPreCheck(self._callback(self._pre_check))
        return self.x

    def _iterate(self, x: PETSc.Vec) -> None:
        assert self.F is not None
        K: PETSc.Mat | None = None
        forces: PETSc.Vec | None = None
        if self._problem.impose():
            K = self._problem.tangent()
            forces = self._problem.lift()
            forces.axpy(1.0, self.F)
        start = self.F if forces is None else forces
        self._now.first = norm(start)
        predicted = self._now.predicts and self._predict(x, norm(start))
        self.has_another_way = self.has_another_way or (predicted and not self._now.shorten)
        self._predictions.lead = not predicted
        self._now.centre = x.copy()
        self._set_tangent(self._problem.tangent() if predicted or K is None else K)
        self._now.fresh = forces is None or predicted
        if forces is not None and not predicted:
            self._factor.solve(forces, x)
            self._now.negative = self._problem.constrain(x, None, self._solve)
            if self._is_loose(x, self._now.first):
                return
            if self._now.refines:
                self._solve(forces, x)
                self._now.negative = self._problem.constrain(x, None, self._solve)
            x.scale(-1.0)
            self.iterations += 1
            self._now.known = False
        else:
            x.copy(self._trial)
            self._now.known = True
        if self._run(x):
            self._predictions.judge(predicted, self.iterations)

    def _run(self, x: PETSc.Vec) -> bool:
        """Let SNES iterate from x; return whether it has converged, else say why in the attempt."""
        with self.statistics.phase("solve"):
            self._run_snes(x)
        reason = self.snes.getConvergedReason()
        if self._now.failure is None and reason > 0 and not self._now.ended:
            self._now.failure = MPMError(
                f"PETSc's SNES {self.snes.getType()!r} ended by a test of its own "
                f"({_reason(reason)}), not where the residual is small; use snes_type 'newtonls'."
            )
        elif self._now.failure is None and reason <= 0:
            residual = self.residuals[-1] if self.residuals else np.nan
            if reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
                why = "as a linear solve failed"
                if self.snes.getKSP().getConvergedReason() == (
                    PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED
                ):
                    why = "as the factorisation of the tangent failed"
            else:
                why = _reason(reason)
                self.gave_up = True
            self._now.failure = ConvergenceError(
                f"Newton's method stopped after {self.iterations} linear solves at a relative "
                f"residual of {residual:.1e} ({why})"
            )
        return self._now.failure is None

    def _run_snes(self, x: PETSc.Vec) -> None:
        """Let SNES iterate; an exception in a callback comes out as itself, not as PETSc's."""
        try:
            self.snes.solve(None, x)
        except BaseException:
            raised, self._raised = self._raised, None
            self.x = None  # what SNES has broken off is not gone on with
            self._factor.forget()
            try:
                if raised is not None:
                    raise raised from raised.__cause__
                raise
            finally:
                del raised  # an error that its own frame holds would keep problems alive

    def _callback(self, method: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback for PETSc that notes what it raises."""
        call, note = weakly(method), weakly(self._note)

        def noting(*args: Any) -> Any:
            try:
                return call(*args)
            except BaseException as error:
                note(error)
                raise

        return noting

    def _note(self, error: BaseException) -> None:
        if self._raised is None:
            self._raised = error

    def _predict(self, x: PETSc.Vec, start: float) -> bool:
        """Move x from zero to the prediction unless its residual is too far above the start's."""
        assert self.F is not None
        guess = self._problem.prediction()
        if guess is None:
            return False
        if self._evaluate(guess) is None and self._predictions.are_near(norm(self.F), start):
            guess.copy(x)
            self.statistics.count("predictions")
            return True
        self.statistics.count("rejected_predictions")
        self._evaluate(x)
        return False

    @property
    def experience(self) -> tuple[float, int]:
        """Success of predictions in earlier steps, for a checkpoint."""
        return self._predictions.kept, self._predictions.from_zero

    @experience.setter
    def experience(self, values: tuple[float, int]) -> None:
        self._predictions.kept, self._predictions.from_zero = values

    def _function(self, snes: PETSc.SNES, x: PETSc.Vec, F: PETSc.Vec) -> None:
        if not (self._now.known and self._same(x, self._trial)):
            self._evaluate(x)
        self._now.known = False
        self._R.copy(F)

    def _same(self, a: PETSc.Vec, b: PETSc.Vec) -> bool:
        same = np.array_equal(a.array_r, b.array_r)
        return over_ranks(self._comm, same, MPI.LAND)

    def _evaluate(self, x: PETSc.Vec) -> MPMError | None:
        assert self.F is not None
        self.statistics.count("residuals")
        if np.isfinite(norm(x)):
            failure = self._problem.residual(x, self.F)
            if failure is None and not np.isfinite(norm(self.F)):
                failure = ConvergenceError("The residual is not finite")
        else:
            failure = ConvergenceError("The linear solve broke down on a singular matrix")
        self._now.failure = failure
        if failure is not None:
            self.F.set(np.nan)
        self.F.copy(self._R)
        if failure is None and self._factor.D is not None and self._now.centre is not None:
            gap = x - self._now.centre
            gap.pointwiseMult(gap, self._factor.D)
            self._R.axpy(1.0, gap)
        return failure

    def _test(
        self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]
    ) -> PETSc.SNES.ConvergedReason | None:
        size = norms[2]
        reasons = PETSc.SNES.ConvergedReason
        if not np.isfinite(size):
            return _compat.NOT_FINITE
        size = norm(self._R)  # as that of SNES, but of small numbers too
        rtol, atol, _, _ = snes.getTolerances()
        scale = self._problem.scale(self._R)
        if iteration >= 2 and size > max(0.25 * self._now.norm, rtol * scale):
            self._now.stalled = True
        scale = self._judged_by(scale)
        self._now.norm = size
        self._now.norms.append(size)
        self.residuals.append(size / scale if scale > 0 else size)
        tell(self._comm, NEWTON, "  iteration %d: residual %.2e", iteration, self.residuals[-1])
        if iteration > LATE:
            self._now.yielding.append(self._problem.terms.yielding())
        self._now.tolerance = tolerance = max(rtol * scale, atol, self._now.enough)
        small = size <= tolerance
        if small or (
            iteration > 0
            and (self._is_round_off(*self._now.motion) or self._is_at_floor(*self._now.motion))
        ):
            left = self._release(snes.getSolution(), tolerance)
            if left > tolerance:
                verdict = self._judge_rest(snes.getSolution(), left, tolerance, scale)
                if verdict == "failed":
                    return reasons.DIVERGED_MAX_IT
                if verdict == "go on":
                    self._refine()
                    return None
            self._now.ended = True
            if small:
                frozen = left / scale if scale > 0.0 else 0.0
                self.statistics["frozen_residual"] = max(self.statistics["frozen_residual"], frozen)
                return reasons.CONVERGED_FNORM_RELATIVE
            self.statistics.count("converged_at_round_off")
            return reasons.CONVERGED_SNORM_RELATIVE
        if self._search is not None and stalled(
            self._now.norms, self._now.hurries and not self._search.trusts
        ):
            self.gave_up = True
            lowest = min(self.residuals[-len(self._now.norms) :])
            self._now.failure = ConvergenceError(
                f"Newton's method makes no headway: in {self.iterations} linear solves the "
                f"relative residual did not stay below {lowest:.1e}"
            )
            return reasons.DIVERGED_MAX_IT
        return None

    def _judged_by(self, scale: float) -> float:
        """Return the size that a residual is compared with; of internal forces without others.

        Args:
            scale: Size of those from outside.
        """
        if self._now.stalled or scale == 0.0:
            if scale < 1e-5 * self._now.internal:
                self._now.internal = self._problem.balance.internal_scale()
            if scale < 1e-6 * self._now.internal:
                return self._now.internal
        return scale

    def _is_round_off(self, step: float, whole: float) -> bool:
        """Whether a step's motion is round-off of the whole motion or, after a stall, of places."""
        return step <= ROUND_OFF * whole or bool(
            self._now.stalled and step <= LAST_PLACES * self._problem.resistance.extent()
        )

    def _is_at_floor(self, step: float, whole: float) -> bool:
        """Whether a step's motion is small, and no longer falls from one to the next.

        A step that is not refined yet must leave the residual as large as it was, too.
        """
        may_end = self._now.refines or self._now.stalled
        return may_end and not self._now.shrinks and step <= NEGLIGIBLE * whole

    def _is_settled(self, y: PETSc.Vec, x: PETSc.Vec) -> bool:
        """Whether a refined step is too small for the residual to judge it."""
        return self._now.refines and self._problem.resistance.motion(
            y
        ) <= NEGLIGIBLE * self._problem.resistance.motion(x)

    def _release(self, x: PETSc.Vec, tolerance: float) -> float:
        """Let go what the proximal term holds back, except where next to nothing moves.

        Args:
            x: The unknowns; replaced by better ones.
            tolerance: Norm of the residual that is small enough.

        Returns:
            Norm of the residual that is left.
        """
        assert self.F is not None
        left = norm(self.F)
        step = x.duplicate()
        always = self.lets_go and self.iterations > 0
        while (left > tolerance or always) and self._factor.D is not None:
            always = False
            self._factor.solve(self.F, step)
            if norm(step * self._factor.D) > HELD * left:
                self._factor.refine(self.F, step, 0.5 * tolerance / left)
            self._problem.constrain(step, x, self._solve)
            better = self._evaluate(x - step) is None and norm(self.F) <= 0.5 * left
            if not better:
                self._evaluate(x)
                break
            x.axpy(-1.0, step)
            left = norm(self.F)
        return left

    def _judge_rest(self, x: PETSc.Vec, left: float, tolerance: float, scale: float) -> str:
        """Say what to do about a residual that is left.

        Args:
            x: The unknowns.
            left: Norm of the residual.
            tolerance: Norm that is small enough.
            scale: Size of the forces that it is compared with.

        Returns:
            ``"go on"``, ``"round-off"``, ``"frozen"``, or ``"failed"``: then ``_failure`` says so.
        """
        assert self.F is not None
        if self._factor.D is None:
            return "round-off"
        step = x.duplicate()
        self._factor.solve(self.F, step)
        rest = self._factor.refine(self.F, step, self._refined)
        self._problem.constrain(step, x, self._solve)
        moved, whole = (
            self._problem.resistance.motion(step),
            self._problem.resistance.motion(x),
        )
        balanced = self._problem.balance.resultant() <= np.sqrt(step.getSize()) * tolerance
        if self._is_round_off(moved, whole) or (self._is_at_floor(moved, whole) and balanced):
            return "round-off"
        forces = max(scale, self._now.first)
        if rest <= 0.5 and self._now.goes_on < 5:
            self._now.goes_on += 1
            return "go on"
        # (less may stay where next to nothing moves)
        scale_inside = self._problem.balance.internal_scale
        if left > HALF_DIGITS * forces and left > HALF_DIGITS * scale_inside():
            share = left / forces if forces > 0.0 else np.inf
            loose = mechanism(self._problem.resistance, self._factor, step)
            self._now.failure = (
                _unbalanced(share) if loose is None else self._not_held(loose, share)
            )
            return "failed"
        return "frozen"

    def _solve(self, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve with the last factor, and for the tangent itself where the shift matters."""
        self._factor.solve(b, x)
        if self._now.refines:
            self._factor.refine(b, x, self._refined)

    @property
    def _refined(self) -> float:
        """How far a step is refined: a residual of round-off hides what the soft parts lack."""
        return EQUAL if self._now.stalled else SMALL

    def _refine(self) -> None:
        """Solve for the tangent itself from now on, and let go what the proximal term holds."""
        assert self.F is not None
        self._now.refines = True
        self._now.centre = None
        self.F.copy(self._R)

    def _set_tangent(self, K: PETSc.Mat, damping: float = 0.0) -> None:
        if self._factor.set(K, self._problem.levels, damping):
            self.snes.setJacobian(self._callback(self._jacobian), K, self._factor.P)

    def _jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, A: PETSc.Mat, P: PETSc.Mat) -> None:
        # SNES notes x at these when this returns, also where it has been given others by then.
        self._asked = A, P
        if not self._now.fresh:
            self._set_tangent(self._problem.tangent())
        self._now.fresh = False
        self._factor.aim(self._now.norms, self._now.tolerance)
        self.iterations += 1

    def _pre_check(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        before, self._now.motion = self._now.motion, (0.0, 0.0)
        self._now.origin = x
        self._now.failure = self._finished(y)
        if self._now.failure is not None:
            return self._fail(x, y)
        refined = self._now.refines
        if refined:
            self._solve(self._R, y)
        self._now.negative = self._problem.constrain(y, x, self._solve)
        if self.iterations == 1 and self._is_loose(y, norm(self._R)):
            return self._fail(x, y)
        if self._now.refines and not refined:
            self._solve(self._R, y)
            self._now.negative = self._problem.constrain(y, x, self._solve)
        if not np.isfinite(norm(y)):
            if self._search is None or not self._search.trusts:
                return False  # the evaluation at x - y says so
            self._search.withdraw(x, y, self._R, self._trial)
            changed = True
        elif self._search is not None and not self._is_settled(y, x):
            try:
                changed = self._search(x, y, self._R, self._trial)
            except Indefinite:
                self._now.failure = self._not_definite()
                return self._fail(x, y)
        else:
            changed = False
            self._trial.waxpy(-1.0, y, x)
            self._evaluate(self._trial)
        self._now.motion = (
            self._problem.resistance.motion(y),
            self._problem.resistance.motion(self._trial),
        )
        self._now.shrinks = self._now.motion[0] <= 0.25 * before[0]
        self._now.known = True
        return changed or self._now.refines

    def _fail(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Let SNES end, as the step to ``x - y`` cannot be taken; return that y is as it was."""
        self._trial.waxpy(-1.0, y, x)
        self._R.set(np.nan)
        self._now.known = True
        return False

    def _not_definite(self) -> ConvergenceError:
        return ConvergenceError(
            f"The tangent was not positive definite after {self.iterations} linear solves"
        )

    @property
    def _shortens(self) -> bool:
        """Whether a smaller step is the best cure of a tangent that is not positive definite."""
        return self._now.shorten and not self._problem.softens

    def _finished(self, y: PETSc.Vec) -> MPMError | None:
        """Finish a linear solve of SNES; return why that cannot be."""
        try:
            if self._factor.finish(self._R, y, self._shortens):
                return None
        except Indefinite:
            return self._not_definite()
        return ConvergenceError(
            f"Multigrid did not solve for a Newton step after {self.iterations} linear solves; "
            "use linear_solver='direct'"
        )

    def _smooth(self) -> bool:
        return self._problem.terms.smooth()

    def _not_held(self, mode: PETSc.Vec, share: float) -> MPMError:
        problem = self._problem
        return not_held(problem.resistance, problem.levels, self._factor, mode, share)

    def _is_loose(self, y: PETSc.Vec, force: float) -> bool:
        """Whether a first step moves a body that nothing holds, which is a failure then."""
        scale = max(self._problem.scale(), force)
        if self._factor.D is None or scale == 0.0 or not np.isfinite(norm(y)):
            return False
        share = norm(y * self._factor.D) / scale
        if share <= LOOSE:
            return False
        loose = mechanism(self._problem.resistance, self._factor, y)
        if loose is not None:
            self._now.failure = self._not_held(loose, share)
            return True
        self._refine()
        return False

    def _uphill(self, F: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Return whether a step for the residual F is not that of a positive definite tangent."""
        if self._factor.shift == 0.0:
            return False
        uphill = self._factor.num_negative == 0 and sign_of_product(F, y) <= 0.0
        if not self._symmetric:
            return uphill and self._problem.work_tells() and not self._smooth()
        expected = self._now.negative + self._factor.num_negative
        return uphill or self._factor.negative_pivots() > expected

    def _redirect(self, F: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Solve for the step with a damped tangent that is positive definite, or reverse it.

        Args:
            F: The residual.
            y: The step; replaced.

        Returns:
            Whether it is reversed: without symmetry, damping leads over a fold too slowly.

        Raises:
            Indefinite: A smaller load step is to be tried instead.
        """
        if not self._symmetric:
            y.scale(-1.0)
            return True
        assert self.K is not None
        self._factor.give_up(self._shortens)
        for damping in DAMPINGS:
            self._set_tangent(self.K, damping)
            self._factor.solve(F, y)
            self._now.negative = self._problem.constrain(y, self._now.origin, self._factor.solve)
            self.iterations += 1
            if not self._uphill(F, y):
                break
        return False


def _unbalanced(share: float) -> ConvergenceError:
    return ConvergenceError(
        f"Newton's method cannot balance {share:.1e} of the forces, as round-off of the tangent is "
        "larger than what resists them; make stiffnesses differ less"
    )


def _reason(code: int) -> str:
    names = {v: k for k, v in vars(PETSc.SNES.ConvergedReason).items() if isinstance(v, int)}
    return str(names.get(code, code)).lower().replace("_", " ")
