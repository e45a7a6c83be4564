# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The factor of safety of a body, by reduction of its strength."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..errors import ConvergenceError, DomainDistortionError, MPMError, ParticleOutsideError
from ..parallel.given import require_same
from .quasistatic import QuasiStaticProblem
from .through_time import TimeProblem

__all__ = ["StrengthReduction", "strength_reduction"]

#: Decimals of a factor: sums of steps are told as 1.2, not as 1.2000000000000002.
DIGITS = 12
#: Least step and tolerance of a factor.
FINEST = 1e-9


@dataclass(frozen=True)
class StrengthReduction:
    """What a reduction of strength has found.

    Attributes:
        factor: Factor of safety: what the strength was last divided by with equilibrium.
        above: The least factor for which there was none; infinite where none was tried.
        factors: The factors with equilibrium, in order.
        displacements: Largest displacement of a node since the reduction began, for each.
    """

    factor: float
    above: float
    factors: list[float] = field(default_factory=list)
    displacements: list[float] = field(default_factory=list)


def strength_reduction(
    problem: QuasiStaticProblem,
    step: float = 0.1,
    tolerance: float = 0.01,
    most: float = 10.0,
    displacement: float | None = None,
) -> StrengthReduction:
    """Find the factor by which the strength of a body can be divided until it slides (collective).

    Cohesion and the tangent of the angle of friction are divided by a growing factor, all loads
    being as they are, until no equilibrium is found (Zienkiewicz, Humpheson & Lewis 1975; Griffiths
    & Lane 1999). What was found is left in the problem: the body in the last state of equilibrium,
    which shows the slide, with the strength that it was given.

    Geometry is followed, so a body that slides may find another equilibrium further down, and does
    where its cells are coarse. The factor of safety of the body as it stands is found by a limit
    of the displacement: a few times what it would settle elastically, for a slope of height H
    about ``density gravity H^2 / young`` (Griffiths & Lane's diagrams have that unit). Newton's
    method may also fail where there is equilibrium, most where soils do not dilate. With a limit
    such a factor is tried again in smaller increments; without one the first factor that fails
    bounds what is found from above.

    Coarse cells may find too high a factor: a vertical cut 5 % with cells of a tenth of its height,
    3 % with half of that. Look at two grids.

    Args:
        problem: A problem at its whole load.
        step: First increment of the factor; it is halved where there is no equilibrium.
        tolerance: Width to which the factor is found.
        most: A factor at which to stop, should the body hold.
        displacement: Largest displacement, from the beginning of the reduction, that counts as
            equilibrium; ``None``: any.

    Returns:
        The factor of safety and how it was found.

    Raises:
        MPMError: The problem is not at its whole load, its steps have a duration (PorousProblem,
            DynamicProblem), or a material has no strength.
    """
    if not isinstance(problem, QuasiStaticProblem):
        raise MPMError("strength_reduction() needs an mpm.QuasiStaticProblem.")
    if isinstance(problem, TimeProblem):
        raise MPMError(
            "strength_reduction() needs an mpm.QuasiStaticProblem, whose steps have no duration, "
            f"not an mpm.{type(problem).__name__}."
        )
    comm = problem.bodies[0].V.mesh.comm
    require_same(comm, step=step, tolerance=tolerance, most=most, displacement=displacement)
    numbers = [step, tolerance, most, 1.0 if displacement is None else displacement]
    if not all(
        isinstance(n, float | int | np.floating | np.integer)
        and not isinstance(n, bool)
        and 0.0 < n < np.inf
        for n in numbers
    ):
        raise MPMError("step, tolerance, most and displacement must be positive numbers.")
    if min(step, tolerance) < FINEST:
        raise MPMError(f"step and tolerance must be at least {FINEST:g}.")
    if most <= 1.0:
        raise MPMError(f"most= is a factor at which to stop, above 1, not {most:g}.")
    if any(body.load.value < 1.0 for body in problem.bodies) or problem.held_back > 0.0:
        raise MPMError("strength_reduction() begins at the whole load; call solve() first.")
    start = [body.converged_displacement.copy() for body in problem.bodies]

    def moved() -> float:
        here = [body.converged_displacement for body in problem.bodies]
        gdim = problem.bodies[0].V.mesh.geometry.dim
        sizes = [
            np.linalg.norm((now - then).reshape(-1, gdim), axis=1).max(initial=0.0)
            for now, then in zip(here, start, strict=True)
        ]
        return float(max(comm.allgather(max(sizes))))

    def stands(factor: float) -> bool:
        """Whether there is equilibrium with strength divided by that."""
        for points in problem.points:
            points.weaken(factor)
        state = problem.capture() if displacement is not None else None
        try:
            problem.step()
        except (ConvergenceError, DomainDistortionError, ParticleOutsideError):
            return False
        if state is not None and displacement is not None and moved() > displacement:
            problem.return_to(state)
            return False
        return True

    good, bad, size = 1.0, np.inf, float(step)
    factors, displacements = [1.0], [0.0]
    try:
        while bad - good > tolerance and good < most:
            factor = min(good + size, 0.5 * (good + bad) if np.isfinite(bad) else np.inf, most)
            factor = round(factor, DIGITS)
            if stands(factor):
                good = factor
                # (there is a limit to end it, so what failed in longer steps is tried again)
                bad = bad if displacement is None else np.inf
                factors.append(good)
                displacements.append(moved())
            else:
                bad = factor
                size = 0.5 * (factor - good)
    finally:
        for points in problem.points:
            points.weaken(1.0)
    return StrengthReduction(good, float(bad), factors, displacements)
