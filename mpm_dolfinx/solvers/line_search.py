# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Line search of Newton's method, and whether its iterations make headway."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np

from ..errors import MPMError
from ..history import Statistics
from ..parallel.magnitudes import norm, unit_sized
from ..tolerances import ARMIJO
from .steps import Steps

__all__ = ["LineSearch", "Rules", "stalled"]

#: Most halvings of a Newton step, and the share of its start that the work may keep without any:
#: with 0.5 and less, as where points yield, a body that gives way finds its way less far.
HALVINGS = 8
SUFFICIENT = 0.8
#: Share of its start that the work may keep where points yield, and most evaluations that look
#: for such a step.
SHARP = 0.3
SECANTS = 4
#: Growth of the norm up to which a step goes on over a fold.
FOLD = 10.0
#: Iterations within which the smallest residual must fall to a share of itself: half as many, as
#: in motions, take 5 % more or fewer solves of sand.
PATIENCE = 15
HEADWAY = 0.7


class _Step(NamedTuple):
    """A step to be taken.

    Attributes:
        x: The unknowns.
        y: The step from them.
        direction: The step, or a multiple of it with which products are numbers of the machine.
        norm: Norm of the residual at the unknowns.
        work: Product of that residual with the direction.
        reversed: Whether it goes against Newton's own step.
    """

    x: PETSc.Vec
    y: PETSc.Vec
    direction: PETSc.Vec
    norm: float
    work: float
    reversed: bool = False

    @classmethod
    def of(cls, x: PETSc.Vec, y: PETSc.Vec, F: PETSc.Vec, reversed: bool = False) -> _Step:
        """Return the step y from unknowns with the residual F (collective)."""
        direction, _ = unit_sized(y)
        return cls(x, y, direction, norm(F), F.dot(direction), reversed)

    def halved(self) -> _Step:
        """Halve the step."""
        self.y.scale(0.5)
        if self.direction is not self.y:
            self.direction.scale(0.5)
        return self._replace(work=0.5 * self.work)


class Rules(NamedTuple):
    """Rules of the search in one solve.

    Attributes:
        potential: Whether the residual is the gradient of a potential.
        works: Whether its work on a step tells if that is stable.
        by_norm: Whether steps are judged by the residual's norm alone: without a potential, its
            work on them may mean nothing.
    """

    potential: bool
    works: bool
    by_norm: bool


