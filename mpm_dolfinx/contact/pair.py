# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact of two deformable bodies: points of one against facets of the other.

With two passes each body's points meet the other's facets, at half the stiffness each where facets
are alike in size, at more of it for the points of much finer ones. The reaction
acts on the facet as if the point were fixed to it by a rigid arm along its normal, so that forces
and moments of both bodies balance, also where friction acts at a gap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import basix
from dolfinx import mesh

from .. import _compat
from ..errors import ConvergenceError, MPMError, agree, agreed
from ..io.snapshot import Taken
from ..meshes.remesh import Column
from ..parallel.given import require_same
from ..particles.particles import Particles
from ..system.term import PointMaterial
from .contact import Contact, Outcome, stiffness
from .facets import Closest, NearFacets, solved
from .law import Coulomb, Points, Traction, as_friction, traction
from .shapes import as_positive
from .surface import Blocks, PointMatrix, Surface, global_dofs, normals
from .whole_step import corrected, deformation, mean_pressure

__all__ = ["Pair"]

#: How near surfaces are looked for, in facets' sizes.
REACH = 2.0
#: Residuals of an attempt after which points stay with their facets.
FREEZE = 12
#: How far a point may slide off a facet's edge within a step, over the facet's size.
LINGER = 0.1
#: Penetration, over the thickness of the domain behind, of bodies as they are given.
OVERLAP = 0.1
#: Step of the complex derivative.
STEP = 1e-40
#: Ratio of the sizes of facets up to which two passes bear the same, and the least that one bears.
ALIKE, LEAST = 1.5, 0.2
#: Degree of the rule on a facet, by the dimension of space: the other body's facets have kinks.
DEGREES = {2: 9, 3: 5}


class _Memory(NamedTuple):
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


type _Table = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


class _Start(NamedTuple):
    """Where a step of a motion begins, at some points.

    Attributes:
        x: Positions of points and nodes of their facets, shape ``(n, 1 + k, gdim)``.
        table: Shape functions with derivatives where the points are projected in the middle of the
            step: see :meth:`NearFacets.tabulate`.
        gap: The gap, infinite where nothing was near, shape ``(n,)``.
        offset: As that of :class:`_Memory`.
    """

    x: NDArray[np.float64]
    table: _Table
    gap: NDArray[np.float64]
    offset: NDArray[np.float64]


class _Stencil(NamedTuple):
    """What the tractions at some points depend on.

    Attributes:
        which: The points.
        place: Their projections on facets.
        table: Shape functions with derivatives there: see :meth:`NearFacets.tabulate`.
        anchored: Shape functions at their anchors.
        x: Positions of points, nodes of their facets and of those of their anchors, ``(n, k, i)``.
        points: Stiffness and memory.
        outward: As that of :class:`Surface`.
        start: Where the step begins, if it is one of a motion.
    """

    which: NDArray[np.int64]
    place: NDArray[np.float64]
    table: _Table
    anchored: NDArray[np.float64]
    x: NDArray[Any]
    points: Points
    outward: NDArray[np.float64]
    start: _Start | None


class _Foot(NamedTuple):
    """Projections of points on facets, which may have a small imaginary part.

    Attributes:
        N: Shape functions there, shape ``(n, k)``.
        dN: Their derivatives, shape ``(n, e, k)``.
        along: Tangents, shape ``(n, e, gdim)``.
        n: Normals, shape ``(n, gdim)``.
        gap: Shape ``(n,)``.
    """

    N: NDArray[Any]
    dN: NDArray[Any]
    along: NDArray[Any]
    n: NDArray[Any]
    gap: NDArray[Any]


class _Acting(NamedTuple):
    """What acts on points and on nodes of their facets.

    Attributes:
        pushes: Tractions by pressure on points and nodes, shape ``(n, 1 + k, gdim)``.
        rubs: The same by friction.
        acts: Pressure and shear.
    """

    pushes: NDArray[Any]
    rubs: NDArray[Any]
    acts: Traction


