# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A background space with the bodies that it moves: its unknowns and conditions."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..assembly.background_forms import BackgroundForms
from ..assembly.blocks import Restriction
from ..background.basis import PointBasis
from ..parallel.magnitudes import joint_norm, norm
from ..parallel.totals import over_ranks
from ..particles.field import CarriedField
from ..particles.free import FreeNodes
from ..particles.particles import Particles
from ..stabilisation.ghost_penalty import GhostPenalty
from ..stabilisation.joints import Joints
from ..tolerances import SLIGHT, SMALL
from ..transfer.touched import TouchedNodes, TransferRows
from .conditions import Prescribed
from .hierarchy import Boxes, FieldDofs
from .numbering import FreeDofs
from .on_background import OnBackground
from .predictor import map_to_background

__all__ = ["Field", "Motion"]


class Motion:
    """How one body follows its background: ``d = d_n + T u``; or its free nodes their unknowns.

    Args:
        moved: The body, or its free nodes.

    Attributes:
        particles: The body.
    """

    def __init__(self, moved: Particles | CarriedField | FreeNodes) -> None:
        self._moved = moved
        self.particles: Any = moved.particles if isinstance(moved, FreeNodes) else moved

    @property
    def T(self) -> PETSc.Mat:
        """All dofs of W by all dofs of V."""
        return self._moved.T

    @property
    def action(self) -> PETSc.Mat:
        """A matrix that multiplies as T does."""
        moved = self._moved
        return moved.transfer.action if isinstance(moved, Particles) else moved.T

    def begin(self) -> None:
        """Take over the present transfer."""
        self._work = self.action.createVecLeft()
        self._rows = self._own_rows()
        self._free_T: tuple[PETSc.Mat, PETSc.Mat] | None = None

    def _own_rows(self) -> slice | NDArray[np.intp]:
        """Return which of this rank's own dofs of W are moved by V, or as free ones."""
        if isinstance(self._moved, FreeNodes):
            return np.flatnonzero(self._moved.dofs)
        if isinstance(self._moved, Particles) and self._moved.free_nodes is not None:
            return np.flatnonzero(~self._moved.free_nodes.dofs)
        return slice(None)

    def free_T(self, prolongation: PETSc.Mat) -> PETSc.Mat:
        """Return T times what gives u from the unknowns, made once for each of it (collective)."""
        if self._free_T is None or self._free_T[0] is not prolongation:
            self._free_T = prolongation, self.T.matMult(prolongation)
        return self._free_T[1]

    def move(self, u: PETSc.Vec) -> None:
        """Set ``d = d_n + T u`` in the rows that are u's."""
        self.action.mult(u, self._work)
        d, own = self.particles.displacement.x, self._work.getLocalSize()
        self._before = self.particles.converged_displacement[:own]
        moved = self._before + self._work.array_r
        d.array[:own][self._rows] = moved[self._rows]
        d.scatter_forward()

    def increment(self) -> NDArray[np.float64]:
        """Return the last change of displacement on this rank's own dofs of W."""
        rows = self._work.getLocalSize()
        d = self.particles.displacement.x.array[:rows]
        return np.asarray(d - self._before)

    def change(self) -> NDArray[np.float64]:
        """Return sizes of the last change on own dofs of W, at least a share of the values'."""
        increment = self.increment()
        values = self.particles.displacement.x.array[: len(increment)]
        return np.asarray(np.abs(increment) + SMALL * np.abs(values))

    def of(self, u: PETSc.Vec) -> PETSc.Vec:
        """Return ``T u``, in a vector that the next call changes."""
        self.action.mult(u, self._work)
        return self._work

    def extent(self) -> float:
        """Return the norm of the positions of the body's nodes, or of a field's values."""
        rows = self._work.getLocalSize()
        self._work.array_w[:] = self.particles.node_positions.ravel()[:rows]
        return norm(self._work)

    def is_rigid(self, motion: PETSc.Vec) -> bool:
        """Return whether a motion of the body is a rigid one, in small rotations (collective).

        Args:
            motion: On W.
        """
        gdim = self.particles.mesh.geometry.dim
        moved = np.array(motion.array_r).reshape(-1, gdim)
        x = self.particles.node_positions[: len(moved)]
        comm: MPI.Comm = self.particles.mesh.comm
        nodes = comm.allreduce(len(x))
        x = x - comm.allreduce(x.sum(axis=0)) / max(nodes, 1)
        motions = [np.broadcast_to(e, x.shape).ravel() for e in np.eye(gdim)]
        for i, j in combinations(range(gdim), 2):
            turn = np.zeros_like(x)
            turn[:, i], turn[:, j] = -x[:, j], x[:, i]
            motions.append(turn.ravel())
        A = np.column_stack(motions)
        normal, right = comm.allreduce(A.T @ A), comm.allreduce(A.T @ moved.ravel())
        rest = moved.ravel() - A @ np.linalg.lstsq(normal, right, rcond=None)[0]
        return joint_norm(rest, comm) <= SLIGHT * joint_norm(moved.ravel(), comm)

    def nodal_size(self, force: PETSc.Vec) -> NDArray[np.float64]:
        """Return the size of ``T f`` at this rank's nodes."""
        bs = self.particles.W.dofmap.index_map_bs
        return np.asarray(np.linalg.norm(self.of(force).array_r.reshape(-1, bs), axis=1))


