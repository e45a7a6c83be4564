# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points of one body against facets of another, through steps."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix

from .approach import Approach, OverStep
from .contact import Outcome
from .facets import Closest
from .law import Friction, Points
from .meeting import Meeting, untouched
from .neighbourhood import Neighbourhood, Sides
from .nitsche import Nitsche
from .pass_memory import Memory, State, no_memory, spread
from .stencil import Start, Stencil, acting
from .surface import Surface

__all__ = ["Pass"]

#: How near surfaces are looked for, in facets' sizes.
REACH = 2.0
#: Residuals of an attempt after which points stay with their facets.
FREEZE = 12


class Pass:
    """Points of one body against facets of another, on meshes that stay the same (collective).

    In a step it looks at those points alone that may come near to a facet.

    Args:
        source: The points.
        target: The facets.
        law: Friction, of both passes.
        penalties: In the normal direction and along the surface.
        stiffnesses: Of the facets of both, shape ``(m,)`` each.
        share: Share of what both passes bear.

    Attributes:
        source: As given.
        share: As given.
        of_step: Whether forces are those of whole steps of a motion.
        stress: The stress behind the points, where that presses.
        state: The points at the last converged step, and what acted on them.
        meeting: The last evaluation in a step; ``None``: there is none yet.
        learned: How often it has learned of other facets.
    """

    def __init__(
        self,
        source: Surface,
        target: Surface,
        law: Friction,
        penalties: tuple[float, float],
        stiffnesses: tuple[NDArray[np.float64], NDArray[np.float64]],
        share: float,
    ) -> None:
        self.source, self.share = source, share
        self._law = law.shared(share)  # (pressure has its share by stiffness)
        self._penalties = penalties
        self._comm: MPI.Comm = source.particles.mesh.comm
        self._stiffness = self._normal = self._in_series(*stiffnesses)
        reach = REACH * max(
            float(np.median(np.concatenate(self._comm.allgather(surface.sizes))))
            for surface in (source, target)
        )
        body = target.particles
        facets = len(basix.topology(body.mesh.basix_cell())[target.gdim - 1])
        number = body.global_index[target.layout.cells] * facets + target.layout.facets
        self._sides = Sides(source, target, number, reach, self._law.by_area)
        self.of_step = False
        self.stress: Nitsche | None = None
        self.meeting: Meeting | None = None
        self.learned, self._evaluations = 0, 0
        self._paired: Closest | None = None
        self._around = self._learn(None)
        self.state, self._approach = self._anew()

    def stiffen(self, source: NDArray[np.float64], target: NDArray[np.float64]) -> None:
        """Take other stiffnesses for what presses (collective)."""
        self._normal = self._in_series(source, target)

    def _in_series(
        self, source: NDArray[np.float64], target: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the share of both bodies' stiffnesses one behind the other (collective)."""
        facing = float(np.median(np.concatenate(self._comm.allgather(target))))
        return self.share / (1.0 / source + 1.0 / facing) if len(source) else source

    # -- Beginnings -------------------------------------------------------------------------------

    def _learn(self, memory: Memory | None) -> Neighbourhood:
        """Return the facets near the points at the last converged step (collective)."""
        mine, nodes = (s.own_nodes(converged=True) for s in self._sides[:2])
        return self._neighbourhood(mine, nodes, memory)

    def _neighbourhood(
        self, mine: NDArray[np.float64], nodes: NDArray[np.float64], memory: Memory | None
    ) -> Neighbourhood:
        self.learned += 1
        followed = None if memory is None else memory.facet >= 0
        return Neighbourhood(self._sides, mine, nodes, followed)

    def _anew(self) -> tuple[State, Approach]:
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
        base = untouched(self.source, at)
        gap = np.where(found.near, found.gap, np.inf).reshape(-1, self.source.nq)
        outcome = base._replace(gap=spread(gap, around.facets, base.gap))
        return State(whole.with_some(around.which, known), outcome), approach

    def restore(
        self,
        touched: NDArray[np.bool_],
        anchors: NDArray[np.float64],
        offset: NDArray[np.float64],
        friction: NDArray[np.float64] | None = None,
    ) -> None:
        """Take what was remembered of points that it knows nothing of yet."""
        near, memory = self._around.near, self.state.memory
        nodes, anchors = self._around.before, anchors.reshape(-1, self.source.gdim)
        which = np.flatnonzero(touched.ravel())
        numbers, place = memory.facet.copy(), memory.place.copy()
        found = near.closest(anchors[which], None, nodes, self._sides.reach)
        there = found.facet >= 0
        numbers[which[there]] = near.number[found.facet[there]]
        place[which[there]] = found.place[there]
        rubbed = memory.friction
        if friction is not None and friction.shape[2] == rubbed.shape[1]:
            rubbed = friction.reshape(rubbed.shape)
        memory = memory._replace(
            touched=touched.ravel(),
            facet=numbers,
            place=place,
            within=touched.ravel() | memory.within,
            offset=offset.ravel(),
            anchors=anchors,
            friction=rubbed,
        )
        self.state = self.state._replace(memory=memory)

    # -- A step ---------------------------------------------------------------------------------

    def begin(self) -> None:
        """Learn of the facets near the points as they are (collective)."""
        self._around = self._learn(self.state.memory)
        self._paired = self.meeting = None
        self._evaluations = 0

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

    def evaluate(self) -> Meeting:
        """Return the forces and tractions there (not collective)."""
        approach, sides, source = self._approach, self._sides, self.source
        around, x = approach.around, approach.x
        self._evaluations += 1
        frozen = self._evaluations > FREEZE
        paired = self._paired = approach.met(self._paired, frozen)
        borne = around.weights > 0.0
        gap = np.where(paired.near, paired.gap, np.inf)
        within = paired.near & (gap <= sides.touch) & borne
        behind: NDArray[np.float64] | None = None
        inside = pressed = within
        if self.stress is not None:
            behind = self.share * self.stress.tractions(around.facets).reshape(x.shape)
            # as far as it may press
            k = self._penalties[0] * np.repeat(self._normal[around.facets], source.nq)
            reach = sides.touch + np.linalg.norm(behind, axis=1) / k
            pressed = paired.near & (paired.gap <= reach) & borne
        step: OverStep | None = None
        if self.of_step:
            step = approach.over_step(paired, within)
            inside, pressed = step.inside, step.pressed & borne
        which = np.flatnonzero(pressed)
        found = paired if step is None else step.found
        stencil, anchor = self._stencil(which, found, behind, step)
        shape = (len(around.facets), source.nq)
        force = np.zeros_like(x)
        pressure, slips = np.zeros(len(x)), np.zeros(len(x), dtype=bool)
        pushes, rubs, acts = acting(self._law, stencil, sides.touch)
        both = pushes + rubs
        force[which], pressure[which], slips[which] = both[:, 0], acts.pressure, acts.slips
        if behind is not None:
            inside = within.copy()
            inside[which] = acts.inside
        works = 0.0, 0.0
        if stencil.start is not None:
            change = stencil.x[:, : both.shape[1]] - stencil.start.x
            w = around.weights[which]
            done = [-float(w @ (part * change).sum(axis=(1, 2))) for part in (pushes, rubs)]
            works = done[0], done[1]
        outcome = Outcome(
            x.reshape(*shape, x.shape[-1]),
            gap.reshape(shape),
            pressure.reshape(shape),
            force.reshape(*shape, x.shape[-1]),
            inside.reshape(shape),
            slips.reshape(shape),
        )
        self.meeting = Meeting(
            law=self._law,
            share=self.share,
            approach=approach,
            found=paired,
            within=within,
            offset=np.zeros(len(x)) if step is None else step.offset,
            stencil=stencil,
            facet=found.facet[which],
            anchor=anchor,
            outcome=outcome,
            shear=acts.shear,
            reaction=both[:, 1:],
            works=works,
            of_step=self.of_step,
            frozen=frozen,
        )
        return self.meeting

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
        own = around.facets[which // self.source.nq]
        points = Points(
            self._penalties[0] * self._normal[own],
            np.where(lost, 0.0, self._penalties[1] * self._stiffness[own]),
            memory.touched[which] | lost,
            np.zeros((len(which), 0)),
            np.where(lost, 0.0, memory.gap[which]),
            around.stretch[which],
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

    def touches(self) -> bool:
        """Return whether any point of this rank touches, or has (not collective)."""
        inside = self.meeting is not None and self.meeting.outcome.inside.any()
        return bool(inside or self.state.memory.touched.any())

    def leaks(self) -> bool:
        """Return whether a point has gone through the other body since the last step."""
        assert self._paired is not None
        return self._approach.leaks(self._approach.last, self._paired)

    def after(self) -> State:
        """Return the state after the last evaluation, if it is that of a step."""
        assert self.meeting is not None
        return self.meeting.state(self.state.memory.friction)
