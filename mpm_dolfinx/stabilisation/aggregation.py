# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Badly filled cells continue the polynomial of a well filled one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import assembled, marked
from ..background.pairs import CellPairs
from ..background.polynomials import CellPolynomials
from ..particles.particles import Particles
from ..transfer.touched import TouchedNodes
from .cell_fill import CellFill, poorly_filled
from .cure import Cure

__all__ = ["Aggregation"]

#: Layers of cells over which aggregation looks for a well filled one.
LAYERS = 8


class Aggregation(Cure):
    """Badly supported dofs follow the polynomial of a well filled cell near by.

    A node whose cells are all filled below one half takes the value there of the continued
    polynomial of a well filled cell, reached over facets (Badia, Verdugo & Martin 2018). Where
    there is none within eight cells the node stays an unknown of its own.

    Args:
        bodies: The bodies (collective).
    """

    extends = True

    def __init__(self, bodies: Sequence[Particles]) -> None:
        super().__init__()
        self._bodies = list(bodies)
        self._V = bodies[0].V
        self._cells = CellPairs(self._V)
        self._polynomials = CellPolynomials(self._V)
        coordinates = self._V.tabulate_dof_coordinates()
        own = self._V.mesh.topology.index_map(self._V.mesh.topology.dim).size_local
        dofs = self._V.dofmap.list[:own]
        self._positions = coordinates[dofs][:, :, : self._V.mesh.geometry.dim]

    @override
    def unknowns(self, touched: TouchedNodes, held: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the unknowns, without dofs that follow a well filled cell."""
        cells, V = self._cells, self._V
        support = CellFill.of(self._bodies, cells)
        good = support.active & ~poorly_filled(support.fill)
        self._good = marked(V, cells.nodes[: cells.num_own][good])
        root = self._roots(good, support.active)
        lost = np.flatnonzero(support.active & ~good & (root.index >= 0))
        coefficients, frame = self._root_polynomials(root.vertices[lost])
        at = self._polynomials.at(self._positions[lost], frame)
        values = at @ coefficients
        gap = np.linalg.norm(self._positions[lost].mean(axis=1) - frame.origin, axis=1)
        distance = np.round(gap / np.ptp(self._positions[lost], axis=1).max(axis=1), 9)
        self._take(cells.nodes[lost], values, root.nodes[lost], distance, cells.index[lost])
        count = V.mesh.comm.allreduce(len(self._node)) * V.dofmap.index_map_bs
        self.counts = {"aggregated_dofs": count}
        result = touched.has_weight | marked(V, self._root)
        result[self._node] = False
        return touched.on_dofs(result)

    def _root_polynomials(self, vertices: NDArray[np.float64]) -> tuple[NDArray[np.float64], Any]:
        frame = self._polynomials.frame(vertices)
        return self._polynomials.moments(vertices, frame).coefficients, frame

    def _roots(self, good: NDArray[np.bool_], active: NDArray[np.bool_]) -> _Roots:
        """Return for each own cell the nearest well filled one over active cells (collective)."""
        cells = self._cells
        n = cells.num_own
        roots = _Roots(
            np.where(good, cells.index[:n], -1), cells.nodes[:n].copy(), cells.vertices[:n].copy()
        )
        middle = cells.vertices[:n].mean(axis=1)
        a, b = cells.pairs.T
        inner = b < n
        a, b = np.concatenate([a, b[inner]]), np.concatenate([b, a[inner]])
        for _ in range(LAYERS):
            found = _Roots(*(cells.with_others(part) for part in roots))
            open_ = active & (roots.index < 0)
            use = open_[a] & (found.index[b] >= 0)
            if not self._V.mesh.comm.allreduce(bool(use.any()), MPI.LOR):
                break
            one, other = a[use], b[use]
            gap = np.linalg.norm(found.vertices[other].mean(axis=1) - middle[one], axis=1)
            near = np.round(gap / np.ptp(cells.vertices[one], axis=1).max(axis=1), 9)
            order = np.lexsort((found.index[other], near, one))
            one, first = np.unique(one[order], return_index=True)
            chosen = other[order][first]
            for mine, theirs in zip(roots, found, strict=True):
                mine[one] = theirs[chosen]
        return roots

    def _take(
        self,
        nodes: NDArray[np.int64],
        values: NDArray[np.float64],
        roots: NDArray[np.int64],
        distance: NDArray[np.float64],
        index: NDArray[np.int64],
    ) -> None:
        """Keep for each own node that is badly supported the nearest cell's offer (collective)."""
        comm: MPI.Comm = self._V.mesh.comm
        imap = self._V.dofmap.index_map
        m, k = nodes.shape
        offers = (
            nodes.ravel(),
            values.reshape(m * k, k),
            np.repeat(roots, k, axis=0),
            np.repeat(distance, k),
            np.repeat(index, k),
        )
        ends = np.asarray(comm.allgather(imap.local_range[1]))
        home = np.searchsorted(ends, offers[0], side="right")
        parts = comm.alltoall([[part[home == r] for part in offers] for r in range(comm.size)])
        node, value, root, far, cell = (
            np.concatenate([part[i] for part in parts]) for i in range(5)
        )
        node = node - imap.local_range[0]
        order = np.lexsort((cell, far, node))
        order = order[~self._good[node[order]]]
        self._node, first = np.unique(node[order], return_index=True)
        self._value, self._root = value[order][first], root[order][first]

    @override
    def followers(self, owned: int) -> NDArray[np.bool_]:
        follows = np.zeros(owned, dtype=bool)
        follows.reshape(-1, self._V.dofmap.index_map_bs)[self._node] = True
        return follows

    @override
    def extension(self, fixed: NDArray[np.bool_]) -> PETSc.Mat:
        V = self._V
        bs = V.dofmap.index_map_bs
        start = V.dofmap.index_map.local_range[0]
        own = V.dofmap.index_map.size_local
        follows = np.zeros((own, bs), dtype=bool)
        follows[self._node] = ~fixed.reshape(-1, bs)[self._node]
        itself = np.flatnonzero(~follows.ravel()) + start * bs
        k = self._root.shape[1]
        component = np.arange(bs)
        shape = (len(self._node), bs, k)
        use = np.broadcast_to(follows[self._node][:, :, None], shape)
        rows = np.broadcast_to(((self._node + start)[:, None] * bs + component)[:, :, None], shape)
        columns = self._root[:, None, :] * bs + component[:, None]
        values = np.broadcast_to(self._value[:, None, :], shape)
        return assembled(
            V,
            np.concatenate([itself, rows[use]]),
            np.concatenate([itself, columns[use]]),
            np.concatenate([np.ones(len(itself)), values[use]]),
            bs,
        )


class _Roots:
    """The well filled cell that each cell follows: input index (-1: none), nodes, vertices."""

    def __init__(
        self, index: NDArray[np.int64], nodes: NDArray[np.int64], vertices: NDArray[np.float64]
    ) -> None:
        self.index = index
        self.nodes = nodes
        self.vertices = vertices

    def __iter__(self) -> Any:
        return iter((self.index, self.nodes, self.vertices))
