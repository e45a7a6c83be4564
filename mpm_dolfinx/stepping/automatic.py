# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps chosen by an estimate of their error, and taken back where it is too large."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import MPMError
from ..parallel.magnitudes import joint_norm
from ..particles.particles import Particles
from ..reals import as_reals
from ..system.predictor import extrapolated
from ..system.reduced import ReducedSystem
from ..tolerances import EQUAL, NEGLIGIBLE, SLIGHT
from .control import LIMIT_HALVINGS, MOST_HALVINGS, Control, StepControl

__all__ = ["ErrorControl", "StepError", "control_of", "error_of_step", "local_error"]

#: The first step: a larger one that walks from the elastic range into flow leaves an error that
#: nothing repairs.
FIRST = 0.05
#: Factor to the next step, at least and at most, and share of the one that would just do.
LEAST, MOST, SAFETY = 0.2, 2.0, 0.9
#: Exponents of a step's error and of that of the step before, in a PI controller of order two.
PROPORTIONAL, INTEGRAL = 0.35, 0.2
#: Error over the allowed one from which a step is taken back.
REJECTED = 4.0
#: What the error of a step counts in which nothing yields: what is left of it in the end.
ELASTIC = 0.02
#: Factor of the tolerance where errors are compared with the motion so far, or with a length.
OF_MOTION, OF_LENGTH = 8.0, 5.0
#: The same where an obstacle drives the motion: nothing relaxes what it has pushed aside wrongly.
OF_DRIVEN = 1.5


@dataclass(frozen=True)
class StepError:
    """Estimated error of a step that has converged and is not committed yet.

    Attributes:
        error: Its error, the root mean square over the nodes of all bodies.
        motion: Motion of the run up to its end, likewise.
        smooth: Whether no history has changed in it, nor contact.
        touches: Whether one has, where bodies may touch and let go.
        driven: Whether points yield in it that an obstacle pushes on its own path.
    """

    error: float
    motion: float
    smooth: bool
    touches: bool = False
    driven: bool = False


def error_of_step(reduced: ReducedSystem, size: float, comm: MPI.Comm) -> StepError:
    """Estimate the error of the step that was solved last, in displacements (collective).

    That of :func:`local_error` by a rule of first order, as backward Euler's; half of the increment
    in the first step.

    Args:
        reduced: The system, its last residual that of the solution.
        size: Size of the step.
        comm: The ranks.
    """
    error, motion = local_error(reduced, size, comm)
    smooth = reduced.terms.smooth()
    touches = not smooth and reduced.terms.one_sided
    return StepError(error, motion, smooth, touches, touches and reduced.terms.is_driven())


def local_error(
    reduced: ReducedSystem, size: float, comm: MPI.Comm, order: int = 1, constant: float = 0.5
) -> tuple[float, float]:
    """Return the error that a rule makes in the step that was solved last, and the motion so far.

    A rule of order p errs by ``C D^(p + 1) |d^(p + 1) u|`` in a step of size D. The derivative is
    what the increment differs by from that which the last p steps let expect, over the same of a
    polynomial. Where the motion is not smooth, as in an impact, it grows as D does not. In the
    first p steps it is a share C of the increment.

    Args:
        reduced: The system, its last residual that of the solution.
        size: Size of the step.
        comm: The ranks.
        order: The order p, 1 or 2.
        constant: The constant C.

    Returns:
        Root mean squares over the nodes of all bodies.
    """
    past = reduced.predictor
    bodies = [i for i, moved in enumerate(reduced.bodies) if isinstance(moved, Particles)]
    every = reduced.unknowns.increments()
    increments = [every[i] for i in bodies]
    error, moved = increments, increments
    steps = past.past[-order:]
    if len(steps) == order:
        expected = extrapolated(steps, size)
        error = [u - expected[i] for i, u in zip(bodies, increments, strict=True)]
        before = 0.0
        for number, (last, _) in enumerate(reversed(steps), 1):
            constant *= 2.0 * number * size / (size + 2.0 * before + last)
            before += last
    if past.moved:
        moved = [past.moved[i] + u for i, u in zip(bodies, increments, strict=True)]
    gdim = reduced.bodies[bodies[0]].W.mesh.geometry.dim
    nodes = comm.allreduce(sum(len(u) for u in increments)) / gdim
    sizes = [joint_norm(np.concatenate(own), comm) / math.sqrt(nodes) for own in (error, moved)]
    return constant * sizes[0], sizes[1]


