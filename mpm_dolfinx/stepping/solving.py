# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""One load step: solved from the last converged one, and made the converged one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..boundary.supports import Support
from ..constitutive.points import MaterialPoints
from ..errors import TRIAL_ERRORS, ConvergenceError
from ..history import History
from ..log import NEWTON, tell
from ..parallel.garbage import Cleaner
from ..particles.particles import Particles
from ..solvers.newton import NewtonSolver
from ..solvers.problem import ReducedProblem
from ..system.body import BodyTerm
from ..system.reduced import ReducedSystem
from ..tolerances import INEXACT, SMALL
from .control import Converged
from .displacement_control import ControlledSystem, DisplacementControl
from .leaving import Masses, move_bodies

__all__ = ["Goal", "StepSolver", "System", "set_load"]

#: How much farther a body may move for the same controlled displacement than in the step before.
JUMP = 10.0
#: Alternations after which a step is given up.
MOST_ALTERNATIONS = 5000


class System(NamedTuple):
    """Residual, tangent and solver of a problem, on the present meshes of its bodies.

    Attributes:
        bodies: The bodies.
        body_terms: What each is made of and loaded by.
        reduced: Residual and tangent.
        newton: What finds a root of the residual.
        clean_up: Frees what is out of use.
        points: The materials at the points of each body.
        supports: The supports that the problem was given.
        loads: The loads that the load factor multiplies and the user may change.
        masses: Masses of the particles of a body, by its number.
    """

    bodies: Sequence[Particles]
    body_terms: Sequence[BodyTerm]
    reduced: ReducedSystem
    newton: NewtonSolver
    clean_up: Cleaner
    points: Sequence[MaterialPoints]
    supports: Sequence[Support]
    loads: Sequence[fem.Constant | fem.Function]
    masses: Masses

    @property
    def comm(self) -> MPI.Comm:
        """The ranks."""
        comm: MPI.Comm = self.bodies[0].V.mesh.comm
        return comm


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


def set_load(bodies: Sequence[Particles], load: float, proportional: bool) -> None:
    """Set the load factor, and whether supports move in proportion to it or to totals."""
    for body in bodies:
        np.copyto(body.load.value, load)
        np.copyto(body.proportional.value, float(proportional))


class StepSolver:
    """Solves steps of a problem, as long as its bodies have their meshes.

    Args:
        system: What it is solved by.
        history: Where solves are counted.
    """

    def __init__(self, system: System, history: History) -> None:
        self.system, self._history = system, history
        self._moved: float | None = None

    def begin_run(self) -> None:
        """Begin a run, in whose first step nothing can have jumped."""
        self._moved = None

    def solve(
        self,
        goal: Goal,
        size: float,
        control: DisplacementControl | None,
        converged: Converged,
        in_run: bool,
    ) -> int:
        """Solve one step from where it is expected to end, or else from where it begins.

        A prediction from which Newton's method fails is not the start of a second attempt, nor is
        the step made smaller for it: most of what fails is near a solution that the prediction is
        far from.

        Args:
            goal: Where it goes.
            size: How far that is.
            control: What is controlled, if anything.
            converged: Where it begins.
            in_run: Whether it may be made smaller.

        Returns:
            How often equations of terms were solved in turn with the displacements.
        """
        bodies, terms, reduced, newton = self.system[:4]
        before, again = converged.prescribed, False
        changes = [new - old for new, old in zip(goal.values, before, strict=True)]
        while True:
            newton.forget()
            reduced.begin(changes, size, before, newton.release)
            system: ReducedProblem = reduced
            if control is not None:
                system = ControlledSystem(reduced, control, goal.parameter, list(bodies))
            try:
                newton.solve(system, reduced.unknowns.sizes, in_run, again)
                return self._alternate()
            except TRIAL_ERRORS:
                if again or not newton.has_another_way:
                    raise
            again = True
            self._history.failed_iterations += newton.iterations
            self._history.statistics.count("second_attempts")
            for body in bodies:
                body.roll_back()
            if control is not None:
                set_load(bodies, converged.load, converged.proportional)
            reduced.terms.roll_back()
            for term in terms:
                term.miss()

    def _alternate(self) -> int:
        """Solve equations of terms in turn with the displacements, until all hold together.

        Returns:
            How often it did.
        """
        terms, newton, statistics = (
            self.system.reduced.terms,
            self.system.newton,
            self._history.statistics,
        )
        if not terms.alternates:
            return 0
        for number in range(1, MOST_ALTERNATIONS + 1):
            with statistics.phase("solve"):
                statistics["field_solves"] += terms.take_turns()
            statistics.count("alternations")
            left = newton.unbalanced()
            tell(self.system.comm, NEWTON, "  alternation %d: residual %.2e", number, left)
            if left <= SMALL:
                newton.residuals.append(left)
                return number
            newton.go_on(INEXACT)
        raise ConvergenceError(
            f"Displacements and other fields were not in equilibrium with each other after "
            f"{MOST_ALTERNATIONS} alternations: {left:.1e} of the forces were left"
        )

    def jump(self, size: float, displacement: float) -> str | None:
        """Return a warning where a body has moved much farther than what is controlled of it.

        Args:
            size: How far that has moved in the step that was solved (collective).
            displacement: Its value.
        """
        assert self.system.newton.x is not None
        moved, before = (
            self.system.reduced.resistance.motion(self.system.newton.x) / size,
            self._moved,
        )
        self._moved = moved
        if before is None or moved <= JUMP * before:
            return None
        return (
            f"In the step to a controlled displacement of {displacement:.6g} the body moved "
            f"{moved / before:.3g} times as far for it as in the step before: it has jumped to "
            "another state, between which and the last one the displacement went back. Control "
            "one that grows all the way, such as the opening of a crack."
        )

    def commit(self, goal: Goal, parameter: float) -> Converged:
        """Make the step that was solved the converged one (collective).

        Args:
            goal: Where it went.
            parameter: Load factor, or parameter of the path, at its end.

        Returns:
            What is known of it, but for the size of forces.

        Raises:
            MPMError: A body is outside that must not be, or a term fails; all is as before then.
        """
        bodies, reduced = self.system.bodies, self.system.reduced
        before = [body.converged_displacement for body in bodies]
        move_bodies(bodies, self._history, self.system.masses, parameter, goal.last)
        with self._history.statistics.phase("commit"):
            try:
                reduced.terms.commit()
            except BaseException:
                for body, converged in zip(bodies, before, strict=True):
                    body.restore(converged.reshape(-1, body.mesh.geometry.dim))
                raise
        return Converged(
            float(bodies[0].load.value),
            parameter,
            [total.copy() for total in goal.values],
            [force.array_r.copy() for force in reduced.unknowns.forces],
            bool(bodies[0].proportional.value),
            reduced.balance.followed(),
            [support.reaction for support in self.system.supports],
        )
