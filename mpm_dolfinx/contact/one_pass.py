# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points of one body against facets of another: which meet which, and what is remembered of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import basix

from .. import _compat
from .behind import At
from .contact import Outcome
from .facets import Closest, NearFacets, separated
from .law import Friction, Points, unworn
from .nitsche import Nitsche, Spread
from .pair_matrices import Met
from .stencil import (
    Foot,
    Start,
    Stencil,
    Sums,
    acting,
    add_tangents,
    by_stress,
    projected,
    remembered,
)
from .surface import Surface, global_nodes

__all__ = ["Memory", "Pass"]

#: How near surfaces are looked for, in facets' sizes.
REACH = 2.0
#: Residuals of an attempt after which points stay with their facets.
FREEZE = 12
#: How far a point may slide off a facet's edge within a step, over the facet's size.
LINGER = 0.1
#: Cosine of the angle of two facets' normals below which there is a corner between them.
CORNER = 0.7
#: Penetration, over the thickness of the domain behind, of bodies as they are given.
OVERLAP = 0.1


class Memory(NamedTuple):
    """State of a pass at the last converged step.

    Attributes:
        touched: Which points were in contact, shape ``(n,)``.
        facet: Number of the facet of their anchors, or of the closest where they touched nothing,
            -1 where none was near, shape ``(n,)``.
        place: Place on it, shape ``(n, gdim - 1)``.
        closest: Number of the closest facet, shape ``(n,)``.
        gap: Shape ``(n,)``.
        within: Which points were behind their facets, shape ``(n,)``.
        offset: Gap at which each begins to be pressed in a motion, shape ``(n,)``: negative for
            points that came there from the side and not through a facet, or they would win energy.
        points: Where they were, shape ``(n, gdim)``.
        anchors: Where their anchors were, shape ``(n, gdim)``.
        friction: What the law of friction remembers, shape ``(n, k)``.
    """

    touched: NDArray[np.bool_]
    facet: NDArray[np.int64]
    place: NDArray[np.float64]
    closest: NDArray[np.int64]
    gap: NDArray[np.float64]
    within: NDArray[np.bool_]
    offset: NDArray[np.float64]
    points: NDArray[np.float64]
    anchors: NDArray[np.float64]
    friction: NDArray[np.float64]

    def of(self, points: NDArray[np.int64]) -> Memory:
        """Return the memory of some points."""
        parts: list[Any] = [part[points] for part in self]
        return Memory(*parts)


