# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pairs of background cells with a common facet, across ranks too."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix.ufl
from dolfinx import fem

from .. import _compat
from ..meshes.quadrature import cell_volumes

__all__ = ["CellPairs"]


class CellPairs:
    """Pairs of background cells that share a facet, across ranks too.

    Ghost cells are not used, so any ghost mode will do. Cells of other ranks have numbers after
    those of this rank's own cells.

    Args:
        V: Background space (collective).

    Attributes:
        pairs: Two cells of each pair with an own cell, which is the first, shape ``(n, 2)``.
        mine: Whether a pair belongs to this rank, that of the lower one of its cells' owners.
        num_own: Number of cells that this rank owns.
        nodes: Global nodes of V of each cell, those of other ranks last, shape ``(c, k)``.
        volumes: Volumes of the cells that this rank owns, areas in the plane.
    """

    def __init__(self, V: fem.FunctionSpace) -> None:
        background = V.mesh
        topology = background.topology
        tdim = topology.dim
        self._comm: MPI.Comm = background.comm
        self.num_own = int(topology.index_map(tdim).size_local)
        topology.create_connectivity(tdim, 0)
        shape = basix.topology(background.basix_cell())
        corners, facets = len(shape[0]), np.asarray(shape[tdim - 1])
        local = topology.connectivity(tdim, 0).array.reshape(-1, corners)[: self.num_own]
        vertices = topology.index_map(0).local_to_global(local.ravel()).reshape(-1, corners)
        keys = np.sort(vertices[:, facets], axis=2).reshape(-1, facets.shape[1])
        cells = np.repeat(np.arange(self.num_own), len(facets))
        first, second, single = _matched(keys)
        inner = np.column_stack([cells[first], cells[second]])
        cell, rank, other = self._across(keys[single], cells[single]).T
        homes, number = np.unique(np.column_stack([rank, other]), axis=0, return_inverse=True)
        outer = np.column_stack([cell, self.num_own + number.reshape(-1)])
        self.pairs: NDArray[np.int64] = np.concatenate([inner, outer]).astype(np.int64)
        self.mine: NDArray[np.bool_] = np.concatenate(
            [np.ones(len(inner), dtype=bool), rank > self._comm.rank]
        )
        asked = [homes[homes[:, 0] == r, 1] for r in range(self._comm.size)]
        self._sent: list[NDArray[np.int64]] = self._comm.alltoall(asked)
        dofs = V.dofmap.list[: self.num_own]
        nodes = V.dofmap.index_map.local_to_global(dofs.ravel()).reshape(dofs.shape)
        self.nodes = self.with_others(nodes)
        self._background = background
        own = np.arange(self.num_own if self._comm.size > 1 else 0)
        self._beyond = self.with_others(self._own_vertices(own))[len(own) :].copy()
        self.volumes = cell_volumes(background)

    def _own_vertices(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        geometry = self._background.geometry
        corners = _compat.geometry_dofmap(self._background)[cells]
        return np.asarray(geometry.x[corners, : geometry.dim])

    def vertices(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the geometry nodes of cells, ``(..., m, gdim)``."""
        own = cells < self.num_own
        found = np.empty((*cells.shape, *self._beyond.shape[1:]))
        found[own] = self._own_vertices(cells[own])
        found[~own] = self._beyond[cells[~own] - self.num_own]
        return found

    def _across(self, keys: NDArray[np.int64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return pairs with another rank's cell: own cell, that rank, its cell; shape ``(n, 3)``.

        Args:
            keys: Facets with one own cell, by their vertices, shape ``(n, m)``.
            cells: Those cells.
        """
        size = self._comm.size
        if size == 1:
            return np.zeros((0, 3), dtype=np.int64)
        meeting = keys[:, 0] % size
        told = self._comm.alltoall(
            [np.column_stack([keys, cells])[meeting == r] for r in range(size)]
        )
        source = np.repeat(np.arange(size), [len(t) for t in told])
        whole = np.concatenate(told)
        a, b, _ = _matched(whole[:, :-1])
        a, b = np.concatenate([a, b]), np.concatenate([b, a])
        answers = np.column_stack([whole[a, -1], source[b], whole[b, -1]])
        mine = self._comm.alltoall([answers[source[a] == r] for r in range(size)])
        return np.concatenate(mine).reshape(-1, 3)

    def with_others(self, values: NDArray[Any]) -> NDArray[Any]:
        """Append to values of own cells those of the other ranks' cells in pairs (collective)."""
        if self._comm.size == 1:
            return values
        parts = self._comm.alltoall([values[cells] for cells in self._sent])
        return np.concatenate([values, *parts])


def _matched(
    keys: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows that are equal in pairs (first and second of each), and the single ones."""
    order = np.lexsort(keys.T[::-1])
    same = np.zeros(len(keys) + 1, dtype=bool)
    same[1:-1] = (np.diff(keys[order], axis=0) == 0).all(axis=1)
    first = np.flatnonzero(same[1:])
    single = order[~(same[1:] | same[:-1])]
    return order[first], order[first + 1], single
