# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Body meshes made anew under the same particles: quadrilaterals cut in two, nodes moved.

DOLFINx has no meshes of quadrilaterals and triangles together, so a triangle is a quadrilateral
with two corners in one place, one of which is a new vertex. At the middle of such a quadrilateral
are the gradients of the triangle, and its area is that of the one-point rule. Nodes in one place
move alike, since the background has one value there. So the halves of a quadrilateral need not
share their diagonal, and do not: two cells with two facets in common, the diagonal and the edge of
no length, are more than DOLFINx (0.11) bears.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

import basix.ufl
from dolfinx import fem, mesh

from .. import _compat
from ..parallel.exchange import RowExchange
from ..tolerances import SMALL
from .cells import coordinate_element, input_cell_index
from .redistribution import Carrier, neighbour_ranks

__all__ = ["HALVES", "PLACES", "Column", "Cuts", "Place", "Remesh", "diagonals"]

type Cuts = NDArray[np.int64]
"""Global index and diagonal of quadrilaterals to be cut, shape ``(m, 2)``, on all ranks.

Diagonal 0 is that of the corners 0 and 3, diagonal 1 that of 1 and 2.
"""

type Place = Literal["cells", "points", "nodes", "forces", "facets"]
"""Where kept values live; the first axis is always that of the owned cells.

``"cells"``: ``(n, ...)``; ``"points"``: at the quadrature points, ``(n, nq, ...)``; ``"nodes"``: at
each cell's nodes, ``(n, k, ...)``; ``"forces"``: there too, but of a node that a cut doubles the
copy has none; ``"facets"``: at points of each cell's facets, ``(n, facets, points, ...)``, in the
order of the facet's corners and symmetric about its middle.
"""

PLACES: tuple[str, ...] = get_args(Place.__value__)


class Column(NamedTuple):
    """Values cell by cell, and where they live: what becomes of them on another mesh.

    Attributes:
        values: One row for each cell that this rank owns, shape ``(n, ...)``.
        at: Where they live.
    """

    values: NDArray[Any]
    at: Place


#: Corners of the two halves of a quadrilateral, by diagonal. One of each half is there twice: first
#: as a new vertex in the place of the last one. All that are at a corner share its mass.
HALVES = np.array([[[0, 1, 3, 3], [0, 3, 2, 3]], [[1, 3, 2, 2], [1, 2, 0, 2]]])


