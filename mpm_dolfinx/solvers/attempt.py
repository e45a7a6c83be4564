# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An attempt of Newton's method, and the experience that attempts leave."""

from __future__ import annotations

from dataclasses import dataclass, field

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from .problem import ReducedProblem

__all__ = ["Attempt", "Predictions"]

#: First residual of a prediction that is kept, over that of a start from zero; from 1 on as long
#: as it saves linear solves.
KEPT = 2.0


@dataclass(slots=True)
class Attempt:
    """An attempt at a solution.

    Attributes:
        problem: As given to :meth:`NewtonSolver.solve`.
        shorten: As there.
        predicts: Whether it may begin at a prediction.
        hurries: Whether it is given up soon where it makes no headway.
        enough: Norm of a residual that is small enough, however large the forces are.
        centre: Where the proximal term holds; ``None``: nowhere.
        failure: Why the last evaluation, or all, has failed.
        first: Norm of the first residual, with linearised forces of Dirichlet values.
        norm: That of the last; ``norms`` are all.
        norms: See above.
        internal: Size of internal forces, once it is known.
        tolerance: Norm of a residual that is small enough.
        motion: Sizes of the last step and of the whole motion.
        shrinks: Whether the last step was much smaller than that before.
        stalled: Whether residuals no longer fall.
        refines: Whether steps are those of the tangent itself, without the shift.
        goes_on: How often a residual that was left has been gone on with.
        ended: Whether it has ended by its own tests.
        known: Whether the residual is that of the vector that PETSc asks for next.
        fresh: Whether the tangent is.
        negative: Number of negative eigenvalues that are permitted.
        origin: Where the last step began.
        yielding: Which particles yielded in late iterations.
    """

    problem: ReducedProblem
    shorten: bool
    predicts: bool
    hurries: bool = False
    enough: float = 0.0
    centre: PETSc.Vec | None = None
    failure: MPMError | None = None
    first: float = 0.0
    norm: float = np.inf
    norms: list[float] = field(default_factory=list)
    internal: float = np.inf
    tolerance: float = 0.0
    motion: tuple[float, float] = (0.0, 0.0)
    shrinks: bool = True
    stalled: bool = False
    refines: bool = False
    goes_on: int = 0
    ended: bool = False
    known: bool = False
    fresh: bool = False
    negative: int = 0
    origin: PETSc.Vec | None = None
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
