# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Orders: of points, and of the nodes of cells in other programs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import basix
import dolfinx
from dolfinx import mesh

__all__ = ["gmsh_order", "morton_order", "vtk_cell"]


def morton_order(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the order of points along Morton's curve.

    Args:
        points: Shape ``(n, gdim)``.

    Returns:
        Shape ``(n,)``.
    """
    gdim = points.shape[1]
    code = np.zeros(len(points), dtype=np.uint32)
    if len(points) > 0:
        low = points.min(axis=0)
        size = float((points.max(axis=0) - low).max()) or 1.0
        bits = np.iinfo(code.dtype).bits // gdim
        cells = ((points - low) * ((2**bits - 1) / size)).astype(np.uint32)
        for bit in range(bits):
            for i in range(gdim):
                code |= ((cells[:, i] >> bit) & 1) << (bit * gdim + i)
    return np.argsort(code, kind="stable").astype(np.int32)


#: VTK's types of cells of degree 1, the order of their corners, and the types of Lagrange cells.
_VTK = {
    "interval": (3, [0, 1], 68),
    "triangle": (5, [0, 1, 2], 69),
    "quadrilateral": (9, [0, 1, 3, 2], 70),
    "tetrahedron": (10, [0, 1, 2, 3], 71),
    "hexahedron": (12, [0, 1, 3, 2, 4, 5, 7, 6], 72),
}


def vtk_cell(cell: basix.CellType, degree: int, count: int) -> tuple[int, NDArray[np.int64]]:
    """Return VTK's type of a cell, and which of its nodes, equispaced, is each of VTK's.

    Args:
        cell: The cell.
        degree: Its degree.
        count: Number of its nodes.
    """
    straight, corners, curved = _VTK[cell.name]
    return (straight, np.array(corners)) if degree == 1 else (curved, _vtk_order(cell, count))


def _vtk_order(cell: basix.CellType, count: int) -> NDArray[np.int64]:
    """Return which of a curved cell's nodes, equispaced, is each of VTK's."""
    return np.argsort(dolfinx.cpp.io.perm_vtk(mesh.to_type(cell.name), count))


def gmsh_order(cell: basix.CellType, count: int) -> NDArray[np.int64]:
    """Return which of a cell's nodes, in Gmsh's order, is each of DOLFINx's."""
    order = dolfinx.cpp.io.perm_gmsh(mesh.to_type(cell.name), count)
    return np.asarray(order, dtype=np.int64)
