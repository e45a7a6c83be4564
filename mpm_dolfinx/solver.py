# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Newton's method on the reduced system: PETSc SNES, a proximal term and a line search."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from . import _compat
from .cleanup import weakly
from .errors import ConvergenceError, MPMError
from .factor import ShiftedFactor
from .history import Statistics
from .line_search import LineSearch, stalled

__all__ = ["NewtonSolver", "ReducedProblem"]

#: Newton increment, relative to the step's, at which round-off is reached.
ROUND_OFF = 1e-13
#: First residual of a prediction that is kept, over that of a start from zero; from 1 on as long
#: as it saves linear solves.
KEPT = 2.0
#: Share of the residual that the proximal term may go on to hold back where it is released.
HELD = 0.1
#: Residual, relative to the forces, that may stay where next to nothing moves.
FROZEN = 1e-5
#: Share of the forces that the proximal term may bear in the first step.
LOOSE = 1e-3
#: Relative diagonal shifts tried in turn until a tangent is positive definite.
DAMPINGS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)


class ReducedProblem(Protocol):
    """What the solver asks of a problem. All calls are collective."""

    def residual(self, x: PETSc.Vec, F: PETSc.Vec) -> MPMError | None:
        """Evaluate the residual at x, or say why that cannot be."""

    def tangent(self) -> PETSc.Mat:
        """Return the tangent at the x of the last residual, always the same object."""

    def constrain(
        self, y: PETSc.Vec, x: PETSc.Vec | None, solve: Callable[[PETSc.Vec, PETSc.Vec], None]
    ) -> int:
        """Amend a Newton step y from x (``None``: zero) so that ``x - y`` is permitted.

        ``solve`` solves with the factor that gave y. Returns how many negative eigenvalues the
        tangent has where it is positive definite in all directions that are permitted.
        """

    def smooth(self) -> bool:
        """Return whether no history changes in the last residual, nor contact."""

    def prediction(self) -> PETSc.Vec | None:
        """Return unknowns to expect at the step's end, if the past says any."""

    def rigid_motions(self) -> PETSc.NullSpace:
        """Return the rigid motions in the unknowns, which multigrid must know."""

    def impose(self) -> bool:
        """Impose the step's Dirichlet values from now on; return whether there are any."""

    def lift(self) -> PETSc.Vec:
        """Return the linearised forces of the step's Dirichlet values."""

    def scale(self) -> float:
        """Return the size of external forces and reactions at the last residual."""

    def internal_scale(self) -> float:
        """Return the size of the absolute internal contributions at the last residual."""

    def motion(self, x: PETSc.Vec) -> float:
        """Return the size of the displacement that x causes on the body."""

    def extent(self) -> float:
        """Return the size of the positions of the body, in the same norm."""


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

    Attributes:
        snes: The PETSc SNES.
        residuals: Relative residuals of the last attempt.
        iterations: Linear solves of the last attempt.
        x: The solution of the last attempt.
        F: Its residual, without the proximal term.
        no_equilibrium: Whether the last attempt's iterations came to nothing.
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
    ) -> None:
        self._comm = comm
        self._symmetric = symmetric
        self._search = (
            LineSearch(
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
        self.no_equilibrium = False
        self.x: PETSc.Vec | None = None
        self.F: PETSc.Vec | None = None
        self._centre: PETSc.Vec | None = None
        self._failure: MPMError | None = None
        self._known = self._fresh = False
        self._kept = KEPT
        self._from_zero = 0
        self.snes = PETSc.SNES().create(comm)
        self.snes.setOptionsPrefix(prefix)
        self.snes.setType("newtonls")
        _compat.use_basic_line_search(self.snes)
        self.snes.setTolerances(rtol=1e-9, atol=1e-50, stol=0.0, max_it=30)
        self._factor = ShiftedFactor(self.snes, prefix, options, symmetric, shift, dim, statistics)

    @property
    def K(self) -> PETSc.Mat | None:
        """The reduced tangent."""
        return self._factor.K

    def solve(self, problem: ReducedProblem, sizes: tuple[int, int]) -> None:
        """Find a root of the residual, starting from zero or from the prediction.

        The prediction is kept only where its residual is small beside that of a start from zero.
        From zero, the first linear solve carries the step's Dirichlet values, as it does in
        finite elements, and their linearised forces count as part of the first residual.

        Args:
            problem: Residual and tangent.
            sizes: Local and global number of unknowns.

        Raises:
            MPMError: Why there is none; ``x`` and ``F`` are the last evaluated then.
        """
        self._problem = problem
        self.residuals = []
        self.iterations = 0
        self._motion = (0.0, 0.0)
        self._stalled = self._ended = False
        self._norm = np.inf
        self._first = 0.0
        self._norms: list[float] = []
        self.no_equilibrium = False
        if self._search is not None:
            self._search.begin()
        self._factor.begin()
        self._centre = None
        x = self._start(sizes)
        if sizes[1] == 0:
            problem.impose()
        self._evaluate(x)
        if self._failure is None and sizes[1] > 0:
            self._iterate(x)
        if self._failure is not None:
            raise self._failure

    def _start(self, sizes: tuple[int, int]) -> PETSc.Vec:
        """Return the zero vector of unknowns, with vectors and SNES of its size."""
        same = self.x is not None and self.x.getSizes() == sizes
        if self._comm.allreduce(same, MPI.LAND):
            assert self.x is not None
            self.x.set(0.0)
            return self.x
        self.snes.reset()
        self.x = PETSc.Vec().createMPI(sizes, comm=self._comm)
        self.F = self.x.duplicate()
        self._R = self.x.duplicate()
        self._trial = self.x.duplicate()
        self.snes.setFunction(weakly(self._function), self.x.duplicate())
        self.snes.setConvergenceTest(weakly(self._test))
        self.snes.setLineSearchPreCheck(weakly(self._pre_check))
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
        self._first = start.norm()
        predicted = self._predict(x, start)
        self._centre = x.copy()
        self._set_tangent(self._problem.tangent() if predicted or K is None else K)
        self._fresh = forces is None or predicted
        if forces is not None and not predicted:
            self._factor.solve(forces, x)
            self._negative = self._problem.constrain(x, None, self._factor.solve)
            if self._is_loose(x, self._first):
                return
            x.scale(-1.0)
            self.iterations += 1
            self._known = False
        else:
            x.copy(self._trial)
            self._known = True
        with self.statistics.phase("solve"):
            self.snes.solve(None, x)
        reason = self.snes.getConvergedReason()
        if self._failure is None and reason > 0 and not self._ended:
            self._failure = MPMError(
                f"PETSc's SNES {self.snes.getType()!r} ended by a test of its own "
                f"({_reason(reason)}), not where the residual is small; use snes_type 'newtonls'."
            )
        elif self._failure is None and reason > 0:
            self._judge(predicted)
        elif self._failure is None:
            residual = self.residuals[-1] if self.residuals else np.nan
            if reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
                why = "as a linear solve failed"
                if self.snes.getKSP().getConvergedReason() == (
                    PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED
                ):
                    why = "as the factorisation of the tangent failed"
            else:
                why = _reason(reason)
                self.no_equilibrium = True
            self._failure = ConvergenceError(
                f"Newton's method stopped after {self.iterations} linear solves at a relative "
                f"residual of {residual:.1e} ({why})"
            )

    def _predict(self, x: PETSc.Vec, start: PETSc.Vec) -> bool:
        """Move x from zero to the prediction unless its residual is too far above the start's."""
        assert self.F is not None
        guess = self._problem.prediction()
        if guess is None:
            return False
        norm = start.norm()
        if self._evaluate(guess) is None and self.F.norm() < self._kept * norm:
            guess.copy(x)
            self._risky = self.F.norm() >= norm
            self.statistics.count("predictions")
            return True
        self.statistics.count("rejected_predictions")
        self._evaluate(x)
        return False

    @property
    def experience(self) -> tuple[float, int]:
        """What earlier steps have taught about predictions, for a checkpoint."""
        return self._kept, self._from_zero

    @experience.setter
    def experience(self, values: tuple[float, int]) -> None:
        self._kept, self._from_zero = values

    def _judge(self, predicted: bool) -> None:
        """Keep only sure predictions from now on, if a doubtful one has saved no linear solve."""
        if not predicted:
            self._from_zero = self.iterations
        elif self._risky and self.iterations >= self._from_zero:
            self._kept = 1.0

    def _function(self, snes: PETSc.SNES, x: PETSc.Vec, F: PETSc.Vec) -> None:
        if not (self._known and self._same(x, self._trial)):
            self._evaluate(x)
        self._known = False
        self._R.copy(F)

    def _same(self, a: PETSc.Vec, b: PETSc.Vec) -> bool:
        same = np.array_equal(a.array_r, b.array_r)
        return bool(self._comm.allreduce(same, MPI.LAND)) if self._comm.size > 1 else same

    def _evaluate(self, x: PETSc.Vec) -> MPMError | None:
        assert self.F is not None
        self.statistics.count("residuals")
        if np.isfinite(x.norm()):
            failure = self._problem.residual(x, self.F)
            if failure is None and not np.isfinite(self.F.norm()):
                failure = ConvergenceError("The residual is not finite")
        else:
            failure = ConvergenceError("The linear solve broke down on a singular matrix")
        self._failure = failure
        if failure is not None:
            self.F.set(np.nan)
        self.F.copy(self._R)
        if failure is None and self._factor.D is not None and self._centre is not None:
            gap = x - self._centre
            gap.pointwiseMult(gap, self._factor.D)
            self._R.axpy(1.0, gap)
        return failure

    def _test(
        self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]
    ) -> PETSc.SNES.ConvergedReason | None:
        _, _, norm = norms
        reasons = PETSc.SNES.ConvergedReason
        if not np.isfinite(norm):
            return _compat.NOT_FINITE
        rtol, atol, _, _ = snes.getTolerances()
        scale = self._problem.scale()
        if iteration >= 2 and norm > max(0.25 * self._norm, rtol * scale):
            self._stalled = True
        if self._stalled or scale == 0.0:
            internal = self._problem.internal_scale()
            if scale < 1e-6 * internal:
                scale = internal
        self._norm = norm
        self._norms.append(norm)
        self.residuals.append(norm / scale if scale > 0 else norm)
        small = norm <= max(rtol * scale, atol)
        step, whole = self._motion
        if small or (
            iteration > 0
            and (
                step <= ROUND_OFF * whole
                or (self._stalled and step <= 4 * np.finfo(float).eps * self._problem.extent())
            )
        ):
            left = self._release(snes.getSolution(), max(rtol * scale, atol))
            forces = max(scale, self._first)
            if left > FROZEN * forces and left > FROZEN * self._problem.internal_scale():
                self._failure = _not_held(left / forces if forces > 0.0 else np.inf)
                return reasons.DIVERGED_MAX_IT
            self._ended = True
            if small:
                frozen = left / scale if scale > 0.0 else 0.0
                self.statistics["frozen_residual"] = max(self.statistics["frozen_residual"], frozen)
                return reasons.CONVERGED_FNORM_RELATIVE
            self.statistics.count("converged_at_round_off")
            return reasons.CONVERGED_SNORM_RELATIVE
        if self._search is not None and stalled(self._norms):
            self.no_equilibrium = True
            lowest = min(self.residuals)
            self._failure = ConvergenceError(
                f"Newton's method makes no headway: in {self.iterations} linear solves the "
                f"relative residual did not stay below {lowest:.1e}"
            )
            return reasons.DIVERGED_MAX_IT
        return None

    def _release(self, x: PETSc.Vec, tolerance: float) -> float:
        """Let go what the proximal term holds back, except where next to nothing moves.

        Args:
            x: The unknowns; replaced by better ones.
            tolerance: Norm of the residual that is small enough.

        Returns:
            Norm of the residual that is left.
        """
        assert self.F is not None
        left = self.F.norm()
        step = x.duplicate()
        while left > tolerance and self._factor.D is not None:
            self._factor.solve(self.F, step)
            if (step * self._factor.D).norm() > HELD * left:
                break
            self._problem.constrain(step, x, self._factor.solve)
            better = self._evaluate(x - step) is None and self.F.norm() <= 0.5 * left
            if not better:
                self._evaluate(x)
                break
            x.axpy(-1.0, step)
            left = self.F.norm()
        return float(left)

    def _set_tangent(self, K: PETSc.Mat, damping: float = 0.0) -> None:
        if self._factor.set(K, self._problem.rigid_motions, damping):
            self.snes.setJacobian(weakly(self._jacobian), K, self._factor.P)

    def _jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, A: PETSc.Mat, P: PETSc.Mat) -> None:
        if not self._fresh:
            self._set_tangent(self._problem.tangent())
        self._fresh = False
        self.iterations += 1

    def _pre_check(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        self._motion = (0.0, 0.0)
        self._origin = x
        self._negative = self._problem.constrain(y, x, self._factor.solve)
        if self.iterations == 1 and self._is_loose(y, self._R.norm()):
            self._trial.waxpy(-1.0, y, x)
            self._R.set(np.nan)
            self._known = True
            return False
        if not np.isfinite(y.norm()):
            if self._search is None or not self._search.trusts:
                return False  # the evaluation at x - y says so
            self._search.withdraw(x, y, self._R, self._trial)
            changed = True
        elif self._search is not None:
            changed = self._search(x, y, self._R, self._trial)
        else:
            changed = False
            self._trial.waxpy(-1.0, y, x)
            self._evaluate(self._trial)
        self._motion = (self._problem.motion(y), self._problem.motion(self._trial))
        self._known = True
        return changed

    def _smooth(self) -> bool:
        return self._problem.smooth()

    def _is_loose(self, y: PETSc.Vec, force: float) -> bool:
        """Whether a first step moves a body that nothing holds, which is a failure then."""
        scale = max(self._problem.scale(), force)
        if self._factor.D is None or scale == 0.0 or not np.isfinite(y.norm()):
            return False
        held = y * self._factor.D
        share = held.norm() / scale
        if share <= LOOSE:
            return False
        again = y.duplicate()
        self._factor.solve(held, again)  # what is held softly, but held, gives way now
        if (again * self._factor.D).norm() <= 0.5 * held.norm():
            return False
        self._failure = _not_held(share)
        return True

    def _uphill(self, F: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Return whether a step for the residual F is not that of a positive definite tangent."""
        if not self._symmetric or self._factor.shift == 0.0:
            return False
        return F.dot(y) <= 0.0 or self._factor.negative_pivots() > self._negative

    def _redirect(self, F: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve for the step with a damped tangent that is positive definite.

        Args:
            F: The residual.
            y: The step; replaced.
        """
        assert self.K is not None
        for damping in DAMPINGS:
            self._set_tangent(self.K, damping)
            self._factor.solve(F, y)
            self._negative = self._problem.constrain(y, self._origin, self._factor.solve)
            self.iterations += 1
            if not self._uphill(F, y):
                return


def _not_held(share: float) -> MPMError:
    return MPMError(
        f"Forces ({share:.1e} of all) act where nothing holds the bodies; support each of them "
        "against all rigid motions, with conditions and supports that reach it where it is"
    )


def _reason(code: int) -> str:
    names = {v: k for k, v in vars(PETSc.SNES.ConvergedReason).items() if isinstance(v, int)}
    return str(names.get(code, code)).lower().replace("_", " ")
