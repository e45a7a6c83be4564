# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Unknowns of free nodes, beside those of the background that carries the rest of their body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..assembly.blocks import Restriction
from ..background.basis import PointBasis
from ..errors import MPMError, agree
from ..parallel.totals import over_ranks
from ..particles.field import CarriedField
from ..particles.free import FreeNodes
from ..particles.particles import Particles
from ..transfer.matrix import transfer_matrix
from ..transfer.touched import JointNodes, joined_rows
from .field import Field
from .hierarchy import FieldDofs

__all__ = ["FreeField", "Subspace"]


class FreeField(Field):
    """The free nodes of a body as a field: its space is W, its unknowns are their dofs.

    A component of a free node that the background would carry by held dofs alone follows these, and
    what holds it counts as a reaction of theirs. Where they move it goes with them, and follows
    them as long as they are held, as nodes of finite elements do. All calls are collective.

    Args:
        nodes: The free nodes.
        host: The background space that carries the other nodes.
        conditions: Dirichlet conditions, of which those on W count.

    Attributes:
        nodes: As given.
        host: As given.

    Raises:
        MPMError: A condition on W holds nodes that are carried.
    """

    def __init__(
        self, nodes: FreeNodes, host: Field, conditions: Sequence[fem.DirichletBC] = ()
    ) -> None:
        super().__init__([nodes], conditions)
        self.nodes, self.host = nodes, host
        self._beneath: PETSc.Mat | None = None
        self._followers, self._bound = (np.zeros(self._owned, dtype=bool) for _ in range(2))
        self._held()

    def _held(self) -> NDArray[np.bool_]:
        """Return which own dofs of W conditions hold; they are of free nodes."""
        fixed = self.prescribed.held
        carried = fixed & ~self.nodes.dofs
        with agree(self._comm):
            if fixed.any() and self.nodes.automatic:
                raise MPMError(
                    "A Dirichlet condition on particles.W holds nodes that free='auto' may let the "
                    "background carry; hold them by conditions on V or a support."
                )
            if carried.any():
                node = int(np.flatnonzero(carried)[0]) // self._bs
                where = self.V.tabulate_dof_coordinates()[node, : self.V.mesh.geometry.dim]
                raise MPMError(
                    "A Dirichlet condition on particles.W holds carried nodes, e.g. at "
                    f"{tuple(float(f'{x:.6g}') for x in where)}; hold them by conditions on V or a "
                    "support, or make them free."
                )
        return fixed

    @override
    def held_now(self) -> NDArray[np.bool_]:
        fixed, held = self._held(), self.host.held_now()
        self._followers, self._bound = (np.zeros(self._owned, dtype=bool) for _ in range(2))
        self._beneath = None
        if over_ranks(self._comm, bool(held.any()), MPI.LOR):
            self._follow(held, fixed)
        self.nodes.bind(self._bound)
        return fixed | self._followers

    def _follow(self, held: NDArray[np.bool_], fixed: NDArray[np.bool_]) -> None:
        """Find own dofs of W that follow held ones of the background (collective).

        Args:
            held: Own dofs of V that are held.
            fixed: Own dofs of W that are held by themselves.
        """
        nodes = self.nodes
        nodes.locate()
        led = over_ranks(self._comm, bool(nodes.are_led.any()), MPI.LOR)
        moving = led or self.host.prescribed.changes
        rows = nodes.background if moving else nodes.beneath
        first = self._where_held() if led else rows
        whole, _ = self._holds(first, held)
        free = nodes.dofs
        if led:  # of carried ones, only what is not out of reach by now
            whole &= free | self._holds(rows, held)[1]
        self._followers = whole & free & ~fixed
        if not over_ranks(self._comm, bool(whole.any()), MPI.LOR):
            return
        self._beneath = transfer_matrix(first, self.V, self.host.V)
        if moving:
            before = nodes.led.x.array[: self._owned]
            self._bound = whole & ((before != 0.0) | (self._lifts() != 0.0))

    def _where_held(self) -> PointBasis:
        """Return rows of the background, for nodes that are led where that began (collective)."""
        body, rows = self.motions[0].particles, self.nodes.background
        led = np.flatnonzero(self.nodes.are_led)
        gone = self.nodes.led.x.array.reshape(-1, self._bs)[led]
        before = body.mover.basis.within(body.node_positions[led] - gone)
        first = PointBasis(rows.nodes.copy(), rows.values.copy(), rows.found.copy())
        first.nodes[led], first.values[led], first.found[led] = before[:3]
        return first

    def _holds(
        self, rows: PointBasis, held: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which own dofs of W held dofs of V carry, wholly or in part (collective)."""
        sizes = transfer_matrix(rows._replace(values=np.abs(rows.values)), self.V, self.host.V)
        weights, every, loose = sizes.createVecRight(), *(sizes.createVecLeft() for _ in range(2))
        weights.set(1.0)
        sizes.mult(weights, every)
        weights.array_w[held] = 0.0
        sizes.mult(weights, loose)
        whole = (every.array_r > 0.0) & (loose.array_r == 0.0)
        return whole, np.asarray(loose.array_r < every.array_r)

    def _lifts(self) -> NDArray[np.float64]:
        """Return how the change of held dofs of the background moves own dofs of W (collective)."""
        assert self._beneath is not None
        given, taken = self._beneath.createVecs()
        given.array_w[:] = self.host.changes()
        self._beneath.mult(given, taken)
        return np.asarray(taken.array_r)

    @override
    def changes(self) -> NDArray[np.float64]:
        lifts = super().changes()
        if self._beneath is not None:
            lifts[self._followers] = self._lifts()[self._followers]
        return lifts

    @override
    def end(self) -> None:
        led = self.nodes.led.x
        own = led.array[: self._owned]
        own[:] = np.where(self._bound, own + self.motions[0].increment(), 0.0)
        led.scatter_forward()

    def add_followed(self, forces: PETSc.Vec) -> bool:
        """Add the last forces on what follows held dofs of the background to those on these.

        Args:
            forces: On all dofs of the host's V.

        Returns:
            Whether anything follows them.
        """
        if self._beneath is None:
            return False
        own = self._beneath.createVecLeft()
        own.array_w[self._followers] = self.force.array_r[self._followers]
        self._beneath.multTransposeAdd(own, forces, forces)
        return True


class Subspace:
    """A background space and the free nodes of its bodies, in which these move together.

    Args:
        fields: The field of the background, then those of free nodes, in the order of all fields.

    Attributes:
        fields: As given.
        host: The first of them.
    """

    def __init__(self, fields: Sequence[Field]) -> None:
        self.fields = list(fields)
        self.host = fields[0]

    @staticmethod
    def all_of(fields: Sequence[Field]) -> list[Subspace]:
        """Return the subspaces that fields make up, in their order."""
        found: list[list[Field]] = []
        for field in fields:
            if isinstance(field, FreeField):
                next(group for group in found if group[0] is field.host).append(field)
            else:
                found.append([field])
        return [Subspace(group) for group in found]

    def restriction(
        self, bodies: Sequence[Particles | CarriedField]
    ) -> tuple[Restriction, tuple[int, int]]:
        """Return where a tangent goes that is reduced by rows of T of bodies, and its size."""
        host, free = self.host, self.fields[1:]
        found, sizes = host.restriction([host.rows_of(body) for body in bodies])
        if not free:
            return found, sizes
        starts = np.cumsum([0, *(field.touched.count for field in self.fields)]).tolist()
        rows = []
        for body, carried in zip(bodies, found.rows, strict=True):
            number = next(
                (n for n, field in enumerate(free) if field.motions[0].particles is body), None
            )
            if number is None:
                rows.append(carried)
            else:
                both = [carried, free[number].rows_of(body)]
                rows.append(joined_rows(both, [0, starts[1 + number]]))
        others = [field.restriction([])[0] for field in free]
        joint = found._replace(
            touched=JointNodes([field.touched for field in self.fields]),
            rows=rows,
            numbers=np.concatenate([found.numbers, *(other.numbers for other in others)]),
            part=slice(found.part.start, others[-1].part.stop),
        )
        return joint, sizes

    def level(self) -> FieldDofs:
        """Return this rank's unknowns as the finest level of multigrid, of the host's boxes."""
        levels = [field.level() for field in self.fields]
        if len(levels) == 1:
            return levels[0]
        numbers, points, components = (
            np.concatenate([getattr(level, name) for level in levels])
            for name in ("numbers", "points", "components")
        )
        return FieldDofs(numbers, points, components, levels[0].lines, levels[0].bs)

    def increment(self) -> NDArray[np.float64]:
        """Return the last increment on this rank's own dofs of all fields, one after the other."""
        return np.concatenate([field.u.array_r for field in self.fields])

    def split(self, values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return values on the own dofs of all fields by field."""
        ends = np.cumsum([field.u.getLocalSize() for field in self.fields])
        return np.split(values, ends[:-1])
