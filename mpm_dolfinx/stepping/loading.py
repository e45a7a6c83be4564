# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps of a problem: tried, committed, or taken back and made smaller."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import NamedTuple, NoReturn, Protocol

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import (
    TRIAL_ERRORS,
    ConvergenceError,
    MPMError,
    ParticleOutsideError,
)
from ..history import Attempt, History, Step
from ..log import NEWTON, STEPS, tell
from ..parallel.boundary import of_user
from ..parallel.garbage import Cleaner
from ..parallel.interruption import Hold, Interrupted, held, interrupted, settle
from ..parallel.totals import over_ranks
from ..particles.particles import Particles
from ..solvers.newton import NewtonSolver
from ..solvers.problem import ReducedProblem
from ..system.body import BodyTerm
from ..system.conditions import dirichlet_values
from ..system.errors import estimated
from ..system.reduced import ReducedSystem
from ..system.release import Release
from ..tolerances import SMALL
from .adaptivity import Adaptivity
from .automatic import ErrorControl, error_of_step
from .control import Control, Converged, Progress, Run, StepControl
from .diagnosis import count_folded, placed
from .displacement_control import ControlledSystem, DisplacementControl
from .freeing import Carried, carried_after, relieve
from .leaving import may_stop, move_bodies

__all__ = ["Mender", "Owner", "Recorder", "Stepper"]

#: What an alternation may leave of the residual that it begins with.
INEXACT = 0.1
#: How much farther a body may move for the same controlled displacement than in the step before.
JUMP = 10.0
#: Alternations after which a step is given up.
MOST_ALTERNATIONS = 5000
#: How often nodes are freed at the end of a step.
MOST_FREED = 10

type Path = Callable[[float], None]
"""A path of the user's: sets loads and conditions to their totals at t in (0, 1]."""


class Owner(Protocol):
    """Problem, as its load steps need it. All calls are collective."""

    bodies: list[Particles]
    body_terms: list[BodyTerm]
    history: History

    def masses(self, number: int) -> NDArray[np.float64] | None:
        """Return the mass of each particle of a body that this rank owns, if it is known."""

    def begin_step(self) -> None:
        """Take over what the user may change between two steps, if that is allowed."""

    def improper(self) -> MPMError | None:
        """Return why the domains as they are now cannot be those of a converged step."""

    def end_step(self) -> None:
        """Do what is to be done between two steps."""

    def mend(self, error: MPMError) -> bool:
        """Change what made the smallest step fail; return whether to go on."""

    def repartition(self, threshold: float) -> bool:
        """Move particles to where they are best now; return whether any have moved."""

    def warn(self, sentence: str) -> None:
        """Warn the user, on one rank."""

    def loads(self) -> Sequence[fem.Constant | fem.Function]:
        """Return the loads that the load factor multiplies and the user may change."""

    def forces_of_supports(self) -> list[NDArray[np.float64]]:
        """Return the forces of the supports that it was given, by what is set now."""

    def size_of_forces(self) -> float | None:
        """Return the size of the forces on nodes in the last evaluation, if they tell an error."""


class Mender(Protocol):
    """Changes of the bodies' meshes between steps. All calls are collective."""

    def after_step(self) -> None:
        """Look at what a converged step has made of the domains."""

    def mend(self, error: MPMError) -> bool:
        """Change what made the smallest step fail; return whether to go on."""


class Recorder(Protocol):
    """Follows the steps that a problem makes. All calls are collective."""

    def begins(self) -> None:
        """Look at the state that the run of a motion begins from, with its loads as they are."""

    def solved(self, stepper: Stepper) -> Callable[[], None]:
        """Look at a step that is solved, and not yet committed; leave all as it is.

        Args:
            stepper: What has solved it.

        Returns:
            What is called when the step is committed.

        Raises:
            MPMError: The step cannot be followed; it is taken back then, and the run ends.
        """


