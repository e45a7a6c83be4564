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
from itertools import pairwise

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

__all__ = ["FreeDofs", "even", "imbalance"]

#: How much more than an even share a rank may have for the sake of locality.
SLACK = 0.05


class FreeDofs:
    """A numbering of the free dofs of V, and values that move between it and V's own.

    Args:
        V: Background space.
        free: This rank's own dofs of V that are free, local numbers, sorted.
        transfers: T of each body (collective).

    Attributes:
        columns: The free dofs, global numbers of V, in the order of the new numbers.
        numbers: New number of each of ``free``, shape ``(len(free),)``.
        sizes: Number of free dofs of this rank and of all ranks.
        off_rank_rows: Share of the rows of T (the bodies' nodes) with an unknown of another rank.
        off_rank_columns: Number of unknowns that ranks need from others for a product with T.
    """

    def __init__(
        self, V: fem.FunctionSpace, free: NDArray[np.int32], transfers: Sequence[PETSc.Mat]
    ) -> None:
        self._comm: MPI.Comm = V.mesh.comm
        comm, bs = self._comm, V.dofmap.index_map_bs
        start = V.dofmap.index_map.local_range[0] * bs
        index = free.astype(np.int64) + start
        self.off_rank_rows, self.off_rank_columns = 0.0, 0
        if comm.size == 1:
            self._place(index, np.arange(len(free)))
            return
        seen = _Columns(V, transfers)
        ranks = even(comm, seen.homes[free // bs], SLACK)
        owner = np.full(V.dofmap.index_map.size_local, -1, dtype=np.int64)
        owner[free // bs] = ranks
        self.off_rank_rows, off = seen.off_rank(owner)
        self.off_rank_columns = bs * off
        order = np.argsort(ranks, kind="stable")
        ends = np.searchsorted(ranks[order], np.arange(comm.size + 1))
        received = comm.alltoall([index[order[a:b]] for a, b in pairwise(ends)])
        firsts = comm.alltoall(_starts(comm, [len(part) for part in received]))
        numbers = np.empty(len(free), dtype=np.int64)
        for rank, first in enumerate(firsts):
            which = order[ends[rank] : ends[rank + 1]]
            numbers[which] = first + np.arange(len(which))
        self._place(np.concatenate(received), numbers)

    def _place(self, columns: NDArray[np.int64], numbers: NDArray[np.int64]) -> None:
        comm = self._comm
        self.columns = PETSc.IS().createGeneral(columns.astype(PETSc.IntType), comm=comm)
        self.numbers = numbers
        self.sizes: tuple[int, int] = self.columns.getLocalSize(), self.columns.getSize()
        self._scatter: PETSc.Scatter | None = None
        if comm.size > 1:
            self._own = PETSc.Vec().createMPI((len(numbers), self.sizes[1]), comm=comm)
            targets = PETSc.IS().createGeneral(numbers.astype(PETSc.IntType), comm=comm)
            x = PETSc.Vec().createMPI(self.sizes, comm=comm)
            self._scatter = PETSc.Scatter().create(self._own, None, x, targets)

    def collect(self, values: NDArray[np.float64], x: PETSc.Vec) -> None:
        """Set the unknowns to values at ``free``, the dofs on the ranks that own them in V."""
        if self._scatter is None:
            x.array_w[:] = values
            return
        self._own.array_w[:] = values
        self._scatter.scatter(self._own, x, addv=PETSc.InsertMode.INSERT)

    def spread(self, x: PETSc.Vec) -> NDArray[np.float64]:
        """Return the unknowns at ``free``, the dofs on the ranks that own them in V."""
        if self._scatter is None:
            return np.asarray(x.array_r)
        self._scatter.scatter(
            x, self._own, addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.REVERSE
        )
        return np.asarray(self._own.array_r)


def _starts(comm: MPI.Comm, counts: list[int]) -> list[int]:
    """Return where each part begins in the concatenation of all ranks' parts."""
    before = comm.allgather(sum(counts))
    first = sum(before[: comm.rank])
    return [first + sum(counts[:i]) for i in range(len(counts))]


class _Columns:
    """Which nodes of V the rows of T on this rank touch, and how often.

    Attributes:
        homes: For each own node of V the rank with most rows in its column; where no body
            touches it, this one.
    """

    def __init__(self, V: fem.FunctionSpace, transfers: Sequence[PETSc.Mat]) -> None:
        comm, bs, nodes = V.mesh.comm, V.dofmap.index_map_bs, V.dofmap.index_map
        self._comm = comm
        self._rows = []
        for T in transfers:
            starts, columns, _ = T.getValuesCSR()
            self._rows.append((starts, columns // bs))
        firsts = np.array(comm.allgather(nodes.local_range[0]))
        every = np.concatenate([columns for _, columns in self._rows])
        self._touched, counts = np.unique(every, return_counts=True)
        ends = np.append(np.searchsorted(self._touched, firsts), len(self._touched))
        told = comm.alltoall([(self._touched[a:b], counts[a:b]) for a, b in pairwise(ends)])
        self._asked = [where - firsts[comm.rank] for where, _ in told]
        self.homes: NDArray[np.int64] = np.full(nodes.size_local, comm.rank, dtype=np.int64)
        most = np.zeros(nodes.size_local, dtype=np.int64)
        for rank, (local, (_, count)) in enumerate(zip(self._asked, told, strict=True)):
            better = count > most[local]
            self.homes[local[better]] = rank
            most[local[better]] = count[better]

    def off_rank(self, owner: NDArray[np.int64]) -> tuple[float, int]:
        """Return the share of rows with a node on another rank, and how many nodes that are.

        Args:
            owner: New rank of each own node of V, -1 where it is not free.
        """
        comm = self._comm
        ranks = np.concatenate(comm.alltoall([owner[local] for local in self._asked]))
        off = (ranks >= 0) & (ranks != comm.rank)
        rows = total = 0
        for starts, columns in self._rows:
            flags = off[np.searchsorted(self._touched, columns)]
            sums = np.concatenate([[0], np.cumsum(flags)])[starts]
            rows += int(np.count_nonzero(np.diff(sums)))
            total += len(starts) - 1
        share = comm.allreduce(rows) / max(comm.allreduce(total), 1)
        return share, comm.allreduce(int(off.sum()))


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
    counts = np.array(comm.allgather(np.bincount(homes, minlength=size)))
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
