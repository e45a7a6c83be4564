# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The factor of safety of a body, by reduction of its strength."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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

#: Displacement over size, of what moves, over the relative loss of strength: that of a body that
#: flows, and the most of one that does not begin to. At rest it is a few elastic strains. A slide
#: goes on until its shape bears the weaker strength, by some tenths of its size times that loss.
FLOW, REST = 0.03, 0.015


@dataclass(frozen=True)
class StrengthReduction:
    """Result of a reduction of strength.

    Attributes:
        factor: Factor of safety: what the strength was last divided by with equilibrium.
        above: The least factor for which none was found; infinite where none was tried.
        factors: The factors with equilibrium, in order.
        displacements: Largest displacement of a node since the reduction began, for each.
        reason: Why there is none for ``above``: ``"flow"``, the body slides by more than 0.03 of
            its size times the strength that it lost, and goes on to; ``"no convergence"``, where
            Newton's method failed, which says nothing of the ground unless the body was about to
            flow; ``"most"``, the body bears the largest factor.
        failure: What Newton's method failed with at ``above`` and where, if that is the reason.
        curve: Factors with any state, in order, the displacements there, and the rates: by how
            much of its size what moves has moved since the last equilibrium, over the relative loss
            of strength, zero at factor 1; those of bodies that flow too, shape ``(n, 3)``.
    """

    factor: float
    above: float
    factors: list[float] = field(default_factory=list)
    displacements: list[float] = field(default_factory=list)
    reason: Literal["flow", "no convergence", "most"] = "most"
    failure: MPMError | None = None
    curve: Array = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True)
class _Found:
    """A state that was found: the factor, how far the body has moved, and its rate."""

    factor: float
    way: float
    rate: float

    @property
    def flows(self) -> bool:
        """Whether the body gives way."""
        return self.rate > FLOW


class _Search:
    """Which factor is tried next, by what came of those before.

    A factor at which Newton's method fails is tried again whenever a nearer one has stood, one at
    which the body flows is not.

    Args:
        step: First increment.
        most: Largest factor.

    Attributes:
        good: The last factor that stood.
        bad: The least factor above it that did not, since then or for good.
    """

    def __init__(self, step: float, most: float) -> None:
        self.good, self.bad = 1.0, np.inf
        self._step, self._first, self._most = step, step, most
        self._flows = np.inf  # the least at which the body flows
        self._left = 0.0  # the last that was left in a leap

    def next(self) -> list[float]:
        """Return the factor to try, and one beyond it, at which a body that flows may rest."""
        middle = 0.5 * (self.good + self.bad)
        factor = min(self.good + self._step, middle, self._most)
        found = [factor]
        if self._flows == np.inf and factor < self._most:
            found.append(min(factor + self._first, self._most))
        return [round(each, 12) for each in found]  # (1.2, where sums are 1.2000000000000002)

    def leap(self) -> list[float]:
        """Return a factor to try, once, beyond one at which Newton's method fails."""
        if self._flows < np.inf or self.good in (self._left, self._most):
            return []
        self._left = self.good
        return [round(min(self.good + self._first, self._most), 12)]

    def stood(self, factor: float) -> None:
        """Go on from a factor, also to those at which Newton's method has failed."""
        self.good, self.bad = factor, self._flows

    def fell(self, factor: float, flows: bool) -> None:
        """Go half as far from the last that stood."""
        self.bad = min(factor, self.bad)
        self._step = 0.5 * (self.bad - self.good)
        if flows:
            self._flows = factor


