# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An attempt of Newton's method, and the experience that attempts leave."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .judge import Judge
from .line_search import LineSearch
from .problem import ReducedProblem
from .residual import Residual
from .steps import Steps

__all__ = ["Attempt", "Predictions"]

#: First residual of a prediction that is kept, over that of a start from zero; from 1 on as long
#: as it saves linear solves.
KEPT = 2.0


@dataclass(frozen=True, slots=True)
class Attempt:
    """An attempt at a solution.

    Attributes:
        problem: As given to :meth:`NewtonSolver.solve`.
        shorten: As there.
        residual: The residual.
        steps: Finds Newton steps.
        judge: Says when it is at an end.
        search: Shortens the steps, if that is asked for.
        yielding: Which particles yielded in each iteration, by body.
    """

    problem: ReducedProblem
    shorten: bool
    residual: Residual
    steps: Steps
    judge: Judge
    search: LineSearch | None
    yielding: list[list[NDArray[np.bool_]]] = field(default_factory=list)


class Predictions:
    """Experience with starts from predictions.

    Attributes:
        kept: First residual of one that is taken, over that of a start from zero.
        from_zero: Linear solves of the last step that began at zero.
        lead: Whether the last attempt has not failed from one.
    """

    def __init__(self) -> None:
        self.kept, self.from_zero, self.lead = KEPT, 0, True
        self._risky = False

    def are_near(self, size: float, start: float) -> bool:
        """Return whether to begin at one, by norms of its residual and of that at zero."""
        near = size < self.kept * start
        if near:
            self._risky = size >= start
        return near

    def judge(self, predicted: bool, iterations: int) -> None:
        """Take sure ones alone from now on, if a doubtful one has saved no linear solve.

        Args:
            predicted: Whether a solve began at one.
            iterations: Its linear solves.
        """
        if not predicted:
            self.from_zero = iterations
        elif self._risky and iterations >= self.from_zero:
            self.kept = 1.0
