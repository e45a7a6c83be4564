# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Line search of Newton's method, and whether its iterations make headway."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from petsc4py import PETSc

from .errors import MPMError
from .history import Statistics

__all__ = ["LineSearch", "stalled"]

#: Most halvings of a Newton step, and the drop in work that needs none.
HALVINGS = 8
SUFFICIENT = 0.8
#: Iterations within which the smallest residual must fall, and to what share of itself.
PATIENCE = 15
HEADWAY = 0.7


class LineSearch:
    """Shortens a Newton step, in another direction where its own leads uphill.

    A step is taken where the residual's work on it falls to 0.8 of its start in absolute value,
    or the residual's norm falls. Where the whole step does neither and the tangent is not
    positive definite, its direction may be one in which the incremental potential grows; the
    direction is then that of a damped tangent which is (a modified Newton step: Nocedal &
    Wright 2006, section 3.4). What is left is halved.

    Args:
        evaluate: Evaluates the residual at unknowns into ``F``; returns a failure or ``None``.
        redirect: Replaces a step for the residual given by a damped one, where the tangent is
            not positive definite; returns whether it did.
        statistics: Where to count.
    """

    def __init__(
        self,
        evaluate: Callable[[PETSc.Vec], MPMError | None],
        redirect: Callable[[PETSc.Vec, PETSc.Vec], bool],
        statistics: Statistics,
    ) -> None:
        self._evaluate = evaluate
        self._redirect = redirect
        self._statistics = statistics

    def __call__(self, x: PETSc.Vec, y: PETSc.Vec, F: PETSc.Vec, trial: PETSc.Vec) -> bool:
        """Choose the step to ``x - y`` (collective).

        Args:
            x: The unknowns.
            y: The Newton step; replaced by the step to be taken.
            F: The residual at x; afterwards that at the new unknowns.
            trial: Set to the new unknowns.

        Returns:
            Whether y has changed.
        """
        norm, work = F.norm(), F.dot(y)
        start = F.copy()
        fraction, changed = 1.0, False
        for halving in range(HALVINGS + 1):
            trial.waxpy(-1.0, y, x)
            failure = self._evaluate(trial)
            if failure is None and (
                abs(F.dot(y)) <= SUFFICIENT * abs(work) * fraction or F.norm() <= norm
            ):
                break
            if halving == 0 and self._redirect(start, y):  # neither, so its direction is doubted
                self._statistics.count("redirections")
                work, changed = start.dot(y), True
                trial.waxpy(-1.0, y, x)
                failure = self._evaluate(trial)
                if failure is None and (abs(F.dot(y)) <= SUFFICIENT * work or F.norm() <= norm):
                    break
            if halving < HALVINGS:
                y.scale(0.5)
                fraction *= 0.5
                self._statistics.count("halvings")
        start.destroy()
        return changed or fraction < 1.0


def stalled(norms: Sequence[float]) -> bool:
    """Return whether the norms of the residuals so far stopped falling."""
    if len(norms) <= PATIENCE:
        return False
    return min(norms[-PATIENCE:]) > HEADWAY * min(norms[:-PATIENCE])
