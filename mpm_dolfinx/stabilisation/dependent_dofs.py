# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Columns of the transfer that depend on each other: combinations of dofs that move no node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..particles.particles import Particles
from ..transfer.touched import TouchedNodes
from .cure import Cure

__all__ = ["Dependence", "DependentDofs", "dependent_columns", "dependent_dofs"]

#: Most rows of a column that is looked at, and what is left of a column of length one that
#: depends on others. A shift of 1e-13 would freeze by half what is left of 3e-7.
FEW_ROWS = 6
DEPENDENT = 1e-6
#: Share of a column's length in a row where it is alone that makes it independent.
CLEAR = 1e-2
#: Most columns that are orthogonalised together.
LARGEST = 300


class Dependence(NamedTuple):
    """Columns that are combinations of others: ``T[:, columns[d]] = sum_k c T[:, stand_in]``.

    The same on all ranks.

    Attributes:
        columns: The columns that depend on others, sorted, shape ``(n,)``.
        which: Number among them of the dependent column of each term, shape ``(m,)``.
        stand_ins: The column of each term, none of which depends on others, shape ``(m,)``.
        coefficients: Its coefficient c, shape ``(m,)``.
    """

    columns: NDArray[np.int64]
    which: NDArray[np.int64]
    stand_ins: NDArray[np.int64]
    coefficients: NDArray[np.float64]


