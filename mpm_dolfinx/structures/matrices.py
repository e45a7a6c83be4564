# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tangent of a structure: on its nodes and slips, then on bodies and slips."""

from __future__ import annotations

from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .. import _compat
from .hosts import Hosts

__all__ = ["Matrices"]

type Array = NDArray[np.float64]
type Sizes = tuple[int, int]
"""Number of rows on this rank, and on all."""


class _Entries(NamedTuple):
    """A matrix that sums up entries.

    Attributes:
        matrix: The matrix.
        mine: Which of all entries are there, in rows of this rank.
    """

    matrix: PETSc.Mat
    mine: NDArray[np.bool_]

    def set(self, values: Array) -> PETSc.Mat:
        """Return the matrix with other entries (collective)."""
        _compat.set_entries(self.matrix, np.ascontiguousarray(values.ravel()[self.mine]))
        return self.matrix


class Matrices:
    """The tangents of a structure with the same cells in the same bodies (collective).

    Args:
        hosts: The bodies that move its nodes.
        cells: Nodes of its cells, shape ``(m, k)``.
        slips: Nodes that slip, shape ``(b,)``.
        layout: Sizes of the unknowns of slips; ``None``: there are none.
        comm: The ranks.
    """

    def __init__(
        self,
        hosts: Hosts,
        cells: NDArray[np.int64],
        slips: NDArray[np.int64],
        layout: Sizes | None,
        comm: MPI.Comm,
    ) -> None:
        self._hosts, self._cells, self._slips, self._comm = hosts, cells, slips, comm
        (m, k), gdim = cells.shape, hosts.gdim
        dofs = cells[:, :, None] * gdim + np.arange(gdim)
        whole = (m, k, gdim, k, gdim)
        rows, columns = dofs[:, :, :, None, None], dofs[:, None, None, :, :]
        self._nodes = self._entries(rows, columns, whole, (hosts.sizes, hosts.sizes))
        self._by_slips: _Entries | None = None
        self._on_slips: _Entries | None = None
        self._made: dict[tuple[int, int], PETSc.Mat] = {}
        if layout is None:
            return
        number = np.full(hosts.total, -1)
        number[slips] = np.arange(len(slips))
        z = number[cells]
        self._by_slips = self._entries(
            dofs[:, :, :, None], z[:, None, None, :], (m, k, gdim, k), (hosts.sizes, layout)
        )
        both = [np.broadcast_to(part, (m, k, k)).ravel() for part in (z[:, :, None], z[:, None])]
        pairs = [np.concatenate([part, np.arange(len(slips))]) for part in both]
        self._on_slips = self._entries(pairs[0], pairs[1], pairs[0].shape, (layout, layout))

    def _entries(
        self,
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        shape: tuple[int, ...],
        sizes: tuple[Sizes, Sizes],
    ) -> _Entries:
        """Return a matrix with entries at places, none where a place is negative (collective)."""
        i, j = (np.broadcast_to(part, shape).ravel() for part in (rows, columns))
        matrix = PETSc.Mat().create(comm=self._comm)
        matrix.setSizes(sizes)
        matrix.setType("aij")
        first, last = matrix.getOwnershipRange()
        mine = (i >= first) & (i < last) & (j >= 0)
        places = (part[mine].astype(PETSc.IntType) for part in (i, j))
        _compat.set_entry_places(matrix, *places)
        return _Entries(matrix, mine)

    def of(self, tangent: Array, along: Array, bond: Array) -> dict[tuple[int, int], PETSc.Mat]:
        """Return the tangent on bodies, and after these on slips (collective).

        Args:
            tangent: Of the cells by their nodes, shape ``(m, k, gdim, k, gdim)``.
            along: Directions of slips, shape ``(b, gdim)``.
            bond: Derivatives of the bond's forces by slips, shape ``(b,)``.

        Returns:
            The same objects in each call.
        """
        made, every = self._made, self._hosts.rows
        K = self._nodes.set(tangent)
        for b, right in enumerate(every):
            KB = K.matMult(right)
            for a, left in enumerate(every):
                made[a, b] = left.transposeMatMult(KB, result=made.get((a, b)))
        if self._by_slips is not None and self._on_slips is not None:
            t = np.zeros((self._hosts.total, self._hosts.gdim))
            t[self._slips] = along
            Kt = np.einsum("mkglh,mlh->mkgl", tangent, t[self._cells])
            tKt = np.einsum("mkgl,mkg->mkl", Kt, t[self._cells])
            Kz, z = self._by_slips.set(Kt), len(every)
            for a, rows in enumerate(every):
                made[a, z] = rows.transposeMatMult(Kz, result=made.get((a, z)))
                made[z, a] = Kz.transposeMatMult(rows, result=made.get((z, a)))
            made[z, z] = self._on_slips.set(np.concatenate([tKt.ravel(), bond]))
        return made
