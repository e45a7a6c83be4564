# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Columns of the transfer that depend on each other: combinations of dofs that move no node."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

__all__ = ["dependent_columns"]

#: Most rows of a column that is looked at, and what is left of a column of length one that
#: depends on others.
FEW_ROWS = 6
DEPENDENT = 1e-7


def dependent_columns(
    comm: MPI.Comm,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    values: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Find columns of a distributed matrix that are combinations of other columns (collective).

    Only columns with few rows can be, in a transfer: those of background nodes that few nodes
    of the body see. They fall into small groups that share no row, and in each group columns are
    orthogonalised in the order of what is left of them, the largest first (Businger & Golub
    1965); those of which nothing is left depend on the others.

    Args:
        comm: The ranks.
        rows: Global row of each entry this rank owns.
        columns: Its global column.
        values: Its value, not zero.

    Returns:
        Global columns that depend on others, sorted, the same on all ranks.
    """
    mine, counts = np.unique(columns, return_counts=True)
    everywhere = comm.allgather((mine, counts)) if comm.size > 1 else [(mine, counts)]
    known, place = np.unique(np.concatenate([m for m, _ in everywhere]), return_inverse=True)
    total = np.bincount(place, weights=np.concatenate([c for _, c in everywhere]))
    few = known[total <= FEW_ROWS]
    picked = np.isin(columns, few)
    part = rows[picked], columns[picked], values[picked]
    parts = comm.allgather(part) if comm.size > 1 else [part]
    i, j, v = (np.concatenate(each) for each in zip(*parts, strict=True))
    if len(i) == 0:
        return few[:0]
    _, i = np.unique(i, return_inverse=True)
    names, j = np.unique(j, return_inverse=True)
    label = _groups(i, j, len(names))
    found: list[int] = []
    order = np.argsort(label[j], kind="stable")
    cuts = np.flatnonzero(np.diff(label[j][order])) + 1
    for entries in np.split(order, cuts):
        some, column = np.unique(j[entries], return_inverse=True)
        _, row = np.unique(i[entries], return_inverse=True)
        if len(some) == 1:
            continue
        block = np.zeros((row.max() + 1, len(some)))
        block[row, column] = v[entries]
        found.extend(names[some[_dependent(block)]].tolist())
    return np.sort(np.asarray(found, dtype=np.int64))


def _groups(i: NDArray[np.int64], j: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the group of each column: those that share rows have one, directly or by others."""
    label = np.arange(count)
    while True:
        lowest = np.full(i.max() + 1, count)
        np.minimum.at(lowest, i, label[j])
        new = label.copy()
        np.minimum.at(new, j, lowest[i])
        if np.array_equal(new, label):
            return label
        label = new


def _dependent(block: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the columns of a dense matrix that depend on others."""
    left = block / np.linalg.norm(block, axis=0)
    rest = np.arange(left.shape[1])
    while len(rest):
        size = np.linalg.norm(left[:, rest], axis=0)
        best = int(size.argmax())
        if size[best] < DEPENDENT:
            return rest
        pivot = left[:, rest[best]] / size[best]
        rest = np.delete(rest, best)
        left[:, rest] -= np.outer(pivot, pivot @ left[:, rest])
    return rest
