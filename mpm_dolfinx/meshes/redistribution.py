# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A mesh made again on other ranks, and what goes along with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, la, mesh

from .. import _compat
from ..errors import MPMError
from ..parallel.exchange import RowExchange
from .cells import coordinate_element, disconnected_mesh, input_cell_index, tags_from_nodes

__all__ = ["Carrier", "Redistribution", "neighbour_ranks"]


class Carrier:
    """Takes tags and piecewise constants of a mesh to another mesh of the same body.

    Args:
        source: The mesh before.
        mesh: The mesh after, of which each cell is one of those before, or a part of one.
        origin: Input index of the one before, for each owned cell after, shape ``(n,)``.
        numbers: Input number after, for each local node before, shape ``(m,)``.

    Attributes:
        source: The mesh before.
        mesh: The mesh after.
        origin: As given.
        numbers: As given.
    """

    def __init__(
        self,
        source: mesh.Mesh,
        mesh: mesh.Mesh,
        origin: NDArray[np.int64],
        numbers: NDArray[np.int64],
    ) -> None:
        self.source, self.mesh = source, mesh
        self.origin, self.numbers = origin, numbers

    def then(self, move: Carrier) -> Carrier:
        """Return the carrier that does this one's move and then another's (collective).

        Args:
            move: Its source is the mesh of this one.
        """
        if move.mesh is self.mesh:
            return self
        comm = self.mesh.comm
        cells = RowExchange(comm, input_cell_index(self.mesh), move.origin)
        nodes = self.mesh.geometry
        owned = nodes.index_map().size_local
        have = np.asarray(nodes.input_global_indices[:owned], dtype=np.int64)
        return Carrier(
            self.source,
            move.mesh,
            cells(self.origin),
            RowExchange(comm, have, self.numbers)(move.numbers[:owned]),
        )

    def carry(self, thing: Any) -> Any:
        """Return tags or a piecewise constant Function on the mesh after (collective).

        Args:
            thing: ``MeshTags`` or a DG0 Function on the mesh before; anything else, also what
                lives on the mesh after already, is returned as it is.

        Raises:
            MPMError: A Function that is not piecewise constant.
        """
        if self.mesh is self.source:
            return thing
        if isinstance(thing, mesh.MeshTags) and _compat.are_tags_of(thing, self.source):
            return self._cell_tags(thing) if thing.dim == thing.topology.dim else self._tags(thing)
        if isinstance(thing, fem.Function) and thing.function_space.mesh is self.source:
            return self._function(thing)
        return thing

    def of_cells(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values of the owned cells on the mesh after, shape ``(n, ...)`` (collective)."""
        have = input_cell_index(self.source)
        return RowExchange(self.mesh.comm, have, self.origin)(values)

    def _cell_tags(self, tags: mesh.MeshTags) -> mesh.MeshTags:
        count = self.source.topology.index_map(tags.dim).size_local
        own = tags.indices < count
        values = np.zeros((count, 2), dtype=np.int32)
        values[tags.indices[own]] = np.column_stack([tags.values[own], np.ones(own.sum())])
        values = _with_ghosts(self.mesh.topology.index_map(tags.dim), self.of_cells(values))
        tagged = np.flatnonzero(values[:, 1]).astype(np.int32)
        moved = mesh.meshtags(self.mesh, tags.dim, tagged, values[tagged, 0])
        moved.name = tags.name
        return moved

    def _tags(self, tags: mesh.MeshTags) -> mesh.MeshTags:
        topology, dim = self.source.topology, tags.dim
        topology.create_connectivity(dim, topology.dim)
        topology.create_connectivity(dim, 0)
        own = tags.indices < topology.index_map(dim).size_local
        nodes = _compat.entity_nodes(self.source, dim, tags.indices[own])
        self.mesh.topology.create_connectivity(dim, 0)
        self.mesh.topology.create_connectivity(dim, self.mesh.topology.dim)
        moved = tags_from_nodes(
            self.mesh, dim, self.numbers[nodes], tags.values[own].astype(np.int32)
        )
        moved.name = tags.name
        return moved

    def _function(self, function: fem.Function) -> fem.Function:
        space = function.function_space
        element = space.ufl_element()
        if element.degree != 0:
            raise MPMError(
                f"The Function {function.name} moves to other ranks only if it is piecewise "
                "constant (DG0)."
            )
        bs = space.dofmap.bs
        count = self.source.topology.index_map(self.source.topology.dim).size_local
        values = function.x.array.reshape(-1, bs)[space.dofmap.list[:count, 0]]
        moved = fem.Function(fem.functionspace(self.mesh, element), name=function.name)
        values = self.of_cells(values)
        cells = moved.function_space.dofmap.list[: len(values), 0]
        moved.x.array.reshape(-1, bs)[cells] = values
        moved.x.scatter_forward()
        return moved


class Redistribution(Carrier):
    """A mesh whose cells have moved to other ranks, and what moves with it.

    Cells keep their input index. On one rank the mesh is the same one.

    Args:
        source: The mesh before.
        ranks: New rank of each cell that this rank owns, shape ``(n,)`` (collective).
    """

    def __init__(self, source: mesh.Mesh, ranks: NDArray[np.int64]) -> None:
        moved, numbers = (source, None) if source.comm.size == 1 else _moved(source, ranks)
        if numbers is None:
            numbers = np.asarray(source.geometry.input_global_indices, dtype=np.int64)
        super().__init__(source, moved, input_cell_index(moved), numbers)


def _moved(source: mesh.Mesh, ranks: NDArray[np.int64]) -> tuple[mesh.Mesh, NDArray[np.int64]]:
    """Return a mesh with cells on other ranks, and its input numbers of the local nodes."""
    comm, gdim = source.comm, source.geometry.dim
    index = input_cell_index(source)
    nodes = _compat.geometry_dofmap(source)[: len(index)]
    numbering = source.geometry.index_map()
    cells = source.topology.index_map(source.topology.dim)
    apart = numbering.size_global == cells.size_global * nodes.shape[1]
    if apart and _compat.NUMBERS_CELLS:
        moved = _moved_apart(source, ranks, index, source.geometry.x[nodes][:, :, :gdim])
        exchange = RowExchange(comm, input_cell_index(moved), index)
        places = _compat.geometry_dofmap(moved)
        told = exchange(moved.geometry.input_global_indices[places].astype(np.int64))
        numbers = np.zeros(len(source.geometry.x), dtype=np.int64)
        numbers[nodes] = told
        return moved, numbers
    first, last = (cells.size_global * r // comm.size for r in (comm.rank, comm.rank + 1))
    exchange = RowExchange(comm, index, np.arange(first, last))
    local = np.arange(len(source.geometry.x), dtype=np.int32)
    numbers = numbering.local_to_global(local)
    corners = exchange(numbers[nodes])
    where = exchange(np.column_stack([ranks, neighbour_ranks(source, ranks)]))
    targets = [[row[0], *sorted({*row[1:]} - {row[0], -1})] for row in where.tolist()]
    x = source.geometry.x[: numbering.size_local, :gdim].copy()
    element = coordinate_element(source)
    return _compat.mesh_on_ranks(comm, corners, element, x, targets), numbers


def _moved_apart(
    source: mesh.Mesh,
    ranks: NDArray[np.int64],
    index: NDArray[np.int64],
    corners: NDArray[np.float64],
) -> mesh.Mesh:
    """Move cells that share no vertex."""
    comm = source.comm
    parts = comm.alltoall([(index[ranks == r], corners[ranks == r]) for r in range(comm.size)])
    numbers, places = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(numbers)
    return disconnected_mesh(comm, places[order], source.basix_cell(), numbers[order])


def _with_ghosts(cells: Any, values: NDArray[Any]) -> NDArray[Any]:
    """Return whole numbers of the owned cells on ghosts too, shape ``(n, k)`` (collective)."""
    everywhere = la.vector(cells, values.shape[1])
    result = everywhere.array.reshape(-1, values.shape[1])
    result[: len(values)] = values
    everywhere.scatter_forward()
    return result.astype(values.dtype)


def neighbour_ranks(source: mesh.Mesh, ranks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the new rank behind each facet of each owned cell; none in a mesh without ghosts."""
    topology, dim = source.topology, source.topology.dim
    cells = topology.index_map(dim)
    if source.comm.allreduce(cells.num_ghosts) == 0:
        return np.zeros((len(ranks), 0), dtype=np.int64)
    topology.create_connectivity(dim, dim - 1)
    topology.create_connectivity(dim - 1, dim)
    everywhere = _with_ghosts(cells, ranks[:, None])[:, 0]
    behind = topology.connectivity(dim - 1, dim)
    first, last = behind.array[behind.offsets[:-1]], behind.array[behind.offsets[1:] - 1]
    facets = topology.connectivity(dim, dim - 1).array.reshape(
        cells.size_local + cells.num_ghosts, -1
    )
    facets = facets[: len(ranks)]
    other = first[facets] + last[facets] - np.arange(len(ranks))[:, None]
    return np.asarray(everywhere[other])
