# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points to background cells: the background basis evaluated at points of any rank."""

from __future__ import annotations

from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix
import basix.ufl
from dolfinx import fem, mesh

from . import _compat
from .exchange import swap

__all__ = ["BackgroundBasis", "PointBasis"]

#: Reference distance within which a point outside a cell counts as on its boundary.
TOLERANCE = 1e-10
#: Reference distance within which a point is on a facet; the cell first in the input takes it.
FACET = 1e-12
#: Points looked for at once, so that what is known of them stays in the cache.
BLOCK = 1 << 14
#: Basis values below this are no weight.
DROP = 1e-13
#: Background cells that a tile, of which a rank learns at once, holds in the mean.
TILE = 256


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


class _Table(NamedTuple):
    """Background cells, of any rank.

    Attributes:
        vertices: Their geometry nodes, shape ``(n, k, gdim)``.
        nodes: Global nodes of V, shape ``(n, K)``.
        number: Input indices, shape ``(n,)``.
        home: Local numbers on the ranks that own them, shape ``(n,)``.
        rank: These ranks, shape ``(n,)``.
    """

    vertices: NDArray[np.float64]
    nodes: NDArray[np.int64]
    number: NDArray[np.int64]
    home: NDArray[np.int64]
    rank: NDArray[np.int64]

    @classmethod
    def owned(cls, V: fem.FunctionSpace) -> _Table:
        """Return the cells that this rank owns."""
        background = V.mesh
        count = background.topology.index_map(background.topology.dim).size_local
        corners = _compat.geometry_dofmap(background)[:count]
        dofs = V.dofmap.list[:count]
        return cls(
            background.geometry.x[corners][:, :, : background.geometry.dim],
            V.dofmap.index_map.local_to_global(dofs.ravel()).reshape(dofs.shape),
            _compat.input_cell_index(background),
            np.arange(count),
            np.full(count, background.comm.rank),
        )

    def part(self, which: slice | NDArray[np.int64]) -> _Table:
        """Return some of the cells."""
        return _Table._make(a[which] for a in self)

    def joined(self, other: _Table) -> _Table:
        """Return the cells of both tables, each once."""
        both = _Table._make(np.concatenate(pair) for pair in zip(self, other, strict=True))
        return both.part(np.unique(both.number, return_index=True)[1])


class _Cells:
    """Background cells, and the inverse of their maps.

    Args:
        background: The mesh.
        table: All of its cells, or some.
    """

    def __init__(self, background: mesh.Mesh, table: _Table) -> None:
        self.vertices, self.nodes, self.index, self.home, self.rank = table
        self.gdim = background.geometry.dim
        count = len(self.vertices)
        self._background = background
        self._name = background.basix_cell()
        self.simplex = self._name in (basix.CellType.triangle, basix.CellType.tetrahedron)
        self.map = basix.ufl.element(
            "Lagrange", self._name.name, _compat.geometry_degree(background)
        ).basix_element
        self.middle = basix.geometry(self._name).mean(axis=0)
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

    @cached_property
    def tree(self) -> Any:
        """A tree of the cells' bounding boxes."""
        size = np.ptp(self.vertices.reshape(-1, self.gdim), axis=0).max()
        domain = self._background
        if domain.comm.size > 1:
            degree = self.map.degree
            domain = _compat.disconnected_mesh(
                MPI.COMM_SELF, self.vertices, self._name, degree=degree
            )
        cells = np.arange(len(self.vertices), dtype=np.int32)
        return _compat.cell_tree(domain, cells, 1e2 * TOLERANCE * size)

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
        smallest = np.ptp(self.vertices, axis=1).max(axis=1).min(initial=np.inf)
        floor = self.roundoff / smallest
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
        for start in range(0, n if len(self.vertices) else 0, BLOCK):
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


