# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The residual of a problem, with the proximal term that holds what nothing else does."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from ..errors import ConvergenceError, MPMError
from ..history import Statistics
from ..parallel.magnitudes import norm
from .linear import ShiftedFactor
from .problem import ReducedProblem

__all__ = ["Residual"]


class Residual:
    """The residual F, and F with the proximal term: ``R = F + D (x - centre)``.

    D is the shift of the step's factor. All calls are collective.

    Args:
        problem: What has the residual.
        factor: What has D.
        F: Set to the residual evaluated last; not a number where that failed.
        R: The same for R.
        statistics: Where to count.

    Attributes:
        F: As given.
        R: As given.
        failure: Why the last evaluation has failed.
        centre: Where the proximal term holds; ``None``: nowhere.
    """

    def __init__(
        self,
        problem: ReducedProblem,
        factor: ShiftedFactor,
        F: PETSc.Vec,
        R: PETSc.Vec,
        statistics: Statistics,
    ) -> None:
        self._problem, self._factor, self._statistics = problem, factor, statistics
        self.F, self.R = F, R
        self.failure: MPMError | None = None
        self.centre: PETSc.Vec | None = None

    def begin(self, x: PETSc.Vec) -> None:
        """Evaluate both before anything moves.

        Args:
            x: Zeros.

        Raises:
            MPMError: Why that cannot be. Forces that are not finite here are in no shorter step.
        """
        given = MPMError(
            "The forces are not finite before anything moves; look at the values of loads, and of "
            "Functions and Constants in forms and terms"
        )
        if (failure := self.at(x, given)) is not None:
            raise failure

    def at(self, x: PETSc.Vec, infinite: MPMError | None = None) -> MPMError | None:
        """Evaluate both at unknowns, or say why that cannot be.

        Args:
            x: The unknowns.
            infinite: What to say where the residual is not finite.
        """
        self._statistics.count("residuals")
        if np.isfinite(norm(x)):
            failure = self._problem.residual(x, self.F)
            if failure is None and not np.isfinite(norm(self.F)):
                failure = infinite or ConvergenceError("The residual is not finite")
        else:
            failure = ConvergenceError("The linear solve broke down on a singular matrix")
        self.failure = failure
        if failure is not None:
            self.F.set(np.nan)
        self.F.copy(self.R)
        if failure is None and self._factor.D is not None and self.centre is not None:
            gap = x - self.centre
            gap.pointwiseMult(gap, self._factor.D)
            self.R.axpy(1.0, gap)
        return failure

    def let_go(self) -> None:
        """Hold nothing any more, from the last evaluation on."""
        self.centre = None
        self.F.copy(self.R)

    def held(self, y: PETSc.Vec) -> float:
        """Return the size of the proximal term's force for a motion; zero without the term."""
        return 0.0 if self._factor.D is None else norm(y * self._factor.D)
