# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rows of arrays that move between ranks, known by a global index."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

__all__ = ["RowExchange", "swap"]


def swap(comm: MPI.Comm, parts: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    """Return the parts that each rank has sent to this one (collective).

    Args:
        comm: The ranks.
        parts: What goes to each rank, shapes ``(n, ...)``: all of one type, and of one shape but
            for n, on all ranks.
    """
    if comm.size == 1:
        return [parts[0].copy()]
    counts = np.array([len(part) for part in parts])
    received = np.empty_like(counts)
    comm.Alltoall(counts, received)
    sent = np.concatenate(parts)
    result = np.empty((received.sum(), *sent.shape[1:]), dtype=sent.dtype)
    width = int(np.prod(sent.shape[1:]))
    comm.Alltoallv((sent, (counts * width).tolist()), (result, (received * width).tolist()))
    return np.split(result, np.cumsum(received)[:-1])


class RowExchange:
    """Brings rows from the ranks that have them to the ranks that want them.

    Who has which row is found through a directory that is itself spread over the ranks: rank r
    keeps the places of the r-th part of all indices. No rank sees more than its own share.

    Args:
        comm: The ranks (collective).
        have: Global index of each row that this rank has, from 0 on, each on one rank.
        want: Global index of each row that this rank wants, in any order, as often as it likes.

    Attributes:
        found: Whether any rank has each wanted row.
    """

    def __init__(self, comm: MPI.Comm, have: NDArray[np.int64], want: NDArray[np.int64]) -> None:
        self._comm = comm
        self._count = len(want)
        most = max(int(have.max(initial=-1)), int(want.max(initial=-1))) + 1
        self._share = -(-max(comm.allreduce(most, MPI.MAX), 1) // comm.size)
        base = comm.rank * self._share
        source = np.full(self._share, -1, dtype=np.int64)
        row = np.zeros(self._share, dtype=np.int64)
        sent = self._by_rank(have // self._share)
        told = comm.alltoall([(have[which], which) for which in sent])
        for rank, (index, where) in enumerate(told):
            source[index - base] = rank
            row[index - base] = where
        asked = self._by_rank(want // self._share)
        questions = comm.alltoall([want[w] - rank * self._share for rank, w in enumerate(asked)])
        answers = comm.alltoall([(source[q], row[q]) for q in questions])
        rank_of = np.full(len(want), -1, dtype=np.int64)
        row_of = np.zeros(len(want), dtype=np.int64)
        for which, (ranks, rows) in zip(asked, answers, strict=True):
            rank_of[which] = ranks
            row_of[which] = rows
        self.found: NDArray[np.bool_] = rank_of >= 0
        self._take = self._by_rank(rank_of)
        self._give = comm.alltoall([row_of[which] for which in self._take])

    def _by_rank(self, ranks: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Return for each rank the places where it is named."""
        order = np.argsort(ranks, kind="stable")
        ends = np.searchsorted(ranks[order], np.arange(self._comm.size + 1))
        return [order[a:b] for a, b in pairwise(ends)]

    def __call__(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the wanted rows (collective).

        Args:
            values: One row for each that this rank has, shape ``(len(have), ...)``.

        Returns:
            Shape ``(len(want), ...)``; zero where no rank has a row.
        """
        parts = self._comm.alltoall([values[rows] for rows in self._give])
        result: NDArray[Any] = np.zeros((self._count, *values.shape[1:]), dtype=values.dtype)
        for which, part in zip(self._take, parts, strict=True):
            result[which] = part
        return result
