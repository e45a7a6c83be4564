# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Newton's steps: solutions with the factor of a tangent, refined, permitted, or redirected."""

from __future__ import annotations

from collections.abc import Iterator

from petsc4py import PETSc

from ..parallel.magnitudes import sign_of_product
from ..tolerances import SMALL
from .linear import ShiftedFactor
from .problem import ReducedProblem
from .refusals import Failure

__all__ = ["Steps"]

#: Relative diagonal shifts tried in turn until a tangent is positive definite: the least one that
#: is leaves most of the step, and the last is larger than any tangent.
DAMPINGS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)


class Steps:
    """Finds Newton steps of one solve. All calls are collective.

    Args:
        problem: What they are for.
        factor: Solves with the tangent.
        symmetric: Whether that is symmetric.
        shorten: Whether a step that fails is tried again with less load.

    Attributes:
        count: Linear solves so far.
        indefinite: How many of their tangents were symmetric, and not positive definite.
        refines: Whether steps are those of the tangent itself, without the shift.
        refined: Relative residual of a step that is.
    """

    def __init__(
        self, problem: ReducedProblem, factor: ShiftedFactor, symmetric: bool, shorten: bool
    ) -> None:
        self._problem, self._factor, self._symmetric = problem, factor, symmetric
        self._shortens = shorten and not problem.softens
        self._negative = 0  # eigenvalues that are permitted
        self._origin: PETSc.Vec | None = None
        self.count = self.indefinite = 0
        self.refines, self.refined = False, SMALL

    def follow(
        self, damping: float = 0.0, K: PETSc.Mat | None = None, of_first: bool = False
    ) -> None:
        """Factorise the tangent at the last residual, or a given one."""
        K = self._problem.tangent() if K is None else K
        self._factor.set(K, self._problem.levels, damping, of_first)

    def solve(self, b: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve with the last factor, and for the tangent itself where the shift matters."""
        self._factor.solve(b, y)
        if self.refines:
            self._factor.refine(b, y, self.refined)

    def permit(self, y: PETSc.Vec, x: PETSc.Vec | None) -> None:
        """Amend a step from x (``None``: zero), so that it is permitted."""
        self._origin = x
        self._negative = self._problem.constrain(y, x, self.solve)

    def newton(self, R: PETSc.Vec, y: PETSc.Vec, x: PETSc.Vec) -> Failure | None:
        """Solve for a Newton step, or say why that failed.

        Args:
            R: The residual.
            y: Set to the step.
            x: The unknowns.

        Raises:
            ConvergenceError: A smaller step of the load does better.
        """
        self.count += 1
        failed = self._factor.step(R, y, self._shortens)
        if failed is None:
            if self.refines:
                self.solve(R, y)
            self.permit(y, x)
        return failed

    def uphill(self, R: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Return whether a step for the residual R is not that of a positive definite tangent."""
        factor = self._factor
        if factor.shift == 0.0:
            return False
        uphill = factor.num_negative == 0 and sign_of_product(R, y) <= 0.0
        if not self._symmetric:
            return uphill and self._problem.work_tells() and not self._problem.terms.smooth()
        return uphill or factor.negative_pivots() > self._negative + factor.num_negative

    def redirect(self, R: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Solve for the step with a damped tangent that is positive definite, or reverse it.

        Args:
            R: The residual.
            y: The step; replaced.

        Returns:
            Whether it is reversed: without symmetry, damping leads over a fold too slowly.

        Raises:
            ConvergenceError: A smaller step of the load does better.
        """
        if not self._symmetric:
            y.scale(-1.0)
            return True
        self.indefinite += 1
        self._factor.give_up(self._shortens)
        for _ in self.damped(R, y, of_first=False):
            if not self.uphill(R, y):
                break
        return False

    def damped(self, R: PETSc.Vec, y: PETSc.Vec, of_first: bool) -> Iterator[None]:
        """Replace a step by those of the last tangent with more and more damping, one at a time.

        Args:
            R: The residual.
            y: The step.
            of_first: Whether damping is relative to the first tangent, as where the last one has
                lost what resisted.
        """
        for damping in DAMPINGS:
            self.follow(damping, self._factor.K, of_first)
            self._factor.solve(R, y)
            self._negative = self._problem.constrain(y, self._origin, self._factor.solve)
            self.count += 1
            yield
