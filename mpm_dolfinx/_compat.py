# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The only place that knows DOLFINx versions and installations."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI  # (before DOLFINx: the wheel finds its MPI library by it)

import numpy as np
from numpy.typing import NDArray

try:
    import dolfinx
except ImportError as error:  # pragma: no cover
    raise ImportError(
        "mpm_dolfinx needs DOLFINx 0.11 with PETSc; install it with "
        "'pip install mpm-dolfinx[wheel]', or from conda-forge, apt or source."
    ) from error

from petsc4py import PETSc

import basix
import basix.ufl
import ufl
from dolfinx import fem, geometry, mesh

__all__ = [
    "candidate_cells",
    "cell_tree",
    "disconnected_mesh",
    "geometry_degree",
    "geometry_dofmap",
    "input_cell_index",
    "is_condition_on",
    "require_supported",
]

_VERSION = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])


def require_supported() -> None:
    """Raise ImportError where this DOLFINx cannot run the package."""
    if _VERSION < (0, 11):
        raise ImportError(
            f"mpm_dolfinx needs DOLFINx 0.11 or newer, this is {dolfinx.__version__}."
        )
    if np.issubdtype(PETSc.ScalarType, np.complexfloating):
        raise ImportError("mpm_dolfinx needs a DOLFINx and PETSc with real scalars.")


def geometry_dofmap(domain: mesh.Mesh) -> NDArray[np.int32]:
    """Return the geometry nodes of each local cell (``.dofmap`` before 0.11)."""
    return np.asarray(domain.geometry.dofmaps[0])


def geometry_degree(domain: mesh.Mesh) -> int:
    """Return the degree of the coordinate element (``.cmap`` before 0.11)."""
    return int(domain.geometry.cmaps[0].degree)


def input_cell_index(domain: mesh.Mesh) -> NDArray[np.int64]:
    """Return the input index of each owned cell; in a submesh, which has none, the global one."""
    cells = domain.topology.index_map(domain.topology.dim)
    try:
        index = domain.topology.original_cell_index[: cells.size_local]
    except RuntimeError:
        index = np.arange(*cells.local_range)
    return np.asarray(index, dtype=np.int64)


def cell_tree(domain: mesh.Mesh, cells: NDArray[np.int32], padding: float) -> Any:
    """Return a bounding-box tree of some cells (keyword arguments since 0.10)."""
    return geometry.bb_tree(domain, domain.topology.dim, padding=padding, entities=cells)


def candidate_cells(
    tree: Any, points: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return offsets and cells whose boxes hold each point, ``points`` of shape (n, 3)."""
    found = geometry.compute_collisions_points(tree, points)
    return found.offsets, found.array


def is_condition_on(bc: fem.DirichletBC, V: fem.FunctionSpace) -> bool:
    """Return whether a Dirichlet condition is on a space or on a component of it."""
    own = V._cpp_object
    return bool(bc.function_space == own or own.contains(bc.function_space))


def disconnected_mesh(
    comm: MPI.Comm, corners: NDArray[np.float64], cell: basix.CellType
) -> mesh.Mesh:
    """Return a mesh whose cells share no vertex and stay on the rank that gives them.

    ``dolfinx.mesh.create_mesh`` reorders such cells in quadratic time (0.11), so the topology
    is built directly.

    Args:
        comm: Communicator (collective).
        corners: Corners of this rank's cells in DOLFINx order, shape ``(n, k, gdim)``.
        cell: Cell type.
    """
    n, k, gdim = corners.shape
    vertices = dolfinx.cpp.common.IndexMap(comm, n * k)
    cells = dolfinx.cpp.common.IndexMap(comm, n)
    dofmap = np.arange(n * k, dtype=np.int32).reshape(n, k)
    first_cell, first_vertex = cells.local_range[0], vertices.local_range[0]
    topology = dolfinx.cpp.mesh.Topology(
        cell_type=mesh.to_type(cell.name),
        vertex_map=vertices,
        cell_map=cells,
        cells=dolfinx.cpp.graph.AdjacencyList_int32(dofmap),
        original_index=np.arange(n, dtype=np.int64) + first_cell,
    )
    element = basix.ufl.element("Lagrange", cell.name, 1, shape=(gdim,))
    coordinate_element: Any = fem.coordinate_element  # dispatched on the element
    geometry_nodes = mesh.create_geometry(
        vertices,
        dofmap,
        coordinate_element(element.basix_element),
        np.ascontiguousarray(corners.reshape(-1, gdim)),
        np.arange(n * k, dtype=np.int64) + first_vertex,
    )
    whole = dolfinx.cpp.mesh.Mesh_float64(comm, topology, geometry_nodes._cpp_object)
    return mesh.Mesh(whole, ufl.Mesh(element))
