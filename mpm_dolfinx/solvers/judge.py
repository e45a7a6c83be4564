# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Judges when Newton's method has come to rest: by its residual, by round-off, by what is held."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from ..errors import ConvergenceError
from ..history import Statistics
from ..parallel.magnitudes import norm
from ..tolerances import (
    EQUAL,
    HALF_DIGITS,
    INEXACT,
    LAST_PLACES,
    NEGLIGIBLE,
    ROUND_OFF,
    SLIGHT,
    SMALL,
)
from .linear import ShiftedFactor
from .mechanism import mechanism, not_held
from .problem import ReducedProblem
from .residual import Residual
from .steps import Steps

__all__ = ["Judge"]


class Judge:
    """Judges the residuals of one solve. All calls are collective.

    Where residuals no longer fall they are compared with internal forces, if those from outside are
    next to nothing beside them; a step that is round-off of the motion ends a solve.

    Args:
        problem: What is solved.
        residual: Its residual.
        steps: Its steps.
        factor: The factor of its tangent.
        statistics: Where to count.
        enough: Norm of a residual that is small enough, however large the forces are.

    Attributes:
        first: Norm of the first residual, with linearised forces of Dirichlet values.
        norms: Norms of all residuals.
        tolerance: Norm of a residual that is small enough.
        scale: Size with which the last was compared.
    """

    def __init__(
        self,
        problem: ReducedProblem,
        residual: Residual,
        steps: Steps,
        factor: ShiftedFactor,
        statistics: Statistics,
        enough: float = 0.0,
    ) -> None:
        self._problem, self._residual, self._steps = problem, residual, steps
        self._factor, self._statistics, self._enough = factor, statistics, enough
        self.first = self.tolerance = self.scale = 0.0
        self.norms: list[float] = []
        self._internal = np.inf  # forces, once they are known
        self._motion = 0.0, 0.0  # sizes of the last step and of the whole motion
        self._shrinks, self._stalled = True, False
        self._goes_on = 0

    # -- Sizes ------------------------------------------------------------------------------------

    def compared_with(self, scale: float) -> float:
        """Return the size that a residual is compared with; of internal forces without others.

        Args:
            scale: Size of those from outside.
        """
        if self._stalled or scale == 0.0:
            if scale < 10.0 * SMALL * self._internal:
                self._internal = self._problem.balance.internal_scale()
            if scale < SMALL * self._internal:
                return self._internal
        return scale

    def note(self, rtol: float, atol: float) -> float:
        """Take the last residual for the next one, and return its relative size."""
        size, scale = norm(self._residual.R), self._problem.scale(self._residual.R)
        if len(self.norms) >= 2 and size > max(0.25 * self.norms[-1], rtol * scale):
            self._stalled, self._steps.refined = True, EQUAL
        self.scale = scale = self.compared_with(scale)
        self.norms.append(size)
        self.tolerance = max(rtol * scale, atol, self._enough)
        return size / scale if scale > 0.0 else size

    def note_step(self, y: PETSc.Vec | None, x: PETSc.Vec) -> None:
        """Take note of a step to x; ``None``: it was not taken."""
        before, self._motion = self._motion[0], (0.0, 0.0)
        if y is not None:
            moves = self._problem.resistance.motion
            self._motion = moves(y), moves(x)
        self._shrinks = self._motion[0] <= 0.25 * before

    def is_settled(self, y: PETSc.Vec, x: PETSc.Vec) -> bool:
        """Whether a refined step is too small for the residual to judge it."""
        moves = self._problem.resistance.motion
        return self._steps.refines and moves(y) <= NEGLIGIBLE * moves(x)

    # -- Rest -------------------------------------------------------------------------------------

    def is_at_rest(self, x: PETSc.Vec, always: bool) -> bool:
        """Return whether a solve ends with the last residual.

        Args:
            x: The unknowns; replaced by better ones where that ends the solve.
            always: Whether what the proximal term holds back is let go however little it is.

        Raises:
            MPMError: What is left cannot be balanced.
        """
        small, moved = self.norms[-1] <= self.tolerance, len(self.norms) > 1
        if not small and not (
            moved and (self._is_round_off(*self._motion) or self._is_at_floor(*self._motion))
        ):
            return False
        left = self._release(x, always and self._steps.count > 0)
        if left > self.tolerance and self._goes_on_with(x, left):
            self.refine()
            return False
        if small:
            frozen = left / self.scale if self.scale > 0.0 else 0.0
            self._statistics["frozen_residual"] = max(self._statistics["frozen_residual"], frozen)
        else:
            self._statistics.count("converged_at_round_off")
        return True

    def refine(self) -> None:
        """Solve for the tangent itself from now on, and let go what the proximal term holds."""
        self._steps.refines = True
        self._residual.let_go()

    def _is_round_off(self, step: float, whole: float) -> bool:
        """Whether a step's motion is round-off of the whole motion or, after a stall, of places."""
        return step <= ROUND_OFF * whole or bool(
            self._stalled and step <= LAST_PLACES * self._problem.resistance.extent()
        )

    def _is_at_floor(self, step: float, whole: float) -> bool:
        """Whether a step's motion is small, and no longer falls from one to the next.

        A step that is not refined yet must leave the residual as large as it was, too.
        """
        may_end = self._steps.refines or self._stalled
        return may_end and not self._shrinks and step <= NEGLIGIBLE * whole

    def _release(self, x: PETSc.Vec, always: bool) -> float:
        """Let go what the proximal term holds back, except where next to nothing moves.

        Args:
            x: The unknowns; replaced by better ones.
            always: Whether once at least.

        Returns:
            Norm of the residual that is left.
        """
        residual = self._residual
        left, step = norm(residual.F), x.duplicate()
        while (left > self.tolerance or always) and self._factor.D is not None:
            always = False
            self._factor.solve(residual.F, step)
            if residual.held(step) > INEXACT * left:
                self._factor.refine(residual.F, step, 0.5 * self.tolerance / left)
            self._problem.constrain(step, x, self._steps.solve)
            if not (residual.at(x - step) is None and norm(residual.F) <= 0.5 * left):
                residual.at(x)
                break
            x.axpy(-1.0, step)
            left = norm(residual.F)
        return left

    def _goes_on_with(self, x: PETSc.Vec, left: float) -> bool:
        """Return whether the solve goes on for the sake of a residual that is left.

        It does not where this is round-off, or in what moves next to nothing.

        Raises:
            MPMError: It cannot be balanced.
        """
        if self._factor.D is None:
            return False
        step, problem = x.duplicate(), self._problem
        self._factor.solve(self._residual.F, step)
        rest = self._factor.refine(self._residual.F, step, self._steps.refined)
        problem.constrain(step, x, self._steps.solve)
        moves = problem.resistance.motion(step), problem.resistance.motion(x)
        balanced = problem.balance.resultant() <= np.sqrt(step.getSize()) * self.tolerance
        if self._is_round_off(*moves) or (self._is_at_floor(*moves) and balanced):
            return False
        if rest <= 0.5 and self._goes_on < 5:
            self._goes_on += 1
            return True
        # (less may stay where next to nothing moves)
        forces, inside = max(self.scale, self.first), problem.balance.internal_scale
        if left > HALF_DIGITS * forces and left > HALF_DIGITS * inside():
            share = left / forces if forces > 0.0 else np.inf
            loose = mechanism(problem.resistance, problem.levels, self._factor, step)
            if loose is None:
                raise ConvergenceError(
                    f"Newton's method cannot balance {share:.1e} of the forces, as round-off of "
                    "the tangent is larger than what resists them; make stiffnesses differ less"
                )
            raise not_held(problem.resistance, problem.levels, self._factor, loose, share)
        return False

    def look_at_first(self, y: PETSc.Vec, force: float) -> None:
        """Refine steps from the first one on where the proximal term bears much of the forces.

        Args:
            y: The first step.
            force: Norm of what it was solved for.

        Raises:
            MPMError: It moves a body that nothing holds.
        """
        scale = max(self._problem.scale(), force)
        if self._factor.D is None or scale == 0.0 or not np.isfinite(norm(y)):
            return
        share = self._residual.held(y) / scale
        if share <= SLIGHT:
            return
        problem = self._problem
        loose = mechanism(problem.resistance, problem.levels, self._factor, y)
        if loose is not None:
            raise not_held(problem.resistance, problem.levels, self._factor, loose, share)
        self.refine()
