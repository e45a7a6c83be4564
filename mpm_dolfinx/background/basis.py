# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Values of the background's basis at points, on the ranks that ask."""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .. import _compat
from ..parallel.totals import over_ranks
from ..tolerances import BLOCK, NEGLIGIBLE, ROUND_OFF
from .cells import Cells, CellTable
from .points import PointBasis
from .tiles import Tiles
from .walls import Walls

__all__ = ["BackgroundBasis", "PointBasis"]

#: Distance in cells at which the cells beside a point are looked for.
BESIDE = 0.25


class BackgroundBasis:
    """Evaluates the basis of a background space at points, wherever their cells live.

    On several ranks each learns of the cells around its points from the ranks that own them, and
    remembers them: where points stay among known cells, nothing is sent.

    Args:
        V: Vector Lagrange space on the background mesh (collective).
    """

    def __init__(self, V: fem.FunctionSpace) -> None:
        self._V, self._mesh = V, V.mesh
        self._at_rest: NDArray[np.bool_] | None = None
        self._walls: Walls | None = None
        self._basis = V.ufl_element().basix_element
        own = CellTable.owned(V)
        self._tiles = Tiles(V.mesh.comm, own) if V.mesh.comm.size > 1 else None
        self._cells = Cells(V.mesh, own if self._tiles is None else self._tiles.cells)

    def hold(self, at_rest: NDArray[np.bool_]) -> bool:
        """Let the boundary hold what passes it where its nodes are at rest (collective).

        See :class:`.Walls`.

        Args:
            at_rest: Components of nodes of V that this rank owns, shape ``(n, gdim)``.

        Returns:
            Whether some were at rest that are no longer.
        """
        before, self._at_rest = self._at_rest, at_rest
        let_go = before is not None and bool(np.any(before & ~at_rest))
        return over_ranks(self._mesh.comm, let_go, MPI.LOR)

    def at(self, points: NDArray[np.float64], gradients: bool = False) -> PointBasis:
        """Evaluate the basis at points (collective).

        A point on a facet belongs to that of its cells that comes first in the mesh's input,
        on any number of ranks. A point at most 1e-10 of a cell outside the mesh, or the round-off
        of its coordinates, counts as on it. Beyond a boundary that :meth:`hold` was told of, the
        basis is continued.

        Args:
            points: This rank's points, shape ``(n, gdim)``; they may lie in cells of any rank.
            gradients: Whether to evaluate gradients too.

        Returns:
            Nodes, values and whether a cell was found.
        """
        basis = self.within(points, gradients)
        if self._at_rest is None:
            return basis
        lost = np.flatnonzero(~basis.found & np.isfinite(points).all(axis=1))
        if over_ranks(self._mesh.comm, len(lost)) > 0:
            if self._walls is None:
                self._walls = Walls(self._V)
            self._walls.extend(basis, points, lost, self._at_rest)
        return basis

    def within(self, points: NDArray[np.float64], gradients: bool = False) -> PointBasis:
        """Evaluate the basis as :meth:`at` does, at points in cells alone (collective)."""
        cells = self._around(points)
        n, k = len(points), cells.nodes.shape[1]
        if n == 0 or len(cells.index) == 0:
            slopes = np.zeros((n, k, points.shape[1])) if gradients else None
            none = np.zeros(n, dtype=np.int64)
            nodes = np.zeros((n, k), dtype=np.int64)
            return PointBasis(nodes, np.zeros((n, k)), none > 0, slopes, none, none)
        nodes, values = np.empty((n, k), dtype=np.int64), np.empty((n, k))
        slopes = np.empty((n, k, points.shape[1])) if gradients else None
        found = np.empty(n, dtype=bool)
        home, rank = np.empty(n, dtype=cells.home.dtype), np.empty(n, dtype=cells.rank.dtype)
        for start in range(0, n, BLOCK):  # what is on the way is large
            part = slice(start, start + BLOCK)
            cell, reference, violation = cells.locate(points[part])
            reference = cells.clip(cell, reference)
            table = _compat.tabulated(self._basis, int(gradients), reference)
            found[part] = violation <= NEGLIGIBLE
            inside = found[part, None]
            values[part] = np.where((np.abs(table[0]) >= ROUND_OFF) & inside, table[0], 0.0)
            if slopes is not None:
                inverse = np.linalg.inv(cells.jacobians(cell, reference))
                own = np.einsum("jpk,pji->pki", table[1:], inverse)
                slopes[part] = np.where(inside[:, :, None], own, 0.0)
            nodes[part], home[part], rank[part] = (
                cells.nodes[cell],
                cells.home[cell],
                cells.rank[cell],
            )
        return PointBasis(nodes, values, found, slopes, home, rank)

    def beside(self, points: NDArray[np.float64]) -> tuple[PointBasis, NDArray[np.float64]]:
        """Evaluate at points the basis of the cells beside theirs, continued (collective).

        Args:
            points: This rank's points, shape ``(n, gdim)``, on which :meth:`at` has been.

        Returns:
            The basis of the cells in each of m directions, of which several may be one, with
            gradients, shapes ``(n, m, ...)``; how far the point lies outside each, in reference
            coordinates, shape ``(n, m)``, infinite where there is none.
        """
        n, gdim = points.shape
        ways = np.array([way for way in product((-1, 0, 1), repeat=gdim) if any(way)])
        size = np.zeros((n, gdim))
        if n > 0:
            size = np.ptp(self._cells.vertices[self._cells.locate(points)[0]], axis=1)
        probes = (points[:, None] + BESIDE * size[:, None] * ways).reshape(-1, gdim)
        basis = self.at(probes, gradients=True)
        assert basis.gradients is not None
        cells, shape = self._cells, (n, len(ways))
        outside = np.full(n * len(ways), np.inf)
        if n > 0:
            cell, _, _ = cells.locate(probes)
            reference = cells.pull_back(cell, np.repeat(points, len(ways), axis=0))
            far = cells.violation(cell, reference)
            known = basis.found & np.isfinite(far)
            outside[known] = far[known]
            table = _compat.tabulated(self._basis, 1, reference[known])
            inverse = np.linalg.inv(cells.jacobians(cell[known], reference[known]))
            basis.values[known] = table[0]
            basis.gradients[known] = np.einsum("jpk,pji->pki", table[1:], inverse)
        basis = PointBasis._make(
            None if part is None else part.reshape(*shape, *part.shape[1:]) for part in basis
        )
        return basis, outside.reshape(shape)

    def _around(self, points: NDArray[np.float64]) -> Cells:
        """Return cells with those that hold points among them (collective)."""
        if self._tiles is not None and self._tiles.know(points):
            self._cells = Cells(self._mesh, self._tiles.cells)
        return self._cells
