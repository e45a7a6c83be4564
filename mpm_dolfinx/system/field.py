# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A background space with the bodies that it moves: its unknowns, conditions and stabilisation."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import combinations
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .. import _compat
from ..assembly.background_forms import BackgroundForms
from ..assembly.fused import Restriction, no_ties
from ..background.basis import PointBasis
from ..background.grids import cell_lines, coarser, grid_lines
from ..meshes.boxes import BOX_CELLS
from ..parallel.magnitudes import joint_norm, norm
from ..parallel.totals import over_ranks
from ..particles.field import CarriedField
from ..particles.free import FreeNodes
from ..particles.particles import Particles
from ..solvers.strategies import Coarsening
from ..stabilisation.ghost_penalty import GhostPenalty
from ..stabilisation.joints import Joints
from ..transfer.touched import TouchedNodes, TransferRows
from .conditions import fixed_dofs
from .hierarchy import FieldDofs
from .numbering import FreeDofs
from .predictor import map_to_background

__all__ = ["Field", "Motion"]

#: Change of values, relative to themselves, that counts as none: a residual that is small beside
#: what it does is round-off.
NOTHING = 1e-5

#: What a rigid motion may leave of a motion that counts as one.
RIGID = 1e-3


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

    def begin(self) -> None:
        """Take over the present transfer."""
        self._work = self.T.createVecLeft()
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
        self.T.mult(u, self._work)
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
        return np.asarray(np.abs(increment) + NOTHING * np.abs(values))

    def of(self, u: PETSc.Vec) -> PETSc.Vec:
        """Return ``T u``, in a vector that the next call changes."""
        self.T.mult(u, self._work)
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
        return joint_norm(rest, comm) <= RIGID * joint_norm(moved.ravel(), comm)

    def nodal_size(self, force: PETSc.Vec) -> NDArray[np.float64]:
        """Return the size of ``T f`` at this rank's nodes."""
        bs = self.particles.W.dofmap.index_map_bs
        return np.asarray(np.linalg.norm(self.of(force).array_r.reshape(-1, bs), axis=1))


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
        moduli: Shear modulus of each body as the first step with a penalty begins, which is scaled
            by them; ``None`` before.
        u: The increment of the last residual, on this rank's own dofs of V.
        force: The residual on all dofs of V that was evaluated last: at supports, their force.
        free: The dofs that are unknowns; ``None`` until they are found.
        dofs: Their local numbers.
        touched: The nodes of V that bodies touch.
        part: Where the unknowns are among this rank's.
        prescribes: Whether Dirichlet values change in the step that has begun.
        factor: Value on V of an unknown of size 1.
    """

    factor: float = 1.0

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
        self._conditions = conditions
        self.motions = [Motion(body) for body in bodies]
        self.moduli: list[float] | None = None
        self.free: FreeDofs | None = None
        self._looked_up: list[fem.DirichletBC] | None = None
        self._lines: list[NDArray[np.float64]] | None = None
        self._background = background
        self.dofs = np.zeros(0, dtype=np.int32)
        self._found: FreeDofs | None = None
        self._bases: list[PointBasis] = []  # by which nodes were found
        self._ghosts = ghosts
        self._joints = joints
        self._comm: MPI.Comm = V.mesh.comm
        self._bs = V.dofmap.index_map_bs
        self._owned = V.dofmap.index_map.size_local * self._bs

    @property
    def conditions(self) -> list[fem.DirichletBC]:
        """The Dirichlet conditions on this space."""
        return [bc for bc in self._conditions if _compat.is_condition_on(bc, self.V)]

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of badly supported dofs and of joints, by the names of the statistics."""
        joints = {} if self._joints is None else {"joint_nodes": self._joints.count}
        ghosts = {} if self._ghosts is None else self._ghosts.counts
        return ghosts | joints

    def begin(self, change: NDArray[np.float64], before: NDArray[np.float64] | None = None) -> None:
        """Take over the Dirichlet values of a step, on the local dofs of V.

        Args:
            change: Their change in the step.
            before: Their totals at its beginning; ``None``: zero.
        """
        self._change = change[: self._owned]
        self._totals = np.zeros(self._owned) if before is None else before[: self._owned]
        self._imposed = False
        self.prescribes = over_ranks(self._comm, bool(np.any(change)), MPI.LOR)
        moved = (self._change != 0.0) | (self._totals != 0.0)
        at_rest = (self._held() & ~moved).reshape(-1, self._bs)
        for body in self.bodies:
            if not isinstance(body, Particles) or body.is_free:
                continue
            if body.background_basis.hold(at_rest):
                body.forget_transfer()

    # -- Unknowns -------------------------------------------------------------------------

    def find(self) -> FreeDofs:
        """Find the unknowns: dofs with weight or a background term, and without a condition.

        They are the same object as long as nothing moves relative to what carries it.
        """
        moved, ghosts = self.look(), self._ghosts
        active = self.touched.has_weight if ghosts is None else ghosts.tie(self.touched)
        free = self.touched.on_dofs(active)
        if self._background is not None:
            free[self._background.support()] = True
        dofs = np.flatnonzero(free & ~self._fixed).astype(np.int32)
        same = not moved and ghosts is None and np.array_equal(dofs, self.dofs)
        if self._found is None or not over_ranks(self._comm, same, MPI.LAND):
            self._take(dofs)
        self.u.set(0.0)
        self.force.set(0.0)
        self.free = self._found
        assert self.free is not None
        return self.free

    def _take(self, dofs: NDArray[np.int32]) -> None:
        """Take other dofs for the unknowns (collective)."""
        self.dofs = dofs
        self._found = FreeDofs(self.V, dofs, self.touched)
        T = self.bodies[0].T
        self.u, self.force = T.createVecRight(), T.createVecRight()
        for motion in self.motions:
            motion.begin()

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
        self._fixed = self.held_now()
        return moved

    def held_now(self) -> NDArray[np.bool_]:
        """Return which of this rank's own dofs of V conditions hold where the bodies are now."""
        return self._held()

    def rows_of(self, particles: Particles | CarriedField) -> TransferRows:
        """Return the rows of T of one of the bodies."""
        number = next(i for i, m in enumerate(self.motions) if m.particles is particles)
        return self.touched.rows[number]

    def _held(self) -> NDArray[np.bool_]:
        """Return which of this rank's own dofs of V have a condition, looked up once for each."""
        conditions, known = self.conditions, self._looked_up
        if known is None or list(map(id, conditions)) != list(map(id, known)):
            self._looked_up, self._conditioned = conditions, fixed_dofs(conditions, self.V)
        return self._conditioned

    def forget(self) -> None:
        """Forget the unknowns."""
        self.free = None

    def number(self, part: slice, numbers: NDArray[np.int64], sizes: tuple[int, int]) -> None:
        """Take over the numbers of the unknowns among those of all fields.

        Args:
            part: Where they are among this rank's.
            numbers: Number of the unknown of each free dof.
            sizes: Number of all fields' unknowns of this rank and of all ranks.
        """
        self.part, self._numbers, self._sizes = part, numbers, sizes
        self._prolongation: PETSc.Mat | None = None
        self._penalty: tuple[PETSc.Mat, PETSc.Mat] | None = None
        self._product: PETSc.Mat | None = None

    def restriction(self, rows: Sequence[TransferRows]) -> tuple[Restriction, tuple[int, int]]:
        """Return where a tangent goes that is reduced by rows of T, and its size."""
        numbers = np.full(self._owned, -1, dtype=np.int32)
        numbers[self.dofs] = self._numbers
        ties = self._ties(numbers.reshape(-1, self._bs))
        found = Restriction(self.touched, rows, numbers, self.part, ties, self.factor)
        return found, self._sizes

    def _ties(self, numbers: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the blocks of the penalty: first row, height, first column, width of each.

        Args:
            numbers: Number of the unknown of each own dof of V, or -1, shape ``(n, bs)``.
        """
        if self._ghosts is None or not self._ghosts.acts:
            return no_ties
        counts, step = np.count_nonzero(numbers >= 0, axis=1), self._bs + 1
        firsts = np.where(numbers >= 0, numbers, numbers.max(axis=1, keepdims=True)).min(axis=1)
        known = self.touched.at_nodes(firsts.astype(np.int64) * step + counts, self._ghosts.tied)
        pairs = np.broadcast_arrays(known[:, :, None], known[:, None, :])
        span = step * max(self._sizes[1], 1)
        rows, columns = np.divmod(np.unique(pairs[0] * span + pairs[1]), span)
        blocks = np.column_stack([*np.divmod(rows, step), *np.divmod(columns, step)])
        return blocks[(blocks[:, 1] > 0) & (blocks[:, 3] > 0)].astype(np.int32)

    @property
    def prolongation(self) -> PETSc.Mat:
        """Matrix from all unknowns to the increment of all dofs of V, zero at the fixed ones."""
        if self._prolongation is None:
            offsets = np.zeros(self._owned + 1, dtype=PETSc.IntType)
            offsets[1 + self.dofs] = 1
            csr = (
                np.cumsum(offsets, dtype=PETSc.IntType),
                self._numbers.astype(PETSc.IntType),
                np.full(len(self.dofs), self.factor),
            )
            sizes = (self.u.getSizes(), self._sizes)
            self._prolongation = PETSc.Mat().createAIJ(sizes, csr=csr, comm=self._comm)
        return self._prolongation

    def level(self) -> FieldDofs:
        """Return this rank's unknowns as the finest level of multigrid (collective)."""
        assert self.free is not None
        if self._lines is None:
            lines = cell_lines(self.V)
            self._lines = lines if self.V.ufl_element().degree > 1 else coarser(lines)
        nodes, components = np.divmod(self.dofs, self._bs)
        gdim = self.V.mesh.geometry.dim
        points = self.free.collect(self.V.tabulate_dof_coordinates()[nodes, :gdim])
        numbers = np.arange(self.part.start, self.part.stop)
        return FieldDofs(numbers, points, self.free.collect(components), self._lines, self._bs)

    @cached_property
    def coarsening(self) -> Coarsening:
        """How well multigrid's boxes follow the background (collective)."""
        if grid_lines(self.V) is None:
            return Coarsening.FAIR if self.V.ufl_element().degree == 1 else Coarsening.POOR
        nested = self.V.ufl_element().degree == 1 or self.V.mesh.basix_cell() in BOX_CELLS
        return Coarsening.GOOD if nested else Coarsening.POOR

    # -- Vectors --------------------------------------------------------------------------

    def spread(self, x: PETSc.Vec) -> None:
        """Set increment and bodies to what the unknowns x and the imposed values give."""
        values = self._lifts() if self._imposed else np.zeros(self._owned)
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

    def residual_at_unknowns(self) -> PETSc.Vec | None:
        """Return the last residual at the free dofs, zero elsewhere, if these are known."""
        if self.free is None:
            return None
        values = self.force.duplicate()
        values.set(0.0)
        values.array_w[self.dofs] = self.force.array_r[self.dofs]
        return values

    def impose(self) -> bool:
        """Impose the step's Dirichlet values from now on; return whether there are any."""
        self._imposed = True
        if not self.prescribes:
            return False
        return over_ranks(self._comm, bool(np.any(self._lifts())), MPI.LOR)

    def _lifts(self) -> NDArray[np.float64]:
        return np.where(self._fixed, self._change, 0.0)

    def lift(self) -> PETSc.Vec:
        """Return the increment that the step's Dirichlet values are."""
        return self.driven(self._lifts())

    def changes(self) -> NDArray[np.float64]:
        """Return the change of the Dirichlet values in the step, zero at other own dofs of V."""
        return self._lifts()

    def driven(self, values: NDArray[np.float64]) -> PETSc.Vec:
        """Return the increment with values at the fixed dofs, on own dofs of V, and no unknowns."""
        self.u.array_w[:] = np.where(self._fixed, values, 0.0)
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
        u = map_to_background([motion.T for motion in self.motions], increments, fit, positive)
        x.array_w[self.part] = self.free.collect(u[self.dofs]) / self.factor

    def reactions(self) -> float:
        """Return the norm of the last residual at Dirichlet conditions."""
        forces = np.where(self._fixed, self.force.array_r, 0.0)
        return joint_norm(forces, self._comm)

    def works(self) -> NDArray[np.float64]:
        """Return the work of forces on the background over the last increment (collective).

        Returns:
            Work done against what acts on the background itself, work of the residual at Dirichlet
            conditions, and work of the residual at the unknowns.
        """
        assert self.free is not None
        own = self.u.duplicate()
        own.set(0.0)
        if self._sizes[1] > 0 and norm(self.u) > 0.0:
            self.add_product(self.u, own)
        work = self.u.array_r * self.force.array_r
        found = [
            self.u.array_r @ own.array_r,
            work[self._fixed].sum(),
            work[self.dofs].sum(),
        ]
        return np.asarray(self._comm.allreduce(np.array(found)))

    def resultant(self) -> NDArray[np.float64]:
        """Return the sum of the last residual over the free dofs, by component, as values."""
        free = self.force.array_r[self.dofs]
        sums = np.bincount(self.dofs % self._bs, weights=free, minlength=self._bs)
        return np.asarray(self.factor * self._comm.allreduce(sums))

    # -- What acts on the background itself ---------------------------------------------------

    def scale_penalty(self, moduli: Callable[[Field], list[float]]) -> None:
        """Take the shear moduli of the bodies as the step begins, if the penalty needs them."""
        if self._penalised and self.moduli is None:
            self.moduli = moduli(self)

    def add_residual(self) -> None:
        """Add what acts on the background to the force of the last increment."""
        if self._background is not None:
            self.force.axpy(1.0, self._background.assemble_residual())
        if self._penalised and self._sizes[1] > 0 and norm(self.u) > 0.0:
            self._matrices()[0].multAdd(self.u, self.force, self.force)

    def tangents(self) -> list[PETSc.Mat]:
        """Return the tangents of what acts on the background, in the unknowns."""
        found = []
        if self._background is not None:
            whole = self._background.assemble_tangent()
            self._product = whole.ptap(self.prolongation, result=self._product)
            found.append(self._product)
        if self._penalised:
            found.append(self._matrices()[1])
        return found

    def add_product(self, u: PETSc.Vec, force: PETSc.Vec) -> None:
        """Add the product of these tangents on all dofs of V with an increment."""
        if self._background is not None:
            self._background.assemble_tangent().multAdd(u, force, force)
        if self._penalised:
            self._matrices()[0].multAdd(u, force, force)

    @property
    def _penalised(self) -> bool:
        return self._ghosts is not None and self._ghosts.acts

    def penalty_force(self, moduli: Sequence[float]) -> PETSc.Vec:
        """Return the force of the penalty at the last increment with shear moduli (collective)."""
        force = self.u.duplicate()
        force.set(0.0)
        if self._ghosts is not None and self._ghosts.acts:
            self._ghosts.penalty(moduli).mult(self.u, force)
        return force

    def _matrices(self) -> tuple[PETSc.Mat, PETSc.Mat]:
        """Return the step's penalty on all dofs of V and in the unknowns."""
        if self._penalty is None:
            assert self._ghosts is not None and self.moduli is not None
            matrix = self._ghosts.penalty(self.moduli)
            self._penalty = matrix, matrix.ptap(self.prolongation)
        return self._penalty
