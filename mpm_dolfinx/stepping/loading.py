# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps of a problem: tried, committed, or taken back and made smaller."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import NoReturn, Protocol

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import TRIAL_ERRORS, MPMError, ParticleOutsideError, warn
from ..history import Step
from ..io.checkpoint import Snapshot
from ..log import STEPS, tell
from ..parallel.boundary import of_user
from ..parallel.interruption import Hold, Interrupted, held, interrupted, settle
from ..parallel.totals import over_ranks
from ..system.errors import estimated
from ..system.locking import locking
from ..system.release import Release
from .adaptivity import Adaptivity
from .automatic import ErrorControl, error_of_step
from .control import Control, Run, StepControl
from .displacement_control import DisplacementControl
from .leaving import left_outside, may_stop
from .solving import Goal, set_load
from .trial import Owner, Path, Trial

__all__ = ["Mender", "Stepper"]


class Mender(Protocol):
    """Changes of the bodies' meshes between steps. All calls are collective."""

    def after_step(self) -> None:
        """Look at what a converged step has made of the domains."""

    def mend(self, error: MPMError) -> bool:
        """Change what made the smallest step fail; return whether to go on."""

    def repeat(self, snapshot: Snapshot, functions: bool, source: str) -> None:
        """Make the changes with which a state was made."""


