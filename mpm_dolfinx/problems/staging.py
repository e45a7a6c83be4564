# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""From one stage to the next: what a problem is changes, and its state does not.

A stage begins in equilibrium. What acts at once is held back by a term of its own, and goes over
the next run (:mod:`mpm_dolfinx.system.release`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError
from ..history import Stage
from ..io.checkpoint import Snapshot
from ..io.snapshot import belongs, merged
from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..stepping.loading import Stepper
from ..system.release import Release
from .state import ProblemState, Stateful

__all__ = ["Change", "Staging"]


class Change:
    """Change of a problem by a stage, made in the same state; the problem stays as it was.

    Displacement, stress and history stay where they were. All calls are collective.

    Args:
        problem: The problem.

    Attributes:
        kind: A word for what kind of change it is.
    """

    kind = ""

    def __init__(self, problem: Stateful) -> None:
        self._whole = problem
        self._was = problem.bcs, problem.terms, problem.bodies, problem.particles

    def make(self) -> None:
        """Change what the problem is made of; here nothing."""

    def settle(self) -> None:
        """Give what is new its state; the system is built, the bodies are where they were."""

    def renews(self, body: int | None, name: str) -> bool:
        """Return whether something of a state is new, and not as it was.

        Args:
            body: Number of the body, or ``None`` for numbers.
            name: What it is called in a state.
        """
        return False

    def undo(self) -> None:
        """Take back what was changed."""
        p = self._whole
        p.bcs, p.terms, p.bodies, p.particles = self._was


class _Standing(NamedTuple):
    """Forces before a stage: of what, and where.

    Attributes:
        moved: What each force acts on.
        forces: On own dofs of its W.
        spaces: The backgrounds.
        gathered: Forces on their own dofs, of bodies whose nodes go with their cells.
        left: What is held back there.
        reactions: Reactions there, if any are known.
        fixed: Dofs with a condition.
    """

    moved: list[tuple[int, str]]
    forces: list[NDArray[np.float64]]
    spaces: list[fem.FunctionSpace]
    gathered: list[NDArray[np.float64]]
    left: list[NDArray[np.float64]]
    reactions: list[NDArray[np.float64]] | None
    fixed: list[NDArray[np.bool_]]


class Staging:
    """Takes a problem from one stage to the next.

    Args:
        state: State of the problem.
        stepper: Knows the reactions of its last converged step.
        release: Holds back what a stage changes at once.
    """

    def __init__(self, state: ProblemState, stepper: Stepper, release: Release) -> None:
        self._state, self._stepper, self._release = state, stepper, release

    @property
    def held_back(self) -> float:
        """How much of what the last stage changes is held back yet, from 1 to 0."""
        return self._release.remaining

    def begin(self, name: str, change: Change, sudden: bool) -> None:
        """Change what the problem is, in the same state, and let the next run be a stage.

        What acts at once is held back and goes over the next run, unless the stage is sudden. Where
        it cannot be changed all stays as it was (collective).

        Args:
            name: Name of the stage.
            change: What changes.
            sudden: Whether nothing is held back.

        Raises:
            MPMError: What is to be changed does not go together.
        """
        if not isinstance(name, str):
            raise MPMError(f"The name of a stage must be a string, not {name!r}.")
        state, release = self._state, self._release
        problem = state.problem
        if sudden and release.remaining > 0.0:
            raise MPMError(
                f"{100 * release.remaining:.3g} % of what the last stage changes is held back "
                "yet; finish it with solve() before a sudden one."
            )
        first = state.identity()
        before = None if sudden else self._standing_forces()
        spaces, count = state.spaces, len(problem.bodies)
        kept, numbered = state.kept, list(state.numbered)

        def carry(snapshot: Snapshot) -> Snapshot:
            state.keep_terms()
            change.settle()
            numbers = (count, len(problem.bodies))
            backgrounds = [_number_of(V, spaces) for V in state.spaces]
            # What something remembers is its own: another one that has its key has no part in it.
            stay = [thing for _, thing in state.kept]
            gone = [one.key for _, one in kept if all(one is not thing for thing in stay)]

            def renewed(body: int | None, name: str) -> bool:
                return belongs(name, gone) or change.renews(body, name)

            found = merged(snapshot, state.capture(), numbers, backgrounds, renewed)
            nothing = {"past": [], "past moved": False, "supports": None, "force": None}
            found.numbers.update({**nothing, "release remaining": 0.0})
            return found

        def undo() -> None:
            change.undo()
            state.kept, state.numbered = kept, numbered

        state.renew(change.make, carry, undo)
        self._stepper.begin_stage()
        state.after_stage(f"{change.kind} {name!r}", first)
        problem.history.stages.append(Stage(name, problem.history.stage))
        if before is not None:
            self._hold_difference(before)

    def hold_all(self) -> None:
        """Hold the forces back that bodies are under now; they go as loads come (collective)."""
        reduced = self._state.problem.reduced
        V = [field.V.dofmap for field in reduced.fields]
        none = [np.zeros(m.index_map.size_local * m.index_map_bs) for m in V]
        self._release.hold(reduced.terms.nodal_forces(), none)

    def _moved(self) -> list[Particles | CarriedField]:
        """Return all that has unknowns, in the order of :meth:`.Terms.nodal_forces`."""
        return [*self._state.problem.bodies, *self._state.problem.built.carried]

    def _standing_forces(self) -> _Standing:
        """Return the forces of the last converged state (collective)."""
        reduced = self._state.problem.reduced
        forces = reduced.terms.nodal_forces()
        return _Standing(
            [_identity(one) for one in self._moved()],
            forces,
            self._state.spaces,
            self._gathered(forces),
            self._release.left(),
            self._stepper.trial.converged.reactions,
            [field.held_now() for field in reduced.fields],
        )

    def _hold_difference(self, before: _Standing) -> None:
        """Hold back what the forces are other now than before a stage (collective)."""
        after = self._state.problem.reduced.terms.nodal_forces()
        freed = self._gathered(after)
        for one, new in zip(self._moved(), after, strict=True):
            if (known := _identity(one)) in before.moved:
                new -= before.forces[before.moved.index(known)]
            new *= one.shares_nodes
        for field, new in zip(self._state.problem.reduced.fields, freed, strict=True):
            held = field.held_now()
            number = _number_of(field.V, before.spaces)
            if number is None:
                continue
            new -= before.gathered[number]
            new += before.left[number]
            if before.reactions is not None:
                dofs = before.fixed[number] & ~held
                new[dofs] += before.reactions[number][dofs]
        self._release.hold(after, freed)

    def _gathered(self, forces: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
        """Return forces on bodies whose nodes go with their cells, on the dofs of each background.

        Where a cell is taken away its own nodes are of no use to hold its force.

        Args:
            forces: On this rank's own dofs of W of each body, and of each of its fields.
        """
        totals = []
        for field in self._state.problem.reduced.fields:
            total = np.zeros(field.V.dofmap.index_map.size_local * field.V.dofmap.index_map_bs)
            for body, force in zip(self._moved(), forces, strict=True):
                if body.V is field.V and not body.shares_nodes:
                    vector, part = body.T.createVecLeft(), body.T.createVecRight()
                    vector.array_w[:] = force
                    body.T.multTranspose(vector, part)
                    total += part.array_r
            totals.append(total)
        return totals


def _identity(one: Particles | CarriedField) -> tuple[int, str]:
    """Return the key of a body, or of a field on it, which stages keep."""
    if isinstance(one, CarriedField):
        return id(one.field.particles), one.field.name
    return id(one), ""


def _number_of(V: fem.FunctionSpace, spaces: Sequence[fem.FunctionSpace]) -> int | None:
    """Return the number of a background among others, if it is one of them."""
    return next((number for number, known in enumerate(spaces) if known is V), None)
