# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Changes of a stage: new input, cells that are taken away, bodies that come.

Each is a :class:`~mpm_dolfinx.problems.staging.Change`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol, override

import numpy as np
from numpy.typing import NDArray

from ..constitutive.beginning import begin_with_stress, take_over
from ..constitutive.moduli import mean_shear_modulus
from ..constitutive.points import MaterialPoints
from ..errors import MPMError, agree
from ..io.snapshot import spaces_of
from ..meshes.regions import in_space, marked
from ..meshes.tags import cells_with
from ..particles.particles import Particles
from ..reals import as_wholes
from ..system.term import Term
from .arguments import as_bodies, as_conditions, as_terms
from .body import Body
from .initial_stress import initial_stress_at_points, warn_of_other_ground
from .setup import Setup
from .staging import Change
from .state import Stateful

__all__ = ["Addition", "Given", "Removal", "Staged", "chosen_cells", "join"]

#: What says which law governs which points.
OF_LAWS = {"material", "cell_tags"}


class Staged(Stateful, Protocol):
    """A problem that goes through stages.

    Attributes:
        setup: What the user has given for the bodies.
    """

    setup: Setup


class _OfSetup(Change):
    """Base of the changes of a problem with materials.

    Args:
        problem: The problem.
    """

    def __init__(self, problem: Staged) -> None:
        super().__init__(problem)
        self.problem, self._setup_before = problem, problem.setup

    @override
    def undo(self) -> None:
        super().undo()
        self.problem.setup = self._setup_before


class Given(_OfSetup):
    """Other materials, loads, conditions or terms.

    Args:
        problem: The problem.
        setup: What it is made of from now on.
        bcs: The Dirichlet conditions.
        terms: What else acts on the bodies; what the problem itself has may be among it.
        own: The terms that the problem itself has.
    """

    kind = "stage"

    def __init__(
        self, problem: Staged, setup: Setup, bcs: Any, terms: Any, own: Sequence[Term] = ()
    ) -> None:
        super().__init__(problem)
        self._bcs = as_conditions(bcs, spaces_of(problem.bodies))
        given = as_terms(terms, problem.bodies)
        self._terms = [*own, *(term for term in given if all(term is not mine for mine in own))]
        self._setup = replace(setup, terms=tuple(self._terms))
        self._changed = [
            set(new.changed_from(old))
            for new, old in zip(setup.given, problem.setup.given, strict=True)
        ]
        self._points, self._moduli = list(problem.built.points), problem.reduced.unknowns.moduli

    @override
    def make(self) -> None:
        problem = self.problem
        join(self._terms, problem.terms)
        problem.setup, problem.bcs, problem.terms = self._setup, self._bcs, self._terms

    @override
    def settle(self) -> None:
        problem, factors = self.problem, {}
        for body, changed, points, before in zip(
            problem.bodies, self._changed, problem.built.points, self._points, strict=True
        ):
            if changed & OF_LAWS:
                take_over(points, before)
                factors[id(body)] = _shear(points) / _shear(before)
        if self._moduli is not None:
            problem.reduced.unknowns.moduli = [
                None if modulus is None else modulus * factors.get(id(moved), 1.0)
                for moved, modulus in zip(problem.reduced.bodies, self._moduli, strict=True)
            ]

    @override
    def renews(self, body: int | None, name: str) -> bool:
        if body is None:
            return name == "moduli"
        return bool(self._changed[body] & OF_LAWS) and name.startswith("history ")


def _shear(points: MaterialPoints) -> float:
    """Return the mean shear modulus of a body (collective)."""
    return mean_shear_modulus(points.laws, points.strain.volumes())


