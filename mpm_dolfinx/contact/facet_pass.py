# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points of one body against facets of another, through steps."""

from __future__ import annotations

from typing import Any, NamedTuple, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import basix

from ..errors import ConvergenceError
from .approach import Approach, OverStep
from .facets import Closest
from .law import Friction, Points
from .meeting import Meeting
from .memory import FacetMemory, no_memory, spread
from .neighbourhood import Neighbourhood, Sides
from .one_pass import Pass, retold, worn
from .outcome import Outcome, untouched
from .pair_matrices import Places
from .stencil import Start, Stencil, acting
from .surface import NEAR, Surface, median

__all__ = ["FacetPass"]

#: Residuals of an attempt after which points stay with their facets.
FREEZE = 12


type Array = NDArray[np.float64]


class Past(NamedTuple):
    """Points at the last converged step.

    Attributes:
        memory: What is known of all of them.
        outcome: What acted on them.
    """

    memory: FacetMemory
    outcome: Outcome

    @property
    def friction(self) -> Array:
        """Memory of the law of friction, shape ``(n, k)``."""
        return self.memory.friction


class FacetPass(Pass[Past, Meeting]):
    """Points of one body against facets of another, on meshes that stay the same (collective).

    In a step it looks at those points alone that may come near to a facet.

    Args:
        source: The points.
        target: The facets.
        law: Friction, of both passes.
        penalty: Stiffness in the normal direction, without unit.
        stiffnesses: Of the facets of both, shape ``(m,)`` each.
        share: Share of the load that it bears.
    """

    WITHIN = (
        "The bodies of a Pair overlap at the beginning: {particles} are up to {depth:.3g} deep in "
        "the other body; move the bodies apart."
    )

    def __init__(
        self,
        source: Surface,
        target: Surface,
        law: Friction,
        penalty: float,
        stiffnesses: tuple[Array, Array],
        share: float,
    ) -> None:
        super().__init__(source, law, penalty)
        self.share = share
        self._target = target
        self._stiffness = self._normal = self._in_series(*stiffnesses)
        reach = NEAR * max(surface.size for surface in (source, target))
        body = target.particles
        facets = len(basix.topology(body.mesh.basix_cell())[target.gdim - 1])
        number = body.global_index[target.layout.cells] * facets + target.layout.facets
        self._sides = Sides(source, target, number, reach, share)
        self._evaluations = 0
        self._paired: Closest | None = None
        self._around = self._learn(None)
        self.state, self._approach = self._anew()

    @override
    def stiffen(self, *stiffnesses: Array) -> None:
        self._normal = self._in_series(*stiffnesses)

    def _in_series(self, source: Array, target: Array) -> Array:
        """Return both bodies' stiffnesses one behind the other (collective)."""
        return 1.0 / (1.0 / source + 1.0 / median(self._target.particles.mesh.comm, target))

    # -- What it tells ----------------------------------------------------------------------------

    @property
    @override
    def anchors(self) -> Array:
        return self.state.memory.anchors.reshape(self.told.positions.shape)

    # -- Beginnings -------------------------------------------------------------------------------

    def _learn(self, memory: FacetMemory | None) -> Neighbourhood:
        """Return the facets near the points at the last converged step (collective)."""
        mine, nodes = (s.own_nodes(converged=True) for s in self._sides[:2])
        return self._neighbourhood(mine, nodes, memory)

    def _neighbourhood(
        self, mine: NDArray[np.float64], nodes: NDArray[np.float64], memory: FacetMemory | None
    ) -> Neighbourhood:
        self.learned += 1
        followed = None if memory is None else memory.facet >= 0
        return Neighbourhood(self._sides, mine, nodes, followed)

    def _anew(self) -> tuple[Past, Approach]:
        """Return the state at converged positions, of points that nothing has touched yet."""
        around, near = self._around, self._around.near
        at = self.source.positions(converged=True)
        x = at.reshape(-1, self.source.gdim)
        whole = no_memory(self._law, x)
        last = whole.of(around.which)
        approach = Approach(around, last, last.points, around.before)
        found = near.closest(
            last.points, approach.normals(converged=True), around.before, self._sides.reach
        )
        numbers = near.numbers(found.facet)
        within = found.near & (found.gap <= self._sides.touch)
        known = last._replace(
            facet=numbers, place=found.place, closest=numbers, gap=found.gap, within=within
        )
        base = untouched(at)
        gap = np.where(found.near, found.gap, np.inf).reshape(-1, self.source.nq)
        outcome = base._replace(gap=spread(gap, around.facets, base.gap))
        return Past(whole.with_some(around.which, known), outcome), approach

    # -- What is kept ---------------------------------------------------------------------------

    @override
    def columns(self) -> dict[str, NDArray[Any]]:
        memory, shape = self.state.memory, self.told.gap.shape
        kept: dict[str, NDArray[Any]] = {
            "met": memory.facet + 1,
            "closest": memory.closest + 1,
            "place": memory.place,
            "gap": memory.gap,
            "within": memory.within,
            "offset": memory.offset,
        }
        of_points = {name: part.reshape(*shape, *part.shape[1:]) for name, part in kept.items()}
        return super().columns() | of_points

    @override
    def restore(self, columns: dict[str, NDArray[Any]]) -> None:
        """Take what was kept of points of which nothing is known yet.

        Where anchors are in their places on the facets of then, these are taken as they were, to
        the last digit. Where facets were split or changed, anchors are looked for.
        """
        near, corners, memory = self._around.near, self._around.before, self.state.memory
        flat = {name: v.reshape(-1, *v.shape[2:]) for name, v in columns.items()}
        numbers, place = flat["met"] - 1, flat["place"]
        on, foot = near.find(numbers), np.full_like(flat["anchor"], np.inf)
        N, _, _ = near.tabulate(place[on >= 0])
        foot[on >= 0] = np.einsum("nk,nki->ni", N, corners[on[on >= 0]])
        same = np.linalg.norm(foot - flat["anchor"], axis=1) <= self._sides.touch
        lost = np.flatnonzero(flat["touches"] & ~same)
        found = near.closest(flat["anchor"][lost], None, corners, self._sides.reach)
        there = found.facet >= 0
        numbers = np.where(same, numbers, memory.facet)
        numbers[lost[there]] = near.number[found.facet[there]]
        place = np.where(same[:, None], place, memory.place)
        place[lost[there]] = found.place[there]
        known = memory._replace(
            touched=flat["touches"],
            facet=numbers,
            place=place,
            closest=np.where(same, flat["closest"] - 1, memory.closest),
            gap=np.where(same, flat["gap"], memory.gap),
            within=np.where(same, flat["within"], flat["touches"] | memory.within),
            offset=flat["offset"],
            anchors=flat["anchor"],
            friction=worn(columns.get("friction"), memory.friction),
        )
        self.state = Past(known, retold(self.state.outcome, columns))

    # -- A step ---------------------------------------------------------------------------------

    @override
    def begin(self) -> None:
        """Learn of the facets near the points as they are (collective)."""
        self._around = self._learn(self.state.memory)
        self._paired = self.evaluation = None
        self._evaluations = 0

    @override
    def look(self) -> None:
        """Learn where points and facets are now, and of others where bodies have gone far."""
        source, memory = self.source, self.state.memory
        mine, nodes = (s.own_nodes() for s in self._sides[:2])
        before = self._around
        if before.is_left(mine, nodes):
            self._around = self._neighbourhood(mine, nodes, memory)
            if self._paired is not None:
                self._paired = self._around.taken_over(self._paired, before)
        around = self._around
        x = (source.shapes @ mine[source.layout.own[around.facets]]).reshape(-1, source.gdim)
        last, corners = memory.of(around.which), around.near.positions(nodes)
        self._approach = Approach(around, last, x, corners)

    @override
    def evaluate(self) -> None:
        approach, sides = self._approach, self._sides
        around = approach.around
        self._evaluations += 1
        frozen = self._evaluations > FREEZE
        found = paired = self._paired = approach.met(self._paired, frozen)
        borne = around.weights > 0.0
        pressed = within = paired.near & (paired.gap <= sides.touch) & borne
        behind: Array | None = None
        if self.stress is not None:
            behind, reach = self._behind(around.facets, sides.touch)
            pressed = paired.near & (paired.gap <= reach) & borne
        step: OverStep | None = None
        if self.of_step:
            step = approach.over_step(paired, within)
            found, pressed = step.found, step.pressed & borne
        stencil, anchor = self._stencil(np.flatnonzero(pressed), found, behind, step)
        self.evaluation = Meeting(
            self._law,
            approach,
            paired,
            within,
            step,
            stencil,
            found.facet[stencil.which],
            anchor,
            acting(self._law, stencil, sides.touch),
            frozen,
        )

    def _stencil(
        self,
        which: NDArray[np.int64],
        found: Closest,
        behind: NDArray[np.float64] | None,
        step: OverStep | None,
    ) -> tuple[Stencil, NDArray[np.int64]]:
        """Return the quantities that tractions at points depend on, and the anchors' facets."""
        approach, memory = self._approach, self._approach.last
        around, near = approach.around, approach.around.near
        x, nodes = approach.x, approach.nodes
        facet = found.facet[which]
        anchor = near.find(memory.facet[which])
        lost = anchor < 0
        # what has come from where nothing was near has no anchor yet
        anchor = np.where(lost, facet, anchor)
        anchored = np.where(lost[:, None], found.place[which], memory.place[which])
        parts = [x[which][:, None], nodes[facet]]
        if not self._law.smooth:
            parts.append(nodes[anchor])
        normal, tangential, stretch = (part[which] for part in self._stiffnesses(around.facets))
        points = Points(
            normal,
            np.where(lost, 0.0, tangential),
            memory.touched[which] | lost,
            np.zeros((len(which), 0)),
            np.where(lost, 0.0, memory.gap[which]),
            stretch,
            memory.friction[which],
        )
        start = None
        if step is not None:
            before = np.concatenate([memory.points[which][:, None], around.before[facet]], axis=1)
            middle = 0.5 * (before + np.concatenate(parts[:2], axis=1))
            place = near.project(middle[:, 0], middle[:, 1:], found.place[which])
            start = Start(before, near.tabulate(place), step.gap[which], step.begins[which])
        stencil = Stencil(
            which,
            found.place[which],
            near.tabulate(found.place[which]),
            near.tabulate(anchored)[0],
            np.concatenate(parts, axis=1),
            points,
            near.outward[facet],
            start,
            None if behind is None else behind[which],
        )
        return stencil, anchor

    @override
    def forces(self, factor: float) -> list[PETSc.Vec]:
        if self.evaluation is None:
            self.evaluate()
        assert self.evaluation is not None
        return self.evaluation.forces(factor)

    @override
    def add_tangents(self, factor: float, secants: bool, into: Places) -> None:
        assert self.evaluation is not None
        self.evaluation.add_tangents(factor, into)

    @override
    def after(self) -> Past:
        """Return the state after the last evaluation.

        Raises:
            ConvergenceError: One body has gone through the other.
        """
        assert self.evaluation is not None and self._paired is not None
        if self._approach.leaks(self._paired):
            raise ConvergenceError(
                "A body goes through the other one of a Pair in one step; take smaller steps"
            )
        return Past(*self.evaluation.state(self.state.memory.friction))