class _Pass:
    """Points of one body against facets of another (or of itself).

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
        self.memory: _Memory | None = None
        self.stencil: _Stencil | None = None
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

    def _apart(self) -> tuple[NDArray[np.float64], float] | None:
        if self.source.particles is not self.target.particles:
            return None
        return self._flat(self.source.undeformed()), 2.0 * self.reach

    # -- A step ---------------------------------------------------------------------------------

    def begin(self, converged: bool = True) -> None:
        """Learn of the facets near the points as they are (collective)."""
        x = self._flat(self.source.positions(converged))
        nodes = self.target.node_positions(converged)
        self._near = NearFacets(self.target, self._number, x, 3.0 * self.reach, nodes)
        self._before = self._near.positions(self.target.node_positions(converged=True))
        self._start = x, nodes
        self._paired: Closest | None = None
        self.stencil = None
        self.count = 0

    def _follow(self, x: NDArray[np.float64], nodes: NDArray[np.float64]) -> None:
        """Learn of other facets where bodies have gone far since (collective)."""
        moved = [
            np.linalg.norm(a - b, axis=1).max(initial=0.0)
            for a, b in zip((x, nodes), self._start, strict=True)
        ]
        if self._comm.allreduce(sum(moved), MPI.MAX) <= self.reach:
            return
        paired, near = self._paired, self._near
        assert near is not None
        self._near = NearFacets(self.target, self._number, x, 3.0 * self.reach, nodes)
        self._before = self._near.positions(self.target.node_positions(converged=True))
        self._start = x, nodes
        if paired is not None:
            place = np.where(paired.facet >= 0, self._near.find(_numbers(near, paired.facet)), -1)
            self._paired = paired._replace(facet=place, near=paired.near & (place >= 0))

    def begin_anew(self) -> None:
        """Take the converged positions for those of points that nothing has touched yet."""
        self.begin()
        x = self._flat(self.source.positions(converged=True))
        assert self._near is not None
        nodes = self._near.positions(self.target.node_positions(converged=True))
        found = self._near.closest(x, self._normals(True), nodes, self.reach, self._apart())
        self.memory = _Memory(
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
        found = near.closest(x, self._normals(), nodes, self.reach, self._apart())
        if self._paired is not None:
            # A point that slides off an edge goes on to touch until the step's end, or the force
            # would come and go from one iterate to the next.
            stays = self._paired.near & (found.facet >= 0) & (found.beside < LINGER)
            found = found._replace(near=found.near | stays)
        if self.count > FREEZE and self._paired is not None:
            found = self._frozen(found, x, nodes)
        self._paired = found
        gap = np.where(found.near, found.gap, np.inf)
        borne = self.source.weights.ravel() > 0.0
        within = found.near & (gap <= self.touch) & borne
        inside = acting = within
        self._within, self._offset = within, np.zeros(len(x))
        if self.of_step:
            found, inside, acting = self._over_step(found, within, x, nodes)
            acting &= borne
        which = np.flatnonzero(acting)
        self.stencil = self._stencil(which, found, x, nodes)
        shape = (len(self.source.cells), self.source.nq)
        force = np.zeros_like(x)
        pressure, slips = np.zeros(len(x)), np.zeros(len(x), dtype=bool)
        pushes, rubs, acts = self._act(self.stencil, self.stencil.x)
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
            foot = self._foot(table, x[lost], nodes[at], near.outward[at])
            facet[lost], gap[lost] = at, foot.gap
            found = found._replace(facet=facet, place=place, gap=gap)
        sideways = within & ~memory.within & (memory.gap < -self.touch)
        offset = np.where(memory.within, np.clip(found.gap, memory.offset, 0.0), 0.0)
        self._offset = np.where(within, np.where(sideways, found.gap, offset), 0.0)
        inside = within & ~sideways & (found.gap - memory.offset <= self.touch)
        out = (found.facet >= 0) & (found.near | (found.gap > self.touch))
        return found, inside, inside | (memory.within & out)

    def _frozen(
        self, found: Closest, x: NDArray[np.float64], nodes: NDArray[np.float64]
    ) -> Closest:
        """Return the pairing of before, with projections as they are now."""
        assert self._near is not None and self._paired is not None
        before = self._paired
        keep = np.flatnonzero(before.near)
        facet, place = found.facet.copy(), found.place.copy()
        gap, near = found.gap.copy(), found.near.copy()
        facet[keep] = before.facet[keep]
        X = nodes[facet[keep]]
        s = self._near.project(x[keep], X, before.place[keep])
        N, dN, _ = self._near.tabulate(s)
        n = normals(np.einsum("nek,nki->nie", dN, X))
        n = n * (self._near.outward[facet[keep]] / np.linalg.norm(n, axis=1))[:, None]
        place[keep], near[keep] = s, True
        gap[keep] = ((x[keep] - np.einsum("nk,nki->ni", N, X)) * n).sum(axis=1)
        return Closest(facet, place, gap, near, found.beside)

    def _stencil(
        self,
        which: NDArray[np.int64],
        found: Closest,
        x: NDArray[np.float64],
        nodes: NDArray[np.float64],
    ) -> _Stencil:
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
        )
        self._facet, self._anchor = facet, anchor
        start = None
        if self.of_step:
            before = np.concatenate([memory.points[which][:, None], self._before[facet]], axis=1)
            middle = 0.5 * (before + np.concatenate(parts[:2], axis=1))
            place = near.project(middle[:, 0], middle[:, 1:], found.place[which])
            table = near.tabulate(place)
            start = _Start(before, table, memory.gap[which], memory.offset[which])
        return _Stencil(
            which,
            found.place[which],
            near.tabulate(found.place[which]),
            near.tabulate(anchored)[0],
            np.concatenate(parts, axis=1),
            points,
            near.outward[facet],
            start,
        )

    def _foot(
        self,
        table: _Table,
        x: NDArray[Any],
        X: NDArray[Any],
        outward: NDArray[np.float64],
    ) -> _Foot:
        """Return projections of points ``(n, i)`` on facets with nodes ``(n, k, i)``.

        Args:
            table: Shape functions with derivatives there.
            x: The points, real or with a small imaginary part.
            X: The nodes.
            outward: As that of :class:`Surface`.
        """
        N, dN, ddN = table
        # One step of Newton's method has the derivative of the projection exactly.
        r = x - np.einsum("nk,nki->ni", N, X)
        A = np.einsum("nek,nki->nei", dN, X)
        B = np.einsum("nefk,nki->nefi", ddN, X)
        G = (A @ A.swapaxes(1, 2) - np.einsum("nefi,ni->nef", B, r)).real
        ds = solved(G, np.einsum("nei,ni->ne", A, r))
        N = N + np.einsum("nek,ne->nk", dN, ds)
        dN = dN + np.einsum("nefk,nf->nek", ddN, ds)
        r = x - np.einsum("nk,nki->ni", N, X)
        A = np.einsum("nek,nki->nei", dN, X)
        n = outward[:, None] * normals(A.swapaxes(1, 2))
        n = n / np.sqrt((n * n).sum(axis=1))[:, None]
        return _Foot(N, dN, A, n, (r * n).sum(axis=1))

    def _act(self, stencil: _Stencil, z: NDArray[Any]) -> _Acting:
        """Return what acts on the points and on nodes of their facets.

        Args:
            stencil: The points.
            z: Their stencils' positions, real or with a small imaginary part.
        """
        near, start = self._near, stencil.start
        assert near is not None
        both = z[:, : 1 + near.element.dim]
        x, X = both[:, 0], both[:, 1:]
        foot = self._foot(stencil.table, x, X, stencil.outward)
        delta = np.zeros_like(x)
        if not self.law.smooth:
            delta = x - np.einsum("nk,nki->ni", stencil.anchored, z[:, 1 + near.element.dim :])
        if start is None:
            acts = traction(self.law, stencil.points, delta, foot.gap, foot.n, self.touch)
            gradient = _gradient(foot)
        else:
            gap, middle, change = foot.gap, 0.5 * (start.x + both), both - start.x
            foot = self._foot(start.table, middle[:, 0], middle[:, 1:], stencil.outward)
            gradient = _gradient(foot)
            linear = gap - (gradient * change).sum(axis=(1, 2))
            linear = np.where(linear.real > 0.0, linear, 0.0)
            before = np.where(np.isfinite(start.gap), start.gap, linear)
            v = deformation(middle, change)
            gradient, _ = corrected(gradient, change, v, gap - before, self.target.extent)
            gap, before = gap - start.offset, before - start.offset
            p = mean_pressure(stencil.points.stiffness, before, gap, self.touch)
            acts = traction(self.law, stencil.points, delta, gap, foot.n, self.touch, p)
        pushes = acts.pressure[:, None, None] * gradient
        # the arm g n turns with the facet
        A = foot.along
        along = solved(A @ A.swapaxes(1, 2), np.einsum("nei,ni->ne", A, acts.shear))
        turn = -foot.gap[:, None] * np.einsum("nek,ne->nk", foot.dN, along)
        rubs = -(foot.N[:, :, None] * acts.shear[:, None, :] + turn[:, :, None] * foot.n[:, None])
        return _Acting(pushes, np.concatenate([acts.shear[:, None], rubs], axis=1), acts)

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

    def derivatives(self) -> NDArray[np.float64]:
        """Return the derivative of all forces at the points' stencils, ``(n, 1 + k, i, z, j)``."""
        assert self.stencil is not None
        z = self.stencil.x.astype(np.complex128)
        n, count, gdim = z.shape
        assert self._near is not None
        D = np.zeros((n, 1 + self._near.element.dim, gdim, count, gdim))
        if n == 0:
            return D
        # (nothing acts where all are shifted, so that the points' derivatives follow)
        for node in range(1, count):
            for j in range(gdim):
                kept = z[:, node, j].copy()
                z[:, node, j] += 1j * STEP
                pushes, rubs, _ = self._act(self.stencil, z)
                z[:, node, j] = kept
                D[:, :, :, node, j] = (pushes + rubs).imag / STEP
        D[:, :, :, 0] = -D[:, :, :, 1:].sum(axis=3)
        return D

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
        D = self.derivatives() * w[:, None, None, None, None]
        N = source.shapes[point]
        own = global_dofs(source.particles.W, source.nodes[facet_of])
        columns: list[tuple[int, NDArray[np.int64], NDArray[np.int64], slice]] = [
            (0, facet_of, own, slice(0, 1)),
            (1, near.number[self._facet], near.dofs[self._facet], slice(1, 1 + k)),
        ]
        if not self.law.smooth:
            columns.append(
                (1, near.number[self._anchor], near.dofs[self._anchor], slice(1 + k, 1 + 2 * k))
            )
        rows = columns[:2]
        found: dict[tuple[int, int], list[Blocks]] = {}
        for row, row_key, row_dofs, row_part in rows:
            for column, column_key, column_dofs, column_part in columns:
                block = D[:, row_part, :, column_part, :]
                if row == 0:
                    block = N[:, :, None, None, None] * block
                if column == 0:
                    block = block * N[:, None, None, :, None]
                n, a, i, b, j = block.shape
                values = block.reshape(n, a * i, b * j)
                keys = np.column_stack([row_key, column_key])
                found.setdefault((row, column), []).append(
                    Blocks(keys, row_dofs, column_dofs, values)
                )
        return found

    # -- The next step --------------------------------------------------------------------------

    def after(self) -> _Memory:
        """Return what is to be remembered of the last evaluation, if it is that of a step."""
        near, memory, found = self._near, self.memory, self._paired
        assert near is not None and memory is not None and found is not None
        assert self.stencil is not None
        x = self._flat(self.outcome.positions)
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
        return _Memory(
            inside,
            numbers,
            place,
            closest,
            found.gap,
            self._within,
            self._offset,
            x,
            anchors,
        )

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
        was = np.flatnonzero(
            (at >= 0) & np.isfinite(memory.gap) & (self.source.weights.ravel() > 0)
        )
        if len(was) == 0:
            return False
        X = self._nodes[at[was]]
        s = self._near_place(x[was], X)
        inner = near.clamped(s)
        N, dN, _ = near.tabulate(inner)
        r = x[was] - np.einsum("nk,nki->ni", N, X)
        n = normals(np.einsum("nek,nki->nie", dN, X))
        n = n * (near.outward[at[was]] / np.linalg.norm(n, axis=1))[:, None]
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


