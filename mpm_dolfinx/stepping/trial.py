# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A step that is tried: committed, or taken back to the last converged one."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, warn
from ..history import Attempt, History, Step
from ..log import STEPS, tell
from ..particles.particles import Particles
from ..solvers.newton import NewtonSolver
from ..system.conditions import dirichlet_values
from ..system.reduced import ReducedSystem
from .control import Converged, Progress, Run
from .diagnosis import count_folded, improper, placed
from .displacement_control import DisplacementControl
from .freeing import TriedNodes, carried_after, relieve
from .solving import Goal, StepSolver, System, set_load

__all__ = ["Owner", "Path", "Recorder", "Trial"]

type Path = Callable[[float], None]
"""A path of the user's: sets loads and conditions to their totals at t in (0, 1]."""


class Owner(Protocol):
    """Problem, as its load steps need it. All calls are collective.

    Attributes:
        bodies: The bodies.
        history: Where steps are written down.
    """

    bodies: list[Particles]
    history: History

    @property
    def at_rest(self) -> bool:
        """Whether a step ends in equilibrium."""

    def begin_step(self) -> None:
        """Take over what the user may change between two steps, if that is allowed."""

    def end_step(self) -> None:
        """Do what is to be done between two steps."""

    def repartition(self, threshold: float) -> bool:
        """Move particles to where they are best now; return whether any have moved."""

    def time_error(self, size: float) -> tuple[float | None, float | None]:
        """Return the error of a solved step by its duration, and the motion so far, if known."""


class Recorder(Protocol):
    """Follows the steps that a problem makes. All calls are collective."""

    def begins(self) -> None:
        """Look at the state that the run of a motion begins from, with its loads as they are."""

    def solved(self, trial: Trial) -> Callable[[], None]:
        """Look at a step that is solved, and not yet committed; leave all as it is.

        Args:
            trial: What has solved it.

        Returns:
            What is called when the step is committed.

        Raises:
            MPMError: The step cannot be followed; it is taken back then, and the run ends.
        """


