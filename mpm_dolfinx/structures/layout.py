# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes and cells of a structure, which all ranks know."""

from __future__ import annotations

from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix
from dolfinx import mesh

from .. import _compat
from ..errors import MPMError, agree
from ..meshes.regions import in_space, marked
from ..reals import as_reals

__all__ = ["Layout", "chosen", "layout_of"]

#: Kinds of cells of lines and of surfaces.
KINDS = (
    (basix.CellType.interval,),
    (basix.CellType.triangle, basix.CellType.quadrilateral),
)


class Layout(NamedTuple):
    """A structure in the same order on any number of ranks.

    Attributes:
        nodes: Undeformed places, those that are drawn first, shape ``(N, gdim)``.
        cells: Nodes of each cell, corners first, shape ``(m, k)``.
        kind: Kind of the cells.
        degree: Degree of their shape functions.
    """

    nodes: NDArray[np.float64]
    cells: NDArray[np.int64]
    kind: basix.CellType
    degree: int = 1

    @property
    def dim(self) -> int:
        """Dimension of the cells, 1 or 2."""
        return 1 if self.kind == basix.CellType.interval else 2

    @property
    def element(self) -> Any:
        """The shape functions of a cell."""
        variant = basix.LagrangeVariant.equispaced
        return basix.create_element(basix.ElementFamily.P, self.kind, self.degree, variant)

    def raised(self, degree: int) -> Layout:
        """Return the same with nodes within its cells too, for shape functions of a degree.

        Each cell has its own, also where neighbours could share them: all follow the bodies.
        """
        other = self._replace(degree=degree)
        within = np.asarray(other.element.points)[self.cells.shape[1] :]
        shapes = np.asarray(self.element.tabulate(0, within))[0, :, :, 0]
        more = np.einsum("qk,mkg->mqg", shapes, self.nodes[self.cells])
        count, (m, k) = len(self.nodes), more.shape[:2]
        numbers = count + np.arange(m * k).reshape(m, k)
        nodes = np.concatenate([self.nodes, more.reshape(m * k, self.nodes.shape[1])])
        return other._replace(nodes=nodes, cells=np.concatenate([self.cells, numbers], axis=1))

    def is_same(self, other: Layout) -> bool:
        """Return whether another structure is drawn in the same way."""
        return np.array_equal(self.nodes, other.nodes) and np.array_equal(self.cells, other.cells)


def chosen(where: Any, layout: Layout, what: str) -> NDArray[np.bool_]:
    """Return at which nodes a function of the user holds, shape ``(N,)``.

    Args:
        where: The function.
        layout: The structure.
        what: What it is called.

    Raises:
        MPMError: It is none, or returns something else.
    """
    if not callable(where):
        raise MPMError(f"{what} is a function of coordinates such as mpm.region(...).")
    return marked(where, in_space(layout.nodes), f"The function {what}")


def layout_of(given: Any, comm: MPI.Comm, gdim: int, what: str, surfaces: bool) -> Layout:
    """Return nodes and cells of what a user gives (collective).

    Args:
        given: A mesh of lower dimension, or the points of a polyline, shape ``(N, gdim)``.
        comm: The ranks.
        gdim: Dimension of space.
        what: What the structure is called.
        surfaces: Whether it may be a surface.

    Raises:
        MPMError: Something else, in another space, or cells that are curved or of no size.
    """
    if isinstance(given, mesh.Mesh):
        found = _of_mesh(given, comm, gdim, what, surfaces)
    else:
        with agree(comm):
            found = _of_points(given, gdim, what)
    with agree(comm):
        if not np.isfinite(found.nodes).all():
            raise MPMError(f"The nodes of a {what} must be finite.")
        if len(found.cells) == 0:
            raise MPMError(f"A {what} needs one cell at least; there is none.")
        _require_sizes(found, what)
    return found


def _of_points(given: Any, gdim: int, what: str) -> Layout:
    """Return the layout of a polyline."""
    try:
        points = as_reals(given)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != gdim or len(points) < 2:
        raise MPMError(
            f"A {what} is drawn by a mesh of lower dimension, or by the points of a polyline, "
            f"shape (n, {gdim}), not by {given!r}."
        )
    first = np.arange(len(points) - 1)
    return Layout(points, np.column_stack([first, first + 1]), basix.CellType.interval)


def _of_mesh(given: mesh.Mesh, comm: MPI.Comm, gdim: int, what: str, surfaces: bool) -> Layout:
    """Return the layout of a mesh (collective)."""
    kind, dim = given.basix_cell(), given.topology.dim
    with agree(comm):
        if given.comm.size != comm.size:
            raise MPMError(f"The mesh of a {what} must be on the same ranks as its bodies.")
        if given.geometry.dim != gdim:
            raise MPMError(
                f"The mesh of a {what} lies in {given.geometry.dim} dimensions, and its bodies in "
                f"{gdim}."
            )
        if dim >= gdim or kind not in KINDS[0] + (KINDS[1] if surfaces else ()):
            kinds = "lines" + (", in space also of surfaces" if surfaces else "")
            raise MPMError(f"The mesh of a {what} is one of {kinds}, not of {kind.name} cells.")
        if _compat.geometry_degree(given) > 1:
            raise MPMError(f"The mesh of a {what} needs straight cells, of geometry of degree 1.")
    owned = given.topology.index_map(dim).size_local
    dofs = _compat.geometry_dofmap(given)[:owned].astype(np.int64)
    names = np.asarray(given.geometry.input_global_indices, dtype=np.int64)
    x = given.geometry.x[:, :gdim]
    parts = comm.allgather((names[dofs], np.unique(names[dofs]), x[np.unique(dofs)], dofs, names))
    cells = np.concatenate([part[0] for part in parts])
    known: dict[int, Any] = {}
    for _, _, places, own, numbers in parts:
        known |= dict(zip(numbers[np.unique(own)].tolist(), places, strict=True))
    order = np.array(sorted(known), dtype=np.int64)
    nodes = np.array([known[name] for name in order.tolist()]).reshape(-1, gdim)
    cells = np.searchsorted(order, cells)
    return Layout(nodes, cells[np.lexsort(np.sort(cells, axis=1).T[::-1])], kind)


def _require_sizes(layout: Layout, what: str) -> None:
    """Raise an error where a cell has no size."""
    corners = layout.nodes[layout.cells]
    edges = corners[:, 1 : layout.dim + 1] - corners[:, :1]
    span = np.ptp(corners, axis=1).max(axis=1)
    size = np.sqrt(np.abs(np.linalg.det(edges @ edges.swapaxes(1, 2))))
    flat = np.flatnonzero(~(size > 1e-10 * span**layout.dim))
    if len(flat):
        where = tuple(float(f"{x:.6g}") for x in corners[flat[0]].mean(axis=0))
        raise MPMError(f"A cell of a {what} has no size, near {where}.")
