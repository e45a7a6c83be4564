# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The only place that knows DOLFINx versions and installations."""

from __future__ import annotations

from typing import Any, NamedTuple

from mpi4py import MPI  # (before DOLFINx: the wheel finds its MPI library by it)

import numpy as np
from numpy.typing import NDArray

try:
    import dolfinx
except ImportError as error:  # pragma: no cover
    raise ImportError(
        "mpm_dolfinx needs DOLFINx 0.9 or newer with PETSc; install it with "
        "'pip install mpm-dolfinx[wheel]', or from conda-forge, apt or source."
    ) from error

from petsc4py import PETSc

import basix
import basix.ufl
from dolfinx import fem, mesh

__all__ = [
    "NUMBERS_CELLS",
    "CompiledIntegral",
    "apart_topology",
    "are_tags_of",
    "compiled_integrals",
    "coordinate_map",
    "entity_nodes",
    "geometry_degree",
    "geometry_dofmap",
    "interpolation_points",
    "is_condition_on",
    "mesh_on_ranks",
    "own_dofs",
    "packed",
    "require_supported",
    "set_entries",
    "set_entry_places",
    "tabulated",
]

#: Whether this is DOLFINx 0.9, the oldest that runs the package.
_OLDEST = dolfinx.__version__.startswith("0.9.")
#: Whether a mesh that is put together can be told the input index of its cells.
NUMBERS_CELLS = not _OLDEST


def require_supported() -> None:
    """Raise ImportError where this DOLFINx cannot run the package."""
    if tuple(map(int, dolfinx.__version__.split(".")[:2])) < (0, 9):
        raise ImportError(f"mpm_dolfinx needs DOLFINx 0.9 or newer, this is {dolfinx.__version__}.")
    if np.issubdtype(PETSc.ScalarType, np.complexfloating):
        raise ImportError("mpm_dolfinx needs a DOLFINx and PETSc with real scalars.")


def geometry_dofmap(domain: mesh.Mesh) -> NDArray[np.int32]:
    """Return the geometry nodes of each local cell (``.dofmap`` before 0.11)."""
    geometry = domain.geometry
    return np.asarray(geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap)


def geometry_degree(domain: mesh.Mesh) -> int:
    """Return the degree of the coordinate element (``.cmap`` before 0.11)."""
    geometry = domain.geometry
    return int((geometry.cmaps[0] if hasattr(geometry, "cmaps") else geometry.cmap).degree)


def coordinate_map(element: Any) -> Any:
    """Return the map of an element in C++ (mesh.create_geometry wants another kind in 0.9)."""
    coordinate_element: Any = fem.coordinate_element  # dispatched on the element
    return coordinate_element(element.basix_element)._cpp_object


def is_condition_on(bc: fem.DirichletBC, V: fem.FunctionSpace) -> bool:
    """Return whether a Dirichlet condition is on a space or on a component of it."""
    own = V._cpp_object
    return bool(bc.function_space == own or own.contains(bc.function_space))


def holds(bc: fem.DirichletBC, value: fem.Constant | fem.Function) -> bool:
    """Return whether a Dirichlet condition has its values from a Constant or a Function."""
    return bool(bc.g is value._cpp_object)


def are_tags_of(tags: mesh.MeshTags, domain: mesh.Mesh) -> bool:
    """Return whether tags are of a mesh (whose topology is wrapped since 0.10)."""
    return bool(tags.topology == getattr(domain.topology, "_cpp_object", domain.topology))


