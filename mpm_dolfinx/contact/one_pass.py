# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points of one body against facets of another: which meet which, and what is remembered of it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import basix

from .. import _compat
from .contact import Outcome
from .facets import Closest, NearFacets, separated
from .law import Coulomb, Points
from .stencil import Foot, Start, Stencil, acting_now, added_blocks, derivatives, projected
from .surface import Blocks, Surface, global_dofs

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
    """What a pass knows of the last converged step.

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


class Pass:
    """Points of one body against facets of another.

    Args:
        source: The points.
        target: The facets.
        law: Friction, of both passes.
        penalties: In the normal direction and along the surface.

    Attributes:
        share: Share of what both passes bear.
        of_step: Whether forces are those of whole steps of a motion.
        works: This rank's work against pressure and against friction in such a step.
    """

    def __init__(
        self,
        source: Surface,
        target: Surface,
        law: Coulomb,
        penalties: tuple[float, float],
    ) -> None:
        self.source, self.target = source, target
        self.law = self._whole = law
        self._penalties, self.share = penalties, 1.0
        self._comm: MPI.Comm = source.particles.mesh.comm
        self.memory: Memory | None = None
        self.stencil: Stencil | None = None
        self.of_step = False
        self.works = (0.0, 0.0)
        self._near: NearFacets | None = None

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
        self.law = replace(law, cohesion=share * law.cohesion, limit=share * law.limit)
        facing = float(np.median(np.concatenate(self._comm.allgather(target))))
        k = share / (1.0 / source + 1.0 / facing) if len(source) else source
        self._stiffness = np.repeat(k, self.source.nq)
        self.reach = REACH * max(
            float(np.median(np.concatenate(self._comm.allgather(surface.sizes))))
            for surface in (self.source, self.target)
        )
        body = self.target.particles
        sides = len(basix.topology(body.mesh.basix_cell())[self.target.gdim - 1])
        self._number = body.global_index[self.target.cells] * sides + self.target.facets

    @property
    def touch(self) -> float:
        """Gap at which points touch."""
        return max(self.source.touch, self.target.touch)

    def _flat(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return x.reshape(-1, self.source.gdim)

    # -- A step ---------------------------------------------------------------------------------

    def begin(self, converged: bool = True) -> None:
        """Learn of the facets near the points as they are (collective)."""
        self._learn(
            self._flat(self.source.positions(converged)), self.target.node_positions(converged)
        )
        self._paired: Closest | None = None
        self.stencil = None
        self.count = 0

    def _learn(self, x: NDArray[np.float64], nodes: NDArray[np.float64]) -> NearFacets:
        """Learn of the facets near points, for bodies at some positions (collective)."""
        near = NearFacets(self.target, self._number, x, 3.0 * self.reach, nodes)
        self._before = near.positions(self.target.node_positions(converged=True))
        self._start = x, nodes
        self._near = near
        return near

    def _follow(self, x: NDArray[np.float64], nodes: NDArray[np.float64]) -> None:
        """Learn of other facets where bodies have gone far since (collective)."""
        moved = [
            np.linalg.norm(a - b, axis=1).max(initial=0.0)
            for a, b in zip((x, nodes), self._start, strict=True)
        ]
        if self._comm.allreduce(sum(moved), MPI.MAX) <= self.reach:
            return
        paired, before = self._paired, self._near
        assert before is not None
        near = self._learn(x, nodes)
        if paired is not None:
            place = np.where(paired.facet >= 0, near.find(_numbers(before, paired.facet)), -1)
            self._paired = paired._replace(facet=place, near=paired.near & (place >= 0))

    def begin_anew(self) -> None:
        """Take the converged positions for those of points that nothing has touched yet."""
        self.begin()
        x = self._flat(self.source.positions(converged=True))
        assert self._near is not None
        nodes = self._near.positions(self.target.node_positions(converged=True))
        found = self._near.closest(x, self._normals(True), nodes, self.reach)
        self.memory = Memory(
            np.zeros(len(x), dtype=bool),
            _numbers(self._near, found.facet),
            found.place,
            _numbers(self._near, found.facet),
            found.gap,
            found.near & (found.gap <= self.touch),
            np.zeros(len(x)),
            x,
            x,
        )
        self.outcome = self._nothing(x, np.where(found.near, found.gap, np.inf))

    def _normals(self, converged: bool = False) -> NDArray[np.float64]:
        return self._flat(self.source.normals(converged))

    def _nothing(self, x: NDArray[np.float64], gap: NDArray[np.float64]) -> Outcome:
        m, nq, gdim = len(self.source.cells), self.source.nq, self.source.gdim
        none = np.zeros((m, nq), dtype=bool)
        place = x.reshape(m, nq, gdim)
        zero = np.zeros((m, nq))
        return Outcome(place, gap.reshape(m, nq), zero, np.zeros_like(place), none, none)

    def overlap(self) -> tuple[NDArray[np.int64], float] | None:
        """Return particles that are deep in the other body at the beginning, and how deep."""
        depth = -self.outcome.gap
        bound = OVERLAP * self.source.thickness[:, None]
        deep = (depth > bound) & (self.source.weights > 0.0)
        if not deep.any():
            return None
        cells = self.source.cells[deep.any(axis=1)]
        return self.source.particles.global_index[cells], float(depth[deep].max())

    def look(self) -> None:
        """Learn where facets are now (collective)."""
        x = self._flat(self.source.positions())
        node_positions = self.target.node_positions()
        self._follow(x, node_positions)
        assert self._near is not None
        self._x, self._nodes = x, self._near.positions(node_positions)

    def evaluate(self) -> None:
        """Find what acts there."""
        assert self._near is not None
        near, x, nodes = self._near, self._x, self._nodes
        self.count += 1
        found = near.closest(x, self._normals_near(x, nodes), nodes, self.reach)
        if self._paired is not None:
            # A point that slides off an edge goes on to touch until the step's end, or the force
            # would come and go from one iterate to the next.
            stays = self._paired.near & (found.facet >= 0) & (found.beside < LINGER)
            found = found._replace(near=found.near | stays)
        # One that was behind the end of a facet and touched nothing goes on to, until it is behind
        # the facet itself.
        assert self.memory is not None
        out = ~self.memory.within & (self.memory.gap < -self.touch)
        found = found._replace(near=found.near & ~(out & (found.beside >= LINGER)))
        if self.count > FREEZE and self._paired is not None:
            found = self._frozen(found, x, nodes)
        self._paired = found
        gap = np.where(found.near, found.gap, np.inf)
        borne = self.source.weights.ravel() > 0.0
        within = found.near & (gap <= self.touch) & borne
        inside = pressed = within
        self._within, self._offset = within, np.zeros(len(x))
        if self.of_step:
            found, inside, pressed = self._over_step(found, within, x, nodes)
            pressed &= borne
        which = np.flatnonzero(pressed)
        self.stencil = self._stencil(which, found, x, nodes)
        shape = (len(self.source.cells), self.source.nq)
        force = np.zeros_like(x)
        pressure, slips = np.zeros(len(x)), np.zeros(len(x), dtype=bool)
        pushes, rubs, acts = acting_now(self.law, self.stencil, self.touch, self.target.extent)
        both = pushes + rubs
        force[which], pressure[which], slips[which] = both[:, 0], acts.pressure, acts.slips
        self.reaction = both[:, 1:]
        self.shear = acts.shear
        if self.stencil.start is not None:
            change = self.stencil.x[:, : both.shape[1]] - self.stencil.start.x
            w = self.source.weights.ravel()[which]
            done = [-float(w @ (part * change).sum(axis=(1, 2))) for part in (pushes, rubs)]
            self.works = done[0], done[1]
        self.outcome = Outcome(
            x.reshape(*shape, -1),
            gap.reshape(shape),
            pressure.reshape(shape),
            force.reshape(*shape, -1),
            inside.reshape(shape),
            slips.reshape(shape),
        )

    def _normals_near(
        self, x: NDArray[np.float64], nodes: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return normals at the points; zero on facets that are far from all others."""
        m, nq, gdim = len(self.source.cells), self.source.nq, self.source.gdim
        low, high = nodes.min(axis=(0, 1), initial=np.inf), nodes.max(axis=(0, 1), initial=-np.inf)
        within = ((x >= low - self.reach) & (x <= high + self.reach)).all(axis=1)
        which = np.flatnonzero(within.reshape(m, nq).any(axis=1))
        found = np.zeros((m, nq, gdim))
        found[which] = self.source.normals(which=which)
        return self._flat(found)

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
        near, memory = self._near, self.memory
        assert near is not None and memory is not None
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
        near, memory = self._near, self.memory
        assert near is not None and memory is not None
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
        near, memory = self._near, self.memory
        assert near is not None and memory is not None
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
        near, memory = self._near, self.memory
        assert near is not None and memory is not None
        facet = found.facet[which]
        anchor = near.find(memory.facet[which])
        lost = anchor < 0
        # what has come from where nothing was near has no anchor yet
        anchor = np.where(lost, facet, anchor)
        anchored = np.where(lost[:, None], found.place[which], memory.place[which])
        parts = [x[which][:, None], nodes[facet]]
        if not self.law.smooth:
            parts.append(nodes[anchor])
        k = self._stiffness[which]
        points = Points(
            self._penalties[0] * k,
            np.where(lost, 0.0, self._penalties[1] * k),
            memory.touched[which] | lost,
            np.zeros((len(which), 0)),
            np.where(lost, 0.0, memory.gap[which]),
            self.source.stretch(self.law.by_area).ravel()[which],
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
        )

    def forces(self) -> tuple[PETSc.Vec, PETSc.Vec]:
        """Return the forces on the nodes of both bodies (collective)."""
        assert self._near is not None and self.stencil is not None
        source = self.source
        first = source.force(self.outcome.traction)
        second = _compat.create_vector(self.target.particles.W)
        w = source.weights.ravel()[self.stencil.which]
        values = w[:, None, None] * self.reaction
        dofs = self._near.dofs[self._facet].astype(PETSc.IntType)
        second.setValues(dofs.ravel(), values.ravel(), addv=PETSc.InsertMode.ADD_VALUES)
        second.assemble()
        return first, second

    def blocks(self, factor: float) -> dict[tuple[int, int], list[Blocks]]:
        """Return what the forces' derivatives add to matrices, by (source 0, target 1).

        Args:
            factor: What they are multiplied by.
        """
        near, source = self._near, self.source
        assert near is not None and self.stencil is not None
        k = near.element.dim
        which = self.stencil.which
        facet_of, point = which // source.nq, which % source.nq
        w = -factor * source.weights.ravel()[which]
        D = derivatives(self.law, self.stencil, self.touch, self.target.extent)
        N, none = source.shapes[point], np.zeros((0, k))
        own = global_dofs(source.particles.W, source.nodes[facet_of])
        columns = [
            (0, 0, facet_of, own, N),
            (1, 1, near.number[self._facet], near.dofs[self._facet], none),
        ]
        if not self.law.smooth:
            anchors = near.number[self._anchor], near.dofs[self._anchor]
            columns.append((1, 1 + k, *anchors, none))
        found: dict[tuple[int, int], list[Blocks]] = {}
        for row, first_row, row_key, row_dofs, row_shapes in columns[:2]:
            for column, first_column, column_key, column_dofs, column_shapes in columns:
                keys, one, number = _grouped(row_key, column_key)
                shape = (len(keys), row_dofs.shape[1], column_dofs.shape[1])
                rows, cols = (first_row, row_shapes), (first_column, column_shapes)
                values = added_blocks(D, w, number, rows, cols, shape)
                blocks = Blocks(keys, row_dofs[one], column_dofs[one], values)
                found.setdefault((row, column), []).append(blocks)
        return found

    # -- The next step --------------------------------------------------------------------------

    def after(self) -> Memory:
        """Return what is to be remembered of the last evaluation, if it is that of a step."""
        near, memory, found = self._near, self.memory, self._paired
        assert near is not None and memory is not None and found is not None
        assert self.stencil is not None
        x = self._flat(self.outcome.positions)
        offset = self._offset
        if self.of_step:
            found, offset = self._returned(found, x)
        place, numbers = found.place.copy(), _numbers(near, found.facet)
        which = self.stencil.which
        if not self.law.smooth and len(which):
            inside = self.outcome.inside.ravel()[which]
            slips = self.outcome.slips.ravel()[which]
            k = self.stencil.points.tangential
            stays = inside & ~slips & self.stencil.points.touched
            stays &= near.find(memory.facet[which]) >= 0
            moves = inside & ~stays
            # anchors that moved are beside the foot, and belong to the facet that is there
            X = self._nodes[self._facet[moves]]
            N, _, _ = near.tabulate(self.stencil.place[moves])
            lag = self.shear[moves] / np.where(k[moves] > 0.0, k[moves], 1.0)[:, None]
            foot = np.einsum("nk,nki->ni", N, X) + lag
            at, s = self.located(foot, self._nodes, self._facet[moves])
            numbers[which[stays]] = memory.facet[which[stays]]
            place[which[stays]] = memory.place[which[stays]]
            numbers[which[moves]] = near.number[at]
            place[which[moves]] = s
        anchors = x.copy()
        at = near.find(numbers)
        N, _, _ = near.tabulate(place[at >= 0])
        anchors[at >= 0] = np.einsum("nk,nki->ni", N, self._nodes[at[at >= 0]])
        inside = self.outcome.inside.ravel().copy()
        closest = _numbers(near, found.facet)
        return Memory(
            inside,
            numbers,
            place,
            closest,
            found.gap,
            self._within,
            offset,
            x,
            anchors,
        )

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
        which = which[(off > 0.0) | (self.count > FREEZE)]
        there = near.closest(
            x[which], self._normals_near(x, self._nodes)[which], self._nodes, self.reach
        )
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
        near, memory, found = self._near, self.memory, self._paired
        assert near is not None and memory is not None and found is not None
        x = self._flat(self.outcome.positions)
        at = near.find(memory.facet)
        # (one beside a thin body may have been behind its far side already)
        before = np.isfinite(memory.gap) & (memory.gap > -0.25 * self.reach)
        was = np.flatnonzero((at >= 0) & before & (self.source.weights.ravel() > 0))
        if len(was) == 0:
            return False
        X = self._nodes[at[was]]
        s = self._near_place(x[was], X)
        inner = near.clamped(s)
        r, n = separated(near.tabulate(inner), x[was], X, near.outward[at[was]])
        deep = (r * n).sum(axis=1) < -0.75 * self.reach
        beside = np.linalg.norm(s - inner, axis=1) > 0.5
        return bool(np.any(deep & ~beside & ~found.near[was]))

    def _near_place(self, x: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
        assert self._near is not None
        middle = basix.geometry(self._near.element.cell_type).mean(axis=0)
        return self._near.project(x, X, np.tile(middle, (len(x), 1)))

    def restore(
        self,
        touched: NDArray[np.bool_],
        anchors: NDArray[np.float64],
        offset: NDArray[np.float64],
    ) -> None:
        """Take what was remembered, on the meshes of now (collective)."""
        self.begin_anew()
        near, memory = self._near, self.memory
        assert near is not None and memory is not None
        nodes = near.positions(self.target.node_positions(converged=True))
        which = np.flatnonzero(touched.ravel())
        numbers, place = memory.facet.copy(), memory.place.copy()
        found = near.closest(self._flat(anchors)[which], None, nodes, self.reach)
        there = found.facet >= 0
        numbers[which[there]] = near.number[found.facet[there]]
        place[which[there]] = found.place[there]
        self.memory = memory._replace(
            touched=touched.ravel(),
            facet=numbers,
            place=place,
            within=touched.ravel() | memory.within,
            offset=offset.ravel(),
            anchors=self._flat(anchors),
        )


def _numbers(near: NearFacets, facet: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return numbers of facets by their places, -1 where there is none."""
    numbers = np.full(len(facet), -1, dtype=np.int64)
    numbers[facet >= 0] = near.number[facet[facet >= 0]]
    return numbers


def _grouped(
    a: NDArray[np.int64], b: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return different pairs of numbers ``(m, 2)``, one place of each, and which each place has."""
    order = np.lexsort((b, a))
    keys = np.column_stack([a, b])[order]
    new = np.append(True, (np.diff(keys, axis=0) != 0).any(axis=1))[: len(keys)]
    number = np.zeros(len(a), dtype=np.int64)
    number[order] = np.cumsum(new) - 1
    return keys[new], order[new], number
