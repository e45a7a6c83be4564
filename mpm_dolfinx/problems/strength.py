# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The factor of safety of a body, by reduction of its strength."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..constitutive.moduli import undeformed_tangent
from ..errors import TRIAL_ERRORS, MPMError, ParticleOutsideError, warn
from ..materials.base import StrainMaterial
from ..parallel.boundary import collective
from ..parallel.interruption import held, interrupted, settle
from ..tolerances import NEGLIGIBLE
from .quasistatic import QuasiStaticProblem
from .through_time import TimeProblem

__all__ = ["StrengthReduction", "strength_reduction"]

type Array = NDArray[np.float64]

#: What says that there is no equilibrium, or none was found.
FAILURES = (*TRIAL_ERRORS, ParticleOutsideError)


@dataclass(frozen=True)
class StrengthReduction:
    """Result of a reduction of strength.

    Attributes:
        factor: Factor of safety: what the strength was last divided by with equilibrium.
        above: The least factor for which none was found; infinite where none was tried.
        factors: The factors with equilibrium, in order.
        displacements: Largest displacement of a node since the reduction began, for each.
        limit: Largest displacement that counted as equilibrium.
        reason: Why there is none for ``above``: ``"displacement"``, there is one but beyond the
            limit; ``"no convergence"``, where Newton's method failed, which says nothing of the
            ground unless the curve is steep there; ``"most"``, the body bears the largest factor.
        failure: What Newton's method failed with at ``above`` and where, if that is the reason.
        curve: Factors with any equilibrium, in order, and the displacements there, those beyond
            the limit too, shape ``(n, 2)``.
    """

    factor: float
    above: float
    factors: list[float] = field(default_factory=list)
    displacements: list[float] = field(default_factory=list)
    limit: float = np.inf
    reason: Literal["displacement", "no convergence", "most"] = "most"
    failure: MPMError | None = None
    curve: Array = field(default_factory=lambda: np.zeros((0, 2)))


class _Search:
    """Which factor is tried next, by what came of those before.

    A factor at which Newton's method fails is tried again whenever a nearer one has stood, one that
    moves the body too far is not.

    Args:
        step: First increment.
        most: Largest factor.

    Attributes:
        good: The last factor that stood.
        bad: The least factor above it that did not, since then or for good.
    """

    def __init__(self, step: float, most: float) -> None:
        self.good, self.bad = 1.0, np.inf
        self._step, self._most, self._too_far = step, most, np.inf

    def next(self) -> float:
        """Return the factor to try."""
        middle = 0.5 * (self.good + self.bad)
        # sums of steps are told as 1.2, not as 1.2000000000000002
        return round(min(self.good + self._step, middle, self._most), 12)

    def stood(self, factor: float) -> None:
        """Go on from a factor, also to those at which Newton's method has failed."""
        self.good, self.bad = factor, self._too_far

    def fell(self, factor: float, too_far: bool) -> None:
        """Go half as far from the last that stood."""
        self.bad, self._step = factor, 0.5 * (factor - self.good)
        if too_far:
            self._too_far = factor