class Stepper:
    """Takes a problem through runs of load steps, and through steps alone.

    Args:
        trial: Tries the steps of the problem.
        release: Holds back what a stage changes at once.
        mender: What changes meshes between steps, if anything.

    Attributes:
        trial: Tries the steps, and knows the last that has converged.
        interrupted: The run that a checkpoint interrupted, if the next one is to go on with it.
    """

    def __init__(self, trial: Trial, release: Release, mender: Mender | None = None) -> None:
        self.trial, self._release, self._mender = trial, release, mender
        self.interrupted: Run | None = None
        self._begins_stage = self._told_of_locking = False

    @property
    def share(self) -> float:
        """How much of the run is done."""
        return 1.0 if self.trial.run is None else self.trial.run.control.share

    def resume(self, run: Run | None) -> None:
        """Let the next run be one that was interrupted, or a new one."""
        self.trial.run = self.interrupted = run

    def begin_stage(self) -> None:
        """Let the next run be one of a new stage, which may begin at the whole load."""
        self.resume(None)
        self._begins_stage = True
        for known, field in zip(
            self.trial.converged.prescribed, self.trial.reduced.fields, strict=True
        ):
            held = np.zeros(len(known), dtype=bool)
            for bc in field.prescribed:
                held[bc.dof_indices()[0]] = True
            known[~held] = 0.0

    # -- Runs -----------------------------------------------------------------------------

    def steps(
        self,
        owner: Owner,
        steps: int | ErrorControl,
        update: Path | None,
        repartition: float | None,
        control: DisplacementControl | None = None,
        span: tuple[float, float] | None = None,
        adaptivity: Adaptivity | None = None,
    ) -> Iterator[Step]:
        """Apply the whole load: see :meth:`Problem.steps`.

        Args:
            owner: The problem, which the iterator keeps alive.
            steps: As there; ``"auto"`` with what goes with it is an :class:`ErrorControl`.
            update: As there; through time it is called with the time.
            repartition: As there.
            control: As there.
            span: Times at beginning and end; ``None``: not through time.
            adaptivity: Frees nodes at the end of steps; ``None``: nothing does.
        """
        trial = self.trial
        comm, chosen = trial.solver.system.comm, _control_of(steps)
        if update is not None:
            if not callable(update):
                raise MPMError(f"update= is a function of t, not {update!r}.")
            update = of_user(comm, update)
        if control is not None and not isinstance(control, DisplacementControl):
            raise MPMError(f"control= is a DisplacementControl, not {control!r}.")
        # Between two steps Ctrl-C acts as ever, but on several ranks, where it would take some of
        # them out of what the others go on with.
        with held() if comm.size > 1 else nullcontext(Hold()) as hold:
            last = Hold()
            run = self._begin(chosen, update, control, span, adaptivity)
            may_split = any(body.on_distortion == "split" for body in owner.bodies)
            if control is not None and (repartition is not None or may_split):
                control.require_movable()
            while not run.control.finished:
                with held() as now:
                    if interrupted(comm, last.left):
                        self._leave(update)
                    try:
                        step = self._try(run, update, control)
                    except ParticleOutsideError as told:
                        if not may_stop(owner.bodies):
                            raise
                        owner.history.stopped = told
                        warn(comm, f"The run stopped. {told!s}")
                        return
                    if step is not None:
                        self._end_step(repartition)
                last = now
                if step is not None:
                    yield step
                    if trial.run is not run:
                        raise MPMError(
                            "This run cannot go on: a step, a stage or another run was begun, or "
                            "a checkpoint restored, between two of its steps; leave its loop "
                            "before."
                        )
            trial.run = None
            if (sentence := left_outside(owner.bodies, owner.history)) is not None:
                warn(comm, sentence)
            self._warn_of_doubts(run)
            if interrupted(comm, last.left):
                self._leave()
        if hold.left:
            raise KeyboardInterrupt

    def _begin(
        self,
        steps: Control,
        update: Path | None,
        control: DisplacementControl | None,
        span: tuple[float, float] | None,
        adaptivity: Adaptivity | None,
    ) -> Run:
        """Return a new run, or the one that a checkpoint interrupted."""
        trial = self.trial
        goal, began, end = None, trial.owner.history.stage, None
        if control is not None:
            control.require_for(trial.owner.bodies, update is not None)
            goal = control.value
        if span is not None:
            began, end = span
        trial.solver.begin_run()
        if self.interrupted is not None:
            self.interrupted.require(steps, update is not None, goal, end, adaptivity)
            trial.run, self.interrupted = self.interrupted, None
            return trial.run
        start = trial.converged.load if control is None else control.present()
        done = trial.converged.load >= 1.0 and self._release.remaining == 0.0
        if control is None and update is None and done and not self._begins_stage:
            raise MPMError(
                "The whole load is applied already; go on with problem.step() or with a path "
                "(update=...)."
            )
        if start == goal:
            raise MPMError("The controlled displacement has its value already.")
        self._begins_stage = False
        if span is None:
            trial.reduced.predictor.clear(isinstance(steps, ErrorControl))
        base = [values.copy() for values in trial.converged.prescribed]
        left = self._release.remaining
        trial.run = Run(steps, update is not None, start, base, goal, began, end, left)
        trial.run.adaptivity = adaptivity
        if span is not None:
            trial.converged.parameter = began
        else:
            trial.converged.parameter = 0.0 if trial.run.shares else trial.converged.load
        return trial.run

    def _warn_of_doubts(self, run: Run | None) -> None:
        """Warn at the end of a run, or of a single step, of what makes it doubtful (collective)."""
        owner, every = self.trial.owner, []
        system = self.trial.solver.system
        if owner.at_rest and not self._told_of_locking:
            every.append(locking(owner.bodies, system.body_terms))
            self._told_of_locking = every[0] is not None
        if run is not None and run.adaptivity is not None:
            if (found := owner.history.steps[-1].error) is not None:
                every += [run.adaptivity.complaint(found), run.doubt]
        for sentence in every:
            if sentence is not None:
                warn(system.comm, sentence)

    def _try(
        self, run: Run, update: Path | None, control: DisplacementControl | None
    ) -> Step | None:
        """Try a step of a run; return it, or ``None`` where another one is to be tried.

        Raises:
            MPMError: The run cannot go on.
            BaseException: What a user's code has raised, or Ctrl-C.
        """
        trial = self.trial
        t, end = run.control.target, run.parameter
        goal = Goal(end, [], run.time, t == 1.0, run.control.lands)
        try:
            self._release.aim(run.remaining)
            if control is None:
                proportional = update is None and trial.converged.proportional
                set_load(trial.owner.bodies, run.aim, proportional)
            if update is not None:
                self._go_along(run, update)
            goal = goal._replace(values=trial.prescribed())
            step = trial.advance(goal, control, self._rejects(run, end))
        except Interrupted:
            trial.give_up()
            self._leave(update)
        except TRIAL_ERRORS as error:
            trial.take_back(run.size, end, str(error))
            if self._goes_on_after(error, run, end):
                return None
            limit = run.limit if trial.newton.gave_up else None
            told = trial.placed(error, limit)
            if self._mender is not None and self._mender.mend(told):
                run.control.begin_anew()
                return None
            trial.give_up(update)
            raise told from error.__cause__
        except MPMError as error:
            trial.give_up(update)
            raise trial.placed(error) from error.__cause__
        except BaseException:
            trial.give_up()
            raise
        if step is not None:
            run.control.accept(step.iterations)
            if run.adaptivity is not None:
                step = self._free_nodes(run.adaptivity, step, goal, update, control)
        return step

    def _go_along(self, run: Run, update: Path) -> None:
        """Let a path set loads; warn, once, where the load factor multiplies them besides."""
        owner, comm = self.trial.owner, self.trial.solver.system.comm
        grows, loads = run.end is None and run.aim < 1.0, self.trial.solver.system.loads
        before = _values(loads) if grows else []
        update(run.control.target if run.end is None else run.time)
        if not grows:
            return
        factor = float(owner.bodies[0].load.value)
        pairs = zip(before, _values(loads), strict=True)
        mine = factor == run.aim and any(not np.array_equal(*pair) for pair in pairs)
        if run.warned or not over_ranks(comm, mine, MPI.LOR):
            return
        run.warned = True
        warn(
            comm,
            f"update= sets loads, and the load factor multiplies them besides: it is {factor:.3g} "
            "in this step and goes to 1 by itself, as the loads had not been applied in full "
            "before this run. Set particles.load.value = 1 in update= if it says all of the loads, "
            "or apply the others by solve() first.",
        )

    def _goes_on_after(self, error: MPMError, run: Run, end: float) -> bool:
        """Return whether a step that has failed is tried again: of other nodes, or smaller."""
        trial = self.trial
        if trial.relieved(error):
            return True
        if not run.control.cut_back(trial.newton.gave_up):
            return False
        history = trial.owner.history
        history.cutbacks += 1
        tell(
            trial.solver.system.comm,
            STEPS,
            "cutback %d: the step to %.6g failed after %d iterations, half of it is tried",
            history.cutbacks,
            end,
            trial.newton.iterations,
        )
        return True

    def _free_nodes(
        self,
        adaptivity: Adaptivity,
        step: Step,
        goal: Goal,
        update: Path | None,
        control: DisplacementControl | None,
    ) -> Step:
        """Free nodes after a step, which finds a better equilibrium each time; return it.

        Where it finds none, nodes are what they were and the step is as it was.

        Raises:
            MPMError: The run cannot go on.
            BaseException: What a user's code has raised, or Ctrl-C.
        """
        trial = self.trial
        owner, steps = trial.owner, trial.owner.history.steps
        while True:  # (each time other nodes are freed, of which there are so many)
            try:
                with owner.history.statistics.phase("assemble"):
                    terms = trial.solver.system.body_terms
                    errors = estimated(owner.bodies, terms, trial.reduced)
            except ParticleOutsideError:  # as the last step of a run may leave them
                break
            steps[-1] = step = replace(step, error=errors.total(owner.bodies))
            assert trial.run is not None
            trial.run.doubt = errors.doubt
            chosen = adaptivity.chosen(owner.bodies, errors)
            if not chosen:
                break
            freed = trial.nodes.free(chosen)
            try:
                better = trial.advance(goal._replace(again=True), control)
            except Interrupted:
                trial.give_up()
                self._leave(update)
            except (*TRIAL_ERRORS, ParticleOutsideError) as error:
                trial.take_back(0.0, goal.parameter, str(error))
                trial.give_up(update)
                break
            except BaseException:
                trial.give_up()
                raise
            if better is None:
                break
            steps[-2:] = [
                step := replace(
                    better,
                    iterations=step.iterations + better.iterations,
                    alternations=step.alternations + better.alternations,
                    freed=step.freed + freed,
                )
            ]
        return step

    # -- A step ---------------------------------------------------------------------------

    def step(self) -> Step:
        """Make one increment to the present values: see :meth:`Problem.step`."""
        trial = self.trial
        owner, comm = trial.owner, trial.solver.system.comm
        with held() as hold:
            before = self.interrupted, trial.run, trial.converged.parameter
            time = owner.history.stage + 1.0
            self.resume(None)
            trial.converged.parameter = trial.converged.load
            try:
                load = float(owner.bodies[0].load.value)
                step = None
                while step is None:
                    self._release.aim(self._release.remaining)
                    set_load(owner.bodies, load, trial.converged.proportional)
                    try:
                        step = trial.advance(Goal(load, trial.prescribed(), time))
                    except TRIAL_ERRORS as error:
                        trial.go_back()
                        trial.miss()
                        if not trial.relieved(error):
                            raise
            except BaseException as error:
                trial.give_up()
                told = trial.placed(error) if isinstance(error, MPMError) else None
                self.interrupted, trial.run, trial.converged.parameter = before
                if isinstance(error, Interrupted):
                    self._leave()
                if told is None:
                    raise
                owner.history.failed_iterations += trial.newton.iterations
                raise told from error.__cause__
            self._end_step(None)
            first = load == 0.0 and len(owner.history.steps) == 1
            moved = any(np.any(body.displacement.x.array) for body in owner.bodies)
            if first and not over_ranks(comm, moved, MPI.LOR):
                warn(
                    comm,
                    "The step has moved nothing, at a load factor of 0, by which loads and "
                    "displacements of supports are multiplied; if these were to act, set "
                    "particles.load.value before, or apply them by solve().",
                )
            self._warn_of_doubts(None)
            if interrupted(comm):
                self._leave()
        if hold.left:
            raise KeyboardInterrupt
        return step

    def _rejects(self, run: Run, end: float) -> Callable[[float], bool] | None:
        """Return a function that takes converged steps back, if they are chosen by their errors.

        Args:
            run: The run.
            end: Load factor, parameter or displacement at the end of the step to try.
        """
        control, trial = run.control, self.trial
        if not isinstance(control, ErrorControl):
            return None
        comm = trial.solver.system.comm

        def rejects(size: float) -> bool:
            ratio = control.judge(error_of_step(trial.reduced, size, comm))
            tried = run.size
            if not control.reject():
                if (sentence := control.failure) is not None:
                    raise MPMError(sentence)
                if (sentence := control.complaint) is not None:
                    warn(comm, sentence)
                return False
            trial.take_back(
                tried, end, f"its error was estimated {ratio:.3g} times the allowed one"
            )
            trial.owner.history.statistics.count("rejected_steps")
            tell(
                comm,
                STEPS,
                "rejected: the step of %.6g to %.6g, with %.3g times the allowed error",
                tried,
                end,
                ratio,
            )
            return True

        return rejects

    def _end_step(self, repartition: float | None) -> None:
        """Do what is to be done between two steps (collective)."""
        self.trial.owner.end_step()
        if self._mender is not None:
            self._mender.after_step()
        if repartition is not None:
            self.trial.owner.repartition(repartition)

    def _leave(self, update: Path | None = None) -> NoReturn:
        """Obey Ctrl-C on all ranks, at the last converged step (collective)."""
        self.trial.follow_back(update)
        settle(self.trial.solver.system.comm)
        raise KeyboardInterrupt from None


def _control_of(steps: int | ErrorControl) -> Control:
    """Return the control that chooses the ends of steps."""
    if isinstance(steps, ErrorControl):
        return steps
    if isinstance(steps, int | np.integer) and steps >= 1 and not isinstance(steps, bool):
        return StepControl(int(steps))
    raise MPMError(f"steps must be a whole number from 1 on or 'auto', not {steps!r}.")


def _values(loads: Sequence[fem.Constant | fem.Function]) -> list[NDArray[np.float64]]:
    """Return copies of the values of loads on this rank."""
    return [np.array(f.x.array if isinstance(f, fem.Function) else f.value) for f in loads]
