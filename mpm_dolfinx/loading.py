# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps of a problem: tried, committed, or taken back and made smaller."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .bodies import dirichlet_values, may_stop, move_bodies
from .diagnosis import placed
from .displacement_control import ControlledSystem, DisplacementControl
from .errors import (
    ConvergenceError,
    DomainDistortionError,
    MPMError,
    ParticleOutsideError,
    on_all_ranks,
)
from .history import Step
from .solver import ReducedProblem
from .stepping import Run, StepControl

if TYPE_CHECKING:
    from .problem import ParticleProblem

__all__ = ["Converged", "go_back", "load_steps", "single_step"]


@dataclass
class Converged:
    """What a problem knows of the last converged step besides its bodies and their histories.

    Attributes:
        load: Load factor.
        parameter: Load factor, or parameter of the path.
        prescribed: Dirichlet values, on the local dofs of V.
        reactions: Residual on this rank's own dofs of V (at supports, their force); ``None``
            where there was no step.
    """

    load: float
    parameter: float
    prescribed: NDArray[np.float64]
    reactions: NDArray[np.float64] | None = None


def load_steps(
    problem: ParticleProblem,
    steps: int,
    update: Callable[[float], None] | None,
    repartition: float | None,
    control: DisplacementControl | None,
) -> Iterator[Step]:
    """Apply the whole load: see :meth:`ParticleProblem.steps`."""
    if not isinstance(steps, int | np.integer) or steps < 1:
        raise MPMError(f"The number of steps must be a whole number from 1 on, not {steps!r}.")
    if update is not None:
        update = on_all_ranks(problem._comm, update)
    if control is not None and not isinstance(control, DisplacementControl):
        raise MPMError(f"control= is a DisplacementControl, not {control!r}.")
    run = _begin_run(problem, int(steps), update, control)
    may_split = any(body.on_distortion == "split" for body in problem.bodies)
    if control is not None and (repartition is not None or may_split):
        control.require_movable()
    while not run.control.finished:
        t, end = run.control.target, run.parameter
        try:
            if control is None:
                _set_load(problem, end)
            if update is not None:
                _follow(problem, update, t)
            values = run.dirichlet_values(dirichlet_values(problem.bcs, problem.bodies[0].V))
            step = _advance(problem, end, values, t == 1.0, control)
        except (ConvergenceError, DomainDistortionError) as error:
            go_back(problem)
            problem.history.failed_iterations += problem._newton.iterations
            no_equilibrium = problem._newton.no_equilibrium
            if not run.control.cut_back(no_equilibrium):
                limit = run.limit if no_equilibrium else None
                told = placed(error, problem.reduced, problem._converged.parameter, limit)
                if problem.mend(told):
                    run.control.begin_anew()
                    continue
                go_back(problem, update)
                raise told from error.__cause__
            problem.history.cutbacks += 1
            continue
        except MPMError as error:
            go_back(problem, update)
            told = placed(error, problem.reduced, problem._converged.parameter)
            if may_stop(problem.bodies) and isinstance(told, ParticleOutsideError):
                problem.history.stopped = told
                problem.warn(f"The run stopped. {told!s}")
                return
            raise told from error.__cause__
        run.control.accept(step.iterations)
        problem.end_step()
        if repartition is not None:
            problem.repartition(repartition)
        yield step
    problem._run = None
    _warn_of_outside(problem)


def single_step(problem: ParticleProblem) -> Step:
    """Make one increment to the present values: see :meth:`ParticleProblem.step`."""
    problem._run = None
    try:
        load = float(problem.bodies[0].load.value)
        _set_load(problem, load)
        values = dirichlet_values(problem.bcs, problem.bodies[0].V)
        step = _advance(problem, load, values, last=True)
    except MPMError as error:
        go_back(problem)
        problem.history.failed_iterations += problem._newton.iterations
        raise placed(error, problem.reduced, problem._converged.parameter) from error.__cause__
    problem.end_step()
    return step