@collective()
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
    method may also fail where there is equilibrium, most where soils do not dilate. So a factor
    at which it has failed is tried again in smaller increments. One that moves the body too far is
    not. The result tells which of the two ended the search, ``found.reason``, and there is a
    warning where it was Newton's method, far below the limit.

    Where something else ends it, Ctrl-C or an error in a function of yours, the body is left in the
    last state of equilibrium too, with the strength that it was given.

    Coarse cells may find too high a factor: a vertical cut 5 % with cells of a tenth of its height,
    3 % with half of that. Look at two grids.

    Args:
        problem: A problem at its whole load.
        step: First increment of the factor; it is halved where there is no equilibrium.
        tolerance: Width to which the factor is found.
        most: A factor at which to stop, should the body hold.
        displacement: Largest displacement, from the beginning of the reduction, that counts as
            equilibrium; ``np.inf``: any. By default it is half the strain of the body's stress at
            its modulus of shear, in the mean (of squares) over the body, times its extent, the mean
            (geometric) of the sides of a box around it: for a slope some ``density gravity
            H^2 / young``.

    Returns:
        The factor of safety and how it was found.

    Raises:
        MPMError: The problem is not at its whole load, a step there with the strength that it has
            fails, its steps have a duration (PorousProblem, DynamicProblem), no material has a
            strength, or domains may be split.
    """
    _require(problem, step, tolerance, most, displacement)
    start = [body.converged_displacement.copy() for body in problem.bodies]
    limit = _elastic_displacement(problem) if displacement is None else float(displacement)
    search = _Search(float(step), float(most))
    ways: dict[float, float] = {}
    failures: dict[float, MPMError] = {}
    factor = 1.0
    try:
        for points in problem.points:
            points.laws.weaken(search.next())  # laws that do not say what it is refuse that
        while True:
            for points in problem.points:
                points.laws.weaken(factor)
            found = _equilibrium(problem, start, limit)
            if isinstance(found, MPMError):
                failures[factor] = found
            else:
                ways[factor] = found
            if factor == 1.0:
                _require_rest(found, limit)
            if factor in ways and ways[factor] <= limit:
                search.stood(factor)
            else:
                search.fell(factor, too_far=factor in ways)
            if search.bad - search.good <= tolerance or search.good >= most:
                break
            factor = search.next()
    finally:
        for points in problem.points:
            points.laws.weaken(1.0)
    result = _result(search, ways, failures, limit)
    if result.failure is not None:
        _warn_if_far(problem, result)
    return result


def _require_rest(found: float | MPMError, limit: float) -> None:
    """Raise an error where a step at the present strength is not one of a body at rest."""
    if isinstance(found, MPMError):
        raise MPMError(
            "strength_reduction() begins with a step at the present loads and strength, which "
            f"failed, so that a factor would mean nothing: {found!s}",
            found.particles,
        ) from found
    if found > limit:
        raise MPMError(
            "strength_reduction() begins with a step at the present loads and strength, in which "
            f"the body moves by {found:.3g}, beyond the limit {limit:.3g} of the displacement; let "
            "it come to rest by problem.step(), or give displacement=."
        )


def _result(
    search: _Search, ways: dict[float, float], failures: dict[float, MPMError], limit: float
) -> StrengthReduction:
    """Return the result, and why the search ended.

    Args:
        search: It.
        ways: How far the body has moved where there was equilibrium.
        failures: What there was in its place.
        limit: Largest displacement that counts.
    """
    reason: Literal["displacement", "no convergence", "most"] = "most"
    failure = None
    if search.bad < np.inf:
        # (a factor that failed may have moved the body too far when it was tried again)
        failure = None if search.bad in ways else failures[search.bad]
        reason = "displacement" if failure is None else "no convergence"
    curve = np.array(sorted(ways.items())).reshape(-1, 2)
    factors, displacements = curve[curve[:, 1] <= limit].T.tolist()
    return StrengthReduction(
        search.good,
        float(search.bad),
        factors,
        displacements,
        limit,
        reason,
        failure,
        curve,
    )


def _warn_if_far(problem: QuasiStaticProblem, result: StrengthReduction) -> None:
    """Warn where Newton's method failed for a body that has hardly moved (collective)."""
    limit = result.limit if result.limit < np.inf else _elastic_displacement(problem)
    if result.displacements[-1] < 0.25 * limit:  # it does not look as if it slid
        warn(
            problem.bodies[0].mesh.comm,
            f"The factor of safety of {result.factor:g} may be too low: at {result.above:g} "
            f"Newton's method failed, for a body that has moved by {result.displacements[-1]:.3g} "
            f"(limit {limit:.3g}). {result.failure!s}",
        )