@collective()
def strength_reduction(
    problem: QuasiStaticProblem,
    step: float = 0.05,
    tolerance: float = 0.01,
    most: float = 10.0,
) -> StrengthReduction:
    """Find the factor by which the strength of a body can be divided until it slides (collective).

    Cohesion and the tangent of the angle of friction are divided by a growing factor, all loads
    being as they are, until no equilibrium is found (Zienkiewicz, Humpheson & Lewis 1975; Griffiths
    & Lane 1999). What was found is left in the problem: the body in the last state of equilibrium,
    which shows the slide, with the strength that it was given.

    Geometry is followed, so a body that slides finds other equilibria further down, as its shape
    changes. They do not count. A body at rest that loses a hundredth of its strength gives way by
    some hundredths of its elastic strains, one that slides by about a hundredth of its size. So the
    body flows where it moves by more than 0.03 of the relative loss of strength times its size,
    both of what moves, and does so again in the next increment: what a few cells do that come to
    rest is no slide.
    The rule has no length. Ground so soft that elastic strains come to hundredths flows a few per
    cent earlier than stiff one.

    Newton's method may also fail where there is equilibrium, most where soils do not dilate. So a
    factor at which it has failed is tried again in smaller increments. One at which the body flows
    is not. The result tells which of the two ended the search, ``found.reason``, and there is a
    warning where it was Newton's method, for a body that hardly gives way.

    Where something else ends it, Ctrl-C or an error in a function of yours, the body is left in the
    last state of equilibrium too, with the strength that it was given.

    A body with a factor below 1 slides while it is loaded, or does not bear the whole load. Where
    it comes to rest it just stands, and there is a warning. Load it with twice the strength, and
    take half of the factor that is found.

    Coarse cells may find too high a factor: a vertical cut 5 % with cells of a tenth of its height,
    3 % with half of that. Look at two grids.

    Args:
        problem: A problem at its whole load.
        step: First increment of the factor; it is halved where there is no equilibrium. In a long
            one a body may begin to flow unseen, in up to a quarter of it.
        tolerance: Width to which the factor is found.
        most: A factor at which to stop, should the body hold.

    Returns:
        The factor of safety and how it was found.

    Raises:
        MPMError: The problem is not at its whole load, a step there with the strength that it has
            fails, its steps have a duration (PorousProblem, DynamicProblem), no material has a
            strength, or domains may be split.
    """
    _require(problem, step, tolerance, most)
    start = [body.converged_displacement.copy() for body in problem.bodies]
    search = _Search(float(step), float(most))
    curve: dict[float, tuple[float, float]] = {}
    failures: dict[float, MPMError] = {}
    try:
        for points in problem.points:
            points.laws.weaken(search.next()[0])  # laws that do not say what it is refuse that
        curve[1.0] = _at_rest(_equilibria(problem, start, 1.0, [1.0], step), step), 0.0
        factors = search.next()
        while factors:
            states, error = _equilibria(problem, start, search.good, factors, step)
            stands = error is None and not states[-1].flows
            for each in states if stands else states[:1]:
                curve[each.factor] = each.way, each.rate
            if stands:
                search.stood(states[-1].factor)
            else:
                search.fell(factors[0], flows=bool(states))
            if error is not None and not states:
                failures[factors[0]] = error
            factors = search.next()
            if search.bad - search.good <= tolerance or search.good >= most:
                # where Newton's method fails for a body at rest, it may not a little further
                factors = search.leap() if curve[search.good][1] < REST else []
    finally:
        for points in problem.points:
            points.laws.weaken(1.0)
    result = _result(search, curve, failures)
    if result.factor == 1.0:
        _warn_of_slide(problem, result)
    elif result.failure is not None:
        _warn_if_at_rest(problem, result, curve[result.factor][1])
    return result


def _at_rest(found: tuple[list[_Found], MPMError | None], loss: float) -> float:
    """Return how far a body moves in a step at the present strength, if it is at rest."""
    states, error = found
    if error is not None:
        raise MPMError(
            "strength_reduction() begins with a step at the present loads and strength, which "
            f"failed, so that a factor would mean nothing: {error!s}",
            error.particles,
        ) from error
    if states[0].flows:
        raise MPMError(
            "strength_reduction() begins with a step at the present loads and strength, in which "
            f"the body moves by {states[0].way:.3g}, by {states[0].rate * loss:.3g} of the size of "
            f"what moves, above {FLOW * loss:g}: it flows; let it settle by problem.step(), or, "
            "where it slides, load it with twice the strength, and take half of the factor."
        )
    return states[0].way


def _result(
    search: _Search, curve: dict[float, tuple[float, float]], failures: dict[float, MPMError]
) -> StrengthReduction:
    """Return the result, and why the search ended.

    Args:
        search: It.
        curve: How far the body has moved, and its rate, where there was a state.
        failures: What there was in its place.
    """
    reason: Literal["flow", "no convergence", "most"] = "most"
    failure = None
    if search.bad < np.inf:
        # (at a factor that failed the body may have flowed when it was tried again)
        failure = None if search.bad in curve else failures[search.bad]
        reason = "flow" if failure is None else "no convergence"
    rows = np.array([(factor, *curve[factor]) for factor in sorted(curve)])
    factors, displacements = rows[rows[:, 0] <= search.good, :2].T.tolist()
    return StrengthReduction(
        search.good, float(search.bad), factors, displacements, reason, failure, rows
    )


