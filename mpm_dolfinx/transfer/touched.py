# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rows of T, and the background nodes that they touch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..background.basis import PointBasis
from ..parallel.exchange import swap

__all__ = ["JointNodes", "TouchedNodes", "TransferRows", "joined_rows"]


class TransferRows(NamedTuple):
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
        block_size: Number of dofs at a node of V.
        num_own: Number of this rank's own nodes of V.
        active: This rank's own nodes of V that any rank touches, local numbers, sorted.
        homes: For each of these the rank that touches it most often.
    """

    def __init__(
        self, V: fem.FunctionSpace, bases: Sequence[PointBasis], owned: Sequence[int]
    ) -> None:
        self._comm: MPI.Comm = V.mesh.comm
        self._owned = owned
        first, last = V.dofmap.index_map.local_range
        self.num_own: int = last - first
        self.block_size: int = V.dofmap.index_map_bs
        kept = [basis.values != 0.0 for basis in bases]
        every = np.concatenate([basis.nodes[keep] for basis, keep in zip(bases, kept, strict=True)])
        self.nodes, numbers, counts = _distinct(every)
        self.rows = []
        for basis, keep in zip(bases, kept, strict=True):
            ends = np.cumsum(np.count_nonzero(keep, axis=1))
            mine, numbers = np.split(numbers, [int(ends[-1]) if len(ends) else 0])
            offsets = np.concatenate([[0], ends]).astype(np.int64)
            values = basis.values.ravel() if keep.all() else basis.values[keep]  # no copy if all
            self.rows.append(TransferRows(offsets, mine, values))
        firsts = self._comm.allgather(first)
        self._firsts = np.asarray(firsts)
        self._ends = np.searchsorted(self.nodes, firsts[1:])
        told = swap(self._comm, self._by_owner(np.column_stack([self.nodes, counts])))
        self._own = [part[:, 0] - first for part in told]
        most = np.zeros(self.num_own, dtype=np.int64)
        homes = np.zeros(self.num_own, dtype=np.int64)
        for rank, (own, part) in enumerate(zip(self._own, told, strict=True)):
            better = part[:, 1] > most[own]
            homes[own[better]] = rank
            most[own[better]] = part[better, 1]
        self.active: NDArray[np.int32] = np.flatnonzero(most).astype(np.int32)
        self.homes: NDArray[np.int64] = homes[self.active]

    @property
    def count(self) -> int:
        """Number of the touched nodes."""
        return len(self.nodes)

    @property
    def has_weight(self) -> NDArray[np.bool_]:
        """Whether any rank touches each of this rank's own nodes of V."""
        result = np.zeros(self.num_own, dtype=bool)
        result[self.active] = True
        return result

    def hold(self) -> NDArray[np.float64]:
        """Return the largest weight of each of this rank's own nodes of V, 0 without (collective).

        It is how well the bodies hold the node: 1 where one of their nodes lies on it.
        """
        largest = np.zeros(len(self.nodes))
        for row in self.rows:
            np.maximum.at(largest, row.nodes, np.abs(row.values))
        result = np.zeros(self.num_own)
        for own, part in zip(self._own, swap(self._comm, self._by_owner(largest)), strict=True):
            result[own] = np.maximum(result[own], part)
        return result

    def shared(self) -> NDArray[np.bool_]:
        """Return whether several bodies touch each of this rank's own nodes of V (collective)."""
        first = np.full(len(self.nodes), len(self.rows))
        last = np.full(len(self.nodes), -1)
        for number, row in enumerate(self.rows):
            first[row.nodes] = np.minimum(first[row.nodes], number)
            last[row.nodes] = number
        low, high = np.full(self.num_own, len(self.rows)), np.full(self.num_own, -1)
        told = swap(self._comm, self._by_owner(np.column_stack([first, last])))
        for own, part in zip(self._own, told, strict=True):
            low[own] = np.minimum(low[own], part[:, 0])
            high[own] = np.maximum(high[own], part[:, 1])
        return high > low

    def rows_on(self, nodes: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
        """Return whether each row of T has a weight on chosen nodes, for each body (collective).

        Args:
            nodes: Whether each of this rank's own nodes of V is chosen.
        """
        chosen, found = self.spread(nodes), []
        for row in self.rows:
            result = np.zeros(len(row.offsets) - 1, dtype=bool)
            number = np.repeat(np.arange(len(result)), np.diff(row.offsets))
            result[number[chosen[row.nodes]]] = True
            found.append(result)
        return found

    def at_nodes(self, values: NDArray[Any], nodes: NDArray[np.int64]) -> NDArray[Any]:
        """Return at any nodes of V what their owners have (collective).

        Args:
            values: One number for each own node of V.
            nodes: Global nodes, touched or not, of any shape.
        """
        wanted, number = np.unique(nodes, return_inverse=True)
        asked = np.split(wanted, np.searchsorted(wanted, self._firsts[1:]))
        first = self._firsts[self._comm.rank]
        answers = swap(self._comm, [values[own - first] for own in swap(self._comm, asked)])
        return np.concatenate(answers)[number].reshape(nodes.shape)

    def on_dofs(self, nodes: NDArray[Any]) -> NDArray[Any]:
        """Return values of this rank's own nodes of V at its own dofs."""
        return np.repeat(nodes, self.block_size)

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
        result = np.zeros((self.num_own, *values.shape[1:]), dtype=values.dtype)
        for own, part in zip(self._own, swap(self._comm, self._by_owner(values)), strict=True):
            result[own] += part
        return result

    def off_rank(self, owner: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many rows of T there are, how many have a node on another rank, and those.

        Args:
            owner: Rank of each own node of V as an unknown, -1 where it is none (collective).

        Returns:
            All rows, rows with such a node, and such nodes, each on all ranks, shape ``(3,)``.
        """
        comm = self._comm
        ranks = self.spread(owner)
        off = (ranks >= 0) & (ranks != comm.rank)
        rows = 0
        for row, owned in zip(self.rows, self._owned, strict=True):
            before = np.concatenate([[0], np.cumsum(off[row.nodes])])[row.offsets[: owned + 1]]
            rows += int(np.count_nonzero(np.diff(before)))
        return np.asarray(comm.allreduce(np.array([sum(self._owned), rows, off.sum()])))


class JointNodes:
    """The touched nodes of several spaces of the same block size, one after the other, as of one.

    Args:
        parts: Those of each space.

    Attributes:
        block_size: Number of dofs at a node.
        count: Number of the touched nodes.
    """

    def __init__(self, parts: Sequence[TouchedNodes]) -> None:
        self._parts = list(parts)
        self.block_size = parts[0].block_size
        self._ends = np.cumsum([part.count for part in parts])
        self._own_ends = np.cumsum([part.num_own for part in parts])
        self.count = int(self._ends[-1])

    def spread(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return :meth:`TouchedNodes.spread` of the own nodes of all spaces (collective)."""
        own = np.split(values, self._own_ends[:-1])
        return np.concatenate([p.spread(v) for p, v in zip(self._parts, own, strict=True)])

    def collect(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return :meth:`TouchedNodes.collect` of the touched nodes of all spaces (collective)."""
        touched = np.split(values, self._ends[:-1])
        return np.concatenate([p.collect(v) for p, v in zip(self._parts, touched, strict=True)])


def joined_rows(rows: Sequence[TransferRows], starts: Sequence[int]) -> TransferRows:
    """Return rows of T with the columns of several spaces beside each other.

    Args:
        rows: Those of the same nodes of W in each space.
        starts: The number from which on the touched nodes of each space are counted.
    """
    counts = [np.diff(one.offsets) for one in rows]
    offsets = np.concatenate([[0], np.cumsum(np.sum(counts, axis=0))]).astype(np.int64)
    nodes = np.empty(offsets[-1], dtype=np.int32)
    values = np.empty(offsets[-1])
    first = offsets[:-1].copy()
    for one, count, start in zip(rows, counts, starts, strict=True):
        places = np.arange(len(one.nodes)) + np.repeat(first - one.offsets[:-1], count)
        nodes[places], values[places] = one.nodes + start, one.values
        first += count
    return TransferRows(offsets, nodes, values)


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
