# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A problem that goes through time, step by step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ..errors import MPMError
from ..history import History, Step
from ..parallel.boundary import collective, of_user
from ..parallel.given import as_positive
from ..stepping.progress import with_bar
from ..tolerances import NEGLIGIBLE
from .problem import Problem

__all__ = ["TimeProblem"]

type Path_ = Callable[[float], None]


class TimeProblem(Problem):
    """A problem whose steps have a duration. Loads act in full unless a path says otherwise."""

    predicts = False
    at_rest = False

    def _aim(self, t: float) -> None:
        """Take a time for the end of the step to try."""

    def _begin_run(self, now: float) -> None:
        """Take notice that a run begins at a time (collective)."""

    def _resume_run(self) -> None:
        """Take notice that a run goes on from a checkpoint (collective)."""

    def _end_run(self) -> None:
        """Look back at a run that has come to its end (collective)."""

    @collective()
    def solve(  # type: ignore[override]
        self,
        *,
        time: float,
        dt: float,
        update: Path_ | None = None,
        output_at: Sequence[float] = (),
        output: str | Path | None = None,
        progress: bool = False,
        repartition: float | None = None,
    ) -> History:
        """Go on to a time.

        Args:
            time: Where to end, counted from the beginning of the first run (``history.time``).
            dt: Largest duration of a step; all steps up to each of the times asked for are equal.
                A step that fails is halved; later ones grow again.
            update: The user's path: ``update(t)`` sets values of Dirichlet conditions, Constants
                and Functions to what they are at the time t. It is called at the run's
                beginning too, and again with a smaller t after a failure. The load factor is 1
                unless it sets another.
            output_at: Times that steps end at, to the last bit, besides the last one.
            output: A ``.pvd`` file, to which the states at these times and the last one are
                written, and before the first step the state that is there.
            progress: Whether rank 0 shows a progress bar.
            repartition: As in :meth:`QuasiStaticProblem.solve`.

        Returns:
            The history of the run; of a motion, ``history.energies`` has what became of the energy.

        Raises:
            MPMError: The run cannot go on; the state is that of the last converged step.
        """
        began = self.history.time
        path = self.steps(
            time=time, dt=dt, update=update, output_at=output_at, repartition=repartition
        )
        if output is not None and not self.history.steps:
            self.write(output)

        def done(_: Step) -> float:
            return (self.history.time - began) / (time - began)

        wanted = {float(time), *map(float, output_at)}
        count = math.ceil((time - began) / dt)
        for step in with_bar(path, count, done) if progress and self._comm.rank == 0 else path:
            if output is not None and step.time in wanted:
                self.write(output)
        return self.history

    @collective()
    def steps(  # type: ignore[override]
        self,
        *,
        time: float,
        dt: float,
        update: Path_ | None = None,
        output_at: Sequence[float] = (),
        repartition: float | None = None,
    ) -> Iterator[Step]:
        """Go on to a time, one converged step at a time.

        After :meth:`restore` it goes on with the run that was interrupted, if it ends at one of
        the times asked for.

        Args:
            time: As in :meth:`solve`.
            dt: As in :meth:`solve`.
            update: As in :meth:`solve`.
            output_at: As in :meth:`solve`.
            repartition: As in :meth:`solve`.

        Yields:
            Each converged step; ``step.load`` and ``step.time`` are the time at its end.

        Raises:
            MPMError: As in :meth:`solve`.
        """
        self.reign.require()
        if update is not None and not callable(update):
            raise MPMError(f"update= is a function of t, not {update!r}.")
        now = self.history.time
        for name, value in (("time", time), ("dt", dt)):
            known = isinstance(value, float | int | np.number) and not isinstance(value, bool)
            if not known or not math.isfinite(value):
                raise MPMError(f"{name} must be a finite number, not {value!r}.")
        if time <= now:
            raise MPMError(f"It is {now:g} already; give a later time than {time:g}.")
        if dt <= 0.0:
            raise MPMError(f"dt must be positive, not {dt:g}.")
        try:
            wanted = sorted({*map(float, output_at), float(time)})
        except (TypeError, ValueError):
            raise MPMError(f"output_at must be a list of times, not {output_at!r}.") from None
        if not all(math.isfinite(t) and t <= time for t in wanted):
            raise MPMError(f"output_at must not have times later than the end, {time:g}.")
        return self._through(now, [t for t in wanted if t > now], float(dt), update, repartition)

    def _through(
        self,
        now: float,
        ends: list[float],
        dt: float,
        update: Path_ | None,
        repartition: float | None,
    ) -> Iterator[Step]:
        """Go from one of the times to the next."""
        if update is not None:
            update = of_user(self._comm, update)
        interrupted = self._stepper.interrupted
        resumes = interrupted is not None and interrupted.end == ends[0]

        def path(t: float) -> None:
            self._aim(t)
            self._apply_loads()
            if update is not None:
                update(t)

        path(now)
        if resumes:
            self._resume_run()
        else:
            self._stepper.resume(None)
            self._begin_run(now)
        for end in ends:
            count, began = max(1, math.ceil((end - now) / dt * (1.0 - NEGLIGIBLE))), now
            if resumes and interrupted is not None:
                count, began = interrupted.control.steps, interrupted.began
                resumes = False
            yield from self._stepper.steps(self, count, path, repartition, None, (began, end))
            if self.history.time != end:
                return
            now = end
        self._end_run()

    def _apply_loads(self) -> None:
        """Apply loads in full, and supports as they are given."""
        for body in self.bodies:
            np.copyto(body.load.value, 1.0)
            np.copyto(body.proportional.value, 0.0)

    @collective()
    def step(self, dt: float) -> Step:  # type: ignore[override]
        """Go on by a duration, with loads as they are set now all through it.

        Args:
            dt: The duration; where that fails it is gone through in several steps.

        Returns:
            The last converged step.

        Raises:
            MPMError: As in :meth:`solve`.
        """
        dt = as_positive(dt, "dt")
        for _ in self.steps(time=self.history.time + dt, dt=2.0 * dt):
            pass
        return self.history.steps[-1]
