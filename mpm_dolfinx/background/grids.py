# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rectilinear grids over a background, on which multigrid has its coarse levels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix
from dolfinx import fem

from .. import _compat
from ..tolerances import NEGLIGIBLE

__all__ = ["box_weights", "cell_lines", "coarser", "grid_lines"]


def cell_lines(V: fem.FunctionSpace) -> list[NDArray[np.float64]]:
    """Return grid lines about as far from each other as the vertices of the background.

    Where the vertices lie on a rectilinear grid, uniform or graded, these are its lines. Else
    the distance of lines follows the mean size of the cells in each slab across the background.

    Args:
        V: Background space (collective).

    Returns:
        For each direction the coordinates of the lines, rising, the same on all ranks.
    """
    if (lines := grid_lines(V)) is not None:
        return lines
    x = _vertices(V)
    low, high = x.min(axis=1, initial=np.inf), x.max(axis=1, initial=-np.inf)
    comm: MPI.Comm = V.mesh.comm
    return [_by_size(comm, low[:, a], high[:, a]) for a in range(V.mesh.geometry.dim)]


def grid_lines(V: fem.FunctionSpace) -> list[NDArray[np.float64]] | None:
    """Return the lines of the rectilinear grid that the vertices of the background lie on.

    Args:
        V: Background space (collective).

    Returns:
        As :func:`cell_lines`; ``None`` where they lie on no grid.
    """
    x = _vertices(V)
    comm: MPI.Comm = V.mesh.comm
    # a background with four times as many grid points as vertices is no grid
    most = 4.0 * V.mesh.topology.index_map(0).size_global
    lines = []
    for axis in range(V.mesh.geometry.dim):
        parts = comm.allgather(_distinct(x[:, :, axis].ravel()))
        lines.append(_distinct(np.concatenate(parts)))
        if len(lines[-1]) > most:
            return None
    return lines if np.prod([len(line) for line in lines], dtype=float) <= most else None


def _vertices(V: fem.FunctionSpace) -> NDArray[np.float64]:
    """Return the vertices of this rank's own cells, shape ``(n, corners, gdim)``."""
    background = V.mesh
    count = background.topology.index_map(background.topology.dim).size_local
    corners = len(basix.geometry(background.basix_cell()))  # they come first
    nodes = _compat.geometry_dofmap(background)[:count, :corners]
    return np.asarray(background.geometry.x[nodes][:, :, : background.geometry.dim])


def _distinct(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sorted coordinates, each once."""
    values = np.unique(values)
    if len(values) == 0:
        return values
    gap = np.diff(values, prepend=-np.inf)
    return np.asarray(values[gap > NEGLIGIBLE * (values[-1] - values[0])])


def _by_size(
    comm: MPI.Comm, low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return lines whose distance is the mean extent of the cells around (collective)."""
    first = comm.allreduce(float(low.min(initial=np.inf)), MPI.MIN)
    last = comm.allreduce(float(high.max(initial=-np.inf)), MPI.MAX)
    cells, whole = comm.allreduce(np.array([len(low), float((high - low).sum())]))
    slabs = max(round((last - first) * cells / whole), 1)  # as wide as a cell is
    edges = np.linspace(first, last, slabs + 1)
    slab = np.clip(np.searchsorted(edges, 0.5 * (low + high)) - 1, 0, slabs - 1)
    sums = np.stack([np.bincount(slab, minlength=slabs), np.bincount(slab, high - low, slabs)])
    count, extent = comm.allreduce(sums)
    known = np.flatnonzero(count)
    size = np.interp(np.arange(slabs), known, extent[known] / count[known])
    passed = np.concatenate([[0.0], np.cumsum(np.diff(edges) / size)])
    number = max(round(float(passed[-1])), 1)
    return np.interp(np.linspace(0.0, passed[-1], number + 1), passed, edges)


def coarser(lines: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Return every second line in each direction, and the outermost."""
    return [line if len(line) <= 2 else np.append(line[:-1:2], line[-1]) for line in lines]


def box_weights(
    lines: Sequence[NDArray[np.float64]], points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the multilinear basis of a rectilinear grid at points inside it.

    Args:
        lines: The grid's lines.
        points: Shape ``(n, gdim)``.

    Returns:
        Numbers of the grid points around each point, in the order of ``np.ravel_multi_index``,
        and the values there, each of shape ``(n, 2**gdim)``.
    """
    n, gdim = points.shape
    places = np.empty((gdim, n), dtype=np.int64)
    shares = np.empty((gdim, n))
    for axis, line in enumerate(lines):
        place = np.clip(np.searchsorted(line, points[:, axis], "right") - 1, 0, len(line) - 2)
        share = (points[:, axis] - line[place]) / (line[place + 1] - line[place])
        whole = np.round(share)
        places[axis] = place
        shares[axis] = np.clip(np.where(np.abs(share - whole) < NEGLIGIBLE, whole, share), 0.0, 1.0)
    shape = tuple(len(line) for line in lines)
    numbers = np.empty((n, 2**gdim), dtype=np.int64)
    values = np.ones((n, 2**gdim))
    for corner, ends in enumerate(product((0, 1), repeat=gdim)):
        numbers[:, corner] = np.ravel_multi_index(
            tuple(places[a] + e for a, e in enumerate(ends)), shape
        )
        for axis, end in enumerate(ends):
            values[:, corner] *= shares[axis] if end else 1.0 - shares[axis]
    return numbers, values
