# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where the unknowns of a step live: on the ranks whose bodies they move, evenly.

The background's own ranges are no good layout for the reduced system: a body that fills a part of
the background leaves ranks without unknowns, and a body that has moved finds its columns of T on
other ranks. Free dofs are therefore numbered anew in each step: each goes to the rank with most
rows of T in its column, as far as no rank gets more than its share.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .exchange import swap
from .location import PointBasis

__all__ = ["FreeDofs", "TouchedNodes", "even", "imbalance"]

#: How much more than an even share a rank may have for the sake of locality.
SLACK = 0.05


class Rows(NamedTuple):
    """Rows of T, one for each local node of W, in compressed rows of touched nodes of V."""

    offsets: NDArray[np.int64]
    nodes: NDArray[np.int32]
    values: NDArray[np.float64]


class TouchedNodes:
    """The nodes of V that the bodies' nodes on this rank touch, and the ranks that own them.

    Args:
        V: Background space (collective).
        bases: Background basis at the local nodes of W of each body.
        owned: How many of these are the rank's own, which come first.

    Attributes:
        nodes: The touched nodes, global numbers, sorted.
        rows: The rows of T of each body, in numbers of the touched nodes.
        active: This rank's own nodes of V that any rank touches, local numbers, sorted.
        homes: For each of these the rank that touches it most often.
    """

    def __init__(
        self, V: fem.FunctionSpace, bases: Sequence[PointBasis], owned: Sequence[int]
    ) -> None:
        self._comm: MPI.Comm = V.mesh.comm
        self._owned = owned
        first, last = V.dofmap.index_map.local_range
        self._size = last - first
        kept = [basis.values != 0.0 for basis in bases]
        every = np.concatenate([basis.nodes[keep] for basis, keep in zip(bases, kept, strict=True)])
        self.nodes, numbers, counts = _distinct(every)
        self.rows = []
        for basis, keep in zip(bases, kept, strict=True):
            ends = np.cumsum(np.count_nonzero(keep, axis=1))
            mine, numbers = np.split(numbers, [int(ends[-1]) if len(ends) else 0])
            offsets = np.concatenate([[0], ends]).astype(np.int64)
            self.rows.append(Rows(offsets, mine, basis.values[keep]))
        firsts = self._comm.allgather(first)
        self._ends = np.searchsorted(self.nodes, firsts[1:])
        told = swap(self._comm, self._by_owner(np.column_stack([self.nodes, counts])))
        self._own = [part[:, 0] - first for part in told]
        most = np.zeros(self._size, dtype=np.int64)
        homes = np.zeros(self._size, dtype=np.int64)
        for rank, (own, part) in enumerate(zip(self._own, told, strict=True)):
            better = part[:, 1] > most[own]
            homes[own[better]] = rank
            most[own[better]] = part[better, 1]
        self.active: NDArray[np.int32] = np.flatnonzero(most).astype(np.int32)
        self.homes: NDArray[np.int64] = homes[self.active]

    def _by_owner(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        return np.split(values, self._ends)

    def spread(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return at the touched nodes what their owners have (collective).

        Args:
            values: One row for each own node of V, shape ``(n, ...)``.
        """
        return np.concatenate(swap(self._comm, [values[own] for own in self._own]))

    def collect(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the sums of all ranks' values at this rank's own nodes of V (collective).

        Args:
            values: One row for each touched node, shape ``(n, ...)``.
        """
        result = np.zeros((self._size, *values.shape[1:]), dtype=values.dtype)
        for own, part in zip(self._own, swap(self._comm, self._by_owner(values)), strict=True):
            result[own] += part
        return result

    def off_rank(self, owner: NDArray[np.int64]) -> tuple[float, int]:
        """Return the share of rows with a node on another rank, and how many nodes that are.

        Args:
            owner: Rank of each own node of V as an unknown, -1 where it is none (collective).
        """
        comm = self._comm
        ranks = self.spread(owner)
        off = (ranks >= 0) & (ranks != comm.rank)
        rows = 0
        for row, owned in zip(self.rows, self._owned, strict=True):
            before = np.concatenate([[0], np.cumsum(off[row.nodes])])[row.offsets[: owned + 1]]
            rows += int(np.count_nonzero(np.diff(before)))
        counts = np.array([rows, sum(self._owned), off.sum()])
        off_rank, total, columns = comm.allreduce(counts)
        return float(off_rank / max(total, 1)), int(columns)


def _distinct(
    nodes: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]:
    """Return the distinct nodes, sorted; the number of each among them; how often they occur."""
    low = int(nodes.min(initial=np.iinfo(np.int64).max))
    span = int(nodes.max(initial=low - 1)) - low + 1
    if span > 8 * len(nodes):
        found, number, counts = np.unique(nodes, return_inverse=True, return_counts=True)
        return found, number.astype(np.int32), counts
    counts = np.bincount(nodes - low, minlength=span)
    found = np.flatnonzero(counts)
    table = np.empty(span, dtype=np.int32)
    table[found] = np.arange(len(found))
    return found + low, table[nodes - low], counts[found]


class FreeDofs:
    """A numbering of the free dofs of V, and values that move between it and V's own.

    Args:
        V: Background space.
        free: This rank's own dofs of V that are free, local numbers, sorted.
        touched: The nodes that bodies touch (collective).

    Attributes:
        columns: The free dofs, global numbers of V, in the order of the new numbers.
        numbers: New number of each of ``free``, shape ``(len(free),)``.
        sizes: Number of free dofs of this rank and of all ranks.
        off_rank_rows: Share of the rows of T (the bodies' nodes) with an unknown of another rank.
        off_rank_columns: Number of unknowns that ranks need from others for a product with T.
    """

    def __init__(
        self, V: fem.FunctionSpace, free: NDArray[np.int32], touched: TouchedNodes
    ) -> None:
        self._comm: MPI.Comm = V.mesh.comm
        self._V, self._free = V, free
        comm, bs = self._comm, V.dofmap.index_map_bs
        start = V.dofmap.index_map.local_range[0] * bs
        index = free.astype(np.int64) + start
        self.off_rank_rows, self.off_rank_columns = 0.0, 0
        self._order: NDArray[np.int64] | None = None
        if comm.size == 1:
            self.numbers = np.arange(len(free))
            self._set_columns(index)
            return
        homes = np.full(V.dofmap.index_map.size_local, comm.rank, dtype=np.int64)
        homes[touched.active] = touched.homes
        ranks = even(comm, homes[free // bs], SLACK)
        owner = np.full(V.dofmap.index_map.size_local, -1, dtype=np.int64)
        owner[free // bs] = ranks
        self.off_rank_rows, off = touched.off_rank(owner)
        self.off_rank_columns = bs * off
        self._order = np.argsort(ranks, kind="stable")
        self._sent = np.searchsorted(ranks[self._order], np.arange(1, comm.size))
        received = swap(comm, np.split(index[self._order], self._sent))
        self._received = np.cumsum([len(part) for part in received])[:-1]
        columns = np.concatenate(received)
        last = sum(comm.allgather(len(columns))[: comm.rank + 1])
        self.numbers = self._returned(np.arange(last - len(columns), last))
        self._set_columns(columns)

    def _set_columns(self, columns: NDArray[np.int64]) -> None:
        self.columns = PETSc.IS().createGeneral(columns.astype(PETSc.IntType), comm=self._comm)
        self.sizes: tuple[int, int] = self.columns.getLocalSize(), self.columns.getSize()

    def _returned(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return at ``free`` what the ranks of the unknowns have."""
        result = np.empty(len(self._free), dtype=values.dtype)
        result[self._order] = np.concatenate(swap(self._comm, np.split(values, self._received)))
        return result

    def collect(self, values: NDArray[np.float64], x: PETSc.Vec) -> None:
        """Set the unknowns to values at ``free``, the dofs on the ranks that own them in V."""
        if self._order is not None:
            parts = swap(self._comm, np.split(values[self._order], self._sent))
            values = np.concatenate(parts)
        x.array_w[:] = values

    def spread(self, x: PETSc.Vec) -> NDArray[np.float64]:
        """Return the unknowns at ``free``, the dofs on the ranks that own them in V."""
        values = np.asarray(x.array_r)
        return values if self._order is None else self._returned(values)

    def rigid_motions(self) -> PETSc.NullSpace:
        """Return the rigid motions of the background in the unknowns (collective)."""
        gdim = self._V.mesh.geometry.dim
        x = self._V.tabulate_dof_coordinates()[: self._V.dofmap.index_map.size_local, :gdim]
        motions = [np.broadcast_to(e, x.shape) for e in np.eye(gdim)]
        for i, j in combinations(range(gdim), 2):
            turn = np.zeros_like(x)
            turn[:, i], turn[:, j] = -x[:, j], x[:, i]
            motions.append(turn)
        found: list[PETSc.Vec] = []
        for motion in motions:
            vector = PETSc.Vec().createMPI(self.sizes, comm=self._comm)
            self.collect(motion.ravel()[self._free], vector)
            before = vector.norm()
            for other in found * 2:  # twice is enough for orthogonality (Parlett 1980, section 6-9)
                vector.axpy(-vector.dot(other), other)
            if vector.normalize() > 1e-12 * before:
                found.append(vector)
        return PETSc.NullSpace().create(vectors=found, comm=self._comm)


def imbalance(comm: MPI.Comm, count: int) -> float:
    """Return the largest count of a rank over the mean of all (collective)."""
    counts = comm.allgather(count)
    return float(max(counts) * len(counts) / max(sum(counts), 1))


def even(comm: MPI.Comm, homes: NDArray[np.int64], slack: float) -> NDArray[np.int64]:
    """Return a rank for each item, its home unless that has its share already (collective).

    Args:
        comm: The ranks.
        homes: Rank where each of this rank's items is best, shape ``(n,)``. Where a home has
            too many, the last ones (it keeps its own first; then by rank and order) go to ranks
            that have room.
        slack: How much more than an even share, relatively, a rank may have.

    Returns:
        Ranks, shape ``(n,)``.
    """
    size = comm.size
    counts = np.empty((size, size), dtype=np.int64)
    comm.Allgather(np.bincount(homes, minlength=size), counts)
    total = counts.sum(axis=0)
    most = int(np.ceil((1.0 + slack) * total.sum() / size))
    # First come those that are at home already, then the others by rank.
    stay = counts.diagonal()
    before = counts[: comm.rank].sum(axis=0) + np.where(np.arange(size) > comm.rank, stay, 0)
    before[comm.rank] = 0
    order = np.argsort(homes, kind="stable")
    ends = np.searchsorted(homes[order], np.arange(size + 1))
    excess = np.maximum(total - most, 0)
    room = np.cumsum(np.maximum(most - total, 0))
    ranks = homes.copy()
    for home in np.flatnonzero(excess):
        which = order[ends[home] : ends[home + 1]]
        place = before[home] + np.arange(len(which)) - most
        late = place >= 0
        slot = excess[:home].sum() + place[late]
        ranks[which[late]] = np.searchsorted(room, slot, side="right")
    return ranks
