# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The reduced system of a step: residual and tangent in the free dofs of the background."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from . import _compat
from .assembly import BackgroundForms
from .dependence import Dependence, dependent_dofs
from .errors import DomainDistortionError, MPMError, agreed
from .fused import FusedTangent
from .history import Statistics
from .layout import FreeDofs, TouchedNodes, imbalance
from .particles import Particles
from .predictor import Predictor, map_to_background
from .share import Body
from .stabilisation import Aggregation, GhostPenalty

__all__ = ["ReducedSystem"]

SUBSET = PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN
DIFFERENT = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN


class ReducedSystem:
    """``sum_bodies T^T R(d_n + T u) = 0`` in the free dofs of V, as the solver sees it.

    Args:
        bodies: The bodies, all on one background space.
        background: Terms on the background.
        bcs: Dirichlet conditions on V.
        evaluate: What the forms need before each assembly; may return a failure.
        smooth: Whether no history changes in the last residual, nor contact.
        statistics: Where to count.
        predictor: Says what increment to expect; ``None`` for none.
        stabilisation: What is done about badly supported dofs.
        remove_dependent: Whether dofs of T that others can stand for are no unknowns.

    Attributes:
        prescribes: Whether Dirichlet values change in the step that has begun.
        moduli: Shear moduli of the bodies at the first step with a ghost penalty, which is scaled
            by them; ``None`` before.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        background: BackgroundForms | None,
        bcs: Sequence[fem.DirichletBC],
        evaluate: Callable[[], MPMError | None],
        smooth: Callable[[], bool],
        statistics: Statistics,
        predictor: Predictor | None = None,
        stabilisation: GhostPenalty | Aggregation | None = None,
        remove_dependent: bool = False,
    ) -> None:
        self.predictor = predictor
        self._stabilisation = stabilisation
        self._remove_dependent = remove_dependent
        self._dependence: Dependence | None = None
        self.moduli: list[float] | None = None
        self._extension: PETSc.Mat | None = None
        self._ghost: tuple[PETSc.Mat, PETSc.Mat] | None = None
        self._bodies = list(bodies)
        self._background = background
        self._bcs = bcs
        self._evaluate = evaluate
        self.smooth = smooth
        self._statistics = statistics
        self._V = bodies[0].particles.V
        self._comm: MPI.Comm = self._V.mesh.comm
        self._bs = self._V.dofmap.index_map_bs
        self._owned = self._V.dofmap.index_map.size_local * self._bs
        self._free: NDArray[np.int32] | None = None
        self._total: PETSc.Mat | None = None
        self._fast = [
            number
            for number, body in enumerate(bodies)
            if body.forms.internal is not None or body.forms.fused
        ]
        self._fused: FusedTangent | None = None
        if self._fast:
            fast = [(bodies[number].particles, bodies[number].forms) for number in self._fast]
            self._fused = FusedTangent(fast, statistics)

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of free dofs of this rank and of all ranks."""
        return self._layout.sizes

    @property
    def force(self) -> PETSc.Vec:
        """The residual on all dofs of V that was evaluated last: at supports, their force."""
        return self._force

    @property
    def follows_load(self) -> bool:
        """Whether what the load factor does depends on the displacement."""
        return any(body.forms.follows_load for body in self._bodies)

    def begin(self, change: NDArray[np.float64], size: float) -> None:
        """Prepare a step, or another try of the same.

        Args:
            change: Change of the Dirichlet values, on the local dofs of V.
            size: Size of the step, in load factor or parameter of the path.

        Raises:
            ParticleOutsideError: Where the last step left a domain outside the background.
        """
        self._change = change[: self._owned]
        self._size = size
        self._imposed = False
        self.prescribes = bool(self._comm.allreduce(bool(np.any(change)), MPI.LOR))
        with self._statistics.phase("locate"):
            for body in self._bodies:
                body.particles.locate()
        if self._free is None:
            with self._statistics.phase("transfer"):
                self._find_free_dofs()
        with self._statistics.phase("assemble"):
            for body in self._bodies:
                body.forms.assemble_external()
            self._gather([body.forms.external for body in self._bodies])
            self._external = float(self._force.norm())

    def end(self) -> None:
        """Take note of the increments; forget the free dofs, since the bodies have moved."""
        self.forget()
        if self.predictor is not None:
            self.predictor.record(self._size, [body.increment() for body in self._bodies])

    def forget(self) -> None:
        """Forget the free dofs."""
        self._free = None

    def _find_free_dofs(self) -> None:
        """Free are dofs with weight or a background term, and without a condition."""
        free = np.zeros(self._owned, dtype=bool)
        active = np.zeros(self._owned // self._bs, dtype=bool)
        bodies = [body.particles for body in self._bodies]
        owned = [body.W.dofmap.index_map.size_local for body in bodies]
        touched = TouchedNodes(self._V, [body.node_basis for body in bodies], owned)
        active[touched.active] = True
        if self._stabilisation is not None:
            active = self._stabilisation.unknowns(active, self._statistics)
        free.reshape(-1, self._bs)[active] = True
        supported = np.zeros(self._owned, dtype=bool)
        if self._background is not None:
            supported[self._background.support()] = True
        free |= supported
        self._fixed = np.zeros(self._owned, dtype=bool)
        for bc in self._bcs:
            self._fixed[_compat.own_dofs(bc, self._V)] = True
        free &= ~self._fixed
        T = self._bodies[0].particles.T
        if self._remove_dependent:
            self._dependence = dependent_dofs(bodies, touched, free & ~supported)
            start, end = T.getOwnershipRangeColumn()
            dependent = self._dependence.columns
            free[dependent[(dependent >= start) & (dependent < end)] - start] = False
            self._statistics["dependent_dofs"] = max(
                self._statistics["dependent_dofs"], len(dependent)
            )
        self._free = np.flatnonzero(free).astype(np.int32)
        self._layout = FreeDofs(self._V, self._free, touched)
        self._columns = self._layout.columns
        self._u = T.createVecRight()
        self._force = T.createVecRight()
        self._part = T.createVecRight()
        self._total = self._ghost = None
        if isinstance(self._stabilisation, Aggregation):
            self._extension = self._stabilisation.extension(self._fixed)
        for body in self._bodies:
            body.restrict(self._columns, self._extension)
        if self._fused is not None:
            rows = [touched.rows[number] for number in self._fast]
            self._fused.restrict(touched, rows, *self._numbering())
        self._statistics.count("transfers")
        self._statistics["free_dofs"] = self.sizes[1]
        self._statistics["off_rank_rows"] = self._layout.off_rank_rows
        self._statistics["off_rank_columns"] = self._layout.off_rank_columns
        self._statistics["dof_imbalance"] = imbalance(self._comm, self.sizes[0])
        particles = sum(body.particles.num_local for body in self._bodies)
        self._statistics["particle_imbalance"] = imbalance(self._comm, particles)

    def _numbering(self) -> tuple[NDArray[np.int32], tuple[int, int]]:
        """Return the number of each own dof of V among those of the fused tangent, -1: none.

        They are the free dofs or, before an extension, all dofs of V.
        """
        if self._extension is not None:
            first, last = self._u.getOwnershipRange()
            return np.arange(first, last, dtype=np.int32), self._u.getSizes()
        numbers = np.full(self._owned, -1, dtype=np.int32)
        assert self._free is not None
        numbers[self._free] = self._layout.numbers
        return numbers, self.sizes

    def _fused_tangent(self, fused: FusedTangent) -> PETSc.Mat:
        whole = fused.assemble(keep=self.prescribes)
        if self._extension is None:
            return whole
        return whole.ptap(self._extension).createSubMatrix(self._columns, self._columns)

    def _on_background(self, x: PETSc.Vec) -> PETSc.Vec:
        """Return the increment of V with free dofs x, and zero at the fixed ones."""
        self._part.set(0.0)
        self._part.array_w[self._free] = self._layout.spread(x)
        if self._extension is None:
            return self._part
        self._extension.mult(self._part, self._u)
        return self._u

    def _gather(self, vectors: Sequence[PETSc.Vec]) -> None:
        """Set the force to the sum of ``T^T`` times each body's vector."""
        self._bodies[0].particles.T.multTranspose(vectors[0], self._force)
        for body, vector in zip(self._bodies[1:], vectors[1:], strict=True):
            body.particles.T.multTransposeAdd(vector, self._force, self._force)

    def residual(self, x: PETSc.Vec, F: PETSc.Vec) -> MPMError | None:
        """Evaluate the residual at x, or say why that cannot be."""
        increments = [body.particles.increment.x for body in self._bodies]
        u = increments[0]
        u.array[: self._owned] = self._lifts() if self._imposed else 0.0
        u.array[self._free] = self._layout.spread(x)
        if self._extension is not None:
            self._part.array_w[:] = u.array[: self._owned]
            self._extension.mult(self._part, self._u)
            u.array[: self._owned] = self._u.array_r
        u.scatter_forward()
        for other in increments[1:]:
            other.array[:] = u.array
        self._u.array_w[:] = u.array[: self._owned]
        with self._statistics.phase("constitutive"):
            failure: MPMError | None = None
            for body in self._bodies:
                body.move(self._u)
                inverted = body.particles.inverted()
                failure = failure or distorted("turn inside out", inverted)
            failure = agreed(self._comm, failure) or agreed(self._comm, self._updated())
        if failure is not None:
            return failure
        with self._statistics.phase("assemble"):
            self._gather([body.forms.assemble_residual() for body in self._bodies])
            if self._background is not None:
                self._force.axpy(1.0, self._background.assemble_residual())
            if self._penalised and self.sizes[1] > 0 and self._u.norm() > 0.0:
                self._penalty()[0].multAdd(self._u, self._force, self._force)
            self._extend(self._force)
        self._layout.collect(self._force.array_r[self._free], F)
        return None

    def _updated(self) -> MPMError | None:
        """Update what the forms hold; return why that cannot be, also where a user's code fails."""
        try:
            return self._evaluate()
        except MPMError as error:
            return error
        except Exception as error:
            failure = MPMError(f"evaluate() failed with {type(error).__name__}: {error}")
            failure.__cause__ = error
            return failure

    def _extend(self, force: PETSc.Vec) -> None:
        """Move what aggregated dofs feel to those that they follow."""
        if self._extension is not None:
            self._extension.multTranspose(force, self._part)
            self._part.copy(force)

    def load_derivative(self, order: int = 1) -> tuple[PETSc.Vec, float]:
        """Return :meth:`BodyForms.load_derivative` on all dofs of V (collective)."""
        with self._statistics.phase("assemble"):
            parts = [body.forms.load_derivative(order) for body in self._bodies]
            total = self._force.duplicate()
            total.set(0.0)
            for body, (part, _) in zip(self._bodies, parts, strict=True):
                body.particles.T.multTransposeAdd(part, total, total)
            self._extend(total)
            return total, sum(size for _, size in parts)

    def functional(self, particles: Particles, row: PETSc.Vec) -> PETSc.Vec:
        """Return the coefficients on the free dofs of a functional on a body's W (collective)."""
        total = self._force.duplicate()
        particles.T.multTranspose(row, total)
        self._extend(total)
        return self.restricted(total)

    def restricted(self, force: PETSc.Vec) -> PETSc.Vec:
        """Return a vector on all dofs of V at the free ones (collective)."""
        reduced = PETSc.Vec().createMPI(self.sizes, comm=self._comm)
        self._layout.collect(force.array_r[self._free], reduced)
        return reduced

    def constrain(
        self, y: PETSc.Vec, x: PETSc.Vec | None, solve: Callable[[PETSc.Vec, PETSc.Vec], None]
    ) -> int:
        """Leave a Newton step as it is: all steps are permitted."""
        return 0

    def tangent(self) -> PETSc.Mat:
        """Return the tangent at the x of the last residual, one object within a step."""
        with self._statistics.phase("assemble"):
            parts = [] if self._fused is None else [self._fused_tangent(self._fused)]
            parts += [body.tangent() for body in self._bodies if body.forms.stock]
            if self._background is not None:
                whole = self._background.assemble_tangent()
                if self._extension is not None:
                    whole = whole.ptap(self._extension)
                parts.append(whole.createSubMatrix(self._columns, self._columns))
            if self._penalised:
                parts.append(self._penalty()[1])
            if len(parts) == 1 and self._extension is None:
                return parts[0]
            if self._total is None:
                self._total = parts[0].copy()
                for part in parts[1:]:
                    self._total.axpy(1.0, part, structure=DIFFERENT)
            else:
                self._total.zeroEntries()
                for part in parts:
                    self._total.axpy(1.0, part, structure=SUBSET)
            return self._total

    def prediction(self) -> PETSc.Vec | None:
        """Return the free dofs to expect at the step's end, if the past says any."""
        if self.predictor is None:
            return None
        increments = self.predictor.increments(self._size)
        if increments is None:
            return None
        u = map_to_background([body.particles.T for body in self._bodies], increments)
        if self._dependence is not None:
            self._dependence.fold(
                self._comm, self._bodies[0].particles.T.getOwnershipRangeColumn()[0], u
            )
        x = PETSc.Vec().createMPI(self.sizes, comm=self._comm)
        self._layout.collect(u[self._free], x)
        return x

    def rigid_motions(self) -> PETSc.NullSpace:
        """Return the rigid motions of the background in the free dofs (collective)."""
        return self._layout.rigid_motions()

    @property
    def _penalised(self) -> bool:
        """Whether there is a ghost penalty now."""
        return isinstance(self._stabilisation, GhostPenalty) and self._stabilisation.acts

    def _penalty(self) -> tuple[PETSc.Mat, PETSc.Mat]:
        """Return the ghost penalty's matrix on all dofs and on the free ones."""
        assert isinstance(self._stabilisation, GhostPenalty)
        if self.moduli is None:
            self.moduli = [body.shear_modulus() for body in self._bodies]
        if self._ghost is None:
            matrix = self._stabilisation.matrix(self.moduli)
            self._ghost = matrix, matrix.createSubMatrix(self._columns, self._columns)
        return self._ghost

    def impose(self) -> bool:
        """Impose the step's Dirichlet values from now on; return whether there are any."""
        self._imposed = True
        return bool(self._comm.allreduce(bool(np.any(self._lifts())), MPI.LOR))

    def _lifts(self) -> NDArray[np.float64]:
        return np.where(self._fixed, self._change, 0.0)

    def lift(self) -> PETSc.Vec:
        """Return the linearised forces of the step's Dirichlet values on the free dofs."""
        self._u.array_w[:] = self._lifts()
        if self._extension is not None:
            self._extension.mult(self._u, self._part)
            self._part.copy(self._u)
        self._part.set(0.0)
        if self._background is not None:
            self._background.assemble_tangent().mult(self._u, self._part)
        if self._fused is not None:
            self._fused.multiply_add(self._u, self._part)
        for body in self._bodies:
            if not body.forms.stock:
                continue
            force = body.stock_force(self._u)
            body.particles.T.multTransposeAdd(force, self._part, self._part)
        if self._penalised:
            self._penalty()[0].multAdd(self._u, self._part, self._part)
        if self._extension is not None:
            self._extension.multTranspose(self._part, self._u)
            self._u.copy(self._part)
        return self.restricted(self._part)

    def scale(self) -> float:
        """Return the larger of external forces and reactions."""
        reactions = np.where(self._fixed, self._force.array_r, 0.0)
        return max(
            self._external, float(np.sqrt(self._comm.allreduce(float(reactions @ reactions))))
        )

    def internal_scale(self) -> float:
        """Return the size of what all domains add to the residual, in absolute values."""
        with self._statistics.phase("assemble"):
            self._part.set(0.0)
            for body in self._bodies:
                total = body.forms.absolute_contributions(body.particles.domain_nodes)
                body.particles.T.multTransposeAdd(total, self._part, self._part)
            return float(self._part.norm())

    def motion(self, x: PETSc.Vec) -> float:
        """Return the size of the displacement that x causes on the bodies."""
        u = self._on_background(x)
        return float(np.linalg.norm([body.motion(u) for body in self._bodies]))

    def extent(self) -> float:
        """Return the size of the positions of all nodes."""
        return float(np.linalg.norm([body.extent() for body in self._bodies]))

    def crossed(self) -> MPMError | None:
        """Return an error where domains cross themselves."""
        found: MPMError | None = None
        for body in self._bodies:
            found = found or distorted("cross themselves", body.particles.crossed())
        return agreed(self._comm, found)

    def worst_dof(self) -> tuple[list[int], tuple[float, ...]]:
        """Return the global dof with the largest residual, if any, and where it is (collective)."""
        best: tuple[float, int, tuple[float, ...]] = (-1.0, -1, ())
        if self._free is not None and len(self._free):
            size = np.nan_to_num(np.abs(self._force.array_r[self._free]), nan=0.0, posinf=0.0)
            dof = int(self._free[size.argmax()])
            gdim = self._V.mesh.geometry.dim
            x = self._V.tabulate_dof_coordinates()[dof // self._bs, :gdim]
            start = self._V.dofmap.index_map.local_range[0] * self._bs
            best = float(size.max()), start + dof, tuple(float(round(c, 6)) for c in x)
        _, dof, where = max(self._comm.allgather(best))
        return ([dof] if dof >= 0 else []), where

    def count_folded(self) -> None:
        """Count the curved domains that are folded."""
        curved = [b.particles for b in self._bodies if b.particles.W.ufl_element().degree > 1]
        if curved:
            folded = self._comm.allreduce(sum(len(body.folded()) for body in curved))
            self._statistics["folded_domains"] = max(self._statistics["folded_domains"], folded)

    def worst_particles(self) -> list[int]:
        """Return the particles at the node with the largest residual."""
        best: tuple[float, list[int]] = (0.0, [])
        if self._free is None:
            return best[1]
        for body in self._bodies:
            self._part.set(0.0)
            self._part.array_w[self._free] = self._force.array_r[self._free]
            size = np.nan_to_num(body.nodal_size(self._part), nan=0.0, posinf=0.0)
            largest = self._comm.allreduce(float(size.max(initial=0.0)), MPI.MAX)
            if largest <= best[0]:
                continue
            nodes = np.flatnonzero(size >= largest)
            touches = np.isin(body.particles.domain_nodes, nodes).any(axis=1)
            mine = [int(p) for p in body.particles.global_index[touches]]
            best = largest, sorted({p for ps in self._comm.allgather(mine) for p in ps})
        return best[1]


def distorted(how: str, which: NDArray[np.int64]) -> DomainDistortionError | None:
    """Return an error about domains, if there are any."""
    return (
        DomainDistortionError(f"The domains of {{particles}} {how}", which) if len(which) else None
    )