def entity_nodes(domain: mesh.Mesh, dim: int, entities: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the geometry nodes of entities' vertices ``(n, k)`` (0.9 crashes where n is zero)."""
    if len(entities) == 0:
        corners = len(basix.topology(domain.basix_cell())[dim][0])
        return np.zeros((0, corners), dtype=np.int32)
    return mesh.entities_to_geometry(domain, dim, entities)


def mesh_on_ranks(
    comm: MPI.Comm,
    cells: NDArray[np.int64],
    element: Any,
    x: NDArray[np.float64],
    ranks: list[list[int]],
) -> mesh.Mesh:
    """Return a mesh with each cell where one says (cells and points swapped before 0.10).

    Args:
        comm: Communicator (collective).
        cells: Nodes of this rank's part of the input, shape ``(n, k)``.
        element: The coordinate element.
        x: This rank's part of the points, shape ``(m, gdim)``.
        ranks: For each of the cells its rank, then those where it is a ghost.
    """
    counts = [len(targets) for targets in ranks]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    flat = np.array([rank for targets in ranks for rank in targets], dtype=np.int32)

    def partitioner(*_: Any) -> Any:
        return dolfinx.cpp.graph.AdjacencyList_int32(flat, offsets)

    create: Any = mesh.create_mesh
    middle = (x, element) if _OLDEST else (element, x)
    whole: mesh.Mesh = create(comm, cells, *middle, partitioner)
    return whole


def apart_topology(
    comm: MPI.Comm,
    cell: basix.CellType,
    corners: NDArray[np.int32],
    vertices: Any,
    cells: Any,
    index: NDArray[np.int64] | None,
) -> Any:
    """Return the topology of cells that share no vertex (put together by setters before 0.10)."""
    cell_type = mesh.to_type(cell.name)
    connectivity = dolfinx.cpp.graph.AdjacencyList_int32(corners)
    if NUMBERS_CELLS:
        if index is None:
            index = np.arange(*cells.local_range, dtype=np.int64)
        return dolfinx.cpp.mesh.Topology(
            cell_type=cell_type,
            vertex_map=vertices,
            cell_map=cells,
            cells=connectivity,
            original_index=index,
        )
    assert index is None
    topology = dolfinx.cpp.mesh.Topology(comm, cell_type)
    single = dolfinx.cpp.graph.AdjacencyList_int32(np.arange(corners.size, dtype=np.int32)[:, None])
    topology.set_index_map(0, vertices)
    topology.set_connectivity(single, 0, 0)
    topology.set_index_map(topology.dim, cells)
    topology.set_connectivity(connectivity, topology.dim, 0)
    return topology


def interpolation_points(V: fem.FunctionSpace) -> NDArray[np.float64]:
    """Return the reference points at which a space takes its values (a method before 0.10)."""
    points = V.element.interpolation_points
    return np.asarray(points() if callable(points) else points)


def set_entry_places(matrix: PETSc.Mat, rows: NDArray[Any], columns: NDArray[Any]) -> None:
    """Say where the entries of :func:`set_entries` go (petsc4py 3.22 has no COO assembly).

    Args:
        matrix: A matrix with type and sizes.
        rows: Global row of each entry, any rank's; PETSc may sort the array in place.
        columns: Global column of each entry, likewise.
    """
    if hasattr(matrix, "setPreallocationCOO"):
        matrix.setPreallocationCOO(rows, columns)
        return
    matrix.setUp()
    matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
    matrix.setAttr("entry_places", (rows[:, None].copy(), columns[:, None].copy()))


def set_entries(matrix: PETSc.Mat, values: NDArray[np.float64]) -> None:
    """Set a matrix to entries at the places of :func:`set_entry_places`; equal places add up."""
    if hasattr(matrix, "setValuesCOO"):
        matrix.setValuesCOO(values, PETSc.InsertMode.INSERT_VALUES)
        return
    rows, columns = matrix.getAttr("entry_places")
    matrix.zeroEntries()
    matrix.setValuesRCV(rows, columns, values[:, None], addv=PETSc.InsertMode.ADD_VALUES)
    matrix.assemble()


class CompiledIntegral(NamedTuple):
    """One integral of a compiled form.

    Attributes:
        key: Its key in ``fem.pack_coefficients``.
        kernel: Address of its kernel for double precision.
        entities: Owned cells ``(m,)``, or cells and local facets ``(m, 2)``.
    """

    key: Any
    kernel: int
    entities: NDArray[np.int32]


def compiled_integrals(form: fem.Form) -> list[CompiledIntegral]:
    """Return the integrals of a form over cells and exterior facets."""
    ufcx, whole = form.ufcx_form, form._cpp_object
    module: Any = form.module
    cast = module.ffi.cast
    result = []
    for place, kind in enumerate((fem.IntegralType.cell, fem.IntegralType.exterior_facet)):
        start, end = ufcx.form_integral_offsets[place], ufcx.form_integral_offsets[place + 1]
        for i in range(end - start):
            kernel = ufcx.form_integrals[start + i].tabulate_tensor_float64
            # the subdomain's tag names an integral until 0.9
            name = i if hasattr(fem, "pack_constants") else ufcx.form_integral_ids[start + i]
            entities = np.ascontiguousarray(whole.domains(kind, name))
            result.append(CompiledIntegral((kind, name), int(cast("intptr_t", kernel)), entities))
    return result


def packed(form: fem.Form) -> tuple[Any, Any]:
    """Return a form's constants, and its coefficients by integral (in C++ alone until 0.9)."""
    if hasattr(fem, "pack_constants"):
        return fem.pack_constants(form), fem.pack_coefficients(form)
    own = form._cpp_object
    return dolfinx.cpp.fem.pack_constants(own), dolfinx.cpp.fem.pack_coefficients(own)


def own_dofs(bc: fem.DirichletBC, V: fem.FunctionSpace) -> NDArray[np.int32]:
    """Return the dofs of V, local numbers, that a condition on V or a part of it has on this rank.

    Each stands there once, sorted, however often the condition names it. DOLFINx says where
    ghosts begin too, but 0.9 takes dofs for blocks there.
    """
    dofs = np.unique(np.asarray(bc.dof_indices()[0]))
    return np.asarray(dofs[dofs < V.dofmap.index_map.size_local * V.dofmap.index_map_bs])


def tabulated(element: Any, derivatives: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values of scalar basis functions at points, of which there may be none.

    Basix 0.9 of Debian ends the program where there are none.

    Args:
        element: A Basix element.
        derivatives: Highest order of derivatives.
        points: Shape ``(n, tdim)``.

    Returns:
        Shape ``(m, n, k)`` for m derivatives.
    """
    some = points if len(points) else np.zeros((1, points.shape[1]))
    return np.asarray(element.tabulate(derivatives, some)[:, : len(points), :, 0])
