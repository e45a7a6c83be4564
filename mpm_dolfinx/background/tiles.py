# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Boxes of cells that a point is looked for in."""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..parallel.exchange import swap
from ..tolerances import LAST_PLACES, NEGLIGIBLE
from .cells import CellTable

__all__ = ["Tiles"]

#: Background cells that a tile, of which a rank learns at once, holds in the mean.
TILE = 256


class Tiles:
    """Boxes of a coarse grid over the background, in which ranks tell each other their cells.

    Args:
        comm: The ranks (collective).
        own: The cells that this rank owns.
    """

    def __init__(self, comm: MPI.Comm, own: CellTable) -> None:
        self._comm = comm
        self._own = own
        vertices = own.vertices[:]
        gdim = vertices.shape[2]
        low, high = vertices.min(axis=1), vertices.max(axis=1)
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
        error = 2.0 * LAST_PLACES * (np.abs(self._low) + size).max()
        pad = max(1e2 * NEGLIGIBLE * size.max(), error)
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
        vertices = np.concatenate(swap(self._comm, [t.vertices[:] for t in told]))
        number, home, rank, nodes = np.split(numbers, [1, 2, 3], axis=1)
        where = (home[:, 0].astype(np.int32), rank[:, 0].astype(np.int32))
        self.cells = self.cells.joined(CellTable(vertices, nodes, number[:, 0], *where))
        return True

    def _inside(self, tiles: NDArray[np.int64]) -> CellTable:
        """Return this rank's own cells in some tiles."""
        wanted = np.zeros(len(self._known), dtype=bool)
        wanted[tiles] = True
        low, high = self._ranges
        found = np.zeros(len(low), dtype=bool)
        for step in product(*(range(n + 1) for n in (high - low).max(axis=0, initial=0))):
            found |= wanted[self._tile(np.minimum(low + step, high))]
        return self._own.part(np.flatnonzero(found))