def go_back(problem: ParticleProblem, update: Callable[[float], None] | None = None) -> None:
    """Return to the last converged step.

    Args:
        problem: The problem.
        update: A path of the user's, to be called with the parameter of that step.
    """
    for body in problem.bodies:
        body.roll_back()
    for share in problem.shares:
        share.forms.update_average()
    _set_load(problem, problem._converged.load)
    problem.roll_back()
    if update is not None and problem._converged.parameter > 0.0:
        update(problem._converged.parameter)


def _begin_run(
    problem: ParticleProblem,
    steps: int,
    update: Callable[[float], None] | None,
    control: DisplacementControl | None,
) -> Run:
    """Return a new run, or the one that a checkpoint interrupted."""
    goal = None
    if control is not None:
        control.require_for(problem.bodies, update is not None)
        goal = control.value
    if problem._resume and problem._run is not None:
        problem._run.require(steps, update is not None, goal)
        problem._resume = False
        return problem._run
    start = problem._converged.load if control is None else control.present()
    if control is None and update is None and problem._converged.load >= 1.0:
        raise MPMError(
            "The whole load is applied already; go on with problem.step() or with a path "
            "(update=...)."
        )
    if start == goal:
        raise MPMError("The controlled displacement has its value already.")
    if update is not None:
        problem._converged.parameter = 0.0
    if problem.reduced.predictor is not None:
        problem.reduced.predictor.clear()
    base = problem._converged.prescribed.copy()
    problem._run = Run(StepControl(steps), update is not None, start, base, goal)
    return problem._run


def _advance(
    problem: ParticleProblem,
    parameter: float,
    values: NDArray[np.float64],
    last: bool,
    control: DisplacementControl | None = None,
) -> Step:
    """Solve one step to Dirichlet totals, and commit it.

    Unless it is the last one it must leave all particles inside the background. Under
    displacement control the parameter is the displacement.
    """
    size = parameter - problem._converged.parameter
    if control is not None:
        size = abs(parameter - control.present())
    problem.reduced.begin(values - problem._converged.prescribed, size)
    system: ReducedProblem = problem.reduced
    displacement = None
    if control is not None:
        system = ControlledSystem(problem.reduced, control, parameter, problem.bodies)
        displacement = parameter
    problem._newton.solve(system, problem.reduced.sizes)
    if (failure := problem.reduced.crossed()) is not None:
        raise failure
    if control is not None:
        parameter = float(problem.bodies[0].load.value)
    move_bodies(problem.bodies, problem.history, problem._masses, parameter, last)
    with problem.history.statistics.phase("commit"):
        problem.commit()
        load = float(problem.bodies[0].load.value)
        reactions = problem.reduced.force.array_r.copy()
        problem._converged = Converged(load, parameter, values.copy(), reactions)
        problem.reduced.end()
        problem.reduced.count_folded()
        problem._clean_up()
    newton = problem._newton
    step = Step(parameter, newton.iterations, list(newton.residuals), displacement)
    problem.history.steps.append(step)
    return step


def _set_load(problem: ParticleProblem, load: float) -> None:
    for body in problem.bodies:
        np.copyto(body.load.value, load)


def _follow(problem: ParticleProblem, update: Callable[[float], None], t: float) -> None:
    """Set the values of a path; where that fails the load is that before the step."""
    try:
        update(t)
    except Exception as error:
        if not isinstance(error, MPMError):
            go_back(problem)
        raise


def _warn_of_outside(problem: ParticleProblem) -> None:
    """Say so where the last step, which is converged, took particles off the background."""
    try:
        with problem.history.statistics.phase("locate"):
            for body in problem.bodies:
                body.locate()
    except ParticleOutsideError as error:
        told = str(error)
        problem.warn(f"The run is complete, but {told[0].lower()}{told[1:]}")
