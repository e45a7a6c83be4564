# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Cells of the background: which one holds a point, and where in it."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix.ufl
from dolfinx import fem, geometry, mesh

from .. import _compat
from .._core import loops
from ..meshes.cells import disconnected_mesh, input_cell_index
from ..tolerances import BLOCK, EQUAL, LAST_PLACES, NEGLIGIBLE

__all__ = ["CellTable", "Cells"]


class Vertices:
    """Geometry nodes of a mesh's cells, which are found where they are asked for.

    Args:
        x: Coordinates of nodes, shape ``(N, gdim)``.
        corners: Nodes of the cells, shape ``(n, k)``.
    """

    def __init__(self, x: NDArray[np.float64], corners: NDArray[np.int32]) -> None:
        self._x, self._corners = x, corners

    def __getitem__(self, cells: slice | NDArray[np.integer[Any]]) -> NDArray[np.float64]:
        return np.asarray(self._x[self._corners[cells]])


class CellTable(NamedTuple):
    """Background cells, of any rank.

    Attributes:
        vertices: Their geometry nodes, of shape ``(n, k, gdim)`` where it is indexed.
        nodes: Global nodes of V, shape ``(n, K)``.
        number: Input indices, shape ``(n,)``.
        home: Local numbers on the ranks that own them, shape ``(n,)``.
        rank: These ranks, shape ``(n,)``.
    """

    vertices: NDArray[np.float64] | Vertices
    nodes: NDArray[np.int64]
    number: NDArray[np.int64]
    home: NDArray[np.integer[Any]]
    rank: NDArray[np.integer[Any]]

    @classmethod
    def owned(cls, V: fem.FunctionSpace) -> CellTable:
        """Return the cells that this rank owns."""
        background = V.mesh
        count = background.topology.index_map(background.topology.dim).size_local
        corners = _compat.geometry_dofmap(background)[:count]
        dofs = V.dofmap.list[:count]
        return cls(
            Vertices(background.geometry.x[:, : background.geometry.dim], corners),
            V.dofmap.index_map.local_to_global(dofs.ravel()).reshape(dofs.shape),
            input_cell_index(background),
            np.arange(count, dtype=np.int32),
            np.full(count, background.comm.rank, dtype=np.int32),
        )

    def part(self, which: slice | NDArray[np.int64]) -> CellTable:
        """Return some of the cells."""
        return CellTable._make(a[which] for a in self)

    def joined(self, other: CellTable) -> CellTable:
        """Return the cells of both tables, each once."""
        pairs = zip(self, other, strict=True)
        both = CellTable._make(np.concatenate([one[:], two[:]]) for one, two in pairs)
        return both.part(np.unique(both.number, return_index=True)[1])


