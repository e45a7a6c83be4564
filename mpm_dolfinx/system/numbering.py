# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where the unknowns of a step live: on the ranks whose bodies they move, evenly.

The background's own ranges are no good layout for the reduced system: a body that fills a part of
the background leaves ranks without unknowns, and a body that has moved finds its columns of T on
other ranks. Free dofs are therefore numbered anew in each step: each goes to the rank with most
rows of T in its column, as far as no rank gets more than its share.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import Any, Protocol

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..parallel.balance import even
from ..parallel.exchange import swap
from ..transfer.touched import TouchedNodes

__all__ = ["FreeDofs", "Numbering"]


class FreeDofs:
    """The free dofs of one V with ranks of their own, and values that move between these and V's.

    Args:
        V: Background space.
        free: This rank's own dofs of V that are free, local numbers, sorted.
        touched: The nodes that bodies touch (collective).

    Attributes:
        count: Number of unknowns of this rank.
        owners: Rank of the unknown of each of ``free``, shape ``(len(free),)``.
        places: Place of that unknown among its rank's, shape ``(len(free),)``.
        off_rank: Number of rows of T (nodes of bodies), of those with an unknown of another rank,
            and of unknowns that ranks need from others for a product with T, shape ``(3,)``.
    """

    def __init__(
        self, V: fem.FunctionSpace, free: NDArray[np.int32], touched: TouchedNodes
    ) -> None:
        self._comm: MPI.Comm = V.mesh.comm
        self._V, self._free = V, free
        comm, bs = self._comm, V.dofmap.index_map_bs
        self._order: NDArray[np.int64] | None = None
        if comm.size == 1:
            self.off_rank = np.zeros(3, dtype=np.int64)
            self.owners = np.zeros(len(free), dtype=np.int64)
            self.places = np.arange(len(free))
            self.count = len(free)
            return
        homes = np.full(touched.num_own, comm.rank, dtype=np.int64)
        homes[touched.active] = touched.homes
        nodes, number = np.unique(free // bs, return_inverse=True)
        owner = np.full(touched.num_own, -1, dtype=np.int64)
        owner[nodes] = even(comm, homes[nodes])  # (dofs of a node stay together)
        self.owners = owner[nodes][number]
        self.off_rank = touched.off_rank(owner) * (1, 1, bs)
        self._order = np.argsort(self.owners, kind="stable")
        self._sent = np.searchsorted(self.owners[self._order], np.arange(1, comm.size))
        received = swap(comm, np.split(free[self._order], self._sent))
        lengths = np.cumsum([len(part) for part in received])
        self.count, self._received = int(lengths[-1]), lengths[:-1]
        self.places = self.spread(np.arange(self.count))

    def collect(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return at this rank's unknowns the values at ``free``, on the ranks of V (collective)."""
        if self._order is None:
            return values
        return np.concatenate(swap(self._comm, np.split(values[self._order], self._sent)))

    def spread(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return at ``free``, on the ranks of V, the values at the unknowns (collective)."""
        if self._order is None:
            return values
        result = np.empty(len(self._free), dtype=values.dtype)
        result[self._order] = np.concatenate(swap(self._comm, np.split(values, self._received)))
        return result

    def rigid_motions(self) -> list[NDArray[np.float64]]:
        """Return the rigid motions of the background at this rank's unknowns (collective).

        Values that are no displacements have none.
        """
        gdim = self._V.mesh.geometry.dim
        if self._V.dofmap.index_map_bs != gdim:
            return []
        x = self._V.tabulate_dof_coordinates()[: self._V.dofmap.index_map.size_local, :gdim]
        motions = [np.broadcast_to(e, x.shape) for e in np.eye(gdim)]
        for i, j in combinations(range(gdim), 2):
            turn = np.zeros_like(x)
            turn[:, i], turn[:, j] = -x[:, j], x[:, i]
            motions.append(turn)
        return [self.collect(motion.ravel()[self._free]) for motion in motions]


class Unknowns(Protocol):
    """Some unknowns, as their numbering must know them; see :class:`FreeDofs`."""

    @property
    def count(self) -> int:
        """Number of unknowns of this rank."""

    @property
    def owners(self) -> NDArray[np.int64]:
        """Rank of each unknown that this rank knows."""

    @property
    def places(self) -> NDArray[np.int64]:
        """Place of each of these among its rank's."""

    @property
    def off_rank(self) -> NDArray[np.int64]:
        """Numbers of what crosses ranks, shape ``(3,)``."""

    def rigid_motions(self) -> list[NDArray[np.float64]]:
        """Return the rigid motions at this rank's unknowns (collective)."""


class Numbering:
    """Numbers of the unknowns of all fields: on each rank one field's after the other's.

    Args:
        comm: The ranks (collective).
        fields: The free dofs of each field, or unknowns that are no such.

    Attributes:
        sizes: Number of unknowns of this rank and of all ranks.
        parts: Where each field's unknowns are among this rank's.
        numbers: Number of the unknown of each free dof of each field.
        off_rank: Sum of :attr:`FreeDofs.off_rank`.
    """

    def __init__(self, comm: MPI.Comm, fields: Sequence[Unknowns]) -> None:
        self._comm, self._fields = comm, list(fields)
        self.off_rank = np.sum([free.off_rank for free in fields], axis=0)
        counts = np.array(comm.allgather([free.count for free in fields]))
        starts = np.concatenate([[0], np.cumsum(counts)])
        self.sizes: tuple[int, int] = int(counts[comm.rank].sum()), int(starts[-1])
        starts = starts[:-1].reshape(counts.shape)
        own = starts[comm.rank] - starts[comm.rank, 0]
        self.parts = [
            slice(int(first), int(first) + free.count)
            for first, free in zip(own, fields, strict=True)
        ]
        self.numbers: list[NDArray[np.int64]] = [
            starts[free.owners, number] + free.places for number, free in enumerate(fields)
        ]

    def is_of(self, fields: Sequence[Unknowns]) -> bool:
        """Return whether these are the numbers of some free dofs."""
        return all(map(operator.is_, fields, self._fields))

    def vector(self) -> PETSc.Vec:
        """Return a vector of all unknowns, zero (collective)."""
        return PETSc.Vec().createMPI(self.sizes, comm=self._comm)

    def rigid_motions(self, together: Sequence[int]) -> PETSc.NullSpace:
        """Return the rigid motions of each background in the unknowns (collective).

        Args:
            together: How many fields, one after the other, move as one.
        """
        found: list[PETSc.Vec] = []
        ends = np.cumsum([0, *together])
        pairs = list(zip(self.parts, self._fields, strict=True))
        for first, end in pairwise(ends):
            parts = [part for part, _ in pairs[first:end]]
            for motion in zip(*(free.rigid_motions() for _, free in pairs[first:end]), strict=True):
                vector = self.vector()
                for part, own in zip(parts, motion, strict=True):
                    vector.array_w[part] = own
                before = vector.norm()
                # Twice is enough for orthogonality (Parlett 1980, section 6-9).
                for other in found * 2:
                    vector.axpy(-vector.dot(other), other)
                if vector.normalize() > 1e-12 * before:
                    found.append(vector)
        return PETSc.NullSpace().create(vectors=found, comm=self._comm)