class DependentDofs(Cure):
    """Dofs whose column of T others can stand in for are no unknowns.

    Args:
        bodies: The bodies on one background space of degree 1.
    """

    def __init__(self, bodies: Sequence[Particles]) -> None:
        super().__init__()
        self._bodies = list(bodies)
        V = bodies[0].V
        self._comm: MPI.Comm = V.mesh.comm
        bs = V.dofmap.index_map_bs
        self._first, self._last = (end * bs for end in V.dofmap.index_map.local_range)

    def unknowns(self, touched: TouchedNodes, held: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """See :meth:`Cure.unknowns`: not those that depend on others."""
        result = touched.on_dofs(touched.has_weight)
        self._dependence = dependent_dofs(self._bodies, touched, result & ~held)
        dependent = self._dependence.columns
        own = (dependent >= self._first) & (dependent < self._last)
        result[dependent[own] - self._first] = False
        self.counts = {"dependent_dofs": len(dependent)}
        return result

    def stand_in(self, u: NDArray[np.float64]) -> None:
        """See :meth:`Cure.stand_in`: T u stays (collective)."""
        found, start = self._dependence, self._first
        values = np.zeros(len(found.columns))
        own = (found.columns >= start) & (found.columns < self._last)
        values[own] = u[found.columns[own] - start]
        values = self._comm.allreduce(values) if self._comm.size > 1 else values
        own = (found.stand_ins >= start) & (found.stand_ins < self._last)
        stand_ins = found.stand_ins[own] - start
        np.add.at(u, stand_ins, (found.coefficients * values[found.which])[own])


def dependent_dofs(
    bodies: Sequence[Particles], touched: TouchedNodes, free: NDArray[np.bool_]
) -> Dependence:
    """Find free dofs of V whose columns of T depend on those of others (collective).

    Only columns with few rows can, in a transfer of degree one: those of background nodes that few
    nodes of the body see.

    Args:
        bodies: Bodies on one background space.
        touched: The nodes of V that they touch.
        free: Whether each dof of V that this rank owns can be an unknown.

    Returns:
        Global dofs.
    """
    V = bodies[0].V
    comm, bs = V.mesh.comm, V.dofmap.index_map_bs
    counts = np.zeros(len(touched.nodes), dtype=np.int64)
    own, start = [], 0
    for body, rows in zip(bodies, touched.rows, strict=True):
        index = body.W.dofmap.index_map
        offsets = rows.offsets[: index.size_local + 1]
        row = np.repeat(np.arange(index.size_local), np.diff(offsets))
        own.append((row + index.local_range[0] + start, rows.nodes[: offsets[-1]], rows.values))
        counts += np.bincount(own[-1][1], minlength=len(counts))
        start += index.size_global
    few = touched.spread(touched.collect(counts) <= FEW_ROWS)
    unknown = touched.spread(free.reshape(-1, bs))
    parts = []
    for row, node, values in own:
        picked = few[node]
        node = node[picked]
        parts.append(
            (row[picked], touched.nodes[node], values[: len(picked)][picked], unknown[node])
        )
    every = [tuple(np.concatenate(column) for column in zip(*parts, strict=True))]
    if comm.size > 1:
        every = comm.allgather(every[0])
    row, node, values, mask = (np.concatenate(column) for column in zip(*every, strict=True))
    found: dict[bytes, Dependence] = {}
    results = []
    for component, kept in enumerate(mask.T):
        key = kept.tobytes()
        if key not in found:
            found[key] = dependent_columns(row[kept], node[kept], values[kept])
        columns, which, stand_ins, coefficients = found[key]
        dofs = [nodes * bs + component for nodes in (columns, stand_ins)]
        results.append(Dependence(dofs[0], which, dofs[1], coefficients))
    return _joined(results)


def _joined(parts: Sequence[Dependence]) -> Dependence:
    """Return what is known of different columns as one."""
    columns, which, stand_ins, coefficients = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
    ends = np.cumsum([0, *(len(part.columns) for part in parts[:-1])])
    which = which + np.repeat(ends, [len(part.which) for part in parts])
    order = np.argsort(columns)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return Dependence(columns[order], place[which], stand_ins, coefficients)


def dependent_columns(
    rows: NDArray[np.int64], columns: NDArray[np.int64], values: NDArray[np.float64]
) -> Dependence:
    """Find columns of a sparse matrix that are combinations of other columns.

    A column that is alone in a row depends on none. The others fall into groups that share no
    row, and in each group columns are orthogonalised in the order of what is left of them, the
    largest first (Businger & Golub 1965); those of which nothing is left depend on the others.
    Of a group too large for that, the columns with most rows are taken to be independent.

    Args:
        rows: Row of each entry.
        columns: Its column.
        values: Its value, not zero.
    """
    known, j = np.unique(columns, return_inverse=True)
    _, i = np.unique(rows, return_inverse=True)
    total = np.bincount(j)
    terms: list[tuple[int, int, float]] = []
    left = np.arange(len(j))
    for few in range(int(total.max(initial=0)), 0, -1):
        left = left[total[j[left]] <= few]
        left = left[_entangled(i[left], j[left], values[left])]
        if len(left) == 0:
            break
        label = _groups(i[left], j[left], len(known))[j[left]]
        _, first = np.unique(j[left], return_index=True)
        large = np.bincount(label[first], minlength=len(known))[label] > LARGEST
        small = np.flatnonzero(~large)[np.argsort(label[~large], kind="stable")]
        cuts = np.flatnonzero(np.diff(label[small])) + 1
        for entries in np.split(left[small], cuts) if len(small) else ():
            terms += _terms(i[entries], j[entries], values[entries])
        left = left[large]
    dependent, stand_in, coefficients = zip(*terms, strict=True) if terms else ((), (), ())
    found, which = np.unique(np.array(dependent, dtype=np.int64), return_inverse=True)
    stand_ins = known[np.array(stand_in, dtype=np.int64)]
    return Dependence(known[found], which, stand_ins, np.array(coefficients, dtype=np.float64))


def _terms(
    i: NDArray[np.int64], j: NDArray[np.int64], values: NDArray[np.float64]
) -> list[tuple[int, int, float]]:
    """Return dependent column, stand-in and coefficient of each term in a group of columns."""
    names, column = np.unique(j, return_inverse=True)
    _, row = np.unique(i, return_inverse=True)
    block = np.zeros((row.max() + 1, len(names)))
    block[row, column] = values
    dependent = _dependent(block)
    if len(dependent) == 0:
        return []
    others = np.setdiff1d(np.arange(len(names)), dependent)
    solution = np.linalg.lstsq(block[:, others], block[:, dependent])[0]
    return [
        (int(names[d]), int(names[other]), float(solution[k, n]))
        for n, d in enumerate(dependent)
        for k, other in enumerate(others)
    ]


def _entangled(
    i: NDArray[np.int64], j: NDArray[np.int64], values: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the entries of columns that may depend on each other.

    A column that is alone in a row is part of no combination that vanishes; without it another
    may be alone.
    """
    length = np.sqrt(np.bincount(j, weights=values**2))
    clear = np.abs(values) > CLEAR * length[j]
    kept = np.arange(len(values))
    while len(kept):
        alone = (np.bincount(i[kept])[i[kept]] == 1) & clear[kept]
        free = np.zeros(len(length), dtype=bool)
        free[j[kept[alone]]] = True
        if not free.any():
            break
        kept = kept[~free[j[kept]]]
    return kept


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
    left = np.ascontiguousarray((block / np.linalg.norm(block, axis=0)).T)
    order = np.arange(len(left))
    size = np.ones(len(left))
    for k in range(len(left)):
        best = k + int(size[k:].argmax())
        for values in (left, order, size):
            values[[k, best]] = values[[best, k]]
        length = np.linalg.norm(left[k])
        if length < DEPENDENT:
            return order[k:]
        pivot = left[k] / length
        along = left[k + 1 :] @ pivot
        left[k + 1 :] -= along[:, None] * pivot
        size[k + 1 :] -= along**2
    return order[:0]
