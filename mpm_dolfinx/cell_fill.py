# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""How well bodies fill the cells of the background, and which cells are neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix
import basix.ufl
from dolfinx import fem, la

from . import _compat
from .location import PointBasis
from .particles import Particles

__all__ = ["CellFill", "CellPairs"]


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
        index: Input index of each cell, those of other ranks last, shape ``(c,)``.
        nodes: Global nodes of V of each cell, shape ``(c, k)``.
        vertices: Geometry nodes of each cell, shape ``(c, m, gdim)``.
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
        geometry = _compat.geometry_dofmap(background)[: self.num_own]
        self.index = self.with_others(_compat.input_cell_index(background))
        self.nodes = self.with_others(nodes)
        self.vertices = self.with_others(background.geometry.x[geometry, : background.geometry.dim])

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


class CellFill(NamedTuple):
    """What the bodies do to the cells of the background that this rank owns.

    Attributes:
        fill: Volume of each body inside each cell over the cell's, shape ``(c, bodies)``.
        active: Whether a body reaches into the cell, shape ``(c,)``.
    """

    fill: NDArray[np.float64]
    active: NDArray[np.bool_]

    @classmethod
    def of(cls, bodies: Sequence[Particles], count: int) -> CellFill:
        """Look at bodies at their last converged positions (collective).

        The volume is that of the history's quadrature points in the cell. A body may also
        reach into a cell with nodes alone, a sliver: the fill is zero then, but nodes of the
        cell have weight that belong to no filled cell.

        Args:
            bodies: The bodies.
            count: Number of background cells that this rank owns.
        """
        V = bodies[0].V
        comm: MPI.Comm = V.mesh.comm
        volume = np.zeros((count, len(bodies)))
        used = np.zeros(count, dtype=np.uint64)
        bit = np.uint64(1) << np.arange(V.dofmap.list.shape[1], dtype=np.uint64)
        for number, body in enumerate(bodies):
            points, volumes = body.quadrature_points()
            at = body.background_basis.at(points)
            for cells, values in _sent(comm, at, at.found, volumes):
                np.add.at(volume[:, number], cells, values)
            rows = body.node_basis.part(body.W.dofmap.index_map.size_local)
            bits = ((rows.values != 0.0) * bit).sum(axis=1, dtype=np.uint64)
            for cells, values in _sent(comm, rows, rows.found, bits):
                np.bitwise_or.at(used, cells, values)
        filled = volume.any(axis=1)
        own = V.dofmap.list[:count]
        known = la.vector(V.dofmap.index_map)
        known.array[own[filled]] = 1.0
        known.scatter_reverse(la.InsertMode.add)
        known.scatter_forward()
        alone = ((known.array[own] == 0.0) * bit).sum(axis=1, dtype=np.uint64)
        active = filled | ((used & alone) != 0)
        return cls(volume / _cell_volumes(V, count)[:, None], active)


def _sent(
    comm: MPI.Comm, at: PointBasis, which: NDArray[np.bool_], values: NDArray[Any]
) -> list[tuple[NDArray[np.int64], NDArray[Any]]]:
    """Send values at some points to the owners of their cells; return what comes (collective)."""
    assert at.cell is not None and at.rank is not None
    chosen = [which & (at.rank == r) for r in range(comm.size)]
    return comm.alltoall([(at.cell[pick], values[pick]) for pick in chosen])


def _cell_volumes(V: fem.FunctionSpace, count: int) -> NDArray[np.float64]:
    """Return the volumes of the first cells of a background."""
    background = V.mesh
    cell, gdim = background.basix_cell(), background.geometry.dim
    degree = _compat.geometry_degree(background)
    element = basix.ufl.element("Lagrange", cell.name, degree).basix_element
    points, weights = basix.make_quadrature(cell, gdim * degree)
    slopes = element.tabulate(1, points)[1:, :, :, 0]
    x = background.geometry.x[_compat.geometry_dofmap(background)[:count], :gdim]
    jacobian = np.einsum("jqk,nki->nqij", slopes, x)
    return np.asarray(np.abs(np.linalg.det(jacobian)) @ weights)