class Cells:
    """Background cells, and the inverse of their maps.

    Args:
        background: The mesh.
        table: All of its cells, or some.
    """

    def __init__(self, background: mesh.Mesh, table: CellTable) -> None:
        self.vertices, self.nodes, self.index, self.home, self.rank = table
        self.gdim = background.geometry.dim
        vertices, count = table.vertices[:], len(table.nodes)
        self._background = background
        self._name = background.basix_cell()
        self.simplex = self._name in (basix.CellType.triangle, basix.CellType.tetrahedron)
        self.map = basix.ufl.element(
            "Lagrange", self._name.name, _compat.geometry_degree(background)
        ).basix_element
        self.middle = basix.geometry(self._name).mean(axis=0)
        # Of coordinates: no small part of a cell that is tiny or far from the origin.
        self.roundoff = 2.0 * LAST_PLACES * np.abs(vertices).max(initial=0.0)
        self._smallest = np.ptp(vertices, axis=1).max(axis=1, initial=0.0).min(initial=np.inf)
        self.affine = self._is_affine()
        every = np.arange(count)
        slopes = np.linalg.inv(self.jacobians(every, np.tile(self.middle, (count, 1))))
        error = LAST_PLACES * np.abs(vertices).max(axis=(1, 2), initial=0.0)
        #: Reference distance that is round-off of coordinates, which is much far from the origin.
        self.slack = error * np.abs(slopes).sum(axis=2).max(axis=1, initial=0.0)
        if self.affine:
            self._slopes = slopes
            self._centres = np.einsum(
                "k,nki->ni", self.map.tabulate(0, self.middle[None])[0, 0, :, 0], vertices
            )
        self.grid = None if self.simplex or not self.affine else RegularGrid.of(vertices)

    @cached_property
    def tree(self) -> Any:
        """A tree of the cells' bounding boxes."""
        vertices = self.vertices[:]
        size = np.ptp(vertices.reshape(-1, self.gdim), axis=0).max()
        domain = self._background
        if domain.comm.size > 1:
            degree = self.map.degree
            domain = disconnected_mesh(MPI.COMM_SELF, vertices, self._name, degree=degree)
        cells = np.arange(len(vertices), dtype=np.int32)
        slack = max(1e2 * NEGLIGIBLE * size, self.roundoff)
        return geometry.bb_tree(domain, domain.topology.dim, padding=slack, entities=cells)

    def _is_affine(self) -> bool:
        count = len(self.nodes)
        if count == 0 or (self.simplex and self.map.degree == 1):
            return True
        corners = np.vstack([self.middle, self.middle + 0.37 / (1 + np.arange(self.gdim))])
        jacobians = self.jacobians(
            np.arange(count).repeat(2), np.tile(corners, (count, 1))
        ).reshape(-1, 2, self.gdim, self.gdim)
        change = np.abs(jacobians[:, 0] - jacobians[:, 1]).max(axis=(1, 2))
        slack = 1e-12 * np.abs(jacobians).max(axis=(1, 2, 3))
        return bool(np.all(change <= np.maximum(slack, self.roundoff)))

    def jacobians(
        self, cells: NDArray[np.int64], reference: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``dx/dX`` of cells at reference points, shape ``(n, gdim, gdim)``."""
        table = _compat.tabulated(self.map, 1, reference)[1:]
        return np.asarray(np.einsum("jpk,pki->pij", table, self.vertices[cells]))

    def pull_back(
        self, cells: NDArray[np.int64], points: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return reference coordinates of points in cells; NaN where Newton fails.

        Args:
            cells: Local cells, shape ``(n,)``.
            points: Points, shape ``(n, gdim)``.

        Returns:
            Reference coordinates, shape ``(n, gdim)``, where cells are not affine by at most 30
            Newton steps.
        """
        if self.affine:
            gaps = points - self._centres[cells]
            return np.asarray(self.middle + np.einsum("nij,nj->ni", self._slopes[cells], gaps))
        reference = np.tile(self.middle, (len(points), 1))
        active = np.arange(len(points))
        floor = self.roundoff / self._smallest
        for _ in range(30):
            table = _compat.tabulated(self.map, 1, reference[active])
            corners = self.vertices[cells[active]]
            gap = points[active] - np.einsum("pk,pki->pi", table[0], corners)
            jacobian = np.einsum("jpk,pki->pij", table[1:], corners)
            with np.errstate(all="ignore"):
                step = _solve(jacobian, gap)
            reference[active] += step
            size = np.abs(step).max(axis=1)
            lost = ~(size < 1e3)
            reference[active[lost]] = np.nan
            active = active[~lost & (size > max(1e-14, floor))]
            if len(active) == 0:
                return reference
        reference[active[size[~lost & (size > max(1e-14, floor))] > 1e-12]] = np.nan
        return reference

    def violation(
        self, cells: NDArray[np.int64], reference: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return how far reference coordinates lie outside the cell (0 inside, inf for NaN)."""
        low = -reference.min(axis=1, initial=0.0)
        high = reference.sum(axis=1) - 1 if self.simplex else reference.max(axis=1) - 1
        worst = np.maximum(low, high)
        near = np.maximum(EQUAL, self.slack[cells])
        return np.where(np.isnan(worst), np.inf, np.where(worst <= near, 0.0, worst))

    def clip(self, cells: NDArray[np.int64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return reference coordinates moved onto the cell, and onto its facets where near.

        Else nodes off a facet that a point lies on would have the round-off of its coordinates
        for a weight.
        """
        slack = self.slack[cells, None]
        inside = np.where(reference <= slack, 0.0, reference)
        if not self.simplex:
            return np.where(inside >= 1.0 - slack, 1.0, inside)
        total = inside.sum(axis=1)[:, None]
        return np.asarray(inside / np.where(total >= 1.0 - slack, total, 1.0))

    def locate(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return for each point the best cell, its reference coordinates and its violation."""
        n = len(points)
        cell = np.zeros(n, dtype=np.int64)
        reference = np.tile(self.middle, (n, 1))
        violation = np.full(n, np.inf)
        if self.grid is not None:
            self._locate_in_grid(self.grid, points, cell, reference, violation)
        if violation.max(initial=0.0) <= NEGLIGIBLE:
            return cell, reference, violation
        for start in range(0, n if len(self.nodes) else 0, BLOCK):
            block = np.arange(start, min(start + BLOCK, n))
            block = block[violation[block] > NEGLIGIBLE]
            block = block[np.isfinite(points[block]).all(axis=1)]
            if len(block) == 0:
                continue
            hit, found, coordinates, outside = self._search(points[block])
            known = block[hit]
            cell[known], reference[known], violation[known] = found, coordinates, outside
        return cell, reference, violation

    def _locate_in_grid(
        self,
        grid: RegularGrid,
        points: NDArray[np.float64],
        cell: NDArray[np.int64],
        reference: NDArray[np.float64],
        violation: NDArray[np.float64],
    ) -> None:
        """Set what :meth:`locate` returns of points in the boxes of a grid."""
        loops.locate(
            grid.spaced_lines,
            grid.table,
            self.index,
            self._slopes,
            self._centres,
            self.middle,
            self.slack,
            (LAST_PLACES, EQUAL),
            points,
            cell,
            reference,
            violation,
        )

    def _search(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return which points lie in a cell's bounding box, and for them what ``locate`` does."""
        padded = np.zeros((len(points), 3))
        padded[:, : self.gdim] = points
        found = geometry.compute_collisions_points(self.tree, padded)
        offsets, candidates = found.offsets, found.array
        counts = np.diff(offsets)
        hit = np.flatnonzero(counts)
        if len(hit) == 0:
            return hit, hit, points[hit], np.zeros(0)
        cells: NDArray[np.int64] = candidates.astype(np.int64)
        reference = self.pull_back(cells, np.repeat(points, counts, axis=0))
        outside = self.violation(cells, reference)
        starts, counts = offsets[hit], counts[hit]
        least = np.repeat(np.minimum.reduceat(outside, starts), counts)
        rank = np.where(outside == least, self.index[cells], np.iinfo(np.int64).max)
        first = np.repeat(np.minimum.reduceat(rank, starts), counts)
        best = np.flatnonzero(rank == first)
        return hit, cells[best], reference[best], outside[best]


class RegularGrid:
    """Index arithmetic on cells that are the boxes of a rectilinear grid, or some of them.

    Args:
        lines: Coordinates of the grid lines in each direction.
        table: Cell in each box, -1 where there is none.

    Attributes:
        table: As given.
        spaced_lines: The lines, and their distance where it is the same everywhere, else 0.
    """

    def __init__(self, lines: list[NDArray[np.float64]], table: NDArray[np.int64]) -> None:
        self.table = table
        self.spaced_lines = [(line, _even(line)) for line in lines]

    @classmethod
    def of(cls, vertices: NDArray[np.float64]) -> RegularGrid | None:
        """Return the grid of cells with these vertices ``(n, k, gdim)``, if they are one."""
        if len(vertices) == 0:
            return None
        lines, places = [], []
        for x in np.moveaxis(vertices, 2, 0):
            line = np.unique(x)
            error = 2.0 * LAST_PLACES * np.abs(line).max()
            line = line[np.diff(line, prepend=-np.inf) > max(1e-9 * (line[-1] - line[0]), error)]
            middles = 0.5 * (x.min(axis=1) + x.max(axis=1))
            place = np.searchsorted(line, middles) - 1
            ends = line[np.clip([place, place + 1], 0, len(line) - 1)]
            near = np.minimum(np.abs(x - ends[0][:, None]), np.abs(x - ends[1][:, None]))
            if near.max() > max(1e-9 * np.diff(line).min(), error):
                return None
            lines.append(line)
            places.append(place)
        shape = tuple(len(line) - 1 for line in lines)
        if np.prod(shape, dtype=float) > 16 * len(vertices):
            return None
        table = np.full(shape, -1, dtype=np.int64)
        table[tuple(places)] = np.arange(len(vertices))
        return cls(lines, table)


def _even(line: NDArray[np.float64]) -> float:
    """Return the size of a line's intervals where all have the same, else 0."""
    size = float((line[-1] - line[0]) / (len(line) - 1))
    return 0.0 if np.ptp(np.diff(line)) > 1e-6 * size else size


def _solve(matrix: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve many 2 x 2 or 3 x 3 systems by Cramer's rule."""
    if matrix.shape[-1] == 2:
        (a, b), (c, d) = matrix[:, 0].T, matrix[:, 1].T
        x, y = vector.T
        cofactors = np.stack([d * x - b * y, a * y - c * x], axis=1)
        return np.asarray(cofactors / (a * d - b * c)[:, None])
    u, v, w = matrix[:, :, 0], matrix[:, :, 1], matrix[:, :, 2]
    vw = np.cross(v, w)
    numerators = [vw, np.cross(w, u), np.cross(u, v)]
    determinant = np.einsum("pi,pi->p", u, vw)
    cofactors = np.stack([np.einsum("pi,pi->p", k, vector) for k in numerators], axis=1)
    return np.asarray(cofactors / determinant[:, None])