class Removal(_OfSetup):
    """Cells that are taken away.

    Args:
        problem: The problem.
        number: Number of their body.
        cells: Their local indices on this rank.
    """

    kind = "remove"

    def __init__(self, problem: Staged, number: int, cells: NDArray[np.int64]) -> None:
        super().__init__(problem)
        self._number, self._cells = number, cells
        self._body = problem.bodies[number]
        self._deletable = self._body.deletion is not None

    @override
    def make(self) -> None:
        self._body.remove(self._cells)

    @override
    def renews(self, body: int | None, name: str) -> bool:
        return body == self._number and name in ("deleted", "kept")

    @override
    def undo(self) -> None:
        super().undo()
        self._body.allow_deletion(self._deletable)


class Addition(_OfSetup):
    """A body that comes.

    Args:
        problem: The problem.
        given: The body.
    """

    kind = "add"

    def __init__(self, problem: Staged, given: Body) -> None:
        super().__init__(problem)
        self._bodies = as_bodies([*problem.bodies, given.particles])
        self._given = given

    @override
    def make(self) -> None:
        problem, setup = self.problem, self.problem.setup
        given, bodies = (*setup.given, self._given), (*setup.bodies, self._given)
        problem.setup = replace(setup, given=given, bodies=bodies)
        problem.bodies = self._bodies
        problem.particles = list(self._bodies)

    @override
    def settle(self) -> None:
        stress = self._given.initial_stress
        if stress is not None:
            body, points = self._given.particles, self.problem.built.points[-1]
            begin_with_stress(points, initial_stress_at_points(stress, body))
            warn_of_other_ground([self._given], self.problem.setup.given)

    @override
    def renews(self, body: int | None, name: str) -> bool:
        return body is None and name in ("moduli", "cuts", "fields units")


def join(terms: Sequence[Term], before: Sequence[Term]) -> None:
    """Let the terms that are new join those that stay (collective).

    Args:
        terms: All that act from now on.
        before: Those that have acted.
    """
    gone = [term for term in before if all(term is not other for other in terms)]
    for term in terms:
        if all(term is not other for other in before):
            term.come_after(gone)


def chosen_cells(particles: Particles, which: Any, tags: Any, cell_tags: Any) -> NDArray[np.int64]:
    """Return the local indices of domains that are chosen, on this rank (collective).

    Args:
        particles: The body.
        which: Global indices, or a function of undeformed centroids ``(3, n)`` that returns which
            are meant, or ``None``.
        tags: One tag of ``cell_tags`` or several, or ``None``.
        cell_tags: Tags of the body's cells.

    Raises:
        MPMError: Both or none of them are given, something is not there, or nothing would be left.
    """
    if (which is None) == (tags is None):
        raise MPMError("Give either particles= or tags= of what is to be removed.")
    comm, chosen = particles.mesh.comm, np.zeros(particles.num_local, dtype=bool)
    if tags is not None:
        cells = cells_with(particles.mesh, cell_tags, tags, "remove()")
        chosen[cells[cells < particles.num_local]] = True
    with agree(comm):
        if callable(which):
            x = in_space(particles.initial_centroid)
            chosen = marked(which, x, "The function that chooses particles")
        elif which is not None:
            try:
                indices = as_wholes(which).ravel()
            except (TypeError, ValueError):
                raise MPMError(
                    "particles= are global indices, whole numbers, or a function of coordinates, "
                    f"not {which!r}."
                ) from None
            lost = np.unique(indices[(indices < 0) | (indices >= particles.num_global)])
            if len(lost):
                raise MPMError(f"There are no cells {', '.join(map(str, lost))} to be removed.")
            chosen = np.isin(particles.global_index, indices)
    count = comm.allreduce(int((chosen & ~particles.deleted).sum()))
    rest = comm.allreduce(int((~chosen & ~particles.deleted).sum()))
    if count == 0:
        raise MPMError(
            "No particle is to be removed, or it is removed already: a function is asked at the "
            "centroids of the undeformed domains."
        )
    if rest == 0:
        raise MPMError("Nothing would be left of the body; a problem keeps a part of each body.")
    return np.flatnonzero(chosen & ~particles.deleted)