class Goal(NamedTuple):
    """Where a step goes.

    Attributes:
        parameter: Load factor, parameter of the path or, if that is controlled, displacement.
        values: Dirichlet totals, for each field.
        time: Time at its end.
        last: Whether it is the last of a run, or alone: it may take particles off the background.
        output: Whether it ends at a level that was asked for.
        again: Whether the step before has ended there, and this one corrects it.
    """

    parameter: float
    values: list[NDArray[np.float64]]
    time: float
    last: bool = True
    output: bool = True
    again: bool = False


class Stepper:
    """Takes a problem from one converged step to the next.

    It outlives the meshes of the bodies: :meth:`follow` gives it what the problem is solved by, at
    first and where that is made for other meshes.

    Args:
        owner: The problem, which is not kept alive.
        release: Holds back what a stage changes at once.
        mender: What changes meshes between steps, if anything.

    Attributes:
        converged: What is known of the last converged step.
        run: The run that was begun last, ``None`` after its end.
        newton: What finds a root of the residual.
    """

    def __init__(self, owner: Owner, release: Release, mender: Mender | None = None) -> None:
        self._owner = weakref.ref(owner)
        self._release = release
        self._mender = mender
        self.run: Run | None = None
        #: Free nodes of the last converged step, where others are tried since.
        self._free: list[tuple[Particles, NDArray[np.bool_], NDArray[np.bool_]]] = []
        self._resumes = self._follows = self._begins = False
        self._moved: float | None = None
        self._recorders: list[weakref.ref[Recorder]] = []

    def record(self, recorder: Recorder) -> None:
        """Let a recorder follow the steps from now on, as long as somebody keeps it."""
        self._recorders.append(weakref.ref(recorder))

    @property
    def recorders(self) -> list[Recorder]:
        """Those that follow the steps."""
        self._recorders = [known for known in self._recorders if known() is not None]
        return [found for known in self._recorders if (found := known()) is not None]

    def follow(self, reduced: ReducedSystem, newton: NewtonSolver, clean_up: Cleaner) -> None:
        """Take what the problem is solved by, and its present load for that of a converged step.

        Args:
            reduced: Residual and tangent.
            newton: What finds a root of the residual.
            clean_up: Frees what is out of use.
        """
        self._reduced, self.newton, self._clean_up = reduced, newton, clean_up
        self._follows, self._free = True, []
        first = self.owner.bodies[0]
        load = float(first.load.value)
        none = [np.zeros(len(field.bodies[0].increment.x.array)) for field in reduced.fields]
        self.converged = Converged(load, load, none, None, bool(first.proportional.value))

    def release(self) -> None:
        """Let go of what :meth:`follow` has given; what PETSc holds is freed together later."""
        if self._follows:
            del self._reduced, self.newton
            self._clean_up.end()
        self._follows = False

    @property
    def owner(self) -> Owner:
        """The problem."""
        owner = self._owner()
        assert owner is not None
        return owner

    @property
    def reduced(self) -> ReducedSystem:
        """Residual and tangent."""
        return self._reduced

    @property
    def _comm(self) -> MPI.Comm:
        comm: MPI.Comm = self.owner.bodies[0].V.mesh.comm
        return comm

    @property
    def share(self) -> float:
        """How much of the run is done."""
        return 1.0 if self.run is None else self.run.control.share

    def progress(self) -> Progress:
        """Return how far the problem is, for a checkpoint."""
        return Progress(self.converged, self.newton.experience, self.run)

    def take(self, progress: Progress) -> None:
        """Go to where a problem has been, its bodies and histories being there (collective).

        The run is not taken over: see :meth:`resume`.
        """
        self.converged = progress.converged
        self.newton.experience = progress.experience
        self._reduced.unknowns.forget()
        self.go_back()

    def resume(self, run: Run | None) -> None:
        """Let the next run be one that was interrupted, or a new one."""
        self.run, self._resumes = run, run is not None

    def begin_stage(self) -> None:
        """Let the next run be one of a new stage, which may begin at the whole load."""
        self.run, self._resumes, self._begins = None, False, True
        for known, field in zip(self.converged.prescribed, self._reduced.fields, strict=True):
            held = np.zeros(len(known), dtype=bool)
            for bc in field.conditions:
                held[bc.dof_indices()[0]] = True
            known[~held] = 0.0

    def steps(
        self,
        steps: int | ErrorControl,
        update: Path | None,
        repartition: float | None,
        control: DisplacementControl | None,
        span: tuple[float, float] | None = None,
        adaptivity: Adaptivity | None = None,
    ) -> Iterator[Step]:
        """Apply the whole load: see :meth:`Problem.steps`.

        Args:
            steps: As there; ``"auto"`` with what goes with it is an :class:`ErrorControl`.
            update: As there; through time it is called with the time.
            repartition: As there.
            control: As there.
            span: Times at beginning and end; ``None``: not through time.
            adaptivity: Frees nodes at the end of steps; ``None``: nothing does.
        """
        return self._steps(self.owner, steps, update, repartition, control, span, adaptivity)

    @property
    def interrupted(self) -> Run | None:
        """The run that a checkpoint interrupted, if the next one is to go on with it."""
        return self.run if self._resumes else None

    def _steps(
        self,
        owner: Owner,  # which the iterator keeps alive
        steps: int | ErrorControl,
        update: Path | None,
        repartition: float | None,
        control: DisplacementControl | None,
        span: tuple[float, float] | None,
        adaptivity: Adaptivity | None,
    ) -> Iterator[Step]:
        if isinstance(steps, ErrorControl):
            chosen: Control = steps
        elif isinstance(steps, int | np.integer) and steps >= 1 and not isinstance(steps, bool):
            chosen = StepControl(int(steps))
        else:
            raise MPMError(f"steps must be a whole number from 1 on or 'auto', not {steps!r}.")
        if update is not None:
            if not callable(update):
                raise MPMError(f"update= is a function of t, not {update!r}.")
            update = of_user(self._comm, update)
        if control is not None and not isinstance(control, DisplacementControl):
            raise MPMError(f"control= is a DisplacementControl, not {control!r}.")
        comm = self._comm
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
                        owner.warn(f"The run stopped. {told!s}")
                        return
                    if step is not None:
                        self._end_step(owner)
                        if repartition is not None:
                            owner.repartition(repartition)
                last = now
                if step is not None:
                    yield step
                    self._require_governing(run)
            self.run = None
            self._warn_of_outside()
            if adaptivity is not None and (found := owner.history.steps[-1].error) is not None:
                if (sentence := adaptivity.complaint(found)) is not None:
                    owner.warn(sentence)
            if interrupted(comm, last.left):
                self._leave()
        if hold.left:
            raise KeyboardInterrupt

    def _require_governing(self, run: Run) -> None:
        """Raise an error where something else was begun between two steps of a run."""
        if self.run is not run:
            raise MPMError(
                "This run cannot go on: a step, a stage or another run was begun, or a checkpoint "
                "restored, between two of its steps; leave its loop before."
            )

    def _try(
        self, run: Run, update: Path | None, control: DisplacementControl | None
    ) -> Step | None:
        """Try a step of a run; return it, or ``None`` where another one is to be tried.

        Raises:
            MPMError: The run cannot go on.
            BaseException: What a user's code has raised, or Ctrl-C.
        """
        owner = self.owner
        t, end = run.control.target, run.parameter
        goal = Goal(end, [], run.time, t == 1.0, run.control.lands)
        try:
            self._release.aim(run.remaining)
            if control is None:
                self._set_load(run.aim, update is None and self.converged.proportional)
            if update is not None:
                grows = run.end is None and run.aim < 1.0
                before = _values(owner.loads()) if grows else []
                update(t if run.end is None else run.time)
                if grows:
                    self._look_at_loads(owner, run, before)
            goal = goal._replace(values=self.prescribed())
            step = self._advance(goal, run, control)
        except Interrupted:
            self._give_up()
            self._leave(update)
        except TRIAL_ERRORS as error:
            self._take_back(run.size, end, str(error))
            if self._carry(relieve(self._looked_after, error)):
                return None
            gave_up = self.newton.gave_up
            if run.control.cut_back(gave_up):
                owner.history.cutbacks += 1
                tell(
                    self._comm,
                    STEPS,
                    "cutback %d: the step to %.6g failed after %d iterations, half of it is tried",
                    owner.history.cutbacks,
                    end,
                    self.newton.iterations,
                )
                return None
            limit = run.limit if gave_up else None
            told = self._placed(error, self.converged.parameter, limit)
            if owner.mend(told) or (self._mender is not None and self._mender.mend(told)):
                run.control.begin_anew()
                return None
            self._give_up(update)
            raise told from error.__cause__
        except MPMError as error:
            self._give_up(update)
            told = self._placed(error, self.converged.parameter)
            raise told from error.__cause__
        except BaseException:
            self._give_up()
            raise
        if step is not None:
            run.control.accept(step.iterations)
            if run.adaptivity is not None:
                step = self._free_nodes(run.adaptivity, step, goal, update, control)
        return step

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
        owner, steps = self.owner, self.owner.history.steps
        for tries in range(MOST_FREED + 1):
            try:
                with owner.history.statistics.phase("assemble"):
                    errors = estimated(owner.bodies, owner.body_terms, self._reduced)
            except ParticleOutsideError:  # as the last step of a run may leave them
                break
            steps[-1] = step = replace(step, error=errors.total(owner.bodies))
            chosen = adaptivity.chosen(owner.bodies, errors)
            if not chosen or tries == MOST_FREED:
                break
            before = self._count_free()
            self._keep_free()
            for body, free in chosen:
                assert body.free_nodes is not None
                body.choose_free(free, body.free_nodes.spent)
            freed = self._count_free() - before
            try:
                better = self._advance(goal._replace(again=True), None, control)
            except Interrupted:
                self._give_up()
                self._leave(update)
            except (*TRIAL_ERRORS, ParticleOutsideError) as error:
                self._take_back(0.0, goal.parameter, str(error))
                self._give_up(update)
                break
            except BaseException:
                self._give_up()
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

    def _count_free(self) -> int:
        """Return the number of free nodes of all bodies that may have others too (collective)."""
        own = [
            int(body.free[: body.W.dofmap.index_map.size_local].sum())
            for body in self.owner.bodies
            if body.free_nodes is not None
        ]
        return int(self._comm.allreduce(sum(own)))

    def _placed(self, error: MPMError, reached: float, limit: str | None = None) -> MPMError:
        """Return an error that says where and why its step failed (collective)."""
        return placed(error, self._reduced, reached, limit, self.newton.flips)

    def _take_back(self, size: float, end: float, reason: str) -> None:
        """Return to the last converged step, and take note of what is lost (collective)."""
        self.go_back()
        self._miss()
        history, iterations = self.owner.history, self.newton.iterations
        history.failed_iterations += iterations
        history.taken_back.append(Attempt(end, size, iterations, reason))

    def _reject(self, run: Run, size: float, end: float) -> bool:
        """Take a converged step back whose error is too large, if steps are chosen by it.

        Args:
            run: The run.
            size: Size of the step, as it was begun.
            end: Load factor, parameter or displacement at its end.
        """
        control = run.control
        if not isinstance(control, ErrorControl):
            return False
        ratio = control.judge(error_of_step(self._reduced, size, self._comm))
        tried = run.size
        if not control.reject():
            if (sentence := control.complaint) is not None:
                self.owner.warn(sentence)
            return False
        self._take_back(tried, end, f"its error was estimated {ratio:.3g} times the allowed one")
        self.owner.history.statistics.count("rejected_steps")
        tell(
            self._comm,
            STEPS,
            "rejected: the step of %.6g to %.6g, with %.3g times the allowed error",
            tried,
            end,
            ratio,
        )
        return True

    def _leave(self, update: Path | None = None) -> NoReturn:
        """Obey Ctrl-C on all ranks, at the last converged step (collective)."""
        self._follow_back(update)
        settle(self._comm)
        raise KeyboardInterrupt from None

    def step(self) -> Step:
        """Make one increment to the present values: see :meth:`Problem.step`."""
        owner = self.owner
        with held() as hold:
            before = self.run, self.converged.parameter
            time = owner.history.stage + 1.0
            self.run, self.converged.parameter = None, self.converged.load
            try:
                load = float(owner.bodies[0].load.value)
                step = None
                while step is None:
                    self._release.aim(self._release.remaining)
                    self._set_load(load, self.converged.proportional)
                    try:
                        step = self._advance(Goal(load, self.prescribed(), time))
                    except TRIAL_ERRORS as error:
                        self.go_back()
                        self._miss()
                        if not self._carry(relieve(self._looked_after, error)):
                            raise
            except BaseException as error:
                self._give_up()
                reached = self.converged.parameter
                self.run, self.converged.parameter = before
                if isinstance(error, Interrupted):
                    self._leave()
                if not isinstance(error, MPMError):
                    raise
                owner.history.failed_iterations += self.newton.iterations
                raise self._placed(error, reached) from error.__cause__
            self._end_step(owner)
            if interrupted(self._comm):
                self._leave()
        if hold.left:
            raise KeyboardInterrupt
        return step

    def go_back(self, update: Path | None = None) -> None:
        """Return to the last converged step (collective).

        Args:
            update: A path of the user's, to be called with the parameter of that step.
        """
        for body in self.owner.bodies:
            body.roll_back()
        self._set_load(self.converged.load, self.converged.proportional)
        self._reduced.terms.roll_back()
        self._follow_back(update)

    def _miss(self) -> None:
        """Let bodies expect nothing in the next try of a step, as this one has failed."""
        for term in self.owner.body_terms:
            term.miss()

    def _carry(self, carried: Carried) -> bool:
        """Carry free nodes before a step is tried again; return whether any are (collective)."""
        if carried.free:
            self._keep_free()
        carried.apply()
        return bool(carried.free)

    def _keep_free(self) -> None:
        """Note which nodes are free, unless that is done since the last converged step."""
        if not self._free:
            self._free = [
                (body, body.free_nodes.chosen, body.free_nodes.spent)
                for body in self.owner.bodies
                if body.free_nodes is not None
            ]

    @property
    def _looked_after(self) -> list[Particles]:
        """Bodies with nodes that are free as long as the domains around them are good."""
        adapts = self.run is not None and self.run.adaptivity is not None
        return [
            body
            for body in self.owner.bodies
            if body.frees_by_itself or (adapts and body.free_nodes is not None)
        ]

    def _give_up(self, update: Path | None = None) -> None:
        """Return to the last converged step, and to the free nodes that it had (collective)."""
        for body, free, spent in self._free:
            body.choose_free(free, spent)
        self._free = []
        self.go_back(update)

    def _follow_back(self, update: Path | None) -> None:
        """Let a path of the user's set what it does at the last converged step."""
        if update is not None and self.converged.parameter > 0.0:
            update(self.converged.parameter)

    def _begin(
        self,
        steps: Control,
        update: Path | None,
        control: DisplacementControl | None,
        span: tuple[float, float] | None,
        adaptivity: Adaptivity | None,
    ) -> Run:
        """Return a new run, or the one that a checkpoint interrupted."""
        goal = self._moved = None
        if control is not None:
            control.require_for(self.owner.bodies, update is not None)
            goal = control.value
        if self._resumes and self.run is not None:
            end = None if span is None else span[1]
            self.run.require(steps, update is not None, goal, end, adaptivity)
            self._resumes = False
            return self.run
        start = self.converged.load if control is None else control.present()
        done = self.converged.load >= 1.0 and self._release.remaining == 0.0
        if control is None and update is None and done and not self._begins:
            raise MPMError(
                "The whole load is applied already; go on with problem.step() or with a path "
                "(update=...)."
            )
        if start == goal:
            raise MPMError("The controlled displacement has its value already.")
        self._begins = False
        self._reduced.predictor.clear(isinstance(steps, ErrorControl))
        base = [values.copy() for values in self.converged.prescribed]
        began = self.owner.history.stage
        end = None
        if span is not None:
            began, end = span
            self.converged.parameter = began
        self.run = Run(
            steps,
            update is not None,
            start,
            base,
            goal,
            began,
            end,
            self._release.remaining,
            adaptivity=adaptivity,
        )
        if span is None:
            self.converged.parameter = 0.0 if self.run.shares else self.converged.load
        return self.run

    def _advance(
        self, goal: Goal, run: Run | None = None, control: DisplacementControl | None = None
    ) -> Step | None:
        """Solve one step, and commit it, or return ``None``: it is rejected.

        Unless it is the last one of a run, or alone, it must leave all particles inside the
        background.

        Args:
            goal: Where it goes.
            run: The run by whose control it may be rejected, if any.
            control: What is controlled.
        """
        owner, reduced = self.owner, self._reduced
        owner.begin_step()
        parameter, losses = goal.parameter, len(owner.history.losses)
        size = 0.0 if goal.again else parameter - self.converged.parameter
        if control is not None and not goal.again:
            size = abs(parameter - control.present())
        displacement = None if control is None else parameter
        experience = self.newton.experience
        alternations = self._find_equilibrium(goal, size, control)
        if (failure := owner.improper()) is not None:
            raise failure
        carried = carried_after(self._looked_after)
        if carried.too_late:
            self._take_back(size, parameter, "free nodes left the background")
            self._carry(carried)
            return None
        if run is not None and self._reject(run, size, parameter):
            self.newton.experience = experience
            return None
        taken = [recorder.solved(self) for recorder in self.recorders]
        if control is not None:
            if not goal.again:
                self._look_for_jump(owner, size, parameter)
            parameter = float(owner.bodies[0].load.value)
        force = owner.size_of_forces()
        before = [body.converged_displacement for body in owner.bodies]
        move_bodies(owner.bodies, owner.history, owner.masses, parameter, goal.last)
        with owner.history.statistics.phase("commit"):
            try:
                reduced.terms.commit()
            except BaseException:
                for body, converged in zip(owner.bodies, before, strict=True):
                    body.restore(converged.reshape(-1, body.mesh.geometry.dim))
                self.newton.experience = experience
                raise
            load = float(owner.bodies[0].load.value)
            reactions = [force.array_r.copy() for force in reduced.unknowns.forces]
            prescribed = [total.copy() for total in goal.values]
            proportional = bool(owner.bodies[0].proportional.value)
            self.converged = Converged(
                load, parameter, prescribed, reactions, proportional, reduced.balance.followed()
            )
            self.converged.supports = owner.forces_of_supports()
            if len(owner.history.losses) == losses:
                self.converged.force = force
            reduced.end(goal.again)
            for take in taken:
                take()
            self._free = []
            carried.apply()
            count_folded(owner.bodies, owner.history.statistics)
            self._clean_up()
        newton = self.newton
        residuals = list(newton.residuals)
        step = Step(
            parameter,
            newton.iterations,
            residuals,
            displacement,
            goal.time,
            goal.output,
            alternations=alternations,
        )
        owner.history.steps.append(step)
        tell(
            self._comm,
            STEPS,
            "step %d: %s, %d iterations, relative residual %.1e",
            len(owner.history.steps),
            f"time {step.time:.6g}" if displacement is None else f"displacement {displacement:.6g}",
            step.iterations,
            step.residuals[-1] if step.residuals else 0.0,
        )
        return step

    def _find_equilibrium(
        self,
        goal: Goal,
        size: float,
        control: DisplacementControl | None,
    ) -> int:
        """Solve one step from where it is expected to end, or else from where it begins.

        A prediction from which Newton's method fails is not the start of a second attempt, nor is
        the step made smaller for it: most of what fails is near a solution that the prediction is
        far from.

        Returns:
            How often equations of terms were solved in turn with the displacements.
        """
        reduced, newton, again = self._reduced, self.newton, False
        before = self.converged.prescribed
        changes = [new - old for new, old in zip(goal.values, before, strict=True)]
        while True:
            newton.forget()
            reduced.begin(changes, size, before)
            system: ReducedProblem = reduced
            if control is not None:
                system = ControlledSystem(reduced, control, goal.parameter, self.owner.bodies)
            try:
                newton.solve(system, reduced.unknowns.sizes, self.run is not None, again)
                return self._alternate()
            except TRIAL_ERRORS:
                if again or not newton.has_another_way:
                    raise
            again = True
            self.owner.history.failed_iterations += newton.iterations
            self.owner.history.statistics.count("second_attempts")
            for body in self.owner.bodies:
                body.roll_back()
            if control is not None:
                self._set_load(self.converged.load, self.converged.proportional)
            reduced.terms.roll_back()
            self._miss()

    def _look_for_jump(self, owner: Owner, size: float, displacement: float) -> None:
        """Warn where a body has moved much farther than its controlled displacement (collective).

        Args:
            owner: The problem.
            size: How far that has moved in the step.
            displacement: Its value.
        """
        assert self.newton.x is not None
        moved, before = self._reduced.resistance.motion(self.newton.x) / size, self._moved
        self._moved = moved
        if before is not None and moved > JUMP * before:
            owner.warn(
                f"In the step to a controlled displacement of {displacement:.6g} the body moved "
                f"{moved / before:.3g} times as far for it as in the step before: it has jumped to "
                "another state, between which and the last one the displacement went back. Control "
                "one that grows all the way, such as the opening of a crack."
            )

    def _alternate(self) -> int:
        """Solve equations of terms in turn with the displacements, until all hold together.

        Returns:
            How often it did.
        """
        terms, newton = self._reduced.terms, self.newton
        if not terms.alternates:
            return 0
        for number in range(1, MOST_ALTERNATIONS + 1):
            with self.owner.history.statistics.phase("solve"):
                self.owner.history.statistics["field_solves"] += terms.take_turns()
            self.owner.history.statistics.count("alternations")
            left = newton.unbalanced()
            tell(self._comm, NEWTON, "  alternation %d: residual %.2e", number, left)
            if left <= SMALL:
                newton.residuals.append(left)
                return number
            newton.go_on(INEXACT)
        raise ConvergenceError(
            f"Displacements and other fields were not in equilibrium with each other after "
            f"{MOST_ALTERNATIONS} alternations: {left:.1e} of the forces were left"
        )

    def _look_at_loads(self, owner: Owner, run: Run, before: Sequence[NDArray[np.float64]]) -> None:
        """Warn where a path has set loads that the load factor multiplies besides (collective).

        Args:
            owner: The problem.
            run: The run, which warns once.
            before: Values of loads before the path was asked.
        """
        factor = float(owner.bodies[0].load.value)
        pairs = zip(before, _values(owner.loads()), strict=True)
        mine = factor == run.aim and any(not np.array_equal(*pair) for pair in pairs)
        if run.warned or not over_ranks(self._comm, mine, MPI.LOR):
            return
        run.warned = True
        owner.warn(
            f"update= sets loads, and the load factor multiplies them besides: it is {factor:.3g} "
            "in this step and goes to 1 by itself, as the loads had not been applied in full "
            "before this run. Set particles.load.value = 1 in update= if it says all of the loads, "
            "or apply the others by solve() first."
        )

    def _end_step(self, owner: Owner) -> None:
        owner.end_step()
        if self._mender is not None:
            self._mender.after_step()

    def prescribed(self) -> list[NDArray[np.float64]]:
        """Return the Dirichlet totals at the end of the step to try, for each field (collective).

        They are those of the present values of the conditions.
        """
        totals = [dirichlet_values(field.conditions, field.V) for field in self._reduced.fields]
        return totals if self.run is None else self.run.dirichlet_values(totals)

    def _set_load(self, load: float, proportional: bool) -> None:
        """Set the load factor, and whether supports move in proportion to it or to totals."""
        for body in self.owner.bodies:
            np.copyto(body.load.value, load)
            np.copyto(body.proportional.value, float(proportional))

    def _warn_of_outside(self) -> None:
        """Say so where the last step, which is converged, took particles off the background."""
        try:
            with self.owner.history.statistics.phase("locate"):
                for body in self.owner.bodies:
                    body.locate()
        except ParticleOutsideError as error:
            told = str(error)
            self.owner.warn(f"The run is complete, but {told[0].lower()}{told[1:]}")


def _values(loads: Sequence[fem.Constant | fem.Function]) -> list[NDArray[np.float64]]:
    """Return copies of the values of loads on this rank."""
    return [np.array(f.x.array if isinstance(f, fem.Function) else f.value) for f in loads]
