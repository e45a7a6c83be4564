# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The rank that owns the background around a point."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..parallel.balance import SLACK
from ..parallel.bisection import bisect
from .basis import BackgroundBasis

__all__ = ["ranks_of_background"]


def ranks_of_background(
    V: fem.FunctionSpace, background: BackgroundBasis, points: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return for each point the rank that owns most of the background where it lies (collective).

    Where a rank would get more than 5 % above an even share, the points are cut into even compact
    parts instead, and each part goes to the rank that owns most of the background there.

    Args:
        V: Background space.
        background: Its basis.
        points: This rank's points, shape ``(n, gdim)``.
    """
    comm = V.mesh.comm
    basis = background.at(points)
    firsts = np.array(comm.allgather(V.dofmap.index_map.local_range[0]))
    owners = np.searchsorted(firsts, basis.nodes, side="right") - 1
    shares = np.einsum("nk,nkj->nj", basis.values, owners[:, :, None] == owners[:, None, :])
    best = np.take_along_axis(owners, shares.argmax(axis=1)[:, None], axis=1)[:, 0]
    homes = np.where(basis.found, best, comm.rank)
    counts = comm.allreduce(np.bincount(homes, minlength=comm.size))
    if counts.max() <= np.ceil((1.0 + SLACK) * counts.mean()):
        return homes
    parts = bisect(comm, points, comm.size)
    return _ranks_of_parts(comm, parts, homes)[parts]


def _ranks_of_parts(
    comm: MPI.Comm, parts: NDArray[np.int64], homes: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return a rank for each part: where most is at home, else where most is (collective)."""
    size = comm.size
    at_home = np.bincount(parts * size + homes, minlength=size**2)
    here = np.zeros((size, size), dtype=np.int64)
    here[:, comm.rank] = np.bincount(parts, minlength=size)
    comm.Allreduce(MPI.IN_PLACE, at_home)
    comm.Allreduce(MPI.IN_PLACE, here)
    ranks = np.full(size, -1, dtype=np.int64)
    free = np.ones(size, dtype=bool)
    for pair in np.lexsort((-here.ravel(), -at_home)):
        part, rank = divmod(int(pair), size)
        if ranks[part] < 0 and free[rank]:
            ranks[part], free[rank] = rank, False
    return ranks