def _require(
    problem: QuasiStaticProblem,
    step: float,
    tolerance: float,
    most: float,
    displacement: float | None,
) -> None:
    """Raise an error where :func:`strength_reduction` was given what it cannot do (collective)."""
    if not isinstance(problem, QuasiStaticProblem):
        raise MPMError("strength_reduction() needs an mpm.QuasiStaticProblem.")
    if isinstance(problem, TimeProblem):
        raise MPMError(
            "strength_reduction() needs an mpm.QuasiStaticProblem, whose steps have no duration, "
            f"not an mpm.{type(problem).__name__}."
        )
    anywhere = displacement is None or displacement == np.inf
    numbers = [step, tolerance, most, 1.0 if anywhere else displacement]
    if not all(
        isinstance(n, float | int | np.floating | np.integer)
        and not isinstance(n, bool)
        and 0.0 < n < np.inf
        for n in numbers
    ):
        raise MPMError("step, tolerance, most and displacement must be positive numbers.")
    if min(step, tolerance) < NEGLIGIBLE:
        raise MPMError(f"step and tolerance must be at least {NEGLIGIBLE:g}.")
    if most <= 1.0:
        raise MPMError(f"most= is a factor at which to stop, above 1, not {most:g}.")
    if any(body.load.value < 1.0 for body in problem.bodies) or problem.staging.held_back > 0.0:
        raise MPMError("strength_reduction() begins at the whole load; call solve() first.")
    laws = [law for points in problem.points for law in points.laws.given]
    if all(isinstance(law, StrainMaterial) and law.is_elastic for law in laws):
        raise MPMError(
            "strength_reduction() needs a body whose law has a strength; those of this problem are "
            f"elastic: {', '.join(sorted({type(law).__name__ for law in laws}))}."
        )
    if any(body.on_distortion == "split" for body in problem.bodies):
        raise MPMError(
            "strength_reduction() follows the nodes of the bodies, which a split of domains "
            "changes; set on_distortion = 'error' of the bodies before."
        )


def _moved(problem: QuasiStaticProblem, start: list[Array]) -> float:
    """Return how far a node has moved since it was displaced as given, at most (collective)."""
    comm, gdim = problem.bodies[0].V.mesh.comm, problem.bodies[0].V.mesh.geometry.dim
    sizes = [
        np.linalg.norm((body.converged_displacement - then).reshape(-1, gdim), axis=1)
        for body, then in zip(problem.bodies, start, strict=True)
    ]
    return float(max(comm.allgather(max(size.max(initial=0.0) for size in sizes))))


def _elastic_displacement(problem: QuasiStaticProblem) -> float:
    """Return half the strain of the stress at the modulus of shear, times extent (collective)."""
    comm = problem.bodies[0].V.mesh.comm
    sums, corners = np.zeros(2), []
    for body, points in zip(problem.bodies, problem.points, strict=True):
        shear = undeformed_tangent(points.laws)[:, 0, 1, 0, 1].reshape(body.num_local, -1)
        strains = np.linalg.norm(body.stress.reshape(-1, 9), axis=1) / shear.mean(axis=1)
        sums += body.initial_volume @ strains**2, body.initial_volume.sum()
        corners.append(body.mesh.geometry.x[:, : body.V.mesh.geometry.dim])
    x = np.concatenate(corners)
    lower = np.min(comm.allgather(x.min(axis=0, initial=np.inf)), axis=0)
    upper = np.max(comm.allgather(x.max(axis=0, initial=-np.inf)), axis=0)
    extent = float(np.prod(upper - lower) ** (1.0 / len(lower)))
    squares, volume = np.sum(comm.allgather(sums), axis=0)
    way = 0.5 * extent * float(np.sqrt(squares / volume))
    return way if way > 0.0 else np.inf


def _equilibrium(problem: QuasiStaticProblem, start: list[Array], limit: float) -> float | MPMError:
    """Look for equilibrium with the present strength, and stay there if it is within a limit.

    Whatever else ends it, Ctrl-C or an error in a user's function, leaves the body where it was.

    Returns:
        How far the body has moved, or why no equilibrium was found.
    """
    comm, stages = problem.bodies[0].V.mesh.comm, len(problem.history.stages)
    found: float | MPMError
    with held() as hold:
        before = problem.state.capture()
        try:
            problem.step()
            found = _moved(problem, start)
            if interrupted(comm):
                settle(comm)
                raise KeyboardInterrupt
        except FAILURES as error:
            found = error
        except BaseException:
            problem.state.adopt(before)
            raise
        if len(problem.history.stages) != stages:
            raise MPMError(
                "A stage was begun within strength_reduction(), by a method of the problem's own; "
                "a factor is of one stage alone."
            )
        if not isinstance(found, MPMError) and found > limit:
            problem.state.adopt(before)
    if interrupted(comm, hold.left):
        raise KeyboardInterrupt
    return found