class _Numbers(NamedTuple):
    """Numbers of a field's unknowns among those of all fields.

    Attributes:
        part: Where they are among this rank's.
        numbers: Of the unknown of each free dof.
        sizes: Number of all fields' unknowns of this rank and of all ranks.
    """

    part: slice
    numbers: NDArray[np.int64]
    sizes: tuple[int, int]


class Field:
    """One background space with all bodies that it moves. All calls are collective.

    Args:
        bodies: The bodies on this space, or the free nodes of one.
        conditions: Dirichlet conditions, of which those on this space count.
        background: Terms on it.
        ghosts: Penalty on dofs that the bodies support badly; ``None``: nothing.
        joints: What keeps the joints between bodies shut; ``None``: nothing.

    Attributes:
        V: The space.
        bodies: As given.
        motions: How each body follows.
        prescribed: The conditions on this space, and their values in the step.
        acting: What acts on the background itself.
        boxes: The boxes of multigrid over it.
        u: The increment of the last residual, on this rank's own dofs of V.
        force: The residual on all dofs of V that was evaluated last: at supports, their force.
        free: The dofs that are unknowns; ``None`` until they are found.
        dofs: Their local numbers.
        fixed: Whether each own dof of V has been held when they were looked for.
        touched: The nodes of V that bodies touch.
        factor: Value on V of an unknown of size 1.
    """

    factor: float = 1.0
    touched: TouchedNodes

    def __init__(
        self,
        bodies: Sequence[Particles | CarriedField | FreeNodes],
        conditions: Sequence[fem.DirichletBC] = (),
        background: BackgroundForms | None = None,
        ghosts: GhostPenalty | None = None,
        joints: Joints | None = None,
    ) -> None:
        self.bodies = list(bodies)
        self.V = V = bodies[0].V
        self.motions = [Motion(body) for body in bodies]
        self.prescribed = Prescribed(conditions, V)
        self.acting = OnBackground(background, ghosts)
        self.boxes = Boxes(V)
        self.free: FreeDofs | None = None
        self.dofs = np.zeros(0, dtype=np.int32)
        self._found: FreeDofs | None = None
        self._bases: list[PointBasis] = []  # by which nodes were found
        self._joints = joints
        self._comm: MPI.Comm = V.mesh.comm
        self._bs = V.dofmap.index_map_bs
        self._owned = V.dofmap.index_map.size_local * self._bs
        self.fixed = np.zeros(self._owned, dtype=bool)
        self.u = PETSc.Vec().createMPI((self._owned, None), bsize=self._bs, comm=self._comm)
        self.force = self.u.duplicate()
        self._numbers = _Numbers(slice(0, 0), np.zeros(0, dtype=np.int64), (0, 0))
        self._prolongation: PETSc.Mat | None = None

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of badly supported dofs and of joints, by the names of the statistics."""
        joints = {} if self._joints is None else {"joint_nodes": self._joints.count}
        return self.acting.counts | joints

    def begin(self, change: NDArray[np.float64], before: NDArray[np.float64] | None = None) -> None:
        """Take over the Dirichlet values of a step: see :meth:`.Prescribed.begin`."""
        self.prescribed.begin(change, before)
        at_rest = self.prescribed.at_rest
        for body in self.bodies:
            if not isinstance(body, Particles) or body.is_free:
                continue
            if body.mover.basis.hold(at_rest):
                body.forget_transfer()

    def end(self) -> None:
        """Take note of a converged step, with whose values bodies have moved."""

    # -- Unknowns -------------------------------------------------------------------------

    def find(self) -> FreeDofs:
        """Find the unknowns: dofs with weight or a background term, and without a condition.

        They are the same object as long as nothing moves relative to what carries it.
        """
        moved = self.look()
        free = self.acting.unknowns(self.touched)
        dofs = np.flatnonzero(free & ~self.fixed).astype(np.int32)
        same = not moved and self.acting.lasts and np.array_equal(dofs, self.dofs)
        if self._found is None or not over_ranks(self._comm, same, MPI.LAND):
            self.dofs = dofs
            self._found = FreeDofs(self.V, dofs, self.touched)
            for motion in self.motions:
                motion.begin()
        self.u.set(0.0)
        self.force.set(0.0)
        self.free = self._found
        return self.free

    def look(self) -> bool:
        """Find the nodes of V that bodies touch, and the dofs with a condition.

        Returns:
            Whether the nodes may be others than before.
        """
        bases = [body.node_basis for body in self.bodies]
        same = len(bases) == len(self._bases) and all(map(operator.is_, bases, self._bases))
        moved = self._joints is not None or not over_ranks(self._comm, same, MPI.LAND)
        if self._joints is not None:
            self.touched = self._joints.touched()
        elif moved:
            owned = [body.W.dofmap.index_map.size_local for body in self.bodies]
            self.touched = TouchedNodes(self.V, bases, owned)
        self._bases = bases
        self.fixed = self.held_now()
        return moved

    def held_now(self) -> NDArray[np.bool_]:
        """Return which of this rank's own dofs of V conditions hold where the bodies are now."""
        return self.prescribed.held

    def rows_of(self, particles: Particles | CarriedField) -> TransferRows:
        """Return the rows of T of one of the bodies."""
        number = next(i for i, m in enumerate(self.motions) if m.particles is particles)
        return self.touched.rows[number]

    def forget(self) -> None:
        """Forget the unknowns."""
        self.free = None

    def number(self, part: slice, numbers: NDArray[np.int64], sizes: tuple[int, int]) -> None:
        """Take over the numbers of the unknowns: see :class:`_Numbers`."""
        self._numbers = _Numbers(part, numbers, sizes)
        self._prolongation = None
        self.acting.renew()

    @property
    def part(self) -> slice:
        """Where the unknowns are among this rank's."""
        return self._numbers.part

    def restriction(self, rows: Sequence[TransferRows]) -> tuple[Restriction, tuple[int, int]]:
        """Return where a tangent goes that is reduced by rows of T, and its size."""
        part, own, sizes = self._numbers
        numbers = np.full(self._owned, -1, dtype=np.int32)
        numbers[self.dofs] = own
        ties = self.acting.ties(self.touched, numbers.reshape(-1, self._bs), sizes[1])
        return Restriction(self.touched, rows, numbers, part, ties, self.factor), sizes

    @property
    def prolongation(self) -> PETSc.Mat:
        """Matrix from all unknowns to the increment of all dofs of V, zero at the fixed ones."""
        if self._prolongation is None:
            offsets = np.zeros(self._owned + 1, dtype=PETSc.IntType)
            offsets[1 + self.dofs] = 1
            csr = (
                np.cumsum(offsets, dtype=PETSc.IntType),
                self._numbers.numbers.astype(PETSc.IntType),
                np.full(len(self.dofs), self.factor),
            )
            sizes = (self.u.getSizes(), self._numbers.sizes)
            self._prolongation = PETSc.Mat().createAIJ(sizes, csr=csr, comm=self._comm)
        return self._prolongation

    def level(self) -> FieldDofs:
        """Return this rank's unknowns as the finest level of multigrid (collective)."""
        assert self.free is not None
        return self.boxes.finest(self.free, self.dofs, self.part.start)

    # -- Vectors --------------------------------------------------------------------------

    def spread(self, x: PETSc.Vec) -> None:
        """Set increment and bodies to what the unknowns x and the imposed values give."""
        values = self.changes() if self.prescribed.imposed else np.zeros(self._owned)
        self._set(self.u, x, values)
        first, *others = [body.increment.x for body in self.bodies]
        first.array[: self._owned] = self.u.array_r
        first.scatter_forward()
        for other in others:
            other.array[:] = first.array
        for motion in self.motions:
            motion.move(self.u)

    def _set(self, u: PETSc.Vec, x: PETSc.Vec, values: NDArray[np.float64]) -> None:
        """Set u to the unknowns x, and to values at other dofs."""
        assert self.free is not None
        values[self.dofs] = self.factor * self.free.spread(x.array_r[self.part])
        u.array_w[:] = values

    def collect(self, force: PETSc.Vec, F: PETSc.Vec) -> None:
        """Set the unknowns' part of F to a force on all dofs of V."""
        assert self.free is not None
        F.array_w[self.part] = self.factor * self.free.collect(force.array_r[self.dofs])

    def impose(self) -> bool:
        """Impose the step's Dirichlet values from now on; return whether there are any."""
        self.prescribed.imposed = True
        if not self.prescribed.changes:
            return False
        return over_ranks(self._comm, bool(np.any(self.changes())), MPI.LOR)

    def changes(self) -> NDArray[np.float64]:
        """Return the change of the Dirichlet values in the step, zero at other own dofs of V."""
        return np.where(self.fixed, self.prescribed.change, 0.0)

    def lift(self) -> PETSc.Vec:
        """Return the increment that the step's Dirichlet values are."""
        return self.driven(self.changes())

    def driven(self, values: NDArray[np.float64]) -> PETSc.Vec:
        """Return the increment with values at the fixed dofs, on own dofs of V, and no unknowns."""
        self.u.array_w[:] = np.where(self.fixed, values, 0.0)
        return self.u

    def on_background(self, x: PETSc.Vec) -> PETSc.Vec:
        """Return the increment of V with unknowns x, and zero at the fixed dofs."""
        u = self.u.duplicate()
        self._set(u, x, np.zeros(self._owned))
        return u

    def on_bodies(self, x: PETSc.Vec) -> list[float]:
        """Return the size of the displacement that the unknowns x cause on each body."""
        u = self.on_background(x)
        return [norm(motion.of(u)) / abs(self.factor) for motion in self.motions]

    def predict(self, increments: list[NDArray[np.float64]], x: PETSc.Vec, fit: bool) -> None:
        """Set the unknowns' part of x to what increments of the bodies' nodes are on V.

        Args:
            increments: Change of displacement on this rank's own dofs of W, for each body.
            x: The unknowns.
            fit: As for :func:`map_to_background`; not done for particles that are alone, whose
                increments the background meets with any motion between them.
        """
        assert self.free is not None
        fit = fit and all(body.shares_nodes for body in self.bodies)
        positive = self.V.ufl_element().degree == 1
        transfers = [motion.action if positive else motion.T for motion in self.motions]
        u = map_to_background(transfers, increments, fit, positive)
        x.array_w[self.part] = self.free.collect(u[self.dofs]) / self.factor
