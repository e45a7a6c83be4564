# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points of a body's surface against a target: a shape, or facets of another body."""

from __future__ import annotations

from typing import Any, Protocol

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .behind import At
from .law import Friction
from .nitsche import Nitsche, Spread
from .outcome import Outcome
from .pair_matrices import Met, Places
from .surface import Surface

__all__ = ["Evaluation", "Pass", "State"]

type Array = NDArray[np.float64]


class Evaluation(Protocol):
    """Tractions on points, where their facets were put."""

    @property
    def outcome(self) -> Outcome:
        """Tractions at the points that were looked at."""

    @property
    def works(self) -> tuple[float, float]:
        """Work against pressure and against friction in a step of a motion."""

    def met(self) -> Met:
        """Return the facets that meet at the points where something acts."""

    def by_stress(self, factor: float) -> tuple[At, list[Spread]]:
        """Return points with normals, and how forces on bodies grow with the stress behind.

        Args:
            factor: What forces are multiplied by.
        """


class State(Protocol):
    """Points at a converged step."""

    @property
    def outcome(self) -> Outcome:
        """Tractions that acted on them."""

    @property
    def friction(self) -> Array:
        """Memory of the law of friction, the last of its dimensions for each point."""


class Pass[Past: State, Found: Evaluation]:
    """Points of a body's surface against a target, on meshes that stay the same.

    Args:
        source: The points.
        law: The law of friction.
        penalty: Stiffness in the normal direction, without unit.

    Attributes:
        source: As given.
        of_step: Whether forces are those of whole steps of a motion.
        stress: The stress behind the points, where that presses.
        state: The points at the last converged step.
        evaluation: The last evaluation in a step; ``None``: there is none yet.
        learned: How often it has learned of other facets.
    """

    #: What is said of points that are deep in the target from the beginning.
    WITHIN: str

    state: Past
    _stiffness: Array
    _normal: Array

    #: Share of the load that it bears: what acts at its points counts by as much.
    share = 1.0

    def __init__(self, source: Surface, law: Friction, penalty: float) -> None:
        self.source = source
        self._law, self._penalty = law, penalty
        self.of_step = False
        self.stress: Nitsche | None = None
        self.evaluation: Found | None = None
        self.learned = 0

    def stiffen(self, *stiffnesses: Array) -> None:
        """Take other stiffnesses for what presses (collective).

        Args:
            stiffnesses: Of the facets of the points, and of the other body's, shape ``(m,)``.
        """
        raise NotImplementedError

    def _stiffnesses(self, facets: NDArray[np.int64] | None) -> tuple[Array, Array, Array]:
        """Return stiffnesses of points, normal and along the surface, and stretches, ``(n,)``.

        Stiffnesses are per area at the step's beginning. Where a motion keeps the energy of
        penetration they are per undeformed area, or a facet that is drawn out would gain energy,
        and by Nitsche's method, where they hold what the stress presses.

        Args:
            facets: Numbers of the points' facets; ``None``: all.
        """
        some = slice(None) if facets is None else facets
        stretch = self.source.stretch[some]
        of_area = not self.of_step and self.stress is None
        area = stretch if of_area else np.ones_like(stretch)
        normal = self._penalty * self._normal[some, None] * area
        tangential = self._law.stiffness * self._stiffness[some, None] * area
        return normal.ravel(), tangential.ravel(), stretch.ravel()

    def _behind(self, facets: NDArray[np.int64] | None, touch: float) -> tuple[Array, Array]:
        """Return tractions by the stress behind points, and gaps up to which these may press."""
        assert self.stress is not None
        some = slice(None) if facets is None else facets
        behind = self.stress.tractions(facets).reshape(-1, self.source.gdim)
        k = np.repeat(self._penalty * self._normal[some], self.source.nq)
        return behind, touch + np.linalg.norm(behind, axis=1) / k

    # -- What it tells ----------------------------------------------------------------------------

    @property
    def told(self) -> Outcome:
        """Outcome at the last converged step."""
        return self.state.outcome

    @property
    def gap(self) -> Array:
        """Gaps then, shape ``(m, nq)``."""
        return self.told.gap

    @property
    def anchors(self) -> Array:
        """Anchors then, or where points were that touched nothing, shape ``(m, nq, gdim)``."""
        raise NotImplementedError

    @property
    def rubbed(self) -> Array:
        """Memory of the law of friction, shape ``(n, k)``."""
        return self.state.friction.reshape(self.told.gap.size, len(self._law.memory))

    def touches(self) -> bool:
        """Return whether any point of this rank touches, or has (not collective)."""
        now = self.evaluation is not None and self.evaluation.outcome.inside.any()
        return bool(now or self.told.inside.any())

    # -- A step ---------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Prepare a step, or another try of it."""

    def begin(self) -> None:
        """Begin a step that was prepared, before it is evaluated first (collective)."""

    def look(self) -> None:
        """Learn where points and target are now (collective)."""

    def evaluate(self) -> None:
        """Evaluate what acts there (not collective)."""
        raise NotImplementedError

    def forces(self, factor: float) -> list[PETSc.Vec]:
        """Return forces on the nodes of the points' body, and of the other one (collective).

        Args:
            factor: What they are multiplied by.
        """
        raise NotImplementedError

    def add_tangents(self, factor: float, secants: bool, into: Places) -> None:
        """Add the derivatives of the forces to blocks.

        Args:
            factor: What they are multiplied by.
            secants: Whether points that have changed their slip may take secants instead.
            into: The blocks, for each point where something acts.
        """
        raise NotImplementedError

    def after(self) -> Past:
        """Return the state after the last evaluation.

        Raises:
            ConvergenceError: Points have gone through the target in the step.
        """
        raise NotImplementedError

    def roll_back(self) -> None:
        """Return to the last converged step."""
        self.evaluation = None

    # -- What is kept ---------------------------------------------------------------------------

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the kept values of the points by name, each of shape ``(m, nq, ...)``."""
        told = self.told
        kept: dict[str, NDArray[Any]] = {
            "touches": told.inside,
            "slips": told.slips,
            "pressure": told.pressure,
            "traction": told.traction,
            "anchor": self.anchors,
            "stretch": self.source.last_stretch,
        }
        if self._law.memory:
            kept["friction"] = self.rubbed.reshape(*told.gap.shape, len(self._law.memory))
        return kept

    def restore(self, columns: dict[str, NDArray[Any]]) -> None:
        """Take what was kept of points of which nothing is known yet."""
        raise NotImplementedError


def retold(outcome: Outcome, columns: dict[str, NDArray[Any]]) -> Outcome:
    """Return an outcome with what was kept of it."""
    return outcome._replace(
        inside=columns["touches"],
        slips=columns["slips"],
        pressure=columns["pressure"],
        traction=columns["traction"],
    )


def worn(kept: NDArray[np.float64] | None, new: Array) -> Array:
    """Return a memory of friction as it was kept, where that is one of the same law."""
    known = kept is not None and kept.shape[2] == new.shape[-1]
    return np.asarray(kept).reshape(new.shape) if known else new
