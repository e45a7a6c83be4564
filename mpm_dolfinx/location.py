# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points to background cells: the background basis evaluated at points of any rank."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import basix
import basix.ufl
from dolfinx import fem, mesh

from . import _compat

__all__ = ["BackgroundBasis", "PointBasis"]

#: Reference distance within which a point outside a cell counts as on its boundary.
TOLERANCE = 1e-10
#: Reference distance within which a point is on a facet; the cell first in the input takes it.
FACET = 1e-12
#: Points looked for at once, so that what is known of them stays in the cache.
BLOCK = 1 << 14
#: Basis values below this are no weight.
DROP = 1e-13


class PointBasis(NamedTuple):
    """Background basis functions at points.

    Attributes:
        nodes: Global node (block) numbers of V, shape ``(n, k)``.
        values: Their values at the points, zero where below 1e-13, shape ``(n, k)``.
        found: Whether a background cell holds the point, shape ``(n,)``.
        gradients: Their gradients, shape ``(n, k, gdim)``, where asked for.
        cell: The cell, a local number on the rank that owns it, shape ``(n,)``; ``None`` where
            values are of several cells.
        rank: That rank, shape ``(n,)``.
    """

    nodes: NDArray[np.int64]
    values: NDArray[np.float64]
    found: NDArray[np.bool_]
    gradients: NDArray[np.float64] | None = None
    cell: NDArray[np.int64] | None = None
    rank: NDArray[np.int64] | None = None

    def part(self, count: int) -> PointBasis:
        """Return what is known of the first points."""
        return PointBasis._make(None if a is None else a[:count] for a in self)