def _warn_of_slide(problem: QuasiStaticProblem, result: StrengthReduction) -> None:
    """Warn where the body bears no loss of strength: it may have slid already (collective)."""
    warn(
        problem.bodies[0].mesh.comm,
        "The factor of safety may be far below 1: the body bears no loss of strength, not even at "
        f"{result.above:g}, as one that slid while it was loaded, to where it just stands. "
        "Load it with twice the strength, and take half of the factor that is found.",
    )


def _warn_if_at_rest(problem: QuasiStaticProblem, result: StrengthReduction, rate: float) -> None:
    """Warn where Newton's method failed for a body that hardly gives way (collective)."""
    if rate < REST:
        warn(
            problem.bodies[0].mesh.comm,
            f"The factor of safety of {result.factor:g} may be too low: at {result.above:g} "
            f"Newton's method failed, for a body that does not flow: it moved by {rate:.2g} of its "
            f"size times the strength that it lost last (it flows at {FLOW:g}). {result.failure!s}",
        )


def _require(
    problem: QuasiStaticProblem,
    step: float,
    tolerance: float,
    most: float,
) -> None:
    """Raise an error where :func:`strength_reduction` was given what it cannot do (collective)."""
    if not isinstance(problem, QuasiStaticProblem):
        raise MPMError("strength_reduction() needs an mpm.QuasiStaticProblem.")
    if isinstance(problem, TimeProblem):
        raise MPMError(
            "strength_reduction() needs an mpm.QuasiStaticProblem, whose steps have no duration, "
            f"not an mpm.{type(problem).__name__}."
        )
    if not all(
        isinstance(n, float | int | np.floating | np.integer)
        and not isinstance(n, bool)
        and 0.0 < n < np.inf
        for n in (step, tolerance, most)
    ):
        raise MPMError("step, tolerance and most must be positive numbers.")
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


def _slid(problem: QuasiStaticProblem, before: list[Array]) -> float:
    """Return how far what moves has moved since domains were somewhere, over its size (collective).

    The mean is over the body with displacements as weight, ``sum(V u^2) / sum(V u)``, and the size
    of what moves the root of its volume, ``sum(V u)^2 / sum(V u^2)``.

    Args:
        problem: It.
        before: Centroids of its bodies then.
    """
    sums = np.zeros(2)
    for body, then in zip(problem.bodies, before, strict=True):
        way = np.linalg.norm(body.centroid - then, axis=1)
        sums += body.initial_volume @ way, body.initial_volume @ way**2
    mesh = problem.bodies[0].V.mesh
    first, second = np.sum(mesh.comm.allgather(sums), axis=0)
    if second == 0.0:
        return 0.0
    size = (first / np.sqrt(second)) ** (2.0 / mesh.geometry.dim)
    return float(second / first / size)


def _equilibria(
    problem: QuasiStaticProblem, start: list[Array], good: float, factors: list[float], loss: float
) -> tuple[list[_Found], MPMError | None]:
    """Look for equilibrium, at a larger factor where the body flows; stay there if it rests.

    Whatever else ends it, Ctrl-C or an error in a user's function, leaves the body where it was.

    Args:
        problem: It.
        start: Displacements of the bodies' nodes when the reduction began.
        good: The factor at which it is at rest.
        factors: What to divide the strength by, in order, until it rests.
        loss: Relative loss of strength for the rate where there is none.

    Returns:
        The states that were found, and why there was none at the next factor.
    """
    comm, stages = problem.bodies[0].V.mesh.comm, len(problem.history.stages)
    states: list[_Found] = []
    failure: MPMError | None = None
    with held() as hold:
        before = problem.state.capture()
        try:
            for factor in factors:
                for points in problem.points:
                    points.laws.weaken(factor)
                places = [body.centroid.copy() for body in problem.bodies]
                problem.step()
                rate = _slid(problem, places) / (np.log(factor / good) or loss)
                states.append(_Found(factor, _moved(problem, start), rate))
                if interrupted(comm):
                    settle(comm)
                    raise KeyboardInterrupt
                if not states[-1].flows:
                    break
                good = factor
        except FAILURES as error:
            failure = error
        except BaseException:
            problem.state.adopt(before)
            raise
        if len(problem.history.stages) != stages:
            raise MPMError(
                "A stage was begun within strength_reduction(), by a method of the problem's own; "
                "a factor is of one stage alone."
            )
        if states and (failure is not None or states[-1].flows):
            problem.state.adopt(before)
    if interrupted(comm, hold.left):
        raise KeyboardInterrupt
    return states, failure