class ErrorControl:
    """Chooses the end of the next step between 0 and 1 by the errors of the steps before.

    With ``q = w e / ((8 tolerance)^2 |d|)`` of a step's error e and the motion |d| of the run so
    far, or ``w e / ((5 tolerance)^2 length)``, the next step is larger by
    ``0.9 q^-0.35 q_before^0.2`` (a PI controller: Gustafsson 1991), and one with q > 4 is taken
    back; w is 1, or 0.02 where nothing yields. A first step in which something touches is taken
    back down to a quarter. Where an obstacle on its own path pushes points that yield, the errors
    add up and the motion goes on as it does: they are compared with the motion so far over the
    share t of the run, ``q = e / ((1.5 tolerance)^2 |d| / t)``. The error of the run is then in
    proportion to the tolerance.

    Args:
        tolerance: Error allowed in the end, relative to the motion.
        output_at: Shares of the run at which a step is to end.
        length: Compare with it, and not with the motion so far.

    Attributes:
        steps: ``"auto"``.

    Raises:
        MPMError: Numbers that make no sense.
    """

    def __init__(
        self,
        tolerance: float = 1e-2,
        output_at: Sequence[float] = (),
        length: float | None = None,
    ) -> None:
        given = {"tolerance": (tolerance, 1.0)}
        if length is not None:
            given["length"] = (length, math.inf)
        for name, (value, most) in given.items():
            known = isinstance(value, float | int | np.number) and not isinstance(value, bool)
            if not (known and 0.0 < value <= most and math.isfinite(value)):
                bound = "" if most == math.inf else f" up to {most:g}"
                raise MPMError(f"{name} must be a positive number{bound}, not {value!r}.")
        try:
            places = as_reals(list(output_at))
        except (TypeError, ValueError):
            places = np.array([math.nan])
        levels: list[float] = sorted({*places.ravel().tolist()} - {1.0})
        if places.ndim != 1 or not all(0.0 < t < 1.0 for t in levels):
            raise MPMError(
                "output_at must be a list of shares of the run, larger than 0 and up to 1, not "
                f"{output_at!r}."
            )
        self.steps: Any = "auto"
        self._tolerance = float(tolerance)
        self._length = None if length is None else float(length)
        self._levels = [*levels, 1.0]
        self._now = 0.0
        self._size = FIRST
        self._before: float | None = None
        self._ratio = 0.0
        self._holds = self._touches = False
        self._unkept = self._in_a_row = 0

    @property
    def asked(self) -> list[Any]:
        """Options that a run from a checkpoint must share with the one before."""
        return [self.steps, self._tolerance, self._length, self._levels]

    def __str__(self) -> str:
        """Return how the steps are chosen, for a sentence."""
        levels = ", ".join(f"{t:g}" for t in self._levels[:-1])
        return (
            f"steps chosen by tolerance={self._tolerance:g}, length={self._length}, "
            f"output_at=[{levels}]"
        )

    @property
    def finished(self) -> bool:
        """Whether the whole load is reached."""
        return self._now == 1.0

    @property
    def share(self) -> float:
        """How much is done."""
        return self._now

    @property
    def lands(self) -> bool:
        """Whether the step to try ends at one of the levels that were asked for."""
        return self.target in self._levels

    @property
    def _level(self) -> float:
        return next(t for t in self._levels if t > self._now)

    @property
    def _least(self) -> float:
        return FIRST / float(2**MOST_HALVINGS)

    @property
    def _smallest(self) -> bool:
        """Whether no smaller step than the present one is tried; its size has a round-off."""
        return self.target - self._now <= self._least * (1.0 + SLIGHT)

    @property
    def target(self) -> float:
        """End of the step to try: a level, or no further than halfway to the next."""
        level = self._level
        left = level - self._now
        if self._size >= left * (1.0 - NEGLIGIBLE):
            return level
        return self._now + min(self._size, 0.5 * left)  # no short step is left over

    def judge(self, found: StepError) -> float:
        """Return the error of the step that was tried, over the allowed one.

        Args:
            found: What is estimated.
        """
        if self._length is not None:
            factor, motion = OF_LENGTH, self._length
        else:
            factor, motion = OF_MOTION, found.motion
        if found.driven:
            factor, motion = OF_DRIVEN, self._length or found.motion / self.target
        allowed = (factor * self._tolerance) ** 2 * motion
        self._touches = found.touches
        error = found.error * (ELASTIC if found.smooth else 1.0)
        self._ratio = error / allowed if error > 0.0 else 0.0
        return self._ratio

    def reject(self) -> bool:
        """Make the step smaller that was judged last, if its error is too large; tell whether.

        The smallest is not, and counted: see :attr:`failure`. Nor is the first one, as half of it
        counts as its error, however small it is; but what contact moves wrongly at first stays, so
        that with it the first step is made smaller, once.
        """
        tried = self.target - self._now
        kept = self._before is None and (tried < FIRST or not self._touches)
        if self._ratio <= REJECTED or kept:
            self._in_a_row = 0
            return False
        if self._smallest:
            self._unkept += 1
            self._in_a_row += 1
            return False
        self._size = max(tried * max(LEAST, SAFETY / math.sqrt(self._ratio)), self._least)
        return True

    @property
    def complaint(self) -> str | None:
        """Warning that the step judged last misses the tolerance, given once."""
        if self._unkept != 1 or self._ratio <= REJECTED or not self._smallest:
            return None
        return (
            f"{self._missed}: a step of the smallest size, {self._least:.3g} of the run, had "
            f"{self._ratio:.3g} times the allowed error; {MOST_HALVINGS} such steps in a row end "
            "it."
        )

    @property
    def failure(self) -> str | None:
        """Why the run ends with the step judged last, if it does.

        As many steps in a row miss as one may be halved; after a jump, as where a body snaps
        through, two do.
        """
        if self._in_a_row < MOST_HALVINGS:
            return None
        return (
            f"{self._missed}: {MOST_HALVINGS} steps in a row of the smallest size, "
            f"{self._least:.3g} of the run, had more than {REJECTED:g} times the allowed error, "
            "the last one "
            f"{self._ratio:.3g} times; if bodies move on here under hardly any more load, as at a "
            "limit load, displacement control (control=...) or a motion follows them, else give a "
            "larger tolerance, or a number of steps"
        )

    @property
    def _missed(self) -> str:
        """Beginning of a sentence on steps that miss the tolerance."""
        length = "" if self._length is None else f" and length={self._length:g}"
        return f"tolerance={self._tolerance:g}{length} cannot be kept"

    def accept(self, iterations: int) -> None:
        """Go to the target, and choose the next step by the error that was judged last."""
        now = self.target
        tried = now - self._now
        ratio = max(self._ratio, EQUAL)
        factor = SAFETY * float(ratio**-PROPORTIONAL)
        if self._before is None:
            factor = SAFETY / math.sqrt(ratio)
        else:
            factor *= float(self._before**INTEGRAL)
        factor = min(max(factor, LEAST), 1.0 if self._holds else MOST)
        size = tried * factor
        # A step that was shortened says nothing against one of the size before.
        shortened = tried < self._size / 1.2
        self._size = max(size, self._size) if shortened and factor >= 1.0 else size
        self._size = max(self._size, self._least)
        self._now, self._before, self._holds = now, ratio, False

    def begin_anew(self) -> None:
        """Try a step as at the beginning, after what made smaller ones fail has changed."""
        self._size, self._before, self._holds = FIRST, None, False

    def cut_back(self, gave_up: bool = False) -> bool:
        """Halve the step; return False where it is at its smallest, or a limit is found.

        Args:
            gave_up: As in :meth:`StepControl.cut_back`.
        """
        tried = self.target - self._now
        limit = tried <= FIRST / 2**LIMIT_HALVINGS and tried <= SLIGHT * self._now
        if self._smallest or (gave_up and limit):
            return False
        self._size, self._holds = max(0.5 * tried, self._least), True
        return True


def control_of(attributes: dict[str, Any]) -> Control:
    """Return the control that has these attributes, for a run from a checkpoint."""
    control: Control
    if "_tolerance" in attributes:
        control = ErrorControl()
    else:
        control = StepControl(attributes["steps"])
    vars(control).update(attributes)
    return control