class _Cells:
    """The background cells that one rank owns, and the inverse of their maps."""

    def __init__(self, background: mesh.Mesh) -> None:
        tdim = background.topology.dim
        self.gdim = background.geometry.dim
        count = background.topology.index_map(tdim).size_local
        self.vertices = background.geometry.x[_compat.geometry_dofmap(background)[:count]][
            :, :, : self.gdim
        ]
        name = background.basix_cell()
        self.simplex = name in (basix.CellType.triangle, basix.CellType.tetrahedron)
        self.map = basix.ufl.element(
            "Lagrange", name.name, _compat.geometry_degree(background)
        ).basix_element
        self.middle = basix.geometry(name).mean(axis=0)
        # Of coordinates: no small part of a cell that is tiny or far from the origin.
        self.roundoff = 8.0 * np.finfo(float).eps * np.abs(self.vertices).max(initial=0.0)
        self.affine = self._is_affine()
        if self.affine:
            every = np.arange(count)
            self._slopes = np.linalg.inv(self.jacobians(every, np.tile(self.middle, (count, 1))))
            self._centres = np.einsum(
                "k,nki->ni", self.map.tabulate(0, self.middle[None])[0, 0, :, 0], self.vertices
            )
        self.grid = None if self.simplex or not self.affine else _Grid.of(self.vertices)
        size = np.ptp(self.vertices.reshape(-1, self.gdim), axis=0).max() if count else 1.0
        self.index = _compat.input_cell_index(background)
        cells = np.arange(count, dtype=np.int32)
        self.tree = _compat.cell_tree(background, cells, 1e2 * TOLERANCE * size) if count else None

    @property
    def box(self) -> NDArray[np.float64]:
        """Lower and upper corner of all cells, shape ``(2, gdim)``; empty: inverted."""
        if len(self.vertices) == 0:
            return np.array([np.full(self.gdim, np.inf), np.full(self.gdim, -np.inf)])
        points = self.vertices.reshape(-1, self.gdim)
        pad = 1e-8 * np.ptp(points, axis=0).max()
        return np.stack([points.min(axis=0) - pad, points.max(axis=0) + pad])

    def _is_affine(self) -> bool:
        if len(self.vertices) == 0 or (self.simplex and self.map.degree == 1):
            return True
        corners = np.vstack([self.middle, self.middle + 0.37 / (1 + np.arange(self.gdim))])
        jacobians = self.jacobians(
            np.arange(len(self.vertices)).repeat(2), np.tile(corners, (len(self.vertices), 1))
        ).reshape(-1, 2, self.gdim, self.gdim)
        change = np.abs(jacobians[:, 0] - jacobians[:, 1]).max(axis=(1, 2))
        slack = 1e-12 * np.abs(jacobians).max(axis=(1, 2, 3))
        return bool(np.all(change <= np.maximum(slack, self.roundoff)))

    def jacobians(
        self, cells: NDArray[np.int64], reference: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return ``dx/dX`` of cells at reference points, shape ``(n, gdim, gdim)``."""
        table = self.map.tabulate(1, reference)[1:, :, :, 0]
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
        smallest = np.ptp(self.vertices, axis=1).max(axis=1).min(initial=np.inf)
        floor = self.roundoff / smallest
        for _ in range(30):
            table = self.map.tabulate(1, reference[active])[:, :, :, 0]
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

    def violation(self, reference: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far reference coordinates lie outside the cell (0 inside, inf for NaN)."""
        low = -reference.min(axis=1, initial=0.0)
        high = reference.sum(axis=1) - 1 if self.simplex else reference.max(axis=1) - 1
        worst = np.maximum(low, high)
        return np.where(np.isnan(worst), np.inf, np.where(worst <= FACET, 0.0, worst))

    def clip(self, reference: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return reference coordinates moved onto the cell."""
        if not self.simplex:
            return np.clip(reference, 0.0, 1.0)
        inside = np.maximum(reference, 0.0)
        return np.asarray(inside / np.maximum(1.0, inside.sum(axis=1))[:, None])

    def locate(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return for each point the best cell, its reference coordinates and its violation."""
        n = len(points)
        cell = np.zeros(n, dtype=np.int64)
        reference = np.tile(self.middle, (n, 1))
        violation = np.full(n, np.inf)
        for start in range(0, n if self.tree is not None else 0, BLOCK):
            block = np.arange(start, min(start + BLOCK, n))
            block = block[np.isfinite(points[block]).all(axis=1)]
            if self.grid is not None:
                inside, found = self.grid.find(points[block], self.index)
                known = block[inside]
                cell[known] = found
                reference[known] = self.pull_back(found, points[known])
                violation[known] = self.violation(reference[known])
                block = block[violation[block] > TOLERANCE]
            if len(block) == 0:
                continue
            hit, found, coordinates, outside = self._search(points[block])
            known = block[hit]
            cell[known], reference[known], violation[known] = found, coordinates, outside
        return cell, reference, violation

    def _search(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return which points lie in a cell's bounding box, and for them what ``locate`` does."""
        padded = np.zeros((len(points), 3))
        padded[:, : self.gdim] = points
        offsets, candidates = _compat.candidate_cells(self.tree, padded)
        counts = np.diff(offsets)
        hit = np.flatnonzero(counts)
        if len(hit) == 0:
            return hit, hit, points[hit], np.zeros(0)
        cells: NDArray[np.int64] = candidates.astype(np.int64)
        reference = self.pull_back(cells, np.repeat(points, counts, axis=0))
        outside = self.violation(reference)
        starts, counts = offsets[hit], counts[hit]
        least = np.repeat(np.minimum.reduceat(outside, starts), counts)
        rank = np.where(outside == least, self.index[cells], np.iinfo(np.int64).max)
        first = np.repeat(np.minimum.reduceat(rank, starts), counts)
        best = np.flatnonzero(rank == first)
        return hit, cells[best], reference[best], outside[best]


class _Grid:
    """Index arithmetic on cells that are the boxes of a rectilinear grid, or some of them.

    Args:
        lines: Coordinates of the grid lines in each direction.
        table: Cell in each box, -1 where there is none.
    """

    def __init__(self, lines: list[NDArray[np.float64]], table: NDArray[np.int64]) -> None:
        self._lines = lines
        self._table = table

    @classmethod
    def of(cls, vertices: NDArray[np.float64]) -> _Grid | None:
        """Return the grid of cells with these vertices ``(n, k, gdim)``, if they are one."""
        if len(vertices) == 0:
            return None
        lines, places = [], []
        for x in np.moveaxis(vertices, 2, 0):
            line = np.unique(x)
            line = line[np.diff(line, prepend=-np.inf) > 1e-9 * (line[-1] - line[0])]
            middles = 0.5 * (x.min(axis=1) + x.max(axis=1))
            place = np.searchsorted(line, middles) - 1
            ends = line[np.clip([place, place + 1], 0, len(line) - 1)]
            near = np.minimum(np.abs(x - ends[0][:, None]), np.abs(x - ends[1][:, None]))
            if near.max() > 1e-9 * np.diff(line).min():
                return None
            lines.append(line)
            places.append(place)
        shape = tuple(len(line) - 1 for line in lines)
        if np.prod(shape, dtype=float) > 16 * len(vertices):
            return None
        table = np.full(shape, -1, dtype=np.int64)
        table[tuple(places)] = np.arange(len(vertices))
        return cls(lines, table)

    @staticmethod
    def _place(line: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the interval of a line that holds each coordinate, or is next to it."""
        size = (line[-1] - line[0]) / (len(line) - 1)
        if np.ptp(np.diff(line)) > 1e-6 * size:
            return np.asarray(np.clip(np.searchsorted(line, x, "right") - 1, 0, len(line) - 2))
        place = np.clip((x - line[0]) / size, 0, len(line) - 2).astype(np.int64)
        place -= (x < line[place]) & (place > 0)
        place += (x >= line[place + 1]) & (place < len(line) - 2)
        return np.asarray(place)

    def find(
        self, points: NDArray[np.float64], index: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return which points lie in boxes with a cell, and these cells.

        Args:
            points: Points, shape ``(n, gdim)``.
            index: Input index of each cell; on a facet the first cell wins.
        """
        low, high = [], []
        for line, x in zip(self._lines, points.T, strict=True):
            place = self._place(line, x)
            reach = FACET * (line[place + 1] - line[place])
            low.append(np.where(x - line[place] <= reach, np.maximum(place - 1, 0), place))
            beyond = np.minimum(place + 1, len(line) - 2)
            high.append(np.where(line[place + 1] - x <= reach, beyond, place))
        cell = self._table[tuple(high)]
        between = np.flatnonzero(np.any([a != b for a, b in zip(low, high, strict=True)], axis=0))
        for pick in product(*zip(low, high, strict=True)) if len(between) else ():
            other = self._table[tuple(p[between] for p in pick)]
            mine = cell[between]
            better = (other >= 0) & ((mine < 0) | (index[other] < index[mine]))
            cell[between[better]] = other[better]
        inside = np.flatnonzero(cell >= 0)
        return inside, cell[inside]


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


class BackgroundBasis:
    """Evaluates the basis of a background space at points, wherever their cells live.

    Args:
        V: Vector Lagrange space on the background mesh (collective).
    """

    def __init__(self, V: fem.FunctionSpace) -> None:
        self._comm = V.mesh.comm
        self._cells = _Cells(V.mesh)
        self._basis = V.ufl_element().basix_element
        self._dofs = V.dofmap.list
        self._map = V.dofmap.index_map
        self._boxes = np.asarray(self._comm.allgather(self._cells.box))

    def at(self, points: NDArray[np.float64], gradients: bool = False) -> PointBasis:
        """Evaluate the basis at points (collective).

        A point on a facet belongs to that of its cells that comes first in the mesh's input,
        on any number of ranks. A point at most 1e-10 of a cell outside the mesh counts as on it.

        Args:
            points: This rank's points, shape ``(n, gdim)``; they may lie in cells of any rank.
            gradients: Whether to evaluate gradients too.

        Returns:
            Nodes, values and whether a cell was found.
        """
        if self._comm.size == 1:
            return self._evaluate(points, gradients).basis(np.zeros(len(points), np.int64))
        inside = np.all(
            (points[None] >= self._boxes[:, None, 0]) & (points[None] <= self._boxes[:, None, 1]),
            axis=2,
        )
        asked = [np.flatnonzero(row) for row in inside]
        questions = self._comm.alltoall([points[index] for index in asked])
        ends = np.cumsum([len(q) for q in questions])
        answer = self._evaluate(np.concatenate(questions), gradients)
        replies = self._comm.alltoall(
            [answer.part(slice(end - len(q), end)) for q, end in zip(questions, ends, strict=True)]
        )
        n, k = len(points), self._dofs.shape[1]
        result = _Answer(
            np.zeros((n, k), dtype=np.int64),
            np.zeros((n, k)),
            np.zeros((n, k, points.shape[1])) if gradients else None,
            np.full(n, np.inf),
            np.zeros(n, dtype=np.int64),
            np.zeros(n, dtype=np.int64),
        )
        rank = np.zeros(n, dtype=np.int64)
        for source, (index, reply) in enumerate(zip(asked, replies, strict=True)):
            better = (reply.violation < result.violation[index]) | (
                (reply.violation == result.violation[index]) & (reply.cell < result.cell[index])
            )
            result.take(index[better], reply.part(better))
            rank[index[better]] = source
        return result.basis(rank)

    def _evaluate(self, points: NDArray[np.float64], gradients: bool) -> _Answer:
        cell, reference, violation = self._cells.locate(points)
        n, k = len(points), self._dofs.shape[1]
        if n == 0 or self._cells.tree is None:
            slopes = np.zeros((n, k, points.shape[1])) if gradients else None
            nodes = np.zeros((n, k), np.int64)
            return _Answer(nodes, np.zeros((n, k)), slopes, violation, cell, cell)
        reference = self._cells.clip(reference)
        table = self._basis.tabulate(int(gradients), reference)[:, :, :, 0]
        found = (violation <= TOLERANCE)[:, None]
        values = np.where((np.abs(table[0]) >= DROP) & found, table[0], 0.0)
        slopes = None
        if gradients:
            jacobian = self._cells.jacobians(cell, reference)
            slopes = np.einsum("jpk,pji->pki", table[1:], np.linalg.inv(jacobian))
            slopes = np.where(found[:, :, None], slopes, 0.0)
        nodes = self._map.local_to_global(self._dofs[cell].ravel()).reshape(-1, k)
        return _Answer(nodes, values, slopes, violation, self._cells.index[cell], cell)


class _Answer(NamedTuple):
    """Basis functions at points, how far outside the best cell they are, and its numbers.

    ``cell`` is its input index, ``home`` its local number on the rank that answers.
    """

    nodes: NDArray[np.int64]
    values: NDArray[np.float64]
    gradients: NDArray[np.float64] | None
    violation: NDArray[np.float64]
    cell: NDArray[np.int64]
    home: NDArray[np.int64]

    def basis(self, rank: NDArray[np.int64]) -> PointBasis:
        """Return what is known of the points, with the rank that each answer is of."""
        return PointBasis(self.nodes, self.values, self.found, self.gradients, self.home, rank)

    @property
    def found(self) -> NDArray[np.bool_]:
        return np.asarray(self.violation <= TOLERANCE)

    def part(self, which: slice | NDArray[np.bool_]) -> _Answer:
        """Return the answer for some of the points."""
        return _Answer._make(None if a is None else a[which] for a in self)

    def take(self, index: NDArray[np.int64], other: _Answer) -> None:
        """Put another answer in the place of some points' own."""
        for mine, theirs in zip(self, other, strict=True):
            if mine is not None and theirs is not None:
                mine[index] = theirs