def _gradient(foot: _Foot) -> NDArray[Any]:
    """Return the gradient of the gap by the point and the nodes of its facet, ``(n, 1 + k, i)``."""
    n = foot.n[:, None, :]
    return np.concatenate([n, -foot.N[:, :, None] * n], axis=1)


class Pair(Contact):
    """Contact of two bodies, each on a background of its own, with friction.

    Bodies on the same V stick where they touch; give them different ones, which may be made on the
    same mesh. Then they feel each other by contact alone, where their facets meet::

        touch = mpm.contact.Pair(a, b, friction=0.2)
        problem = mpm.QuasiStaticProblem([a, b], law, terms=[touch])

    Points on the facets of each body meet the facets of the other, with the pressure of
    :class:`Rigid` for the stiffness of both bodies one behind the other.

    Args:
        a: A body; what the contact tells is told at its points first.
        b: The other body.
        friction: Coefficient of friction, or a :class:`Coulomb`.
        facet_tags: Tags of the facets of a and of b, where not all of their boundaries may touch.
        tags: The tags of those that may.
        moduli: Moduli of a and b; those of their materials by default.
        passes: 2, or 1: points of a (best the body with the finer facets) against facets of b.
        penalty: As for :class:`Rigid`.
        tangential_penalty: As there.
        quadrature_degree: Degree of the rule on each facet; ``None`` is 9 in the plane and 5 in
            space, since the facets on the other side have kinks.
        axisymmetric: As there.

    Raises:
        MPMError: What makes no sense.
    """

    def __init__(
        self,
        a: Particles,
        b: Particles,
        friction: float | Coulomb = 0.0,
        *,
        facet_tags: Sequence[mesh.MeshTags | None] = (None, None),
        tags: Sequence[int | None] = (None, None),
        moduli: Sequence[float | None] = (None, None),
        passes: int = 2,
        penalty: float = 1.0,
        tangential_penalty: float = 1.0,
        quadrature_degree: int | None = None,
        axisymmetric: bool = False,
    ) -> None:
        for body in (a, b):
            if not isinstance(body, Particles):
                raise MPMError(f"A contact needs mpm.Particles, not {type(body).__name__}.")
        if a is b:
            raise MPMError(
                "A Pair needs two bodies, not the same one twice: places of one body that are in "
                "one cell of its V move together and never meet. Cut the body in two where it is "
                "to touch itself, with a V for each part, and tie them where they hang together."
            )
        if a.V is b.V:
            raise MPMError(
                "The bodies of a Pair are on the same V, which makes them stick; give each its "
                "own, such as a second function space on the same mesh."
            )
        if passes not in (1, 2):
            raise MPMError(f"A Pair has 1 or 2 passes, not {passes!r}.")
        for name, value in (("facet_tags", facet_tags), ("tags", tags), ("moduli", moduli)):
            if not isinstance(value, list | tuple) or len(value) != 2:
                raise MPMError(f"{name} of a Pair must be two, one for each body, not {value!r}.")
        law = as_friction(friction)
        require_same(
            a.mesh.comm,
            friction=[law.friction, law.cohesion, law.limit],
            tags=list(tags),
            moduli=list(moduli),
            passes=passes,
            penalty=penalty,
            tangential_penalty=tangential_penalty,
            quadrature_degree=quadrature_degree,
            axisymmetric=axisymmetric,
        )
        super().__init__([a, b], law, axisymmetric)
        self._moduli = [None if m is None else as_positive(m, "modulus") for m in moduli]
        penalties = (
            as_positive(penalty, "penalty"),
            as_positive(tangential_penalty, "tangential_penalty"),
        )
        degree = DEGREES[a.mesh.geometry.dim] if quadrature_degree is None else quadrature_degree
        self._surfaces = [
            Surface(body, some, tag, degree, axisymmetric, "A Pair")
            for body, some, tag in zip((a, b), facet_tags, tags, strict=True)
        ]
        self._passes = [
            _Pass(self._surfaces[i], self._surfaces[1 - i], law, penalties) for i in range(passes)
        ]
        self._made, self._begins = False, True
        self._last: list[Outcome] | None = None

    # -- The term -------------------------------------------------------------------------------

    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        """See :meth:`Term.take_part`."""
        super().take_part(number, bodies, materials)
        first = not self._made
        self._settle()
        if first:
            self._require_apart()

    def _settle(self, again: bool = False) -> None:
        """Take the present meshes of the bodies (collective)."""
        new = [surface.settle() for surface in self._surfaces]
        if not any(new) and not again:
            return
        k = [
            stiffness(surface, modulus, material, "A Pair")
            for surface, modulus, material in zip(
                self._surfaces, self._moduli, self._materials, strict=True
            )
        ]
        shares = self._shares()
        for i, each in enumerate(self._passes):
            each.settle(k[i], k[1 - i], shares[i])
            each.begin_anew()
        self._made, self._last = True, None
        self._new_pattern()

    def _shares(self) -> list[float]:
        """Return what each pass bears (collective).

        Points on facets of a size h see kinks of the other body's shape functions with an error of
        the order of h^2, so that the points of facets that are much finer bear more.
        """
        if len(self._passes) == 1:
            return [1.0]
        squares = [
            float(np.median(np.concatenate(self._comm.allgather(surface.sizes)))) ** 2
            for surface in self._surfaces
        ]
        if max(squares) < ALIKE**2 * min(squares):
            return [0.5, 0.5]
        first = float(np.clip(squares[1] / sum(squares), LEAST, 1.0 - LEAST))
        return [first, 1.0 - first]

    def _new_pattern(self) -> None:
        spaces = [body.W for body in self.bodies]
        self._matrices = {(i, j): PointMatrix(spaces[i], spaces[j]) for i in (0, 1) for j in (0, 1)}

    def _require_apart(self) -> None:
        for each in self._passes:
            deep = each.overlap()
            with agree(self._comm):
                if deep is not None:
                    raise MPMError(
                        f"The bodies of a Pair overlap at the beginning: {{particles}} are up to "
                        f"{deep[1]:.3g} deep in the other body; move the bodies apart.",
                        deep[0],
                    )

    def begin(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.begin`.

        What was evaluated last stays until the next evaluation: it may still be committed.
        """
        self._settle()
        for surface in self._surfaces:
            surface.look_at_deleted()
        self._begins = True
        return ()

    def _look(self) -> None:
        """Learn where facets are now (collective)."""
        if self._begins:
            self._begins = False
            for each in self._passes:
                each.of_step = self._of_step
                each.begin()
            self._new_pattern()
        for each in self._passes:
            each.look()

    def update(self) -> MPMError | None:
        """See :meth:`Term.update`."""
        self._look()
        try:
            for each in self._passes:
                each.evaluate()
        except np.linalg.LinAlgError:
            return ConvergenceError("Facets of a Pair collapse; take smaller steps")
        return None

    def smooth(self) -> bool:
        """See :meth:`Term.smooth`: contact is not."""
        return not any(
            each.outcome.inside.any() or (each.memory is not None and each.memory.touched.any())
            for each in self._passes
        )

    def residuals(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.residuals`."""
        if self._begins or any(each.stencil is None for each in self._passes):
            self._look()
            for each in self._passes:
                each.evaluate()
        first, second = self._passes[0].forces()
        for each in self._passes[1:]:
            on_b, on_a = each.forces()
            first.axpy(1.0, on_a)
            second.axpy(1.0, on_b)
        for force in (first, second):
            force.scale(-1.0 / self._share)
        return [first, second]

    def _works(self) -> tuple[float, float]:
        """See :meth:`Contact._works`."""
        normal, shear = np.sum([each.works for each in self._passes], axis=0)
        return float(normal), float(shear)

    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """See :meth:`Term.tangents`."""
        parts: dict[tuple[int, int], list[Blocks]] = {pair: [] for pair in self._matrices}
        for number, each in enumerate(self._passes):
            for (i, j), blocks in each.blocks(1.0 / self._share).items():
                parts[abs(i - number), abs(j - number)] += blocks
        found = {pair: self._matrices[pair].of(blocks) for pair, blocks in parts.items()}
        return {pair: K for pair, K in found.items() if K is not None}

    # -- What it remembers ----------------------------------------------------------------------

    def commit(self) -> Callable[[], None]:
        """See :meth:`Term.commit`.

        Raises:
            ConvergenceError: One body has gone through the other.
        """
        failure: MPMError | None = None
        if any([each.leaks() for each in self._passes]):
            failure = ConvergenceError(
                "A body goes through the other one of a Pair in one step; take smaller steps"
            )
        if (failure := agreed(self._comm, failure)) is not None:
            raise failure
        before = [each.memory for each in self._passes]
        told = self._last
        for each in self._passes:
            each.memory = each.after()
        self._last = [each.outcome for each in self._passes]

        def undo() -> None:
            for each, memory in zip(self._passes, before, strict=True):
                each.memory = memory
            self._last = told

        return undo

    def _told(self) -> list[Outcome]:
        if self._last is None:
            return [each.outcome for each in self._passes]
        return self._last

    def roll_back(self) -> None:
        """See :meth:`Term.roll_back`."""
        for each, outcome in zip(self._passes, self._told(), strict=True):
            each.outcome = outcome

    def _outcome(self) -> tuple[Surface, Outcome]:
        """Return what the points of a tell: with two passes they bear their share alone."""
        if not self._made:
            raise MPMError("A contact belongs to no problem yet; give it as terms=[contact].")
        told, share = self._told()[0], self._passes[0].share
        return self._surfaces[0], replace(
            told, pressure=told.pressure / share, traction=told.traction / share
        )

    def _forces(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Return positions of all points, and the forces there on a."""
        if not self._made:
            raise MPMError("A contact belongs to no problem yet; give it as terms=[contact].")
        found = []
        for number, outcome in enumerate(self._told()):
            surface, sign = self._surfaces[number], 1.0 - 2.0 * number
            force = sign * surface.weights[:, :, None] * outcome.traction
            gdim = surface.gdim
            found.append((outcome.positions.reshape(-1, gdim), force.reshape(-1, gdim)))
        return found

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force on a, shape ``(gdim,)``, on all ranks (collective); that on b is the opposite."""
        mine = np.sum([force.sum(axis=0) for _, force in self._forces()], axis=0)
        return np.asarray(self._comm.allreduce(mine))

    def moment(self, about: Any) -> NDArray[np.float64]:
        """Return the moment on a: see :meth:`Contact.moment`; that on b is the opposite."""
        parts = self._forces()
        return self._moment([x for x, _ in parts], [force for _, force in parts], about)

    def columns(self, body: int | None) -> dict[str, Column]:
        """See :meth:`Contact.columns`."""
        if body is None or body not in self._places:
            return {}
        number = self._places.index(body)
        surface = self._surfaces[number]
        columns = surface.columns()
        if number < len(self._passes):
            memory, outcome = self._passes[number].memory, self._told()[number]
            assert memory is not None
            shape = outcome.inside.shape
            columns["anchor"] = surface.column(memory.anchors.reshape(*shape, surface.gdim))
            columns["touches"] = surface.column(memory.touched.reshape(shape))
            columns["offset"] = surface.column(memory.offset.reshape(shape))
            columns["slips"] = surface.column(outcome.slips)
            columns["pressure"] = surface.column(outcome.pressure)
            columns["traction"] = surface.column(outcome.traction)
        return columns

    def take(self, taken: Taken) -> None:
        """See :meth:`Contact.take`."""
        self._settle()
        every = [taken.columns[place] for place in self._places]
        for surface, columns in zip(self._surfaces, every, strict=True):
            surface.restore(columns)
        self._settle(again=True)
        for each, surface, columns in zip(self._passes, self._surfaces, every, strict=False):
            touched = surface.of_column(columns["touches"])
            each.restore(
                touched,
                surface.of_column(columns["anchor"]),
                surface.of_column(columns["offset"]),
            )
        self.update()
        self._last = [
            replace(
                each.outcome,
                inside=surface.of_column(columns["touches"]),
                slips=surface.of_column(columns["slips"]),
                pressure=surface.of_column(columns["pressure"]),
                traction=surface.of_column(columns["traction"]),
            )
            for each, surface, columns in zip(self._passes, self._surfaces, every, strict=False)
        ]