class LineSearch:
    """Shortens a Newton step, in another direction where its own leads uphill.

    A step is taken where the residual's work on it falls to 0.8 of its start in absolute value,
    or the residual's norm falls. Where the whole step does neither and the tangent is not
    positive definite, its direction may be one in which the incremental potential grows; the
    direction is then that of a damped tangent which is (a modified Newton step: Nocedal &
    Wright 2006, section 3.4).

    Where the tangent has no symmetry and the residual's work on a step is negative, so is the
    second-order work (Hill 1958): soil that dilates less than its friction has passed a fold, where
    Newton's method goes to and fro between the side that resists and the side that gives way. The
    way on is forward, against the Newton step, as far as the norm grows no more than tenfold.

    Otherwise, where the response is smooth, the whole step is taken on trust: a step that turns
    a stiff body leaves the residual far larger, and Newton's method has forgotten that some
    iterations later. If seven have not brought the residual below what it was, or before that a
    domain turns inside out, the response is no longer smooth or a linear solve breaks down, the
    search withdraws to where it was (the watchdog of Chamberlain, Powell, Lemarechal & Pedersen
    1982), once in a solve. What is left is halved. Where even then domains turn inside out, as of
    sand whose points have parted and resist nothing, the step is that of a damped tangent, in the
    first seven iterations: a body at its limit would creep on by it.

    Where points yield, the step then goes on to where the work is at most 0.3 of its start, by the
    secants of regula falsi: a body that flows has kinks, and Newton steps that are only just
    accepted go to and fro over them.

    Args:
        rules: The rules of the solve.
        evaluate: Evaluates the residual at unknowns into ``F``; returns a failure or ``None``.
        steps: Says whether a step is not that of a positive definite tangent, and finds others.
        smooth: Says whether no history changes in the residual evaluated last.
        statistics: Where to count.

    Attributes:
        damps: Whether a step may be damped; where there is another start, that does better.
    """

    def __init__(
        self,
        rules: Rules,
        evaluate: Callable[[PETSc.Vec], MPMError | None],
        steps: Steps,
        smooth: Callable[[], bool],
        statistics: Statistics,
    ) -> None:
        self._rules = rules
        self._evaluate = evaluate
        self._steps = steps
        self._smooth = smooth
        self._statistics = statistics
        self._trusted: _Step | None = None
        self._since, self._may_trust = 0, True
        self.damps = True

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
        step = _Step.of(x, y, F)
        self._since += 1
        if self._trusted is not None and step.norm <= self._trusted.norm:
            self._trusted = None
        start = F.copy()
        if self._reduces(step, F, trial) and not self._overdue(F):
            return self._sharpen(step, 1.0, F, trial)
        if self._trusted is None and self._steps.uphill(start, y):
            self._statistics.count("redirections")
            step = _Step.of(x, y, start, self._steps.redirect(start, y))
            if not self._reduces(step, F, trial):
                self._halve(step, F, trial)
            return True
        smooth = bool(np.isfinite(norm(F))) and self._smooth()
        if smooth and self._may_trust and not self._overdue(F):
            if self._trusted is None:
                self._trusted, self._since = _Step.of(x.copy(), y.copy(), start), 0
                self._statistics.count("trusted_steps")
            return False
        if self._trusted is None:
            self._halve(step, F, trial)
            soon = self.damps and self._since <= PATIENCE // 2
            if soon and not np.isfinite(norm(F)):
                self._damp(step, start, F, trial)
        else:
            self.withdraw(x, y, F, trial)
        return True

    @property
    def trusts(self) -> bool:
        """Whether a step was taken on trust that has not paid yet."""
        return self._trusted is not None

    def withdraw(self, x: PETSc.Vec, y: PETSc.Vec, F: PETSc.Vec, trial: PETSc.Vec) -> None:
        """Go back to where a step was taken on trust, and halve it (collective).

        Args:
            x: The unknowns.
            y: Set to the step to be taken from them.
            F: Set to the residual at the new unknowns.
            trial: Set to these.
        """
        assert self._trusted is not None
        before, self._trusted, self._may_trust = self._trusted, None, False
        self._statistics.count("withdrawn_steps")
        self._halve(before, F, trial)
        y.waxpy(-1.0, trial, x)

    def _overdue(self, F: PETSc.Vec) -> bool:
        """Whether a step taken on trust should have paid by now: half of all patience is left."""
        if self._trusted is None or self._since < PATIENCE // 2:
            return False
        return norm(F) > self._trusted.norm

    def _reduces(self, step: _Step, F: PETSc.Vec, trial: PETSc.Vec) -> bool:
        """Evaluate at the step's end; return whether norm or work fall far enough."""
        trial.waxpy(-1.0, step.y, step.x)
        if self._evaluate(trial) is not None:
            return False
        size = norm(F)
        if step.reversed:
            return size <= FOLD * step.norm
        if self._rules.by_norm:
            return size <= (1.0 - ARMIJO) * step.norm
        tells = step.work > 0.0 or self._rules.potential or not self._rules.works
        falls = tells and abs(F.dot(step.direction)) <= SUFFICIENT * abs(step.work)
        return bool(falls or size <= step.norm)

    def _halve(self, step: _Step, F: PETSc.Vec, trial: PETSc.Vec) -> None:
        """Halve the step until norm or work fall far enough."""
        for halvings in range(HALVINGS):
            step = step.halved()
            self._statistics.count("halvings")
            if self._reduces(step, F, trial):
                self._sharpen(step, 2.0 ** (halvings + 1), F, trial)
                break

    def _damp(self, step: _Step, start: PETSc.Vec, F: PETSc.Vec, trial: PETSc.Vec) -> None:
        """Damp the step, more and more, until domains bear it and norm or work fall far enough."""
        for _ in self._steps.damped(start, step.y, of_first=True):
            damped = _Step.of(step.x, step.y, start)
            if self._reduces(damped, F, trial):
                break
            if np.isfinite(norm(F)):
                self._halve(damped, F, trial)
                break

    def _sharpen(self, step: _Step, longest: float, F: PETSc.Vec, trial: PETSc.Vec) -> bool:
        """Go on to where the work has fallen far enough.

        Args:
            step: The step that is accepted; changed.
            longest: The whole Newton step, as a multiple of it.
            F: The residual at its end; replaced.
            trial: Its end; replaced.

        Returns:
            Whether the step has changed.
        """
        work = F.dot(step.direction)
        far = abs(work) > SHARP * abs(step.work)
        if not (self._rules.works and far and step.work > 0.0) or step.reversed:
            return False
        if self._trusted is not None or self._smooth():
            return False
        low, high = (0.0, step.work), None
        share, found = 1.0, (abs(work), 1.0)
        for _ in range(SECANTS):
            if work < 0.0:
                high = share, work
            else:
                low = share, work
            if high is not None:
                width = high[0] - low[0]
                inner = width * low[1] / (low[1] - high[1])
                share = low[0] + min(max(inner, 0.1 * width), 0.9 * width)
            elif share < longest:
                share = min(2.0 * share, longest)
            else:
                break
            trial.waxpy(-share, step.y, step.x)
            failed = self._evaluate(trial) is not None
            work = -step.work if failed else F.dot(step.direction)
            if not failed and abs(work) < found[0]:
                found = abs(work), share
            if not failed and abs(work) <= SHARP * step.work:
                break
        if share != found[1]:
            trial.waxpy(-found[1], step.y, step.x)
            self._evaluate(trial)
        step.y.scale(found[1])
        return found[1] != 1.0


def stalled(norms: Sequence[float]) -> bool:
    """Return whether the norms of the residuals so far stopped falling.

    Where the residual is no gradient, as with plastic flow that is not associated, iterations may
    go round in a circle over a few kinks for ever.
    """
    if len(norms) <= PATIENCE:
        return False
    return min(norms[-PATIENCE:]) > HEADWAY * min(norms[:-PATIENCE])
