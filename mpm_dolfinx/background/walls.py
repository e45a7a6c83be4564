# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The background beyond parts of its boundary that are held: what has passed them stays there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, la, mesh

from .. import _compat
from ..meshes.nearest import FacetTree
from ..tolerances import ROUND_OFF, SMALL
from .cells import Cells, CellTable
from .points import PointBasis

__all__ = ["Walls"]


class _Found(NamedTuple):
    """Points beyond the boundary, as one rank knows them.

    Attributes:
        away: Their distances, infinite where the boundary does not hold them, shape ``(n,)``.
        nodes: Global nodes of V, shape ``(n, k)``.
        values: Of the basis, shape ``(n, k)``.
        gradients: Shape ``(n, k, gdim)``.
        cell: The cell at the boundary, shape ``(n,)``.
    """

    away: NDArray[np.float64]
    nodes: NDArray[np.int64]
    values: NDArray[np.float64]
    gradients: NDArray[np.float64]
    cell: NDArray[np.int64]


class Walls:
    """The boundary of a background that holds what passes it, up to a cell beyond.

    In the cells at a floor that is held, what is fast moves the other nodes alone: a step may take
    it through the floor, as a step's motion is linear in a cell. Beyond, the basis is that of the
    nearest place of the boundary, where its nodes are at rest in the direction of the point: such
    a point moves along the boundary with them, or not at all.

    Args:
        V: Vector Lagrange space on the background mesh (collective).
    """

    def __init__(self, V: fem.FunctionSpace) -> None:
        self._V = V
        self._own = Cells(V.mesh, CellTable.owned(V))
        self._basis = V.ufl_element().basix_element
        self._gdim = V.mesh.geometry.dim
        self._at_rest = la.vector(V.dofmap.index_map, self._gdim)
        domain, dim = V.mesh, V.mesh.topology.dim - 1
        domain.topology.create_connectivity(dim, dim + 1)
        facets = mesh.exterior_facet_indices(domain.topology)
        corners = domain.geometry.x[_compat.entity_nodes(domain, dim, facets), : self._gdim]
        to_cell = domain.topology.connectivity(dim, dim + 1)
        cells = np.array([to_cell.links(facet)[0] for facet in facets], dtype=np.int64)
        if corners.shape[1] == 4:  # two triangles of each quadrilateral
            corners = corners[:, [[0, 1, 2], [1, 3, 2]]].reshape(-1, 3, 3)
            cells = np.repeat(cells, 2)
        self._cells = cells
        self._boundary = FacetTree(corners) if len(cells) else None

    def extend(
        self,
        basis: PointBasis,
        points: NDArray[np.float64],
        lost: NDArray[np.int64],
        at_rest: NDArray[np.bool_],
    ) -> None:
        """Set the basis at points that the boundary holds, in place (collective).

        Args:
            basis: That at all of this rank's points.
            points: The points, shape ``(n, gdim)``.
            lost: Those that are in no cell.
            at_rest: Components of nodes of V that this rank owns, shape ``(m, gdim)``.
        """
        self._at_rest.array[: at_rest.size] = at_rest.ravel()
        self._at_rest.scatter_forward()
        comm = self._V.mesh.comm
        asked = comm.allgather(points[lost])
        starts = np.cumsum([0, *map(len, asked)])
        mine = slice(starts[comm.rank], starts[comm.rank + 1])
        told = comm.allgather(self._nearest(np.concatenate(asked)))
        rank = np.argmin([found.away[mine] for found in told], axis=0)
        every = np.arange(len(lost))
        parts = (np.stack([part[mine] for part in each]) for each in zip(*told, strict=True))
        found = _Found(*(part[rank, every] for part in parts))
        held = np.isfinite(found.away)
        which = lost[held]
        basis.found[which] = True
        basis.nodes[which], basis.values[which] = found.nodes[held], found.values[held]
        if basis.gradients is not None:
            basis.gradients[which] = found.gradients[held]
        if basis.cell is not None and basis.rank is not None:
            basis.cell[which], basis.rank[which] = found.cell[held], rank[held]

    def _nearest(self, points: NDArray[np.float64]) -> _Found:
        """Return the basis at the nearest places of this rank's part of the boundary."""
        n, k = len(points), self._own.nodes.shape[1]
        found = _Found(
            np.full(n, np.inf),
            np.zeros((n, k), dtype=np.int64),
            np.zeros((n, k)),
            np.zeros((n, k, self._gdim)),
            np.zeros(n, dtype=np.int64),
        )
        if n == 0 or self._boundary is None:
            return found
        facets, ways = self._boundary.ways(points)
        cell = self._cells[facets]
        near = self._own.violation(cell, self._own.pull_back(cell, points)) <= 1.0
        cell, ways = cell[near], ways[near]
        there = self._own.clip(cell, self._own.pull_back(cell, points[near] + ways))
        table = _compat.tabulated(self._basis, 1, there)
        values = np.where(np.abs(table[0]) >= ROUND_OFF, table[0], 0.0)
        local = self._V.dofmap.list[cell]
        loose = self._at_rest.array.reshape(-1, self._gdim)[local] == 0.0
        away = np.linalg.norm(ways, axis=1)
        across = np.abs(ways) > SMALL * away[:, None]
        free = (loose & across[:, None] & (values != 0.0)[:, :, None]).any(axis=(1, 2))
        slopes = np.einsum(
            "jpk,pji->pki", table[1:], np.linalg.inv(self._own.jacobians(cell, there))
        )
        normal = ways / np.where(away > 0.0, away, 1.0)[:, None]
        slopes -= np.einsum("pki,pi,pj->pkj", slopes, normal, normal)
        found.away[near] = np.where(free, np.inf, away)
        found.nodes[near], found.values[near] = self._own.nodes[cell], values
        found.gradients[near], found.cell[near] = slopes, cell
        return found