class Pass:
    """Points of one body against facets of another.

    In a step it looks at those points alone that may come near to a facet.

    Args:
        source: The points.
        target: The facets.
        law: Friction, of both passes.
        penalties: In the normal direction and along the surface.

    Attributes:
        share: Share of what both passes bear.
        of_step: Whether forces are those of whole steps of a motion.
        stress: The stress behind the points, where that presses.
        memory: What is known of all points.
        outcome: What acted on all points at the last converged step.
        learned: How often it has learned of other facets.
        works: This rank's work against pressure and against friction in such a step.
    """

    def __init__(
        self,
        source: Surface,
        target: Surface,
        law: Friction,
        penalties: tuple[float, float],
    ) -> None:
        self.source, self.target = source, target
        self.law = self._whole = law
        self._penalties, self.share = penalties, 1.0
        self._comm: MPI.Comm = source.particles.mesh.comm
        self.memory: Memory | None = None
        self.stencil: Stencil | None = None
        self.of_step = False
        self.stress: Nitsche | None = None
        self.works = (0.0, 0.0)
        self.learned = 0
        self._near: NearFacets | None = None
        self._known: tuple[Memory, Memory] | None = None

    def settle(
        self, source: NDArray[np.float64], target: NDArray[np.float64], share: float
    ) -> None:
        """Take stiffnesses of the facets of both surfaces, shape ``(m,)`` each (collective).

        Args:
            source: That of the points' facets.
            target: That of the others.
            share: Share of what both passes bear.
        """
        # (pressure has its share by stiffness)
        law, self.share = self._whole, share
        self.law = law.shared(share)
        self._stiffness = self._normal = self._in_series(source, target)
        self.reach = REACH * max(
            float(np.median(np.concatenate(self._comm.allgather(surface.sizes))))
            for surface in (self.source, self.target)
        )
        body = self.target.particles
        sides = len(basix.topology(body.mesh.basix_cell())[self.target.gdim - 1])
        self._number = body.global_index[self.target.cells] * sides + self.target.facets

    def stiffen(self, source: NDArray[np.float64], target: NDArray[np.float64]) -> None:
        """Take other stiffnesses than those of :meth:`settle` for what presses (collective)."""
        self._normal = self._in_series(source, target)

    def _in_series(
        self, source: NDArray[np.float64], target: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the share of both bodies' stiffnesses one behind the other (collective)."""
        facing = float(np.median(np.concatenate(self._comm.allgather(target))))
        return self.share / (1.0 / source + 1.0 / facing) if len(source) else source

    @property
    def touch(self) -> float:
        """Gap at which points touch."""
        return max(self.source.touch, self.target.touch)

    def _flat(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return x.reshape(-1, self.source.gdim)

    # -- A step ---------------------------------------------------------------------------------

    def begin(self) -> None:
        """Learn of the facets near the points as they are (collective)."""
        self._learn(self.source.own_nodes(converged=True), self.target.own_nodes(converged=True))
        self._paired: Closest | None = None
        self.stencil = None
        self._evaluations = 0

    def _learn(self, mine: NDArray[np.float64], nodes: NDArray[np.float64]) -> NearFacets:
        """Learn of the facets near points, and of the points near these (collective).

        Args:
            mine: Positions of the own nodes of the points' surface.
            nodes: Those of the facets'.
        """
        source = self.source
        x = source.shapes @ mine[source.own]
        near = NearFacets(self.target, self._number, self._flat(x), 3.0 * self.reach, nodes)
        corners = near.positions(nodes)
        self._before = near.positions(self.target.own_nodes(converged=True))
        # (until it learns anew, no point gets nearer to a facet by more than the reach)
        low = corners.min(axis=(0, 1), initial=np.inf) - 2.0 * self.reach
        high = corners.max(axis=(0, 1), initial=-np.inf) + 2.0 * self.reach
        within = ((x >= low) & (x <= high)).all(axis=2).any(axis=1)
        if self.memory is not None:
            within |= (self.memory.facet >= 0).reshape(len(within), source.nq).any(axis=1)
        self._facets = np.flatnonzero(within)
        points = self._facets[:, None] * source.nq + np.arange(source.nq)
        self._which, self._known = points.ravel(), None
        self._stretch: NDArray[np.float64] | None = None
        self._weights = source.weights[self._facets].ravel()
        self._start, self._near = (mine, nodes), near
        self.learned += 1
        return near

    def _follow(self, mine: NDArray[np.float64], nodes: NDArray[np.float64]) -> None:
        """Learn of other facets where bodies have gone far since (collective)."""
        moved = [
            surface.spread * np.sqrt(((a - b) ** 2).sum(axis=1).max(initial=0.0))
            for surface, a, b in zip(
                (self.source, self.target), (mine, nodes), self._start, strict=True
            )
        ]
        if self._comm.allreduce(float(sum(moved)), MPI.MAX) <= self.reach:
            return
        paired, before, which = self._paired, self._near, self._which
        assert before is not None
        near = self._learn(mine, nodes)
        if paired is not None:
            facet = near.find(_numbers(before, paired.facet))
            paired = paired._replace(facet=facet, near=paired.near & (facet >= 0))
            whole = _nothing(self._num_points, self.source.gdim - 1)
            self._paired = Closest(
                *(
                    _spread(part, which, base)[self._which]
                    for part, base in zip(paired, whole, strict=True)
                )
            )

    @property
    def _num_points(self) -> int:
        """Number of all points."""
        return len(self.source.cells) * self.source.nq

    @property
    def _last(self) -> Memory:
        """Memory of the points that it looks at."""
        assert self.memory is not None
        if self._known is None or self._known[0] is not self.memory:
            self._known = self.memory, self.memory.of(self._which)
        return self._known[1]

    def begin_anew(self) -> None:
        """Take the converged positions for those of points that nothing has touched yet."""
        self.memory = None
        self.begin()
        x = self._flat(self.source.positions(converged=True))
        near, which = self._near, self._which
        assert near is not None
        nodes = near.positions(self.target.own_nodes(converged=True))
        normals = self._flat(self.source.normals(converged=True, which=self._facets))
        found = near.closest(x[which], normals, nodes, self.reach)
        self.memory = self._remembered(
            x,
            Memory(
                np.zeros(len(which), dtype=bool),
                _numbers(near, found.facet),
                found.place,
                _numbers(near, found.facet),
                found.gap,
                found.near & (found.gap <= self.touch),
                np.zeros(len(which)),
                x[which],
                x[which],
                unworn(self.law, (len(which),)),
            ),
        )
        untouched = self._untouched(x)
        gap = np.where(found.near, found.gap, np.inf).reshape(-1, self.source.nq)
        self.outcome = replace(untouched, gap=_spread(gap, self._facets, untouched.gap))

    def _untouched(self, x: NDArray[np.float64]) -> Outcome:
        """Return the outcome without contact, at x."""
        shape = len(self.source.cells), self.source.nq
        place, zero, none = x.reshape(*shape, x.shape[-1]), np.zeros(shape), np.zeros(shape, bool)
        return Outcome(place, np.full(shape, np.inf), zero, np.zeros_like(place), none, none)

    def _remembered(self, x: NDArray[np.float64], known: Memory) -> Memory:
        """Return the memory of all points.

        Args:
            x: Their positions.
            known: What there is of those that it looks at.
        """
        n = len(x)
        facet, place, gap, near, beside = _nothing(n, self.source.gdim - 1)
        last = unworn(self.law, (n,)) if self.memory is None else self.memory.friction
        whole = Memory(near, facet, place, facet, gap, near, beside, x, x, last)
        return Memory(
            *(_spread(part, self._which, base) for part, base in zip(known, whole, strict=True))
        )

    def overlap(self) -> tuple[NDArray[np.int64], float] | None:
        """Return particles that are deep in the other body at the beginning, and how deep."""
        depth = -self.outcome.gap
        bound = OVERLAP * self.source.thickness[:, None]
        deep = (depth > bound) & (self.source.weights > 0.0) & ~self.outcome.inside
        if not deep.any():
            return None
        cells = self.source.cells[deep.any(axis=1)]
        return self.source.particles.global_index[cells], float(depth[deep].max())

    def look(self) -> None:
        """Learn where facets are now (collective)."""
        source, nodes = self.source, self.target.own_nodes()
        mine = source.own_nodes()
        self._follow(mine, nodes)
        assert self._near is not None
        self._x = self._flat(source.shapes @ mine[source.own[self._facets]])
        self._nodes = self._near.positions(nodes)

    def evaluate(self) -> None:
        """Find what acts there."""
        assert self._near is not None
        near, x, nodes, last = self._near, self._x, self._nodes, self._last
        self._evaluations += 1
        normals = self._flat(self.source.normals(which=self._facets))
        found = near.closest(x, normals, nodes, self.reach)
        if self._paired is not None:
            # A point that slides off an edge goes on to touch until the step's end, or the force
            # would come and go from one iterate to the next.
            stays = self._paired.near & (found.facet >= 0) & (found.beside < LINGER)
            found = found._replace(near=found.near | stays)
        # One that was behind the end of a facet and touched nothing goes on to, until it is behind
        # the facet itself.
        out = ~last.within & (last.gap < -self.touch)
        found = found._replace(near=found.near & ~(out & (found.beside >= LINGER)))
        if self._evaluations > FREEZE and self._paired is not None:
            found = self._frozen(found, x, nodes)
        self._paired = found
        gap = np.where(found.near, found.gap, np.inf)
        borne = self._weights > 0.0
        within = found.near & (gap <= self.touch) & borne
        inside = pressed = within
        self._within, self._offset = within, np.zeros(len(x))
        self._behind: NDArray[np.float64] | None = None
        if self.stress is not None:
            self._behind = self.share * self._flat(self.stress.tractions(self._facets))
            # as far as it may press
            k = self._penalties[0] * np.repeat(self._normal[self._facets], self.source.nq)
            reach = self.touch + np.linalg.norm(self._behind, axis=1) / k
            pressed = found.near & (found.gap <= reach) & borne
        if self.of_step:
            found, inside, pressed = self._over_step(found, within, x, nodes)
            pressed &= borne
        which = np.flatnonzero(pressed)
        self.stencil = self._stencil(which, found, x, nodes)
        shape = (len(self._facets), self.source.nq)
        force = np.zeros_like(x)
        pressure, slips = np.zeros(len(x)), np.zeros(len(x), dtype=bool)
        pushes, rubs, acts = acting(self.law, self.stencil, self.touch, self.target.extent)
        both = pushes + rubs
        force[which], pressure[which], slips[which] = both[:, 0], acts.pressure, acts.slips
        if self._behind is not None:
            inside = within.copy()
            inside[which] = acts.inside
        self.reaction = both[:, 1:]
        self.shear = acts.shear
        if self.stencil.start is not None:
            change = self.stencil.x[:, : both.shape[1]] - self.stencil.start.x
            w = self._weights[which]
            done = [-float(w @ (part * change).sum(axis=(1, 2))) for part in (pushes, rubs)]
            self.works = done[0], done[1]
        self._trial = Outcome(
            x.reshape(*shape, x.shape[-1]),
            gap.reshape(shape),
            pressure.reshape(shape),
            force.reshape(*shape, x.shape[-1]),
            inside.reshape(shape),
            slips.reshape(shape),
        )

    def touches(self) -> bool:
        """Return whether any point of this rank touches, or has."""
        inside = self.stencil is not None and self._trial.inside.any()
        return bool(inside or (self.memory is not None and self.memory.touched.any()))

    def _over_step(
        self,
        found: Closest,
        within: NDArray[np.bool_],
        x: NDArray[np.float64],
        nodes: NDArray[np.float64],
    ) -> tuple[Closest, NDArray[np.bool_], NDArray[np.bool_]]:
        """Return facets, and which points touch at the end of a step and in the whole of it.

        Points that leave through their facets give back their energy.
        """
        near, memory = self._near, self._last
        assert near is not None
        lost = np.flatnonzero(memory.within & (found.facet < 0))
        at = near.find(memory.closest[lost])
        lost, at = lost[at >= 0], at[at >= 0]
        if len(lost):
            facet, place, gap = found.facet.copy(), found.place.copy(), found.gap.copy()
            place[lost] = self._near_place(x[lost], nodes[at])
            table = near.tabulate(place[lost])
            foot = projected(table, x[lost], nodes[at], near.outward[at])
            facet[lost], gap[lost] = at, foot.gap
            found = found._replace(facet=facet, place=place, gap=gap)
        self._from, begins = self._before_step(found)
        sideways = within & ~memory.within & (self._from < -self.touch)
        offset = np.where(memory.within, np.clip(found.gap, begins, 0.0), 0.0)
        self._offset = np.where(within, np.where(sideways, found.gap, offset), 0.0)
        self._begins = begins
        inside = within & ~sideways & (found.gap - begins <= self.touch)
        out = (found.facet >= 0) & (found.near | (found.gap > self.touch))
        return found, inside, inside | (memory.within & out)

    def _before_step(self, found: Closest) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gaps at the beginning of a step, and those at which points begin to be pressed.

        What a point has gone through is told by the facet that it comes to: measured from one on
        the other side of a corner, its gap would jump, and the force with it. A point that was
        pressed there, and is deeper behind this facet, begins to be pressed from there on, so that
        it keeps its energy. On a surface without corners the gap is that of its facet of then.
        """
        near, memory = self._near, self._last
        assert near is not None
        gap, offset = memory.gap.copy(), memory.offset.copy()
        last = near.find(memory.closest)
        new = np.flatnonzero((found.facet >= 0) & (found.facet != last))
        if len(new) == 0:
            return gap, offset
        foot = self._foot_before(new, found.facet[new], found.place[new])
        pressed = memory.within[new] & (last[new] >= 0)
        was = self._foot_before(new, np.where(pressed, last[new], found.facet[new]), None)
        bent = (foot.n * was.n).sum(axis=1) < CORNER
        other = ~pressed | bent
        depth = (gap - offset)[new]
        gap[new[other]] = foot.gap[other]
        turned = pressed & bent
        offset[new[turned]] = np.minimum(foot.gap - depth, 0.0)[turned]
        return gap, offset

    def _foot_before(
        self, which: NDArray[np.int64], facet: NDArray[np.int64], place: NDArray[np.float64] | None
    ) -> Foot:
        """Return projections of some points on facets at the beginning of the step."""
        near, memory = self._near, self._last
        assert near is not None
        x, X = memory.points[which], self._before[facet]
        s = self._near_place(x, X) if place is None else near.project(x, X, place)
        return projected(near.tabulate(s), x, X, near.outward[facet])

    def _frozen(
        self, found: Closest, x: NDArray[np.float64], nodes: NDArray[np.float64]
    ) -> Closest:
        """Return the pairing of before, with projections as they are now.

        A point beside the end of its facet is not held there: it would be pressed by the plane of
        the facet, which goes on where there is none.
        """
        assert self._near is not None and self._paired is not None
        before = self._paired
        keep = np.flatnonzero(before.near)
        s = self._near.project(x[keep], nodes[before.facet[keep]], before.place[keep])
        beside = np.abs(s - self._near.clamped(s)).max(axis=1, initial=0.0)
        keep, s = keep[beside < LINGER], s[beside < LINGER]
        facet, place = found.facet.copy(), found.place.copy()
        gap, near = found.gap.copy(), found.near.copy()
        facet[keep] = before.facet[keep]
        at = facet[keep]
        r, n = separated(self._near.tabulate(s), x[keep], nodes[at], self._near.outward[at])
        place[keep], near[keep] = s, True
        gap[keep] = (r * n).sum(axis=1)
        return Closest(facet, place, gap, near, found.beside)

    def _stencil(
        self,
        which: NDArray[np.int64],
        found: Closest,
        x: NDArray[np.float64],
        nodes: NDArray[np.float64],
    ) -> Stencil:
        near, memory = self._near, self._last
        assert near is not None
        facet = found.facet[which]
        anchor = near.find(memory.facet[which])
        lost = anchor < 0
        # what has come from where nothing was near has no anchor yet
        anchor = np.where(lost, facet, anchor)
        anchored = np.where(lost[:, None], found.place[which], memory.place[which])
        parts = [x[which][:, None], nodes[facet]]
        if not self.law.smooth:
            parts.append(nodes[anchor])
        if self._stretch is None:
            self._stretch = self.source.stretch(self.law.by_area, self._facets).ravel()
        own = self._facets[which // self.source.nq]
        points = Points(
            self._penalties[0] * self._normal[own],
            np.where(lost, 0.0, self._penalties[1] * self._stiffness[own]),
            memory.touched[which] | lost,
            np.zeros((len(which), 0)),
            np.where(lost, 0.0, memory.gap[which]),
            self._stretch[which],
            memory.friction[which],
        )
        self._facet, self._anchor = facet, anchor
        start = None
        if self.of_step:
            before = np.concatenate([memory.points[which][:, None], self._before[facet]], axis=1)
            middle = 0.5 * (before + np.concatenate(parts[:2], axis=1))
            place = near.project(middle[:, 0], middle[:, 1:], found.place[which])
            table = near.tabulate(place)
            start = Start(before, table, self._from[which], self._begins[which])
        return Stencil(
            which,
            found.place[which],
            near.tabulate(found.place[which]),
            near.tabulate(anchored)[0],
            np.concatenate(parts, axis=1),
            points,
            near.outward[facet],
            start,
            None if self._behind is None else self._behind[which],
        )

    def forces(self) -> tuple[PETSc.Vec, PETSc.Vec]:
        """Return the forces on the nodes of both bodies (collective)."""
        assert self._near is not None and self.stencil is not None
        first = self.source.force(self._trial.traction, which=self._facets)
        second = _compat.create_vector(self.target.particles.W)
        values = self._weights[self.stencil.which][:, None, None] * self.reaction
        dofs = self._near.dofs[self._facet].astype(PETSc.IntType)
        second.setValues(dofs.ravel(), values.ravel(), addv=PETSc.InsertMode.ADD_VALUES)
        second.assemble()
        return first, second

    def met(self) -> Met:
        """Return the facets that meet at the points where something acts."""
        near, source = self._near, self.source
        assert near is not None and self.stencil is not None
        own = self._facets[self.stencil.which // source.nq]
        bs = source.particles.W.dofmap.index_map_bs
        others = [self._facet] if self.law.smooth else [self._facet, self._anchor]
        nodes = [near.dofs[facet][:, ::bs] // bs for facet in others]
        mine = global_nodes(source.particles.W, source.nodes[own])
        return Met(np.stack([own, *others], axis=1), (mine, *nodes))

    def add_tangents(
        self,
        factor: float,
        group: NDArray[np.int64],
        positions: NDArray[np.int32],
        values: NDArray[np.float64],
    ) -> None:
        """Add the forces' derivatives to blocks.

        Args:
            factor: What they are multiplied by.
            group: See :class:`Sums`.
            positions: As there.
            values: As there.
        """
        assert self.stencil is not None
        which, source = self.stencil.which, self.source
        sums = Sums(
            -factor * self._weights[which],
            source.shapes[which % source.nq],
            group,
            positions,
            values,
        )
        add_tangents(self.law, self.stencil, self.touch, self.target.extent, sums)

    def by_stress(self, factor: float) -> tuple[At, Sequence[Spread]]:
        """Return points with normals, and how forces on both bodies grow with the stress behind.

        Args:
            factor: As for :meth:`add_tangents`.
        """
        near, source = self._near, self.source
        assert near is not None and self.stencil is not None
        which = self.stencil.which
        normals, forces = by_stress(self.law, self.stencil, self.touch)
        w = -factor * self.share * self._weights[which]
        forces = w[:, None, None] * forces
        at = At(self._facets[which // source.nq], which % source.nq, normals)
        numbers, dofs = near.number[self._facet], near.dofs[self._facet]
        others = Spread.over_met(at, numbers, dofs, forces[:, 1:], len(source.cells))
        return at, [Spread.over_facets(source, at, forces[:, 0]), others]

    # -- The next step --------------------------------------------------------------------------

    def after(self) -> tuple[Memory, Outcome]:
        """Return memory and outcome of the last evaluation, if it is that of a step."""
        near, last, found = self._near, self._last, self._paired
        assert near is not None and found is not None and self.stencil is not None
        trial, x, offset = self._trial, self._x, self._offset
        if self.of_step:
            found, offset = self._returned(found, x)
        inside = trial.inside.ravel()
        place, numbers = found.place.copy(), _numbers(near, found.facet)
        which = self.stencil.which
        if not self.law.smooth and len(which):
            slips = trial.slips.ravel()[which]
            k = self.stencil.points.tangential
            stays = inside[which] & ~slips & self.stencil.points.touched
            stays &= near.find(last.facet[which]) >= 0
            moves = inside[which] & ~stays
            # anchors that moved are beside the foot, and belong to the facet that is there
            X = self._nodes[self._facet[moves]]
            N, _, _ = near.tabulate(self.stencil.place[moves])
            lag = self.shear[moves] / np.where(k[moves] > 0.0, k[moves], 1.0)[:, None]
            foot = np.einsum("nk,nki->ni", N, X) + lag
            at, s = self.located(foot, self._nodes, self._facet[moves])
            numbers[which[stays]] = last.facet[which[stays]]
            place[which[stays]] = last.place[which[stays]]
            numbers[which[moves]] = near.number[at]
            place[which[moves]] = s
        anchors = x.copy()
        at = near.find(numbers)
        N, _, _ = near.tabulate(place[at >= 0])
        anchors[at >= 0] = np.einsum("nk,nki->ni", N, self._nodes[at[at >= 0]])
        closest = _numbers(near, found.facet)
        rubbed = last.friction.copy()
        if self.law.memory:
            rubbed[which] = remembered(self.law, self.stencil, self.touch, self.target.extent)
        own = Memory(
            inside, numbers, place, closest, found.gap, self._within, offset, x, anchors, rubbed
        )
        memory = self._remembered(self._flat(self.source.positions()), own)
        untouched = self._untouched(memory.points)
        outcome = Outcome(
            *(
                _spread(getattr(trial, field.name), self._facets, getattr(untouched, field.name))
                for field in fields(Outcome)
            )
        )
        return memory, outcome

    def _returned(
        self, found: Closest, x: NDArray[np.float64]
    ) -> tuple[Closest, NDArray[np.float64]]:
        """Return the pairing at a step's end and where points begin to be pressed from then on.

        A point that has stayed with its facet beyond the facet's end goes to the one that it is on:
        if it did in the next step, its gap would change by as much however short that is, and the
        force without bound. It keeps its energy.
        """
        near = self._near
        assert near is not None
        which = np.flatnonzero(self._within)
        off = np.abs(found.place[which] - near.clamped(found.place[which])).max(axis=1, initial=0.0)
        which = which[(off > 0.0) | (self._evaluations > FREEZE)]
        normals = self._flat(self.source.normals(which=self._facets))[which]
        there = near.closest(x[which], normals, self._nodes, self.reach)
        moves = there.near & (there.facet >= 0) & (there.facet != found.facet[which])
        which = which[moves]
        facet, place, gap = found.facet.copy(), found.place.copy(), found.gap.copy()
        depth = gap[which] - self._offset[which]
        facet[which], place[which], gap[which] = (
            part[moves] for part in (there.facet, there.place, there.gap)
        )
        offset = self._offset.copy()
        offset[which] = np.minimum(gap[which] - depth, 0.0)
        return found._replace(facet=facet, place=place, gap=gap), offset

    def located(
        self,
        points: NDArray[np.float64],
        nodes: NDArray[np.float64],
        otherwise: NDArray[np.int64],
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the facets that points on the surface are on, or else, and their places there."""
        assert self._near is not None
        found = self._near.closest(points, None, nodes, self.reach)
        at = np.where(found.facet >= 0, found.facet, otherwise)
        start = np.where((found.facet >= 0)[:, None], found.place, 0.5)
        return at, self._near.project(points, nodes[at], start)

    def leaks(self) -> bool:
        """Return whether a point has gone through the other body since the last step."""
        near, memory, found, x = self._near, self._last, self._paired, self._x
        assert near is not None and found is not None
        at = near.find(memory.facet)
        # (one beside a thin body may have been behind its far side already)
        before = np.isfinite(memory.gap) & (memory.gap > -0.25 * self.reach)
        was = np.flatnonzero((at >= 0) & before & ~found.near & (self._weights > 0.0))
        if len(was) == 0:
            return False
        X = self._nodes[at[was]]
        s = self._near_place(x[was], X)
        inner = near.clamped(s)
        r, n = separated(near.tabulate(inner), x[was], X, near.outward[at[was]])
        deep = (r * n).sum(axis=1) < -0.75 * self.reach
        beside = np.linalg.norm(s - inner, axis=1) > 0.5
        return bool(np.any(deep & ~beside))

    def _near_place(self, x: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
        assert self._near is not None
        middle = basix.geometry(self._near.element.cell_type).mean(axis=0)
        return self._near.project(x, X, np.tile(middle, (len(x), 1)))

    def restore(
        self,
        touched: NDArray[np.bool_],
        anchors: NDArray[np.float64],
        offset: NDArray[np.float64],
        friction: NDArray[np.float64] | None = None,
    ) -> None:
        """Take what was remembered, on the meshes of now (collective)."""
        self.begin_anew()
        near, memory = self._near, self.memory
        assert near is not None and memory is not None
        nodes = near.positions(self.target.own_nodes(converged=True))
        which = np.flatnonzero(touched.ravel())
        numbers, place = memory.facet.copy(), memory.place.copy()
        found = near.closest(self._flat(anchors)[which], None, nodes, self.reach)
        there = found.facet >= 0
        numbers[which[there]] = near.number[found.facet[there]]
        place[which[there]] = found.place[there]
        rubbed = memory.friction
        if friction is not None and friction.shape[2] == rubbed.shape[1]:
            rubbed = friction.reshape(rubbed.shape)
        self.memory = memory._replace(
            touched=touched.ravel(),
            facet=numbers,
            place=place,
            within=touched.ravel() | memory.within,
            offset=offset.ravel(),
            anchors=self._flat(anchors),
            friction=rubbed,
        )


def _numbers(near: NearFacets, facet: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return numbers of facets by their places, -1 where there is none."""
    numbers = np.full(len(facet), -1, dtype=np.int64)
    numbers[facet >= 0] = near.number[facet[facet >= 0]]
    return numbers


def _nothing(n: int, e: int) -> Closest:
    """Return the closest points of n points to which no facet is near."""
    facet, gap, place = np.full(n, -1, dtype=np.int64), np.full(n, np.inf), np.zeros((n, e))
    return Closest(facet, place, gap, np.zeros(n, dtype=bool), np.zeros(n))


def _spread(part: NDArray[Any], which: NDArray[np.int64], base: NDArray[Any]) -> NDArray[Any]:
    """Return an array with others in some places."""
    whole = base.copy()
    whole[which] = part
    return whole
