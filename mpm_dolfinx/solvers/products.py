# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Products with matrices whose arrays are known, by compiled loops.

PETSc's take twice as long: of three dofs of a node, rows are alike, and coarse rows have places for
all that a fine one adds. On several ranks, and with 64-bit indices, they are PETSc's all the same.
"""

from __future__ import annotations

from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .._core import loops

__all__ = ["acting", "galerkin", "keep_rows"]

#: By which a matrix has its arrays, and what acts for it.
ROWS, ACTING = "mpm_dolfinx_rows", "mpm_dolfinx_acting"


class _Rows(NamedTuple):
    """The arrays in which a matrix lives."""

    offsets: NDArray[np.integer]
    columns: NDArray[np.integer]
    values: NDArray[np.float64]


class _Product:
    """Context of a PETSc matrix that multiplies by others' rows."""

    def __init__(self, rows: _Rows) -> None:
        self._rows, self._first = rows, loops.equal_rows(rows)

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Set y to the matrix times x."""
        loops.multiply(self._rows, self._first, x.array_r, y.array_w)


def keep_rows(
    matrix: PETSc.Mat,
    offsets: NDArray[np.integer],
    columns: NDArray[np.integer],
    values: NDArray[np.float64],
) -> None:
    """Keep the arrays in which a matrix lives, where loops can use them.

    Args:
        matrix: The matrix.
        offsets: Where its rows begin.
        columns: Their columns.
        values: Their values; they may change.
    """
    if matrix.comm.size == 1 and offsets.dtype == np.int32:
        matrix.setAttr(ROWS, _Rows(offsets, columns, values))


def acting(matrix: PETSc.Mat) -> PETSc.Mat:
    """Return a matrix that multiplies as another does, and faster where its rows are known."""
    rows = matrix.getAttr(ROWS)
    if rows is None:
        return matrix
    found = matrix.getAttr(ACTING)
    if found is None:
        found = PETSc.Mat().createPython(matrix.getSizes(), _Product(rows), comm=matrix.comm)
        matrix.setAttr(ACTING, found)
    return found


def galerkin(A: PETSc.Mat, P: PETSc.Mat, result: PETSc.Mat | None = None) -> PETSc.Mat:
    """Return ``P^T A P`` (collective).

    Args:
        A: The matrix.
        P: The interpolation.
        result: That of before, for an A with the same sparsity; its values are replaced.
    """
    rows, own = A.getAttr(ROWS), P.getAttr(ROWS)
    if rows is None or own is None:
        return A.ptap(P, result=result)
    if result is None:
        count = P.getSize()[1]
        offsets, columns = loops.galerkin_pattern(rows, own, count)
        arrays = offsets, columns, np.zeros(len(columns))
        result = PETSc.Mat().createAIJWithArrays((count, count), arrays, comm=A.comm)
        keep_rows(result, *arrays)
    loops.galerkin(rows, own, *result.getAttr(ROWS))
    result.assemble()
    return result
