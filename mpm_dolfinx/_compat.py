# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The only place that knows DOLFINx versions and installations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import singledispatchmethod
from inspect import signature
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
import ufl
from dolfinx import fem, geometry, graph, io, mesh
from dolfinx.fem import petsc as fem_petsc
from ufl.algorithms import expand_derivatives
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.strip_terminal_data import strip_terminal_data

__all__ = [
    "NUMBERS_CELLS",
    "CompiledIntegral",
    "NonlinearProblem",
    "are_tags_of",
    "candidate_cells",
    "cell_tree",
    "cell_vertices",
    "compiled_integrals",
    "coordinate_element",
    "create_vector",
    "disconnected_mesh",
    "entity_nodes",
    "equispaced_element",
    "expanded",
    "geometry_degree",
    "geometry_dofmap",
    "gmsh_order",
    "input_cell_index",
    "interpolation_points",
    "is_condition_on",
    "mesh_on_ranks",
    "own_dofs",
    "packed",
    "require_supported",
    "set_entries",
    "set_entry_places",
    "tabulated",
    "tags_from_nodes",
    "vtk_cell",
]

_VERSION = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])
#: Whether a mesh that is put together can be told the input index of its cells.
NUMBERS_CELLS = _VERSION >= (0, 10)


def require_supported() -> None:
    """Raise ImportError where this DOLFINx cannot run the package."""
    if _VERSION < (0, 9):
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
    middle = (x, element) if _VERSION < (0, 10) else (element, x)
    whole: mesh.Mesh = create(comm, cells, *middle, partitioner)
    return whole


def equispaced_element(cell: basix.CellType, degree: int, gdim: int) -> Any:
    """Return the vector Lagrange element whose nodes are equispaced, as VTK has them."""
    variant = basix.LagrangeVariant.equispaced
    return basix.ufl.element("Lagrange", cell.name, degree, lagrange_variant=variant, shape=(gdim,))


#: VTK's types of cells of degree 1, the order of their corners, and the types of Lagrange cells.
_VTK = {
    "interval": (3, [0, 1], 68),
    "triangle": (5, [0, 1, 2], 69),
    "quadrilateral": (9, [0, 1, 3, 2], 70),
    "tetrahedron": (10, [0, 1, 2, 3], 71),
    "hexahedron": (12, [0, 1, 3, 2, 4, 5, 7, 6], 72),
}


def vtk_cell(cell: basix.CellType, degree: int, count: int) -> tuple[int, NDArray[np.int64]]:
    """Return VTK's type of a cell, and which of its nodes, equispaced, is each of VTK's.

    Args:
        cell: The cell.
        degree: Its degree.
        count: Number of its nodes.
    """
    straight, corners, curved = _VTK[cell.name]
    return (straight, np.array(corners)) if degree == 1 else (curved, _vtk_order(cell, count))


def _vtk_order(cell: basix.CellType, count: int) -> NDArray[np.int64]:
    """Return which of a curved cell's nodes, equispaced, is each of VTK's."""
    return np.argsort(dolfinx.cpp.io.perm_vtk(mesh.to_type(cell.name), count))


def gmsh_order(cell: basix.CellType, count: int) -> NDArray[np.int64]:
    """Return which of a cell's nodes, in Gmsh's order, is each of DOLFINx's."""
    order = dolfinx.cpp.io.perm_gmsh(mesh.to_type(cell.name), count)
    return np.asarray(order, dtype=np.int64)


