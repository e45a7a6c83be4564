# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which part of each background cell the bodies fill."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import la

from ..background.basis import PointBasis
from ..background.pairs import CellPairs
from ..meshes.quadrature import volume_ratio
from ..particles.particles import Particles
from ..tolerances import SMALL

__all__ = ["CellFill", "poorly_filled"]

#: Fill of a cell below which its dofs count as badly supported, but for round-off: bodies whose
#: domains are half as wide as a cell fill halves of cells.
FILL = 0.5


def poorly_filled(fill: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether cells are filled too little to support their dofs.

    Args:
        fill: Of each body, shape ``(c, bodies)``.
    """
    return np.asarray(fill.sum(axis=1) < FILL - SMALL)


def _points(body: Particles) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions ``(n nq, gdim)`` and volumes ``(n nq,)`` of a body's points.

    They are those of the last converged step, without particles that are deleted or of which no
    node is carried.
    """
    nodes, gradient = body.domain_nodes, body.placement.gradient()
    there = np.ones(len(nodes), dtype=bool)
    if body.deletion is not None or body.free_nodes is not None:
        there = ~(body.deleted | body.free[nodes].all(axis=1))
    rule, corners = body.undeformed.rule, body.node_positions[nodes[there]]
    points = np.einsum("qk,nki->nqi", rule.shapes, corners)
    volumes = rule.weights[there] * volume_ratio(gradient[there])
    return points.reshape(-1, corners.shape[-1]), volumes.ravel()


class CellFill(NamedTuple):
    """Fill of the cells of the background that this rank owns by the bodies.

    Attributes:
        fill: Volume of each body inside each cell over the cell's, shape ``(c, bodies)``.
        active: Whether a body reaches into the cell, shape ``(c,)``.
    """

    fill: NDArray[np.float64]
    active: NDArray[np.bool_]

    @classmethod
    def of(cls, bodies: Sequence[Particles], pairs: CellPairs) -> CellFill:
        """Look at bodies at their last converged positions (collective).

        The volume is that of the history's quadrature points in the cell. A body may also
        reach into a cell with nodes alone, a sliver: the fill is zero then, but nodes of the
        cell have weight that belong to no filled cell.

        Args:
            bodies: The bodies.
            pairs: The cells of the background.
        """
        V, count = bodies[0].V, pairs.num_own
        comm: MPI.Comm = V.mesh.comm
        volume = np.zeros((count, len(bodies)))
        used = np.zeros(count, dtype=np.uint64)
        bit = np.uint64(1) << np.arange(V.dofmap.list.shape[1], dtype=np.uint64)
        for number, body in enumerate(bodies):
            points, volumes = _points(body)
            at = body.mover.basis.at(points)
            for cells, values in _sent(comm, at, at.found, volumes):
                volume[:, number] += np.bincount(cells, weights=values, minlength=count)
            rows = body.node_basis.part(body.W.dofmap.index_map.size_local)
            bits = ((rows.values != 0.0) * bit).sum(axis=1, dtype=np.uint64)
            for cells, values in _sent(comm, rows, rows.found, bits):
                np.bitwise_or.at(used, cells, values)
        filled = volume.any(axis=1)
        own = V.dofmap.list[:count]
        known = la.vector(V.dofmap.index_map)
        known.array[own[filled]] = 1.0
        known.scatter_reverse(la.InsertMode.add)
        known.scatter_forward()
        alone = ((known.array[own] == 0.0) * bit).sum(axis=1, dtype=np.uint64)
        active = filled | ((used & alone) != 0)
        return cls(volume / pairs.volumes[:, None], active)


def _sent(
    comm: MPI.Comm, at: PointBasis, which: NDArray[np.bool_], values: NDArray[Any]
) -> list[tuple[NDArray[np.integer[Any]], NDArray[Any]]]:
    """Send values at some points to the owners of their cells; return what comes (collective)."""
    assert at.cell is not None and at.rank is not None
    if comm.size == 1:
        return [(at.cell[which], values[which])]
    chosen = [which & (at.rank == r) for r in range(comm.size)]
    return comm.alltoall([(at.cell[pick], values[pick]) for pick in chosen])
