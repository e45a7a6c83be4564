# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Clouds of axis-aligned boxes, as meshes whose cells share no vertex."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix
from dolfinx import mesh

from ..errors import MPMError, agree
from ..parallel.exchange import swap
from ..reals import as_finite, as_reals
from ..tolerances import SMALL
from .cells import disconnected_mesh

__all__ = ["BOX_CELLS", "mesh_of_boxes"]

BOX_CELLS = (basix.CellType.quadrilateral, basix.CellType.hexahedron)


def mesh_of_boxes(comm: MPI.Comm, points: Any, lengths: Any, gdim: int) -> mesh.Mesh:
    """Return a mesh of rectangles or boxes, one for each point (collective).

    Args:
        comm: The ranks; each box is given by one of them.
        points: Centres of this rank's boxes, shape ``(n, gdim)``.
        lengths: Side lengths, a number or shape ``(n, gdim)``.
        gdim: Dimension, 2 or 3.

    Raises:
        MPMError: Shapes that do not fit, or lengths that are not positive.
    """
    with agree(comm):
        centres = as_finite(points, None, gdim)
        if centres is None:
            raise MPMError(f"points must be finite and of shape (n, {gdim}).")
        try:
            sides = np.broadcast_to(as_reals(lengths), centres.shape)
        except (TypeError, ValueError):
            raise MPMError(
                f"lengths must be a number or of shape {centres.shape}, not {np.shape(lengths)}."
            ) from None
        if not (np.isfinite(sides).all() and (sides > 0.0).all()):
            raise MPMError("lengths must be positive and finite.")
    _require_apart(comm, centres, sides)
    cell = BOX_CELLS[gdim - 2]
    unit = basix.geometry(cell) - 0.5
    corners = centres[:, None] + unit * sides[:, None]
    return disconnected_mesh(comm, corners, cell)


def _require_apart(comm: MPI.Comm, centres: NDArray[np.float64], sides: Any) -> None:
    """Raise an error where two boxes, of any ranks, are in one place (collective)."""
    least = comm.allreduce(float(sides.min(initial=np.inf)), MPI.MIN)
    places = np.round(centres / (SMALL * least)).astype(np.int64)
    homes = (places @ np.array([7919, 104729, 1299709])[: centres.shape[1]]) % comm.size
    first = sum(comm.allgather(len(centres))[: comm.rank])
    rows = np.column_stack([places, np.arange(first, first + len(centres))])
    here = np.concatenate(swap(comm, [rows[homes == rank] for rank in range(comm.size)]))
    _, which, times = np.unique(here[:, :-1], axis=0, return_inverse=True, return_counts=True)
    twice = here[times[which.ravel()] > 1, -1]
    with agree(comm):
        if len(twice):
            raise MPMError(
                "The boxes of {particles} have others in the same place; give each box once, on "
                "one rank.",
                twice,
            )