def cell_vertices(domain: mesh.Mesh, count: int) -> NDArray[np.int64]:
    """Return the global vertices of the first cells, in the order of the reference cell."""
    topology = domain.topology
    corners = len(basix.geometry(domain.basix_cell()))
    local = topology.connectivity(topology.dim, 0).array[: count * corners]
    whole = topology.index_map(0).local_to_global(np.asarray(local, dtype=np.int32))
    return np.asarray(whole, dtype=np.int64).reshape(count, corners)


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
        index: Input index of each cell, where ``NUMBERS_CELLS``; ``None`` numbers them from rank
            to rank.
        degree: Degree of the cells' map.
    """
    n, k, gdim = nodes.shape
    corners = len(basix.geometry(cell))
    vertices = dolfinx.cpp.common.IndexMap(comm, n * corners)
    places = vertices if degree == 1 else dolfinx.cpp.common.IndexMap(comm, n * k)
    cells = dolfinx.cpp.common.IndexMap(comm, n)
    dofmap = np.arange(n * k, dtype=np.int32).reshape(n, k)
    element = equispaced_element(cell, degree, gdim)
    coordinate_element: Any = fem.coordinate_element  # dispatched on the element
    # (mesh.create_geometry wants another kind of element in 0.9)
    geometry_nodes = dolfinx.cpp.mesh.Geometry_float64(
        places,
        dofmap,
        coordinate_element(element.basix_element)._cpp_object,
        np.ascontiguousarray(nodes.reshape(-1, gdim)),
        np.arange(n * k, dtype=np.int64) + places.local_range[0],
    )
    connectivity = np.arange(n * corners, dtype=np.int32).reshape(n, corners)
    topology = _topology(comm, cell, connectivity, vertices, cells, index)
    whole = dolfinx.cpp.mesh.Mesh_float64(comm, topology, geometry_nodes)
    return mesh.Mesh(whole, ufl.Mesh(element))


def _topology(
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


def create_vector(V: fem.FunctionSpace) -> PETSc.Vec:
    """Return a vector with ghosts for a space, on the communicator of its mesh (collective).

    DOLFINx makes it on the index map's own communicator, which is out of reach once the space is
    gone; then PETSc could not free the vector any more, nor the communicator.
    """
    places, block = V.dofmap.index_map, V.dofmap.index_map_bs
    sizes = (block * places.size_local, block * places.size_global)
    ghosts = places.ghosts.astype(PETSc.IntType)
    return PETSc.Vec().createGhost(ghosts, sizes, bsize=block, comm=V.mesh.comm)


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


class _NonlinearProblem:
    """``dolfinx.fem.petsc.NonlinearProblem`` as it is since 0.10, by Newton's method of 0.9.

    Takes ``snes_rtol`` alone of the PETSc options, as a bound of the increment.
    """

    def __init__(
        self,
        F: ufl.Form,
        u: fem.Function,
        bcs: Sequence[fem.DirichletBC] = (),
        J: ufl.Form | None = None,
        petsc_options_prefix: str = "",
        petsc_options: dict[str, Any] | None = None,
    ) -> None:
        from dolfinx.nls.petsc import NewtonSolver

        old: Any = fem_petsc.NonlinearProblem
        self._u = u
        self._newton = NewtonSolver(u.function_space.mesh.comm, old(F, u, list(bcs), J))
        self._newton.convergence_criterion = "incremental"
        self._newton.rtol = self._newton.atol = (petsc_options or {}).get("snes_rtol", 1e-9)
        self._newton.error_on_nonconvergence = False
        self._reason = 0

    @property
    def solver(self) -> _NonlinearProblem:
        """The object that tells whether the last solve converged."""
        return self

    def getConvergedReason(self) -> int:
        """Return a positive number where the last solve converged."""
        return self._reason

    def solve(self) -> fem.Function:
        """Solve from the present values on."""
        converged = self._newton.solve(self._u)[1]
        self._reason = 1 if converged else -1
        return self._u


#: DOLFINx's nonlinear problem, for comparisons with finite elements.
NonlinearProblem: Any = (
    fem_petsc.NonlinearProblem
    if "petsc_options_prefix" in signature(fem_petsc.NonlinearProblem).parameters
    else _NonlinearProblem
)


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


def expanded(integral: Any) -> Any:
    """Return an integrand with its derivatives carried out.

    UFL's traversals dispatch by ``functools.singledispatchmethod``, which with Python 3.13 keeps
    for ever what it was used for: all of the form, down to meshes and their communicators. So the
    integrand is that of an integral without data, and what was kept is dropped.
    """
    stripped, _ = strip_terminal_data(integral)
    result = expand_derivatives(apply_algebra_lowering(stripped.integrand()))
    for traversal in _traversals():
        for method in vars(traversal).values():
            kept = getattr(method, "_method_cache", None)
            if isinstance(method, singledispatchmethod) and kept is not None:
                kept.clear()
    return result


def _traversals() -> Iterator[type]:
    """Yield the classes of UFL's traversals (since 2025.1)."""
    try:
        from ufl.corealg.dag_traverser import DAGTraverser
    except ImportError:
        return
    classes: list[type] = [DAGTraverser]
    while classes:
        yield classes[-1]
        classes.extend(classes.pop().__subclasses__())


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