def diagonals(
    corner_jacobians: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the better diagonal of quadrilaterals, and the smaller one of its triangles' areas.

    The triangles that a diagonal makes have the areas of the other two corners. Of a concave
    quadrilateral, the diagonal through the reflex corner alone makes two of positive area.

    Args:
        corner_jacobians: Determinants at the four corners, shape ``(n, 4)``.

    Returns:
        Diagonals, and the areas over half the Jacobian's, each shape ``(n,)``.
    """
    areas = np.stack(
        [corner_jacobians[:, [1, 2]].min(axis=1), corner_jacobians[:, [0, 3]].min(axis=1)], axis=1
    )
    second = areas[:, 1] > areas[:, 0] + SMALL * np.abs(corner_jacobians).max(axis=1)
    return second.astype(np.int64), np.where(second, areas[:, 1], areas[:, 0])


class _Nodes(NamedTuple):
    """Nodes of the cells of a mesh.

    Attributes:
        of_cells: Local nodes of each local cell, shape ``(n, k)``.
        x: Positions of the local nodes, shape ``(m, gdim)``.
        numbering: Index map of the nodes.
        element: Coordinate element that they are for.
        of_geometry_nodes: The node in the place of each local node of the mesh; where there is
            none, any one.
    """

    of_cells: NDArray[np.int32]
    x: NDArray[np.float64]
    numbering: Any
    element: Any
    of_geometry_nodes: NDArray[np.int64]

    @classmethod
    def of_geometry(cls, source: mesh.Mesh) -> _Nodes:
        """Return the nodes of a mesh."""
        geometry = source.geometry
        x = geometry.x[:, : geometry.dim].copy()
        same = np.arange(len(x), dtype=np.int64)
        element = coordinate_element(source)
        return cls(_compat.geometry_dofmap(source), x, geometry.index_map(), element, same)

    @classmethod
    def of_space(cls, space: fem.FunctionSpace) -> _Nodes:
        """Return the nodes of a Lagrange space, in which a mesh of its degree is interpolated."""
        source, dofmap = space.mesh, space.dofmap
        gdim, degree = source.geometry.dim, space.ufl_element().degree
        x = space.tabulate_dof_coordinates()[:, :gdim].copy()
        element = basix.ufl.element("Lagrange", source.basix_cell().name, degree, shape=(gdim,))
        known = _compat.geometry_dofmap(source)
        corners = len(basix.topology(source.basix_cell())[0])
        alike = known.shape[1] if known.shape[1] == dofmap.list.shape[1] else corners
        places = np.zeros(len(source.geometry.x), dtype=np.int64)
        places[known[:, :alike]] = dofmap.list[:, :alike]
        return cls(dofmap.list, x, dofmap.index_map, element, places)


class Remesh(Carrier):
    """A mesh on the same ranks with some quadrilaterals cut in two, or with moved nodes.

    The first half of a quadrilateral keeps its input index; the second ones follow after all
    others, in the order of the cuts.

    Args:
        source: The mesh before (collective).
        cuts: Quadrilaterals of degree 1 to be cut.
        positions: Where the nodes of the owned cells are to be, shape ``(n, k, gdim)``; ``None``
            leaves them. They are those of a Lagrange space on the mesh, whose degree the map of the
            new cells has.
        space: That space; only with positions.

    Attributes:
        source: The mesh before.
        mesh: The mesh after.
        index: Input indices on the new mesh of the owned cells of the old one and of their halves.
    """

    def __init__(
        self,
        source: mesh.Mesh,
        cuts: Cuts,
        positions: NDArray[np.float64] | None = None,
        space: fem.FunctionSpace | None = None,
    ) -> None:
        comm = source.comm
        index = input_cell_index(source)
        count = source.topology.index_map(source.topology.dim).size_global
        self._count, self._cut = count, cuts[:, 0]
        order = np.argsort(index)
        place = np.searchsorted(index, cuts[:, 0], sorter=order)
        place[place == len(index)] = 0
        here = np.zeros(len(cuts), dtype=bool)
        if len(index):
            here = index[order[place]] == cuts[:, 0]
        cut, diagonal = order[place[here]], cuts[here, 1]
        whole = np.ones(len(index), dtype=bool)
        whole[cut] = False
        self._parents = np.concatenate([np.flatnonzero(whole), cut, cut])
        self.index = np.concatenate(
            [index[whole], index[cut], count + np.flatnonzero(here).astype(np.int64)]
        )
        places = _Nodes.of_geometry(source) if space is None else _Nodes.of_space(space)
        nodes = places.of_cells[: len(index)]
        own, both = np.arange(nodes.shape[1]), (0, 1) if len(cut) else ()
        doubled = (HALVES[..., :-1] == HALVES[..., -1:]).argmax(axis=-1)
        every = HALVES.reshape(len(HALVES), 1, 1, -1)
        times = (HALVES[..., None] == every).sum(axis=-1)
        corners = np.broadcast_to(own, (len(index), len(own)))[whole]
        self._corners = np.concatenate([corners, *(HALVES[diagonal, half] for half in both)])
        self._parts = np.concatenate(
            [np.ones(corners.shape), *(1.0 / times[diagonal, half] for half in both)]
        )

        x, numbering = places.x, places.numbering
        if positions is not None:
            x[nodes] = positions
        added = np.cumsum([0, *comm.allgather(2 * len(cut))])
        firsts = np.array(comm.allgather(numbering.local_range[0]))
        old = numbering.local_to_global(np.arange(len(x), dtype=np.int32))
        numbers = old + added[np.searchsorted(firsts, old, side="right") - 1]
        corners = np.take_along_axis(nodes[self._parents], self._corners, axis=1)
        cells = numbers[corners]
        new, twins = np.arange(len(index) - len(cut), len(cells)), doubled[diagonal].ravel("F")
        cells[new, twins] = numbering.local_range[1] + added[comm.rank] + np.arange(len(new))
        self._copies = np.zeros(self._corners.shape, dtype=bool)
        self._copies[new, twins] = True
        points = np.concatenate([x[: numbering.size_local], x[corners[new, -1]]])

        ranks = np.full(len(index), comm.rank, dtype=np.int64)
        seen = np.column_stack([ranks, neighbour_ranks(source, ranks)])[self._parents]
        total = count + len(cuts)
        first, last = (total * r // comm.size for r in (comm.rank, comm.rank + 1))
        exchange = RowExchange(comm, self.index, np.arange(first, last))
        targets = [[row[0], *sorted({*row[1:]} - {row[0], -1})] for row in exchange(seen).tolist()]
        element = places.element
        after = _compat.mesh_on_ranks(comm, exchange(cells), element, points, targets)
        origin = input_cell_index(after).copy()
        second = origin >= count
        origin[second] = cuts[origin[second] - count, 0]
        super().__init__(source, after, origin, numbers[places.of_geometry_nodes])

    @property
    def halves(self) -> NDArray[np.bool_]:
        """Whether each owned cell of the new mesh is half of one of the old mesh, ``(n,)``."""
        index = input_cell_index(self.mesh)
        return np.asarray(np.isin(index, self._cut) | (index >= self._count))

    def rows(self, values: NDArray[Any], nodal: bool = False) -> NDArray[Any]:
        """Return values of the owned cells for each of :attr:`index`, on the same rank.

        Args:
            values: Shape ``(n, ...)``, nodal ones ``(n, k, ...)``.
            nodal: Whether halves have a part of the nodes only.
        """
        taken: NDArray[Any] = values[self._parents]
        if not nodal or len(self._cut) == 0:
            return taken
        corners = self._corners.reshape(*self._corners.shape, *[1] * (values.ndim - 2))
        return np.asarray(np.take_along_axis(taken, corners, axis=1))

    def column(self, column: Column) -> Column:
        """Return kept values for each of :attr:`index`, on the same rank.

        A half has the values of its cell and of its points, of those corners that are its own,
        and of those facets; there is nothing yet on the facets that the cut has made.
        """
        if column.at != "facets":
            rows = self.rows(column.values, nodal=column.at in ("nodes", "forces"))
            if column.at == "forces":
                rows[self._copies] = 0.0
            return Column(rows, column.at)
        taken = column.values[self._parents]
        cell = self.source.basix_cell()
        edges = np.sort(basix.topology(cell)[self.source.topology.dim - 1], axis=1)
        if len(self._cut) == 0:
            return Column(taken, column.at)
        ends = self._corners[:, edges]
        same = np.all(np.sort(ends, axis=2)[:, :, None] == edges, axis=3)
        facet, there = same.argmax(axis=2), same.any(axis=2)
        turned = ends[:, :, 0] > ends[:, :, 1]
        more = (1,) * (taken.ndim - 2)
        taken = np.take_along_axis(taken, facet.reshape(*facet.shape, *more), axis=1)
        if taken.ndim > 2:
            taken = np.where(turned.reshape(*turned.shape, *more), taken[:, :, ::-1], taken)
        nothing = np.zeros((), taken.dtype)  # a truth stays one
        return Column(np.where(there.reshape(*there.shape, *more), taken, nothing), column.at)

    def masses(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shares in masses at nodes ``(n, k)`` of each cell of the new mesh, ``(n, k)``.

        A half has that of the corner which is its own, and half of those on the diagonal.
        """
        want = input_cell_index(self.mesh)
        exchange = RowExchange(self.mesh.comm, self.index, want)
        shares = self.rows(nodal, nodal=True)
        return np.asarray(exchange(shares * self._parts if len(self._cut) else shares))
