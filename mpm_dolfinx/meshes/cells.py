# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Cells of a mesh: their numbers, vertices and elements, and meshes whose cells are apart."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix.ufl
import dolfinx
import ufl
from dolfinx import graph, io, mesh

from .. import _compat

__all__ = [
    "cell_vertices",
    "coordinate_element",
    "disconnected_mesh",
    "equispaced_element",
    "input_cell_index",
    "tags_from_nodes",
]


def coordinate_element(domain: mesh.Mesh) -> Any:
    """Return the coordinate element of a mesh, which the mesh of UFL knows (untyped there)."""
    ufl_domain: Any = domain.ufl_domain()
    return ufl_domain.ufl_coordinate_element()


def input_cell_index(domain: mesh.Mesh) -> NDArray[np.int64]:
    """Return the input index of each owned cell; in a submesh, which has none, the global one."""
    cells = domain.topology.index_map(domain.topology.dim)
    try:
        index = domain.topology.original_cell_index[: cells.size_local]
    except RuntimeError:
        index = np.arange(*cells.local_range)
    return np.asarray(index, dtype=np.int64)


def cell_vertices(domain: mesh.Mesh, count: int) -> NDArray[np.int64]:
    """Return the global vertices of the first cells, in the order of the reference cell."""
    topology = domain.topology
    corners = len(basix.geometry(domain.basix_cell()))
    local = topology.connectivity(topology.dim, 0).array[: count * corners]
    whole = topology.index_map(0).local_to_global(np.asarray(local, dtype=np.int32))
    return np.asarray(whole, dtype=np.int64).reshape(count, corners)


def tags_from_nodes(
    domain: mesh.Mesh, dim: int, nodes: NDArray[np.int64], values: NDArray[np.int32]
) -> mesh.MeshTags:
    """Return tags of entities that are given by input numbers of their nodes.

    Args:
        domain: The mesh (collective).
        dim: Dimension of the entities.
        nodes: Input numbers, shape ``(n, k)``, each entity on one rank, any one.
        values: Their tags, shape ``(n,)``.
    """
    entities, local = io.distribute_entity_data(domain, dim, nodes, values)
    return mesh.meshtags_from_entities(
        domain, dim, graph.adjacencylist(np.asarray(entities, dtype=np.int32)), local
    )


def equispaced_element(cell: basix.CellType, degree: int, gdim: int) -> Any:
    """Return the vector Lagrange element whose nodes are equispaced, as VTK has them."""
    variant = basix.LagrangeVariant.equispaced
    return basix.ufl.element("Lagrange", cell.name, degree, lagrange_variant=variant, shape=(gdim,))


def disconnected_mesh(
    comm: MPI.Comm,
    nodes: NDArray[np.float64],
    cell: basix.CellType,
    index: NDArray[np.int64] | None = None,
    degree: int = 1,
) -> mesh.Mesh:
    """Return a mesh whose cells share no vertex and stay on the rank that gives them.

    ``dolfinx.mesh.create_mesh`` reorders such cells in quadratic time (0.11), so the topology
    is built directly.

    Args:
        comm: Communicator (collective).
        nodes: Corners of this rank's cells in DOLFINx order, or all nodes of curved ones,
            equispaced, shape ``(n, k, gdim)``.
        cell: Cell type.
        index: Input index of each cell, where ``_compat.NUMBERS_CELLS``; ``None`` numbers them from
            rank to rank.
        degree: Degree of the cells' map.
    """
    n, k, gdim = nodes.shape
    corners = len(basix.geometry(cell))
    vertices = dolfinx.cpp.common.IndexMap(comm, n * corners)
    places = vertices if degree == 1 else dolfinx.cpp.common.IndexMap(comm, n * k)
    cells = dolfinx.cpp.common.IndexMap(comm, n)
    dofmap = np.arange(n * k, dtype=np.int32).reshape(n, k)
    element = equispaced_element(cell, degree, gdim)
    geometry_nodes = dolfinx.cpp.mesh.Geometry_float64(
        places,
        dofmap,
        _compat.coordinate_map(element),
        np.ascontiguousarray(nodes.reshape(-1, gdim)),
        np.arange(n * k, dtype=np.int64) + places.local_range[0],
    )
    connectivity = np.arange(n * corners, dtype=np.int32).reshape(n, corners)
    topology = _compat.apart_topology(comm, cell, connectivity, vertices, cells, index)
    whole = dolfinx.cpp.mesh.Mesh_float64(comm, topology, geometry_nodes)
    return mesh.Mesh(whole, ufl.Mesh(element))