class Trial:
    """Tries steps of a problem, and knows the last that has converged.

    It outlives the meshes of the bodies: :meth:`follow` gives it what the problem is solved by, at
    first and where that is made for other meshes.

    Args:
        owner: The problem, which is not kept alive.

    Attributes:
        converged: What is known of the last converged step.
        run: The run whose steps are tried, ``None`` for a step alone.
        nodes: Free nodes, as they are tried.
    """

    converged: Converged

    def __init__(self, owner: Owner) -> None:
        self._owner = weakref.ref(owner)
        self.run: Run | None = None
        self.nodes = TriedNodes(owner.bodies)
        self._solver: StepSolver | None = None
        self._recorders: list[weakref.ref[Recorder]] = []

    def progress(self) -> Progress:
        """Return how far the problem is, for a checkpoint."""
        return Progress(self.converged, self.newton.experience, self.run)

    def take(self, progress: Progress) -> None:
        """Go to where a problem has been, its bodies and histories being there (collective).

        The run is not taken over.
        """
        self.converged = progress.converged
        self.newton.experience = progress.experience
        self.reduced.unknowns.forget()
        self.go_back()

    def record(self, recorder: Recorder) -> None:
        """Let a recorder follow the steps from now on, as long as somebody keeps it."""
        self._recorders.append(weakref.ref(recorder))

    @property
    def recorders(self) -> list[Recorder]:
        """Those that follow the steps."""
        self._recorders = [known for known in self._recorders if known() is not None]
        return [found for known in self._recorders if (found := known()) is not None]

    def follow(self, system: System) -> None:
        """Take what the problem is solved by, and its present load for that of a converged step."""
        self._solver = StepSolver(system, self.owner.history)
        self.nodes = TriedNodes(system.bodies)
        first = system.bodies[0]
        load, proportional = float(first.load.value), bool(first.proportional.value)
        none = [np.zeros(len(field.bodies[0].increment.x.array)) for field in self.reduced.fields]
        self.converged = Converged(load, load, none, None, proportional)

    def release(self) -> None:
        """Let go of what :meth:`follow` has given; what PETSc holds is freed together later."""
        if self._solver is not None:
            clean_up = self._solver.system.clean_up
            self._solver = None
            clean_up.end()

    @property
    def owner(self) -> Owner:
        """The problem."""
        owner = self._owner()
        assert owner is not None
        return owner

    @property
    def solver(self) -> StepSolver:
        """Solver of steps on the present meshes."""
        assert self._solver is not None
        return self._solver

    @property
    def reduced(self) -> ReducedSystem:
        """Residual and tangent."""
        return self.solver.system.reduced

    @property
    def newton(self) -> NewtonSolver:
        """Newton's method, which finds a root of the residual."""
        return self.solver.system.newton

    def prescribed(self) -> list[NDArray[np.float64]]:
        """Return the Dirichlet totals at the end of the step to try, for each field (collective).

        They are those of the present values of the conditions.
        """
        totals = [dirichlet_values(field.prescribed, field.V) for field in self.reduced.fields]
        return totals if self.run is None else self.run.dirichlet_values(totals)

    # -- A step ---------------------------------------------------------------------------

    def advance(
        self,
        goal: Goal,
        control: DisplacementControl | None = None,
        rejects: Callable[[float], bool] | None = None,
    ) -> Step | None:
        """Solve one step, and commit it, or return ``None``: it is rejected.

        Unless it is the last one of a run, or alone, it must leave all particles inside the
        background.

        Args:
            goal: Where it goes.
            control: What is controlled.
            rejects: Takes a step back whose error is too large, given its size, and tells whether.
        """
        owner, solver, comm = self.owner, self.solver, self.solver.system.comm
        owner.begin_step()
        parameter, history = goal.parameter, owner.history
        losses = len(history.losses)
        size = 0.0 if goal.again else parameter - self.converged.parameter
        if control is not None and not goal.again:
            size = abs(parameter - control.present())
        experience = self.newton.experience
        turns = solver.solve(goal, size, control, self.converged, self.run is not None)
        if (failure := improper(owner.bodies, solver.system.points)) is not None:
            raise failure
        carried = carried_after(self._looked_after)
        if carried.too_late:
            self.take_back(size, parameter, "free nodes left the background")
            self.nodes.carry(carried)
            return None
        if rejects is not None and rejects(size):
            self.newton.experience = experience
            return None
        error, motion = owner.time_error(size)
        taken = [recorder.solved(self) for recorder in self.recorders]
        if control is not None:
            if not goal.again and (sentence := solver.jump(size, parameter)) is not None:
                warn(comm, sentence)
            parameter = float(owner.bodies[0].load.value)
            for term in solver.system.body_terms:
                term.begin()  # (loads are those before the factor was found yet)
        force = self.reduced.terms.size_of_forces() if owner.at_rest else None
        try:
            converged = solver.commit(goal, parameter)
        except BaseException:
            self.newton.experience = experience
            raise
        with history.statistics.phase("commit"):
            self.converged = converged
            if len(history.losses) == losses:
                converged.force = force
            self.reduced.end(goal.again)
            for take in taken:
                take()
            self.nodes.settle()
            carried.apply()
            count_folded(owner.bodies, history.statistics)
            solver.system.clean_up()
        step = Step(
            parameter,
            self.newton.iterations,
            list(self.newton.residuals),
            None if control is None else goal.parameter,
            goal.time,
            goal.output,
            alternations=turns,
            time_error=error,
            motion=motion,
        )
        history.steps.append(step)
        where = step.time if step.displacement is None else step.displacement
        tell(
            comm,
            STEPS,
            "step %d: %s, %d iterations, relative residual %.1e",
            len(history.steps),
            f"{'time' if step.displacement is None else 'displacement'} {where:.6g}",
            step.iterations,
            step.residuals[-1] if step.residuals else 0.0,
        )
        return step

    # -- Back -----------------------------------------------------------------------------

    def go_back(self, update: Path | None = None) -> None:
        """Return to the last converged step (collective).

        Args:
            update: A path of the user's, to be called with the parameter of that step.
        """
        for body in self.owner.bodies:
            body.roll_back()
        set_load(self.owner.bodies, self.converged.load, self.converged.proportional)
        self.reduced.terms.roll_back()
        self.follow_back(update)

    def follow_back(self, update: Path | None) -> None:
        """Let a path of the user's set what it does at the last converged step."""
        if update is not None and self.converged.parameter > 0.0:
            update(self.converged.parameter)

    def take_back(self, size: float, end: float, reason: str) -> None:
        """Return to the last converged step, and take note of what is lost (collective)."""
        self.go_back()
        self.miss()
        history, iterations = self.owner.history, self.newton.iterations
        history.failed_iterations += iterations
        history.taken_back.append(Attempt(end, size, iterations, reason))

    def miss(self) -> None:
        """Let bodies expect nothing in the next try of a step, as this one has failed."""
        for term in self.solver.system.body_terms:
            term.miss()

    def give_up(self, update: Path | None = None) -> None:
        """Return to the last converged step, and to the free nodes that it had (collective)."""
        self.nodes.put_back()
        self.go_back(update)

    def relieved(self, error: MPMError) -> bool:
        """Return whether free nodes that an error names are carried from now on (collective)."""
        return self.nodes.carry(relieve(self._looked_after, error))

    @property
    def _looked_after(self) -> list[Particles]:
        """Bodies with nodes that are free as long as the domains around them are good."""
        return self.nodes.looked_after(self.run is not None and self.run.adaptivity is not None)

    def placed(self, error: MPMError, limit: str | None = None) -> MPMError:
        """Return an error that says where and why its step failed (collective)."""
        newton, load = self.newton, self.converged.parameter
        return placed(error, self.reduced, load, limit, newton.flips, newton.unstable)