class _Tiles:
    """Boxes of a coarse grid over the background, in which ranks tell each other their cells.

    Args:
        comm: The ranks (collective).
        own: The cells that this rank owns.
    """

    def __init__(self, comm: MPI.Comm, own: _Table) -> None:
        self._comm = comm
        self._own = own
        gdim = own.vertices.shape[2]
        low, high = own.vertices.min(axis=1), own.vertices.max(axis=1)
        empty = np.full((1, gdim), np.inf)
        corner = np.append(low, empty, axis=0).min(axis=0)
        opposite = np.append(high, -empty, axis=0).max(axis=0)
        boxes = np.array(comm.allgather([corner, opposite]))
        self._low = boxes[:, 0].min(axis=0)
        size = boxes[:, 1].max(axis=0) - self._low
        count = comm.allreduce(len(own.number))
        edge = (size.prod() * TILE / count) ** (1.0 / gdim)
        self._shape = np.maximum(size / edge, 1.0).astype(np.int64)
        self._edges = size / self._shape
        pad = 1e2 * TOLERANCE * size.max()
        self._ranks = self._place(boxes + np.array([[-pad], [pad]]))
        self._ranges = self._place(low - pad), self._place(high + pad)
        self._known = np.zeros(self._shape.prod(), dtype=bool)
        self.cells = own.part(slice(0))

    def _place(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the places of points in the coarse grid; those outside it are at its border."""
        place = np.clip((points - self._low) / self._edges, 0, self._shape - 1)
        return np.asarray(place.astype(np.int64))

    def _tile(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.asarray(np.ravel_multi_index(tuple(places.T), tuple(self._shape)))

    def know(self, points: NDArray[np.float64]) -> bool:
        """Learn of all cells around points; return whether there are new ones (collective)."""
        tiles = self._tile(self._place(points[np.isfinite(points).all(axis=1)]))
        new = np.unique(tiles[~self._known[tiles]])
        if self._comm.allreduce(len(new)) == 0:
            return False
        near = np.stack(np.unravel_index(new, self._shape), axis=1)
        steps = np.array(list(product((-1, 0, 1), repeat=len(self._shape))))
        places = np.clip(near[:, None] + steps, 0, self._shape - 1).reshape(-1, len(self._shape))
        asked = np.unique(self._tile(places))
        asked = asked[~self._known[asked]]
        self._known[asked] = True
        place = np.stack(np.unravel_index(asked, self._shape), axis=1)
        low, high = self._ranks[:, 0, None], self._ranks[:, 1, None]
        of_rank = ((place >= low) & (place <= high)).all(axis=2)
        told = [self._inside(q) for q in swap(self._comm, [asked[has] for has in of_rank])]
        whole = [np.column_stack([t.number, t.home, t.rank, t.nodes]) for t in told]
        numbers = np.concatenate(swap(self._comm, whole))
        vertices = np.concatenate(swap(self._comm, [t.vertices for t in told]))
        number, home, rank, nodes = np.split(numbers, [1, 2, 3], axis=1)
        self.cells = self.cells.joined(
            _Table(vertices, nodes, number[:, 0], home[:, 0], rank[:, 0])
        )
        return True

    def _inside(self, tiles: NDArray[np.int64]) -> _Table:
        """Return this rank's own cells in some tiles."""
        wanted = np.zeros(len(self._known), dtype=bool)
        wanted[tiles] = True
        low, high = self._ranges
        found = np.zeros(len(low), dtype=bool)
        for step in product(*(range(n + 1) for n in (high - low).max(axis=0, initial=0))):
            found |= wanted[self._tile(np.minimum(low + step, high))]
        return self._own.part(np.flatnonzero(found))


class BackgroundBasis:
    """Evaluates the basis of a background space at points, wherever their cells live.

    On several ranks each learns of the cells around its points from the ranks that own them, and
    remembers them: where points stay among known cells, nothing is sent.

    Args:
        V: Vector Lagrange space on the background mesh (collective).
    """

    def __init__(self, V: fem.FunctionSpace) -> None:
        self._mesh = V.mesh
        self._basis = V.ufl_element().basix_element
        own = _Table.owned(V)
        self._tiles = _Tiles(V.mesh.comm, own) if V.mesh.comm.size > 1 else None
        self._cells = _Cells(V.mesh, own if self._tiles is None else self._tiles.cells)

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
        if self._tiles is not None and self._tiles.know(points):
            self._cells = _Cells(self._mesh, self._tiles.cells)
        cells = self._cells
        n, k = len(points), cells.nodes.shape[1]
        if n == 0 or len(cells.index) == 0:
            slopes = np.zeros((n, k, points.shape[1])) if gradients else None
            none = np.zeros(n, dtype=np.int64)
            nodes = np.zeros((n, k), dtype=np.int64)
            return PointBasis(nodes, np.zeros((n, k)), none > 0, slopes, none, none)
        cell, reference, violation = cells.locate(points)
        reference = cells.clip(reference)
        table = _compat.tabulated(self._basis, int(gradients), reference)
        found = violation <= TOLERANCE
        inside = found[:, None]
        values = np.where((np.abs(table[0]) >= DROP) & inside, table[0], 0.0)
        slopes = None
        if gradients:
            jacobian = cells.jacobians(cell, reference)
            slopes = np.einsum("jpk,pji->pki", table[1:], np.linalg.inv(jacobian))
            slopes = np.where(inside[:, :, None], slopes, 0.0)
        nodes = cells.nodes[cell]
        return PointBasis(nodes, values, found, slopes, cells.home[cell], cells.rank[cell])
