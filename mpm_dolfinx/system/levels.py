# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The unknowns of a step as a linear solver must know them: kinds, sizes and coarser levels."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..parallel.totals import over_ranks
from ..particles.particles import Particles
from .field import Field
from .hierarchy import interpolations
from .terms import Terms
from .unknowns import Unknowns
from .value_field import ValueField

__all__ = ["Levels"]


class Levels:
    """Kinds of unknowns, and coarser levels of each. All calls are collective.

    Args:
        unknowns: The unknowns.
        terms: What couples them.

    Attributes:
        massive: The bodies with inertia.
    """

    def __init__(self, unknowns: Unknowns, terms: Terms) -> None:
        self._unknowns, self._terms = unknowns, terms
        self._comm = unknowns.comm
        self.massive: Sequence[Particles] = ()

    @property
    def constrained(self) -> bool:
        """Whether there are unknowns besides displacements."""
        return bool(self._unknowns.values)

    @property
    def held(self) -> bool:
        """Whether each unknown is the motion of a free node with mass."""
        blocks = self._unknowns.blocks
        return all(
            isinstance(block, Field)
            and all(
                isinstance(body, Particles)
                and block.V is body.W
                and any(body is one for one in self.massive)
                for body in block.bodies
            )
            for block in blocks
        )

    @property
    def nested(self) -> bool:
        """Whether multigrid's boxes follow the tangent; where bodies of two fields meet, not."""
        unknowns = self._unknowns
        joint = len(unknowns.subspaces) < len(unknowns.fields)
        hosts = ({id(unknowns.place(body)[0]) for body in term.bodies} for term in self._terms)
        if joint or any(len(fields) > 1 for fields in hosts):
            return False  # each field has boxes of its own
        return all(one.host.boxes.nested for one in unknowns.subspaces)

    def splits(self) -> Sequence[tuple[str, slice]]:
        """Return names of the fields, and where their unknowns are among this rank's.

        All displacements are one, with terms' own unknowns; they come first.
        """
        unknowns = self._unknowns
        moving = len(unknowns.fields) > len(unknowns.values)
        found = [("displacement", unknowns.displacements)] if moving else []
        for field in unknowns.values:
            name = field.carried[0].field.name
            taken = sum(known.split("_of_")[0] == name for known, _ in found)
            found.append((f"{name}_of_{taken}" if taken else name, field.part))
        return found

    def rigid_motions(self) -> PETSc.NullSpace:
        """Return the rigid motions of each background in the unknowns."""
        unknowns = self._unknowns
        assert unknowns.numbering is not None
        moving = [one for one in unknowns.subspaces if not isinstance(one.host, ValueField)]
        others = len(unknowns.blocks) - sum(len(one.fields) for one in moving)
        together = [*(len(one.fields) for one in moving), *[1] * others]
        return unknowns.numbering.rigid_motions(together)

    def interpolations(self, coarsest: int, values: bool = False) -> Sequence[PETSc.Mat]:
        """Return the interpolations to the unknowns of each level from the next coarser one.

        See :func:`.hierarchy.interpolations`.

        Args:
            coarsest: Number of unknowns below which no coarser level is made.
            values: Whether of those that are no displacements; either kind is numbered alone.
        """
        unknowns = self._unknowns
        moving = unknowns.displacements.stop
        first, last = (moving, unknowns.sizes[0]) if values else (0, moving)
        dofs = [
            one.level() for one in unknowns.subspaces if isinstance(one.host, ValueField) == values
        ]
        if not values:
            dofs += [own.level() for own in unknowns.own]
        alone = [one._replace(numbers=one.numbers - first) for one in dofs]
        return interpolations(self._comm, last - first, alone, coarsest)

    def mass(self) -> PETSc.Mat:
        """Return the mass matrix of the unknowns that are no displacements."""
        found: PETSc.Mat | None = None
        for field in self._unknowns.values:
            for carried in field.carried:
                T = self._unknowns.transfer(carried)
                root = T.createVecLeft()
                root.array_w[:] = np.sqrt(np.repeat(carried.weights, carried.W.dofmap.index_map_bs))
                scaled = T.copy()
                scaled.diagonalScale(L=root)
                mass = scaled.transposeMatMult(scaled)
                found = mass if found is None else found + mass
        assert found is not None
        start, stop = found.getOwnershipRange()
        first = self._unknowns.displacements.stop
        own = PETSc.IS().createStride(stop - start - first, first=start + first, comm=self._comm)
        return found.createSubMatrix(own, own)

    def diagonal(self, K: PETSc.Mat) -> PETSc.Vec:
        """Return sizes of the diagonal of a tangent, with signs that make a shift regularise it.

        It is ``|diag K|`` for displacements. For other fields, one after the other, it is the
        diagonal of ``K_ii - sum_j K_ij D_j^-1 K_ji`` with the sizes D_j of those before: that of
        the Schur complement if these were diagonal. A pressure that enforces a constraint has it
        negative, whether or not K_ii is empty. Zeros are replaced by the largest of their field.
        """
        found = K.getDiagonal()
        values = found.array_w
        for block in self._unknowns.blocks:
            part = block.part
            if isinstance(block, ValueField):
                values[part] -= self._schur(K, found, part)
            else:
                values[part] = np.abs(values[part])
            own = np.abs(values[part])
            largest = over_ranks(self._comm, float(own.max(initial=0.0)), MPI.MAX)
            sums = over_ranks(self._comm, float(np.sign(values[part]).sum()))
            values[part] = np.where(own == 0.0, np.copysign(largest, sums), values[part])
        return found

    def _schur(self, K: PETSc.Mat, sizes: PETSc.Vec, part: slice) -> NDArray[np.float64]:
        """Return the part of a diagonal that earlier fields' unknowns take away."""
        first = K.getOwnershipRange()[0]
        stop = part.start
        before, own = (
            PETSc.IS().createStride(b - a, first=first + a, step=1, comm=self._comm)
            for a, b in ((0, stop), (part.start, part.stop))
        )
        if self._comm.allreduce(stop) == 0:
            return np.zeros(part.stop - part.start)
        left, right = K.createSubMatrix(own, before), K.createSubMatrix(before, own)
        inverse = right.createVecLeft()
        inverse.array_w[:] = sizes.array_r[:stop]
        inverse.reciprocal()
        right.diagonalScale(L=inverse)
        return np.asarray(left.matMult(right).getDiagonal().array_r)
