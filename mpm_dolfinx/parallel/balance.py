# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Even shares of a count among ranks, near to where its parts are."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

__all__ = ["SLACK", "even", "imbalance"]

#: How much more than an even share a rank may have for the sake of locality.
SLACK = 0.05


def imbalance(comm: MPI.Comm, count: int) -> float:
    """Return the largest count of a rank over the mean of all (collective)."""
    counts = comm.allgather(count)
    return float(max(counts) * len(counts) / max(sum(counts), 1))


def even(comm: MPI.Comm, homes: NDArray[np.int64], slack: float = SLACK) -> NDArray[np.int64]:
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
