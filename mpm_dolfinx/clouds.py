# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Clouds of axis-aligned boxes, as meshes whose cells share no vertex."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

import basix
from dolfinx import mesh

from . import _compat
from .errors import MPMError, agree
from .methods import BOX_CELLS

__all__ = ["mesh_of_boxes"]


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
        try:
            centres = np.asarray(points, dtype=np.float64)
        except (TypeError, ValueError):
            centres = np.array(np.nan)
        if centres.ndim != 2 or centres.shape[1] != gdim or not np.isfinite(centres).all():
            raise MPMError(f"points must be finite and of shape (n, {gdim}).")
        try:
            sides = np.broadcast_to(np.asarray(lengths, np.float64), centres.shape)
        except (TypeError, ValueError):
            raise MPMError(
                f"lengths must be a number or of shape {centres.shape}, not {np.shape(lengths)}."
            ) from None
        if not (np.isfinite(sides).all() and (sides > 0.0).all()):
            raise MPMError("lengths must be positive and finite.")
    cell = BOX_CELLS[gdim - 2]
    unit = basix.geometry(cell) - 0.5
    corners = centres[:, None] + unit * sides[:, None]
    return _compat.disconnected_mesh(comm, corners, cell)
